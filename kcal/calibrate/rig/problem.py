"""Joint adjustment of a rig: cameras that move or are held, what they see, and what was measured besides.

Shared unknowns: for each camera its free parameters, its rotation, its center. Those of boards, landmarks and features
are eliminated block by block (`kcal.solve.schur`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.rig.blocks import LOCAL_SIZE, Group, Sight
from kcal.lens.model import LensModel
from kcal.lens.pose import nearest_rotation, rotation_from_vector
from kcal.lens.projection import INTRINSICS
from kcal.lens.residual import Field
from kcal.solve.result import State
from kcal.solve.robust import RobustLoss
from kcal.solve.schur import SchurLinearization


class Cameras(NamedTuple):
    """The cameras' part of a state.

    Attributes:
        parameters: one (5 + P) a camera.
        rotation: (C, 3, 3) cam_from_world.
        center: (C, 3) meters, in the world.
    """

    parameters: tuple[Tensor, ...]
    rotation: Tensor
    center: Tensor


class SharedTerm(ABC):
    """Residuals of the cameras alone, in units of their standard deviations."""

    @abstractmethod
    def rows(self, sights: Sequence[Sight], shared_size: int) -> Tensor:
        """(S + 1, Q): derivatives of Q residuals by the shared unknowns, and last these."""


class DistanceTerm(SharedTerm):
    """A measured distance between two centers."""

    def __init__(self, first: int, second: int, length: float, sigma: float) -> None:
        self._pair, self._length, self._sigma = (first, second), length, sigma

    def rows(self, sights: Sequence[Sight], shared_size: int) -> Tensor:
        """See `SharedTerm.rows`."""
        apart = sights[self._pair[1]].center - sights[self._pair[0]].center
        length = torch.linalg.vector_norm(apart)
        out = apart.new_zeros((shared_size + 1, 1))
        for sign, number in zip((-1.0, 1.0), self._pair, strict=True):
            shift = sights[number].shift
            if shift is not None:
                out[shift, 0] = sign * apart / (length * self._sigma)
        out[-1, 0] = (length - self._length) / self._sigma
        return out


class PlaceTerm(SharedTerm):
    """A measured center, with a (3,) sigma along the axes."""

    def __init__(self, camera: int, point: Tensor, sigma: Tensor) -> None:
        self._camera, self._point, self._sigma = camera, point, sigma

    def rows(self, sights: Sequence[Sight], shared_size: int) -> Tensor:
        """See `SharedTerm.rows`."""
        sight = sights[self._camera]
        out = self._point.new_zeros((shared_size + 1, 3))
        if sight.shift is not None:
            out[sight.shift] = torch.diag(1.0 / self._sigma)
        out[-1] = (sight.center - self._point) / self._sigma
        return out


class ParameterTerm(SharedTerm):
    """Known camera parameters: whitening (K, F) times (free parameters - mean)."""

    def __init__(self, camera: int, mean: Tensor, whitening: Tensor) -> None:
        self._camera, self._mean, self._whitening = camera, mean, whitening

    def rows(self, sights: Sequence[Sight], shared_size: int) -> Tensor:
        """See `SharedTerm.rows`."""
        sight = sights[self._camera]
        out = self._mean.new_zeros((shared_size + 1, len(self._whitening)))
        out[sight.inner] = self._whitening.T
        out[-1] = self._whitening @ (sight.parameters - self._mean)[list(sight.free)]
        return out


class RigProblem:
    """See the module. The state is: parameters of all cameras, rotations, centers, then the groups' own tensors.

    Args:
        models: one a camera.
        fields: for each camera what corrects its lens, held as it is, or None.
        groups: what is seen, and how many tensors each group's local state has.
        terms: what was measured of the cameras besides.
        free: free parameters of each camera.
        turning: which cameras' rotations are unknown.
        moving: which cameras' centers are unknown.
        loss: of the root of each block's mean square, in sigmas; None: plain least squares.
    """

    batch: tuple[int, ...] = ()
    joint = False

    def __init__(
        self,
        models: Sequence[LensModel],
        fields: Sequence[Field | None],
        groups: Sequence[tuple[Group, int]],
        terms: Sequence[SharedTerm],
        free: Sequence[FreeParameters],
        turning: Sequence[bool],
        moving: Sequence[bool],
        loss: RobustLoss | None = None,
    ) -> None:
        self.models, self.fields, self.free, self.loss = tuple(models), tuple(fields), tuple(free), loss
        self.groups = tuple(group for group, _ in groups)
        self._tensors = [count for _, count in groups]
        self._terms = tuple(terms)
        self._sizes = [len(INTRINSICS) + model.size for model in self.models]
        self.inner: list[slice] = []
        self.turn: list[slice | None] = []
        self.shift: list[slice | None] = []
        end = 0
        for unknown, turns, moves in zip(self.free, turning, moving, strict=True):
            self.inner.append(slice(end, end := end + len(unknown)))
            self.turn.append(slice(end, end := end + 3) if turns else None)
            self.shift.append(slice(end, end := end + 3) if moves else None)
        self.shared_size = end
        self.residual_count = int(sum(int(group.counts.sum()) for group in self.groups)) + 1

    def cameras(self, state: State) -> Cameras:
        """The cameras' part of a state."""
        return Cameras(tuple(state[0].split(self._sizes)), state[1], state[2])

    def locals(self, state: State) -> list[State]:
        """The groups' parts of a state."""
        out, start = [], 3
        for count in self._tensors:
            out.append(state[start : start + count])
            start += count
        return out

    def sights(self, state: State) -> list[Sight]:
        """The cameras with their places in a step."""
        parameters, rotation, center = self.cameras(state)
        return [
            Sight(values, model, field, turn, place, *slots)
            for values, model, field, turn, place, *slots in zip(
                parameters,
                self.models,
                self.fields,
                rotation,
                center,
                self.free,
                self.inner,
                self.turn,
                self.shift,
                strict=True,
            )
        ]

    def block_squares(self, state: State) -> list[Tensor]:
        """For each group (V,) the sum of squares of each block."""
        sights = self.sights(state)
        each = zip(self.groups, self.locals(state), strict=True)
        return [
            group.residuals(sights, local).square().sum(-1) if len(group) else local[0].new_zeros(0)
            for group, local in each
        ]

    def term_rows(self, state: State) -> Tensor:
        """(S + 1, Q) of what was measured of the cameras besides."""
        sights = self.sights(state)
        rows = [term.rows(sights, self.shared_size) for term in self._terms]
        return torch.cat([state[0].new_zeros((self.shared_size + 1, 0)), *rows], -1)

    def cost(self, state: State) -> Tensor:
        """See `Problem.cost`."""
        total = self.term_rows(state)[-1].square().sum()
        for group, squares in zip(self.groups, self.block_squares(state), strict=True):
            if self.loss is None:
                total = total + squares.sum()
            else:
                count = group.counts.clamp_min(1)
                total = total + (count * self.loss.value(squares / count)).sum()
        return 0.5 * total

    def deletions(self, state: State) -> list[Tensor]:
        """For each group (V,) by how much χ² would fall if one block were left out, at a minimum and to first order.

        A block with leverage bends the solution towards itself and shows a small residual. With N the reduced normal
        matrix, N_i and g_i the block's parts of it and of the gradient, χ² falls by the block's own squares and by
        g_iᵀ (N - N_i)⁻¹ g_i of the others'; for a single residual that is its squared external Studentized value
        (Baarda 1968; Cook and Weisberg 1982).
        """
        gram, L = self._gram(state), LOCAL_SIZE
        scale = gram[:, :L, :L].diagonal(dim1=-2, dim2=-1).rsqrt()
        factor, _ = torch.linalg.cholesky_ex(gram[:, :L, :L] * scale[:, :, None] * scale[:, None, :])
        coupling = gram[:, :L, L:] * scale[:, :, None]
        reduced = gram[:, L:, L:] - coupling.mT @ torch.cholesky_solve(coupling, factor)
        terms = self.term_rows(state)
        rest = (reduced.sum(0) + terms @ terms.T - reduced)[:, :-1, :-1]
        unit = rest.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
        roots, info = torch.linalg.cholesky_ex(rest * unit[:, :, None] * unit[:, None, :])
        pull = torch.linalg.solve_triangular(roots, (reduced[:, :-1, -1] * unit)[..., None], upper=False)
        # Without such a block the rest would determine nothing: it cannot be tested.
        others = torch.where(info == 0, pull.square().sum((-2, -1)), 0.0)
        return list((gram[:, -1, -1] + others).split([len(group) for group in self.groups]))

    def _gram(self, state: State) -> Tensor:
        """(V, L + S + 1, L + S + 1) products of the rows of all blocks, with the loss's weights."""
        sights, grams = self.sights(state), []
        for group, local in zip(self.groups, self.locals(state), strict=True):
            if not len(group):
                continue
            rows = group.rows(sights, local, self.shared_size)
            if self.loss is not None:
                count = group.counts.clamp_min(1)
                rows = rows * self.loss.weight(rows[:, -1].square().sum(-1) / count).sqrt()[:, None, None]
            missing = LOCAL_SIZE - group.size
            gram = rows.new_zeros((len(group), rows.shape[1] + missing, rows.shape[1] + missing))
            # Unknowns that smaller blocks do not have: with a one on the diagonal they change nothing.
            gram[:, range(missing), range(missing)] = 1.0
            gram[:, missing:, missing:] = rows @ rows.transpose(-1, -2)
            grams.append(gram)
        size = LOCAL_SIZE + self.shared_size + 1
        return torch.cat([state[0].new_zeros(0, size, size), *grams])

    def linearize(self, state: State) -> SchurLinearization:
        """See `Problem.linearize`."""
        linear = SchurLinearization(self._gram(state), LOCAL_SIZE, self.term_rows(state))
        if self.loss is not None:
            linear.cost = self.cost(state)
        return linear

    def select(self, elements: Tensor) -> None:
        """See `Problem.select`: there is one element only."""
        return

    def retract(self, state: State, step: State) -> State:
        """See `Problem.retract`."""
        shared, local = step
        parameters, rotation, center = self.cameras(state)
        moved = []
        for values, unknown, inner in zip(parameters, self.free, self.inner, strict=True):
            index = torch.tensor(unknown.indices, dtype=torch.int64)
            moved.append(values.index_add(0, index, unknown.expand(shared[inner])))
        turns = torch.stack([shared.new_zeros(3) if slot is None else shared[slot] for slot in self.turn])
        shifts = torch.stack([shared.new_zeros(3) if slot is None else shared[slot] for slot in self.shift])
        out = [torch.cat(moved), rotation_from_vector(turns) @ rotation, center + shifts]
        start = 0
        for group, before in zip(self.groups, self.locals(state), strict=True):
            part = local[start : start + len(group), LOCAL_SIZE - group.size :]
            out += group.retract(before, part)
            start += len(group)
        return tuple(out)

    @staticmethod
    def tidy(state: State) -> State:
        """The state with its cameras' rotations made orthonormal again after many small steps."""
        return (state[0], nearest_rotation(state[1]), *state[2:])
