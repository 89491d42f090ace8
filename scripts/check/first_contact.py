"""Measure what a newcomer meets first.

    python -m scripts.check.first_contact            # builds the site and a wheel: two minutes

Times are wall clock, each a process of its own; of several the median.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from scripts.shared.page import DOCS, table
from scripts.shared.timing import show, spread

ROOT = DOCS.parents[1]
# Commands that read a file, with one that is missing.
MISSING = (
    "detect none.png --board 9x6 --square 25mm -o a.obs.json",
    "calibrate none.obs.json -o a.camera.json",
    "compare none.obs.json --model opencv5 opencv8",
    "rig none.json none.json --pairs none.obs.json none.obs.json -o rig.json",
    "rig check none.json --marks none.csv",
    "locate none.json none.csv -o a.csv",
    "rectify none.json none.png -o out",
    "bake none.json -o a.npz",
    "export none.json -o a.yaml",
    "show none.json",
    "diff none.json none.json",
    "report none.json",
    "live none.json none.jsonl -o a.geojsonl",
)
# Runs a command as the shell would, and says whether torch was loaded.
RUN = """
import sys
from kcal.cli.main import main
sys.argv = ["kcal", *sys.argv[1:]]
code = 0
try:
    main()
except SystemExit as stop:
    code = stop.code
print("\\n" + f"{code} {'torch' in sys.modules}")
"""


def call(*words: object, folder: Path | str = ROOT) -> str:
    """What a program prints; its exit code does not matter."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run([str(w) for w in words], text=True, capture_output=True, cwd=folder, env=environment)
    return done.stdout + (done.stderr if done.returncode else "")


def processor_seconds(runs: int) -> list[float]:
    """Processor time of each run of `kcal --help`, after one that is not counted."""
    found = []
    for number in range(runs + 1):
        before = os.times()
        call(sys.executable, "-m", "kcal", "--help")
        after = os.times()
        spent = after.children_user + after.children_system - before.children_user - before.children_system
        found += [spent] if number else []
    return found


def loads_torch(command: str, folder: str) -> str:
    """What is wrong with how a command refuses a missing file: "" if nothing."""
    code, loaded = call(sys.executable, "-c", RUN, *command.split(), folder=folder).split("\n")[-2].split()
    if code == "0":
        return "no error"
    return "torch was loaded" if loaded == "True" else ""


def reading_words(path: Path) -> int:
    """Words of a page, code and outputs included: all of it is read."""
    return len(path.read_text(encoding="utf-8").split())


def measured(runs: int) -> list[list[str]]:
    """Figure, value and aim."""
    rows = []
    rows.append(["`kcal --help`, processor time", f"{spread(processor_seconds(runs), 2)} s", "0.3 s"])
    with tempfile.TemporaryDirectory() as folder:
        wrong = {command.split(" none")[0]: loads_torch(command, folder) for command in MISSING}
        bad = ", ".join(f"{name} ({what})" for name, what in wrong.items() if what)
        early = f"{sum(not what for what in wrong.values())} of {len(wrong)}{f'; {bad}' if bad else ''}"
        rows.append(["commands that refuse a missing file before torch is loaded", early, "all"])
        call(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT)
        (wheel,) = Path(folder).glob("*.whl")
        rows.append(["wheel", f"{wheel.stat().st_size / 1024:.0f} KB", ""])
        start = time.perf_counter()
        said = call(sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", Path(folder, "site"))
        rows.append(["`make docs`, without installation", f"{time.perf_counter() - start:.0f} s", ""])
        rows.append(["broken links and other warnings of the site", str(len(said.splitlines())), "0"])
    path = [ROOT / "README.md", ROOT / "docs" / "tutorial" / "guide.md"]
    rows.append(["words to the first position (README and tutorial)", f"{sum(map(reading_words, path)):,}", "1,500"])
    pages = sorted((ROOT / "docs" / "howto").glob("*.md"))
    long = [page.name for page in pages if reading_words(page) > 250]
    rows.append(["how-tos of more than 250 words", f"{len(long)} of {len(pages)}", "0"])
    written = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    blocks = sum(len(re.findall(r"^```python\n", page.read_text(encoding="utf-8"), re.MULTILINE)) for page in written)
    tests = ("tests/test_docs_examples.py",)
    collected = call(
        sys.executable, "-m", "pytest", "--collect-only", "-q", "-o", "addopts=--import-mode=importlib", *tests
    )
    run = len(re.findall(r"::test_python_runs\[", collected))
    rows.append(["Python examples of the pages that tests run", f"{run} of {blocks}", "all"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=9, help="of `kcal --help`")
    arguments = parser.parse_args()
    show(table(["figure", "measured", "aim"], measured(arguments.runs)))


if __name__ == "__main__":
    main()
