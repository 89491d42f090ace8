"""Surveyed landmarks, marked in the images, as a source of a rig."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from kcal.calibrate.rig.resection import consensus_pose
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
    require_positive,
)
from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Landmarks(ItemSource):
    """Surveyed points, marked in the images.

    Args:
        names: one for each.
        points: (L, 3) meters in the local frame.
        sigma: (L, 3) meters along the frame's axes, of the survey; independent from point to point.
        pixels: (L, C, 2) marks.
        pixel_sigma: of a mark along an axis, px; one number for all, or (L, C) for each mark.
        effects: what shifts many of them together, beyond `sigma`.
    """

    __repr__ = brief
    kind = "landmarks"
    absolute: ClassVar[bool] = True
    few: ClassVar[str] = "no camera has a mark of it"

    names: tuple[str, ...]
    points: Tensor
    sigma: Tensor
    pixels: Tensor
    pixel_sigma: float | Tensor = 0.3
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        if self.points.shape != (count, 3) or self.sigma.shape != (count, 3):
            raise InputError(
                f"landmarks: points and sigma ({count}, 3) are needed, got {tuple(self.points.shape)} and "
                f"{tuple(self.sigma.shape)}"
            )
        self.check_marks()
        require_finite("landmarks: points", as_points("landmarks: points", self.points, 3))
        if not bool((torch.isfinite(self.sigma) & (self.sigma > 0)).all()):
            raise InputError("landmarks: every sigma must be a positive number of meters; nothing is surveyed exactly")
        if not isinstance(self.pixel_sigma, Tensor):
            require_positive("landmarks: pixel_sigma", self.pixel_sigma)
            return
        if self.pixel_sigma.shape != self.pixels.shape[:2]:
            raise InputError(f"landmarks: pixel_sigma {tuple(self.pixels.shape[:2])} is needed, one for each mark")
        sigma = self.pixel_sigma[torch.isfinite(self.pixels).all(-1)]
        if not bool((torch.isfinite(sigma) & (sigma > 0)).all()):
            raise InputError("landmarks: pixel_sigma must be a positive number of pixels wherever there is a mark")

    def __add__(self, other: Landmarks) -> Landmarks:
        """Both, with a sigma for each mark; effects shift only those whose they are."""
        return Landmarks(
            names=self.names + other.names,
            points=torch.cat([self.points, other.points]),
            sigma=torch.cat([self.sigma, other.sigma]),
            pixels=torch.cat([self.pixels, other.pixels]),
            pixel_sigma=torch.cat([self._each(), other._each()]),
            effects=self.effects_with(other),
        )

    def _each(self) -> Tensor:
        """(L, C) px, the sigma of each mark."""
        return torch.as_tensor(self.pixel_sigma, dtype=torch.float64).expand(self.pixels.shape[:2])

    def enough(self, cameras: Sequence[Camera]) -> Tensor:
        """See `ItemSource.enough`."""
        return self.marked.any(-1)

    def poses(self, cameras: Sequence[Camera], places: Mapping[int, Tensor]) -> dict[int, Pose]:
        """See `Source.poses`."""
        found = {}
        for c, camera in enumerate(cameras):
            rays, valid = camera.unproject(self.pixels[:, c])
            pose = consensus_pose(rays[valid], self.points[valid], places.get(c))
            if pose is not None:
                found[c] = Pose.at(*pose[:2])
        return found

    def begin(self, cameras: Sequence[Camera], start: Start) -> Tensor:
        """See `ItemSource.begin`."""
        return as_items(self.points)

    def block(self, mask: Tensor, given: Context) -> Block:
        """See `ItemSource.block`."""
        white = torch.eye(2, dtype=torch.float64) / (given.times * self._each()[mask][..., None, None])
        surveyed = self.points[mask], given.times * self.sigma[mask]
        effects = given.effects and given.effects.some(mask)
        return LandmarkBlock(self.pixels[mask], white, *surveyed, given.unknowns.by_refraction, effects)

    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """See `ItemSource.doubt`."""
        return f"its marks are off the surveyed place by {off} ({sigmas:.0f} sigma): a wrong mark or survey"

    def as_given(self, items: Tensor) -> Tensor:
        """See `ItemSource.as_given`."""
        return as_items(self.points)

    def meters(self, items: Tensor) -> Tensor:
        """See `ItemSource.meters`."""
        return torch.linalg.vector_norm(items[:, :3] - self.points, dim=-1)

    def places(self, items: Tensor, anchor: Tensor) -> Tensor:
        """See `ItemSource.places`."""
        return items[:, :3]


# Light bends downward: a landmark at the level distance d is seen k d² / 2R higher than it stands, k being the
# coefficient of refraction and R the Earth's radius.

# 1/m: half the curvature of the Earth, of the mean radius (IUGG) everywhere: a third of a percent of the bending.
_HALF_CURVATURE = 0.5 / 6_371_008.8
_UP = 2


class LandmarkBlock(MarkBlock):
    """Surveyed points, whose adjusted positions (V, 3), meters, are the unknowns.

    Args:
        pixels: (V, C, 2), see `MarkBlock`.
        whitening: (V, C, 2, 2), see `MarkBlock`.
        points: (V, 3) meters, as surveyed; the third axis is up.
        sigma: (V, 3) meters.
        by_refraction: (K,) of the coefficient of refraction by the unknowns; None: it is held.
        effects: see `MarkBlock`.
    """

    kind = "landmarks"
    size = 3
    surveyed: ClassVar[bool] = True

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        points: Tensor,
        sigma: Tensor,
        by_refraction: Tensor | None = None,
        effects: Effects | None = None,
    ) -> None:
        super().__init__(pixels, whitening, effects)
        self._surveyed, self._sigma, self._by_refraction = points, sigma, by_refraction

    def _prior_count(self) -> Tensor:
        return torch.full((len(self),), 3)

    @property
    def added(self) -> Tensor:
        """See `Block.added`."""
        return 2 * self.seen.sum((0, 2))

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        return state.items[:, :3, None], state.items.new_ones(len(self), 1, 1)

    def _bent(self, state: RigState, offset: Tensor) -> Tensor:
        level, up = offset[:, :_UP], offset[:, _UP:]
        return torch.cat([level, up + state.refraction * _HALF_CURVATURE * level.square().sum(1, keepdim=True)], 1)

    def _by_offset(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        slope = 2.0 * state.refraction * _HALF_CURVATURE * offset[:, :_UP, None]
        return torch.cat([by_q[:, :_UP] + slope * by_q[:, _UP:], by_q[:, _UP:]], 1)

    def _by_shared(self, state: RigState, by_q: Tensor, offset: Tensor) -> tuple[Tensor, Tensor] | None:
        if self._by_refraction is None:
            return None
        lift = _HALF_CURVATURE * offset[:, :_UP, None].square().sum(1, keepdim=True)
        return lift * by_q[:, _UP:], self._by_refraction[None]

    def _by_own(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        return by_q

    def _prior(self, state: RigState) -> Tensor | None:
        # The survey.
        error = (state.items[:, :3] - self._surveyed) / self._sigma
        return torch.cat([torch.diag_embed(1.0 / self._sigma), error[:, None]], 1)

    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """See `Block.moved`."""
        return as_items(items[:, :3] + step)
