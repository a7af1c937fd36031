"""TensorFlow, imported from this module everywhere in calstudy."""

from calstudy.base.quiet import load_tensorflow

load_tensorflow()

import tensorflow as tf  # noqa: E402

__all__ = ["tf"]
