"""Points matched between the images whose position nobody surveyed, as a source of a rig."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

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
    require_positive,
)
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import side_axes
from kcal.texts import brief

# 1/m: features are drawn no farther away than 100 km.
_LEAST_INVERSE_RANGE = 1e-5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Features(ItemSource):
    """Points matched between the images whose position nobody surveyed.

    A feature alone determines the epipolar geometry: relative pitch and roll. It determines relative yaw if something
    is known of its range, and the farther away it is, the less need be known: a summit 20 km ± 2 km away is
    0.8 ± 0.08 px of disparity with 10 m of baseline and f 1600 px; a star has none.

    Args:
        names: one for each.
        pixels: (F, C, 2) marks.
        inverse_range: (F,) one over meters from the middle of the rig; 0 at infinity.
        inverse_range_sigma: (F,) its standard deviation; infinite where the range is not known.
        pixel_sigma: of a mark along an axis, px.
        covariance: (F, C, 2, 2) px² of marks, in place of `pixel_sigma`.
        effects: errors that marks of many of them share, beyond these.
    """

    __repr__ = brief
    kind = "features"
    told_by: ClassVar[int] = 2
    turns: ClassVar[bool] = True
    axes: ClassVar[int] = 2

    names: tuple[str, ...]
    pixels: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    pixel_sigma: float = 0.3
    covariance: Tensor | None = None
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        self.check_marks()
        if self.inverse_range.shape != (count,) or self.inverse_range_sigma.shape != (count,):
            raise InputError(f"features: inverse_range and its sigma ({count},) are needed")
        if not bool((torch.isfinite(self.inverse_range) & (self.inverse_range_sigma > 0)).all()):
            raise InputError("features: inverse ranges must be finite and their sigmas positive")
        require_positive("features: pixel_sigma", self.pixel_sigma)
        if self.covariance is not None and self.covariance.shape != (*self.pixels.shape, 2):
            raise InputError(
                f"features: a covariance {(*self.pixels.shape, 2)} is needed, got {tuple(self.covariance.shape)}"
            )

    def __add__(self, other: Features) -> Features:
        """Both, with a covariance for each mark; effects shift only those whose they are."""
        both = self._whole(), other._whole()
        return Features(
            names=self.names + other.names,
            pixels=torch.cat([self.pixels, other.pixels]),
            inverse_range=torch.cat([self.inverse_range, other.inverse_range]),
            inverse_range_sigma=torch.cat([self.inverse_range_sigma, other.inverse_range_sigma]),
            covariance=torch.cat(both),
            effects=self.effects_with(other),
        )

    def _whole(self) -> Tensor:
        alike = self.pixel_sigma**2 * torch.eye(2, dtype=torch.float64).expand(*self.pixels.shape, 2)
        return alike if self.covariance is None else self.covariance

    def begin(self, cameras: Sequence[Camera], start: Start) -> Tensor:
        """See `ItemSource.begin`; along the ray of the first camera that has one, at the range that is expected."""
        inverse = torch.where(torch.isfinite(self.inverse_range_sigma), self.inverse_range, 0.0)
        return as_items(first_rays(cameras, start, self.pixels, inverse, start.center.mean(0)), inverse[:, None])

    def block(self, mask: Tensor, given: Context) -> Block:
        """See `ItemSource.block`."""
        if self.covariance is None:
            white = torch.eye(2, dtype=torch.float64) / (given.times * self.pixel_sigma)
            white = white.expand(*self.pixels[mask].shape, 2)
        else:
            # Where a mark is missing, its covariance may be anything.
            known = self.covariance[mask].nan_to_num(1.0)
            white = torch.linalg.inv(torch.linalg.cholesky_ex(known)[0]) / given.times
        known_range = self.inverse_range[mask], given.times * self.inverse_range_sigma[mask]
        effects = given.effects and given.effects.some(mask)
        return FeatureBlock(self.pixels[mask], white, *known_range, given.anchor, effects)

    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """See `ItemSource.doubt`."""
        return f"its marks do not meet: off by {off} ({sigmas:.0f} sigma): not the same point, or it moved"

    def places(self, items: Tensor, anchor: Tensor) -> Tensor:
        """See `ItemSource.places`; as far away as their inverse range says, at most 100 km."""
        return anchor + items[:, :3] / items[:, 3:4].clamp_min(_LEAST_INVERSE_RANGE)


def inverse_range_beyond(meters: float) -> tuple[float, float]:
    """Inverse range and its standard deviation of what is known to be farther than `meters`.

    Any inverse range from 0 to 1 / meters is taken as equally likely: the mean and the spread of that.

    Example:
        >>> inverse_range_beyond(1000.0)[0]
        0.0005
    """
    require_positive("range", meters)
    return 0.5 / meters, 1.0 / (meters * math.sqrt(12.0))


class FeatureBlock(MarkBlock):
    """Points of unknown position: a unit vector (V, 3) and an inverse range (V, 1), 1/m, from `anchor` each.

    Args:
        pixels: (V, C, 2), see `MarkBlock`, as `whitening` (V, C, 2, 2) and `effects`.
        inverse_range: (V,) as known beforehand, with `sigma`.
    """

    kind = "features"
    size = 3
    by_rows: ClassVar[bool] = True

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        inverse_range: Tensor,
        sigma: Tensor,
        anchor: Tensor,
        effects: Effects | None = None,
    ) -> None:
        super().__init__(pixels, whitening, effects)
        self._mean, self._weight = inverse_range, torch.where(torch.isfinite(sigma), 1.0 / sigma, 0.0)
        self._anchor = anchor

    def _prior_count(self) -> Tensor:
        return (self._weight > 0).long()

    @property
    def added(self) -> Tensor:
        """See `Block.added`."""
        # What nobody else sees tells a camera nothing; what one other sees has a direction from it.
        seen = self.seen.sum(-1)
        by_others = seen.sum(1, keepdim=True) - seen
        beyond = (self.counts - 2 * seen.sum(1) - self.size)[:, None]
        before, after = (2 * count + beyond for count in (by_others, by_others + seen))
        return torch.where(seen > 0, after.clamp_min(0) - before.clamp_min(0), 0).sum(0)

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        direction, inverse = state.items[:, :3], state.items[:, 3:4]
        return (direction + inverse * self._anchor)[..., None], inverse[..., None]

    def _by_own(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        # By two steps across the direction, then by ρ.
        direction = state.items[:, :3]
        along = (self._anchor - center).expand_as(direction)
        moves = torch.stack([*side_axes(direction), along], 1)
        rows = torch.einsum("vjun,vlj->vlun", by_q, moves)
        if by_w is not None:
            rows[:, 2] += by_w
        return rows

    def _prior(self, state: RigState) -> Tensor | None:
        # What is known of the range.
        if not bool(self._weight.any()):
            return None
        zero = torch.zeros_like(self._weight)
        error = (state.items[:, 3] - self._mean) * self._weight
        return torch.stack([zero, zero, self._weight, error], 1)[..., None]

    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """See `Block.moved`."""
        first, second = side_axes(items[:, :3])
        moved = items[:, :3] + step[:, :1] * first + step[:, 1:2] * second
        return as_items(moved / torch.linalg.vector_norm(moved, dim=-1, keepdim=True), items[:, 3:4] + step[:, 2:3])
