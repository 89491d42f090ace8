"""`Camera`: a lens and its intrinsics as an `nn.Module` that projects points and unprojects pixels."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn

from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.lens.inverse import undistort, valid_radius
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, parameter_names, project_components


class Camera(nn.Module):
    """A camera that maps points to pixels (`project`) and pixels to rays (`unproject`).

    Convention: camera frame x right, y down, z forward; pixel (0, 0) is the centre of the first pixel; metres.
    Geometry is float64 whatever `.half()`, `.float()` or the inputs are: lower precision is promoted. Parameters do
    not require gradients until asked (`camera.requires_grad_(True)`), so that training a network around a camera
    leaves its calibration alone.

    Args:
        parameters: (..., 5 + P): fx, fy, cx, cy, skew, then the lens coefficients in the order of `model.names`.
        size: (width, height) in pixels.
        model: a `LensModel` or a preset's name, for example `"opencv5"`.

    Raises:
        InputError: wrong shapes, values that are not finite, a focal length or size that is not positive.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080),
        ...                       coefficients=[-0.1, 0.01, 0, 0, 0], model="opencv5")
        >>> pixels, valid = camera.project(torch.tensor([[1.0, 0.0, 10.0], [0.0, 0.0, -1.0]]))
        >>> valid.tolist()
        [True, False]
        >>> rays, valid = camera.unproject(pixels[:1])
        >>> bool(torch.allclose(rays[0] / rays[0, 2] * 10, torch.tensor([1.0, 0, 10], dtype=torch.float64)))
        True
    """

    parameters_vector: Tensor
    valid_radius: Tensor

    def __init__(self, parameters: Tensor, *, size: tuple[int, int], model: LensModel | str = "opencv5") -> None:
        super().__init__()
        self.model = LensModel.named(model)
        self.size = (int(size[0]), int(size[1]))
        parameters = as_points("camera parameters", parameters, 5 + self.model.size)
        require_finite("camera parameters", parameters)
        if not bool((parameters[..., :2] > 0).all()):
            raise InputError("focal lengths must be positive pixels")
        if min(self.size) < 1:
            raise InputError(f"image size {self.size}: width and height must be positive")
        self.parameters_vector = nn.Parameter(parameters.detach().clone(), requires_grad=False)
        self.register_buffer("valid_radius", valid_radius(parameters[..., 5:].detach(), self.model))

    @classmethod
    def build(
        cls,
        *,
        focal: Sequence[float],
        center: Sequence[float],
        size: tuple[int, int],
        coefficients: Sequence[float] = (),
        model: LensModel | str = "opencv5",
        skew: float = 0.0,
    ) -> Self:
        """A single camera from plain numbers; missing trailing coefficients are zero."""
        model = LensModel.named(model)
        lens = [float(value) for value in coefficients]
        if len(lens) > model.size:
            raise InputError(f"{len(lens)} coefficients given, {model} has {model.size}")
        lens += [0.0] * (model.size - len(lens))
        values = [*map(float, focal), *map(float, center), float(skew), *lens]
        return cls(torch.tensor(values, dtype=torch.float64), size=size, model=model)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in storage order."""
        return parameter_names(self.model)

    @property
    def focal(self) -> Tensor:
        """(..., 2) focal lengths fx, fy in pixels."""
        return self.parameters_vector[..., 0:2]

    @property
    def center(self) -> Tensor:
        """(..., 2) principal point cx, cy in pixels."""
        return self.parameters_vector[..., 2:4]

    @property
    def coefficients(self) -> Tensor:
        """(..., P) lens coefficients in the order of `model.names`."""
        return self.parameters_vector[..., len(INTRINSICS) :]

    @property
    def matrix(self) -> Tensor:
        """(..., 3, 3) intrinsic matrix A of Eq. 3."""
        fx, fy, cx, cy, skew = self.parameters_vector[..., :5].unbind(-1)
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        return torch.stack([fx, skew, cx, zero, fy, cy, zero, zero, one], -1).unflatten(-1, (3, 3))

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with any parameter, the model or the image size."""
        text = repr((self.size, self.model.names, self.parameters_vector.detach().flatten().tolist()))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def update_valid_radius(self) -> None:
        """Measure the valid region again; call it after changing parameters in place."""
        self.valid_radius = valid_radius(self.coefficients.detach(), self.model)

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Map points to pixels.

        Args:
            points_cam: (..., N, 3) in the camera frame.

        Returns:
            pixels (..., N, 2) and valid (..., N): in front of the camera, finite, and before the lens model folds.
            Whether the pixel lies inside the image is another question (`inside`). Pixels that are not valid hold
            the principal point.
        """
        points = as_points("points_cam", points_cam, 3)
        x, y, z = points.unbind(-1)
        radius = self.valid_radius[..., None]
        with torch.no_grad():
            valid = torch.isfinite(points).all(-1) & (z > 0)
            valid = valid & (torch.hypot(x, y) < radius * z)
        keep = valid[..., None]
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=points.dtype, device=points.device)
        safe = torch.where(keep, points, axis).transpose(-1, -2)
        pixels = project_components(safe, self.parameters_vector, self.model).pixels.transpose(-1, -2)
        return torch.where(keep, pixels, self.center[..., None, :]), valid.expand(pixels.shape[:-1])

    def normalize(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Map pixels to undistorted coordinates on the plane z = 1: (normalized (..., N, 2), valid (..., N))."""
        pixels = as_points("pixels", pixels, 2)
        # Taken out before any arithmetic: 0 * NaN in the backward pass would spoil the gradients of the parameters.
        finite = torch.isfinite(pixels).all(-1)
        pixels = torch.where(finite[..., None], pixels, self.center[..., None, :])
        fx, fy, cx, cy, skew = (self.parameters_vector[..., i, None] for i in range(5))
        y = (pixels[..., 1] - cy) / fy
        x = (pixels[..., 0] - cx - skew * y) / fx
        normalized, valid = undistort(torch.stack([x, y], -1), self.coefficients, self.model, self.valid_radius)
        return normalized, valid & finite

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Map pixels to rays.

        Args:
            pixels: (..., N, 2); any real position, also outside the image.

        Returns:
            rays (..., N, 3) of length one, and valid (..., N). A pixel that the lens model cannot have produced, or
            that is not finite, is not valid, and its ray is the optical axis. Gradients by pixels and parameters
            follow the implicit function theorem.
        """
        normalized, valid = self.normalize(pixels)
        rays = torch.cat([normalized, torch.ones_like(normalized[..., :1])], -1)
        return rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True), valid

    def inside(self, pixels: Tensor) -> Tensor:
        """Whether pixels (..., N, 2) lie on the image, whose edges are half a pixel beyond the outer centres."""
        pixels = as_points("pixels", pixels, 2)
        width, height = self.size
        u, v = pixels.unbind(-1)
        return (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)

    def grid(self, columns: int, rows: int) -> Tensor:
        """Pixels (rows, columns, 2) spread evenly over the image, its outermost pixels included."""
        width, height = self.size
        kind, place = torch.float64, self.parameters_vector.device
        u = torch.linspace(0, width - 1, columns, dtype=kind, device=place)
        v = torch.linspace(0, height - 1, rows, dtype=kind, device=place)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)

    def covers_image(self) -> Tensor:
        """(...) whether every pixel of the image has a ray, judged along its border."""
        grid = self.grid(17, 13)
        border = torch.cat([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
        _, valid = self.unproject(border)
        return valid.all(-1)

    def forward(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """The same as `project`."""
        return self.project(points_cam)

    def extra_repr(self) -> str:
        """Model, size and focal length for `repr`."""
        return f"model={self.model}, size={self.size}, focal={self.focal.tolist()}"

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)


def keep_float64(fn: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Let `.to`, `.half`, `.float` move float64 tensors between devices without rounding them."""

    def moved(tensor: Tensor) -> Tensor:
        result = fn(tensor)
        return tensor.to(result.device) if tensor.dtype == torch.float64 else result

    return moved
