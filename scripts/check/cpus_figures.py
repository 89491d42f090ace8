"""What the section "cpus" of docs/measured/other-programs.md computes under each setting, and how far results differ.

Stages: corners of OpenCV's stereo images; cameras of these corners, of other captures and of a simulated one; a rig
from landmarks with ranges, and a rig from the pairs of boards. Each stage begins with the same input under all settings
(corners and cameras of the first one), so that it shows its own share.
"""

from __future__ import annotations

import json
import math
import os
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcal import DegenerateError, InputError, Localizer, Observations, load_camera
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, calibrate_rig, solve_rig
from kcal.files import make_folder
from kcal.lens import camera_difference
from kcal.lens.uncertainty import projection_sigma
from kcal.rig import RigCovariance, pair_by_name
from kcal.solve import SolverStatus
from scripts.check import rig as site
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
