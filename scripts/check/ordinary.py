"""The default camera on captures that people really have: whole, and halves against halves, beside OpenCV and mrcal.

    KCAL_MRCAL=/usr/bin/python3 ...                                     # mrcal's spline, too

Whole: refused or not, RMS, what `kcal report` answers where nothing is required, and the worst that is said. Each
camera is then fitted to every other view of a capture (in natural order of their names) and judged on the others, both
ways. Held out: RMS in pixels over both halves, `scripts.shared.held_out`: as seen, with poses and board refitted, and
with each view's own motion during the readout refitted as well. *Lost* are seen corners that a camera has no image of;
they are not in its RMS. Halves: `camera_difference` between both halves' cameras; a ratio of 1 is what their error bars
state, p is the chance of more. A model that was not measured has no column. `parts`: the same between a few
views, drawn at random, and the rest. `pairs`: the same of rigs, from a few pairs of views and from the rest: χ² of the
relative pose over its six degrees of freedom, and z, the difference of inverse ranges over its standard deviation.
"""

from __future__ import annotations

import itertools
import math
import random
import statistics
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import torch
from torch import Tensor

from kcal import CalibrationOptions, Camera, KcalError, Localizer, Observations, calibrate_camera, calibrate_rig
from kcal.calibrate.rig.result import RigResult
from kcal.lens import camera_difference, vector_from_rotation
from kcal.locate.stereo import Localization
from kcal.report import camera_verdict
from scripts.shared.children import interpreter
from scripts.shared.held_out import Projection, of_halves
from scripts.shared.page import NOT_KEPT, Kept, Lines, Record, section, table, timed
from scripts.shared.peer_lenses import END, fisheye, opencv, splined_camera
from scripts.shared.real_captures import RealCapture, load, names

MODELS = ("kcal", "opencv5", "opencv8", "fisheye", "mrcal")
LEAST_P, RATIOS, WORST = 0.01, (0.5, 1.2), 1.04


def judged(name: str) -> Record:
    """Both halves of one capture, by all models."""
    capture = load(name)
    halves = capture.half(0), capture.half(1)
    record: Record = {"whole": _whole(capture), "views": [len(half.seen.views) for half in halves], "held": {}}
    kcal = _defaults(halves, record)
    fitters: dict[str, Callable[[RealCapture], Projection]] = {
        "opencv5": lambda half: opencv(half.seen, 5, criteria=END),
        "opencv8": lambda half: opencv(half.seen, 8, criteria=END),
        "fisheye": lambda half: fisheye(half.seen),
    }
    if interpreter("mrcal"):
        fitters["mrcal"] = lambda half: splined_camera(half.seen, half.weight)
    if kcal is not None:
        record["held"]["kcal"] = of_halves(kcal, halves)
        between = camera_difference(kcal[0], kcal[1])
        record |= {"ratio": between.ratio, "p": between.probability, "shift": between.rms}
    for model, fit in fitters.items():
        try:
            record["held"][model] = of_halves([fit(half) for half in halves], halves)
        except (KcalError, cv2.error, subprocess.SubprocessError) as error:
            record["held"][model] = {"failed": str(error)[-300:]}
    return record


def _whole(capture: RealCapture) -> Record:
    """What a user gets of all views: RMS, the verdict, and its worst sentence; or why they are refused."""
    try:
        result, spent = timed(calibrate_camera, capture.seen, CalibrationOptions())
    except KcalError as error:
        return {"refused": str(error)}
    verdict, spent_on_report = timed(camera_verdict, result)
    doubts = [finding.text for finding in verdict.findings if finding.severity == "doubt"]
    worst = next(iter([verdict.reason] if verdict.stops else [*result.warnings, *doubts]), "")
    seconds = {"cpu_s": spent, "report_cpu_s": spent_on_report}
    return {"rms": result.rms, "yes": verdict.usable, "worst": worst, **seconds}


def _defaults(halves: tuple[RealCapture, RealCapture], record: Record) -> list[Camera] | None:
    """The default camera of each half; None, and why in the record, if one is refused."""
    cameras: list[Camera] = []
    record |= {"refused": [], "warnings": [], "noise": [], "cpu_s": []}
    for half in halves:
        try:
            result, spent = timed(calibrate_camera, half.seen, CalibrationOptions())
        except KcalError as error:
            record["refused"].append(str(error))
            continue
        record["cpu_s"].append(spent)
        record["warnings"].append(list(result.warnings))
        record["noise"].append(result.noise)
        cameras.append(result.camera)
    return cameras if len(cameras) == len(halves) else None


def over_best(record: Record) -> dict[str, float]:
    """Held-out RMS of kcal over that of the best other, by kind; a camera without an image of a corner errs by ∞."""
    held = record["held"]
    if "kcal" not in held:
        return {}
    whole = {model: one for model, one in held.items() if one.get("lost") == 0}
    others = [one for model, one in whole.items() if model != "kcal"]
    infinite = {"still": math.inf, "moved": math.inf}
    own, best = whole.get("kcal", infinite), {key: min((one[key] for one in others), default=None) for key in infinite}
    return {key: own[key] / value if value is not None else math.nan for key, value in best.items()}


def shown(held: Record | None) -> str:
    """A model's cell."""
    if held is None:
        return "–"
    if "failed" in held:
        return "failed"
    lost = f", {held['lost']} lost" if held["lost"] else ""
    return f"{held['still']:.4f} / {held['moved']:.4f}{lost}"


def lines(records: list[Record]) -> list[str]:
    """The page's table, and how the aims fare."""
    models = [model for model in MODELS if any(model in record["held"] for record in records)]
    rows = []
    for record in records:
        cells = [shown(record["held"].get(model)) for model in models]
        between = f"{record['ratio']:.2f} ({record['p']:.2g})" if "ratio" in record else "refused"
        over = " / ".join(f"{value:.2f}" for value in over_best(record).values() if value == value) or "–"
        views = "+".join(map(str, record["views"]))
        whole = record.get("whole", {})
        answer = f"{'yes' if whole['yes'] else 'no'}, {whole['rms']:.4f}" if "rms" in whole else "refused"
        rows.append([_short(record), answer, views, between, *cells, over])
    known = [record for record in records if "ratio" in record]
    most = max((value for record in known for value in over_best(record).values() if value == value), default=math.nan)
    head = ["capture", "usable, RMS", "views", "halves: ratio (p)", *models, "kcal / best other"]
    out = [*table(head, rows), ""]
    if known:
        out += [
            f"kcal refuses a half of {len(records) - len(known)} of {len(records)} captures. Of the others, "
            f"{sum(record['p'] >= LEAST_P for record in known)} have p ≥ {LEAST_P}; the smallest is "
            f"{min(record['p'] for record in known):.2g}. Mean ratio "
            f"{statistics.fmean(record['ratio'] for record in known):.2f} (aim: {RATIOS[0]} to {RATIOS[1]}). "
            f"Held out, kcal errs by at most {most:.2f} times the best other (aim: {WORST}).",
            "",
        ]
    told = [(record, record.get("whole", {})) for record in records]
    worst = [f"- `{_short(record)}`: {whole.get('refused') or whole['worst']}" for record, whole in told
             if whole.get("refused") or whole.get("worst")]  # fmt: skip
    halves = [f"- half of `{_short(record)}`, refused: {reason}" for record in records for reason in record["refused"]]
    return [*out, *(["The worst that was said:", "", *worst, *halves] if worst or halves else [])]


def _short(record: Record) -> str:
    return Path(record["key"][0]).name.removesuffix(".obs.json")


@section("ordinary.md", "real", captures=("sq1280",))
def real(kept: Kept = NOT_KEPT, captures: tuple[str, ...] = ("all",)) -> list[str]:
    """Names of captures, or observations files."""
    wanted = names() if captures == ("all",) else list(captures)
    records = kept.records([(name,) for name in wanted], judged, lambda one: str(one["held"].get("kcal")))
    return lines(sorted((r for r in records if r["key"][0] in wanted), key=lambda r: wanted.index(r["key"][0])))


def _part(name: str, model: str, count: int, seed: int) -> Record:
    """A camera of so many views of a capture, drawn at random, against that of its other views."""
    seen = load(name).seen
    drawn = random.Random(f"{name} {count} {seed}").sample(seen.names, count)
    cameras: list[Camera] = []
    for views in (drawn, [view for view in seen.names if view not in drawn]):
        try:
            cameras.append(calibrate_camera(seen.subset(views), CalibrationOptions(model=model)).camera)
        except KcalError as error:
            return {"refused": "rest" if cameras else "part", "why": str(error)}
    between = camera_difference(*cameras)
    return {"ratio": between.ratio, "p": between.probability}


@section("ordinary.md", "parts", captures=("st1_l",), models=("hybrid",), views=(4,), seeds=range(1))
def parts(
    kept: Kept = NOT_KEPT,
    captures: tuple[str, ...] = ("all",),
    models: tuple[str, ...] = ("hybrid", "opencv8"),
    views: tuple[int, ...] = (4, 6, 8, 12),
    seeds: range = range(2),
) -> Lines:
    """Names of captures, lenses, and how many of the views are drawn."""
    sizes = {name: len(load(name).seen.views) for name in (names() if captures == ("all",) else captures)}
    keys = [
        (name, model, count, seed)
        for name, size in sizes.items() for model in models for count in views for seed in seeds if 2 * count <= size
    ]  # fmt: skip
    records = kept.records(keys, _part)
    yield ["lens", "views", "parts", "refused", "the rest refused", "p < 5 %", "p < 1 %", "median ratio", "largest"]
    for model, count in itertools.product(models, views):
        ours = [record for record in records if record["key"][1:3] == [model, count]]
        known = sorted((record for record in ours if "ratio" in record), key=lambda record: record["ratio"])
        refused = [sum(record.get("refused") == which for record in ours) for which in ("part", "rest")]
        beyond = [sum(record["p"] < level for record in known) for level in (0.05, 0.01)]
        middle = statistics.median(record["ratio"] for record in known)
        worst = f"{known[-1]['ratio']:.2f} (`{known[-1]['key'][0]}`)"
        yield list(map(str, [model, count, len(ours), *refused, *beyond, f"{middle:.2f}", worst]))


# Left and right of captures by two cameras, view by view at the same moments.
PAIRS = {"st1": ("st1_l", "st1_r"), "gavin": ("gavin_l", "gavin_r"), "stereo": ("stereo_left", "stereo_right")}
# Baselines at which ranges are compared, and of the sides of the image.
AWAY, PLACES = (10.0, 30.0, 100.0), (0.2, 0.5, 0.8)


def _rig(sides: list[Observations], pairs: list[int]) -> RigResult:
    seen = [side.subset([side.names[i] for i in pairs]) for side in sides]
    left, right = (calibrate_camera(side).camera for side in seen)
    return calibrate_rig(left, right, seen[0], seen[1], list(zip(seen[0].names, seen[1].names, strict=True)))


def _drawn_pairs(name: str, count: int, seed: int) -> Record:
    """The rig of so many pairs, drawn at random, against that of the others."""
    sides = [load(side).seen for side in PAIRS[name]]
    numbers = range(len(sides[0].views))
    drawn = sorted(random.Random(f"{name} {count} {seed}").sample(numbers, count))
    found = []
    for which, pairs in (("part", drawn), ("rest", [i for i in numbers if i not in drawn])):
        try:
            found.append(_rig(sides, pairs))
        except KcalError as refusal:
            return {"refused": which, "why": str(refusal)}
    part, rest = (result.stereo() for result in found)
    turn = vector_from_rotation(part.right_from_left_rotation @ rest.right_from_left_rotation.T)
    error = torch.cat([turn, part.right_from_left_translation - rest.right_from_left_translation])
    spread = found[0].relative_covariance() + found[1].relative_covariance()
    record: Record = {"chi2": float(error @ torch.linalg.solve(spread, error)) / len(error)}
    wide, high = rest.left.size
    rays = rest.left.unproject(torch.tensor([[wide * u, high * v] for u in PLACES for v in PLACES]).double())[0]
    rays = rays / rays.norm(dim=-1, keepdim=True)
    for away in AWAY:
        pixels, seen = rest(rays * away * float(rest.baseline))
        told = [Localizer(rig, pixel_sigma=1e-3)(*pixels[seen.all(-1)].unbind(-2)) for rig in (part, rest)]
        inverse, sigma = zip(*(_inverse_range(one) for one in told), strict=True)
        z = (inverse[0] - inverse[1]) / torch.hypot(*sigma)
        record[f"z {away:g}"] = float(z[z.isfinite()].square().mean().sqrt())
    return record


def _inverse_range(found: Localization) -> tuple[Tensor, Tensor]:
    """1 / range, and its standard deviation."""
    far = found.enu.norm(dim=-1)
    along = found.enu / far[:, None]
    return 1.0 / far, (along[:, None] @ found.covariance @ along[..., None])[:, 0, 0].sqrt() / far**2


@section("ordinary.md", "pairs", captures=("stereo",), views=(6,), seeds=range(1))
def pairs(
    kept: Kept = NOT_KEPT,
    captures: tuple[str, ...] = tuple(PAIRS),
    views: tuple[int, ...] = (6, 12),
    seeds: range = range(4),
) -> Lines:
    """Names of captures by two cameras, and how many of their pairs are drawn."""
    keys = [
        (name, count, seed)
        for name in captures for count in views for seed in seeds if count <= len(load(PAIRS[name][0]).seen.views) - 6
    ]  # fmt: skip
    records = kept.records(keys, _drawn_pairs)
    yield ["capture", "pairs", "parts", "refused", "χ²/6", *(f"z at {away:g} baselines" for away in AWAY)]
    for name, count in dict.fromkeys(tuple(key[:2]) for key in keys):
        ours = [record for record in records if tuple(record["key"][:2]) == (name, count)]
        known = [record for record in ours if "chi2" in record]
        chi2 = [record["chi2"] for record in known]
        squares = [[record[f"z {away:g}"] ** 2 for record in known] for away in AWAY]
        means = [statistics.fmean(chi2), *(math.sqrt(statistics.fmean(one)) for one in squares)] if known else []
        yield [name, *map(str, [count, len(ours), len(ours) - len(known)]), *(f"{mean:.2f}" for mean in means)]
