"""Sections of the measured pages, each a function that makes its lines; options are the function's parameters.

python -m scripts.measure rig            every section of docs/measured/rig.md that is made this way
python -m scripts.measure --quick        all of them, in little: that they run, not what they find
"""

from __future__ import annotations

import argparse
import importlib.metadata
import inspect
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from scripts.shared.page import write_section
from scripts.shared.records import seeds
from scripts.shared.timing import show

# Packages whose versions change what is measured.
_TOLD = ("torch", "numpy", "scipy", "opencv-contrib-python-headless", "kornia")


class Section(NamedTuple):
    """Part of a page: the function that makes its lines, and arguments with which that takes seconds."""

    page: str
    name: str
    make: Callable[..., list[str] | None]
    quick: dict[str, Any]


SECTIONS: list[Section] = []


def section(page: str, name: str, **quick: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function that makes a section of a page.

    Its parameters are options; their defaults tell of which type. One named `write` is told whether pages are written.
    A function that returns None writes nothing.

    Args:
        page: file in docs/measured.
        name: of the section.
        quick: arguments in place of the defaults for a run that only shows that it works.
    """

    def keep(make: Callable[..., Any]) -> Callable[..., Any]:
        SECTIONS.append(Section(page, name, make, quick))
        return make

    return keep


def run(arguments: Sequence[str] | None = None) -> None:
    """`main` of a script: make its sections."""
    script = sys.modules["__main__"]
    own = [each for each in SECTIONS if each.make.__module__ == "__main__"]
    parser = argparse.ArgumentParser(description=script.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [each.name for each in own]
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"{', '.join(names)}; all if none is given")
    for name, default in {k: v for each in own for k, v in _options(each).items()}.items():
        _add_option(parser, name, default)
    parser.add_argument("--quick", action="store_true", help="in little: that it runs, not what it finds")
    parser.add_argument("--write", action="store_true", help="write the sections into the page")
    given = vars(parser.parse_args(arguments))
    wanted = given.pop("sections") or names
    if unknown := set(wanted) - set(names):
        parser.error(f"{min(unknown)!r} is no section; there are {', '.join(names)}")
    quick, write = given.pop("quick"), given.pop("write")
    for each in own:
        if each.name in wanted:
            make(each, {k: v for k, v in given.items() if v is not None}, quick=quick, write=write)


def make(each: Section, given: dict[str, Any], *, quick: bool, write: bool) -> None:
    """Make one section, with what is given of its options; a quick one is not written."""
    # Here, because not every script needs them.
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    options = (each.quick if quick else {}) | {k: v for k, v in given.items() if k in _options(each)}
    if "write" in inspect.signature(each.make).parameters:
        options["write"] = write and not quick
    lines = each.make(**options)
    if lines is not None:
        show(lines)
        write_section(each.page, each.name, [*lines, "", _made(each)], write=write and not quick)


def _options(each: Section) -> dict[str, Any]:
    return {k: p.default for k, p in inspect.signature(each.make).parameters.items() if k != "write"}


def _add_option(parser: argparse.ArgumentParser, name: str, default: Any) -> None:
    option = f"--{name.replace('_', '-')}"
    if isinstance(default, bool):
        parser.add_argument(option, action="store_true", default=None)
    elif isinstance(default, range):
        parser.add_argument(option, type=seeds, help=f"for example 0-9; {default.start}-{default.stop - 1} if left out")
    elif isinstance(default, tuple):
        parser.add_argument(option, type=type(default[0]), nargs="*", help=f"{' '.join(map(str, default))} if left out")
    else:
        kind = Path if default is None else type(default)
        parser.add_argument(option, type=kind, help="" if default is None else f"{default} if left out")


def _made(each: Section) -> str:
    """By what, from what and when a section was made; a comment of the page."""
    command = (
        f"python -m scripts.{Path(inspect.getfile(each.make)).parent.name}.{Path(inspect.getfile(each.make)).stem}"
    )
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in _TOLD)
    day = time.strftime("%Y-%m-%d")
    return f"<!-- {command}, {day}, commit {commit.strip()}, Python {platform.python_version()}, {versions} -->"
