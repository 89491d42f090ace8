"""Range errors of a rig before it is built, and with the covariance of one that is solved."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import Rig
from kcal.locate.geodesy import enu_from_cam
from kcal.locate.localizer import Localizer
from kcal.locate.max_likelihood import calibration_effect
from kcal.locate.mounting import by_mounting
from kcal.locate.stereo import BEARING_SIGMAS, Localization, PositionStatus, checked_rig, sight_lines
from kcal.locate.views import fit_pairs
from kcal.texts import briefly
from kcal.threads import in_one_thread

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
    errors = errors or BudgetErrors()
    far, points, left, right = points_at(rig, distances, pixel)
    ray = points[0] / far[0]
    with torch.no_grad():
        along = _epipolar_direction(rig, points)
        moved = {
            "disparity": lambda s: (rig, right + s * errors.disparity_px * along),
            "yaw": lambda s: (_yawed(rig, s * math.radians(errors.yaw_deg)), right),
            "baseline": lambda s: (_stretched(rig, s * errors.baseline_m), right),
            "timing": lambda s: (
                rig,
                rig(points + s * _crossing(rig, ray) * errors.timing_s * errors.speed_mps)[0][..., 1, :],
            ),
        }
        found = {}
        for name, move in moved.items():
            changes = [_range(*_apart(move(sign), left)) - far for sign in (-1.0, 1.0)]
            # A millionth of the error: far from rounding, and no longer curved.
            small = [_range(*_apart(move(sign), left)) for sign in (-1e-5, 1e-5)]
            found[name] = RangeError(
                torch.minimum(*changes), torch.maximum(*changes), (small[1] - small[0]).abs() / 2e-5
            )
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


def _apart(moved: tuple[Rig, Tensor], left: Tensor) -> tuple[Rig, Tensor, Tensor]:
    return moved[0], left, moved[1]


def _range(rig: Rig, left: Tensor, right: Tensor) -> Tensor:
    """Range from the left camera; infinite where the rays do not meet ahead."""
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


def _epipolar_direction(rig: Rig, points: Tensor) -> Tensor:
    """Unit direction in the right image in which a point moves as it comes nearer."""
    before, after = rig.right.project(rig.right_from_left(points))[0], rig(points * (1.0 - 1e-4))[0][..., 1, :]
    step = after - before
    return step / torch.linalg.vector_norm(step, dim=-1, keepdim=True)


def _yawed(rig: Rig, yaw: float) -> Rig:
    turn = rotation_from_vector(torch.tensor([0.0, yaw, 0.0], dtype=torch.float64))
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
    pixel_sigma: float = 0.3,
    pixel: Sequence[float] | None = None,
) -> RangeSigmas:
    """Split the standard deviation of ranges by its sources.

    Errors of lenses and relative pose are correlated: a pose that was solved makes up for most of what the lenses have
    wrong. So the variance of both together is split into what would remain with exact lenses, which better landmarks or
    far features reduce, and the rest, which better calibrated cameras reduce.

    Args:
        rig: with its `covariance` and `mounting`; where one is None, its part is 0.
        distances: (D,) ranges from the left camera, meters; `usual_ranges` if left out.
        pixel_sigma: of a mark along each axis, px.
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
    variance = checked_rig(rig, pixel_sigma) ** 2
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
            by_lenses = effect @ row_space(factor[:-6])
            lenses = by_lenses.norm(dim=-1)
            pose = (effect.square().sum(-1) - lenses.square()).clamp_min(0.0).sqrt()
        stands = rig.mounting
        if stands is not None and stands.covariance is not None:
            enu = points @ enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg).T
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
def station_sigmas(rig: Rig, distance: float, *, pixel_sigma: float = 0.3) -> RangeSigmas | None:
    """Split the standard deviation of ranges from each camera by its sources, where it is worst.

    Looked at are points at a distance from each camera, along the middle row of its image, that another camera sees
    too. Marks, lenses and poses are told apart as by `range_sigmas`; the poses are those of all
    cameras, and `sideways` is zero.

    Args:
        rig: with its `root`; None: lenses and poses count as exact.
        distance: meters.
        pixel_sigma: of a mark along each axis, px.

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
    lenses = root[:, : sum(rig.sizes)]
    within = row_space(lenses.T)
    # With exact lenses, what their errors have in common with the poses is known too.
    exact = root - within @ (within.T @ root)
    marks, without, total = (
        _range_sigma(Localizer(rig, weights="all", pixel_sigma=pixel_sigma, root=known)(pixels, seen), rays, distance)
        for known in (torch.zeros_like(root), exact, root)
    )
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
