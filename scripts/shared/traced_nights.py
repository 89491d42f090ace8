"""Rigs of two traced lenses with calibrations of their own, solved from landmarks or from stars, and their ranges."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal import Baseline, Camera, Localizer, MeasuredPosition, RigData, calibrate_camera
from kcal.calibrate.rig.marks import StarSource
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, solve_rig
from kcal.lens.projection import FAR
from kcal.sim.captures import TrueRig
from kcal.stars import calibrate_by_stars, star_source
from kcal.stars.detect import DetectedStars
from kcal.stars.night import Attitude, NamedStars, SkyView
from kcal.stars.sky import Air, StarCatalog, celestial_directions, observed_directions
from scripts.check.chain_rig import ENU_FROM_RIG, Targets, landmarks, targets, true_rig
from scripts.shared.long_range import ORIGIN, RANGES, matches_of
from scripts.shared.night_scenes import PLACE, TIME
from scripts.shared.star_lenses import star_images
from scripts.shared.traced import BOARD, capture, printed

CLOCK_SIGMA, AIR_SIGMA, STAR, MARK = 0.02, 3.0, 0.1, 0.1  # s, K, px, px
TAPE, MAST, MATCHES = 0.002, 0.01, 12  # m, m
PAIRS_OF_LENSES = 8
AT = (1000.0, 2000.0, 5000.0)
# Shares of the image that boards fill, and views.
_FILL, _VIEWS = (0.40, 0.94), 30
_HORIZON = 40.0  # px
_LOWEST = math.sin(math.radians(6.0))
STRAIGHT = RigOptions(refraction=0.0, refraction_sigma=0.0)


class Case(NamedTuple):
    """What a rig is solved from: surveyed landmarks, or pairs of night images with named stars or without names."""

    landmarks: bool = False
    pairs: int = 0
    named: bool = False
    lenses: str = "boards"


CASES = {
    "12 landmarks ± 2 cm": Case(landmarks=True),
    "1 pair, unnamed, 12 matches": Case(pairs=1),
    "1 pair, named, masts ± 1 cm": Case(pairs=1, named=True),
    "20 pairs, unnamed, 12 matches": Case(pairs=20),
    "20 pairs, named, masts ± 1 cm": Case(pairs=20, named=True),
    "the same, lenses by boards and 20 images tilted by 30°": Case(pairs=20, named=True, lenses="stars"),
}


class Lenses(NamedTuple):
    """Two traced lenses, their calibrations by boards, and targets at `AT`."""

    rig: TrueRig
    cameras: tuple[Camera, Camera]
    targets: Targets


@functools.cache
def lenses(number: int, by: str = "boards") -> Lenses:
    """The lenses of a draw, each calibrated by views of one printed board, or by these and stars."""
    rig = true_rig(number, 1.0)
    board = printed(BOARD.points, number)
    cameras = []
    for side, lens in enumerate((rig.left, rig.right)):
        found = calibrate_camera(capture(lens, _VIEWS, 0.1, 1000 + 2 * number + side, board, _FILL))
        if by == "stars":
            stars = star_images(30.0, 20, 1000 + 2 * number + side, lens=lens)
            joint = calibrate_by_stars(*stars, lens.size, boards=found).joint
            assert joint is not None
            found = joint
        cameras.append(found.camera)
    seen = targets(rig)
    kept = torch.isin(seen.ring, torch.tensor([RANGES.index(distance) for distance in AT]))
    # Where targets so far away are: along the horizon.
    kept &= (seen.pixels[0, :, 1] - 0.5 * (rig.left.size[1] - 1)).abs() < _HORIZON
    some = Targets(seen.ring[kept], seen.inverse[kept], seen.pixels[:, kept], seen.bound[kept])
    return Lenses(rig, (cameras[0], cameras[1]), some)


def _poses(rig: TrueRig) -> tuple[Tensor, Tensor]:
    """(2, 3, 3) cameras from east, north, up, and (2, 3) their centers."""
    right = rig.right_from_left_rotation
    rotation = torch.stack([ENU_FROM_RIG.T, right @ ENU_FROM_RIG.T])
    return rotation, torch.stack([torch.zeros(3).double(), -rig.right_from_left_translation @ rotation[1]])


def night(rig: TrueRig, cameras: tuple[Camera, Camera], case: Case, draw: np.random.Generator) -> StarSource:
    """Stars of a night; the right clock and the air are drawn from what is stated of them."""
    catalog, late = StarCatalog.bundled(), float(draw.normal(0, CLOCK_SIGMA))
    there = Air.at_height(PLACE.height, celsius=10.0 + draw.normal(0, AIR_SIGMA))
    stated = Air.at_height(PLACE.height, celsius_sigma=AIR_SIGMA, hectopascal_sigma=1.0)
    bright = StarCatalog(**{
        field.name: getattr(catalog, field.name)[catalog.magnitude < (6.0 if case.pairs == 1 else 5.0)]
        for field in dataclasses.fields(catalog)
    })  # fmt: skip
    rotation, _ = _poses(rig)
    moments = []
    for number in range(case.pairs):
        time = TIME + datetime.timedelta(minutes=25 * number)
        if case.named:
            view = SkyView(time=time, origin=PLACE, air=stated, dut1=0.0, time_sigma=0.1)
            known = view.directions(bright)
        else:
            view = SkyView(time=time)
            known = celestial_directions(bright, time)
        moment = {}
        for side, lens in enumerate((rig.left, rig.right)):
            moved = time + datetime.timedelta(seconds=late * side)
            seen = observed_directions(bright, moved, PLACE, there)
            rays = torch.from_numpy(seen) @ rotation[side].T
            up = np.flatnonzero((seen[:, 2] > _LOWEST) & (rays[:, 2] > 0.3).numpy())
            at, valid = lens.project(FAR * rays[up])
            inside = (valid & lens.inside(at)).numpy()
            index = up[inside]
            pixels = at.numpy()[inside] + draw.normal(0, STAR, (len(index), 2))
            # Of stars without names, the frame is that of the catalog.
            turn = rotation[side] if case.named else rotation[side] @ _turn(seen[index], known[index])
            moment[side] = NamedStars(
                detected=DetectedStars(pixels, np.full(len(index), STAR), np.ones(len(index)), 0.02, {}),
                view=view,
                attitude=Attitude(
                    rotation=turn, covariance=torch.zeros(3, 3).double(), star=index,
                    residual=np.zeros((len(index), 2)), rms_px=STAR, widened=1.0,
                ),
                directions=known,
                on_earth=case.named,
                covariance=torch.zeros(3, 3).double(),
                warnings=(),
            )  # fmt: skip
        moments.append(moment)
    return star_source(moments, cameras, clock_sigma=CLOCK_SIGMA, origin=PLACE if case.named else None, catalog=bright)


def _turn(seen: np.ndarray, known: np.ndarray) -> Tensor:
    from kcal.stars.sky import turn_between

    return torch.from_numpy(turn_between(known, seen))


def data_of(made: Lenses, case: Case, seed: int) -> RigData:
    """What the rig is solved from: the case's source, and a taped baseline."""
    rig, cameras, _ = made
    draw, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    _, center = _poses(rig)
    length = float(rig.baseline) + draw.normal(0, TAPE)
    data = RigData(
        cameras=cameras, names=("left", "right"),
        baselines=(Baseline(first=0, second=1, length=length, sigma=TAPE),),
        landmarks=landmarks(rig, generator)[0] if case.landmarks else None,
    )  # fmt: skip
    if case.landmarks:
        return data
    features = None
    positions: tuple[MeasuredPosition, ...] = ()
    if case.named:
        positions = tuple(
            MeasuredPosition(
                camera=c, point=center[c] + torch.from_numpy(draw.normal(0, MAST, 3)),
                sigma=torch.full((3,), MAST).double(),
            )
            for c in (0, 1)
        )  # fmt: skip
    else:
        way = draw.uniform((-0.4, -0.2), (0.4, 0.2), (MATCHES, 2))
        rays = torch.nn.functional.pad(torch.from_numpy(way), (0, 1), value=1.0)
        left, right = rig(torch.from_numpy(draw.uniform(100, 1500, (MATCHES, 1))) * rays)[0].unbind(-2)
        marks = torch.stack([left, right], 1)
        features = matches_of(marks + torch.from_numpy(draw.normal(0, MARK, marks.shape)), pixel_sigma=MARK)
    return dataclasses.replace(data, stars=night(rig, cameras, case, draw), features=features, positions=positions)


def trial(number: int, case: Case, seed: int) -> np.ndarray:
    """Solve a rig and judge its ranges.

    Returns:
        (3, 4): for each of `AT` the mean squares of σ and of errors as shares of the range, both of the rig alone, and
            the shares of targets in the 95 % interval, of the rig alone and with marks of 0.1 px.
    """
    made = lenses(number, case.lenses)
    return judged(solve_rig(data_of(made, case, seed), STRAIGHT), made.targets, seed)


def judged(found: RigResult, there: Targets, seed: int) -> np.ndarray:
    """See `trial`."""
    pair = found.stereo()
    generator = torch.Generator().manual_seed(seed)
    columns = []
    for sigma in (1e-4, MARK):
        marks = there.pixels
        if sigma == MARK:
            marks = marks + MARK * torch.randn(marks.shape, dtype=torch.float64, generator=generator)
        answer = Localizer(pair.placed(origin=ORIGIN, heading_deg=35.0), pixel_sigma=sigma)(*marks)
        inside = (answer.range_low <= 1 / there.inverse) & (1 / there.inverse <= answer.range_high)
        if sigma != MARK:
            columns += [
                (answer.inverse_range_sigma / there.inverse).square(),
                (answer.inverse_range / there.inverse - 1.0).square(),
            ]
        columns.append(inside.double())
    table = torch.stack(columns, -1)
    return torch.stack([table[there.ring == RANGES.index(distance)].mean(0) for distance in AT]).numpy()
