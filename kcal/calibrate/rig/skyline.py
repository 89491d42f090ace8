"""What skylines tell of a rig: attitudes of its cameras, with the errors that they share, as one Gaussian."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.source import Measurement, PosedCamera
from kcal.checks import require_finite
from kcal.errors import InputError
from kcal.lens.calibration import ItemResidual
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose, vector_from_rotation
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SkylineSource(Measurement):
    """What the skylines in images of a rig tell of where its cameras look.

    They are one Gaussian, near the attitudes that fit the skylines alone: images of one camera, and cameras that stand
    side by side, share the errors of the terrain raster and of refraction. `kcal.rig.skyline_source` makes it.

    Args:
        cameras: number of the camera of each image.
        names: of the images.
        rotation: (C, 3, 3) cam_from_world by the skyline alone; NaN for cameras without one.
        center: (C, 3) meters where the cameras were taken to be; NaN for cameras without a skyline.
        parameters: (C) parameters of each camera's lens, as they were taken to be.
        rows: (Q, 6 C + P) whitened derivatives by turns of the cameras about their own axes, by their centers, and by
            the parameters of all lenses one after the other.
        residual: (Q,) whitened, there.
        columns: (I,) columns of each image that were used.
        rms_px: (I,) of their residuals.
        sigmas: (I,) root of χ² over the degrees of freedom of each image, by its skyline alone.

    Raises:
        InputError: shapes that do not fit each other.
    """

    __repr__ = brief
    kind = "skyline"

    cameras: tuple[int, ...]
    names: tuple[str, ...]
    rotation: Tensor
    center: Tensor
    parameters: tuple[Tensor, ...]
    rows: Tensor
    residual: Tensor
    columns: tuple[int, ...]
    rms_px: tuple[float, ...]
    sigmas: tuple[float, ...]

    def __post_init__(self) -> None:
        count, lens = len(self.rotation), sum(map(len, self.parameters))
        if self.center.shape != (count, 3) or len(self.parameters) != count:
            raise InputError("skyline: a rotation, a center and parameters for each camera are needed")
        if self.rows.shape != (len(self.residual), 6 * count + lens):
            raise InputError(f"skyline: rows (Q, {6 * count + lens}) are needed, got {tuple(self.rows.shape)}")
        images = len(self.cameras)
        if not images or {len(self.names), len(self.columns), len(self.rms_px), len(self.sigmas)} != {images}:
            raise InputError("skyline: a camera, a name, columns and residuals for each image are needed")
        if any(not 0 <= camera < count for camera in self.cameras):
            raise InputError(f"skyline: cameras 0 to {count - 1} are there")
        require_finite("skyline: rows", self.rows)
        require_finite("skyline: residual", self.residual)
        require_finite("skyline: rotation", self.rotation[sorted(set(self.cameras))])

    def check(self, cameras: int, *, absolute: bool) -> None:
        """See `Source.check`."""
        if len(self.rotation) != cameras:
            raise InputError(f"skyline: attitudes of {len(self.rotation)} cameras, the rig has {cameras}")
        if not absolute:
            raise InputError("a skyline needs a frame on the Earth: landmarks, or a camera's measured position")

    def poses(self, cameras: Sequence[Camera], places: Mapping[int, Tensor]) -> dict[int, Pose]:
        """See `Source.poses`; where the cameras were taken to be."""
        return {c: Pose.at(self.rotation[c], self.center[c]) for c in self.cameras}

    @property
    def about(self) -> tuple[int, ...]:
        """See `Measurement.about`."""
        return tuple(sorted(set(self.cameras)))

    @property
    def count(self) -> int:
        """See `Measurement.count`."""
        return len(self.residual)

    def rows_at(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `Measurement.rows_at`."""
        number = len(self.rotation)
        parts = self.rows.split([3] * (2 * number) + [len(one) for one in self.parameters], 1)
        out = self.residual.new_zeros((shared_size + 1, self.count))
        out[-1] = self.residual
        for c in self.about:
            posed, (turn, center, lens) = cameras[c], (parts[c], parts[number + c], parts[2 * number + c])
            out[-1] += turn @ vector_from_rotation(posed.rotation @ self.rotation[c].T)
            out[-1] += center @ (posed.center - self.center[c]) + lens @ (posed.parameters - self.parameters[c])
            out[: posed.by_unknown.shape[1]] += (lens @ posed.by_unknown).T
            if posed.turn is not None:
                out[posed.turn] += turn.T
            if posed.shift is not None:
                out[posed.shift] += center.T
        return out

    def label(self, names: Sequence[str]) -> str:
        """See `Measurement.label`."""
        return "the skyline"

    def against(self, off: Tensor, sigma: Tensor) -> str:
        """See `Measurement.against`."""
        times = float((off.square() / (1.0 + sigma.square())).mean().sqrt())
        return f"without it the cameras look elsewhere than their skylines say, by {times:.1f} times its sigmas"

    def told(self, center: Tensor, names: Sequence[str]) -> list[ItemResidual]:
        """See `Measurement.told`."""
        own = zip(self.names, self.cameras, self.rms_px, self.sigmas, strict=True)
        return [
            ItemResidual(
                source=self.kind,
                name=name,
                pixels=tuple(rms if c == camera else None for c in range(len(names))),
                sigmas=sigmas,
            )
            for name, camera, rms, sigmas in own
        ]

    def squares_px(self) -> tuple[Tensor, Tensor]:
        """See `Measurement.squares_px`."""
        squares, counts = (torch.zeros(len(self.rotation), dtype=torch.float64) for _ in range(2))
        for camera, columns, rms in zip(self.cameras, self.columns, self.rms_px, strict=True):
            squares[camera] += columns * rms**2
            counts[camera] += columns
        return squares, counts
