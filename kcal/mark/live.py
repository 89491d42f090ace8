"""The rig from the landmarks marked so far, what ranges it promises, and which landmark contradicts the others."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from kcal.calibrate.rig.result import ItemResidual
from kcal.calibrate.rig.solve import RigOptions, solve_rig
from kcal.calibrate.rig.sources import RigData
from kcal.errors import KcalError
from kcal.lens.camera import Camera
from kcal.lens.mounting import Origin
from kcal.lens.rig import StereoRig
from kcal.locate.marks import Marks
from kcal.locate.mounting import placed_rig
from kcal.locate.positions import Located, locate_points
from kcal.locate.range_sigmas import range_sigmas
from kcal.locate.survey import Survey, match_landmarks
from kcal.quantities import range_text

LEAST_LANDMARKS = 4
NOWHERE = Origin(lat=0.0, lon=0.0, height=0.0)


class Promise(NamedTuple):
    """What a rig promises at a distance, meters.

    Attributes:
        distance: from the left camera.
        marks: sigma of the range from noise in the marks of one target.
        rig: sigma of the range from errors of lenses and relative pose; None if nothing is known of them.
        total: both.
    """

    distance: float
    marks: float
    rig: float | None
    total: float


class LiveRig(NamedTuple):
    """What the landmarks of one moment give.

    Attributes:
        rig: the rig; None without a solution.
        origin: of the survey's frame; None if that is local.
        items: how well each landmark agrees with the others.
        promises: at the usual ranges; of a baseline of 10 m, 250 m, 1 km and 5 km.
        marked: landmarks marked in both images.
        sigma: px, typical of the marks.
        text: what the operator should know, in one sentence.
        enough: whether more landmarks would still matter: errors of the rig are below those of marks at the farthest.
        warnings: of the solution.
    """

    rig: StereoRig | None
    origin: Origin | None
    items: tuple[ItemResidual, ...]
    promises: tuple[Promise, ...]
    marked: int
    sigma: float
    text: str
    enough: bool = False
    warnings: tuple[str, ...] = ()


def solve_live(cameras: tuple[Camera, Camera], survey: Survey | None, marks: Marks, hand_sigma: float) -> LiveRig:
    """Solve the rig from surveyed landmarks and their marks, as `kcal rig --landmarks --marks` does.

    Args:
        cameras: calibrated.
        survey: the surveyed places; None if there are none.
        marks: all marks of landmarks.
        hand_sigma: px, of marks without covariance.
    """
    both = torch.isfinite(marks.pixels).all(-1).all(-1)
    names = {name for name, seen in zip(marks.names, both.tolist(), strict=True) if seen}
    count = len(names & set(survey.names)) if survey is not None else 0
    sigma = marks.typical_sigma(hand_sigma)
    nothing = LiveRig(None, None if survey is None else survey.origin, (), (), count, sigma, "")
    if survey is None or count < LEAST_LANDMARKS:
        missing = LEAST_LANDMARKS - count
        return nothing._replace(text=f"{missing} more landmark{'s' if missing > 1 else ''} in both images for a rig")
    try:
        landmarks = match_landmarks(survey, marks, marks.sigmas(hand_sigma)).landmarks
        result = solve_rig(RigData(cameras=cameras, names=("left", "right"), landmarks=landmarks), RigOptions())
        rig = placed_rig(result, survey.origin or NOWHERE)
    except KcalError as error:
        return nothing._replace(text=f"no rig from these landmarks: {error}")
    items = tuple(item for item in result.items if item.source == "landmarks")
    promises = promised(rig, sigma)
    text, enough = verdict(promises, count)
    if result.exact:
        text += "; errors of the lenses are not in it"
    wrong = [item.name for item in items if not item.used]
    if wrong:
        enough = False
        text = f"{', '.join(wrong)} contradict{'s' if len(wrong) == 1 else ''} the other landmarks; {text}"
    return LiveRig(rig, survey.origin, items, promises, count, sigma, text, enough, result.warnings)


def promised(rig: StereoRig, sigma: float) -> tuple[Promise, ...]:
    """Predicted standard deviations of ranges; empty where the rig cannot see that way."""
    try:
        found = range_sigmas(rig, pixel_sigma=sigma)
    except KcalError:
        return ()
    parts = torch.hypot(found.lenses, found.pose).tolist()
    known = rig.covariance is not None
    rows = zip(found.distance.tolist(), found.marks.tolist(), parts, found.total.tolist(), strict=True)
    return tuple(Promise(distance, marks, part if known else None, total) for distance, marks, part, total in rows)


def verdict(promises: tuple[Promise, ...], count: int) -> tuple[str, bool]:
    """Whether landmarks suffice, in words, and about how many are missing.

    They do where errors of the rig are below those of the marks of a single target at the farthest range: better
    landmarks would then hardly change a range. The variance of the rig falls as one over the number of landmarks.

    Example:
        >>> verdict((Promise(5000.0, 150.0, 300.0, 335.0),), 8)
        ('not enough: at 5 km the rig errs by 300 m, marks by 150 m; about 24 more landmarks like these', False)
    """
    if not promises:
        return "the rig's ranges cannot be predicted: its cameras do not look the same way", False
    far = promises[-1]
    if far.rig is None:
        return "these landmarks do not determine the rig well enough to predict its ranges", False
    rig, marks = (f"{error:.0f} m" if error >= 10 else f"{error:.2g} m" for error in (far.rig, far.marks))
    share = f"at {range_text(far.distance)} the rig errs by {rig}, marks by {marks}"
    if far.rig <= far.marks:
        return f"enough: {share}", True
    more = math.ceil(count * ((far.rig / far.marks) ** 2 - 1))
    advice = f"about {more} more landmarks like these" if more <= 40 else "landmarks farther away or a better survey"
    return f"not enough: {share}; {advice}", False


def located(rig: StereoRig, marks: Marks, hand_sigma: float) -> Located:
    """Positions of targets; without a mounting, in a frame whose heading and place mean nothing."""
    known = rig.mounting is not None
    return locate_points(
        rig,
        marks.left,
        marks.right,
        names=marks.names,
        pixel_sigma=hand_sigma,
        cov=marks.covariance_or(hand_sigma),
        origin=None if known else NOWHERE,
        heading_deg=None if known else 0.0,
    )
