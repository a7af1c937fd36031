"""The source of a product: all definitions that its stage and its settings reach.

A definition is a function, a class or an assignment at the top of a module. Whole modules would be too coarse: through
the schema of experiment files the module of a stage imports a hundred others, while ``difference`` reaches nine
definitions and ``simulate-chunk`` about three hundred. From the class of a product and from the classes of its
settings, which include its plug-ins, names are followed from definition to definition through the imports of
calstudy. Of a kind of product the estimate of the cost is left out, and what all tasks have in common.

A digest does not depend on docstrings, comments, layout, annotations of functions, the order of definitions, or the
module that contains a definition. It is the same for all versions of Python that calstudy supports.
"""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from calstudy.base.files import digest_json, replacing
from calstudy.base.package_files import PackageFile, default_directory
from calstudy.base.user_code import FILE_MODULE, parse
from calstudy.run.task import Task

PACKAGE = __name__.partition(".")[0]
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef
COMPREHENSIONS = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp
UNREAD = {"ctx", "kind", "returns", "type_comment", "type_params"}
"""Fields of syntax trees that have no effect on a definition."""
PLANNED = ("_cost", "shown")
"""Methods of a kind of product that have no effect on it."""
EFFECTS = ""
"""Name of the statements of a module that define nothing, such as a call; each definition of the module needs them."""

Address = tuple[str, str]
"""Module and name of a definition."""


@dataclass(frozen=True)
class Source:
    """The digest of some definitions and all that they reach, the packages they import, and the data files they use."""

    digest: str
    packages: frozenset[str]
    files: frozenset[PackageFile]


@dataclass
class _Module:
    """The statements of a module by the names that they define, and the origins of each imported name.

    The name in the other module is None if all of that module, or another package, is imported.
    """

    statements: dict[str, list[ast.stmt]] = field(default_factory=dict)
    imports: dict[str, set[tuple[str, str | None]]] = field(default_factory=dict)


@dataclass(frozen=True)
class _Definition(Source):
    """A single definition; `needs` are those that it reaches directly, and are not in its digest."""

    needs: frozenset[Address]


def source_of(make: Callable[..., Any], settings: Mapping[str, Any]) -> Source:
    """Return the source of what `make` makes with these settings."""
    return _source(_roots(make, settings))


def reached(make: Callable[..., Any], settings: Mapping[str, Any]) -> dict[Address, str]:
    """Return by address the digests of all definitions that affect what `make` makes, or a plug-in."""
    found = frozenset().union(*map(_reach, _roots(make, settings)))
    return {address: _definition(address).digest for address in found}


def _roots(make: Callable[..., Any], settings: Mapping[str, Any]) -> frozenset[Address]:
    classes = {found for section in _classes(settings) for found in section.__mro__}
    return frozenset({_address(make), *map(_address, classes)})


def _address(thing: Callable[..., Any]) -> Address:
    return thing.__module__, thing.__qualname__.partition(".")[0]


def _classes(value: Any) -> Iterator[type[BaseModel]]:
    if isinstance(value, BaseModel):
        yield type(value)
        value = vars(value)
    if isinstance(value, Mapping):
        value = value.values()
    elif not isinstance(value, list | tuple):
        return
    for item in value:
        yield from _classes(item)


@cache
def _source(roots: frozenset[Address]) -> Source:
    """Return the source of definitions, from an earlier process if possible (reading all of a study takes a second)."""
    path, stamp = _kept()
    name, kept = digest_json(sorted(roots)), _read_kept(path, stamp)
    if name not in kept:
        source = _follow(roots)
        kept[name] = [source.digest, sorted(source.packages), sorted(source.files)]
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as stream:
                stream.write(json.dumps({"stamp": stamp, "sources": kept}).encode())
    digest, packages, files = kept[name]
    return Source(digest, frozenset(packages), frozenset(PackageFile(*file) for file in files))


@cache
def _kept() -> tuple[Path, str]:
    """Return the file that keeps sources between processes, and the state of calstudy's files to which they belong."""
    root = Path(__file__).resolve().parents[1]
    states = [(path.relative_to(root).as_posix(), path.stat()) for path in sorted(root.rglob("*.py"))]
    stamp = digest_json([[name, state.st_mtime_ns, state.st_size] for name, state in states])
    return default_directory() / f"source-{digest_json(str(root))}.json", stamp


def _read_kept(path: Path, stamp: str) -> dict[str, Any]:
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        return kept["sources"] if kept["stamp"] == stamp else {}
    except (OSError, ValueError, LookupError, TypeError):
        return {}


def _follow(roots: frozenset[Address]) -> Source:
    found = [_definition(address) for address in frozenset().union(*map(_reach, roots))]
    digest = sha256("".join(sorted({item.digest for item in found})).encode()).hexdigest()[:32]
    packages, files = (frozenset().union(*(getattr(item, name) for item in found)) for name in ("packages", "files"))
    return Source(digest, packages, files)


@cache
def _reach(root: Address) -> frozenset[Address]:
    found: set[Address] = set()
    waiting = [root]
    while waiting:
        address = waiting.pop()
        module = _module(address[0])
        if address in found or module is None or address[0] == Task.__module__:
            continue
        if address[1] not in module.statements.keys() | module.imports.keys():
            continue
        found.add(address)
        waiting += [(address[0], EFFECTS), *_definition(address).needs]
    return frozenset(found)


@cache
def _module(name: str) -> _Module | None:
    """Read a module of calstudy, or a file with a plug-in; None for any other."""
    path = Path(__file__).resolve().parents[2].joinpath(*name.split("."))
    if name.startswith(FILE_MODULE):
        path = Path(str(sys.modules[name].__file__))
    elif name.partition(".")[0] != PACKAGE:
        return None
    else:
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if not path.is_file():
        return None
    module = _Module()
    tree = parse(path.read_text(encoding="utf-8"))
    for statement in tree.body:
        if isinstance(statement, ast.ClassDef) and any(item.arg == "stage" for item in statement.keywords):
            statement.body = [item for item in statement.body if getattr(item, "name", "") not in PLANNED]
            statement.keywords = [item for item in statement.keywords if item.arg != "cost"]
        for defined in _defined(statement):
            module.statements.setdefault(defined, []).append(statement)
    for imported, target in _imports(tree):
        module.imports.setdefault(imported, set()).add(target)
    return module


def _for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _defined(statement: ast.stmt) -> set[str]:
    if isinstance(statement, FUNCTIONS | ast.ClassDef):
        return {statement.name}
    if isinstance(statement, ast.Import | ast.ImportFrom) or _for_types(statement) or _is_text(statement):
        return set()
    if isinstance(statement, ast.Assign | ast.AnnAssign):
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        return {node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)}
    return {EFFECTS}


def _imports(node: ast.AST) -> Iterator[tuple[str, tuple[str, str | None]]]:
    """Yield the imports anywhere in a module, except those for annotations."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ImportFrom):
            module = str(child.module)
            own = module.partition(".")[0] == PACKAGE
            for item in child.names:
                whole = own and _module(f"{module}.{item.name}") is not None
                target = (f"{module}.{item.name}", None) if whole else (module, item.name if own else None)
                yield item.asname or item.name, target
        elif isinstance(child, ast.Import):
            yield from ((item.asname or item.name.partition(".")[0], (item.name, None)) for item in child.names)
        elif isinstance(child, ast.stmt) and not _for_types(child):
            yield from _imports(child)


@cache
def _definition(address: Address) -> _Definition:
    module = _module(address[0])
    assert module is not None, "reached"
    # A name that a module only imports is followed to its origin.
    statements = module.statements.get(address[1], [])
    needs: set[Address] = set()
    packages: set[str] = set()
    for name, attribute in {found for statement in statements for found in _names(statement)} or {(address[1], "")}:
        if name in module.statements:
            needs.add((address[0], name))
        for target, original in module.imports.get(name, ()):
            if target.partition(".")[0] != PACKAGE:
                packages.add(target.partition(".")[0])
            elif original is not None:
                needs.add((target, original))
            elif (other := _module(target)) is not None:
                needs |= {(target, wanted) for wanted in ([attribute] if attribute else other.statements)}
    files = {
        PackageFile(*ast.literal_eval(ast.Tuple(node.args)))
        for statement in statements
        if PackageFile.__name__ in {*module.imports, *module.statements}
        for node in ast.walk(statement)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == PackageFile.__name__
    }
    digest = sha256(_normal(statements).encode()).hexdigest() if statements else ""
    return _Definition(digest, frozenset(packages), frozenset(files), frozenset(needs))


def _names(node: ast.AST, local: frozenset[str] = frozenset()) -> Iterator[tuple[str, str]]:
    """Yield the names that a statement reads and that are not local to a function, each with its attribute, if any."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        if node.value.id not in local:
            yield node.value.id, node.attr
    elif isinstance(node, ast.Name):
        if node.id not in local and isinstance(node.ctx, ast.Load):
            yield node.id, ""
    else:
        for child, bound in _inside(node):
            yield from _names(child, local | bound)


def _inside(node: ast.AST) -> Iterator[tuple[ast.AST, set[str]]]:
    """Yield the parts of a statement that are read, each with the names that the statement binds in it."""
    if isinstance(node, FUNCTIONS):
        around = (*node.decorator_list, *node.args.defaults, *filter(None, node.args.kw_defaults))
        yield from ((part, set()) for part in around)
        bound = _bound(node)
        yield from ((part, bound) for part in node.body)
    elif isinstance(node, COMPREHENSIONS):
        bound = {part.id for item in node.generators for part in ast.walk(item.target) if isinstance(part, ast.Name)}
        yield node.generators[0].iter, set()
        yield from ((part, bound) for part in ast.iter_child_nodes(node))
    else:
        yield from ((part, set()) for part in ast.iter_child_nodes(node))


def _bound(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    """Return the parameters and assigned names of a function, without the variables of its comprehensions."""
    bound = {node.arg for node in ast.walk(function.args) if isinstance(node, ast.arg)}
    waiting: list[ast.AST] = list(function.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, FUNCTIONS | ast.ClassDef):
            bound.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            bound.add(node.id)
        elif not isinstance(node, COMPREHENSIONS | ast.Lambda):
            waiting += ast.iter_child_nodes(node)
    return bound


def _normal(node: Any) -> str:
    """Return a syntax tree as text; `ast.dump` writes empty fields in some versions of Python and not in others."""
    if isinstance(node, list):
        return f"[{','.join(map(_normal, node))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    parts = []
    for name, value in ast.iter_fields(node):
        if name in UNREAD or value is None or value == [] or (name == "annotation" and isinstance(node, ast.arg)):
            continue
        items = [item for item in value if not _is_text(item)] if name == "body" and isinstance(value, list) else value
        parts.append(f"{name}={_normal(items)}")
    return f"{type(node).__name__}({','.join(parts)})"
