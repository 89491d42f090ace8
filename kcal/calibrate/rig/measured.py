"""What was measured of a rig's cameras besides what they see: distances between them and places of their centers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.source import Measurement, PosedCamera, require_positive
from kcal.errors import InputError
from kcal.lens.calibration import ItemResidual
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True)
class Baseline(Measurement):
    """A measured distance between the centers of two cameras, meters."""

    __repr__ = brief

    kind = "baselines"

    first: int
    second: int
    length: float
    sigma: float

    def __post_init__(self) -> None:
        require_positive("baseline", self.length)
        require_positive("baseline: sigma", self.sigma)
        if self.first == self.second:
            raise InputError("baseline: two different cameras are needed")

    @property
    def about(self) -> tuple[int, ...]:
        """See `Measurement.about`."""
        return self.first, self.second

    @property
    def count(self) -> int:
        """See `Measurement.count`."""
        return 1

    def rows_at(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `Measurement.rows_at`."""
        apart = cameras[self.second].center - cameras[self.first].center
        length = torch.linalg.vector_norm(apart)
        out = apart.new_zeros((shared_size + 1, 1))
        for sign, number in zip((-1.0, 1.0), self.about, strict=True):
            shift = cameras[number].shift
            if shift is not None:
                out[shift, 0] = sign * apart / (length * self.sigma)
        out[-1, 0] = (length - self.length) / self.sigma
        return out

    def label(self, names: Sequence[str]) -> str:
        """See `Measurement.label`."""
        return f"the baseline {names[self.first]} to {names[self.second]}"

    def against(self, off: Tensor, sigma: Tensor) -> str:
        """See `Measurement.against`."""
        found, spread = self.length + self.sigma * float(off[0]), self.sigma * float(sigma[0])
        return (
            f"{self.length:.6g} ± {self.sigma:.2g} m was stated, and without it the cameras are {found:.6g} ± "
            f"{spread:.2g} m apart"
        )

    def told(self, center: Tensor, names: Sequence[str]) -> list[ItemResidual]:
        """See `Measurement.told`."""
        error = float(torch.linalg.vector_norm(center[self.first] - center[self.second])) - self.length
        name = f"{names[self.first]} to {names[self.second]}"
        return [ItemResidual(source=self.kind, name=name, meters=error, sigmas=abs(error) / self.sigma)]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredPosition(Measurement):
    """A camera's projection center, measured (by GNSS, say): (3,) meters in the local frame and its (3,) sigmas."""

    __repr__ = brief

    kind = "positions"
    absolute = True

    camera: int
    point: Tensor
    sigma: Tensor

    def __post_init__(self) -> None:
        if self.point.shape != (3,) or self.sigma.shape != (3,) or not bool(torch.isfinite(self.point).all()):
            raise InputError("position: three meters and three sigmas are needed")
        if not bool((torch.isfinite(self.sigma) & (self.sigma > 0)).all()):
            raise InputError("position: every sigma must be a positive number of meters")

    @property
    def about(self) -> tuple[int, ...]:
        """See `Measurement.about`."""
        return (self.camera,)

    @property
    def count(self) -> int:
        """See `Measurement.count`."""
        return 3

    def rows_at(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `Measurement.rows_at`."""
        posed = cameras[self.camera]
        out = self.point.new_zeros((shared_size + 1, 3))
        if posed.shift is not None:
            out[posed.shift] = torch.diag(1.0 / self.sigma)
        out[-1] = (posed.center - self.point) / self.sigma
        return out

    def label(self, names: Sequence[str]) -> str:
        """See `Measurement.label`."""
        return f"the position of {names[self.camera]}"

    def against(self, off: Tensor, sigma: Tensor) -> str:
        """See `Measurement.against`."""
        away, spread = off * self.sigma, float((sigma * self.sigma).norm())
        east, north, up = away.tolist()
        return (
            f"without it the camera stands {float(away.norm()):.3g} ± {spread:.2g} m from where it was measured "
            f"({east:+.3g} m east, {north:+.3g} m north, {up:+.3g} m up)"
        )

    def told(self, center: Tensor, names: Sequence[str]) -> list[ItemResidual]:
        """See `Measurement.told`."""
        off = center[self.camera] - self.point
        sigmas = math.sqrt(float((off / self.sigma).square().mean()))
        meters = float(torch.linalg.vector_norm(off))
        return [ItemResidual(source=self.kind, name=names[self.camera], meters=meters, sigmas=sigmas)]
