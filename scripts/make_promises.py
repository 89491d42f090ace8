"""Write down what users may rely on: names, signatures, attributes, commands and their options.

    python -m scripts.make_promises            # adds what is new to tests/promises/python.txt and commands.txt
    python -m scripts.make_promises --major    # before a new major version: drops what is gone, too

What is no longer there stays in the lists without `--major`, and `tests/promises/test_surface.py` fails until it is
there again.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from scripts.make_reference import DOORS, returned_by

SOURCES = "kcal.calibrate.rig.source"
FOLDER = Path(__file__).parents[1] / "tests" / "promises"


def _arguments(value: Any) -> str:
    """`(a, b=, *, c=)`: names, order and which may be left out; defaults and annotations may change."""
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):
        return ""
    out, starred = [], False
    for each in parameters:
        if each.kind is each.KEYWORD_ONLY and not starred:
            out.append("*")
        starred |= each.kind in (each.KEYWORD_ONLY, each.VAR_POSITIONAL)
        star = "*" if each.kind is each.VAR_POSITIONAL else "**" if each.kind is each.VAR_KEYWORD else ""
        out.append(star + each.name + ("" if star or each.default is each.empty else "="))
    return f"({', '.join(name for name in out if name != 'self')})"


def _members(value: type) -> Iterator[tuple[str, str]]:
    """Public attributes and methods that kcal defines, with their arguments."""
    fields = {each.name for each in dataclasses.fields(value)} if dataclasses.is_dataclass(value) else set()
    fields |= set(getattr(value, "_fields", ())) | set(getattr(value, "model_fields", ()))
    found = {name: "" for name in fields if not name.startswith("_")}
    # What the solver asks of a rig's sources is no promise.
    bases = [vars(base) for base in value.__mro__ if base.__module__ == SOURCES]
    inner = {"model_config", *(name for base in bases for name in (*base, *base.get("__annotations__", ())))}
    for base in value.__mro__:
        if not base.__module__.startswith("kcal"):
            continue
        for name, member in vars(base).items():
            if not name.startswith("_") and name not in {*found, *inner}:
                plain = inspect.isfunction(member) or isinstance(member, (classmethod, staticmethod))
                found[name] = _arguments(getattr(value, name)) if plain else ""
    yield from sorted(found.items())


def python_lines() -> list[str]:
    """One line for each public name, and one for each public member of a public class and of a result."""
    lines = []
    for door in DOORS:
        for name in importlib.import_module(door).__all__:
            value = getattr(importlib.import_module(door), name)
            if inspect.ismodule(value):
                continue
            lines.append(f"{door}.{name}{_arguments(value)}")
            if inspect.isclass(value):
                lines += [f"{door}.{name}.{member}{arguments}" for member, arguments in _members(value)]
    for name, module in (home for homes in returned_by().values() for home in homes):
        value = getattr(importlib.import_module(module), name)
        lines += [f"{name}.{member}{arguments}" for member, arguments in _members(value)]
    return lines


def command_lines() -> list[str]:
    """One line for each command with its arguments in order, and one for each option with its kind."""
    from kcal.cli.main import app

    lines: list[str] = []

    def walk(command: Any, name: str) -> None:
        inner = getattr(command, "commands", {})
        for key, each in inner.items():
            walk(each, f"{name} {key}")
        for each in [] if inner else [command]:
            given = [one for one in each.params if one.param_type_name == "argument"]
            low = sum(one.required for one in given)
            high = "any number" if any(one.nargs < 0 for one in given) else len(given)
            lines.append(f"{name} takes {low} to {high}")
        for each in command.params:
            if each.param_type_name == "option":
                kind = "" if each.is_flag else " VALUE" if each.nargs == 1 else f" VALUE x{each.nargs}"
                lines.extend(f"{name} {flag}{kind}" for flag in (*each.opts, *each.secondary_opts))

    walk(typer.main.get_command(app), "kcal")
    return lines


def stored(name: str) -> list[str]:
    """The lines of a list."""
    return (FOLDER / name).read_text(encoding="utf-8").splitlines()


def main(major: bool = False) -> None:
    for name, lines in (("python.txt", python_lines()), ("commands.txt", command_lines())):
        before = stored(name) if (FOLDER / name).exists() else []
        after = sorted({*([] if major else before), *lines})
        (FOLDER / name).write_text("\n".join(after) + "\n", encoding="utf-8")
        print(f"{name}: {len(after)} lines, {len(set(after) - set(before))} new, {len(set(before) - set(lines))} gone")


if __name__ == "__main__":
    main(sys.argv[1:] == ["--major"])
