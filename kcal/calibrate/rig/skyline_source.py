"""What skylines tell of a rig: attitudes of its cameras, with the errors that they share, as one Gaussian."""

from __future__ import annotations

import dataclasses

from torch import Tensor

from kcal.checks import require_finite
from kcal.errors import InputError
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SkylineSource:
    """What the skylines in images of a rig tell of where its cameras look.

    They are one Gaussian, near the attitudes that fit the skylines alone: images of one camera, and cameras that stand
    side by side, share the errors of the terrain raster and of refraction. `kcal.rig.skyline_source` makes it.

    Args:
        cameras: number of the camera of each image.
        names: of the images.
        rotation: (C, 3, 3) cam_from_world by the skyline alone; NaN for cameras without one.
        center: (C, 3) meters where the cameras were taken to be; NaN likewise.
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
