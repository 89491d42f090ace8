"""Range errors of a rig: before it is built, by what is known of one that is solved, and against known ranges."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points, chi2_tail
from kcal.errors import FileError, InputError
from kcal.finding import Finding
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import Rig
from kcal.locate.localizer import Localizer
from kcal.locate.marks import COVARIANCE, PIXELS, Marks, read_marks
from kcal.locate.max_likelihood import calibration_effect
from kcal.locate.mounting import by_mounting
from kcal.locate.stereo import BEARING_SIGMAS, QUANTILE, Localization, PositionStatus, checked_rig, sight_lines
from kcal.locate.tables import TableRow, header_of, read_rows
from kcal.locate.views import fit_pairs
from kcal.texts import brief, briefly
from kcal.threads import in_one_thread

# Range errors of a rig before it is built, and with the covariance of one that is solved.

# What a stereo rig will do before it is built: range errors against distance, exactly and not to first order.
#
# The paper's Table 2 has ΔZ = Z² Δd / (f B), the slope at the true point. At long range an error is not small: of 3.2
# px of disparity at 5 km, 2 px too few put the point 8.3 km farther out, 2 px too many 1.9 km nearer; the slope says
# 3.1 km for both. Here the rays are moved by each error and intersected again.


@dataclasses.dataclass(frozen=True, kw_only=True)
class BudgetErrors:
    """One error of each kind; each is applied alone, with either sign.

    Args:
        disparity_px: of the match: one mark shifted along the epipolar line.
        yaw_deg: relative yaw, a turn of the right camera about its y axis.
        baseline_m: length of the baseline.
        timing_s: how far apart the two images were taken.
        speed_mps: how fast the target crosses the view meanwhile, to the right.
    """

    disparity_px: float = 0.1
    yaw_deg: float = 0.01
    baseline_m: float = 0.001
    timing_s: float = 0.01
    speed_mps: float = 20.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not 0 <= getattr(self, field.name) < math.inf:
                raise InputError(f"{field.name}: a number that is not negative is needed")


@briefly
class RangeError(NamedTuple):
    """Change of the range in meters, (D,) for D distances: nearer is negative; infinite where the rays diverge.

    Attributes:
        nearer: by the sign of the error that brings the point nearer.
        farther: by the other sign.
        first_order: by the slope at the true point, as in the paper's Table 2.
    """

    nearer: Tensor
    farther: Tensor
    first_order: Tensor


def planned_rig(*, focal_px: float = 1600.0, baseline_m: float = 10.0, size: tuple[int, int] = (1920, 1080)) -> Rig:
    """Two equal pinhole cameras side by side that look the same way: what Table 2 assumes.

    Example:
        >>> float(planned_rig().baseline)
        10.0
    """
    if not 0 < baseline_m < math.inf:
        raise InputError(f"baseline {baseline_m}: a positive number of meters is needed")
    center = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    camera = Camera.build(focal=(focal_px, focal_px), center=center, size=size, model="pinhole")
    shift = torch.tensor([-baseline_m, 0.0, 0.0], dtype=torch.float64)
    return Rig.pair(camera, camera, torch.eye(3, dtype=torch.float64), shift)


@in_one_thread
def range_errors(
    rig: Rig,
    distances: Tensor | Sequence[float],
    errors: BudgetErrors | None = None,
    *,
    pixel: Sequence[float] | None = None,
) -> dict[str, RangeError]:
    """Range errors of a rig by source: "disparity", "yaw", "baseline", "timing".

    Args:
        rig: planned or calibrated.
        distances: (D,) true ranges from the left camera, meters.
        errors: what to apply.
        pixel: where in the left image; the direction in which both cameras' axes look, if left out.

    Raises:
        InputError: a distance that is not positive or that the right camera does not see.

    Example:
        >>> found = range_errors(planned_rig(), [5000.0], BudgetErrors(disparity_px=2.0))["disparity"]
        >>> [round(float(value[0])) for value in found]
        [-1923, 8333, 3125]
    """
    errors, rig = errors or BudgetErrors(), in_left_frame(rig)
    far, points, left, right = points_at(rig, distances, pixel)
    ray = points[0] / far[0]
    with torch.no_grad():
        across = _crossing(rig, ray)
        # In which a point moves in the right image as it comes nearer.
        nearer = rig(points * (1.0 - 1e-4))[0][..., 1, :] - rig.right.project(rig.right_from_left(points))[0]
        along = nearer / torch.linalg.vector_norm(nearer, dim=-1, keepdim=True)
        moved = {
            "disparity": lambda s: (rig, right + s * errors.disparity_px * along),
            "yaw": lambda s: (right_turned(rig, far.new_tensor([0.0, s * math.radians(errors.yaw_deg), 0.0])), right),
            "baseline": lambda s: (_stretched(rig, s * errors.baseline_m), right),
            "timing": lambda s: (rig, rig(points + s * across * errors.timing_s * errors.speed_mps)[0][..., 1, :]),
        }
        found = {}
        for name, move in moved.items():
            # With a millionth of the error, too: far from rounding, and no longer curved.
            *ends, low, high = (measured_ranges(*move(sign), left) for sign in (-1.0, 1.0, -1e-5, 1e-5))
            changes = [end - far for end in ends]
            found[name] = RangeError(torch.minimum(*changes), torch.maximum(*changes), (high - low).abs() / 2e-5)
    return found


@torch.no_grad()
def points_at(
    rig: Rig, distances: Tensor | Sequence[float], pixel: Sequence[float] | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points in one direction at several ranges: ranges (D,), points (D, 3) in the rig frame, left and right pixels.

    Args:
        rig: the rig.
        distances: (D,) from the left camera, meters.
        pixel: where in the left image; the direction in which both cameras' axes look, if left out.

    Raises:
        InputError: a distance that is not positive, or a point that the right camera does not see.
    """
    far = torch.as_tensor(distances, dtype=torch.float64).reshape(-1)
    if not len(far) or not bool(((far > 0) & torch.isfinite(far)).all()):
        raise InputError("distances: positive numbers of meters are needed")
    points = far[:, None] * _direction(rig, pixel)
    pixels, seen = rig(points)
    (left, right), good = pixels.unbind(-2), seen.all(-1)
    if not bool(good.all()):
        raise InputError(f"the rig does not see a point at {float(far[~good][0]):g} m there; choose another pixel")
    return far, points, left, right


def measured_ranges(rig: Rig, right: Tensor, left: Tensor) -> Tensor:
    """Ranges from the left camera by pixels (N, 2); infinite where the rays do not meet ahead."""
    lines = sight_lines(rig, left, right)
    distance = torch.linalg.vector_norm(lines.points, dim=-1)
    return torch.where(lines.status == int(PositionStatus.OK), distance, math.inf)


def _direction(rig: Rig, pixel: Sequence[float] | None) -> Tensor:
    if pixel is not None:
        place = as_points("pixel", torch.tensor([list(map(float, pixel))], dtype=torch.float64), 2)
        rays, valid = rig.left.unproject(place)
        if not bool(valid.all() & rig.left.inside(place).all()):
            raise InputError(f"pixel {tuple(pixel)}: not in the image, or the lens has no ray there")
        return rays[0]
    both = rig.right_from_left_rotation[2] + rig.right_from_left_rotation.new_tensor([0.0, 0.0, 1.0])
    return both / torch.linalg.vector_norm(both)


def _crossing(rig: Rig, ray: Tensor) -> Tensor:
    """Unit vector along the baseline, across the line of sight: motion along it looks like disparity."""
    center = -rig.right_from_left_translation @ rig.right_from_left_rotation
    across = center - (center @ ray) * ray
    length = torch.linalg.vector_norm(across)
    if not float(length) > 0:
        raise InputError("the view runs along the baseline: no range can be measured there")
    return across / length


def in_left_frame(rig: Rig) -> Rig:
    """Two cameras in the left one's frame, with the errors of lenses and relative pose; not where that one stands."""
    if rig.is_pair:
        return rig
    pair = Rig.pair(rig.left, rig.right, rig.right_from_left_rotation, rig.right_from_left_translation)
    pair.covariance = rig.covariance
    return pair


def right_turned(rig: Rig, vector: Tensor) -> Rig:
    """The rig with its right camera turned about its own axes by a rotation vector (3,), radians."""
    turn = rotation_from_vector(vector)
    # About its own center: the center stays where it is.
    return Rig.pair(rig.left, rig.right, turn @ rig.right_from_left_rotation, turn @ rig.right_from_left_translation)


def _stretched(rig: Rig, more: float) -> Rig:
    scale = 1.0 + more / float(rig.baseline)
    if scale <= 0:
        raise InputError("baseline_m: the error is larger than the baseline")
    return Rig.pair(rig.left, rig.right, rig.right_from_left_rotation, scale * rig.right_from_left_translation)


# How uncertain ranges of a solved rig are, by what to improve: marks, lenses, relative pose; and the mounting.

# Singular values of the lenses' errors below this share of the largest are rounding.
_ROUNDING = 1e-6


class RangeSigmas(NamedTuple):
    """Standard deviations in meters, (D,) each; marks² + lenses² + pose² = total².

    Attributes:
        distance: true range from the left camera.
        marks: from noise in the marks of one pair.
        lenses: from errors of both lenses, with what the relative pose makes up for: what exact lenses would gain.
        pose: from errors of the relative pose that would remain if both lenses were known exactly.
        total: of the range.
        ranged: (D,) bool: whether a range can be told at all, the parallax being three of its sigmas.
        sideways: level and across the line of sight, from errors of the mounting, which do not change ranges.
    """

    distance: Tensor
    marks: Tensor
    lenses: Tensor
    pose: Tensor
    total: Tensor
    ranged: Tensor
    sideways: Tensor


def usual_ranges(rig: Rig, baselines: Sequence[float] = (25.0, 100.0, 500.0)) -> list[float]:
    """Ranges at which a rig is near, usual and far: about so many baselines, as round numbers of meters.

    Example:
        >>> from kcal.rig import planned_rig
        >>> usual_ranges(planned_rig())
        [250.0, 1000.0, 5000.0]
    """
    return [_round_number(count * float(rig.baseline)) for count in baselines]


def _round_number(meters: float) -> float:
    """The nearest of 1, 2.5, 5, 10, 25 and so on, by ratio."""
    decade = 10.0 ** math.floor(math.log10(meters))
    return min((decade * k for k in (1.0, 2.5, 5.0, 10.0)), key=lambda number: abs(math.log(number / meters)))


def range_sigmas(
    rig: Rig,
    distances: Tensor | Sequence[float] | None = None,
    *,
    pixel_sigma: float | None = None,
    pixel: Sequence[float] | None = None,
) -> RangeSigmas:
    """Split the standard deviation of ranges by its sources.

    Errors of lenses and relative pose are correlated: a pose that was solved makes up for most of what the lenses have
    wrong. So the variance of both together is split into what would remain with exact lenses, which better landmarks or
    far features reduce, and the rest, which better calibrated cameras reduce.

    Args:
        rig: with its `covariance` and `mounting`; where one is None, its part is 0.
        distances: (D,) ranges from the left camera, meters; `usual_ranges` if left out.
        pixel_sigma: of a mark along each axis, px; if left out, as in `Localizer`.
        pixel: where in the left image; the direction in which both cameras' axes look, if left out.

    Raises:
        InputError: a distance that is not positive or that the right camera does not see.

    Example:
        >>> from kcal.rig import RigCovariance, planned_rig
        >>> rig = planned_rig()
        >>> yaw = torch.zeros(6, 6, dtype=torch.float64)
        >>> yaw[1, 1] = torch.deg2rad(torch.tensor(0.001)) ** 2
        >>> rig.covariance = RigCovariance.of(rig, pose=yaw)
        >>> found = range_sigmas(rig, [5000.0], pixel_sigma=0.1)
        >>> [round(float(part)) for part in (found.marks, found.lenses, found.pose, found.total)]
        [221, 0, 44, 225]
    """
    variance, rig = checked_rig(rig, pixel_sigma) ** 2, in_left_frame(rig)
    far, points, left, right = points_at(rig, usual_ranges(rig) if distances is None else distances, pixel)
    with torch.no_grad():
        found = fit_pairs(rig, left, right, by_camera=rig.covariance is not None)
        # Meters of range by the fit's inverse distance.
        slope = far.square() / (found.scale * found.length)
        marks = slope * (variance * found.fit.covariance[5]).sqrt()
        lenses = pose = sideways = torch.zeros_like(far)
        if rig.covariance is not None:
            factor = rig.covariance.half.T
            effect = slope[:, None] * calibration_effect(found.fit, found.scale, factor)[2].mT
            lenses = (effect @ row_space(factor[:-6])).norm(dim=-1)
            pose = (effect.square().sum(-1) - lenses.square()).clamp_min(0.0).sqrt()
        stands = rig.mounting
        if stands is not None and stands.covariance is not None:
            enu = points @ stands.enu_from_cam.T
            level = torch.nn.functional.normalize(enu[:, :2], dim=-1)
            across = torch.stack([level[:, 1], -level[:, 0], torch.zeros_like(far)], -1)
            rows = (across[:, None] @ by_mounting(enu))[:, 0]
            sideways = (rows @ stands.covariance[:6, :6] * rows).sum(-1).sqrt()
    total = torch.stack([marks, lenses, pose]).norm(dim=0)
    return RangeSigmas(far, marks, lenses, pose, total, total * BEARING_SIGMAS <= far, sideways)


def row_space(matrix: Tensor) -> Tensor:
    """(K, R) orthonormal basis of the rows of a matrix (P, K), whose rows may have any units."""
    length = matrix.norm(dim=-1, keepdim=True)
    _, values, rows = torch.linalg.svd(matrix / torch.where(length > 0, length, 1.0), full_matrices=False)
    return rows[values > _ROUNDING * values[:1].sum()].T


# How uncertain positions of a rig of any number of cameras are at a distance, by what to improve.

# Where along the middle row of each image, as shares of its width.
_PLACES = (0.2, 0.35, 0.5, 0.65, 0.8)


@torch.no_grad()
def station_sigmas(rig: Rig, distance: float, *, pixel_sigma: float | None = None) -> RangeSigmas | None:
    """Split the standard deviation of ranges from each camera by its sources, where it is worst.

    Looked at are points at a distance from each camera, along the middle row of its image, that another camera sees
    too. Marks, lenses and poses are told apart as by `range_sigmas`; the poses are those of all
    cameras, and `sideways` is zero.

    Args:
        rig: with its `root`; None: lenses and poses count as exact.
        distance: meters.
        pixel_sigma: of a mark along each axis, px; if left out, as in `Localizer`.

    Returns:
        the worst place, (1,) each; None where no two cameras see the same at this distance.

    Raises:
        InputError: a distance that is not positive.

    Example:
        >>> from kcal import Camera
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> look = enu_from_cam(0.0).T.repeat(3, 1, 1)
        >>> rig = Rig([camera] * 3, ["a", "b", "c"], look, center=torch.tensor([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]]))
        >>> found = station_sigmas(rig, 1000.0, pixel_sigma=0.1)
        >>> round(float(found.total), 1), bool(found.ranged)
        (4.4, True)
    """
    if not 0.0 < distance < float("inf"):
        raise InputError(f"distance {distance}: a positive number of meters is needed")
    points, rays = _points_before(rig, distance)
    pixels, seen = rig(points)
    some = seen.sum(-1) > 1
    pixels, seen, rays = pixels[some], seen[some], rays[some]
    if not len(pixels):
        return None
    root = torch.zeros(1, rig.quantities, dtype=torch.float64) if rig.root is None else rig.root
    within = row_space(root[:, : sum(rig.sizes)].T)
    # With exact lenses, what their errors have in common with the poses is known too.
    exact = root - within @ (within.T @ root)
    roots = torch.zeros_like(root), exact, root
    found = (Localizer(rig, weights="all", pixel_sigma=pixel_sigma, root=known)(pixels, seen) for known in roots)
    marks, without, total = (_range_sigma(one, rays, distance) for one in found)
    worst = total.nan_to_num(nan=torch.inf).argmax()
    total, marks, without = (value[worst][None] for value in (total, marks, without))
    pose = (without.square() - marks.square()).clamp_min(0.0).sqrt()
    by_lenses = (total.square() - without.square()).clamp_min(0.0).sqrt()
    far = torch.full_like(total, distance)
    return RangeSigmas(far, marks, by_lenses, pose, total, total * BEARING_SIGMAS <= far, torch.zeros_like(total))


def _points_before(rig: Rig, distance: float) -> tuple[Tensor, Tensor]:
    """(N, 3) places at a distance from each camera, along the middle row of its image, and their rays (N, 3)."""
    points, all_rays = [], []
    for camera, turn, center in zip(rig.each, rig.rotation, rig.center, strict=True):
        width, height = camera.size
        pixels = torch.tensor([[share * width, 0.5 * height] for share in _PLACES], dtype=torch.float64)
        rays, valid = camera.unproject(pixels)
        all_rays.append((rays / rays.norm(dim=-1, keepdim=True))[valid] @ turn)
        points.append(center + distance * all_rays[-1])
    return torch.cat(points), torch.cat(all_rays)


def _range_sigma(found: Localization, rays: Tensor, distance: float) -> Tensor:
    """(N,) meters along rays (N, 3); by the inverse range of what has a bearing only; infinite if unknown."""
    ok = found.status == int(PositionStatus.OK)
    along = (rays * (torch.where(ok[:, None, None], found.covariance, 0.0) @ rays[..., None])[..., 0]).sum(-1).sqrt()
    weak = torch.where(found.inverse_range_sigma > 0, distance**2 * found.inverse_range_sigma, torch.inf)
    return torch.where(ok, along, weak)


# Located points against known ranges: whether the intervals are true jointly, and what explains it if they are not.

# Ranges that are this much too long or too short for most are no error of a calibration, but of a unit or a place.
_ABSURD = 3.0
_COLUMNS = ("range", "range_sigma")
_HEADER = "name,left_u,left_v,right_u,right_v,range,range_sigma"
# -2 log likelihood by which one cause is clearly likelier than another, and what it leaves unexplained.
_CLEAR, _UNLIKELY = 4.0, 0.01
# Of noise, times what was stated.
_TIMES = torch.logspace(0.0, 2.0, 101, dtype=torch.float64)


class KnownRanges(NamedTuple):
    """Marks of two cameras, and how far the N points are from the left one: meters, (N,) each."""

    marks: Marks
    ranges: Tensor
    sigmas: Tensor


class Cause(NamedTuple):
    """One explanation of all errors, in place of those that the rig states.

    Attributes:
        name: "yaw": the right camera is turned in the plane of baseline and view, degrees; "scale": the baseline is
            longer by a share; "noise": marks are noisier than stated, times.
        amount: the most likely error of the rig: its yaw or its baseline is too large by that.
        sigma: of the amount, with what the rig states of it; NaN for noise.
        sigmas: the root of what it takes off -2 log likelihood: how far it is from what the rig states.
        probability: of errors that large or larger once it is taken into account.
    """

    name: str
    amount: float
    sigma: float
    sigmas: float
    probability: float

    @property
    def text(self) -> str:
        """In words."""
        if self.name == "noise":
            return f"marks {self.amount:.2g} times as noisy as stated ({self.sigmas:.1f} sigma)"
        what, unit, times = ("yaw", "°", 1.0) if self.name == "yaw" else ("length of the baseline", " %", 100.0)
        return f"{what} off by {times * self.amount:+.2g} ± {times * self.sigma:.2g}{unit} ({self.sigmas:.1f} sigma)"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RangeCheck:
    """Result of `check_ranges` for N points.

    Args:
        names: of the points.
        known: (N,) meters from the left camera.
        measured: (N,) by the rig; infinite where the lines of sight do not meet.
        low: (N,) of the 95 % interval of the difference, as a range that would agree.
        high: (N,) its other end.
        pulls: (N,) errors of one over the range, each over its own sigma; positive where it is measured too short.
        chi2: of all errors jointly, with their covariance.
        probability: of one that large or larger if the intervals are true.
        common: probability of the part of the errors that a yaw and a scale make, as large or larger.
        rest: that of all others; NaN for fewer than three points.
        causes: yaw, scale and noise, the likeliest first.
        findings: one "stop" if the intervals are not true, none otherwise.
    """

    __repr__ = brief

    names: tuple[str, ...]
    known: Tensor
    measured: Tensor
    low: Tensor
    high: Tensor
    pulls: Tensor
    chi2: float
    probability: float
    common: float
    rest: float
    causes: tuple[Cause, ...]
    findings: tuple[Finding, ...]

    @property
    def true(self) -> bool:
        """Whether the intervals agree with the known ranges."""
        return not self.findings

    @property
    def text(self) -> str:
        """The answer, in words."""
        count = len(self.names)
        agree = f"known ranges agree with the stated intervals: χ² {self.chi2:.3g} of {count} points (probability "
        return self.findings[0].sentence if self.findings else f"{agree}{self.probability:.2g})"


@torch.no_grad()
def check_ranges(
    rig: Rig, marks: Marks, ranges: Tensor, sigmas: Tensor, *, pixel_sigma: float | None = None, level: float = 0.05
) -> RangeCheck:
    """Compare a rig's ranges with known ones, jointly, and say whether yaw, scale or noise explains the errors.

    All points share the errors of the rig: with a yaw that is off by two sigma all ranges are, and one by one none of
    them tells more than another. So errors of one over the range, which are Gaussian, are compared with their full
    covariance: of marks, known ranges, and the rig. Their χ² has two independent parts, the one that a turn of the
    right camera and another length of the baseline would make, and the rest. Each is tested so that a rig with true
    intervals fails in `level` of all cases.

    Args:
        rig: of two cameras; without a covariance it counts as exact.
        marks: of N points in both images; their covariance, where stated, replaces `pixel_sigma`.
        ranges: (N,) meters from the left camera.
        sigmas: (N,) meters, standard deviations of these; independent of each other.
        pixel_sigma: of a mark along an axis, px; if left out, as in `Localizer`.
        level: share of rigs with true intervals that fail.

    Raises:
        InputError: no points, shapes that are wrong, ranges that are not positive and finite, a mark outside the image,
            or ranges that are of another place or unit.

    Source: generalized least squares with one parameter for each cause; causes are compared by their likelihood.

    Example:
        >>> from kcal.rig import RigCovariance, planned_rig
        >>> rig = planned_rig()
        >>> sigma = torch.tensor([0, 1e-4, 0, 0, 0, 0], dtype=torch.float64)  # of the yaw: 0.006°
        >>> rig.covariance = RigCovariance.of(rig, pose=torch.diag(sigma**2))
        >>> known = torch.tensor([500.0, 800.0, 1200.0], dtype=torch.float64)
        >>> left, right = rig(known[:, None] * torch.tensor([[0.0, 0.0, 1.0]]).double())[0].unbind(-2)
        >>> right = right - torch.tensor([0.8, 0.0]).double()  # px: as a yaw that is off by 0.029° would
        >>> found = check_ranges(rig, Marks.of_pair("abc", left, right), known, 0.01 * known, pixel_sigma=0.1)
        >>> found.true, found.causes[0].name, round(found.causes[0].amount, 3)
        (False, 'yaw', 0.029)
    """
    mark_sigma = checked_rig(rig, pixel_sigma)
    if len(rig) != 2:
        raise InputError(f"check_ranges: a rig of two cameras is needed, this one has {len(rig)}")
    names, pixels = tuple(marks.names), as_points("marks", marks.pixels, 2, rig.center)
    ranges, sigmas = (torch.as_tensor(value, dtype=torch.float64) for value in (ranges, sigmas))
    if not names or not (ranges.shape == sigmas.shape == (len(names),)):
        raise InputError(f"ranges and sigmas: one number for each of {len(names)} points is needed")
    if not bool((torch.isfinite(ranges) & (ranges > 0) & torch.isfinite(sigmas) & (sigmas > 0)).all()):
        raise InputError("ranges and sigmas: positive finite meters are needed")
    if not bool((3.0 * sigmas < ranges).all()):
        raise InputError("sigmas: a range with a sigma of a third of it or more checks nothing; are both in meters?")
    if not 0.0 < level < 1.0:
        raise InputError(f"level: a share between 0 and 1 is needed, got {level}")
    stated = marks.covariance_or(mark_sigma)
    found = fit_pairs(rig, pixels[:, 0], pixels[:, 1], stated, noise=mark_sigma, by_camera=True)
    for name, status, fine in zip(names, found.status.tolist(), found.fitted.tolist(), strict=True):
        if not fine:
            raise InputError(f"{name}: {PositionStatus(status).name}: its marks give no range; correct or delete them")
    unit = found.scale * found.length
    inverse, error = found.fit.inverse / unit, found.fit.inverse / unit - 1.0 / ranges
    # What marks, known ranges and the rig do to it.
    noise = found.variance * found.fit.covariance[5] / unit.square()
    own = (sigmas / ranges.square()).square()
    effect = calibration_effect(found.fit, found.scale, _rig_errors(rig))[2].mT / unit[:, None]
    shared, slopes = effect[:, :-2], dict(zip(("yaw", "scale"), effect[:, -2:].T, strict=True))

    def covariance(times: Tensor) -> Tensor:
        return torch.diag_embed(times.square()[:, None] * noise + own) + shared @ shared.T

    whole = covariance(_TIMES[:1])[0]
    # In units of their sigmas, and independent.
    both = torch.stack([error, *slopes.values()], 1)
    unexplained, *weighed = torch.linalg.solve_triangular(torch.linalg.cholesky(whole), both, upper=False).T
    chi2 = float(unexplained.square().sum())
    plane = torch.linalg.qr(torch.stack(weighed, 1))[0]
    part = float((plane.T @ unexplained).square().sum())
    degrees, others = plane.shape[1], len(names) - plane.shape[1]
    common = float(chi2_tail(part, degrees))
    rest = float(chi2_tail(chi2 - part, others)) if others else math.nan
    chance = min(common, rest) if others else common
    causes = [_shift(name, unexplained, slope) for name, slope in zip(slopes, weighed, strict=True)]
    causes.append(_noisier(covariance, error))
    causes.sort(key=lambda cause: -cause.sigmas)
    deviation = whole.diagonal().sqrt()
    ends = (inverse + QUANTILE * deviation, inverse - QUANTILE * deviation)
    measured, low, high = (torch.where(value > 0, 1.0 / value, math.inf) for value in (inverse, *ends))
    smallest = 1.0 - (1.0 - level) ** (0.5 if others else 1.0)
    findings = []
    if chance < smallest:
        ratio = float((inverse * ranges).median())
        if not 1.0 / _ABSURD < ratio < _ABSURD and bool((error.abs() > 10.0 * deviation).all()):
            raise InputError(
                f"ranges by the rig are {1.0 / ratio if ratio > 0 else math.inf:.3g} times the known ones: are these "
                "meters from the left camera, and of the same points?"
            )
        findings.append(_contradiction(causes, chance))
    return RangeCheck(
        names=names, known=ranges, measured=measured, low=low, high=high, pulls=error / deviation, chi2=chi2,
        probability=float(chi2_tail(chi2, len(names))), common=common, rest=rest, causes=tuple(causes),
        findings=tuple(findings),
    )  # fmt: skip


def _rig_errors(rig: Rig) -> Tensor:
    """(P, K + 2) what errors of a rig change in its parameters: K that it states, a turn by 1°, a longer baseline."""
    stated = rig.covariance.half.T if rig.covariance else rig.center.new_zeros(sum(rig.sizes) + 6, 0)
    shift, right = rig.right_from_left_translation, rig.right_from_left_rotation
    # The turn in the plane of the baseline and what both cameras look at, about the right camera's own center.
    axis = torch.linalg.cross(right[:, 2] + right.new_tensor([0.0, 0.0, 1.0]), shift)
    axis = -math.radians(1.0) * axis / axis.norm()
    axis = axis if float(axis[axis.abs().argmax()]) > 0 else -axis
    steps = torch.stack([torch.cat([axis, torch.linalg.cross(axis, shift)]), torch.cat([0.0 * shift, shift])], 1)
    return torch.cat([stated, torch.nn.functional.pad(steps, (0, 0, len(stated) - 6, 0))], 1)


def _shift(name: str, error: Tensor, slope: Tensor) -> Cause:
    """The most likely amount of a shift, of errors in units of their sigmas."""
    fall = float(error @ slope) ** 2 / float(slope.square().sum())
    amount, sigma = float(error @ slope) / float(slope.square().sum()), float(slope.norm()) ** -1
    return Cause(name, amount, sigma, math.sqrt(fall), float(chi2_tail(error.square().sum() - fall, len(error) - 1)))


def _noisier(covariance: Callable[[Tensor], Tensor], error: Tensor) -> Cause:
    """The most likely noise of marks, not below the stated one, and what it takes off -2 log likelihood."""
    root = torch.linalg.cholesky(covariance(_TIMES))
    squares = torch.linalg.solve_triangular(root, error[:, None], upper=False).square().sum((-2, -1))
    costs = squares + 2.0 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    best = int(costs.argmin())
    fall = math.sqrt(float(costs[0] - costs[best]))
    return Cause("noise", float(_TIMES[best]), math.nan, fall, float(chi2_tail(squares[best], len(error))))


_CURES = {
    "yaw": "solve the rig again with these points as features with a range, or with other features far away",
    "scale": "measure the baseline again, and check the known ranges' unit and origin",
    "noise": "state the noise of marks (--pixel-sigma), or mark again what is farthest off",
}


def _contradiction(causes: Sequence[Cause], chance: float) -> Finding:
    """What is off, and what explains it best."""
    best, other = causes[:2]
    text = f"the intervals contradict the known ranges (probability {chance:.1g}); best explained by {best.text}"
    if best.sigmas**2 - other.sigmas**2 < _CLEAR:
        text += f", or nearly as well by {other.text}"
    if best.probability < _UNLIKELY:
        text += f", which does not explain all (probability of the rest {best.probability:.1g})"
    return Finding("ranges", "stop", text, _CURES[best.name])


def read_known_ranges(path: str | Path, marks: str | Path | None = None) -> KnownRanges:
    r"""Read known ranges: name,range,range_sigma in meters from the left camera, with marks in both images.

    The columns of marks, as of `read_marks`, stand in the same table, or in one of their own, in which the names are
    looked up.

    Raises:
        FileError: see `read_marks`; a range without its sigma; a name that has no marks, or marks in both tables.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "known.csv")
        ...     _ = path.write_text("left_u,left_v,right_u,right_v,range,range_sigma\n960,540,952,540,2000,20\n")
        ...     read_known_ranges(path).ranges.tolist()
        [2000.0]
    """
    header = header_of(path)
    inside = [column for column in PIXELS if column in header]
    if bool(inside) == (marks is not None):
        wanted = "marks stand in both tables; leave --marks out" if inside else "no columns of marks; give --marks"
        raise FileError(f"{path}: {wanted} ({_HEADER})")
    columns = ("name", *PIXELS, *COVARIANCE, *_COLUMNS, "note")
    rows = read_rows(path, _HEADER, columns, (*(PIXELS if marks is None else ("name",)), *_COLUMNS))
    names = tuple(row.name for row in rows)
    known = torch.tensor([[_known_meters(row, column) for column in _COLUMNS] for row in rows], dtype=torch.float64)
    found = read_marks(path, more=_COLUMNS) if marks is None else read_marks(marks)
    place = {name: i for i, name in enumerate(found.names)}
    for row in rows:
        if row.name not in place:
            raise FileError(f"{row.where}: {row.name!r} has no marks in {marks}")
    which = [place[name] for name in names]
    covariance, sigma = (None if value is None else value[which] for value in (found.covariance, found.sigma))
    return KnownRanges(Marks(names, found.pixels[which], covariance, sigma), *known.T)


def _known_meters(row: TableRow, column: str) -> float:
    if row.number(column, "a number of meters") <= 0:
        raise FileError(f"{row.where}: {column} is {row.cells[column]!r}; a positive number of meters is needed")
    return float(row.cells[column])
