"""How a rig ages: errors that grow with time, drift to watch, relocking, and a check by boards."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.drift import Drift, measure_drift
from kcal.calibrate.rig.sources import Features, Landmarks
from kcal.checks import as_points
from kcal.errors import DegenerateError, InputError
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, RigCovariance, StereoRig
from kcal.locate.budget import usual_ranges
from kcal.locate.geodesy import enu_from_cam
from kcal.locate.marks import Marks
from kcal.locate.mounting import attitude
from kcal.locate.stereo import PositionStatus, sight_lines
from kcal.locate.triangulate import Triangulate
from kcal.threads import in_one_thread

# What a rig that was right once still knows of its relative yaw: masts bend with the sun, and creep with time.

_PART = re.compile(r"([0-9.]+)\s*([hK])\s*:\s*([0-9.eE+-]+)")


def forgotten_yaw(*, hours: float = 0.0, per_hour: float = 0.0, kelvin: float = 0.0, per_kelvin: float = 0.0) -> float:
    """Standard deviation in degrees of the relative yaw that a rig has lost since it was solved.

    A random walk of `per_hour` degrees after an hour, which grows with the root of time, and a turn of `per_kelvin`
    degrees for each kelvin by which it is warmer or colder. Both must be known of the mast: from nights that were
    solved one after the other, or from `kcal rig check`.

    Raises:
        InputError: a negative number.

    Example:
        >>> forgotten_yaw(hours=9, per_hour=0.0004, kelvin=8, per_kelvin=0.0002)  # 0.0012 and 0.0016 degrees
        0.002
    """
    if min(hours, per_hour, kelvin, per_kelvin) < 0 or not math.isfinite(hours + per_hour + kelvin + per_kelvin):
        raise InputError("what a rig forgets: hours, kelvin and degrees from 0 on are needed")
    return math.hypot(per_hour * math.sqrt(hours), per_kelvin * kelvin)


def parse_aging(text: str | None) -> float:
    """`forgotten_yaw` of a text like 9h:0.0004,8K:0.0002; 0 for none.

    Raises:
        InputError: another text.

    Example:
        >>> parse_aging("9h:0.0004,8K:0.0002"), parse_aging("4h:0.001")
        (0.002, 0.002)
    """
    if text is None:
        return 0.0
    known: dict[str, tuple[float, float]] = {}
    for part in text.split(","):
        found = _PART.fullmatch(part.strip())
        try:
            count, unit, degrees = found.groups()  # type: ignore[union-attr]
            known[unit] = float(count), float(degrees)
        except (AttributeError, ValueError):
            raise InputError(
                f"--aged {text}: write hours and degrees in an hour, kelvin and degrees per kelvin, like "
                "9h:0.0004,8K:0.0002"
            ) from None
    (hours, per_hour), (kelvin, per_kelvin) = known.get("h", (0.0, 0.0)), known.get("K", (0.0, 0.0))
    return forgotten_yaw(hours=hours, per_hour=per_hour, kelvin=kelvin, per_kelvin=per_kelvin)


# What a drift of the cameras does to positions, in meters.


class DriftEffect(NamedTuple):
    """What an old rig makes of things that a turned one sees, (D,) meters for D distances.

    Attributes:
        distance: true range from the left camera.
        found: range by the old rig; infinite where its rays no longer meet.
        sigma: one sigma of the shift, from the covariance of the turn, to first order.
    """

    distance: Tensor
    found: Tensor
    sigma: Tensor


def drift_effect(
    old: StereoRig, new: StereoRig, turn_covariance: Tensor, distances: Sequence[float] | None = None
) -> DriftEffect:
    """Ranges that are found with the old rig after it has turned into the new one, in the direction both look.

    Args:
        old: what is believed.
        new: what is.
        turn_covariance: (3, 3) of the relative turn about the right camera's axes, radians².
        distances: meters; `usual_ranges` if left out.

    Example:
        >>> from kcal.lens import rotation_from_vector
        >>> from kcal.rig import planned_rig
        >>> old = planned_rig()
        >>> turn = rotation_from_vector(torch.tensor([0.0, 1.745329e-4, 0.0]).double())  # 0.01°
        >>> new = StereoRig(old.left, old.right, turn, turn @ old.right_from_left_translation)
        >>> [round(value) for value in drift_effect(old, new, torch.zeros(3, 3).double()).found.tolist()]
        [251, 1018, 5478]
    """
    far = torch.tensor(usual_ranges(old) if distances is None else list(distances), dtype=torch.float64)
    if not bool(((far > 0) & torch.isfinite(far)).all()):
        raise InputError("distances: positive numbers of meters are needed")
    with torch.no_grad():
        axis = new.right_from_left_rotation[2] + new.right_from_left_rotation.new_tensor([0.0, 0.0, 1.0])
        points = far[:, None] * axis / torch.linalg.vector_norm(axis)
        left, right, seen = new(points)
        if not bool(seen.all()):
            raise InputError("the cameras do not look the same way: the effect of a drift cannot be computed")
        lines = sight_lines(old, left, right)
        found = torch.linalg.vector_norm(lines.points, dim=-1)
        # Turning the right camera by ω about its x, y, z moves a point's image; the range follows the disparity.
        slope = [_range_slope(old, new, points, far, k) for k in range(3)]
    rows = torch.stack(slope, -1)
    sigma = (rows @ turn_covariance * rows).sum(-1).clamp_min(0.0).sqrt()
    return DriftEffect(far, torch.where(lines.status == int(PositionStatus.OK), found, math.inf), sigma)


def _range_slope(old: StereoRig, new: StereoRig, points: Tensor, far: Tensor, axis: int) -> Tensor:
    """Meters of range by a radian about one axis of the right camera."""
    ends = []
    for sign in (-1.0, 1.0):
        turn = rotation_from_vector(sign * 1e-8 * torch.eye(3, dtype=torch.float64)[axis])
        rig = StereoRig(
            new.left, new.right, turn @ new.right_from_left_rotation, turn @ new.right_from_left_translation
        )
        left, right, _ = rig(points)
        ends.append(torch.linalg.vector_norm(sight_lines(new, left, right).points, dim=-1))
    return (ends[1] - ends[0]) / 2e-8


# Check whether a solved rig has turned, and correct it.


def check_rig(rig: StereoRig, *, features: Features | None = None, landmarks: Landmarks | None = None) -> Drift:
    """Measure how the cameras have turned (`measure_drift`) with what the rig knows of itself.

    Its mounting gives the left camera's pose for landmarks, and its covariance says how well the attitudes were known.

    Args:
        rig: as it was solved, with its `covariance` and, for landmarks, its `mounting`.
        features: see `measure_drift`.
        landmarks: see `measure_drift`; in the frame of `rig.mounting.origin`.

    Raises:
        InputError: nothing to measure with, or landmarks for a rig without mounting.
        DegenerateError: too little to tell the turn.

    Example:
        >>> from kcal.rig import planned_rig
        >>> rig, rows = planned_rig(), torch.tensor([[-90.0, 2, 300], [80, -9, 250], [4, 6, 400], [30, 20, 200]])
        >>> pixels = torch.cat([torch.stack(rig(rows.double())[:2], 1)] * 2, 1)  # the same then and now
        >>> unknown = torch.zeros(4).double(), torch.full((4,), torch.inf).double()
        >>> static = Features(names=tuple("abcd"), pixels=pixels, inverse_range=unknown[0],
        ...                   inverse_range_sigma=unknown[1])
        >>> check_rig(rig, features=static).significant
        False
    """
    pose: tuple[Tensor, Tensor] | None = None
    left = torch.zeros(3, 3, dtype=torch.float64)
    refraction = REFRACTION, REFRACTION_SIGMA
    if rig.mounting is not None:
        stands = rig.mounting
        rotation = enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg).T
        pose = rotation, torch.zeros(3, dtype=torch.float64)
        if stands.covariance is not None:
            left = rotation @ stands.covariance[3:6, 3:6] @ rotation.T
            # Light that was held straight stays so; otherwise another day has another coefficient.
            straight = len(stands.covariance) == 7 and not bool(stands.covariance[6, 6])
            refraction = (
                REFRACTION if stands.refraction is None else stands.refraction,
                0.0 if straight else REFRACTION_SIGMA,
            )
    before = None if rig.covariance is None else (rig.covariance.matrix[-6:-3, -6:-3], left)
    return measure_drift(rig, features=features, landmarks=landmarks, pose=pose, before=before, refraction=refraction)


def seen_again(then: Marks, now: Marks, sigma: float) -> Features:
    """Things of unknown range that are marked in old and new images, for `check_rig`; `sigma` of a mark, pixels.

    Raises:
        InputError: no name is in both.

    Example:
        >>> pixels = torch.tensor([[10.0, 20.0], [30.0, 40.0]], dtype=torch.float64)
        >>> found = seen_again(Marks(("a", "b"), pixels, pixels), Marks(("b", "c"), pixels, pixels), 0.3)
        >>> found.names, found.pixels[0].tolist()
        (('b',), [[30.0, 40.0], [30.0, 40.0], [10.0, 20.0], [10.0, 20.0]])
    """
    common = tuple(name for name in then.names if name in now.names)
    if not common:
        raise InputError("no name is in both files of marks; give the same things the same names")
    pixels = [marks.pixels[[marks.names.index(name) for name in common]] for marks in (then, now)]
    unknown = torch.zeros(len(common), dtype=torch.float64)
    return Features(
        names=common,
        pixels=torch.cat(pixels, 1),
        inverse_range=unknown,
        inverse_range_sigma=torch.full_like(unknown, torch.inf),
        pixel_sigma=sigma,
    )


@in_one_thread
def relocked(rig: StereoRig, drift: Drift, note: str) -> StereoRig:
    """The rig with the attitudes that `check_rig` found; cameras and their places stay.

    The covariance of the drift is added to that of the rig: the errors of the first solution are still in it, and those
    of the check come on top. A rig that counted as exact has the latter alone.

    Args:
        rig: the rig as it was solved.
        drift: what was found.
        note: when and from what, for the record.

    Example:
        >>> from kcal.rig import planned_rig
        >>> rig, rows = planned_rig(), torch.tensor([[-90.0, 2, 300], [80, -9, 250], [4, 6, 400], [30, 20, 200]])
        >>> pixels = torch.cat([torch.stack(rig(rows.double())[:2], 1)] * 2, 1)
        >>> unknown = torch.zeros(4).double(), torch.full((4,), torch.inf).double()
        >>> static = Features(names=tuple("abcd"), pixels=pixels, inverse_range=unknown[0],
        ...                   inverse_range_sigma=unknown[1])
        >>> bool(relocked(rig, check_rig(rig, features=static), "Monday").baseline == rig.baseline)
        True
    """
    new = StereoRig(rig.left, rig.right, drift.rig.right_from_left_rotation, drift.rig.right_from_left_translation)
    new.covariance = (rig.covariance or RigCovariance.of(rig)).with_pose(drift.pose_covariance)
    new.mounting = rig.mounting
    if rig.mounting is not None and drift.cam_from_local is not None and drift.left_covariance is not None:
        rotation, covariance = drift.cam_from_local, rig.mounting.covariance
        heading, pitch, roll = attitude(rotation.T)
        if covariance is not None:
            covariance = covariance.clone()
            covariance[3:6, 3:6] += rotation.T @ drift.left_covariance @ rotation
        new.mounting = dataclasses.replace(
            rig.mounting, heading_deg=heading, pitch_deg=pitch, roll_deg=roll, covariance=covariance
        )
    if rig.calibration is not None:
        new.calibration = dataclasses.replace(rig.calibration, relocked=note, baseline_m=float(new.baseline))
    return new


# A check anyone can understand: do the squares of the board come out as large as they are?


class Sides(NamedTuple):
    """Triangulated distances between neighboring corners, meters: their mean and standard deviation."""

    mean: float
    spread: float


def triangulated_sides(rig: StereoRig, columns: int, rows: int, pixels: Tensor, points: Tensor | None = None) -> Sides:
    """Triangulate every corner of boards seen by both cameras and measure the sides of the squares.

    Args:
        rig: the rig to check.
        columns: inner corners in a row.
        rows: inner corners in a column.
        pixels: (P, 2, columns * rows, 2) corners of P pairs, left and right, row by row; NaN where not seen.
        points: (columns * rows, 3) of a board whose sides differ, such as an AprilGrid: each side then counts as that
            of its first two points, if it has the right length. All sides are alike if not given.

    Returns:
        Mean and standard deviation over all sides whose two corners were seen by both cameras.

    Raises:
        InputError: a shape that does not fit.
        DegenerateError: no side could be triangulated.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> corners = torch.tensor([[0, 0, 5], [0.1, 0, 5], [0, 0.1, 5], [0.1, 0.1, 5]], dtype=torch.float64)
        >>> left, right, _ = rig(corners)
        >>> round(triangulated_sides(rig, 2, 2, torch.stack([left, right])[None]).mean, 9)
        0.1
    """
    pixels = as_points("pixels", pixels, 2)
    if pixels.ndim != 4 or pixels.shape[1:3] != (2, columns * rows):
        raise InputError(f"pixels: shape (P, 2, {columns * rows}, 2) is needed, got {tuple(pixels.shape)}")
    known = None if points is None else as_points("points", points, 3)
    if known is not None and known.shape != (columns * rows, 3):
        raise InputError(f"points: shape ({columns * rows}, 3) is needed, got {tuple(known.shape)}")
    located = Triangulate(rig)(pixels[:, 0], pixels[:, 1])
    points = torch.where((located.status == PositionStatus.OK)[..., None], located.points, torch.nan)
    sides = _grid_sides(points, columns, rows)
    if known is not None:
        ordered = _grid_sides(known[None], columns, rows)
        sides = sides / ordered * ordered[:, :1]
    sides = sides[torch.isfinite(sides)]
    if len(sides) < 2:
        raise DegenerateError("no side of a square could be triangulated")
    return Sides(float(sides.mean()), float(sides.std()))


def _grid_sides(points: Tensor, columns: int, rows: int) -> Tensor:
    """Distances (P, S) of neighbors along rows, then along columns, of points (P, rows * columns, 3)."""
    grid = points.unflatten(1, (rows, columns))
    steps = [(grid[:, :, 1:] - grid[:, :, :-1]).flatten(1, 2), (grid[:, 1:] - grid[:, :-1]).flatten(1, 2)]
    return torch.linalg.vector_norm(torch.cat(steps, 1), dim=-1)
