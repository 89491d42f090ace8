"""Distortion as a module of its own: normalized points in, distorted points out, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.dispatch import finite_or
from kcal.errors import InputError
from kcal.lens.camera_parameters import CameraParameters, LensParameters
from kcal.lens.distortion import distort_components
from kcal.lens.inverse import InverseStart, PreparedInverse, undistort
from kcal.lens.model import LensModel
from kcal.lens.region import in_region

# What a camera's distortion does not have of its own.
_SHARED = frozenset(LensParameters.__annotations__)


class DistortionJacobian(NamedTuple):
    """Derivatives of distorted points (..., N, 2); zero where a point is not valid.

    Attributes:
        by_point: (..., N, 2, 2); the last index is the coordinate of the undistorted point.
        by_coefficients: (..., N, 2, P) in the order of `model.names`.
    """

    by_point: Tensor
    by_coefficients: Tensor


class ExtendedDistortion(LensParameters):
    """Distort normalized points by 4 to 24 coefficients (the paper's Eq. 4 and 10), and undo it.

    Convention: (x, y) on the plane z = 1 of the camera, y down; for a fisheye, angles from the axis along x and y. The
    coefficients of OpenCV come first, in its order, so that `opencv14` is the `distCoeffs` of OpenCV and the
    `distort_points` of kornia; Eq. 10 (`ext20`) adds six. All is float64; float32 is promoted.

    The coefficients do not require gradients until asked (`free`). Gradients by points and coefficients are exact, also
    those of `inverse` (implicit function theorem); `jacobian` has them in closed form. The region where the lens is
    valid is measured when the module is made and when a state is loaded. After changing coefficients otherwise, call
    `update_valid_region()`. `Camera.distortion` is this module of a camera, with the camera's own parameters.

    Args:
        coefficients: (..., P), or numbers, of which those left out at the end are zero. Leading dimensions make a
            batch.
        model: a `LensModel` or the name of one: "opencv4" to "opencv14", "ext16" to "ext24", "fisheye4".

    Raises:
        InputError: too many coefficients, or one that is not finite.

    Example:
        >>> distortion = ExtendedDistortion([-0.25], "ext20")
        >>> distorted, valid = distortion(torch.tensor([[0.5, 0.0], [3.0, 0.0]]))
        >>> distorted[0].tolist(), valid.tolist()
        ([0.46875, 0.0], [True, False])
        >>> normalized, valid = distortion.inverse(distorted[:1])
        >>> bool((normalized - torch.tensor([0.5, 0.0])).abs().max() < 1e-12), valid.tolist()
        (True, [True])
        >>> distortion.jacobian(normalized).by_coefficients.shape
        torch.Size([1, 2, 20])
    """

    def __init__(self, coefficients: Tensor | Sequence[float] = (), model: LensModel | str = "ext20") -> None:
        model = LensModel.named(model)
        if not isinstance(coefficients, Tensor):
            if len(coefficients) > model.size:
                raise InputError(
                    f"{len(coefficients)} coefficients given, {model} has {model.size}; choose a model with more"
                )
            given = [float(value) for value in coefficients]
            coefficients = torch.tensor(given + [0.0] * (model.size - len(given)), dtype=torch.float64)
        super().__init__("distortion coefficients", coefficients, model)
        self._measure_region()

    def forward(self, normalized: Tensor) -> tuple[Tensor, Tensor]:
        """Map normalized to distorted points.

        Args:
            normalized: (..., N, 2).

        Returns:
            distorted (..., N, 2), and valid (..., N): finite and not beyond a fold or pole of the lens. Points that are
            not valid are (0, 0).

        Raises:
            InputError: a wrong shape or an integer dtype.
        """
        x, y, valid = self._valid_points(normalized)
        lens = distort_components(x, y, self.coefficients, self.model, slopes=False)
        return torch.where(valid[..., None], torch.stack([lens.x, lens.y], -1), 0.0), valid

    def jacobian(self, normalized: Tensor) -> DistortionJacobian:
        """Derivatives of `forward` at normalized points (..., N, 2), in closed form."""
        x, y, valid = self._valid_points(normalized)
        lens = distort_components(x, y, self.coefficients, self.model, range(self.model.size))
        by_point = torch.stack(torch.broadcast_tensors(*lens.point), -1).unflatten(-1, (2, 2))
        columns = (by_point, lens.coefficients.movedim(-1, -3).transpose(-1, -2))
        return DistortionJacobian(*(torch.where(valid[..., None, None], column, 0.0) for column in columns))

    def inverse(self, distorted: Tensor, *, start: InverseStart | None = None) -> tuple[Tensor, Tensor]:
        """Map distorted (..., N, 2) to normalized points (..., N, 2), with valid (..., N); see `Camera.unproject`."""
        ready = PreparedInverse(self.valid_region, self.inverse_start, start)
        return undistort(distorted, self.coefficients, self.model, ready)

    def _valid_points(self, normalized: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coordinates (..., N), those that are not valid moved to the axis, and valid (..., N)."""
        points = as_points("normalized", normalized, 2)
        origin = points.new_zeros(())
        x, y, finite = finite_or(points[..., 0], points[..., 1], origin, origin)
        with torch.no_grad():
            valid = finite & in_region(x, y, self.coefficients.detach(), self.model, self.valid_region)
        return torch.where(valid, x, 0.0), torch.where(valid, y, 0.0), valid

    def extra_repr(self) -> str:
        """Model and batch for `repr`."""
        return f"model={self.model}, coefficients={tuple(self.coefficients.shape)}"


class CameraDistortion(ExtendedDistortion):
    """The distortion of a camera, which it keeps as a submodule and whose parameters it shares.

    Args:
        camera: the camera. `names` and `free` are those of its parameters, intrinsics included.
    """

    def __init__(self, camera: CameraParameters) -> None:
        torch.nn.Module.__init__(self)
        self.camera, self.model = camera, camera.model

    def __getattr__(self, name: str) -> Any:
        return getattr(super().__getattr__("camera"), name) if name in _SHARED else super().__getattr__(name)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the camera's parameters."""
        return self.camera.names

    def update_valid_region(self) -> None:
        """Compute the camera's valid region again."""
        self.camera.update_valid_region()
