"""Make tables and pictures of the measured pages anew.

    python -m scripts.measure rig                       all sections of docs/measured/rig.md, printed
    python -m scripts.measure rig coverage --write      one of them, into its page
    python -m scripts.measure rig --help                which there are, and their options
    python -m scripts.measure --quick                   of all pages, in little: that they run, not what they find

What takes long is kept: `--out FILE` continues what FILE has, further files are read as well, and `--only-kept` makes
nothing new. The comment below a table says the command, the commit, the machine and the versions. Real data are in the
folder KCAL_DATA; what a machine lacks is named and left out.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.metadata
import itertools
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from scripts.shared.children import ASKED, answer
from scripts.shared.page import (
    DOCS,
    SECTIONS,
    Kept,
    Section,
    children_seconds,
    laid_out,
    read_section,
    seeds,
    show,
    write_section,
)

ROOT = Path(__file__).parent
# Packages whose versions change what is measured, and modules of others, which count where a section loaded them.
_TOLD = ("torch", "numpy", "scipy", "opencv-contrib-python-headless", "kornia")
_PEERS = ("stonesoup", "onnxruntime", "pycolmap", "gtsam", "aniposelib", "Pose2Sim", "av", "rasterio", "erfa")
# The same of programs in interpreters of their own.
_ASKED_FOR = {"peers": "pyceres|pycolmap", "ros": "image-geometry|camera-calibration-parsers", "opencv": "opencv-.*"}
_VERSIONS = """
import importlib.metadata, json, re, sys
known = [(each.name, each.version) for each in importlib.metadata.distributions()]
print(json.dumps({"versions": [" ".join(one) for one in sorted(known) if re.fullmatch(sys.argv[1], one[0])]}))
"""


def load(page: str) -> list[Section]:
    """Import every script that has sections of a page; they come in the page's order."""
    for path in sorted(ROOT.glob("*/*.py")):
        if re.search(rf'^ *@?section\(\s*"{page}\.md"', path.read_text(encoding="utf-8"), re.MULTILINE):
            try:
                importlib.import_module(f"scripts.{path.parent.name}.{path.stem}")
            except ImportError as error:
                print(f"{path.stem}: left out, {error}", flush=True)
    order = re.findall(r"<!-- begin: (.+) -->", (DOCS / f"{page}.md").read_text(encoding="utf-8"))
    own = [each for each in SECTIONS if each.page == f"{page}.md"]
    return sorted(own, key=lambda each: order.index(each.name) if each.name in order else len(order))


def _add_option(parser: argparse.ArgumentParser, name: str, default: Any) -> None:
    option = f"--{name.replace('_', '-')}"
    if isinstance(default, bool):
        parser.add_argument(option, action="store_true", default=None)
    elif isinstance(default, range):
        parser.add_argument(option, type=seeds, help=f"for example 0-9; {default.start}-{default.stop - 1} if left out")
    elif isinstance(default, tuple):
        shown = " ".join(map(str, default))
        parser.add_argument(option, type=type(default[0]), nargs="+", help=f"{shown} if left out")
    else:
        parser.add_argument(option, type=Path if default is None else type(default), help=f"{default} if left out")


def make(each: Section, given: dict[str, Any], *, quick: bool, write: bool) -> None:
    """Make one section, with what is given of its options; a quick one is not written."""
    # Here, because help does not need them.
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    print(f"{each.page}: {each.name}", flush=True)
    ASKED.clear()
    start, children, write = time.process_time(), children_seconds(), write and not quick
    chosen = {name: value for name, value in given.items() if name in each.options and value is not None}
    more = {"write": write} if "write" in each.options else {}
    try:
        lines = []
        for line in laid_out(each.make(**((each.quick if quick else {}) | chosen | more)) or ()):
            lines += show([line])
    except (ImportError, SystemExit) as missing:
        if isinstance(missing, SystemExit) and not isinstance(missing.code, str):
            raise
        print(f"left out, {missing}", flush=True)
        return
    heads, there = _heads(lines), _heads(read_section(each.page, each.name).splitlines())
    if quick and not all(any(head <= whole for whole in there) for head in heads):
        raise ValueError(f"{each.page}, {each.name}: columns that the page does not have: {heads}")
    if write and not all(any(whole <= head for head in heads) for whole in there):
        raise SystemExit(f"{each.name}: not written, the page has columns that are not here: {there}; empty it first")
    spent = f"{time.process_time() - start + children_seconds() - children:.1f} CPU s"
    if lines and write:
        write_section(each.page, each.name, [*lines, "", _made(each, chosen, spent)])
    print(spent, flush=True)


def _heads(lines: list[str]) -> list[set[str]]:
    """Columns of the tables; numbers in them may follow from options."""
    found = (line for line, below in itertools.pairwise(lines) if below.startswith(("| ---", "|---")))
    return [{cell.strip() for cell in re.sub(r"\d+", "#", line).strip("|").split("|")} for line in found]


def _made(each: Section, chosen: dict[str, Any], spent: str) -> str:
    """By what, from what and when a section was made; a comment of the page."""
    words = [Path(each.page).stem, each.name]
    for name, default in each.options.items():
        value = chosen.get(name, default)
        if value and name not in ("write", "kept"):
            values = [f"{value.start}-{value.stop - 1}"] if isinstance(value, range) else value
            several = isinstance(values, list | tuple)
            words += [f"--{name.replace('_', '-')}", *([] if value is True else values if several else [values])]
    head, changed = (
        subprocess.run(["git", *asked], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()
        for asked in (("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "../kcal", "."))
    )
    machine = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, AttributeError):
        machine = re.search(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text())[1]  # type: ignore[index]
    told = [f"python -m scripts.measure {shlex.join(map(str, words))}", time.strftime("%Y-%m-%d")]
    told += [f"commit {head}{' and changes' if changed else ''}", f"{machine}, {os.cpu_count()} CPUs, one thread"]
    told += [spent, f"Python {platform.python_version()}"]
    packages = importlib.metadata.packages_distributions()
    others = [name for module in _PEERS if module in sys.modules for name in packages.get(module, ())]
    told += [f"{name} {importlib.metadata.version(name)}" for name in (*_TOLD, *others)]
    for peer, python in ASKED.items():
        told += answer(python, "-c", _VERSIONS, _ASKED_FOR.get(peer, peer)).get("versions", [peer])
    return f"<!-- {', '.join(told)} -->"


def main(arguments: list[str] | None = None) -> None:
    """Read the command line: the page comes first, then its sections."""
    words = sys.argv[1:] if arguments is None else arguments
    known = sorted(path.stem for path in DOCS.glob("*.md"))
    page = next((word for word in words if not word.startswith("-")), "")
    if page and page not in known:
        raise SystemExit(f"{page!r} is no page; there are {', '.join(known)}")
    own = [each for one in ([page] if page else known) for each in load(one)]
    names = [each.name for each in own] if page else []

    def known_section(name: str) -> str:
        if name not in names:
            raise argparse.ArgumentTypeError(f"{name!r} is no section; there are {', '.join(names)}")
        return name

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", nargs="?", help=f"{', '.join(known)}; all if none is given")
    told = f"{', '.join(names)}; all if none is given"
    parser.add_argument("sections", nargs="*", metavar="SECTION", type=known_section, help=told)
    # Sections of a page may have options of one name and other kinds.
    asked = [each for each in own if each.name in words] or own if page else []
    options = {name: default for each in asked for name, default in each.options.items()}
    kept = "kept" in options
    for name, default in options.items():
        if name not in ("write", "kept"):
            _add_option(parser, name, default)
    if kept:
        parser.add_argument("--out", nargs="+", type=Path, default=[], help="JSON lines of draws; continues the first")
        parser.add_argument("--only-kept", action="store_true", help="make no draws beside those of --out")
    parser.add_argument("--quick", action="store_true", help="in little: that they run, not what they find")
    parser.add_argument("--write", action="store_true", help="write the sections into their pages")
    given = vars(parser.parse_args(words))
    if kept:
        given["kept"] = Kept(tuple(given.pop("out")), given.pop("only_kept"))
    for each in own:
        if not given["sections"] or each.name in given["sections"]:
            make(each, given, quick=given["quick"], write=given["write"])


if __name__ == "__main__":
    main()
