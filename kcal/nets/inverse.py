"""The learned inverse of a lens: the paper's Inv_NN (Fig. 8, Eq. 12), as a start for Newton's method.

Three layers map a distorted position to a correction of a closed-form guess: the tilt undone and the radial polynomial
of `kcal.lens.inverse`, or, as in the paper, the distorted position itself. A network is never exact and does not
know where a lens folds, so it only gives `Camera.unproject` a first guess. Newton's method and the valid region decide
about the answer.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kcal.checks import StatedModule, as_points
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.inverse import start_from, undo_tilt
from kcal.lens.projection import from_pixels, plane_from_points, rays_from_plane
from kcal.solve.lm import DenseLinearization, DenseProblem, LMOptions, Problem, Result, SolverStatus, State, minimize
from kcal.texts import brief

# Small fully connected networks as functions of one vector of weights, with closed-form Jacobians.
#
# Convention: features come first and points last, (..., F, N). Hidden layers are tanh, the last layer is linear.
# `widths` lists the features of each stage: (2, 8, 8, 2) has three layers. All weights are one vector: for each layer
# the matrix (out, in) row by row, then the bias (out,).

Widths = tuple[int, ...]
# Standard deviations of the initial first-layer weights, whose inputs lie in [-1, 1], and of the hidden biases: wide
# enough for tanh to bend, narrow enough not to saturate.
_FIRST_SPREAD, _BIAS_SPREAD = 1.5, 0.5


class NetValues(NamedTuple):
    """Values (..., out, N); their derivatives by the inputs (..., in, out, N) and by the weights (..., P, out, N)."""

    values: Tensor
    by_input: Tensor
    by_weights: Tensor


class Network(StatedModule):
    """Base of networks: one vector of float64 weights, without gradients until asked."""

    weights: Tensor

    def __init__(self, widths: Widths, weights: Tensor) -> None:
        super().__init__()
        self.widths = widths
        self.weights = nn.Parameter(weights, requires_grad=False)

    @property
    def constants(self) -> object:
        """Widths of the layers."""
        return self.widths


def initial_weights(widths: Widths, seed: int = 0) -> Tensor:
    """Draw random hidden layers and a last layer of zeros, so that the network's value is zero everywhere.

    Raises:
        InputError: fewer than two stages, or a stage without features.
    """
    if len(widths) < 2 or min(widths) < 1:
        raise InputError(f"network: at least two stages of at least one feature are needed, got {widths}")
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for layer, (inside, out) in enumerate(itertools.pairwise(widths)):
        matrix = torch.randn(out, inside, generator=generator, dtype=torch.float64) * inside**-0.5
        bias = torch.randn(out, generator=generator, dtype=torch.float64) * _BIAS_SPREAD
        if layer == 0:
            matrix = matrix * _FIRST_SPREAD
        if layer == len(widths) - 2:
            matrix, bias = torch.zeros_like(matrix), torch.zeros_like(bias)
        parts += [matrix.flatten(), bias]
    return torch.cat(parts)


def layers(weights: Tensor, widths: Widths) -> list[tuple[Tensor, Tensor]]:
    """Split weights (P,) into one matrix (out, in) and bias (out, 1) per layer."""
    found, place = [], 0
    for inside, out in itertools.pairwise(widths):
        end = place + out * inside
        found.append((weights[place:end].unflatten(0, (out, inside)), weights[end : end + out, None]))
        place = end + out
    return found


def evaluate(inputs: Tensor, weights: Tensor, widths: Widths) -> Tensor:
    """Evaluate the network: values (..., out, N) at inputs (..., in, N)."""
    *hidden, (matrix, bias) = layers(weights, widths)
    values = inputs
    for inner, offset in hidden:
        values = torch.tanh(inner @ values + offset)
    return matrix @ values + bias


def evaluate_with_slopes(inputs: Tensor, weights: Tensor, widths: Widths) -> NetValues:
    """As `evaluate`, with derivatives by the inputs and by every weight (backpropagation in closed form)."""
    stack = layers(weights, widths)
    stages = [inputs]
    for matrix, bias in stack[:-1]:
        stages.append(torch.tanh(matrix @ stages[-1] + bias))
    matrix, bias = stack[-1]
    values = matrix @ stages[-1] + bias
    out, count = values.shape[-2:]
    # Derivative of each value by the sums that enter a stage, (..., stage, out, N).
    identity = torch.eye(out, dtype=values.dtype, device=values.device)
    slope = identity[..., None].expand(*values.shape[:-2], out, out, count)
    columns = []
    for stage, (matrix, _) in zip(reversed(stages), reversed(stack), strict=True):
        by_matrix = slope[..., :, None, :, :] * stage[..., None, :, None, :]
        columns.append(torch.cat([by_matrix.flatten(-4, -3), slope], -3))
        slope = torch.einsum("oi,...okn->...ikn", matrix, slope)
        if stage is not inputs:
            slope = slope * (1.0 - stage * stage)[..., None, :]
    return NetValues(values, slope, torch.cat(columns[::-1], -3))


# The fit that all networks share: least squares over their weights by Levenberg-Marquardt.


@torch.no_grad()
def fit_weights(net: Network, problem: Problem, start: State, options: LMOptions | None = None) -> Result:
    """Minimize a problem whose states begin with the network's weights, and copy the weights found into `net`."""
    result = minimize(problem, start, options)
    net.weights.copy_(result.state[0])
    return result


class RegressionProblem(DenseProblem):
    """Residuals net(inputs) - targets, with the Jacobian in closed form. The state is the vector of weights (P,).

    Args:
        inputs: (in, N).
        targets: (out, N).
        widths: features of each stage.
    """

    def __init__(self, inputs: Tensor, targets: Tensor, widths: Widths) -> None:
        super().__init__(lambda weights: (evaluate(inputs, weights, widths) - targets).flatten(), ())
        self._inputs, self._targets, self._widths = inputs, targets, widths

    def linearize(self, state: State) -> DenseLinearization:
        """See `Problem.linearize`."""
        net = evaluate_with_slopes(self._inputs, state[0], self._widths)
        residuals = (net.values - self._targets).flatten()
        self.residual_count = len(residuals)
        # Contiguous with the weights last, as the normal equations read it.
        return DenseLinearization(residuals, net.by_weights.flatten(-2).T.contiguous())


# The learned inverse.

# 1 - |p|² / 4 on the chart at 89.9° off axis, the smallest divisor on the way back to the plane z = 1.
_SMALLEST_DIVISOR = 1.0 - math.tan(math.radians(89.9 / 2)) ** 2


class InverseNet(Network):
    """Map distorted to undistorted coordinates by a network of three layers (Eq. 12 of the paper).

    Convention: both lie on the plane of the lens: z = 1, or the plane of angles for a fisheye. The network works on a
    chart on which wide angles do not grow without bound. For the plane z = 1 it is the stereographic chart
    p = 2 x / (1 + √(1 + |x|²)), where 90° is |p| = 2; the plane of angles is used as it is. With p0 the closed-form
    guess, p = p0 + a · net(p0 / r), where r and a (`reach`, `amplitude`) scale inputs and outputs to the order of one.
    The last layer of a new network is zero, so that it returns the guess. Train it with `train_inverse`.

    The weights and `forward` are float64. As a start for Newton's method (`guess`), the correction alone is computed in
    float32, because the iterations that follow need no more digits.

    Args:
        camera: a single camera; the net copies what the guess needs to know of its lens.
        hidden: number of features in each of the two hidden layers.
        radial: correct the closed-form guess; False: correct the distorted position itself, as in the paper.
        seed: seed of the initial weights.

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

    reach: Tensor
    amplitude: Tensor
    coefficients: Tensor
    start: Tensor

    def __init__(self, camera: Camera, *, hidden: int = 12, radial: bool = True, seed: int = 0) -> None:
        values = camera.params.detach()
        if values.ndim != 1:
            raise InputError(f"InverseNet: a single camera is needed, got a batch of {tuple(values.shape[:-1])}")
        widths = (2, hidden, hidden, 2)
        super().__init__(widths, initial_weights(widths, seed).to(values.device))
        self.model, self.radial = camera.model, radial
        self.register_buffer("reach", values.new_ones(()))
        self.register_buffer("amplitude", values.new_ones(()))
        self.register_buffer("coefficients", values[5:].clone())
        self.register_buffer("start", camera.inverse_start.clone())

    @property
    def constants(self) -> object:
        """Widths, lens model, and what is corrected."""
        return self.widths, self.model.names, self.radial

    def closed_form(self, x: Tensor, y: Tensor) -> Tensor:
        """The guess that the network corrects: (..., 2, N) on the chart, for distorted coordinates x, y (..., N)."""
        if self.radial:
            x, y, _, rest = undo_tilt(x, y, self.coefficients, self.model)
            x, y = self.to_chart(*start_from(x, y, rest, self.start))
        return torch.stack([x, y], -2)

    def to_chart(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Map undistorted coordinates (..., N) to the network's chart."""
        if self.model.fisheye:
            return x, y
        square = torch.addcmul(x * x, y, y)
        scale = 2.0 * (1.0 + torch.sqrt(1.0 + square)).reciprocal()
        return x * scale, y * scale

    def from_chart(self, p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """The inverse of `to_chart`; positions beyond 89.9° off axis are moved to 89.9°, in the same direction."""
        if self.model.fisheye:
            return p, q
        scale = (1.0 - 0.25 * torch.addcmul(p * p, q, q)).clamp(min=_SMALLEST_DIVISOR).reciprocal()
        return p * scale, q * scale

    def forward(self, distorted: Tensor) -> Tensor:
        """Map distorted (..., N, 2) to undistorted coordinates (..., N, 2), approximately and without a validity mask.

        Raises:
            InputError: a wrong shape or an integer dtype.
        """
        distorted = as_points("distorted", distorted, 2)
        return torch.stack(self._corrected(distorted[..., 0], distorted[..., 1], torch.float64), -1)

    def guess(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """The `start` of `Camera.unproject`: roughly undistorted coordinates for distorted ones x, y (..., N)."""
        return self._corrected(x, y, torch.float32)

    def _corrected(self, x: Tensor, y: Tensor, precision: torch.dtype) -> tuple[Tensor, Tensor]:
        guess = self.closed_form(x, y)
        correction = evaluate((guess / self.reach).to(precision), self.weights.to(precision), self.widths)
        moved = guess + self.amplitude * correction.to(torch.float64)
        return self.from_chart(moved[..., 0, :], moved[..., 1, :])

    def extra_repr(self) -> str:
        """Widths and what is corrected, for `repr`."""
        return f"widths={self.widths}, corrects {'the radial start' if self.radial else 'the distorted position'}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class InverseNetOptions:
    """Options of `train_inverse`.

    Args:
        hidden: number of features in each hidden layer.
        radial: see `InverseNet`.
        samples: (columns, rows) of the training pixels, at Chebyshev nodes: denser towards the image's edges.
        iterations: maximum number of trial steps of Levenberg-Marquardt.
        seed: seed of the initial weights.
    """

    hidden: int = 12
    radial: bool = True
    samples: tuple[int, int] = (40, 26)
    iterations: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        if self.hidden < 1 or min(self.samples) < 2 or self.iterations < 1:
            raise InputError("InverseNetOptions: hidden and iterations must be at least 1, samples at least 2 x 2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class InverseFit:
    """A trained inverse net and its accuracy without Newton's method.

    Args:
        net: the network.
        rms: RMS reprojection error in pixels of the net's answers, over a grid of pixels of the image that have a ray
            and were not used for training.
        largest: the largest of these errors; infinite if an answer lies outside the lens's valid region.
        start_rms: RMS error of the closed-form guess that the net corrects.
        start_largest: the largest error of that guess.
        iterations: number of trial steps taken.
        status: why the training stopped.
    """

    __repr__ = brief

    net: InverseNet
    rms: float
    largest: float
    start_rms: float
    start_largest: float
    iterations: int
    status: SolverStatus


@torch.no_grad()
def train_inverse(camera: Camera, options: InverseNetOptions | None = None) -> InverseFit:
    """Train an inverse net for a camera: least squares of net(distorted) - undistorted (Eq. 12, the term of y1 and y4).

    The paper trains with Adam on board points. Here the lens is known, so the training data are pixels all over the
    image with their exact rays, compared on the chart of `InverseNet`, and Levenberg-Marquardt fits the few hundred
    weights. The same seed gives the same net up to rounding.

    Args:
        camera: a single camera.
        options: see `InverseNetOptions`.

    Raises:
        InputError: a batch of cameras.
        DegenerateError: too few pixels have a ray to determine half of the weights.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="opencv5",
        ...                       coefficients=[-0.2, 0.05, 0.01, -0.01, 0.0])
        >>> fit = train_inverse(camera, InverseNetOptions(hidden=4, iterations=40))
        >>> fit.start_largest > 1.0, fit.largest < 0.1
        (True, True)
    """
    options = options or InverseNetOptions()
    net = InverseNet(camera, hidden=options.hidden, radial=options.radial, seed=options.seed)
    pixels = _training_pixels(camera, options.samples)
    rays, valid = camera.unproject(pixels)
    if 4 * int(valid.sum()) < net.weights.numel():
        raise DegenerateError(
            f"only {int(valid.sum())} of {len(pixels)} training pixels have a ray, too few for {net.weights.numel()} "
            "weights; check the camera, use more samples or fewer hidden features"
        )
    X, Y, Z = rays[valid].unbind(-1)
    truth = torch.stack(net.to_chart(*plane_from_points(X, Y, Z, camera.model)))
    guess = net.closed_form(*_distorted(camera, pixels[valid]))
    set_scales(net, guess, truth)
    problem = RegressionProblem(guess / net.reach, (truth - guess) / net.amplitude, net.widths)
    # A correction to 1e-9 of its largest value is more than any start needs.
    limits = LMOptions(max_iterations=options.iterations, tolerance=1e-6, residual_floor=1e-9)
    result = fit_weights(net, problem, (net.weights.detach(),), limits)
    return judged_inverse(camera, net, int(result.iterations), SolverStatus(int(result.status)))


@torch.no_grad()
def judged_inverse(camera: Camera, net: InverseNet, iterations: int, status: SolverStatus) -> InverseFit:
    """The errors of a net, and of the guess that it corrects, over the image of a camera."""
    # Between the training pixels, and dense enough to find the largest error to a few per cent.
    pixels = camera.grid(97, 55).reshape(-1, 2)
    pixels = pixels[camera.unproject(pixels)[1]]
    x, y = _distorted(camera, pixels)
    before = _reprojection_errors(camera, pixels, *net.from_chart(*net.closed_form(x, y).unbind(-2)))
    after = _reprojection_errors(camera, pixels, *net(torch.stack([x, y], -1)).unbind(-1))
    return InverseFit(
        net=net,
        rms=_rms(after),
        largest=float(after.max()),
        start_rms=_rms(before),
        start_largest=float(before.max()),
        iterations=iterations,
        status=status,
    )


def _training_pixels(camera: Camera, counts: tuple[int, int]) -> Tensor:
    """Chebyshev nodes (columns * rows, 2) over the image and a margin of 5 %, because nets extrapolate badly."""
    axes = []
    for size, count in zip(camera.size, counts, strict=True):
        place = -torch.cos(math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count)
        axes.append(0.5 * (size - 1) + 0.5 * size * 1.05 * place)
    return torch.stack(torch.meshgrid(*axes, indexing="xy"), -1).reshape(-1, 2).to(camera.params.device)


def _distorted(camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Distorted coordinates x, y (N,) of pixels (N, 2)."""
    return from_pixels(pixels[:, 0], pixels[:, 1], camera.params)


def _reprojection_errors(camera: Camera, pixels: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Reprojection errors (N,) in pixels of points x, y (N,) of the lens's plane."""
    again, seen = camera.project_rays(torch.stack(rays_from_plane(x, y, camera.model), -1))
    return torch.where(seen, torch.linalg.vector_norm(again - pixels, dim=-1), torch.inf)


def set_scales(net: InverseNet, guess: Tensor, truth: Tensor) -> None:
    """Set `reach` and `amplitude` of a net to the largest lengths of guesses (2, N) and of their corrections."""
    # The floor only keeps a division by it finite.
    for scale, values in ((net.reach, guess), (net.amplitude, truth - guess)):
        scale.copy_(torch.linalg.vector_norm(values, dim=0).amax().clamp(min=1e-12))


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
