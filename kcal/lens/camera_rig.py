"""`CameraRig`: any number of cameras, and where each stands and looks in one frame."""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from kcal.checks import StatedModule, as_points, require_finite, scalar
from kcal.errors import InputError
from kcal.lens.calibration import Exclusion, RigSource, UntilChanged
from kcal.lens.camera import Camera
from kcal.lens.camera_like import CameraLike, as_camera
from kcal.lens.mounting import REFRACTION, Origin, check_refraction
from kcal.lens.pose import Movable, rotation_from_vector
from kcal.texts import brief, length_text


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraRigCalibration:
    """How a rig of any number of cameras was solved.

    Args:
        rms: sqrt(mean ‖r‖²) over the pixels of all cameras.
        rms_px: likewise of each camera; None for a camera with none.
        sources: what the rig was solved from.
        excluded: what was left out, with the reason.
        undetermined: what the data leave open, camera by camera.
        warnings: what should be doubted, a sentence each.
        contradictions: which source contradicts the others, a sentence each; such a rig should not be used.
        pixel_sigma: noise of marks along each axis, px, as stated; None if nobody did.
        kcal_version: the version that solved.
        created: when, with its time zone.
    """

    __repr__ = brief

    rms: float
    rms_px: tuple[float | None, ...]
    sources: tuple[RigSource, ...] = ()
    excluded: tuple[Exclusion, ...] = ()
    undetermined: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    pixel_sigma: float | None = None
    kcal_version: str
    created: datetime.datetime


class CameraRig(Movable, StatedModule):
    """Any number of cameras: `points_cam = rotation[c] @ (points - center[c])`, meters.

    The frame is east, north, up of `origin`; without one it is any right-handed frame, without refraction.

    What is known of cameras and poses together is the attribute `root`: (K, P) with rootᵀ root the covariance of P
    quantities: all parameters of each camera in turn (`Camera.names`); then for each camera its center (3, meters) and
    a small turn of it (3, radians), both along and about the frame's axes; last the coefficient of refraction. None:
    nothing is known, so that cameras and poses count as exact. It is None again once a camera or a pose has changed.
    `calibration` (a `CameraRigCalibration`) tells how the rig was solved.

    Poses may be freed: `rig.free("pose")` all of them, `rig.free("mill")` that of one camera, as in `StereoRig.free`.

    Args:
        cameras: C of them, one or more.
        names: of the cameras, unlike each other.
        rotation: (C, 3, 3) cam_from_frame.
        center: (C, 3) projection centers, meters.
        origin: where the frame is anchored on the Earth.
        refraction: coefficient k, see `StereoLocalizer`.

    Raises:
        InputError: wrong shapes, names that are there twice, a matrix that is no rotation.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> look = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # north
        >>> rig = CameraRig([camera] * 3, ["a", "b", "c"], look.repeat(3, 1, 1), torch.eye(3) * 1000.0)
        >>> rig.names, rig.quantities
        (('a', 'b', 'c'), 34)
    """

    refraction: Tensor
    place: Tensor | None
    root = UntilChanged[Tensor](lambda rig, value: rig.check_root(value))
    calibration = UntilChanged[CameraRigCalibration]()

    def __init__(
        self,
        cameras: Sequence[Camera | CameraLike],
        names: Sequence[str],
        rotation: Tensor,
        center: Tensor,
        *,
        origin: Origin | None = None,
        refraction: float = REFRACTION,
    ) -> None:
        super().__init__()
        rotation, center = as_points("rotation", rotation, 3), as_points("center", center, 3)
        count = len(cameras)
        if not count or rotation.shape != (count, 3, 3) or center.shape != (count, 3):
            raise InputError(
                f"{count} cameras: rotation ({count}, 3, 3) and center ({count}, 3) are needed, got "
                f"{tuple(rotation.shape)} and {tuple(center.shape)}"
            )
        if len(names) != count or len(set(names)) != count or not all(names):
            raise InputError(f"cameras: {count} unlike names are needed, got {', '.join(names) or 'none'}")
        require_finite("rotation", rotation)
        require_finite("center", center)
        still = torch.eye(3, dtype=torch.float64, device=rotation.device)
        error = (rotation @ rotation.mT - still).abs().amax((-2, -1))
        for name, off, sign in zip(names, error.tolist(), torch.linalg.det(rotation).tolist(), strict=True):
            if not off <= 1e-6 or sign < 0:
                raise InputError(f"camera {name}: not a rotation matrix (R Rᵀ must be 1 and det R = +1)")
        check_refraction(refraction, 0.0)
        self.cameras = nn.ModuleList(map(as_camera, cameras))
        self.names = tuple(names)
        self.register_buffer("place", None if origin is None else origin.geodetic.to(rotation.device))
        self.register_buffer("refraction", scalar(refraction, rotation))
        self._keep("rotation", rotation, turns=True)
        self._keep("center", center)

    @property
    def rotation(self) -> Tensor:
        """(C, 3, 3) cam_from_frame, with the steps of `free`."""
        kept, step = self._kept("rotation"), self.freed_step
        return kept if step is None else kept @ rotation_from_vector(-step[1])

    @property
    def center(self) -> Tensor:
        """(C, 3) meters, likewise."""
        kept, step = self._kept("center"), self.freed_step
        return kept if step is None else kept + step[0]

    @property
    def origin(self) -> Origin | None:
        """Where the frame is anchored on the Earth."""
        return None if self.place is None else Origin.at(self.place)

    @property
    def constants(self) -> object:
        """Names, in order."""
        return self.names

    @property
    def pose_slots(self) -> dict[str, Any]:
        """What `free` takes: `pose` for all cameras, or names of cameras; a step is that of `root`: center, turn."""
        return {"pose": slice(None), **{name: number for number, name in enumerate(self.names)}}

    def _zero_step(self) -> Tensor:
        return torch.zeros(len(self), 6, dtype=torch.float64, device=self._kept("center").device)

    def extra_repr(self) -> str:
        """Names, farthest distance of two cameras and origin, for `repr`."""
        apart = length_text(float(torch.cdist(self.center, self.center).max()))
        return ", ".join([*self.names, f"up to {apart} apart", *([] if self.origin is None else [str(self.origin)])])

    def __len__(self) -> int:
        """How many cameras there are."""
        return len(self.names)

    @property
    def each(self) -> list[Camera]:
        """The cameras."""
        return list(self.cameras)  # type: ignore[arg-type]

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with any camera and any pose."""
        own = [camera.fingerprint for camera in self.each]
        text = repr((own, self.rotation.tolist(), self.center.tolist(), self.origin, float(self.refraction)))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many parameters each camera has."""
        return tuple(camera.values.shape[-1] for camera in self.each)

    @property
    def quantities(self) -> int:
        """P: how many quantities the covariance is of."""
        return sum(self.sizes) + 6 * len(self) + 1

    def pose_columns(self, camera: int) -> slice:
        """Where the center and the turn of a camera are among the quantities."""
        first = sum(self.sizes) + 6 * camera
        return slice(first, first + 6)

    def check_root(self, root: Tensor) -> None:
        """Raise `InputError` unless `root` has the size of this rig's quantities, and is finite."""
        if root.ndim != 2 or root.shape[1] != self.quantities:
            raise InputError(f"root: a root (K, {self.quantities}) is needed, got {tuple(root.shape)}")
        require_finite("root", root)

    def with_errors(
        self,
        *,
        position_m: float | Sequence[float] = 0.0,
        attitude_deg: float | Sequence[float] = 0.0,
        refraction: float = 0.0,
    ) -> Tensor:
        """`root`, and independent errors that are stated besides.

        Args:
            position_m: standard deviation of each center along east, north and up; or three of them.
            attitude_deg: of the turn of each camera about these axes; or three of them.
            refraction: of its coefficient.

        Returns:
            (K, P): set it as `rig.root`, or give it to `MultiViewLocalizer`.

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
            >>> rig = CameraRig([camera], ["tower"], torch.eye(3)[None], torch.zeros(1, 3))
            >>> tuple(rig.with_errors(position_m=0.02, attitude_deg=(0.01, 0.01, 0.02)).shape)
            (6, 12)
        """
        three = [[value] * 3 if isinstance(value, int | float) else list(value) for value in (position_m, attitude_deg)]
        one = [*three[0], *(math.radians(value) for value in three[1])]
        if len(one) != 6 or not all(0 <= value < math.inf for value in (*one, refraction)):
            raise InputError("errors: one or three standard deviations are needed, none negative")
        sigma = self.center.new_tensor([*([0.0] * sum(self.sizes)), *(one * len(self)), refraction])
        more = torch.diag(sigma)[sigma > 0]
        return more if self.root is None else torch.cat([self.root, more])

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (..., N, 3) of the frame along straight lines: pixels (..., N, C, 2), and which are seen."""
        points = as_points("points", points, 3, self.center)
        pixels, seen = [], []
        for camera, rotation, center in zip(self.each, self.rotation, self.center, strict=True):
            pixel, valid = camera.project((points - center) @ rotation.T)
            pixels.append(pixel)
            seen.append(valid & camera.inside(pixel))
        return torch.stack(pixels, -2), torch.stack(seen, -1)
