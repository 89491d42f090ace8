"""Kalman filter and smoother of the attitude of both cameras: from looks at the scene to the turn of any moment."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.chance import chi2_quantile
from kcal.lens.rig import StereoRig
from kcal.watch.model import HEAT_SIGMA, LASTING_S, TurnModel

# Of the state: slow turns, lasting errors of the looks, errors of the lenses between the cameras, turns per kelvin.
_SLOW, _LASTING, _BIAS, _HEAT = slice(0, 6), slice(6, 12), slice(12, 17), slice(17, 23)
SIZE = 23
# Radians by which lenses may be wrong between the cameras: some tenths of a pixel.
_LENS_SIGMA = 3e-4
# A look that chance makes so unlikely once in a million is doubted, until so many in a row say the same.
_CHANCE, _AGREE = 1.0 - 1e-6, 3
_GATES = torch.cat([torch.ones(1, dtype=torch.float64),
                    chi2_quantile(torch.arange(1.0, 12.0, dtype=torch.float64), _CHANCE)])  # fmt: skip


class Look(NamedTuple):
    """What the images of one moment tell; leading dimensions (...) are separate rigs.

    Attributes:
        turn: (..., 6) radians of the left and right camera since the reference; what is not seen is not read.
        covariance: (..., 6, 6) of it, as one look tells.
        lasting: (...) share of that covariance that lasts (light and shade).
        seen: (..., 2) whether there is a turn of each camera.
        between: (..., 5) of `between_rows`, from matches between the cameras.
        between_covariance: (..., 5, 5).
        matched: (...) whether there are such.
        kelvin: (...) of warming since the reference; zeros where nobody measures.
    """

    turn: Tensor
    covariance: Tensor
    lasting: Tensor
    seen: Tensor
    between: Tensor
    between_covariance: Tensor
    matched: Tensor
    kelvin: Tensor


class TurnState(NamedTuple):
    """What is known at a moment.

    Attributes:
        mean: (..., 23).
        covariance: (..., 23, 23).
        doubt: (..., 6) radians by which the last looks contradict the state, if they do.
        strikes: (...) how many in a row did.
        kelvin: (...) of the last look.
        lasting: (..., 6) variance of lasting errors, of the last look.
    """

    mean: Tensor
    covariance: Tensor
    doubt: Tensor
    strikes: Tensor
    kelvin: Tensor
    lasting: Tensor


class Turns(NamedTuple):
    """Turn of both cameras at a moment: (..., 6) radians, and (..., 6, 6)."""

    mean: Tensor
    covariance: Tensor


def between_rows(rig: StereoRig) -> Tensor:
    """(5, 6): what matches between the cameras can tell of turns of both.

    These are the turn of the right camera against the left one (3, about the right one's axes), and of the baseline's
    direction in the left camera's frame (2). A turn of both about the baseline shows in no match.
    """
    rotation = rig.right_from_left_rotation
    axis = -(rotation.T @ rig.right_from_left_translation)
    beside = torch.linalg.svd(axis[None])[2][1:]
    across = torch.linalg.cross((axis / axis.norm()).expand(2, 3), beside)
    zero = torch.zeros(2, 3, dtype=torch.float64)
    return torch.cat([torch.cat([-rotation, torch.eye(3, dtype=torch.float64)], 1), torch.cat([across, zero], 1)])


def first_state(model: TurnModel, lead: tuple[int, ...] = ()) -> TurnState:
    """Before the first look."""
    variance = torch.zeros(*lead, SIZE, dtype=torch.float64)
    variance[..., _SLOW], variance[..., _BIAS], variance[..., _HEAT] = model.swing**2, _LENS_SIGMA**2, HEAT_SIGMA**2
    zero = torch.zeros(*lead, 6, dtype=torch.float64)
    return TurnState(
        mean=torch.zeros(*lead, SIZE, dtype=torch.float64),
        covariance=torch.diag_embed(variance),
        doubt=zero, strikes=zero[..., 0], kelvin=zero[..., 0], lasting=zero,
    )  # fmt: skip


def passed(state: TurnState, seconds: Tensor, model: TurnModel) -> tuple[TurnState, Tensor]:
    """The state after a time (...), and (..., 23) what each part keeps."""
    keep = torch.ones_like(state.mean)
    keep[..., _SLOW] = torch.exp(-seconds[..., None] / model.return_s)
    keep[..., _LASTING] = torch.exp(-seconds / LASTING_S)[..., None]
    more = torch.zeros_like(state.mean)
    more[..., _SLOW] = model.swing**2
    more[..., _LASTING] = state.lasting
    covariance = keep[..., None] * state.covariance * keep[..., None, :]
    covariance = covariance + torch.diag_embed((1.0 - keep**2) * more)
    return state._replace(mean=keep * state.mean, covariance=covariance), keep


def taken(state: TurnState, look: Look, model: TurnModel, rows: Tensor) -> TurnState:
    """The state after a look of the same moment; `rows` are those of `between_rows`.

    A look that contradicts the state is doubted and widens what is told of that moment. Three in a row that do are
    believed: somebody has hit the mast.
    """
    share = look.lasting[..., None]
    own = look.covariance.diagonal(dim1=-2, dim2=-1)
    first = (state.lasting == 0).all(-1, keepdim=True)
    variance = state.covariance.diagonal(dim1=-2, dim2=-1).clone()
    # The first look tells how much may last.
    variance[..., _LASTING] = torch.where(first, share * own, variance[..., _LASTING])
    spread = (
        state.covariance - torch.diag_embed(state.covariance.diagonal(dim1=-2, dim2=-1)) + torch.diag_embed(variance)
    )
    design, noise, wanted, there = _rows_of(look, model, rows)
    off = torch.where(there, wanted - (design @ state.mean[..., None])[..., 0], 0.0)

    def innovation(prior: Tensor) -> Tensor:
        return design @ prior @ design.mT + noise

    square = (off * torch.linalg.solve(innovation(spread), off[..., None])[..., 0]).sum(-1)
    strange = square > _GATES[there.sum(-1)]
    strikes = torch.where(strange, state.strikes + 1.0, 0.0)
    believed = strange & (strikes >= _AGREE)
    jump = torch.where(there[..., :6], off[..., :6], 0.0)
    wider = torch.zeros_like(variance)
    wider[..., _SLOW] = torch.where(believed[..., None], jump**2, 0.0)
    spread = spread + torch.diag_embed(wider)
    gain = torch.linalg.solve(innovation(spread), design @ spread).mT
    used = (~strange | believed)[..., None]
    rest = torch.eye(SIZE, dtype=torch.float64) - gain @ design
    after = rest @ spread @ rest.mT + gain @ noise @ gain.mT
    return TurnState(
        mean=torch.where(used, state.mean + (gain @ off[..., None])[..., 0], state.mean),
        covariance=torch.where(used[..., None], after, spread),
        doubt=torch.where(used, 0.0, torch.maximum(state.doubt, jump.abs())),
        strikes=torch.where(believed, 0.0, strikes),
        kelvin=look.kelvin,
        lasting=torch.where(look.seen.repeat_interleave(3, -1), share * own, state.lasting),
    )


def _rows_of(look: Look, model: TurnModel, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Design (..., 11, 23), covariance (..., 11, 11), what was measured (..., 11) and which of it there is."""
    there = torch.cat([look.seen.repeat_interleave(3, -1), look.matched[..., None].expand(*look.matched.shape, 5)], -1)
    by_turn = torch.cat([torch.eye(6, dtype=torch.float64), rows])
    design = torch.zeros(*there.shape, SIZE, dtype=torch.float64)
    design[..., _SLOW] = by_turn
    design[..., :6, _LASTING] = torch.eye(6, dtype=torch.float64)
    design[..., 6:, _BIAS] = torch.eye(5, dtype=torch.float64)
    design[..., _HEAT] = look.kelvin[..., None, None] * by_turn
    # Wind turns both measurements of a moment alike.
    noise = (by_turn * model.gust[..., None, :] ** 2) @ by_turn.mT
    noise = noise.expand(*there.shape, 11).clone()
    noise[..., :6, :6] += (1.0 - look.lasting)[..., None, None] * look.covariance
    noise[..., 6:, 6:] += look.between_covariance
    both = there[..., None] & there[..., None, :]
    noise = torch.where(both, noise, 0.0) + torch.diag_embed((~there).double())
    wanted = torch.cat([look.turn, look.between], -1)
    return torch.where(there[..., None], design, 0.0), noise, torch.where(there, wanted, 0.0), there


def turns_of(state: TurnState, model: TurnModel, *, gusts: bool = True) -> Turns:
    """The turn of both cameras; with the wind of the moment, or only what lasts beyond it (for alarms)."""
    whole = torch.zeros(*state.mean.shape[:-1], 6, SIZE, dtype=torch.float64)
    whole[..., _SLOW] = torch.eye(6, dtype=torch.float64)
    whole[..., _HEAT] = state.kelvin[..., None, None] * torch.eye(6, dtype=torch.float64)
    covariance = whole @ state.covariance @ whole.mT
    more = state.doubt**2 + (model.gust**2 if gusts else 0.0)
    return Turns((whole @ state.mean[..., None])[..., 0], covariance + torch.diag_embed(more))


def smoothed(states: list[TurnState], times: list[float], model: TurnModel) -> list[TurnState]:
    """What is known of each moment from all looks, those after it too (H. Rauch, F. Tung and C. Striebel 1965).

    Args:
        states: after each look, in turn.
        times: seconds of these.
        model: of the turns.
    """
    found = list(states)
    for k in range(len(states) - 2, -1, -1):
        later, here = found[k + 1], states[k]
        prior, keep = passed(here, torch.tensor(times[k + 1] - times[k], dtype=torch.float64), model)
        if bool(states[k + 1].strikes == 0) and bool(here.strikes > 0) and _jumped(states[k + 1], prior):
            # Believed after doubts: what came after the jump tells nothing of before.
            continue
        gain = torch.linalg.solve(prior.covariance + 1e-24 * torch.eye(SIZE, dtype=torch.float64),
                                  keep[:, None] * here.covariance).mT  # fmt: skip
        mean = here.mean + gain @ (later.mean - prior.mean)
        covariance = here.covariance + gain @ (later.covariance - prior.covariance) @ gain.mT
        found[k] = here._replace(mean=mean, covariance=0.5 * (covariance + covariance.mT))
    return found


def _jumped(after: TurnState, prior: TurnState) -> bool:
    move = (after.mean - prior.mean)[_SLOW]
    return bool((move.abs() > 4.0 * prior.covariance.diagonal()[_SLOW].sqrt()).any())
