"""Parameters by name, of which some receive gradients: what a camera and a distortion of its own have in common."""

from __future__ import annotations

import copy
import hashlib
from typing import Any, Self

import torch
from torch import Tensor, nn

from kcal.checks import StatedModule, as_points, as_size, require_finite
from kcal.errors import InputError
from kcal.lens.inverse import prepare_inverse
from kcal.lens.model import LensModel
from kcal.lens.projection import parameter_names
from kcal.lens.region import Region
from kcal.operation import Operations


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
        unknown = [name for name in names if name not in known]
        if unknown:
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
    """After a state was loaded, that of a network in the lens too."""
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
