"""Make sections of the measured pages anew.

    python -m scripts.measure rig locate --write     all sections of two pages that are functions with `section`
    python -m scripts.measure --quick                of all pages, in little
    python -m scripts.measure --list                 which there are

A script makes its own sections alone: `python -m scripts.check.rig --help`.
"""

from __future__ import annotations

import argparse
import importlib
import re
import time
from pathlib import Path

from scripts.shared.sections import SECTIONS, make

ROOT = Path(__file__).parent


def load() -> None:
    """Import every script that has sections."""
    for path in sorted(ROOT.glob("*/*.py")):
        if re.search(r"^@section\(", path.read_text(encoding="utf-8"), re.MULTILINE):
            importlib.import_module(f"scripts.{path.parent.name}.{path.stem}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", help="names of docs/measured; all if none is given")
    parser.add_argument("--quick", action="store_true", help="in little: that they run, not what they find")
    parser.add_argument("--list", action="store_true", help="only name them")
    parser.add_argument("--write", action="store_true", help="write the sections into their pages")
    given = parser.parse_args()
    load()
    for each in SECTIONS:
        if not given.pages or Path(each.page).stem in given.pages:
            print(f"{each.page}: {each.name}", flush=True)
            if not given.list:
                start = time.process_time()
                make(each, {}, quick=given.quick, write=given.write)
                print(f"{time.process_time() - start:.1f} CPU s", flush=True)


if __name__ == "__main__":
    main()
