"""Stars as a block of least squares: directions at infinity, which clocks and the air shift together."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.rig.blocks import Block, Effects, Kind, RigState
from kcal.lens.pose import side_axes


class StarBlock(Block):
    """Stars, each with a direction of its own that the catalogue knows, if the star has a name.

    Camera c sees star i in the direction d_i + Σ_e u_e (t_ec × d_i + s_ei) with the unknowns u_e of clocks and air,
    which are standard normal beforehand.

    Args:
        pixels: (V, C, 2), see `Block`.
        whitening: (V, C, 2, 2), see `Block`.
        direction: (V, 3) of the catalogue; anything for stars without a name.
        sigma: (V,) radians; infinite for these.
        turns: (E, C, 3), see `StarSource.by_effects`.
        factors: (E, V), see `StarSource.factors`.
        shifts: (E, V, 3), see `StarSource.shifts`.
        effects: see `Block`; its amounts are the u_e.
    """

    kind: Kind = "stars"
    size = 2

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        direction: Tensor,
        sigma: Tensor,
        turns: Tensor,
        factors: Tensor,
        shifts: Tensor,
        effects: Effects | None = None,
    ) -> None:
        super().__init__(pixels[:, :, None], whitening[:, :, None], effects)
        named = torch.isfinite(sigma)
        self._weight = torch.where(named, 1.0 / sigma, 0.0)
        self._known = torch.where(named[:, None], direction, 0.0)
        # (E, C, V, 3).
        self._turns = turns[:, :, None] * factors[:, None, :, None]
        self._shifts = shifts

    def _prior_count(self) -> Tensor:
        return 2 * (self._weight > 0).long()

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        return state.star[..., None], state.star.new_zeros(len(self), 1, 1)

    def _moves(self, state: RigState, camera: int) -> Tensor:
        turned = torch.linalg.cross(self._turns[:, camera], state.star.expand(len(self._turns), -1, -1))
        return turned + self._shifts

    def _by_local(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        return torch.einsum("vjun,vlj->vlun", by_q, torch.stack(side_axes(state.star), 1))

    def _prior(self, state: RigState) -> Tensor | None:
        # The catalogue: along the two axes across the star's direction.
        axes = torch.stack(side_axes(state.star), 1)
        error = torch.einsum("vlj,vj->vl", axes, state.star - self._known) * self._weight[:, None]
        rows = torch.diag_embed(self._weight[:, None].expand(-1, 2))
        return torch.cat([rows, torch.where(self._weight[:, None] > 0, error, 0.0)[:, None]], 1)

    def retract(self, state: RigState, step: Tensor) -> RigState:
        """See `Block.retract`."""
        first, second = side_axes(state.star)
        moved = state.star + step[:, :1] * first + step[:, 1:2] * second
        return state._replace(star=moved / torch.linalg.vector_norm(moved, dim=-1, keepdim=True))
