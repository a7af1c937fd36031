"""calstudy: simulation and validation studies of 21 cm interferometer calibration."""

import os
from importlib import import_module

# TensorFlow rounds differently with these kernels and without. It reads this once, when it is imported, in whichever
# process that is first: results must not depend on whether that is a worker or not.
os.environ.setdefault("TF_ENABLE_ONEDNN_OPTS", "0")

__version__: str

# `calibrate` is the package of that name.
INTERFACE = {
    "load": "interface",
    "open_run": "interface",
    "calibrate_data": "interface",
    "InputError": "base.errors",
    "ExperimentError": "base.errors",
}
"""Names of the Python interface, and the modules that have them."""
__all__ = ["__version__", *INTERFACE]


def __getattr__(name: str) -> object:
    # What these functions need takes a second to import, which commands such as --help do without.
    if name in INTERFACE:
        return getattr(import_module(f"calstudy.{INTERFACE[name]}"), name)
    if name == "__version__":
        # Imported above, it would import array.py of a working folder before `__main__` can leave that out.
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("calstudy")
        except PackageNotFoundError:
            return "0+unknown"
    raise AttributeError(f"module 'calstudy' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
