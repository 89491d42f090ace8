"""Stars that several cameras of a rig saw at the same moments: at infinity, known to a few millionths of a radian."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from kcal.checks import require_finite
from kcal.errors import InputError


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarEffect:
    """Something that shifts all stars together and is known only roughly: a clock, the air.

    Args:
        name: what it is, for messages.
        turn: (C, 3) radians about the frame's axes by which each camera sees the sky turned at one sigma of it.
        factor: (S,) by which the turn is larger for some stars, as that of a clock that drifts; 1 if left out.
        shift: (S, 3) by which each star is seen elsewhere at one sigma of it, in all cameras.
    """

    name: str
    turn: Tensor | None = None
    factor: Tensor | None = None
    shift: Tensor | None = None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarSource:
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

    names: tuple[str, ...]
    pixels: Tensor
    pixel_sigma: Tensor
    direction: Tensor
    direction_sigma: Tensor
    effects: tuple[StarEffect, ...] = ()

    def __post_init__(self) -> None:
        count, shape = len(self.names), self.pixels.shape
        if self.pixels.ndim != 3 or shape[::2] != (count, 2) or self.pixel_sigma.shape != shape[:2]:
            raise InputError(f"stars: pixels ({count}, C, 2) and a sigma for each are needed")
        if self.direction.shape != (count, 3) or self.direction_sigma.shape != (count,):
            raise InputError(f"stars: directions ({count}, 3) and a sigma ({count},) are needed")
        if len(set(self.names)) != count:
            raise InputError("stars: a name is there twice")
        seen = torch.isfinite(self.pixels).all(-1)
        if not bool((self.pixel_sigma[seen] > 0).all() & torch.isfinite(self.pixel_sigma[seen]).all()):
            raise InputError("stars: every pixel_sigma must be a positive number")
        if not bool((self.direction_sigma > 0).all()):
            raise InputError("stars: every direction_sigma must be positive; it is infinite without a name")
        require_finite("stars: directions", self.direction[self.named])
        for effect in self.effects:
            turn, shift = effect.turn, effect.shift
            fits = effect.factor is None or effect.factor.shape == (count,)
            fits &= (turn is None or turn.shape == (shape[1], 3)) and (shift is None or shift.shape == (count, 3))
            if not fits:
                raise InputError(f"stars: the effect of {effect.name} has another shape than stars and cameras")

    @property
    def named(self) -> Tensor:
        """(S,) whether a star's direction is known."""
        return torch.isfinite(self.direction_sigma)

    def by_effects(self) -> Tensor:
        """(E, C, 3) turns of the sky at one sigma of each effect."""
        zero = torch.zeros(self.pixels.shape[1], 3, dtype=torch.float64)
        turns = [zero if effect.turn is None else effect.turn for effect in self.effects]
        return torch.stack(turns) if turns else zero.new_zeros(0, *zero.shape)

    def factors(self) -> Tensor:
        """(E, S) by which these turns are larger for each star."""
        one = torch.ones(len(self.names), dtype=torch.float64)
        factors = [one if effect.factor is None else effect.factor for effect in self.effects]
        return torch.stack(factors) if factors else one.new_zeros(0, len(one))

    def shifts(self) -> Tensor:
        """(E, S, 3) shifts of the stars at one sigma of each effect."""
        zero = torch.zeros(len(self.names), 3, dtype=torch.float64)
        shifts = [zero if effect.shift is None else effect.shift for effect in self.effects]
        return torch.stack(shifts) if shifts else zero.new_zeros(0, *zero.shape)
