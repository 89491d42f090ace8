"""Are faults in rigs and captures found, named and refused, and good ones let through?

Rigs: landmarks as in `scripts.check.rig`, marked to 0.1 px and surveyed to 2 cm. *Named* means that the message, or
what was left out, names the wrong one; *plain* that neither a refusal, nor something left out, nor a warning tells.
*Contained* is the share of the six components of the relative pose within their 95 % intervals, of rigs that were
accepted. Captures: simulated ones on a stand and by hand, half of whose views are cropped or zoomed, two real cameras
of a rig mixed into one capture, and all real captures as they are. *Rightly named* is the share of views in the right
group.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from kcal import Baseline, KcalError, Observations, RigData, calibrate_camera, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.lens import vector_from_rotation
from scripts.check.rig import BASELINE, NAMES, STRAIGHT, TRUTH, data, generator, landmarks
from scripts.shared.page import Lines, section
from scripts.shared.real_captures import load, names
from scripts.shared.simulated import simulated

OFF = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)  # m: of a wrong landmark
CROP, ZOOM, NOISE = 40.0, 1.05, 0.15
WITHIN = 1.96


class RigCase(NamedTuple):
    """Data, and the name of what is wrong with them; empty where nothing is."""

    sources: RigData
    wrong: str


def of_landmarks(count: int, seed: int, wrong: bool = False) -> RigCase:
    """A rig of a few landmarks, one of them in a wrong place."""
    whole = landmarks(generator(seed))
    points = whole.points[:count].clone()
    points[2] += OFF * wrong
    few = dataclasses.replace(
        whole, names=whole.names[:count], points=points, sigma=whole.sigma[:count], pixels=whole.pixels[:count]
    )
    sources = RigData(cameras=(TRUTH.left, TRUTH.right), names=NAMES, landmarks=few)
    return RigCase(sources, whole.names[2] if wrong else "")


def with_baseline(kind: str, seed: int, sigma: float) -> RigCase:
    """A rig whose baseline is stated one percent too long."""
    stated = Baseline(first=0, second=1, length=1.01 * BASELINE, sigma=sigma)
    return RigCase(dataclasses.replace(data(kind, generator(seed)), baselines=(stated,)), "the baseline")


def with_position(kind: str, seed: int) -> RigCase:
    """A rig whose left camera was measured half a meter away."""
    found = data(kind, generator(seed))
    left, right = found.positions
    return RigCase(
        dataclasses.replace(found, positions=(dataclasses.replace(left, point=left.point + 0.3), right)),
        "the position of left",
    )


RIGS: dict[str, Callable[[int], RigCase]] = {
    "3 landmarks": lambda seed: of_landmarks(3, seed),
    "5 landmarks, one 1 m off": lambda seed: of_landmarks(5, seed, wrong=True),
    "6 landmarks, one 1 m off": lambda seed: of_landmarks(6, seed, wrong=True),
    "12 landmarks, one 1 m off": lambda seed: of_landmarks(12, seed, wrong=True),
    "baseline 0.1 m off, stated 1 mm": lambda seed: with_baseline("", seed, 0.001),
    "the same beside positions, summits": lambda seed: with_baseline("positions summits", seed, 0.001),
    "position 0.5 m off, stated 2 to 4 cm": lambda seed: with_position("baseline positions", seed),
    "good: 4 landmarks": lambda seed: of_landmarks(4, seed),
    "good: 6 landmarks": lambda seed: of_landmarks(6, seed),
    "good: 12 landmarks": lambda seed: of_landmarks(12, seed),
    "good: 12 and baseline": lambda seed: RigCase(data("baseline", generator(seed)), ""),
    "good: 12 and positions": lambda seed: RigCase(data("positions", generator(seed)), ""),
    "good: everything": lambda seed: RigCase(data("baseline positions summits", generator(seed)), ""),
}


def contained(found: RigResult) -> list[bool]:
    """Which components of the relative pose are within their intervals."""
    rig = found.stereo()
    turn = vector_from_rotation(rig.right_from_left_rotation @ TRUTH.right_from_left_rotation.T)
    error = torch.cat([turn, rig.right_from_left_translation - TRUTH.right_from_left_translation])
    return (error.abs() <= WITHIN * found.relative_covariance().diagonal().sqrt()).tolist()


@section("rig.md", "faults", seeds=range(1))
def of_rigs(seeds: range = range(20)) -> Lines:
    yield ["rigs", "refused", "named", "plain", "left out", "contained"]
    for kind, make in RIGS.items():
        refused = named = plain = out = 0
        inside: list[bool] = []
        for seed in seeds:
            sources, wrong = make(seed)
            try:
                found = solve_rig(sources, STRAIGHT)
            except KcalError as error:
                refused += 1
                named += bool(wrong) and wrong in str(error)
                continue
            gone = [item.name for item in found.left_out]
            out += bool(gone)
            named += bool(wrong) and (wrong in gone or any(wrong in text for text in found.warnings))
            plain += not gone and not found.warnings
            inside += contained(found)
        share = f"{sum(inside) / len(inside):.2f}" if inside else "–"
        yield [kind, f"{refused}/{len(seeds)}", named, plain, out, share]


def changed(seen: Observations, second: set[int], change: Callable[[Tensor], Tensor]) -> Observations:
    """Some views with their pixels changed; what leaves the image is not seen."""
    views, size = list(seen.views), torch.tensor(seen.image_size, dtype=torch.float64)
    for i in second:
        pixels = change(seen.pixels()[i])
        good = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(-1).tolist()
        update: dict[str, object] = {
            "pixels": tuple((p[0], p[1]) if ok else None for p, ok in zip(pixels.tolist(), good, strict=True))
        }
        if (spread := views[i].covariance) is not None:
            update["covariance"] = tuple(one if ok else None for one, ok in zip(spread, good, strict=True))
        views[i] = views[i].model_copy(update=update)
    return seen.model_copy(update={"views": tuple(views)})


def mixed(one: Observations, other: Observations) -> Observations:
    """Every other view of one camera, and the rest of another."""
    first = [view.model_copy(update={"name": f"one {view.name}"}) for view in one.views[::2]]
    second = [view.model_copy(update={"name": f"two {view.name}"}) for view in other.views[1::2]]
    return one.model_copy(update={"views": (*first, *second)})


def captures(seeds: range, views: int) -> Iterator[tuple[str, Observations, set[int]]]:
    """Kind, views, and which of them are of the second group; none in good captures."""
    odd, late = set(range(1, views, 2)), set(range(views // 2, views))
    for seed in seeds:
        for by_hand in (False, True):
            seen, how = simulated(seed, views, NOISE, by_hand).seen, "by hand" if by_hand else "on a stand"
            middle = 0.5 * torch.tensor(seen.image_size, dtype=torch.float64)
            yield f"good, {how}", seen, set()
            yield f"cropped, {how}", changed(seen, odd, lambda p: p - torch.tensor([CROP, 0.0]).double()), odd
            yield f"zoomed, {how}", changed(seen, late, lambda p, m=middle: (p - m) * ZOOM + m), late  # type: ignore[misc]


def real_captures() -> Iterator[tuple[str, Observations, set[int]]]:
    """The same of two cameras mixed, and of all captures as they are."""
    for left, right in (("stereo_left", "stereo_right"), ("st1_l", "st1_r")):
        both = mixed(*(load(name).seen for name in (left, right)))
        yield "two real cameras", both, {i for i, name in enumerate(both.names) if name.startswith("two")}
    for name in names():
        yield "good, real", load(name).seen, set()


def rightly(text: str, seen: Observations, second: set[int]) -> float:
    """Share of the views that a message puts into the right group."""
    listed = set(text.partition("(")[2].partition(")")[0].split(", "))
    told = {i for i, name in enumerate(seen.names) if name in listed}
    right = len(seen.views) - len(told ^ second)
    return max(right, len(seen.views) - right) / len(seen.views)


@section("ordinary.md", "two cameras", seeds=range(1), views=8, simulated_only=True)
def of_captures(seeds: range = range(4), views: int = 20, simulated_only: bool = False) -> Lines:
    found: dict[str, list[float | None]] = {}
    for kind, seen, second in itertools.chain(captures(seeds, views), () if simulated_only else real_captures()):
        share: float | None = None
        try:
            calibrate_camera(seen)
        except KcalError as error:
            share = rightly(str(error), seen, second)
        found.setdefault(kind, []).append(share)
    yield ["captures", "refused", "rightly named"]
    for kind, shares in found.items():
        told = [share for share in shares if share is not None]
        mean = f"{sum(told) / len(told):.2f}" if told and "good" not in kind else "–"
        yield [kind, f"{len(told)}/{len(shares)}", mean]
