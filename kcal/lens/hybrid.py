"""`HybridCamera`: a parametric camera whose lens is corrected by a small smooth field."""

from __future__ import annotations

import hashlib
from typing import Self

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.projection import from_pixels, to_pixels
from kcal.lens.residual import Field, FieldGrid, FieldResidual, correct_components, undo_components

# The name of the field's weights in `HybridCamera.free`.
WEIGHTS = "weights"


class HybridCamera(Camera):
    """A camera with a residual field between its lens and its intrinsics (`kcal.lens.residual`).

    It can be used wherever a `Camera` can: `project` and `unproject` have the same masks and exact round trips, and
    gradients also reach the field's weights. The field can be undone everywhere, so the valid region is that of the
    lens. It is a single camera; use `vmap` for several.

    `params` alone do not describe this camera, because they were fitted together with the field. Writing it to a format
    without fields is therefore an error.

    Args:
        parameters: (5 + P,) as for `Camera`.
        size: (width, height) of the image in pixels.
        model: a `LensModel` or the name of one.
        residual: the field; not given: an empty one, which corrects nothing.

    Raises:
        InputError: as for `Camera`; a batch of cameras; a field whose slope is too steep.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.1])
        >>> grid = FieldGrid.covering((-0.4, -0.3), (0.4, 0.3), widths=[0.2])
        >>> weights = torch.full((2, grid.count), 1e-3, dtype=torch.float64)
        >>> hybrid = HybridCamera.of(camera, FieldResidual(grid, weights))
        >>> point = torch.tensor([[0.1, 0.2, 1.0]], dtype=torch.float64)
        >>> pixels, valid = hybrid.project(point)
        >>> [round(value, 2) for value in (pixels - camera.project(point)[0])[0].tolist()]
        [6.48, 6.48]
        >>> rays, valid = hybrid.unproject(pixels)
        >>> bool(torch.allclose(rays / rays[..., 2:], point, rtol=0, atol=1e-14))
        True
    """

    def __init__(
        self,
        parameters: Tensor,
        *,
        size: tuple[int, int],
        model: LensModel | str = "opencv5",
        residual: FieldResidual | None = None,
    ) -> None:
        super().__init__(parameters, size=size, model=model)
        if self.params.ndim != 1:
            raise InputError(
                f"HybridCamera: a single camera is needed, not a batch of {tuple(self.valid_radius.shape)}"
            )
        self.residual = residual or FieldResidual(FieldGrid())

    @classmethod
    def of(cls, camera: Camera, residual: FieldResidual) -> Self:
        """Add a field to a camera."""
        return cls(camera.params, size=camera.size, model=camera.model, residual=residual)

    @property
    def parametric(self) -> Camera:
        """The camera without its field. It fits no data: the parameters were fitted together with the field."""
        return Camera(self.params, size=self.size, model=self.model)

    @property
    def field(self) -> Field | None:
        """The residual field, as `kcal.lens.projection.project_components` takes it."""
        return self.residual.field

    def with_parameters(self, parameters: Tensor) -> HybridCamera:
        """Make a camera with the same field and other parameters; no memory is shared."""
        residual = FieldResidual(self.residual.grid, self.residual.weights)
        return HybridCamera(parameters, size=self.size, model=self.model, residual=residual)

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with any parameter, weight or unit, the model or the image size."""
        weights = self.residual.weights.detach().flatten().tolist()
        text = repr((super().fingerprint, self.residual.grid.scales, weights))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def free_names(self) -> tuple[str, ...]:
        """As `Camera.free_names`; "weights" stands for all weights of the field."""
        return super().free_names + (WEIGHTS,) * self.residual.weights.requires_grad

    def free(self, *names: str) -> Self:
        """As `Camera.free`, with "weights" for the field; without names, everything but skew."""
        own = [name for name in names if name != WEIGHTS]
        super().free(*own)
        if names and not own:
            self.params.requires_grad_(False)
        self.residual.weights.requires_grad_(not names or WEIGHTS in names)
        return self

    def update_valid_region(self) -> None:
        """Compute the valid region again and check the field; call this after changing parameters or weights."""
        super().update_valid_region()
        self.residual.check()

    def correction(self, pixels: Tensor) -> Tensor:
        """Displacement (..., N, 2) in pixels that the field causes at pixels (..., N, 2)."""
        values = self.params.detach()
        u, v = as_points("pixels", pixels, 2).unbind(-1)
        x, y, _ = self._from_sensor(u, v, values)
        return pixels - torch.stack(to_pixels(x, y, values), -1)

    def _to_sensor(self, x: Tensor, y: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        moved = correct_components(x, y, self.residual.field, slopes=False)
        return to_pixels(moved.x, moved.y, values)

    def _from_sensor(self, u: Tensor, v: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        x, y = from_pixels(u, v, values)
        return undo_components(x, y, self.residual.field)
