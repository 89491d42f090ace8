"""The paper's residual net read literally (Eq. 11): from the distortion vector to corrections of all parameters.

    (δA, δK) = net(K*),  A = A* + δA,  K = K* + δK

For one camera K* is a constant, and so is whatever a network makes of it: the corrected camera is a camera of the same
lens model, and the weights are another way to write its parameters. So this residual can fit nothing that the
parameters themselves cannot (tests prove it), and it is here to be compared with. What the paper's Fig. 8 draws, a
correction that depends on the position, is `kcal.lens.residual`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from kcal.checks import keep_float64
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import INTRINSICS
from kcal.nets.mlp import Widths, evaluate, evaluate_with_slopes, initial_weights

# The order of a correction: of fx, fy, cx, cy in focal lengths, of coefficients as a share of themselves, the least.
_INTRINSIC_UNIT, _LENS_UNIT, _LEAST_UNIT = 1e-3, 1e-2, 1e-9
_SKEW = INTRINSICS.index("skew")


class GlobalResidual(nn.Module):
    """Corrections of a camera's parameters by a network of three layers that sees its distortion vector (Eq. 11).

    Convention: the order of parameters is `Camera.names`; skew is left as it is. K* is divided by its largest
    coefficient. Corrections come in units of a thousandth of the focal length (fx, fy, cx, cy) and of a hundredth of
    each coefficient, because those of high orders count by powers of ten more than others. A new network corrects
    nothing: its last layer is zero. Float64; weights do not require gradients until asked.

    Args:
        camera: a single parametric camera: A* and K*.
        hidden: features of each of the two hidden layers.
        seed: of their first values.

    Raises:
        InputError: a batch of cameras, a hybrid one, or a lens without coefficients.

    Example:
        >>> start = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.05])
        >>> residual = GlobalResidual(start)
        >>> bool((residual.camera().params == start.params).all())
        True
    """

    weights: Tensor
    start: Tensor
    inputs: Tensor
    units: Tensor

    def __init__(self, camera: Camera, *, hidden: int = 8, seed: int = 0) -> None:
        super().__init__()
        start = camera.params.detach()
        if start.ndim != 1 or camera.field is not None:
            raise InputError("GlobalResidual: a single parametric camera is needed")
        if camera.model.size == 0:
            raise InputError("GlobalResidual: a lens without coefficients has no distortion vector")
        self.size, self.model = camera.size, camera.model
        self.corrected = tuple(i for i in range(len(start)) if i != _SKEW)
        self.widths: Widths = (camera.model.size, hidden, hidden, len(self.corrected))
        self.weights = nn.Parameter(initial_weights(self.widths, seed).to(start.device), requires_grad=False)
        lens = start[len(INTRINSICS) :]
        units = (_LENS_UNIT * start.abs()).clamp(min=_LEAST_UNIT)
        units[: len(INTRINSICS)] = _INTRINSIC_UNIT * start[:2].mean()
        for name, value in {
            "start": start.clone(),
            "inputs": (lens / lens.abs().max().clamp(min=1e-12))[:, None],
            "units": units[list(self.corrected)],
        }.items():
            self.register_buffer(name, value)

    def forward(self) -> Tensor:
        """Corrected parameters (5 + P,), A* + δA and K* + δK."""
        return self.parameters_at(self.weights)

    def parameters_at(self, weights: Tensor) -> Tensor:
        """The corrected parameters (5 + P,) for other weights (W,)."""
        correction = self.units * evaluate(self.inputs, weights, self.widths)[:, 0]
        place = torch.tensor(self.corrected, device=correction.device)
        return self.start + torch.zeros_like(self.start).index_put((place,), correction)

    def slopes(self, weights: Tensor) -> Tensor:
        """Derivatives (C, W) of the C corrected parameters by the weights."""
        return self.units[:, None] * evaluate_with_slopes(self.inputs, weights, self.widths).by_weights[..., 0].T

    def camera(self) -> Camera:
        """The corrected camera: an ordinary one."""
        return Camera(self().detach(), size=self.size, model=self.model)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)
