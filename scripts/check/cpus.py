"""Repeat tests and calibrations as other makes of CPU would round them, and say what differs.

    python -m scripts.check.cpus                           # make test-cpus: the whole test suite, once under each
    python -m scripts.check.cpus --tests tests/calibrate   # some tests
    python -m scripts.measure other-programs cpus          # cameras, σ and positions

Libraries choose their code by the CPU: sums run in another order, products are fused with sums or are not, and results
differ in the last bits. Environment variables choose in place of the CPU, so one machine stands for others: `MKL_CBWR`
for torch's matrices, `ATEN_CPU_CAPABILITY` for torch's other operations, `OPENBLAS_CORETYPE` for matrices of NumPy and
SciPy, `NPY_DISABLE_CPU_FEATURES` for NumPy's other operations. What this machine's CPU does not have cannot be chosen.

Stages of the section "cpus": corners of OpenCV's stereo images; cameras of these corners, of other captures and of a
simulated one; a rig from landmarks with ranges, and a rig from the pairs of boards. Each stage begins with the same
input under all settings (corners and cameras of the first one), so that it shows its own share.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcal import CalibrationOptions, DegenerateError, InputError, Localizer, Observations, calibrate_camera, load_camera
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, calibrate_rig, solve_rig
from kcal.files import make_folder
from kcal.lens import camera_difference
from kcal.lens.uncertainty import projection_sigma
from kcal.rig import RigCovariance, pair_by_name
from kcal.solve import SolverStatus
from scripts.check import rig as site
from scripts.shared.children import ALONE
from scripts.shared.page import DOCS, Lines, section, show, table
from scripts.shared.real_captures import stereo_images
from scripts.shared.views import observed, simulate

MODELS = (None, "opencv5", "opencv14")
PAIRS = ("left", "right")
CAPTURES = ("st1_l", "st1_r", "fish_l", "ch1280", "sq1280")
# Of marks, px.
_SIGMA = 0.1


def label(name: str, model: str | None) -> str:
    return f"{name}, {model or 'default'}"


def captures(folder: Path) -> dict[str, Observations]:
    """Observations: those of the pairs from `folder`, others from the data, one simulated."""
    data = Path(os.environ["KCAL_DATA"])
    found = {side: Observations.load(folder / f"{side}.obs.json") for side in PAIRS}
    found |= {name: Observations.load(data / "captures" / f"{name}.obs.json") for name in CAPTURES}
    return found | {"simulated": observed(simulate(20)["pixels"].tolist())}


def find_corners(folder: Path) -> None:
    for side in PAIRS:
        stereo_images(side).save(folder / f"{side}.obs.json")


def fit_cameras(folder: Path, common: Path, only: list[str]) -> dict[str, Any]:
    told: dict[str, Any] = {}
    for name, seen in captures(common).items():
        for model in MODELS:
            here = label(name, model)
            if only and here not in only:
                continue
            try:
                found = calibrate_camera(seen, CalibrationOptions(model=model) if model else None)
            except (InputError, DegenerateError) as error:
                told[here] = {"status": f"refused: {error}"[:60]}
                continue
            found.save(folder / f"{here}.json")
            told[here] = {"status": SolverStatus(found.status).name}
    return told


def positions(found: RigResult, pixels: Tensor) -> dict[str, Any]:
    """Points of marks (N, 2, 2) with their covariance, and the rig that located them."""
    pair = found.stereo()
    pair.covariance = RigCovariance.of(pair, joint=found.joint_covariance())
    localize = Localizer(pair.placed(origin=site.ORIGIN, heading_deg=0.0), pixel_sigma=_SIGMA)
    answer = localize(pixels[:, 0], pixels[:, 1])
    return {
        "points": answer.enu.tolist(),
        "covariance": answer.covariance.tolist(),
        "translation": pair.right_from_left_translation.tolist(),
        "left out": len(found.left_out),
    }


@torch.no_grad()
def locate(common: Path) -> dict[str, Any]:
    """A rig from landmarks, and two from boards: cameras with one that is refined, and with the default one."""
    far = torch.tensor(site.RANGES, dtype=torch.float64)
    ahead = torch.stack([0.1 * torch.linspace(-3, 3, len(far)), 0.02 * torch.arange(len(far)) - 0.06, 0 * far + 1], -1)
    targets = far[:, None] * ahead / ahead.norm(dim=-1, keepdim=True) @ site.LOOK
    draw = site.generator(10_000)
    surveyed = solve_rig(site.data("a baseline", draw), site.STRAIGHT)
    found = {"rig from landmarks": positions(surveyed, site.seen(targets))}
    sides = {side: Observations.load(common / f"{side}.obs.json") for side in PAIRS}
    pairs = pair_by_name(sides["left"].names, sides["right"].names)
    for model in (None, "opencv5"):
        left, right = (load_camera(common / f"{label(side, model)}.json") for side in PAIRS)
        result = calibrate_rig(left, right, sides["left"], sides["right"], pairs, RigOptions())
        marks = torch.stack([sides[side].pixels()[0, ::9] for side in PAIRS], 1)
        found[label("rig from boards", model)] = positions(result, marks)
    return found


def compare_corners(first: Path, second: Path) -> dict[str, Any]:
    """Largest difference in units of a corner's σ, and corners that only one of them has."""
    worst, alone, number = 0.0, 0, 0
    for side in PAIRS:
        one, other = (Observations.load(folder / f"{side}.obs.json") for folder in (first, second))
        a, b = one.pixels(), other.pixels()
        if one.names != other.names:
            return {"of σ": math.inf, "note": "other images"}
        alone += int((a.isfinite().all(-1) != b.isfinite().all(-1)).sum())
        number += int(a.isfinite().all(-1).sum())
        covariance = one.covariances()
        sigma = covariance.diagonal(dim1=-2, dim2=-1).sqrt() if covariance is not None else torch.full_like(a, _SIGMA)
        away = ((a - b) / sigma).abs()
        worst = max(worst, float(away[away.isfinite()].max()))
    return {"of σ": worst, "note": f"{alone} of {number} corners found by one only" if alone else ""}


def compare_cameras(first: Path, second: Path) -> dict[str, Any]:
    """Largest shift in the image in units of its σ, and largest ratio of σ less one."""
    one, other = load_camera(first), load_camera(second)
    found = camera_difference(one, other, grid=(17, 13))
    assert found.sigma is not None
    # Of both cameras, taken as independent: each has a share of a half.
    away = found.length / (found.sigma / math.sqrt(2.0))
    places = found.pixels.reshape(-1, 2)
    sigma = projection_sigma(other, places) / projection_sigma(one, places) - 1.0
    return {
        "of σ": float(away[away.isfinite()].max()),
        "px": found.largest,
        "σ": float(sigma[sigma.isfinite()].abs().max()),
    }


def compare_positions(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Largest shift of a point in units of its σ, all directions, and largest ratio of σ less one."""
    a, b, covariance, second = (
        torch.tensor(x, dtype=torch.float64)
        for x in (one["points"], other["points"], one["covariance"], other["covariance"])
    )
    away = torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), (b - a)[..., None], upper=False)
    sigma = (second.diagonal(dim1=-2, dim2=-1) / covariance.diagonal(dim1=-2, dim2=-1)).sqrt() - 1.0
    return {"of σ": float(away.norm(dim=(-1, -2)).max()), "σ": float(sigma.abs().max())}


Row = tuple[list[float], list[float], str, str]


def compare(first: Path, others: dict[str, Path]) -> dict[str, Row]:
    """For each stage: differences / σ, differences of σ, the setting with the largest one, and statuses that differ."""
    told = {name: json.loads((place / "told.json").read_text()) for name, place in {"": first, **others}.items()}
    found: dict[str, dict[str, dict[str, Any]]] = {"corners": {}}
    statuses: dict[str, set[str]] = {}
    for name, place in others.items():
        found["corners"][name] = compare_corners(first, place)
        for here, record in told[name]["cameras"].items():
            base = told[""]["cameras"][here]
            statuses.setdefault(here, set()).update((base["status"], record["status"]))
            if all((folder / f"{here}.json").exists() for folder in (first, place)):
                found.setdefault(here, {})[name] = compare_cameras(first / f"{here}.json", place / f"{here}.json")
            else:
                found.setdefault(here, {})
        for here, record in told[name]["positions"].items():
            found.setdefault(here, {})[name] = compare_positions(told[""]["positions"][here], record)
    rows: dict[str, Row] = {}
    for here, by_name in found.items():
        worst = max(by_name, key=lambda name: by_name[name]["of σ"], default="")
        note = statuses.get(here, set())
        refused = all(status.startswith("refused") for status in note) and bool(note)
        rows[here] = (
            [one["of σ"] for one in by_name.values()],
            [one["σ"] for one in by_name.values() if "σ" in one],
            worst,
            "refused" if refused else ", ".join(sorted(note)) if len(note) > 1 else "",
        )
    return rows


def compute(place: str, first: str, cameras: tuple[str, ...]) -> None:
    """All stages into a folder, in a process under a setting; only these cameras, and no rigs, if any is named."""
    folder, common = make_folder(Path(place)), Path(first)
    only = [name for name in cameras if name]
    warnings.simplefilter("ignore")
    find_corners(folder)
    told = {"cameras": fit_cameras(folder, common, only), "positions": {} if only else locate(common)}
    (folder / "told.json").write_text(json.dumps(told), encoding="utf-8")


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
    kept = {k: v for k, v in os.environ.items() if k not in ours}
    return kept | ALONE | {"PYTHONPATH": str(ROOT)} | SETTINGS[setting]


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
) -> Lines:
    """Compute all stages under each setting, into folders, and compare each with the first; or only these cameras."""
    with tempfile.TemporaryDirectory(prefix="kcal-cpus-") as name:
        yield from _figures(make_folder(folder or Path(name)), settings, cameras)


def _figures(folder: Path, settings: tuple[str, ...], cameras: tuple[str, ...]) -> Lines:
    places = {setting: folder / str(i) for i, setting in enumerate(settings)}
    first, *others = places
    for setting, place in places.items():
        given = str(place), str(places[first]), cameras
        code = f"from scripts.check.cpus import compute; compute{given!r}"
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
