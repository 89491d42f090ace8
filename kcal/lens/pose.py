"""Poses, rotations and the steps on them; a camera turned until its projections agree with what was seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from kcal.checks import Float64Module, as_tensor, require_finite
from kcal.dispatch import is_differentiated
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import project_components
from kcal.texts import briefly

# Convert and move rigid motions, given by a rotation matrix and a translation.
#
# A step is six numbers: a rotation vector ω (radians) and a translation v (meters), R ← exp([ω]×) R, t ← t + v.


@briefly
class Pose(NamedTuple):
    """Rigid motions dst_from_src: `points_dst = rotation @ points_src + translation`.

    All poses of kcal have this convention; their names say from which frame and into which, as `cam_from_board`.

    Attributes:
        rotation: (..., 3, 3).
        translation: (..., 3) meters.

    Example:
        >>> there = Pose(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]))
        >>> there.after(there).translation.tolist(), (0.0 + there.center).tolist()
        ([2.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
    """

    rotation: Tensor
    translation: Tensor

    @classmethod
    def still(cls) -> Pose:
        """The motion that moves nothing."""
        return cls(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    @classmethod
    def at(cls, rotation: Tensor, center: Tensor) -> Pose:
        """cam_from_world of a camera with this rotation whose projection center (..., 3) is known in the world."""
        return cls(rotation, -(rotation @ center[..., None])[..., 0])

    @property
    def center(self) -> Tensor:
        """(..., 3) the point that is moved to the origin: of cam_from_world, where the camera stands."""
        return -(self.rotation.mT @ self.translation[..., None])[..., 0]

    def after(self, other: Pose) -> Pose:
        """This motion applied after another."""
        return Pose(
            self.rotation @ other.rotation, (self.rotation @ other.translation[..., None])[..., 0] + self.translation
        )

    def inverse(self) -> Pose:
        """The motion back."""
        return Pose(self.rotation.mT, self.center)

    def some(self, chosen: int | slice | Sequence[int] | Tensor) -> Pose:
        """Some of many motions."""
        return Pose(self.rotation[chosen], self.translation[chosen])


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Convert rotation vectors (..., 3) in radians to matrices (..., 3, 3), differentiable also at zero.

    Example:
        >>> rotation_from_vector(torch.zeros(3)).diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    vector = as_tensor("vector", vector)
    if vector.shape[-1:] != (3,):
        raise InputError(f"vector: shape (..., 3) is needed, got {tuple(vector.shape)}")
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    sine, first, _ = (each[..., None] for each in turn_series((vector * vector).sum(-1, keepdim=True)))
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + sine * cross + first * (cross @ cross)


def turn_series(square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sin a / a, (1 - cos a) / a² and (a - sin a) / a³ of a² (...), by their series where these would cancel.

    Source: O. Rodrigues 1840; Murray, Li, Sastry: A Mathematical Introduction to Robotic Manipulation, Eq. 2.14.
    """
    near = square < 1e-4
    far = torch.where(near, 1.0, square)
    angle = far.sqrt()
    sine = torch.where(near, 1.0 - square * (1.0 - square / 20.0) / 6.0, torch.sin(angle) / angle)
    first = torch.where(near, 0.5 - square * (1.0 - square / 30.0) / 24.0, (1.0 - torch.cos(angle)) / far)
    second = torch.where(near, (1.0 - square * (1.0 - square / 42.0) / 20.0) / 6.0, (1.0 - sine) / far)
    return sine, first, second


# How a pose takes a step: along a twist, so that long steps of many boards stay close to the linear model.


def apply_twist(rotation: Tensor, translation: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Move rigid motions by the twist whose first-order effect is that of `kcal.lens.pose.step_rows`.

    A step is (ω, v): points turn by ω about the origin of their own frame, which itself moves by v. Applied
    separately, R ← exp([ω]×) R and t ← t + v, a rotation about any other center deviates from its arc by |ω|² |t| / 2.
    The exponential of the twist (ω, v - ω × t) follows the arc for any center. So boards can follow a rotation of the
    camera's axis, which rich lens models hardly determine, in a few long steps.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3) meters.
        step: (..., 6) radians and meters.

    Source: Murray, Li, Sastry: A Mathematical Introduction to Robotic Manipulation, Eq. 2.36.

    Example:
        >>> quarter = torch.tensor([0.0, 0.0, torch.pi / 2, -torch.pi / 2, 0.0, 0.0], dtype=torch.float64)
        >>> start = torch.eye(3).double(), torch.tensor([0.0, 1.0, 0.0]).double()
        >>> [round(x, 12) + 0.0 for x in apply_twist(*start, quarter)[1].tolist()]  # a quarter turn about the origin
        [-1.0, 0.0, 0.0]
    """
    turn, shift = step[..., :3], step[..., 3:]
    along = shift - torch.linalg.cross(turn, translation)
    sine, first, second = turn_series((turn * turn).sum(-1, keepdim=True))
    # exp([ω]×) and its integral as linear maps of all columns at once: R, t, and the shift.
    columns = torch.cat([rotation, translation[..., None], along[..., None]], -1)
    turned = torch.linalg.cross(turn[..., None].expand_as(columns), columns, dim=-2)
    twice = torch.linalg.cross(turn[..., None].expand_as(columns), turned, dim=-2)
    moved = columns + sine[..., None] * turned + first[..., None] * twice
    screwed = along + first * turned[..., 4] + second * twice[..., 4]
    return moved[..., :3], moved[..., 3] + screwed


def vector_from_rotation(rotation: Tensor) -> Tensor:
    """Convert rotation matrices (..., 3, 3) to rotation vectors (..., 3) of length at most π.

    Example:
        >>> vector_from_rotation(torch.eye(3)).tolist()
        [0.0, 0.0, 0.0]
    """
    rotation = as_tensor("rotation", rotation)
    if rotation.shape[-2:] != (3, 3):
        raise InputError(f"rotation: shape (..., 3, 3) is needed, got {tuple(rotation.shape)}")
    # The products of a quaternion's components: each row is the quaternion, and nothing cancels in the longest.
    axis = (rotation - rotation.mT)[..., [2, 0, 1], [1, 2, 0]][..., None]
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    block = rotation + rotation.mT + (1.0 - trace) * torch.eye(3).to(rotation)
    every = torch.cat([torch.cat([1.0 + trace, axis.mT], -1), torch.cat([axis, block], -1)], -2)
    longest = every.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*every.shape[:-2], 1, 4)
    quaternion = every.gather(-2, longest)[..., 0, :]
    cosine, along = quaternion[..., :1].abs(), quaternion[..., 1:] * torch.where(quaternion[..., :1] < 0, -1.0, 1.0)
    square = along.square().sum(-1, keepdim=True)
    sine = torch.where(square > 0, square, 1.0).sqrt()
    return 2.0 * along * torch.where(square > 0, torch.atan2(sine, cosine) / sine, 1.0 / cosine)


def enu_from_cam(heading_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Tensor:
    """Rotation that takes camera axes (x right, y down, z forward) to east, north, up.

    Starting from a level camera that looks north, it is turned clockwise (seen from above) by the heading, raised by
    the pitch about its own x axis, and then rolled about its own optical axis.

    Args:
        heading_deg: azimuth of the optical axis, degrees clockwise from true north.
        pitch_deg: elevation of the optical axis above the horizontal plane, degrees, positive up.
        roll_deg: degrees, positive clockwise as seen from behind the camera: the right side goes down.

    Returns:
        (3, 3) float64, the columns being the camera's right, down and forward axes in ENU.

    Raises:
        InputError: an angle that is not finite, a pitch beyond ±90, or a heading or roll beyond ±360.

    Example:
        >>> enu_from_cam(90.0)[:, 2].round(decimals=12).abs().tolist()
        [1.0, 0.0, 0.0]
    """
    for name, value, limit in (("heading", heading_deg, 360.0), ("pitch", pitch_deg, 90.0), ("roll", roll_deg, 360.0)):
        if not abs(value) <= limit:
            raise InputError(f"{name} {value}: degrees between -{limit:g} and {limit:g} are needed")
    heading, pitch, roll = (math.radians(value) for value in (heading_deg, pitch_deg, roll_deg))
    east, north = math.sin(heading), math.cos(heading)
    forward = (east * math.cos(pitch), north * math.cos(pitch), math.sin(pitch))
    right = (north, -east, 0.0)
    down = (east * math.sin(pitch), north * math.sin(pitch), -math.cos(pitch))
    columns = (
        [r * math.cos(roll) + d * math.sin(roll) for r, d in zip(right, down, strict=True)],
        [d * math.cos(roll) - r * math.sin(roll) for r, d in zip(right, down, strict=True)],
        forward,
    )
    return torch.tensor(columns, dtype=torch.float64).T


def nearest_rotation(matrix: Tensor) -> Tensor:
    """Return the rotations closest to matrices (..., 3, 3) in the Frobenius norm (orthogonal Procrustes).

    Example:
        >>> nearest_rotation(2 * torch.eye(3)).diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vh)
    u = torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], -1)
    return u @ vh


def check_motion(name: str, rotation: Tensor, translation: Tensor) -> None:
    """Raise `InputError` unless these are a rotation (3, 3) and a translation (3,), all finite; `name` says of what."""
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise InputError(
            f"{name} pose: shapes (3, 3) and (3,) are needed, got {tuple(rotation.shape)} and "
            f"{tuple(translation.shape)}"
        )
    require_finite(f"{name} rotation", rotation)
    require_finite(f"{name} translation", translation)
    identity = torch.eye(3, dtype=torch.float64, device=rotation.device)
    if not torch.allclose(rotation @ rotation.T, identity, atol=1e-6) or torch.linalg.det(rotation) < 0:
        raise InputError(f"{name} rotation: not a rotation matrix (R Rᵀ must be 1 and det R = +1)")


def step_rows(by_point: Tensor, rotated: Tensor) -> Tensor:
    """Derivatives by the six numbers of a step, from derivatives by the moved point.

    Args:
        by_point: (..., 3, 2, N) derivatives of N pixels by their points in the moved frame.
        rotated: (..., 3, N) points after the rotation and before the translation.

    Returns:
        (..., 6, 2, N): by ω (through ω × point), then by v.
    """
    x, y, z = (rotated[..., i, None, :] for i in range(3))
    by_x, by_y, by_z = by_point.unbind(-3)
    turned = torch.stack([by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y], -3)
    return torch.cat([turned, by_point], -3)


def side_axes(rays: Tensor) -> tuple[Tensor, Tensor]:
    """Two directions that form an orthonormal frame with unit rays (..., N, 3); smooth except where z changes sign.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 2017).
    """
    x, y, z = rays.unbind(-1)
    sign = torch.where(z >= 0, 1.0, -1.0).to(z.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], -1)
    return first, torch.stack([b, sign + y * y * a, -y], -1)


class Movable(Float64Module):
    """A module with poses that may be freed, as the parameters of a camera are.

    What is stored stays; the parameter `pose_step`, six numbers a pose and zeros at first, moves it: a rotation vector
    in radians and a shift in meters. So a rotation stays a rotation under any optimizer. Without `free` there is no
    step, in the state neither; a state with one is loaded as frozen.
    """

    pose_step: nn.Parameter | None
    pose_mask: Tensor | None

    def __init__(self) -> None:
        super().__init__()
        self.register_parameter("pose_step", None)
        self.register_buffer("pose_mask", None)

    @property
    def pose_slots(self) -> dict[str, Any]:
        """Name -> index into `pose_step`; the first name means all of it."""
        raise NotImplementedError

    def _zero_step(self) -> Tensor:
        raise NotImplementedError

    def free(self, *names: str) -> Self:
        """Let gradients reach these poses only; without names, all of them. Return the module itself.

        `requires_grad_(False)` freezes it again. See `pose_slots` for the names.

        Raises:
            InputError: an unknown name.
        """
        slots = self.pose_slots
        for name in names:
            if name not in slots:
                raise InputError(f"unknown pose {name!r}: {type(self).__name__} has {', '.join(slots)}")
        if self.pose_step is None:
            self.pose_step = nn.Parameter(self._zero_step())
        mask = torch.zeros_like(self.pose_step, dtype=torch.bool)
        for name in names or tuple(slots)[:1]:
            mask[slots[name]] = True
        self.pose_mask = mask
        self.pose_step.requires_grad_(True)
        return self

    @property
    def freed_step(self) -> tuple[Tensor, Tensor] | None:
        """The first and the last three numbers of each step (..., 3), with gradients for what was freed; or None."""
        if self.pose_step is None or self.pose_mask is None:
            return None
        step = torch.where(self.pose_mask, self.pose_step, self.pose_step.detach())
        return step[..., :3], step[..., 3:]

    def _keep(self, name: str, value: Tensor, *, turns: bool = False) -> None:
        """Store a part of a pose: a parameter as itself, what has a graph with it, anything else as a copy."""
        if isinstance(value, nn.Parameter) and turns:
            raise InputError(
                f"{name}: an optimizer would not keep this parameter a rotation; give its .detach() and call "
                f"{type(self).__name__}.free()"
            )
        if isinstance(value, nn.Parameter):
            self._parameters[name] = value
        else:
            self._buffers[name] = value if is_differentiated(value) else value.detach().clone()

    def _kept(self, name: str) -> Tensor:
        """What `_keep` stored, before any step."""
        found = self._parameters[name] if name in self._parameters else self._buffers[name]
        assert found is not None
        return found

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        if f"{prefix}pose_step" in state_dict and self.pose_step is None:
            step = self.free().pose_step
            assert step is not None
            step.requires_grad_(False)
        elif self.pose_step is not None and self.pose_mask is not None:
            state_dict.setdefault(f"{prefix}pose_step", self._zero_step())
            state_dict.setdefault(f"{prefix}pose_mask", self.pose_mask)
        super()._load_from_state_dict(state_dict, prefix, *rest)


# Rotate a camera until its projections agree with what was seen: Gauss-Newton on rotations.

# Singular values of the rows below this share of the largest are rounding: what they would turn stays as it is.
_ROUNDING = math.sqrt(3.0 * torch.finfo(torch.float64).eps)


def rotation_between(first: Tensor, second: Tensor) -> Tensor:
    """The rotation (..., 3, 3) with second ≈ R first, both (..., N, 3), in the least-squares sense.

    Source: Kabsch (1976); Wahba's problem.

    Example:
        >>> e = torch.eye(3, dtype=torch.float64)
        >>> rotation_between(e, e[[1, 2, 0]]).tolist()
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    return nearest_rotation(second.transpose(-1, -2) @ first) + 0.0


def seen_turned(camera: Camera, points: Tensor, rotation: Tensor, shift: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Where a camera sees points after a motion, and how that changes with a further step.

    Args:
        camera: a single camera; its parameters are held.
        points: (N, 3).
        rotation: (3, 3) the camera's axes from those of the points.
        shift: (3,) added after the rotation; none if left out.

    Returns:
        pixels (2, N), NaN where the camera has no image; and their derivatives (6, 2, N) by a turn about the camera's
        axes and by a shift, as `kcal.lens.pose.step_rows`.
    """
    turned = rotation @ points.T
    moved = turned if shift is None else turned + shift[:, None]
    seen = project_components(moved, camera.params.detach(), camera.model, ())
    return torch.where(seen.regular, seen.pixels, torch.nan), step_rows(seen.by_point, turned)


class TurnFit(NamedTuple):
    """What `fit_turn` found.

    Attributes:
        rotation: (3, 3).
        more: (S,) the other unknowns.
        converged: whether the last step was small enough.
    """

    rotation: Tensor
    more: Tensor
    converged: bool


def fit_turn(
    rotation: Tensor,
    look: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    *,
    more: int = 0,
    steps: int = 50,
    settled: float = 1e-10,
    longest: float = math.inf,
) -> TurnFit:
    """Turn something until residuals are smallest, by Gauss-Newton steps whose weights may follow the residuals.

    Args:
        rotation: (3, 3) to begin with.
        look: from a rotation and the other unknowns (S,) to rows (M, 3 + S) and residuals (M,), both times the square
            roots of their weights; a residual that is NaN counts nothing. Rows are derivatives of the residuals by a
            turn that comes after the rotation, and by the other unknowns, in units that change the residuals about as
            much as a radian does. Weights that depend on the residuals make the fit robust.
        more: S, how many other unknowns there are; they begin at zero.
        steps: at most.
        settled: radians below which a turn ends the iteration.
        longest: radians; no turn is longer, and the other unknowns of a step are shortened with it.

    Example:
        >>> wanted = rotation_from_vector(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
        >>> directions = torch.eye(3, dtype=torch.float64)
        >>> def look(rotation, _):
        ...     turned = directions @ rotation.T
        ...     rows = torch.linalg.cross(torch.eye(3).double()[None], turned[:, None]).transpose(1, 2)
        ...     return rows.flatten(0, 1), (turned - directions @ wanted.T).flatten()
        >>> bool(torch.allclose(fit_turn(directions, look).rotation, wanted))
        True
    """
    others = torch.zeros(more, dtype=torch.float64)
    for _ in range(steps):
        rows, residuals = look(rotation, others)
        rows, residuals = torch.where(residuals.isnan()[:, None], 0.0, rows), residuals.nan_to_num(0.0)
        solution = torch.linalg.lstsq(rows, residuals[:, None], rcond=_ROUNDING, driver="gelsd").solution[:, 0]
        size = float(solution[:3].norm())
        step = -solution * min(1.0, longest / max(size, 1e-300))
        rotation, others = rotation_from_vector(step[:3]) @ rotation, others + step[3:]
        if size < settled:
            return TurnFit(rotation, others, True)
    return TurnFit(rotation, others, False)
