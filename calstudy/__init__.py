"""calstudy: simulation and validation studies of 21 cm interferometer calibration."""

import os
from importlib.metadata import PackageNotFoundError, version

# TensorFlow rounds differently with these kernels and without. It reads this once, when it is imported, in whichever
# process that is first: results must not depend on whether that is a worker or not.
os.environ.setdefault("TF_ENABLE_ONEDNN_OPTS", "0")

try:
    __version__ = version("calstudy")
except PackageNotFoundError:
    __version__ = "0+unknown"
