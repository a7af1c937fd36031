"""calstudy: simulation and validation studies of 21 cm interferometer calibration."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("calstudy")
except PackageNotFoundError:
    __version__ = "0+unknown"
