"""Surveyed landmarks as a block of least squares: positions that the survey knows, light that bends, shared effects.

Light bends downward: a landmark at the level distance d is seen k d² / 2R higher than it stands, k being the
coefficient of refraction and R the Earth's radius.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.rig.blocks import Block, Effects, Kind, RigState

# 1/m: half the curvature of the Earth, of the mean radius (IUGG) everywhere: a third of a percent of the bending.
_HALF_CURVATURE = 0.5 / 6_371_008.8
_UP = 2


class LandmarkBlock(Block):
    """Surveyed points, whose adjusted positions are the unknowns.

    Args:
        pixels: (V, C, 2), see `Block`.
        whitening: (V, C, 2, 2), see `Block`.
        points: (V, 3) meters, as surveyed; the third axis is up.
        sigma: (V, 3) meters.
        by_refraction: (K,) of the coefficient of refraction by the unknowns; None: it is held.
        effects: see `Block`.
        shifts: (E, V, C, 3) see `LandmarkEffect`; needed with effects.
    """

    kind: Kind = "landmarks"
    size = 3

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        points: Tensor,
        sigma: Tensor,
        by_refraction: Tensor | None = None,
        effects: Effects | None = None,
        shifts: Tensor | None = None,
    ) -> None:
        super().__init__(pixels[:, :, None], whitening[:, :, None], effects)
        self._surveyed, self._sigma, self._by_refraction, self._shifts = points, sigma, by_refraction, shifts

    def _prior_count(self) -> Tensor:
        return torch.full((len(self),), 3)

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        return state.points[..., None], state.points.new_ones(len(self), 1, 1)

    def _moves(self, state: RigState, camera: int) -> Tensor:
        return super()._moves(state, camera) if self._shifts is None else self._shifts[:, :, camera]

    def _bent(self, state: RigState, offset: Tensor, camera: int) -> Tensor:
        level, up = offset[:, :_UP], offset[:, _UP:]
        return torch.cat([level, up + state.refraction * _HALF_CURVATURE * level.square().sum(1, keepdim=True)], 1)

    def _by_offset(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        slope = 2.0 * state.refraction * _HALF_CURVATURE * offset[:, :_UP, None]
        return torch.cat([by_q[:, :_UP] + slope * by_q[:, _UP:], by_q[:, _UP:]], 1)

    def _through(self) -> Tensor | None:
        return None if self._by_refraction is None else self._by_refraction[None]

    def _by_board_or_air(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        lift = _HALF_CURVATURE * offset[:, :_UP, None].square().sum(1, keepdim=True)
        return lift * by_q[:, _UP:]

    def _by_local(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        return by_q

    def _prior(self, state: RigState) -> Tensor | None:
        # The survey.
        error = (state.points - self._surveyed) / self._sigma
        return torch.cat([torch.diag_embed(1.0 / self._sigma), error[:, None]], 1)

    def retract(self, state: RigState, step: Tensor) -> RigState:
        """See `Block.retract`."""
        return state._replace(points=state.points + step)
