"""How far a lens that is written in place of another one is from it, over the image."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from kcal.errors import DegenerateError
from kcal.lens.camera import Camera
from kcal.lens.difference import PixelShift

# Columns and rows on which a misfit is measured: four times as dense as the fit's, reaching to the image's edge.
_DENSE = (129, 97)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Misfit(PixelShift):
    """What is written instead of a lens, and how far it is from it, over the image and at infinity.

    Args:
        model: of the format.
        pixels: (rows, columns, 2) that the camera sees rays at.
        shift: (rows, columns, 2) pixels at which what was written sees them, minus `pixels`; NaN where the camera
            itself has no ray.
    """

    model: str

    @property
    def largest(self) -> float:
        """Bound of the length: its maximum on the grid, and what it can be more between the grid's points."""
        bends = [torch.diff(self.shift, n=2, dim=axis).abs() for axis in (0, 1)]
        most = [float(torch.nan_to_num(bend).max()) for bend in bends]
        return super().largest + sum(most) / 4.0


def measured_misfit(camera: Camera, model: str, project: Callable[[Tensor], tuple[Tensor, Tensor]]) -> Misfit:
    """Compare what a camera sees with pixels and a mask that `project` returns for rays (N, 3).

    Raises:
        DegenerateError: rays of the camera without a pixel, because the other lens folds or ends.
    """
    columns, rows = _DENSE
    width, height = camera.size
    # From edge to edge: half a pixel beyond the centers of the outer pixels.
    u = torch.linspace(-0.5, width - 0.5, columns, dtype=torch.float64)
    v = torch.linspace(-0.5, height - 0.5, rows, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
    rays, valid = camera.unproject(pixels.reshape(-1, 2))
    if not bool(valid.any()):
        raise DegenerateError("this camera has no ray for any pixel")
    seen, shown = project(rays)
    if not bool(shown[valid].all()):
        share = float(shown[valid].double().mean())
        raise DegenerateError(f"{model} shows only {share:.1%} of what the camera sees: it folds or ends before")
    shift = torch.where(valid[:, None], seen - pixels.reshape(-1, 2), torch.nan)
    return Misfit(model=model, pixels=pixels, shift=shift.reshape(pixels.shape))
