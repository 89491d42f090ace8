"""The learned inverse of a lens: the paper's Inv_NN (Fig. 8, Eq. 12), as a start for Newton's method.

Three layers see a distorted position and say where the undistorted one lies, relative to a guess in closed form: the
tilt undone and the radial polynomial of `kcal.lens.inverse_start`, or, as the paper has it, the distorted position
itself. A network is never exact, and it does not know where a lens folds. So it is no inverse by itself:
`Camera.unproject` takes it as a first guess, and Newton's method and the valid region decide about the answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from kcal.checks import as_points, keep_float64
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.inverse_start import start_from, without_tilt
from kcal.nets.mlp import Widths, evaluate, initial_weights

# 1 - |p|² / 4 at 89.9° off axis, the least that the plane z = 1 is divided by.
_RIM = 1.0 - math.tan(math.radians(89.9 / 2)) ** 2


class InverseNet(nn.Module):
    """Distorted to undistorted coordinates by a network of three layers (Eq. 12 of the paper).

    Convention: both on the plane of the lens: z = 1, for a fisheye the plane of angles. Distorted positions of a hybrid
    camera are those before its residual field, which is undone by Newton steps of its own. The network works on a chart
    where wide angles take no more room than in an image: of the plane z = 1 the stereographic one,
    p = 2 x / (1 + √(1 + |x|²)), where 90° is |p| = 2; the plane of angles is such a chart itself. With p0 the guess in
    closed form, p = p0 + a · net(p0 / r): r and a (`reach`, `amplitude`) bring inputs and outputs to the order of one.
    A new network is all guess: its last layer is zero. Train it with `kcal.nets.inverse_fit.train_inverse`.

    The weights are float64 like everything in kcal, and so is `forward`. As a start for Newton's method (`guess`) the
    correction alone is computed in float32: the iteration that follows asks for no more digits.

    Args:
        camera: a single camera; what the guess needs to know of its lens is copied.
        hidden: features of each of the two hidden layers.
        radial: correct the closed-form guess; False: correct the distorted position itself, as in the paper (it is
            taken for the guess on the chart).
        seed: of the hidden layers' first values.

    Raises:
        InputError: a batch of cameras, or no hidden feature.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.05])
        >>> net = InverseNet(camera)
        >>> net(torch.tensor([[0.3, 0.2]], dtype=torch.float64)).shape
        torch.Size([1, 2])
        >>> pixels = torch.tensor([[500.0, 400.0]])
        >>> (ray, _), (again, _) = camera.unproject(pixels), camera.unproject(pixels, start=net.guess)
        >>> bool((again - ray).abs().max() < 1e-12)
        True
    """

    weights: Tensor
    reach: Tensor
    amplitude: Tensor
    coefficients: Tensor
    start: Tensor

    def __init__(self, camera: Camera, *, hidden: int = 12, radial: bool = True, seed: int = 0) -> None:
        super().__init__()
        values = camera.params.detach()
        if values.ndim != 1:
            raise InputError(f"one camera has one inverse net, this is a batch of {tuple(values.shape[:-1])}")
        self.widths: Widths = (2, hidden, hidden, 2)
        self.model, self.radial = camera.model, radial
        self.weights = nn.Parameter(initial_weights(self.widths, seed).to(values.device), requires_grad=False)
        for name, value in {
            "reach": values.new_ones(()),
            "amplitude": values.new_ones(()),
            "coefficients": values[5:].clone(),
            "start": camera.inverse_start.clone(),
        }.items():
            self.register_buffer(name, value)

    def closed_form(self, x: Tensor, y: Tensor) -> Tensor:
        """What the network corrects: the guess (..., 2, N) on the chart for distorted coordinates x, y (..., N)."""
        if self.radial:
            x, y, _, rest = without_tilt(x, y, self.coefficients, self.model)
            x, y = self.to_chart(*start_from(x, y, rest, self.start))
        return torch.stack([x, y], -2)

    def to_chart(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Undistorted coordinates (..., N) to the network's chart."""
        if self.model.fisheye:
            return x, y
        square = torch.addcmul(x * x, y, y)
        scale = 2.0 * (1.0 + torch.sqrt(1.0 + square)).reciprocal()
        return x * scale, y * scale

    def from_chart(self, p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """The inverse of `to_chart`; what lies beyond 89.9° is taken for 89.9° off axis in its direction."""
        if self.model.fisheye:
            return p, q
        scale = (1.0 - 0.25 * torch.addcmul(p * p, q, q)).clamp(min=_RIM).reciprocal()
        return p * scale, q * scale

    def forward(self, distorted: Tensor) -> Tensor:
        """Distorted (..., N, 2) to undistorted coordinates (..., N, 2), as good as the network is; no mask.

        Raises:
            InputError: wrong shapes or an integer dtype.
        """
        distorted = as_points("distorted", distorted, 2)
        return torch.stack(self._corrected(distorted[..., 0], distorted[..., 1], torch.float64), -1)

    def guess(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """A start for Newton's method at distorted coordinates x, y (..., N); see `Camera.unproject`."""
        return self._corrected(x, y, torch.float32)

    def _corrected(self, x: Tensor, y: Tensor, precision: torch.dtype) -> tuple[Tensor, Tensor]:
        guess = self.closed_form(x, y)
        correction = evaluate((guess / self.reach).to(precision), self.weights.to(precision), self.widths)
        moved = guess + self.amplitude * correction.to(torch.float64)
        return self.from_chart(moved[..., 0, :], moved[..., 1, :])

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)

    def extra_repr(self) -> str:
        """Widths and what is corrected, for `repr`."""
        return f"widths={self.widths}, corrects {'the radial start' if self.radial else 'the distorted position'}"
