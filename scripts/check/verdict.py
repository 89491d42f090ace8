"""Does the verdict say yes only to captures that deserve it? Seeds below 200 were for setting the thresholds."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator

import torch
from torch import Tensor

from kcal import Camera, KcalError, RigData, solve_rig
from kcal.calibrate import examine
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.lens.pose import rotation_between
from kcal.lens.uncertainty import image_sigma
from kcal.report import camera_verdict, rig_verdict
from kcal.report.verdict import Requirement, Verdict
from kcal.rig import pair_by_name, paired_boards
from kcal.sim.truth import TruthLens
from scripts.check.verdict_captures import FAULTS, Planted, PlantedPair, drawn
from scripts.shared.page import Lines
from scripts.shared.sections import NOT_KEPT, Kept, Record, section

# What is required of a camera, in a rig with 10 m of baseline; of a rig, from boards alone.
CAMERA, RIG, MARK = "2km:10%", "500m:5%", 0.1
# Where nothing is required, a camera whose true error is more than so many times its error bars is wrong.
SIGMAS = 2.0
# Which finding names which fault.
NAMES = {
    "model": {"model"},
    "fronto-parallel": {"tilt"},
    "warp": {"board"},
    "blur": {"blur"},
    "unsynchronized": {"synchronization"},
    "pupil": {"pupil"},
    "mirrored or mixed": {"mirrored"},
}
# What the error says where kcal refuses the capture.
REFUSALS = {
    "fronto-parallel": ("parallel to the image", "determine the focal length only", "tilted alike"),
    "unsynchronized": ("taken at the same moment",),
}
CLEAN = ("clean", "clean", "clean", "clean pair")


def true_error(lens: TruthLens, camera: Camera) -> float:
    """Difference of lens and camera at infinity after the best-fit rotation, RMS over the image, px."""
    grid = camera.grid(33, 25).reshape(-1, 2)
    rays, _ = lens.unproject(grid)
    own, valid = camera.unproject(grid)
    turn = rotation_between(rays[valid], own[valid])
    seen, shown = camera.project(1e9 * rays @ turn.T)
    good = valid & shown
    return float((seen - grid)[good].square().sum(-1).mean().sqrt())


def judge_camera(planted: Planted) -> tuple[Verdict, float, float, Record]:
    """Verdict, true RMS error over the image in px, that of the range over what is required; the verdict without."""
    result = calibrate_camera(planted.observations, planted.options)
    need, found = Requirement.parse(CAMERA), examine(result, planted.options)
    verdict = camera_verdict(result, planted.options, need, mark_sigma=MARK, examination=found)
    bare = camera_verdict(result, planted.options, examination=found)
    off, sigma = true_error(planted.lens, result.camera), image_sigma(result.camera)
    stated = float(sigma[sigma.isfinite()].square().mean().sqrt())
    slope = math.sqrt(2.0) * need[0].distance ** 2 / (float(result.camera.focal[0]) * 10.0)
    more = {"bare": bare.usable, "sigmas": round(off / stated, 2)}
    return verdict, off, slope * math.hypot(off, MARK) / need[0].meters, more


def judge_pair(planted: PlantedPair) -> tuple[Verdict, float, float, Record]:
    """Verdict, true RMS error of ranges in meters, and over what is required."""
    cameras = []
    for seen in planted.alone:
        cameras.append(calibrate_camera(seen, CalibrationOptions()).camera)
    both = (cameras[0], cameras[1])
    matched = pair_by_name(planted.pairs[0].names, planted.pairs[1].names)
    boards = paired_boards(both, planted.pairs, matched)
    result = solve_rig(RigData(cameras=both, names=("left", "right"), boards=boards))
    rig = result.stereo()
    need = Requirement.parse(RIG)[0]
    verdict = rig_verdict(rig, (need,), mark_sigma=MARK, result=result)
    places: list[Tensor] = []
    for u, v in itertools.product((-0.3, 0.0, 0.3), (-0.2, 0.0, 0.2)):
        places.append(torch.tensor([0.5 + u, 0.5 + v]) * torch.tensor(planted.rig.left.size))
    rays = planted.rig.left.unproject(torch.stack(places).double())[0]
    pixels, seen_by_both = planted.rig(need.distance * rays)
    (left, right), seen_by_both = pixels.unbind(-2), seen_by_both.all(-1)
    from kcal.locate.stereo import sight_lines

    lines = sight_lines(rig, left, right)
    off = (lines.points.norm(dim=-1) - need.distance)[seen_by_both]
    error = float(off.square().mean().sqrt())
    return verdict, error, error / need.meters, {}


def judge(kind: str, seed: int) -> Record:
    """One line of the file."""
    clock = time.process_time()
    planted = drawn(kind, seed)
    line: Record = {"kind": kind, "detail": planted.detail}
    try:
        verdict, off, over, more = judge_pair(planted) if isinstance(planted, PlantedPair) else judge_camera(planted)
        line |= more | {
            "yes": verdict.usable,
            "off": round(off, 4),
            "over": round(over, 3),
            "stops": [finding.name for finding in verdict.stops],
            "doubts": [finding.name for finding in verdict.findings if finding.severity == "doubt"],
            "reason": verdict.reason,
        }
    except KcalError as error:
        line |= {"yes": False, "off": None, "over": None, "stops": ["refused"], "doubts": [], "reason": str(error)}
    return line | {"seconds": round(time.process_time() - clock, 2)}


def named(line: Record) -> bool:
    """Whether the planted fault was named."""
    refused = any(text in line["reason"] for text in REFUSALS.get(line["kind"], ()))
    return refused or bool(NAMES[line["kind"]] & {*line["stops"], *line["doubts"]})


def broken(line: Record, times: float) -> bool:
    """Whether the true error is so many times what is required, or more; a camera that was refused is broken."""
    return line["over"] is None or line["over"] > times


def wanted(first: int, planted: int, clean: int) -> Iterator[tuple[str, int]]:
    """Kinds and seeds, of all kinds from the beginning."""
    faulty = [(FAULTS[i % len(FAULTS)], first + i // len(FAULTS)) for i in range(planted)]
    good = [(CLEAN[i % len(CLEAN)], first + i) for i in range(clean)]
    groups = itertools.zip_longest(faulty[::2], faulty[1::2], good)
    return (job for jobs in groups for job in jobs if job is not None)


@section("ordinary.md", "verdict", planted=1, clean=1)
def verdicts(kept: Kept = NOT_KEPT, planted: int = 200, clean: int = 100, first: int = 200) -> Lines:
    """What happens to captures with a planted fault, and to good ones."""
    lines = kept.records(wanted(first, planted, clean), judge, lambda one: f"{one['yes']}, off {one['off']}")
    bad, fine = ([line for line in lines if (line["kind"] in FAULTS) is fault] for fault in (True, False))
    yield [
        "captures", "number", "yes", "yes, but off by more than required", "by twice that", "all that are off by more",
        "fault named", "nothing required: yes", f"of these, off by more than {SIGMAS:g} σ",
        f"no, though within {SIGMAS:g} σ",
    ]  # fmt: skip
    for kind in [*FAULTS, "all planted", "clean"]:
        here = fine if kind == "clean" else [line for line in bad if kind in ("all planted", line["kind"])]
        if not here:
            continue
        yes, alone = [line for line in here if line["yes"]], [line for line in here if "bare" in line]
        yield [
            kind, len(here), len(yes), sum(broken(line, 1.0) for line in yes), sum(broken(line, 2.0) for line in yes),
            sum(broken(line, 1.0) for line in here), "" if kind == "clean" else sum(map(named, here)),
            *([sum(line["bare"] for line in alone),
               sum(line["bare"] and line["sigmas"] > SIGMAS for line in alone),
               sum(not line["bare"] and line["sigmas"] <= SIGMAS for line in alone)] if alone else [""] * 3),
        ]  # fmt: skip
    good = [line for line in fine if not broken(line, 1.0)]
    yield ""
    refused = sum(not line["yes"] for line in good)
    yield f"Of the {len(good)} clean captures that are not off by more than required, {refused} got a no."
