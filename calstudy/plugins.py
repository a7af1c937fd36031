"""Functions of your own, in a Python file that an experiment names: a calibrator, a sky."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from calstudy.errors import InputError
from calstudy.schema import Section, fault


class Plugin(Section):
    """A function in a Python file. What is made with it is made anew when the file changes.

    The file is run by itself: what it imports must be installed.
    """

    path: Path = Field(strict=False, description="The file; a relative path starts at the experiment file.")
    function: str = Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", description="Name of the function in it.")
    options: dict[str, Any] = Field(default_factory=dict, description="Given to the function as keyword arguments.")

    @field_validator("options")
    @classmethod
    def _no_path(cls, options: dict[str, Any]) -> dict[str, Any]:
        if "path" in options:
            raise fault("path", "has a name that is kept for the file itself; call the option something else")
        return options


def plugin_fault(plugin: Plugin) -> str | None:
    """Return what keeps a plugin from being used, found without running its file, or None."""
    try:
        tree = ast.parse(plugin.path.read_text(encoding="utf-8"))
    except OSError as error:
        return f"path = {str(plugin.path)!r}: cannot be read ({error.strerror})"
    except UnicodeDecodeError:
        return f"path = {str(plugin.path)!r}: not a text file in UTF-8"
    except SyntaxError as error:
        return f"path = {str(plugin.path)!r}: not valid Python (line {error.lineno}: {error.msg})"
    names = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
    if plugin.function not in names:
        listed = f"it has: {', '.join(names)}" if names else "it has none"
        return f"function = {plugin.function!r}: not a function of {plugin.path.name} ({listed})"
    return None


def load_function(plugin: Plugin) -> Callable[..., Any]:
    """Run the plugin's file and return its function.

    Raises
    ------
    InputError
        If the file cannot be run, or does not have the function.
    """
    fault_found = plugin_fault(plugin)
    if fault_found is not None:
        raise InputError(fault_found)
    spec = importlib.util.spec_from_file_location(f"calstudy_plugin_{plugin.path.stem}", plugin.path)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ImportError as error:
        raise InputError(f"{plugin.path}: cannot be run ({error})") from None
    return getattr(module, plugin.function)
