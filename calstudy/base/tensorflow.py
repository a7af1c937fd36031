"""TensorFlow as everything here imports it: from this module."""

from calstudy.base.quiet import load_tensorflow

load_tensorflow()

import tensorflow as tf  # noqa: E402

__all__ = ["tf"]
