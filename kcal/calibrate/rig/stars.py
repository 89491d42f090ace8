"""Stars that several cameras of a rig saw at the same moments, as a source of a rig."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from kcal.calibrate.rig.resection import consensus_rotation
from kcal.calibrate.rig.source import (
    Block,
    Context,
    Effect,
    Effects,
    ItemSource,
    MarkBlock,
    RigState,
    Start,
    as_items,
    first_rays,
)
from kcal.checks import require_finite
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose, side_axes
from kcal.texts import brief


def star_turns(effects: Sequence[Effect], stars: int, cameras: int) -> Tensor:
    """(E, C, S, 3) radians by which each camera sees each star turned at one sigma of each effect."""
    found = torch.zeros(len(effects), cameras, stars, 3, dtype=torch.float64)
    for own, effect in zip(found, effects, strict=True):
        if effect.turn is not None:
            own += effect.turn[:, None] * (1.0 if effect.factor is None else effect.factor[:, None])
    return found


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarSource(ItemSource):
    """Stars that cameras of a rig saw at the same moments, each with its own sigma.

    A star is at infinity: it tells how the cameras are turned against each other, yaw included, and where it has a
    name, how they stand on the Earth. It tells nothing of where they stand. `kcal.stars.star_source` makes it from
    images.

    Args:
        names: one for each star in each pair of images.
        pixels: (S, C, 2), NaN where a camera did not see it.
        pixel_sigma: (S, C) of a star along an axis, px.
        direction: (S, 3) unit vectors in the local frame, refracted; NaN for stars without a name.
        direction_sigma: (S,) radians, of the catalogue and of the model of refraction; infinite without a name.
        effects: what shifts all stars together: the clocks, the air.

    Raises:
        InputError: shapes that do not fit, or sigmas that are not positive.
    """

    __repr__ = brief

    kind = "stars"
    checks: ClassVar[str] = f"{ItemSource.checks}, and time, zone and place of the night images"
    turns: ClassVar[bool] = True

    names: tuple[str, ...]
    pixels: Tensor
    pixel_sigma: Tensor
    direction: Tensor
    direction_sigma: Tensor
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count, shape = len(self.names), self.pixels.shape
        self.check_marks()
        if self.pixel_sigma.shape != shape[:2]:
            raise InputError(f"stars: pixels ({count}, C, 2) and a sigma for each are needed")
        if self.direction.shape != (count, 3) or self.direction_sigma.shape != (count,):
            raise InputError(f"stars: directions ({count}, 3) and a sigma ({count},) are needed")
        seen = torch.isfinite(self.pixels).all(-1)
        if not bool((self.pixel_sigma[seen] > 0).all() & torch.isfinite(self.pixel_sigma[seen]).all()):
            raise InputError("stars: every pixel_sigma must be a positive number")
        if not bool((self.direction_sigma > 0).all()):
            raise InputError("stars: every direction_sigma must be positive; it is infinite without a name")
        require_finite("stars: directions", self.direction[self.named])

    @property
    def named(self) -> Tensor:
        """(S,) whether a star's direction is known."""
        return torch.isfinite(self.direction_sigma)

    def check(self, cameras: int, *, absolute: bool) -> None:
        """See `Source.check`."""
        super().check(cameras, absolute=absolute)
        if bool(self.named.any()) and not absolute:
            raise InputError("stars with names need a frame on the Earth: landmarks, or a camera's measured position")

    def enough(self, cameras: Sequence[Camera]) -> Tensor:
        """See `ItemSource.enough`; a star without a name tells only how two cameras are turned against each other."""
        return self.marked.sum(-1) >= 2 - self.named.long()

    def poses(self, cameras: Sequence[Camera], places: Mapping[int, Tensor]) -> dict[int, Pose]:
        """See `Source.poses`; of cameras whose centers are measured."""
        found = {}
        for c, place in places.items():
            rays, valid = cameras[c].unproject(self.pixels[:, c])
            use = valid & self.named
            if int(use.sum()) >= 2:
                found[c] = Pose.at(consensus_rotation(rays[use], self.direction[use])[0], place)
        return found

    def begin(self, cameras: Sequence[Camera], start: Start) -> Tensor:
        """See `ItemSource.begin`; as the catalogue has it, or along the ray of the first camera that sees it."""
        nothing = torch.zeros(len(self.names), dtype=torch.float64)
        seen = first_rays(cameras, start, self.pixels, nothing, start.center[0])
        direction = torch.where(self.named[:, None], self.direction, seen)
        return as_items(direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True))

    def block(self, mask: Tensor, given: Context) -> Block:
        """See `ItemSource.block`."""
        count, cameras = self.pixels.shape[:2]
        white = torch.eye(2, dtype=torch.float64) / (given.times * self.pixel_sigma[mask][..., None, None])
        known = self.direction[mask], given.times * self.direction_sigma[mask]
        turns = star_turns(self.effects, count, cameras)[:, :, mask]
        return StarBlock(self.pixels[mask], white, *known, turns, given.effects and given.effects.some(mask))

    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """See `ItemSource.doubt`."""
        return f"off by {off} ({sigmas:.0f} sigma): not that star, or an aircraft or satellite"


class StarBlock(MarkBlock):
    """Stars, each with a unit vector (V, 3) that the catalogue knows, if the star has a name.

    Camera c sees star i in the direction d_i + Σ_e u_e (t_eci × d_i + s_eic) with the unknowns u_e of clocks and air,
    which are standard normal beforehand.

    Args:
        pixels: (V, C, 2), see `MarkBlock`.
        whitening: (V, C, 2, 2), see `MarkBlock`.
        direction: (V, 3) of the catalogue; anything for stars without a name.
        sigma: (V,) radians; infinite for these.
        turns: (E, C, V, 3) radians, see `star_turns`.
        effects: see `MarkBlock`; its amounts are the u_e.
    """

    kind = "stars"
    size = 2

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        direction: Tensor,
        sigma: Tensor,
        turns: Tensor,
        effects: Effects | None = None,
    ) -> None:
        super().__init__(pixels, whitening, effects)
        named = torch.isfinite(sigma)
        self._weight = torch.where(named, 1.0 / sigma, 0.0)
        self._known = torch.where(named[:, None], direction, 0.0)
        self._turns = turns

    def _prior_count(self) -> Tensor:
        return 2 * (self._weight > 0).long()

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        return state.items[:, :3, None], state.items.new_zeros(len(self), 1, 1)

    def _shift(self, effects: Effects, state: RigState, camera: int) -> Tensor:
        turned = torch.linalg.cross(self._turns[:, camera], state.items[:, :3].expand(len(self._turns), -1, -1))
        return turned + super()._shift(effects, state, camera)

    def _by_own(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        return torch.einsum("vjun,vlj->vlun", by_q, torch.stack(side_axes(state.items[:, :3]), 1))

    def _prior(self, state: RigState) -> Tensor | None:
        # The catalogue: along the two axes across the star's direction.
        star = state.items[:, :3]
        axes = torch.stack(side_axes(star), 1)
        error = torch.einsum("vlj,vj->vl", axes, star - self._known) * self._weight[:, None]
        rows = torch.diag_embed(self._weight[:, None].expand(-1, 2))
        return torch.cat([rows, torch.where(self._weight[:, None] > 0, error, 0.0)[:, None]], 1)

    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """See `Block.moved`."""
        first, second = side_axes(items[:, :3])
        moved = items[:, :3] + step[:, :1] * first + step[:, 1:2] * second
        return as_items(moved / torch.linalg.vector_norm(moved, dim=-1, keepdim=True))
