"""Kinds of plug-ins: calibrators, effects, layouts, beams, estimators, figures, papers, engines.

A plug-in is a class: its fields are its settings, and its methods are its behaviour. The built-in ones are in the
modules of one package. Others are found by an entry point of an installed package, or by the path of a Python file,
which an experiment file may give wherever it may give a name: ``calibrator: mean-gain``, ``calibrator: mine.py`` or, if
a file has several, ``calibrator: mine.py:MeanGain``.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Container, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType
from typing import Any, ClassVar, TypeVar

from pydantic import model_validator
from pydantic.json_schema import JsonSchemaValue

from calstudy.base.errors import InputError, nearest
from calstudy.base.schema import Kinds, Section
from calstudy.base.user_code import identity_of_file, load_file, user_code

FILE_REFERENCE = re.compile(r"(?P<path>.+\.py)(?::(?P<name>[A-Za-z_][A-Za-z0-9_]*))?")


class Plugin(Section):
    """The base class of all plug-ins. Subclasses declare settings as fields, and behaviour as methods.

    The base class of each kind sets the `registry`, and `inherited_with`: a built-in method of its keys may bypass the
    method of the value. A class that overrides the latter does not inherit it, but that of the base class, which calls
    the latter. The version of a built-in plug-in is increased whenever its results change, so that the products that
    depend on it are made again.
    """

    registry: ClassVar[Registry]
    version: ClassVar[int] = 1
    inherited_with: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def __pydantic_init_subclass__(cls, **given: Any) -> None:
        """Replace methods that would bypass one that the class overrides."""
        super().__pydantic_init_subclass__(**given)
        for name, other in cls.inherited_with.items():
            after = cls.__mro__[cls.__mro__.index(cls._provider(other)) + 1 :]
            bypassing = cls._provider(name)
            if bypassing in after and bypassing.__module__.startswith(f"{cls.registry.package}."):
                setattr(cls, name, getattr(cls.registry.base, name))

    @classmethod
    def _provider(cls, name: str) -> type:
        """Return the class whose method of this name is used."""
        return next(kind for kind in cls.__mro__ if name in vars(kind))

    @property
    def reference(self) -> str:
        """The name or path by which the plug-in was requested."""
        return getattr(self, self.registry.tag)

    @model_validator(mode="before")
    @classmethod
    def _refer_to_class(cls, data: Any) -> Any:
        """Add the name of a plug-in that is made in Python; an experiment file always gives it."""
        if isinstance(data, Mapping) and cls.registry.tag not in data:
            return {**data, cls.registry.tag: cls.registry.reference_of(cls)}
        return data

    @property
    def label(self) -> str:
        """The name of the plug-in in file names and tables: its own, its class's in a file, or the file's."""
        file = FILE_REFERENCE.fullmatch(self.reference)
        return self.reference if file is None else file["name"] or Path(file["path"]).stem

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of a built-in class, its tag's default; empty for one that is named after its module."""
        tag = cls.model_fields.get(cls.registry.tag)
        return (tag.default,) if tag is not None and isinstance(tag.default, str) and tag.default else ()

    @property
    def is_built_in(self) -> bool:
        """Whether the plug-in is one of calstudy's own."""
        return type(self).__module__.startswith(f"{self.registry.package}.")

    def is_about_field(self, sentence: str) -> bool:
        """Return whether a sentence starts with the path of a setting and a colon."""
        field, colon, _ = sentence.partition(":")
        return bool(colon) and field.split(".")[0] in type(self).model_fields

    def __reduce__(self) -> tuple:
        """Pickle by reference: a class from a file cannot be imported by name in another process."""
        return _revive, (self.registry.base_path, self.model_dump(mode="json"))


def _revive(base_path: str, block: Mapping[str, Any]) -> Plugin:
    return resolve_name(base_path).registry.make(block)


P = TypeVar("P", bound=Plugin)


class Registry(Kinds[P]):
    """All plug-ins of one kind: the built-in ones, those of installed packages, and those in files.

    The `noun` names the kind, such as "calibrator", and `base_path` is ``module:class`` of its base class. The built-in
    ones are in the modules of `package`; module `sky_based` contains ``sky-based``, and modules whose name starts with
    an underscore contain none. With `families`, a module may have several classes or none, and a class several names
    (`Plugin.names`); names that are defaults of the tag are read from the text of the modules, without importing them.
    """

    def __init__(self, noun: str, package: str, base_path: str, tag: str = "kind", families: bool = False) -> None:
        super().__init__(tag)
        self.noun, self.package, self.base_path, self.families = noun, package, base_path, families
        self.a_noun = f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"

    def read(self, annotation: Any) -> None:
        """Take no kinds from types: the plug-ins are those of the package, and others."""

    @property
    def wanted(self) -> str:
        """The names, or a file."""
        return f"the name of {self.a_noun} ({', '.join(self.names())}) or a file.py"

    @property
    def base(self) -> type[P]:
        """The base class."""
        return resolve_name(self.base_path)

    def built_in(self) -> list[str]:
        """Return the names of the built-in plug-ins."""
        return list(self._modules)

    @cached_property
    def _modules(self) -> dict[str, str]:
        """The modules of the built-in plug-ins, by name."""
        if not self.families:
            return {_named_after(module): module for module in sorted(self._texts)}
        found: list[tuple[tuple[str, ...], str]] = [((name,), module) for name, module in self._declared(self.tag)]
        known = {module for _, module in found}
        for module, text in self._texts.items():
            # Without the module of the base class there is none of its subclasses.
            if module not in known and self.base_path.partition(":")[0] in text:
                things = self._things(import_module(module)).values()
                found += [(thing.names() or (_named_after(module),), module) for thing in things]
        return {name: module for names, module in sorted(found) for name in names}

    @cached_property
    def _texts(self) -> dict[str, str]:
        """The source of each module that may have built-in plug-ins."""
        folder = Path(import_module(self.package).__path__[0])
        paths = sorted([*folder.glob("[!_]*.py"), *folder.glob("[!_]*/__init__.py")])
        names = [path.parent.name if path.stem == "__init__" else path.stem for path in paths]
        return {f"{self.package}.{name}": path.read_text("utf-8") for name, path in zip(names, paths, strict=True)}

    def _declared(self, field: str) -> list[tuple[str, str]]:
        """Return the texts that built-in classes give a field, each with the module."""
        line = re.compile(rf'^    {field}(?:: .+)? = "([^"]+)"$', flags=re.MULTILINE)
        return [(value, module) for module, text in self._texts.items() for value in line.findall(text)]

    def marked(self, field: str, texts: Container[str]) -> list[type[P]]:
        """Return the built-in classes that give a field one of these texts; modules of others are not imported."""
        modules = dict.fromkeys(module for text, module in self._declared(field) if text in texts)
        things = [thing for module in modules for thing in self._things(import_module(module)).values()]
        return [thing for thing in things if getattr(thing, field) in texts]

    def installed(self) -> dict[str, EntryPoint]:
        """Return the entry points of installed packages, by name."""
        return {point.name: point for point in entry_points(group=f"calstudy.{self.noun}s")}

    def names(self) -> list[str]:
        """Return all names: built in, and of installed packages."""
        return [*self.built_in(), *sorted(set(self.installed()) - set(self.built_in()))]

    def find(self, reference: str) -> type[P]:
        """Return the class of a plug-in, given a name or the path of a Python file, with ``:Class`` if it has several.

        Raises InputError if there is none; the message does not name the field.
        """
        if (file := FILE_REFERENCE.fullmatch(reference)) is not None:
            return self._in(load_file(Path(file["path"])), reference, file["name"])
        if reference in self._modules:
            if reference not in self._found:
                self._found[reference] = self._built_in(reference)
            return self._found[reference]
        if reference in (installed := self.installed()):
            with user_code(reference):
                found = installed[reference].load()
            return self._checked(found, reference) if inspect.isclass(found) else self._in(found, reference)
        names = self.names()
        hint = nearest(reference, names)
        raise InputError(f"{reference!r} is not {self.a_noun}{hint} (there are: {', '.join(names)}; or a file.py)")

    def reference_of(self, thing: type[P]) -> str:
        """Return the name or path by which `find` finds a class, or its bare name if it is in no file."""
        if thing.__module__.rpartition(".")[0] == self.package:
            return next(iter(thing.names()), _named_after(thing.__module__))
        for point in self.installed().values():
            if point.module == thing.__module__ and point.attr in ("", thing.__name__):
                return point.name
        try:
            return f"{inspect.getfile(thing)}:{thing.__name__}"
        except (TypeError, OSError):
            return thing.__name__

    def _built_in(self, name: str) -> type[P]:
        module = import_module(self._modules[name])
        if not self.families:
            return self._in(module, name)
        things = self._things(module).values()
        return next(thing for thing in things if name in (thing.names() or (_named_after(module.__name__),)))

    def _in(self, module: ModuleType, reference: str, name: str | None = None) -> type[P]:
        """Return the only class that a module defines, or the one of this name."""
        found = self._things(module)
        if name in found or (name is None and len(found) == 1):
            return found[name or next(iter(found))]
        lacking = [
            f"{other} without {', '.join(sorted(value.__abstractmethods__))}"
            for other, value in self._things(module, abstract=True).items()
        ]
        listed = "; ".join([*found, *lacking]) or f"no subclass of {self.base.__module__}.{self.base.__name__}"
        several = f"must hold one {self.noun}, or be followed by ':Class'"
        what = several if name is None else f"holds no {self.noun} of this name"
        raise InputError(f"{reference!r} {what} (it has: {listed})")

    def _things(self, module: ModuleType, abstract: bool = False) -> dict[str, type[P]]:
        """Return the classes that a module defines, by name; or those `abstract`, which lack methods."""
        own = {name: value for name, value in vars(module).items() if inspect.isclass(value) and value is not self.base}
        return {
            name: value
            for name, value in own.items()
            if issubclass(value, self.base)
            and (value.__module__, inspect.isabstract(value)) == (module.__name__, abstract)
            and not value.__name__.startswith("_")
        }

    def _checked(self, found: type, reference: str) -> type[P]:
        if not issubclass(found, self.base):
            raise InputError(f"{reference!r} is not a subclass of {self.base.__module__}.{self.base.__name__}")
        return found

    def class_of(self, block: Mapping[str, Any], default: str | None, folder: Path | None) -> tuple[type[P], str]:
        """Return the class for a block of settings, and its name or the absolute path of its file; raises as `make`."""
        reference = block.get(self.tag, default)
        file = FILE_REFERENCE.fullmatch(reference) if isinstance(reference, str) else None
        if file is None:
            return super().class_of(block, default, folder)
        try:
            path = ((folder or Path()) / Path(file["path"]).expanduser()).resolve()
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{file['path']!r} cannot be the path of a file ({error})") from None
        reference = str(path) if file["name"] is None else f"{path}:{file['name']}"
        return self.find(reference), reference

    def make(self, block: Any, default: str | None = None, **context: Any) -> P:
        """Return the plug-in that a name, a path or a block describes; errors of its own validation name its line."""
        with user_code():
            return super().make(block, default, **context)

    def others(self) -> list[JsonSchemaValue]:
        """Return the JSON schemas of references to files, and of blocks of plug-ins that are not built in."""
        file: JsonSchemaValue = {"type": "string", "pattern": r"\.py(:\w+)?$"}
        installed = {"enum": sorted(set(self.installed()) - set(self.built_in()))}
        named = {"anyOf": [file, installed]} if installed["enum"] else file
        return [file, {"type": "object", "properties": {self.tag: named}, "required": [self.tag]}]

    def identity(self, reference: str) -> str:
        """Return the identity of a plug-in's code: its name or package with a version, or the digest of its file."""
        if (file := FILE_REFERENCE.fullmatch(reference)) is not None:
            return identity_of_file(Path(file["path"]), f":{file['name'] or ''}")
        if reference in self._modules:
            version = self.find(reference).version
            return reference if version == 1 else f"{reference}@{version}"
        point = self.installed().get(reference)
        if point is None or point.dist is None:
            return reference
        return f"{point.dist.name}=={point.dist.version}:{reference}"


def _named_after(module: str) -> str:
    return module.rpartition(".")[2].replace("_", "-")


def guarded(thing: Plugin) -> AbstractContextManager[None]:
    """Return a context for calls of a plug-in's methods, in which errors of a user's code become `UserCodeError`.

    Errors of built-in plug-ins pass unchanged.
    """
    return nullcontext() if thing.is_built_in else user_code(thing.label)


def refusal_of(thing: Any, *given: Any) -> str | None:
    """Return why a plug-in refuses what it is given, in its own words, or None; raises InputError for anything else."""
    with guarded(thing):
        reason = thing.refusal(*given)
    if reason is None or isinstance(reason, str):
        return reason
    raise InputError(f"{thing.label}: refusal returned {reason!r}; return a sentence that says why, or None")
