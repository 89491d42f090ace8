"""What the cameras of a rig look at, as blocks of least squares: boards, landmarks, features of unknown place.

A camera with rotation R and center c sees the pixel of R q, q = y - w c. For points w = 1 and y is the point. A feature
in direction d at inverse range ρ from a place a near the rig has y = d + ρ a and w = ρ, so that q = d + ρ (a - c) is as
regular at infinity as anywhere (Civera, Davison, Montiel 2008).

Residuals are divided by their standard deviations: squares add up to χ².
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.bundle.twist import apply_twist
from kcal.lens.model import LensModel
from kcal.lens.pose import side_axes, step_rows
from kcal.lens.projection import project_components
from kcal.lens.residual import Field
from kcal.solve.result import State

# Unknowns of the largest block, a board's pose.
LOCAL_SIZE = 6


class Sight(NamedTuple):
    """A camera in the midst of a solve, and where its unknowns stand in a step (None: held)."""

    parameters: Tensor
    model: LensModel
    field: Field | None
    rotation: Tensor
    center: Tensor
    free: FreeParameters
    inner: slice
    turn: slice | None
    shift: slice | None


class Group(ABC):
    """V blocks of one kind, each with its own unknowns that no other block shares.

    Args:
        pixels: (V, C, N, 2), NaN where not seen.
        whitening: (V, C, N, 2, 2) by which pixel residuals are multiplied.
    """

    name: str
    size: int

    def __init__(self, pixels: Tensor, whitening: Tensor) -> None:
        self.seen = torch.isfinite(pixels).all(-1)
        self.target = torch.where(self.seen[..., None], pixels, 0.0).transpose(-1, -2).contiguous()
        self.whitening = torch.where(self.seen[..., None, None], whitening, 0.0).movedim(-3, -1).contiguous()

    def __len__(self) -> int:
        """How many blocks there are."""
        return len(self.target)

    @property
    def counts(self) -> Tensor:
        """(V,) residuals of each block."""
        return 2 * self.seen.sum((-2, -1)) + self.prior_count()

    def prior_count(self) -> Tensor:
        """(V,) residuals besides the pixels."""
        return torch.zeros(len(self), dtype=torch.int64)

    @abstractmethod
    def place(self, local: State) -> tuple[Tensor, Tensor]:
        """Y (V, 3, N) and w (V, 1, 1)."""

    @abstractmethod
    def by_local(self, local: State, by_q: Tensor, center: Tensor) -> Tensor:
        """Derivatives (V, L, 2, N) of pixels by the unknowns, from those by q (V, 3, 2, N)."""

    @abstractmethod
    def retract(self, local: State, step: Tensor) -> State:
        """Apply a step (V, L)."""

    def prior(self, local: State) -> Tensor | None:
        """(V, L + 1, Q): derivatives of Q residuals of what is known beforehand, and last these."""
        return None

    def _projected(self, sights: Sequence[Sight], local: State, derivatives: bool) -> Iterator[tuple]:
        y, w = self.place(local)
        for c, sight in enumerate(sights):
            q = sight.rotation @ (y - w * sight.center[:, None])
            wanted = sight.free.indices if derivatives else None
            found = project_components(q, sight.parameters, sight.model, wanted, sight.field)
            # As an error of a seen point, so that a pose behind which it lies is no candidate.
            bad = torch.where(found.regular, 0.0, torch.nan)[..., None, :]
            error = torch.where(self.seen[:, c, None, :], found.pixels - self.target[:, c] + bad, 0.0)
            yield c, sight, q, w, found, error

    def errors(self, sights: Sequence[Sight], local: State) -> Tensor:
        """(V, C, 2, N) projected minus seen, pixels; 0 where not seen."""
        return torch.stack([error for *_, error in self._projected(sights, local, False)], 1)

    def residuals(self, sights: Sequence[Sight], local: State) -> Tensor:
        """(V, R) whitened residuals, pixels first."""
        white = torch.einsum("vcuwn,vcwn->vcun", self.whitening, self.errors(sights, local)).flatten(1)
        prior = self.prior(local)
        return white if prior is None else torch.cat([white, prior[:, -1]], -1)

    def rows(self, sights: Sequence[Sight], local: State, shared_size: int) -> Tensor:
        """(V, L + S + 1, R) derivatives of the whitened residuals by local and shared unknowns, and last these."""
        out = []
        for c, sight, q, w, found, error in self._projected(sights, local, True):
            rows = q.new_zeros((len(self), self.size + shared_size + 1, 2, q.shape[-1]))
            by_q = torch.einsum("vkun,kj->vjun", found.by_point, sight.rotation)
            rows[:, : self.size] = self.by_local(local, by_q, sight.center)
            shared = rows[:, self.size : -1]
            shared[:, sight.inner] = sight.free.collapse(found.by_camera, -3)
            if sight.turn is not None:
                shared[:, sight.turn] = step_rows(found.by_point, q)[:, :3]
            if sight.shift is not None:
                shared[:, sight.shift] = -w[..., None] * by_q
            rows[:, -1] = error
            rows = torch.where(self.seen[:, c, None, None, :], rows, 0.0)
            out.append(torch.einsum("vuwn,vpwn->vpun", self.whitening[:, c], rows).flatten(-2))
        prior = self.prior(local)
        if prior is not None:
            rows = prior.new_zeros((len(self), self.size + shared_size + 1, prior.shape[-1]))
            rows[:, : self.size], rows[:, -1] = prior[:, :-1], prior[:, -1]
            out.append(rows)
        return torch.cat(out, -1)


class BoardGroup(Group):
    """Boards: local state is (V, 3, 3) and (V, 3), where they stand in the rig's frame."""

    name, size = "boards", 6

    def __init__(self, pixels: Tensor, whitening: Tensor, board_points: Tensor) -> None:
        super().__init__(pixels, whitening)
        self._board = board_points.T.contiguous()

    def place(self, local: State) -> tuple[Tensor, Tensor]:
        """See `Group.place`."""
        rotation, translation = local
        return rotation @ self._board + translation[..., None], translation.new_ones(len(self), 1, 1)

    def by_local(self, local: State, by_q: Tensor, center: Tensor) -> Tensor:
        """See `Group.by_local`: by ω through ω × (R x), then by v."""
        return step_rows(by_q, local[0] @ self._board)

    def retract(self, local: State, step: Tensor) -> State:
        """See `Group.retract`."""
        return apply_twist(local[0], local[1], step)


class LandmarkGroup(Group):
    """Surveyed points: local state is (V, 3), their adjusted positions."""

    name, size = "landmarks", 3

    def __init__(self, pixels: Tensor, whitening: Tensor, points: Tensor, sigma: Tensor) -> None:
        super().__init__(pixels[:, :, None], whitening[:, :, None])
        self.points, self.sigma = points, sigma

    def prior_count(self) -> Tensor:
        """See `Group.prior_count`."""
        return torch.full((len(self),), 3)

    def place(self, local: State) -> tuple[Tensor, Tensor]:
        """See `Group.place`."""
        return local[0][..., None], local[0].new_ones(len(self), 1, 1)

    def by_local(self, local: State, by_q: Tensor, center: Tensor) -> Tensor:
        """See `Group.by_local`."""
        return by_q

    def prior(self, local: State) -> Tensor | None:
        """See `Group.prior`: the survey."""
        error = (local[0] - self.points) / self.sigma
        return torch.cat([torch.diag_embed(1.0 / self.sigma), error[:, None]], 1)

    def retract(self, local: State, step: Tensor) -> State:
        """See `Group.retract`."""
        return (local[0] + step,)


class FeatureGroup(Group):
    """Things of unknown place: local state is (V, 3), unit directions, and (V,), inverse ranges from `anchor`."""

    name, size = "features", 3

    def __init__(self, pixels: Tensor, whitening: Tensor, inverse_range: Tensor, sigma: Tensor, anchor: Tensor) -> None:
        super().__init__(pixels[:, :, None], whitening[:, :, None])
        self._mean, self._weight = inverse_range, torch.where(torch.isfinite(sigma), 1.0 / sigma, 0.0)
        self._anchor = anchor

    def prior_count(self) -> Tensor:
        """See `Group.prior_count`."""
        return (self._weight > 0).long()

    def place(self, local: State) -> tuple[Tensor, Tensor]:
        """See `Group.place`."""
        direction, inverse = local
        return (direction + inverse[:, None] * self._anchor)[..., None], inverse[:, None, None]

    def by_local(self, local: State, by_q: Tensor, center: Tensor) -> Tensor:
        """See `Group.by_local`: by two steps across the direction, then by ρ."""
        along = self._anchor - center
        moves = torch.stack([*side_axes(local[0]), along.expand_as(local[0])], 1)
        return torch.einsum("vjun,vlj->vlun", by_q, moves)

    def prior(self, local: State) -> Tensor | None:
        """See `Group.prior`: what is known of the range."""
        zero = torch.zeros_like(self._weight)
        error = (local[1] - self._mean) * self._weight
        return torch.stack([zero, zero, self._weight, error], 1)[..., None]

    def retract(self, local: State, step: Tensor) -> State:
        """See `Group.retract`."""
        direction, inverse = local
        first, second = side_axes(direction)
        moved = direction + step[:, :1] * first + step[:, 1:2] * second
        return moved / torch.linalg.vector_norm(moved, dim=-1, keepdim=True), inverse + step[:, 2]
