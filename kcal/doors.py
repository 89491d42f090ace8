"""Public names of a folder, loaded when they are first used.

A door is the `__init__.py` of a folder from which users import. Its stub `__init__.pyi` says where each name is
defined: one table for type checkers, the reference and the door. A door imports nothing when it is opened, so that
`import kcal` and `kcal --help` do not wait for torch, and it may name what rooms above it define without an import
circle.
"""

from __future__ import annotations

import ast
import functools
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def door(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The functions `__getattr__` and `__dir__` of a package (PEP 562), whose names stand in its stub.

    Args:
        package: its `__name__`.
        file: its `__file__`.
    """

    @functools.cache
    def modules() -> dict[str, str]:
        lines = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8")).body
        return {
            alias.name: str(line.module) for line in lines if isinstance(line, ast.ImportFrom) for alias in line.names
        }

    def find(name: str) -> Any:
        if name == "__all__":
            return sorted(modules())
        if name.startswith("__") or name not in modules():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if modules()[name] == package:
            return importlib.import_module(f"{package}.{name}")
        value = getattr(importlib.import_module(modules()[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        # Without what the `__init__.py` itself imports, and without modules that happen to be loaded.
        return sorted({*(name for name in vars(sys.modules[package]) if name.startswith("__")), *modules()})

    return find, names
