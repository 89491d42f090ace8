"""The parameters of a camera by name: which there are, which receive gradients, and their fingerprint."""

from __future__ import annotations

import copy
import hashlib
from typing import Self

import torch
from torch import Tensor, nn

from kcal.checks import Float64Module, as_points, as_size, require_finite
from kcal.errors import InputError
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, parameter_names


class CameraParameters(Float64Module):
    """What every camera has: parameters (..., 5 + P), a size and a lens model. The base class of `Camera`.

    Args:
        parameters: (..., 5 + P), as for `Camera`.
        size: (width, height) of the image in pixels.
        model: the lens model.

    Raises:
        InputError: see `Camera`.
    """

    params: Tensor
    free_mask: Tensor
    field: nn.Module | None

    def __init__(self, parameters: Tensor, size: tuple[int, int], model: LensModel) -> None:
        super().__init__()
        # A network in the lens is this camera's own: it trains, moves between devices and is copied with it.
        self.model = model if model.network is None else copy.deepcopy(model)
        self.field = self.model.network
        self.size = as_size(size)
        parameters = as_points("camera parameters", parameters, 5 + model.size)
        require_finite("camera parameters", parameters)
        if not bool((parameters[..., :2] > 0).all()):
            raise InputError("camera parameters: focal lengths must be positive, in pixels")
        self.params = nn.Parameter(parameters.detach().clone(), requires_grad=False)
        self.register_buffer("free_mask", torch.ones(5 + model.size, dtype=torch.bool, device=parameters.device))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in storage order: fx, fy, cx, cy, skew, then the lens coefficients."""
        return parameter_names(self.model)

    @property
    def values(self) -> Tensor:
        """(..., 5 + P) the parameters; gradients reach only the free ones."""
        if not self.params.requires_grad:
            return self.params
        return torch.where(self.free_mask, self.params, self.params.detach())

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the parameters that receive gradients; empty while the camera is frozen."""
        if not self.params.requires_grad:
            return ()
        return tuple(name for name, free in zip(self.names, self.free_mask.tolist(), strict=True) if free)

    def free(self, *names: str) -> Self:
        """Let gradients reach these parameters only; without names, all but skew. Return the camera itself.

        "field" names the weights of the network in the lens, where there is one (`camera.field`).

        The choice is part of the state (`free_mask`). Frozen parameters get a gradient of exactly zero, but weight
        decay in an optimizer would still move them. `requires_grad_(False)` freezes the whole camera again.

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
            raise InputError(f"unknown parameter {unknown[0]!r}: the camera has {', '.join(known)}")
        chosen = names or tuple(name for name in known if name != "skew")
        with torch.no_grad():
            self.free_mask.copy_(torch.tensor([name in chosen for name in self.names]))
        if self.field is not None:
            self.field.requires_grad_("field" in chosen)
        self.params.requires_grad_(True)
        return self

    @property
    def focal(self) -> Tensor:
        """(..., 2) focal lengths fx, fy in pixels."""
        return self.values[..., 0:2]

    @property
    def center(self) -> Tensor:
        """(..., 2) principal point cx, cy in pixels."""
        return self.values[..., 2:4]

    @property
    def coefficients(self) -> Tensor:
        """(..., P) lens coefficients in the order of `model.names`."""
        return self.values[..., len(INTRINSICS) :]

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
