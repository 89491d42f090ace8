"""Train the network of a field together with camera, poses, motions and board.

Of all unknowns, those inside the network (`kcal.lens.field_modes`) are the only ones that the solver does not know.
Where everything else is at its optimum, the derivative of the least cost by them is the partial one (variable
projection, Golub and Pereyra 1973). So both take turns: a few steps of the network's weights, then rounds of solver and
evidence. What counts in the end is the evidence, so that a step which only follows the noise is taken back.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call, jacrev, vmap

from kcal.calibrate.hybrid.families import BEFORE_LENS
from kcal.calibrate.hybrid.fitted_views import Estimate, FittedViews, Rounds, run_rounds
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.errors import InputError
from kcal.lens.field_modes import NetworkModes
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, project_components
from kcal.solve.schur import products_of, without_local

# Nats by which a turn must raise the evidence for another one.
_WORTH = 1.0
# Steps of the solver after each step of the network, as `kcal.calibrate.hybrid.fitted_views` has them.
_FOLLOW = (12, 0.02)
# Steps by Gauss-Newton in a turn; by Adam, as many times so many with everything else held.
_STEPS, _ADAM_STEPS, _RATE = 5, 40, 0.01
_DAMPING = 1e-3
# Views whose derivatives by the network's weights are formed at a time.
_VIEWS = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldTraining:
    """How the network of a field is trained (`kcal.CalibrationOptions.field`).

    Args:
        optimizer: of the weights before the last layer: "gauss-newton" or "adam". The last layer is always solved for
            exactly, with its error bars.
        turns: most of them; each is some steps of the network, then solver and evidence. Fewer if the evidence stays.
        spread: standard deviation of the prior on each of these weights, about its initial value.

    Raises:
        InputError: another optimizer, fewer than one turn, or a spread that is not positive.

    Example:
        >>> FieldTraining(optimizer="adam").turns
        6
    """

    optimizer: Literal["gauss-newton", "adam"] = "gauss-newton"
    turns: int = 6
    spread: float = 0.5

    def __post_init__(self) -> None:
        if self.optimizer not in ("gauss-newton", "adam"):
            raise InputError(f"FieldTraining: optimizer must be gauss-newton or adam, got {self.optimizer!r}")
        if self.turns < 1 or not 0 < self.spread < math.inf:
            raise InputError(f"FieldTraining: turns and spread must be positive, got {self.turns} and {self.spread}")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Turn:
    """Views, and what is known of the network's weights."""

    capture: FittedViews
    initial: Tensor
    spread: float

    def pull(self, weights: Tensor) -> Tensor:
        """Half the squared distance of the network's weights to their initial values, in spreads: nats."""
        return 0.5 * ((weights - self.initial) / self.spread).square().sum()

    def cost(self, problem: BoardProblem, estimate: Estimate) -> float:
        """Of everything, px²."""
        return float(problem.cost(estimate.state) + estimate.variance * self.pull(weights_of(_trunk(estimate))))


def train_network(rounds: Rounds, options: FieldTraining, progress: Callable[[str], object] = lambda _: None) -> Rounds:
    """Train the network of a fit's field, beginning where the fit converged.

    Args:
        rounds: where it did.
        options: see there.
        progress: called after each turn.

    Returns:
        the rounds of largest evidence, prior of the network's weights included.
    """
    initial = weights_of(_trunk(rounds.estimate))
    if not len(initial):
        return rounds
    best, loss = rounds, rounds.untempered_loss
    for number in range(options.turns):
        turn = _Turn(capture=best.capture, initial=initial, spread=options.spread)
        step = _gauss_newton if options.optimizer == "gauss-newton" else _adam
        estimate, spent = step(turn, best.estimate)
        if estimate is best.estimate:
            break
        found = run_rounds(best.capture, estimate, spent=best.steps + spent)
        value = found.untempered_loss + float(turn.pull(weights_of(_trunk(found.estimate))))
        progress(f"network, turn {number + 1}")
        if not value < loss - _WORTH:
            best = found if value < loss else best
            break
        best, loss = found, value
    return best


def _trunk(estimate: Estimate) -> nn.Module:
    network = estimate.model.network
    assert network is not None
    return network


def weights_of(trunk: nn.Module) -> Tensor:
    """(T,) all weights of a network."""
    parts = [part.detach().flatten() for part in trunk.parameters()]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.float64)


def _with_weights(estimate: Estimate, weights: Tensor) -> Estimate:
    """An estimate with other weights (T,) inside its network; how fine features are follows them."""
    form = estimate.model.hybrid
    assert form is not None
    assert isinstance(form.modes, NetworkModes)
    trunk = copy.deepcopy(form.modes.trunk)
    with torch.no_grad():
        for part, values in zip(trunk.parameters(), _split(trunk, weights), strict=True):
            part.copy_(values)
    modes = NetworkModes(trunk, vector=form.modes.vector)
    degree = estimate.families.degree.clone()
    first = BEFORE_LENS + len(form.leading)
    degree[first : first + len(modes)] = torch.tensor([p.degree for p in modes.weight_priors])
    model = LensModel(hybrid=dataclasses.replace(form, modes=modes))
    return estimate._replace(model=model, families=estimate.families._replace(degree=degree))


def _split(trunk: nn.Module, weights: Tensor) -> list[Tensor]:
    """The weights (T,) as those of the network."""
    pieces = weights.split([part.numel() for part in trunk.parameters()])
    return [piece.view_as(part) for piece, part in zip(pieces, trunk.parameters(), strict=True)]


class _Moved:
    """What pixels of the corners do as the weights inside the network change, everything else being held.

    The field is added on a plane that does not depend on it, so that this is exact, and not only to first order.
    """

    def __init__(self, turn: _Turn, problem: BoardProblem, estimate: Estimate) -> None:
        model, state = estimate.model, estimate.state
        assert model.hybrid is not None
        assert isinstance(model.hybrid.modes, NetworkModes)
        self.vector, self.trunk = model.hybrid.modes.vector, model.hybrid.modes.trunk
        points = problem.shown(problem.points(state)).transpose(-1, -2)
        plane = project_components(points, state.parameters[None], model, (0,)).plane
        assert plane is not None
        self.factor = problem.shown(torch.where(turn.capture.seen, turn.capture.weights, 0.0))
        self.places = torch.where(self.factor[..., None] > 0, plane.transpose(-1, -2) / model.hybrid.radius, 0.0)
        self.coefficients = state.parameters[len(INTRINSICS) + len(model.hybrid.leading) :]
        self.focal = state.parameters[:2]
        self.names = [name for name, _ in self.trunk.named_parameters()]

    def pixels(self, weights: Tensor, places: Tensor) -> Tensor:
        """(..., 2) pixels by the field at places (..., 2) on the disc."""
        named = dict(zip(self.names, _split(self.trunk, weights), strict=True))
        features = functional_call(self.trunk, named, (places.reshape(-1, 2),))
        own = self.coefficients
        both = own * torch.eye(2).to(own) if self.vector else own.unflatten(0, (2, -1))
        return (self.focal * (features @ both.T)).view(places.shape)

    def rows(self, weights: Tensor, views: slice) -> Tensor:
        """(V, T, 2 K) weighted derivatives of pixels of some views by the weights; corners as in the problem."""
        places = self.places[views]
        try:
            found = vmap(jacrev(self.pixels), in_dims=(None, 0))(weights, places.reshape(-1, 2))
        except RuntimeError as error:
            raise InputError(
                f"the network of the field cannot be trained by Gauss-Newton, which needs torch.func.vmap: {error}; "
                'use FieldTraining(optimizer="adam")'
            ) from error
        weighted = found.view(*places.shape, -1) * self.factor[views][..., None, None]
        return weighted.permute(0, 3, 2, 1).flatten(-2)


def _gauss_newton(turn: _Turn, estimate: Estimate) -> tuple[Estimate, int]:
    """A few steps by all unknowns together, of which the solver then finds its own again; also its trial steps."""
    spent, damping = 0, _DAMPING
    problem = turn.capture.problem(estimate)
    cost = turn.cost(problem, estimate)
    for _ in range(_STEPS):
        weights = weights_of(_trunk(estimate))
        total = _joint_products(turn, problem, estimate)
        H, g = total[:-1, :-1], total[:-1, -1]
        for _ in range(4):
            # Weights that nothing depends on, and unknowns that are held, stay.
            scale = torch.where(H.diagonal() > 0, (1.0 + damping) * H.diagonal(), 1.0).rsqrt()
            unit = H * scale[:, None] * scale + torch.diag(damping / (1.0 + damping) * (H.diagonal() > 0)).to(H)
            unit.diagonal().masked_fill_(H.diagonal() <= 0, 1.0)
            step = -scale * torch.linalg.solve(unit, g * scale)
            trial = _with_weights(estimate, weights + step[-len(weights) :])
            problem, trial, steps = turn.capture.solved(trial, _FOLLOW)
            spent += steps
            value = turn.cost(problem, trial)
            if value < cost:
                break
            damping *= 10.0
        else:
            return estimate, spent
        gained, cost, estimate, damping = cost - value, value, trial, 0.1 * damping
        if gained < _FOLLOW[1] * estimate.variance:
            break
    return estimate, spent


def _joint_products(turn: _Turn, problem: BoardProblem, estimate: Estimate) -> Tensor:
    """(S + T + 1, S + T + 1) products of derivatives by the solver's unknowns, by the network's, and of residuals."""
    state, weights = estimate.state, weights_of(_trunk(estimate))
    moved, L = _Moved(turn, problem, estimate), problem.local_size
    kept = torch.cat([torch.arange(L), L + problem.moving])
    size, count = len(problem.moving), len(weights)
    total = state.parameters.new_zeros(size + count + 1, size + count + 1)
    for first in range(0, len(state.rotation), _VIEWS):
        views = slice(first, first + _VIEWS)
        rows, own = problem.rows(state, views), moved.rows(weights, views)
        # Motions have priors beside the corners.
        own = torch.cat([own, own.new_zeros(*own.shape[:-1], rows.shape[-1] - own.shape[-1])], -1)
        both = torch.cat([rows[:, kept], own, rows[:, -1:]], 1)
        total += products_of(without_local(both, L).transpose(0, 1).flatten(1))
    place = torch.cat([torch.arange(size), torch.tensor([size + count])])
    total[place[:, None], place] += problem.shared_gram(state)
    precision = estimate.variance / turn.spread**2
    total.diagonal()[size:-1] += precision
    total[size:-1, -1] += precision * (weights - turn.initial)
    return total


def _adam(turn: _Turn, estimate: Estimate) -> tuple[Estimate, int]:
    """Steps down the partial derivative of the cost, and after each few of them the solver's; also its trial steps."""
    spent = 0
    problem = turn.capture.problem(estimate)
    cost = turn.cost(problem, estimate)
    for _ in range(_STEPS):
        moved, weights = _Moved(turn, problem, estimate), weights_of(_trunk(estimate)).requires_grad_()
        errors = problem.shown(problem.pixel_errors(estimate.state).transpose(-1, -2))
        with torch.no_grad():
            rest = torch.where(moved.factor[..., None] > 0, errors, 0.0) - moved.pixels(weights, moved.places)
        optimizer = torch.optim.Adam([weights], lr=_RATE)
        for _ in range(_ADAM_STEPS):
            optimizer.zero_grad()
            residuals = moved.factor[..., None] * (rest + moved.pixels(weights, moved.places))
            (0.5 * residuals.square().sum() + estimate.variance * turn.pull(weights)).backward()
            optimizer.step()
        trial = _with_weights(estimate, weights.detach())
        problem, trial, steps = turn.capture.solved(trial, _FOLLOW)
        spent += steps
        value = turn.cost(problem, trial)
        if not value < cost:
            break
        cost, estimate = value, trial
    return estimate, spent
