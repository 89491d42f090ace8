"""The paper's residual net (Eq. 11), and its training together with an inverse net on the joint loss (Eq. 12)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import INTRINSICS, from_pixels, plane_from_points, project_components
from kcal.nets.inverse import (
    InverseFit,
    InverseNet,
    Network,
    evaluate,
    evaluate_with_slopes,
    initial_weights,
    judged_inverse,
    set_scales,
)
from kcal.solve.lm import LMOptions, SolverStatus, State, minimize
from kcal.solve.schur import SchurProblem
from kcal.texts import brief

# The paper's residual net as written (Eq. 11): from the distortion vector to corrections of all parameters.
#
#     (δA, δK) = net(K*),  A = A* + δA,  K = K* + δK
#
# For one camera K* is a constant, and so is the network's value. The corrected camera has the same lens model, and the
# weights are only another way to write its parameters: this net can fit nothing that the parameters cannot (a test
# proves it). docs/measured/paper.md has figures. The correction that depends on the position, as Fig. 8 draws it, is
# `kcal.lens.field_modes.NetworkModes`.

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


# Train a residual net and an inverse net together, on the paper's joint loss (Eq. 12).

# Called after each step with (step, loss); returning True stops.
Progress = Callable[[int, float], bool | None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointOptions:
    """Options of `train_jointly`.

    Args:
        method: "lm", Levenberg-Marquardt, or "adam", as in the paper, which ends at a larger loss after longer.
        steps: maximum number of steps; None: 100 of Levenberg-Marquardt, 2000 of Adam.
        inverse_weight: λ of Eq. 12.
        hidden: number of features in each hidden layer of the residual net, and of the inverse net.
        rates: learning rates of Adam, likewise.
        seed: seed of the initial weights.
    """

    method: Literal["lm", "adam"] = "lm"
    steps: int | None = None
    inverse_weight: float = 1.0
    hidden: tuple[int, int] = (8, 12)
    rates: tuple[float, float] = (1e-4, 1e-2)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.method not in ("lm", "adam"):
            raise InputError(f"JointOptions: method must be 'lm' or 'adam', got {self.method!r}")
        positive = (self.steps or 1, *self.hidden, *self.rates)
        if self.steps == 0 or not min(positive) > 0 or not 0 <= self.inverse_weight < math.inf:
            raise InputError(
                "JointOptions: steps, hidden and rates must be positive, inverse_weight finite and not negative"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointFit:
    """Two nets that were trained together, and how well they fit.

    Args:
        residual: the residual net.
        camera: the camera that it corrects: A* + δA, K* + δK.
        inverse: the inverse net of that camera, its errors over the whole image, the steps taken and why they ended.
        losses: (steps + 1,) of Eq. 12 in px², the start first, the lowest so far at each step.
        start_rms: sqrt(mean ‖y3 - y3*‖²) of the corners with the camera as it was given, pixels.
        rms: the same with the corrected camera.
        inverse_rms: sqrt(mean ‖y1 - y4‖²) at the corners, pixels of the center of the image.
    """

    __repr__ = brief

    residual: ResidualNet
    camera: Camera
    inverse: InverseFit
    losses: Tensor
    start_rms: float
    rms: float
    inverse_rms: float


def train_jointly(
    camera: Camera,
    points_cam: Tensor,
    pixels: Tensor,
    options: JointOptions | None = None,
    *,
    weights: Tensor | None = None,
    progress: Progress | None = None,
) -> JointFit:
    """Train `ResidualNet` and `InverseNet` of a calibrated camera on the paper's loss (Eq. 12).

        L = MSE(y3, y3*) + λ MSE(y1, y4)

    y3 are corners and y3* their projections by the corrected camera; y1 are points on the plane of the lens and y4 what
    the inverse net makes of them after the corrected lens. Both errors are in pixels: those of y1 and y4 are multiplied
    by the focal length, on the chart of `InverseNet`, which here corrects the distorted position itself. A*, K* and the
    poses of the board stay as they are. The same seed gives the same nets up to rounding.

    This is for comparison with the paper. The residual net fits nothing that the calibration did not, and the inverse
    net knows only places where corners were; `train_inverse` learns the inverse all over the image, and
    `Camera.unproject` is exact.

    Args:
        camera: a single camera with lens coefficients: A* and K*.
        points_cam: (..., N, 3) corners of the board in the camera frame, meters.
        pixels: (..., N, 2) observed corners; NaN where not seen.
        options: see `JointOptions`.
        weights: (..., N) by which residuals are multiplied; None: all count alike.
        progress: called after each step with its number and the loss; return True to stop.

    Raises:
        InputError: a batch of cameras, a hybrid lens, or shapes that do not fit.
        DegenerateError: too few corners, or the camera has no image of one of them.

    Example:
        >>> truth = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.05])
        >>> pixels = truth.grid(9, 7).reshape(-1, 2)
        >>> rays, _ = truth.unproject(pixels)
        >>> start = Camera.build(focal=(803, 803), center=(321, 240), size=(640, 480), coefficients=[-0.21, 0.05])
        >>> fit = train_jointly(start, rays, pixels)
        >>> fit.start_rms > 1.0, fit.rms < 0.01, fit.inverse_rms < 0.01
        (True, True, True)
    """
    options = options or JointOptions()
    residual = ResidualNet(camera, hidden=options.hidden[0], seed=options.seed)
    inverse = InverseNet(camera, hidden=options.hidden[1], radial=False, seed=options.seed)
    problem = _JointProblem(residual, inverse, *_seen(camera, points_cam, pixels, weights), options.inverse_weight)
    start = residual.weights.detach(), inverse.weights.detach()
    first = problem.errors(start)
    if not bool(torch.isfinite(torch.stack(first)).all()):
        raise DegenerateError("train_jointly: the camera has no image of a corner that was seen; calibrate it again")
    steps = options.steps or (100 if options.method == "lm" else 2000)
    state, losses, status = _lowest(problem, start, options, steps, progress)
    last = problem.errors(state)
    with torch.no_grad():
        residual.weights.copy_(state[0])
        inverse.weights.copy_(state[1])
    corrected = residual.camera()
    return JointFit(
        residual=residual,
        camera=corrected,
        inverse=judged_inverse(corrected, inverse, len(losses) - 1, status),
        losses=losses,
        start_rms=problem.rms(first[0]),
        rms=problem.rms(last[0]),
        inverse_rms=problem.rms(last[1]),
    )


def _seen(camera: Camera, points_cam: Tensor, pixels: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Corners that were seen: points (3, M), pixels (2, M), weights (M,)."""
    if camera.model.hybrid:
        raise InputError(
            "train_jointly: a hybrid lens has a field that depends on the position already; calibrate with a model of "
            "coefficients such as 'ext20'"
        )
    points, pixels = as_points("points_cam", points_cam, 3), as_points("pixels", pixels, 2)
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights.to(pixels)
    if points.shape[:-1] != pixels.shape[:-1] or weights.shape != pixels.shape[:-1]:
        shapes = ", ".join(str(tuple(each.shape)) for each in (points, pixels, weights))
        raise InputError(f"train_jointly: points, pixels and weights of the same corners are needed, got {shapes}")
    seen = torch.isfinite(pixels).all(-1) & (weights > 0)
    if int(seen.sum()) < len(camera.names):
        raise DegenerateError(
            f"train_jointly: {int(seen.sum())} corners are too few for {len(camera.names)} parameters"
        )
    return points[seen].T, pixels[seen].T, weights[seen]


def _lowest(
    problem: _JointProblem, start: State, options: JointOptions, steps: int, progress: Progress | None
) -> tuple[State, Tensor, SolverStatus]:
    """The state of the lowest loss, the lowest loss so far after each step, and why it ended."""
    if options.method == "lm":
        result = minimize(
            problem, start, LMOptions(max_iterations=steps, tolerance=1e-8, flatness=1e-6),
            None if progress is None else lambda step, cost: progress(step, 2.0 * float(cost)),
        )  # fmt: skip
        return result.state, 2.0 * result.history, SolverStatus(int(result.status))
    moving = tuple(weights.clone().requires_grad_() for weights in start)
    optimizer = torch.optim.Adam([{"params": [w], "lr": r} for w, r in zip(moving, options.rates, strict=True)])
    losses, best, status = [math.inf], start, SolverStatus.ITERATION_LIMIT
    for step in range(steps + 1):
        loss = 2.0 * problem.cost(moving)
        value = float(loss.detach())
        if value < losses[-1]:
            best = tuple(weights.detach().clone() for weights in moving)
        losses.append(min(losses[-1], value))
        if not math.isfinite(value):
            status = SolverStatus.STALLED
            break
        if step and progress is not None and progress(step, value):
            status = SolverStatus.INTERRUPTED
            break
        if step < steps:
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return best, torch.tensor(losses[1:], dtype=torch.float64), status


def _before_intrinsics(pixels: Tensor, parameters: Tensor) -> Tensor:
    """Distorted coordinates (2, M) of pixels (2, M)."""
    return torch.stack(from_pixels(pixels[0], pixels[1], parameters))


class _JointProblem(SchurProblem):
    """Residuals of Eq. 12 as functions of the weights of both nets: a state is (residual's, inverse's).

    Args:
        residual: A*, K* and the form of the residual net.
        inverse: the form of the inverse net; its scales are set here.
        points: (3, M).
        corners: (2, M).
        weight: (M,).
        balance: λ.
    """

    batch: tuple[int, ...] = ()
    local_size = 0

    def __init__(
        self,
        residual: ResidualNet,
        inverse: InverseNet,
        points: Tensor,
        corners: Tensor,
        weight: Tensor,
        balance: float,
    ) -> None:
        self._residual, self._inverse, self._points, self._corners = residual, inverse, points, corners
        self._share = weight / weight.square().sum().sqrt()
        self.residual_count = 2 * corners.numel()
        self._before = torch.stack(
            inverse.to_chart(*plane_from_points(points[0], points[1], points[2], residual.model))
        )
        self._focal = float(residual.start[:2].mean())
        self._balance = math.sqrt(balance) * self._focal
        seen = project_components(points, residual.start, residual.model)
        set_scales(inverse, _before_intrinsics(seen.pixels, residual.start), self._before)

    def errors(self, state: State) -> tuple[Tensor, Tensor]:
        """y3* - y3 and y4 - y1, both (2, M) in pixels and without weights; NaN where the lens is not regular."""
        parameters = self._residual.parameters_at(state[0])
        seen = project_components(self._points, parameters, self._residual.model)
        distorted = _before_intrinsics(seen.pixels, parameters)
        net = evaluate(distorted / self._inverse.reach, state[1], self._inverse.widths)
        after = distorted + self._inverse.amplitude * net
        error = torch.where(seen.regular, seen.pixels - self._corners, torch.nan)
        return error, self._focal * (after - self._before)

    def rms(self, errors: Tensor) -> float:
        """sqrt(mean ‖e‖²) of errors (2, M), all counting alike."""
        return float(errors.detach().square().sum(0).mean().sqrt())

    def residuals(self, state: State) -> Tensor:
        """See `SchurProblem.residuals`; their squares add up to the loss."""
        seen, undone = self.errors(state)
        return (self._share * torch.cat([seen, self._balance / self._focal * undone])).flatten()[None]

    def rows(self, state: State) -> Tensor:
        """See `SchurProblem.rows`."""
        return self._chain(state).T @ self._own_rows(state)

    def gram(self, state: State) -> Tensor:
        """See `SchurProblem.gram`: from products by the parameters, which are far fewer than their net's weights."""
        rows, chain = self._own_rows(state), self._chain(state)
        return (chain.T @ (rows @ rows.T) @ chain)[None]

    def retract(self, state: State, step: State) -> State:
        """See `SchurProblem.retract`."""
        first, second = step[0].split([len(weights) for weights in state])
        return state[0] + first, state[1] + second

    def _chain(self, state: State) -> Tensor:
        """Derivatives of parameters, inverse weights and the residual by this problem's columns."""
        rest = torch.eye(len(state[1]) + 1, dtype=torch.float64, device=state[1].device)
        return torch.block_diag(self._residual.slopes(state[0]), rest)

    def _own_rows(self, state: State) -> Tensor:
        """(C + W + 1, 4 M) as `rows`, by the C corrected parameters in place of the residual's weights."""
        inverse, wanted = self._inverse, self._residual.corrected
        parameters = self._residual.parameters_at(state[0])
        seen = project_components(self._points, parameters, self._residual.model, wanted)
        distorted = _before_intrinsics(seen.pixels, parameters)
        fx, fy, _, _, skew = parameters[: len(INTRINSICS)]
        # What intrinsics do to pixels is undone by `from_pixels`.
        of_lens = torch.tensor([i >= len(INTRINSICS) for i in wanted], device=fx.device)[:, None]
        down = of_lens * seen.by_camera[:, 1] / fy
        moved = torch.stack([(of_lens * seen.by_camera[:, 0] - skew * down) / fx, down], 1)
        net = evaluate_with_slopes(distorted / inverse.reach, state[1], inverse.widths)
        rate = inverse.amplitude / inverse.reach
        moved = moved + rate * torch.einsum("cim,iom->com", moved, net.by_input)
        after = distorted + inverse.amplitude * net.values
        error = torch.where(seen.regular, seen.pixels - self._corners, torch.nan)
        by_weights = inverse.amplitude * net.by_weights
        first = torch.cat([seen.by_camera, torch.zeros_like(by_weights), error[None]])
        second = torch.cat([moved, by_weights, (after - self._before)[None]])
        return (self._share * torch.cat([first, self._balance * second], 1)).flatten(1)
