"""Users' Python files: their identity, running them as modules, and errors of their code."""

from __future__ import annotations

import ast
import gc
import hashlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from threading import Lock, current_thread, main_thread
from types import CodeType, ModuleType
from typing import Any

from calstudy.base.errors import InputError, refusal_of_disk
from calstudy.base.files import kept_while_unchanged, sha256

FILE_MODULE = "calstudy_plugin_"
"""What the names of modules that were read from a file start with."""


_PARSING = Lock()


def parse(code: str) -> ast.Module:
    """Parse Python code while no other thread can run.

    Python 3.11 counts the depth of trees of all threads together, and fails with SystemError where another one parses
    in the meantime; only the garbage collector leaves a thread that parses.
    """
    with _PARSING:
        collects = gc.isenabled()
        gc.disable()
        try:
            return ast.parse(code)
        finally:
            if collects:
                gc.enable()


digest_file = kept_while_unchanged(256)(sha256)
"""The SHA-256 of a file's content, in hexadecimal, kept while the file does not change."""


_REFUSED: ContextVar[str] = ContextVar("refused", default="")


@contextmanager
def without_code_of_files(instead: str) -> Iterator[None]:
    """Refuse to run Python files in the block, with an InputError that says what can be done instead."""
    token = _REFUSED.set(instead)
    try:
        yield
    finally:
        _REFUSED.reset(token)


def beside_of(path: Path) -> dict[str, Path]:
    """Return the modules that a Python file imports from its own folder, and those that these import, by name."""
    found: dict[str, Path] = {}
    waiting = list(_imported(path))
    while waiting:
        name = waiting.pop()
        if name.partition(".")[0] == __name__.partition(".")[0]:
            continue  # A file beside the package of calstudy itself.
        place = path.parent.joinpath(*name.split("."))
        for candidate in (place.with_suffix(".py"), place / "__init__.py"):
            if candidate.is_file() and candidate != path and name not in found:
                found[name] = candidate
                waiting += _imported(candidate, _package(name, candidate))
    return found


def _package(name: str, file: Path) -> str:
    """Return the name of the package in which a module imports relative names."""
    return name if file.name == "__init__.py" else name.rpartition(".")[0]


def identity_of_file(path: Path, part: str = "") -> str:
    """Return the identity of a file by its content, and of a Python file by the modules of `beside_of` as well.

    `part`, such as ``:MeanGain``, says which of its classes is used.
    """
    beside = beside_of(path) if path.suffix == ".py" else {}
    others = "".join(f":{name}={digest_file(found)}" for name, found in sorted(beside.items()))
    return f"sha256:{digest_file(path)}{part}{others}"


def _imported(path: Path, package: str = "", in_functions: bool = False) -> Iterator[str]:
    """Yield the names of all modules that a file of a package may import, and of the packages that they are in.

    With `in_functions`, of those alone that its functions import.
    """
    try:
        tree = parse(path.read_text(encoding="utf-8"))
    except (ValueError, SyntaxError):
        return  # Whoever runs it reports it.
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    for node in (node for root in (functions if in_functions else [tree]) for node in ast.walk(root)):
        if isinstance(node, ast.Import):
            names = [item.name for item in node.names]
        elif isinstance(node, ast.ImportFrom):
            # Each dot but the first leads one package up.
            inside = package.split(".")[: package.count(".") + 2 - node.level] if node.level else []
            source = [part for part in (*inside, node.module) if part]
            names = [".".join(source), *(".".join([*source, item.name]) for item in node.names)]
        else:
            continue
        for name in filter(None, names):
            parts = name.split(".")
            yield from (".".join(parts[: count + 1]) for count in range(len(parts)))


def load_file(path: Path) -> ModuleType:
    """Run a Python file as a module, once for each version of its content, and return the module.

    It can import modules of its folder, which are then run again. Raises InputError if the file cannot be read or is
    not valid Python, if running it raises an error (the message names the line), or if code of files is refused.
    """
    content, beside = _read_code(path)
    name = f"{FILE_MODULE}{path.stem}_{hashlib.sha256(f'{path}{content}'.encode()).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    loader = _Uncompiled(name, str(path.absolute()))
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    assert spec is not None, "there is a loader"
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        with _modules_beside(path, beside), user_code(path.name):
            loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


@contextmanager
def _modules_beside(path: Path, beside: dict[str, Path]) -> Iterator[None]:
    """Import these modules of a file's folder in the block, where others of the same name may have been imported.

    Raises InputError if a function imports such a module, since a call would import that of the other file.
    """
    own = {name: found for name, found in beside.items() if not _is_installed(name.partition(".")[0])}
    packages = {path: "", **{file: _package(name, file) for name, file in own.items()}}
    late = {name for file, package in packages.items() for name in _imported(file, package, in_functions=True)}
    # They may import any of the others, and as late.
    later = set() if late.isdisjoint(own) else set(own)
    for name in own:
        loaded = getattr(sys.modules.get(name), "__file__", None) if name in later else None
        other = Path(_LATER.get(name) or loaded or own[name])
        if other.is_file() and digest_file(other) != digest_file(own[name]):
            raise InputError(
                f"{path.name} imports {own[name]}, another file imports {other} by the same name, and a function may "
                f"import either when it is called; import {name} at the top of both files, or rename it"
            )
    _LATER.update({name: own[name] for name in later})
    roots = {name.partition(".")[0] for name in own}
    for name in [name for name in sys.modules if name.partition(".")[0] in roots]:
        del sys.modules[name]
    finder = _Beside(own)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        if _CALLED not in sys.meta_path:
            sys.meta_path.insert(0, _CALLED)


class _Uncompiled(SourceFileLoader):
    """Neither reads nor writes compiled code, which Python takes for current if second and size are the same."""

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


class _Beside(MetaPathFinder):
    """Finds modules by name in a given table."""

    def __init__(self, files: dict[str, Path]) -> None:
        self.files = files

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        del path, target
        if (file := self.files.get(fullname)) is None:
            return None
        return importlib.util.spec_from_file_location(
            fullname, file, loader=_Uncompiled(fullname, str(file.absolute()))
        )


_LATER: dict[str, Path] = {}
"""Modules that functions of users' files import when they are called, by name."""
_CALLED = _Beside(_LATER)


def _is_installed(name: str) -> bool:
    """Return whether a module belongs to Python or to an installed package."""
    if name in sys.stdlib_module_names:
        return True
    places = [place for place in sys.path if "site-packages" in place or "dist-packages" in place]
    return PathFinder.find_spec(name, places) is not None


def _read_code(path: Path) -> tuple[str, dict[str, Path]]:
    """Return the content of a Python file with digests of the modules beside it, and these modules; see `load_file`."""
    if instead := _REFUSED.get():
        raise InputError(f"{str(path)!r} is code, which is not run here; {instead}")
    try:
        text = path.read_text(encoding="utf-8")
        parse(text)
        beside = beside_of(path)
        return "".join([text, *(f"{name} {digest_file(found)}" for name, found in sorted(beside.items()))]), beside
    except OSError as error:
        fault = f"cannot be read ({error.strerror})"
    except UnicodeDecodeError:
        fault = "is not a text file in UTF-8"
    except SyntaxError as error:
        fault = f"is not valid Python (line {error.lineno}: {error.msg})"
    except ValueError as error:
        fault = f"is not valid Python ({error})"
    raise InputError(f"{str(path)!r} {fault}")


def files_of_class(cls: type) -> list[Path]:
    """Return the users' files in which functions of a class and its bases are defined."""
    spaces = [item.__globals__ for kind in cls.__mro__ for item in vars(kind).values() if inspect.isfunction(item)]
    return sorted({Path(space["__file__"]) for space in spaces if _is_of_file(space)})


def _is_of_file(space: Mapping[str, Any]) -> bool:
    """Return whether the globals of a function are those of a module that was read from a user's file."""
    return isinstance(getattr(space.get("__spec__"), "loader", None), _Uncompiled)


def load_function(path: Path, name: str) -> Callable[..., Any]:
    """Return a function that a Python file defines; raises InputError if it does not, or cannot be run."""
    module = load_file(path)
    functions = {
        key: value
        for key, value in vars(module).items()
        if inspect.isfunction(value) and value.__module__ == module.__name__
    }
    if name not in functions:
        listed = f"it has: {', '.join(functions)}" if functions else "it has none"
        raise InputError(f"{name!r} is not a function of {path.name} ({listed})")
    return functions[name]


class UserCodeError(InputError):
    """A user's own code raised an error; the message has its type, text, file and line, and nothing of calstudy."""


@contextmanager
def user_code(name: str = "", disk_passes: bool = False) -> Iterator[None]:
    """Run a user's code; its errors, SystemExit included, become a `UserCodeError` that names the line, or else `name`.

    `InputError` passes: it is how user code refuses its input. So do errors without a line of user code, which are
    defects of calstudy, except where the call itself does not fit the user's function. KeyboardInterrupt passes in the
    main thread, where it is Ctrl-C. Without a `name` the code may be anybody's: lines are then those of plug-ins in
    files alone. With `disk_passes` so does what the file system refuses.
    """
    try:
        yield
    except (InputError, GeneratorExit):
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and current_thread() is main_thread():
            raise
        if disk_passes and isinstance(error, OSError | RuntimeError) and refusal_of_disk(error):
            raise
        frames = [
            (frame.f_code, line)
            for frame, line in traceback.walk_tb(error.__traceback__)
            if (_is_users(frame.f_code.co_filename) if name else _is_of_file(frame.f_globals))
        ]
        if not frames and not (name and isinstance(error, TypeError | SystemExit | ImportError)):
            raise
        if frames:
            code, line = frames[-1]
            name = f"{Path(code.co_filename).name} line {line}, in {code.co_name}"
        if isinstance(error, SystemExit | KeyboardInterrupt):
            how = f"sys.exit, status {error.code}" if isinstance(error, SystemExit) else "KeyboardInterrupt"
            text = f"it ended the process ({how}); raise an error instead"
        elif getattr(error, "code", None) == "model-field-missing-annotation":
            given = str(error).split("`")[1]
            text = f"`{given}` has no type: write one, as in `size: float = 1.0`, or ClassVar where it is no setting"
        else:
            text = f"{type(error).__name__}: {error}"
        raise UserCodeError(f"{name}: {text}") from error


def _is_users(filename: str) -> bool:
    """Return whether a file belongs neither to calstudy, nor to Python or an installed package."""
    ours = str(Path(__file__).resolve().parents[1])
    path = str(Path(filename).resolve())
    return not path.startswith((ours, sys.base_prefix, sys.prefix)) and "site-packages" not in path and "<" not in path
