"""Repeat tests and calibrations as other makes of CPU would round them, and say what differs.

    python -m scripts.check.cpus                               # make test-cpus: the whole test suite, once under each
    python -m scripts.check.cpus --tests tests/calibrate       # some tests
    python -m scripts.check.cpus --figures --write             # cameras, σ and positions; docs/measured/cpus.md

Libraries choose their code by the CPU: sums run in another order, products are fused with sums or are not, and results
differ in the last bits. Environment variables choose in place of the CPU, so one machine stands for others: `MKL_CBWR`
for torch's matrices, `ATEN_CPU_CAPABILITY` for torch's other operations, `OPENBLAS_CORETYPE` for matrices of NumPy and
SciPy, `NPY_DISABLE_CPU_FEATURES` for NumPy's other operations. What this machine's CPU does not have cannot be chosen.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

from scripts.shared.page import DOCS

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tests", nargs="+", default=["kcal", "tests"], metavar="PATH")
    parser.add_argument("--settings", nargs="+", default=list(SETTINGS), choices=list(SETTINGS), metavar="NAME")
    parser.add_argument("--processes", type=int, default=2, help="0: pytest without workers")
    arguments = parser.parse_args()
    found = {}
    for setting in arguments.settings:
        found[setting] = run_tests(setting, arguments.tests, arguments.processes)
        counts = {word: list(found[setting].values()).count(word) for word in sorted(set(found[setting].values()))}
        print(f"{setting}: " + ", ".join(f"{count} {word}" for word, count in counts.items()), flush=True)
    different = differing(found)
    for name, one in different.items():
        print(f"{name}: " + ", ".join(f"{setting} {outcome}" for setting, outcome in one.items()))
    if different:
        sys.exit(1)
    print("No test depends on the setting.")


if __name__ == "__main__":
    main()
