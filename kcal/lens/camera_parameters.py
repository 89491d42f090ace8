"""Parameters by name, of which some receive gradients, and the distortion of a camera as a module of its own."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from kcal.checks import StatedModule, as_points, as_size, require_finite
from kcal.dispatch import finite_or
from kcal.errors import InputError
from kcal.lens.inverse import InverseStart, PreparedInverse, prepare_inverse, undistort
from kcal.lens.model import LensModel, distort_components
from kcal.lens.projection import parameter_names
from kcal.lens.region import Region, in_region
from kcal.operation import Operations
from kcal.texts import briefly

# Parameters by name, of which some receive gradients: what a camera and a distortion of its own have in common.


class LensParameters(Operations, StatedModule):
    """Named parameters that contain lens coefficients, which of them are free, and where their lens is valid.

    Args:
        what: of the parameters, for errors.
        parameters: (..., P) in the order of `names`.
        model: the lens model.
    """

    params: Tensor
    free_mask: Tensor
    field: nn.Module | None
    valid_radius: Tensor
    valid_edge: Tensor
    valid_cuts: Tensor
    inverse_start: Tensor

    def __init__(self, what: str, parameters: Tensor, model: LensModel) -> None:
        super().__init__()
        # A network in the lens is this module's own: it trains, moves between devices and is copied with it.
        self.model = model if model.network is None else copy.deepcopy(model)
        self.field = self.model.network
        parameters = as_points(what, parameters, len(self.names))
        require_finite(what, parameters)
        if 0 in parameters.shape[:-1]:
            raise InputError(f"{what}: a batch of at least one is needed, got {tuple(parameters.shape)}")
        self.params = nn.Parameter(parameters.detach().clone(), requires_grad=False)
        free = torch.ones(len(self.names), dtype=torch.bool, device=parameters.device)
        self.register_buffer("free_mask", free)

    def _measure_region(self) -> None:
        """Register what follows from the parameters, and so is not part of the saved state."""
        for name, value in self._measured_region().items():
            self.register_buffer(name, value, persistent=False)
        self.register_load_state_dict_post_hook(_with_new_region)

    @property
    def constants(self) -> object:
        """The lens model, without the weights of a network in it, which are part of the state."""
        form = self.model.hybrid
        return self.model.names, form if form is None or self.model.network is None else (form.shape, form.radius)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in storage order: those of the lens coefficients."""
        return self.model.names

    @property
    def wide(self) -> bool:
        """See `LensModel.wide`."""
        return self.model.wide

    @property
    def values(self) -> Tensor:
        """The parameters in the order of `names`; gradients reach only the free ones."""
        if not self.params.requires_grad:
            return self.params
        return torch.where(self.free_mask, self.params, self.params.detach())

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the parameters that receive gradients; empty while all are frozen."""
        if not self.params.requires_grad:
            return ()
        return tuple(name for name, free in zip(self.names, self.free_mask.tolist(), strict=True) if free)

    def free(self, *names: str) -> Self:
        """Let gradients reach these parameters only; without names, all but skew. Return the module itself.

        "field" names the weights of the network in the lens, where there is one (`camera.field`).

        The choice is part of the state (`free_mask`). Frozen parameters get a gradient of exactly zero, but weight
        decay in an optimizer would still move them. `requires_grad_(False)` freezes all of them again.

        Raises:
            InputError: an unknown parameter name.

        Example:
            >>> from kcal import Camera
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480)).free("fx", "k1")
            >>> camera.project(torch.tensor([[1.0, 1.0, 4.0]]))[0].sum().backward()
            >>> [name for name, g in zip(camera.names, camera.params.grad) if g != 0]
            ['fx', 'k1']
        """
        known = self.names if self.field is None else (*self.names, "field")
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"unknown parameter {unknown[0]!r}: there are {', '.join(known)}")
        chosen = names or tuple(name for name in known if name != "skew")
        with torch.no_grad():
            self.free_mask.copy_(torch.tensor([name in chosen for name in self.names]))
        if self.field is not None:
            self.field.requires_grad_("field" in chosen)
        self.params.requires_grad_(True)
        return self

    def attached(self, parameters: Tensor) -> Self:
        """Put parameters of autograd's graph in place of equal ones. Return the camera itself.

        They are a buffer then, of the same name in `state_dict`.
        """
        del self.params
        self.register_buffer("params", parameters)
        return self

    @property
    def coefficients(self) -> Tensor:
        """(..., P) lens coefficients in the order of `model.names`."""
        return self.values[..., len(self.names) - self.model.size :]

    @property
    def valid_region(self) -> Region:
        """The region where the lens is valid, on the plane z = 1 (for a fisheye, on the plane of angles)."""
        return Region(self.valid_radius, self.valid_edge, self.valid_cuts)

    def _reach(self) -> Tensor | None:
        """(...) largest distorted radius that will be asked for; None: not known."""
        return None

    @torch.no_grad()
    def _measured_region(self) -> dict[str, Tensor]:
        (radius, edge, cuts), start, _ = prepare_inverse(self.coefficients.detach(), self.model, self._reach())
        return {"valid_radius": radius, "valid_edge": edge, "valid_cuts": cuts, "inverse_start": start}

    def update_valid_region(self) -> None:
        """Compute the valid region again; call this after changing parameters in place."""
        for name, value in self._measured_region().items():
            setattr(self, name, value)


def _with_new_region(module: Any, _: Any) -> None:
    """Measure the region anew after a state was loaded, also one of a network in the lens."""
    module.update_valid_region()


class CameraParameters(LensParameters):
    """What every camera has: parameters (..., 5 + P), a size and a lens model. The base class of `Camera`.

    Args:
        parameters: (..., 5 + P), as for `Camera`.
        size: (width, height) of the image in pixels.
        model: the lens model.

    Raises:
        InputError: see `Camera`.
    """

    def __init__(self, parameters: Tensor, size: tuple[int, int], model: LensModel) -> None:
        super().__init__("camera parameters", parameters, model)
        self.size = as_size(size)
        if not bool((self.params[..., :2] > 0).all()):
            raise InputError("camera parameters: focal lengths must be positive, in pixels")

    @property
    def constants(self) -> object:
        """Size and lens model."""
        return self.size, super().constants

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in storage order: fx, fy, cx, cy, skew, then the lens coefficients."""
        return parameter_names(self.model)

    @property
    def focal(self) -> Tensor:
        """(..., 2) focal lengths fx, fy in pixels."""
        return self.values[..., 0:2]

    @property
    def center(self) -> Tensor:
        """(..., 2) principal point cx, cy in pixels."""
        return self.values[..., 2:4]

    @property
    def matrix(self) -> Tensor:
        """(..., 3, 3) intrinsic matrix A of Eq. 3."""
        fx, fy, cx, cy, skew = self.values[..., :5].unbind(-1)
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        return torch.stack([fx, skew, cx, zero, fy, cy, zero, zero, one], -1).unflatten(-1, (3, 3))

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with any parameter, the model or the image size."""
        constants = (self.model.hybrid,) if self.model.hybrid else ()
        text = repr((self.size, self.model.names, self.params.detach().flatten().tolist(), *constants))
        return hashlib.sha256(text.encode()).hexdigest()[:12]


# Distortion as a module of its own: normalized points in, distorted points out, and back.

# What a camera's distortion does not have of its own.
_SHARED = frozenset(LensParameters.__annotations__)


@briefly
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
