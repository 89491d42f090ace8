"""Repeat tests and calibrations as other makes of CPU would round them, and say what differs.

    python -m scripts.check.cpus                           # make test-cpus: the whole test suite, once under each
    python -m scripts.check.cpus --tests tests/calibrate   # some tests
    python -m scripts.measure other-programs cpus          # cameras, σ and positions

Libraries choose their code by the CPU: sums run in another order, products are fused with sums or are not, and results
differ in the last bits. Environment variables choose in place of the CPU, so one machine stands for others: `MKL_CBWR`
for torch's matrices, `ATEN_CPU_CAPABILITY` for torch's other operations, `OPENBLAS_CORETYPE` for matrices of NumPy and
SciPy, `NPY_DISABLE_CPU_FEATURES` for NumPy's other operations. What this machine's CPU does not have cannot be chosen.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path

from kcal.files import make_folder
from scripts.check.cpus_figures import Row, compare
from scripts.shared.page import DOCS, Lines, table
from scripts.shared.sections import section
from scripts.shared.timing import show

ROOT = DOCS.parents[1]
_NO_AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
# What each setting stands for. MKL runs its AVX-512 code on Intel's CPUs only.
SETTINGS: dict[str, dict[str, str]] = {
    "this CPU": {},
    "before AVX": {
        "MKL_CBWR": "COMPATIBLE",
        "ATEN_CPU_CAPABILITY": "default",
        "OPENBLAS_CORETYPE": "Prescott",
        "NPY_DISABLE_CPU_FEATURES": f"X86_V3 {_NO_AVX512}",
    },
    "Intel, AVX2": {
        "MKL_CBWR": "AVX2",
        "ATEN_CPU_CAPABILITY": "avx2",
        "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": _NO_AVX512,
    },
    "AMD, AVX2": {
        "MKL_CBWR": "COMPATIBLE",
        "ATEN_CPU_CAPABILITY": "avx2",
        "OPENBLAS_CORETYPE": "Zen",
        "NPY_DISABLE_CPU_FEATURES": _NO_AVX512,
    },
    "AMD, AVX-512": {"MKL_CBWR": "AVX2", "OPENBLAS_CORETYPE": "SkylakeX"},
    "mixed": {"MKL_CBWR": "COMPATIBLE", "ATEN_CPU_CAPABILITY": "default", "OPENBLAS_CORETYPE": "SkylakeX"},
}


def environment(setting: str) -> dict[str, str]:
    """That of a process which computes as the setting says; variables of another setting are removed."""
    ours = {name for setting in SETTINGS.values() for name in setting}
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return {k: v for k, v in os.environ.items() if k not in ours} | one_thread | SETTINGS[setting]


def outcomes(report: Path) -> dict[str, str]:
    """`passed`, `failed`, `error` or `skipped` of each test in a report of JUnit's form."""
    found = {}
    for case in ElementTree.parse(report).iter("testcase"):
        name = f"{case.get('classname', '')}::{case.get('name', '')}"
        kinds = {child.tag for child in case}
        found[name] = next((word for word in ("error", "failure", "skipped") if word in kinds), "passed")
    return found


def run_tests(setting: str, tests: Sequence[str], processes: int) -> dict[str, str]:
    """The outcome of each test under a setting."""
    with tempfile.TemporaryDirectory(prefix="kcal-cpus-") as folder:
        report = Path(folder, "report.xml")
        words = f"-n {processes} -q --no-header --tb=short -p no:cacheprovider --junitxml={report}".split()
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *words, *tests],
            env=environment(setting), cwd=ROOT, capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode not in (0, 1) or not report.exists():
            raise SystemExit(f"{setting}: pytest ended with {done.returncode}:\n{(done.stdout + done.stderr)[-2000:]}")
        if done.returncode:
            print(done.stdout[-6000:], flush=True)
        return outcomes(report)


def differing(found: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """Tests that do not pass, or are not skipped, under all settings: the outcome under each."""
    names = sorted({name for one in found.values() for name in one})
    by_test = {name: {setting: one.get(name, "missing") for setting, one in found.items()} for name in names}
    return {name: one for name, one in by_test.items() if set(one.values()) not in ({"passed"}, {"skipped"})}


def tests_table(found: dict[str, dict[str, str]]) -> list[str]:
    """How many tests passed under each setting, and which did not under all."""
    rows = []
    for setting, one in found.items():
        counts = [list(one.values()).count(word) for word in ("passed", "skipped")]
        rows.append([setting, *counts, len(one) - sum(counts)])
    failed = [
        f"- `{name}`: " + ", ".join(f"{setting} {outcome}" for setting, outcome in one.items())
        for name, one in differing(found).items()
    ]
    folders = sorted(
        {name.split(".test_")[0].split("::")[0].replace(".", "/") for one in found.values() for name in one}
    )
    return [
        "Tests of " + ", ".join(f"`{folder}`" for folder in folders) + ".",
        "",
        *table(["setting", "passed", "skipped", "failed"], rows),
        *(["", *failed] if failed else []),
    ]


@section("other-programs.md", "cpus", settings=("this CPU", "Intel, AVX2"), cameras=("simulated, opencv5",))
def figures(
    folder: Path | None = None, settings: tuple[str, ...] = tuple(SETTINGS), cameras: tuple[str, ...] = ("",)
) -> Iterator[str]:
    """Compute all stages under each setting, into folders, and compare each with the first; or only these cameras."""
    with tempfile.TemporaryDirectory(prefix="kcal-cpus-") as name:
        yield from _figures(make_folder(folder or Path(name)), settings, cameras)


def _figures(folder: Path, settings: tuple[str, ...], cameras: tuple[str, ...]) -> Lines:
    places = {setting: folder / str(i) for i, setting in enumerate(settings)}
    first, *others = places
    for setting, place in places.items():
        given = str(place), str(places[first]), cameras
        code = f"from scripts.check.cpus_figures import compute; compute{given!r}"
        if not (place / "told.json").exists():
            subprocess.run([sys.executable, "-c", code], env=environment(setting), cwd=ROOT, check=True)
    kinds: dict[str, dict[str, Row]] = {}
    for stage, found in compare(places[first], {name: places[name] for name in others}).items():
        name, _, model = stage.rpartition(", ")
        kind = f"cameras, {model}" if name else "rigs" if stage.startswith("rig ") else stage
        kinds.setdefault(kind, {})[name or stage] = found
    yield ["stage", "number", "largest difference / σ", "of σ itself", "where", "status"]
    for kind, stages in kinds.items():
        where, (away, _, setting, _) = max(stages.items(), key=lambda item: max(item[1][0], default=0.0))
        sigma = [value for _, values, _, _ in stages.values() for value in values]
        notes = "; ".join(f"{stage}: {note}" for stage, (*_, note) in stages.items() if note)
        largest = (f"{max(values):.0e}" if values else "" for values in (away, sigma))
        yield [kind, len(stages), *largest, f"{where}, {setting}", notes]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tests", nargs="+", default=["kcal", "tests"], metavar="PATH")
    parser.add_argument("--settings", nargs="+", default=list(SETTINGS), choices=list(SETTINGS), metavar="NAME")
    parser.add_argument("--processes", type=int, default=2, help="0: pytest without workers")
    parser.add_argument("--folder", type=Path, help="keep outcomes here; what is there is not run again")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="kcal-cpus-") as name:
        kept = make_folder(arguments.folder or Path(name)) / "tests.json"
        found: dict[str, dict[str, str]] = json.loads(kept.read_text()) if kept.exists() else {}
        for setting in arguments.settings:
            new = run_tests(setting, arguments.tests, arguments.processes)
            counts = {word: list(new.values()).count(word) for word in sorted(set(new.values()))}
            print(f"{setting}: " + ", ".join(f"{count} {word}" for word, count in counts.items()), flush=True)
            found[setting] = found.get(setting, {}) | new
            kept.write_text(json.dumps(found), encoding="utf-8")
    show(tests_table(found))
    sys.exit(bool(differing(found)))


if __name__ == "__main__":
    main()
