"""Public names of a folder, loaded when they are first used.

A door is the `__init__.py` of a folder from which users import. Its stub `__init__.pyi` says where each name is
defined: one table for type checkers, the reference and the door. A door imports nothing when it is opened, so that
`import kcal` and `kcal --help` do not wait for torch, and it may name what rooms above it define without an import
circle.

What it gives out also names a slip: where a function or constructor fails and one of its arguments is no such thing as
its annotation says, an `InputError` says which, and what makes one. Nothing is checked as long as nothing fails. A
function or class is the same object wherever it is imported from, so kcal's own calls name slips too.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib
import inspect
import numbers
import re
import sys
import types
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from kcal.errors import InputError, KcalError

_MANY, _NAMED = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
# What makes the things that users most often pass something else for.
_MAKERS = {
    "Camera": "Camera.build, Camera.from_opencv, kcal.load_camera or kcal.calibrate_camera(...).camera",
    "Rig": "kcal.Rig.pair, kcal.load_rig or kcal.solve_rig(...).stereo()",
    "Observations": "kcal.detect or kcal.Observations.load",
    "Board": "kcal.Board or kcal.Board.parse",
    "RigData": "kcal.RigData",
    "Tensor": "torch.as_tensor",
}


@functools.cache
def named_modules(file: str) -> dict[str, str]:
    """The names that the stub beside a file has, and in which module each is defined."""
    lines = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8")).body
    found = [line for line in lines if isinstance(line, ast.Import | ast.ImportFrom)]
    return {alias.name: str(getattr(line, "module", alias.name)) for line in found for alias in line.names}


def door(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The functions `__getattr__` and `__dir__` of a package (PEP 562), whose names stand in its stub.

    Args:
        package: its `__name__`.
        file: its `__file__`.
    """

    def find(name: str) -> Any:
        modules = named_modules(file)
        if name == "__all__":
            return sorted(modules)
        if name.startswith("__") or name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if modules[name] == package:
            return importlib.import_module(f"{package}.{name}")
        module = importlib.import_module(modules[name])
        value = getattr(module, name)
        if inspect.isfunction(value):
            value = _naming_slips(value)
            setattr(module, name, value)  # one function, wherever it is imported from
        elif inspect.isclass(value):
            for word, member in list(vars(value).items()):
                if word == "__init__":
                    type.__setattr__(value, word, _naming_slips(member))
                elif isinstance(member, classmethod) and not word.startswith("_"):
                    type.__setattr__(value, word, classmethod(_naming_slips(member.__func__)))
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        # Without what the `__init__.py` itself imports, and without modules that happen to be loaded.
        return sorted({*(name for name in vars(sys.modules[package]) if name.startswith("__")), *named_modules(file)})

    return find, names


def _naming_slips(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, whose errors name an argument that is no such thing as its annotation says."""
    if hasattr(function, "names_slips"):
        return function

    @functools.wraps(function)
    def named(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except KcalError:
            raise
        except Exception as error:
            if slip := _slip(function, args, kwargs):
                raise InputError(slip) from error
            raise

    vars(named)["names_slips"] = True
    return named


def _slip(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> str:
    """Which argument is another thing than its annotation says, and what makes one; empty if none is."""
    function = inspect.unwrap(function)
    try:
        given = inspect.signature(function).bind(*args, **kwargs)
    except TypeError:  # of missing arguments: Python says which
        return ""
    kinds = {name: parameter.kind for name, parameter in given.signature.parameters.items()}
    single = {name: value for name, value in given.arguments.items() if kinds[name] not in (_MANY, _NAMED)}
    owner = function.__qualname__.removesuffix(".__init__")
    found = _misfit(owner, single, function.__annotations__, function.__globals__)
    # Options are records, whose fields nobody has looked at.
    for record in single.values():
        kind = type(record)
        if not found and dataclasses.is_dataclass(kind) and kind.__module__.startswith("kcal."):
            found = _misfit(kind.__name__, vars(record), kind.__annotations__, vars(sys.modules[kind.__module__]))
    return found


def _misfit(owner: str, values: dict[str, Any], words: dict[str, str], names: dict[str, Any]) -> str:
    """Which of several values is another thing than its annotation says, given what the names in those mean."""
    for name, value in values.items():
        word = words.get(name, "Any")
        try:
            fits = _is_kind(value, eval(word, names))
        except (NameError, AttributeError, TypeError):  # what only type checkers know
            continue
        if not fits:
            found = type(value).__name__
            if isinstance(value, Sequence) and not isinstance(value, str):
                found += f" of {', '.join(dict.fromkeys(type(one).__name__ for one in value)) or 'nothing'}"
            makers = next((f"; {_MAKERS[made]} makes one" for made in _MAKERS if made in re.findall(r"\w+", word)), "")
            return f"{owner}: {name}: {word} is needed, got {found}{makers}"
    return ""


def _is_kind(value: Any, hint: Any) -> bool:
    """Whether a value is what an annotation says, as far as that can be told."""
    origin, inside = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_is_kind(value, one) for one in inside)
    if origin is typing.Literal:
        return value in inside
    if hint is None or hint in (int, float):
        return value is None if hint is None else isinstance(value, numbers.Real)
    kind = origin or hint
    if not isinstance(kind, type) or kind is Any:
        return True
    if kind is Sequence or kind in (tuple, list):
        if not isinstance(value, kind) or (isinstance(value, str) and inside[:1] != (str,)):
            return False
        each = inside[:1] * len(value) if kind is not tuple or ... in inside else inside
        return len(each) in (0, len(value)) and all(map(_is_kind, value, each))
    return isinstance(value, kind)


def shown_in_notebooks(record: Any) -> str | None:
    """The picture and the table that the command line gives, as HTML: what `_repr_html_` is in a class.

    `kcal.report` makes them, above the rooms whose results they show. It is loaded by its name, like a door's modules.
    """
    html: str | None = importlib.import_module("kcal.report.notebook").html_of(record)
    return html
