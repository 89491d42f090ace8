"""The paper's residual net as written (Eq. 11): from the distortion vector to corrections of all parameters.

    (δA, δK) = net(K*),  A = A* + δA,  K = K* + δK

For one camera K* is a constant, and so is the network's value. The corrected camera has the same lens model, and the
weights are only another way to write its parameters: this net can fit nothing that the parameters cannot (a test proves
it). docs/measured/paper.md has figures. The correction that depends on the position, as Fig. 8 draws it, is
`kcal.lens.network_modes.NetworkModes`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import INTRINSICS
from kcal.nets.mlp import Network, evaluate, evaluate_with_slopes, initial_weights

_SKEW = INTRINSICS.index("skew")


class ResidualNet(Network):
    """Corrections of a camera's parameters by a network of three layers that sees its distortion vector (Eq. 11).

    Convention: parameters in the order of `Camera.names`; skew is not corrected. The network's input is K* divided by
    its largest coefficient. Its outputs are scaled to thousandths of the focal length (fx, fy, cx, cy) and hundredths
    of each coefficient, because coefficients differ by powers of ten. A new network corrects nothing: its last layer is
    zero. Float64; the weights do not require gradients until asked. `train_jointly` trains them on corners; what
    that changes comes of its loss, not of the net, which fits nothing that a calibration of the same model cannot.

    Args:
        camera: a single camera: A* and K*.
        hidden: number of features in each of the two hidden layers.
        seed: seed of the initial weights.

    Raises:
        InputError: a batch of cameras, or a lens without coefficients.

    Example:
        >>> start = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.05])
        >>> net = ResidualNet(start)
        >>> bool((net.camera().params == start.params).all())
        True

        Gradients reach the weights through any method of the camera:

        >>> camera = net.requires_grad_().camera(differentiable=True)
        >>> camera.project(torch.tensor([[0.1, 0.2, 1.0]]))[0].sum().backward()
        >>> bool((net.weights.grad != 0).any())
        True
    """

    start: Tensor
    inputs: Tensor
    units: Tensor

    def __init__(self, camera: Camera, *, hidden: int = 8, seed: int = 0) -> None:
        start = camera.params.detach()
        if start.ndim != 1:
            raise InputError(f"ResidualNet: a single camera is needed, got a batch of {tuple(start.shape[:-1])}")
        if camera.model.size == 0:
            raise InputError("ResidualNet: a lens without coefficients has no distortion vector")
        corrected = tuple(i for i in range(len(start)) if i != _SKEW)
        widths = (camera.model.size, hidden, hidden, len(corrected))
        super().__init__(widths, initial_weights(widths, seed).to(start.device))
        self.size, self.model, self.corrected = camera.size, camera.model, corrected
        lens = start[len(INTRINSICS) :]
        # The floors keep the scales of zero coefficients finite.
        units = (1e-2 * start.abs()).clamp(min=1e-9)
        units[: len(INTRINSICS)] = 1e-3 * start[:2].mean()
        self.register_buffer("start", start.clone())
        self.register_buffer("inputs", (lens / lens.abs().max().clamp(min=1e-12))[:, None])
        self.register_buffer("units", units[list(corrected)])

    @property
    def constants(self) -> object:
        """Widths, size, lens model, and what is corrected."""
        return self.widths, self.size, self.model.names, self.corrected

    def forward(self) -> Tensor:
        """Corrected parameters (5 + P,): A* + δA and K* + δK."""
        return self.parameters_at(self.weights)

    def parameters_at(self, weights: Tensor) -> Tensor:
        """The corrected parameters (5 + P,) for other weights (W,)."""
        correction = self.units * evaluate(self.inputs, weights, self.widths)[:, 0]
        place = torch.tensor(self.corrected, device=correction.device)
        return self.start + torch.zeros_like(self.start).index_put((place,), correction)

    def slopes(self, weights: Tensor) -> Tensor:
        """Derivatives (C, W) of the C corrected parameters by the weights."""
        return self.units[:, None] * evaluate_with_slopes(self.inputs, weights, self.widths).by_weights[..., 0].T

    def camera(self, *, differentiable: bool = False) -> Camera:
        """The corrected camera: an ordinary one; `differentiable`: in the graph of this net's weights."""
        values = self()
        camera = Camera(values.detach(), size=self.size, model=self.model)
        return camera.attached(values) if differentiable else camera
