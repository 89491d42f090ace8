"""What a stereo rig will do before it is built: range errors against distance, exactly and not to first order.

The paper's Table 2 has ΔZ = Z² Δd / (f B), the slope at the true point. At long range an error is not small: of 3.2 px
of disparity at 5 km, 2 px too few put the point 8.3 km farther out, 2 px too many 1.9 km nearer; the slope says 3.1 km
for both. Here the rays are moved by each error and intersected again.
"""

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
from kcal.lens.rig import StereoRig
from kcal.locate.stereo import PositionStatus, sight_lines
from kcal.threads import in_one_thread


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


def planned_rig(
    *, focal_px: float = 1600.0, baseline_m: float = 10.0, size: tuple[int, int] = (1920, 1080)
) -> StereoRig:
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
    return StereoRig(camera, camera, torch.eye(3, dtype=torch.float64), shift)


@in_one_thread
def range_errors(
    rig: StereoRig,
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
            "timing": lambda s: (rig, rig(points + s * _crossing(rig, ray) * errors.timing_s * errors.speed_mps)[1]),
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
    rig: StereoRig, distances: Tensor | Sequence[float], pixel: Sequence[float] | None = None
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
    left, right, seen = rig(points)
    good = seen & rig.left.inside(left) & rig.right.inside(right)
    if not bool(good.all()):
        raise InputError(f"the rig does not see a point at {float(far[~good][0]):g} m there; choose another pixel")
    return far, points, left, right


def _apart(moved: tuple[StereoRig, Tensor], left: Tensor) -> tuple[StereoRig, Tensor, Tensor]:
    return moved[0], left, moved[1]


def _range(rig: StereoRig, left: Tensor, right: Tensor) -> Tensor:
    """Range from the left camera; infinite where the rays do not meet ahead."""
    lines = sight_lines(rig, left, right)
    distance = torch.linalg.vector_norm(lines.points, dim=-1)
    return torch.where(lines.status == int(PositionStatus.OK), distance, math.inf)


def _direction(rig: StereoRig, pixel: Sequence[float] | None) -> Tensor:
    if pixel is not None:
        place = as_points("pixel", torch.tensor([list(map(float, pixel))], dtype=torch.float64), 2)
        rays, valid = rig.left.unproject(place)
        if not bool(valid.all() & rig.left.inside(place).all()):
            raise InputError(f"pixel {tuple(pixel)}: not in the image, or the lens has no ray there")
        return rays[0]
    both = rig.right_from_left_rotation[2] + rig.right_from_left_rotation.new_tensor([0.0, 0.0, 1.0])
    return both / torch.linalg.vector_norm(both)


def _crossing(rig: StereoRig, ray: Tensor) -> Tensor:
    """Unit vector along the baseline, across the line of sight: motion along it looks like disparity."""
    center = -rig.right_from_left_translation @ rig.right_from_left_rotation
    across = center - (center @ ray) * ray
    length = torch.linalg.vector_norm(across)
    if not float(length) > 0:
        raise InputError("the view runs along the baseline: no range can be measured there")
    return across / length


def _epipolar_direction(rig: StereoRig, points: Tensor) -> Tensor:
    """Unit direction in the right image in which a point moves as it comes nearer."""
    before, after = rig.right.project(rig.right_from_left(points))[0], rig(points * (1.0 - 1e-4))[1]
    step = after - before
    return step / torch.linalg.vector_norm(step, dim=-1, keepdim=True)


def _yawed(rig: StereoRig, yaw: float) -> StereoRig:
    turn = rotation_from_vector(torch.tensor([0.0, yaw, 0.0], dtype=torch.float64))
    # About its own center: the center stays where it is.
    return StereoRig(rig.left, rig.right, turn @ rig.right_from_left_rotation, turn @ rig.right_from_left_translation)


def _stretched(rig: StereoRig, more: float) -> StereoRig:
    scale = 1.0 + more / float(rig.baseline)
    if scale <= 0:
        raise InputError("baseline_m: the error is larger than the baseline")
    return StereoRig(rig.left, rig.right, rig.right_from_left_rotation, scale * rig.right_from_left_translation)
