"""The least-squares problem of a rig: cameras that move or are held, what they see, and what was measured besides.

Shared unknowns: for each camera its free parameters, its rotation, its center; then the board's warp, if that is free.
Those of boards, landmarks and features are eliminated item by item (`kcal.solve.schur`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.rig.blocks import LOCAL_SIZE, Block, PosedCamera, RigState
from kcal.lens.camera import Camera
from kcal.lens.pose import nearest_rotation, rotation_from_vector
from kcal.solve.result import State
from kcal.solve.robust import RobustLoss
from kcal.solve.schur import SchurLinearization


class SharedTerm(ABC):
    """Residuals of the cameras alone, in units of their standard deviations."""

    @abstractmethod
    def rows(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """(S + 1, Q): derivatives of Q residuals by the shared unknowns, and last these."""


class DistanceTerm(SharedTerm):
    """A measured distance between two centers."""

    def __init__(self, first: int, second: int, length: float, sigma: float) -> None:
        self._pair, self._length, self._sigma = (first, second), length, sigma

    def rows(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `SharedTerm.rows`."""
        apart = cameras[self._pair[1]].center - cameras[self._pair[0]].center
        length = torch.linalg.vector_norm(apart)
        out = apart.new_zeros((shared_size + 1, 1))
        for sign, number in zip((-1.0, 1.0), self._pair, strict=True):
            shift = cameras[number].shift
            if shift is not None:
                out[shift, 0] = sign * apart / (length * self._sigma)
        out[-1, 0] = (length - self._length) / self._sigma
        return out


class PlaceTerm(SharedTerm):
    """A measured center, with a (3,) sigma along the axes."""

    def __init__(self, camera: int, point: Tensor, sigma: Tensor) -> None:
        self._camera, self._point, self._sigma = camera, point, sigma

    def rows(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `SharedTerm.rows`."""
        posed = cameras[self._camera]
        out = self._point.new_zeros((shared_size + 1, 3))
        if posed.shift is not None:
            out[posed.shift] = torch.diag(1.0 / self._sigma)
        out[-1] = (posed.center - self._point) / self._sigma
        return out


class ParameterTerm(SharedTerm):
    """Known camera parameters: whitening (K, F) times (free parameters - mean)."""

    def __init__(self, camera: int, mean: Tensor, whitening: Tensor) -> None:
        self._camera, self._mean, self._whitening = camera, mean, whitening

    def rows(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `SharedTerm.rows`."""
        posed = cameras[self._camera]
        out = self._mean.new_zeros((shared_size + 1, len(self._whitening)))
        out[posed.inner] = self._whitening.T
        out[-1] = self._whitening @ (posed.parameters - self._mean)[list(posed.free)]
        return out


class RigProblem:
    """Everything that a rig is solved from, as one problem whose state is a `RigState`.

    Args:
        cameras: the cameras; what is not free keeps the state's values.
        blocks: what is seen, one block for each kind.
        terms: what was measured of the cameras besides.
        free: free parameters of each camera.
        turning: which cameras' rotations are unknown.
        moving: which cameras' centers are unknown.
        loss: of the root of each item's mean square, in sigmas; None: plain least squares.
    """

    batch: tuple[int, ...] = ()
    joint = False

    def __init__(
        self,
        cameras: Sequence[Camera],
        blocks: Sequence[Block],
        terms: Sequence[SharedTerm],
        free: Sequence[FreeParameters],
        turning: Sequence[bool],
        moving: Sequence[bool],
        loss: RobustLoss | None = None,
    ) -> None:
        self.cameras, self.blocks, self.free, self.loss = tuple(cameras), tuple(blocks), tuple(free), loss
        self._terms = tuple(terms)
        self.inner: list[slice] = []
        self.turn: list[slice | None] = []
        self.shift: list[slice | None] = []
        end = 0
        for unknown, turns, moves in zip(self.free, turning, moving, strict=True):
            self.inner.append(slice(end, end := end + len(unknown)))
            self.turn.append(slice(end, end := end + 3) if turns else None)
            self.shift.append(slice(end, end := end + 3) if moves else None)
        self.warp = slice(end, end := end + 2) if any(block.free_warp for block in self.blocks) else None
        self.shared_size = end
        self.residual_count = int(sum(int(block.counts.sum()) for block in self.blocks)) + 1

    def parameters(self, state: RigState) -> tuple[Tensor, ...]:
        """Parameters (5 + P) of each camera."""
        return state.parameters.split([camera.params.shape[-1] for camera in self.cameras])

    def posed(self, state: RigState) -> list[PosedCamera]:
        """The cameras as they stand, with the places of their unknowns in a step."""
        columns = self.cameras, self.parameters(state), state.rotation, state.center
        slots = self.free, self.inner, self.turn, self.shift
        return [PosedCamera(*values) for values in zip(*columns, *slots, strict=True)]

    def item_squares(self, state: RigState) -> list[Tensor]:
        """For each block (V,) the sum of squared residuals of each item."""
        posed = self.posed(state)
        return [block.residuals(posed, state).square().sum(-1) for block in self.blocks]

    def term_rows(self, state: RigState) -> Tensor:
        """(S + 1, Q) of what was measured of the cameras besides."""
        posed = self.posed(state)
        rows = [term.rows(posed, self.shared_size) for term in self._terms]
        return torch.cat([state.center.new_zeros((self.shared_size + 1, 0)), *rows], -1)

    def cost(self, state: State) -> Tensor:
        """See `Problem.cost`."""
        state = RigState(*state)
        total = self.term_rows(state)[-1].square().sum()
        for block, squares in zip(self.blocks, self.item_squares(state), strict=True):
            if self.loss is None:
                total = total + squares.sum()
            else:
                count = block.counts.clamp_min(1)
                total = total + (count * self.loss.value(squares / count)).sum()
        return 0.5 * total

    def deletions(self, state: RigState) -> list[Tensor]:
        """For each block (V,) by how much χ² would fall without each item, at a minimum and to first order.

        An item with leverage bends the solution towards itself and shows a small residual. With N the reduced normal
        matrix, N_i and g_i the item's parts of it and of the gradient, χ² falls by the item's own squares and by
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
        # An item without which the rest would determine nothing cannot be tested.
        others = torch.where(info == 0, pull.square().sum((-2, -1)), 0.0)
        return list((gram[:, -1, -1] + others).split([len(block) for block in self.blocks]))

    def _gram(self, state: RigState) -> Tensor:
        """(V, L + S + 1, L + S + 1) products of the rows of all items, with the loss's weights."""
        size = LOCAL_SIZE + self.shared_size + 1
        posed, grams = self.posed(state), [state.center.new_zeros(0, size, size)]
        for block in self.blocks:
            rows = block.rows(posed, state, self.shared_size)
            if self.loss is not None:
                count = block.counts.clamp_min(1)
                rows = rows * self.loss.weight(rows[:, -1].square().sum(-1) / count).sqrt()[:, None, None]
            missing = LOCAL_SIZE - block.size
            gram = rows.new_zeros((len(block), size, size))
            # Unknowns that smaller items do not have: with a one on the diagonal they change nothing.
            gram[:, range(missing), range(missing)] = 1.0
            gram[:, missing:, missing:] = rows @ rows.transpose(-1, -2)
            grams.append(gram)
        return torch.cat(grams)

    def linearize(self, state: State) -> SchurLinearization:
        """See `Problem.linearize`."""
        state = RigState(*state)
        linear = SchurLinearization.of_gram(self._gram(state), LOCAL_SIZE, self.term_rows(state))
        if self.loss is not None:
            linear.cost = self.cost(state)
        return linear

    def select(self, elements: Tensor) -> None:
        """See `Problem.select`: there is one element only."""
        return

    def retract(self, state: State, step: State) -> RigState:
        """See `Problem.retract`."""
        state = RigState(*state)
        shared, local = step
        moved = []
        for values, unknown, inner in zip(self.parameters(state), self.free, self.inner, strict=True):
            index = torch.tensor(unknown.indices, dtype=torch.int64)
            moved.append(values.index_add(0, index, unknown.expand(shared[inner])))
        turns = torch.stack([shared.new_zeros(3) if slot is None else shared[slot] for slot in self.turn])
        shifts = torch.stack([shared.new_zeros(3) if slot is None else shared[slot] for slot in self.shift])
        state = state._replace(
            parameters=torch.cat(moved),
            rotation=rotation_from_vector(turns) @ state.rotation,
            center=state.center + shifts,
            warp=state.warp if self.warp is None else state.warp + shared[self.warp],
        )
        for block, part in zip(self.blocks, local.split([len(block) for block in self.blocks]), strict=True):
            state = block.retract(state, part[:, LOCAL_SIZE - block.size :])
        return state

    @staticmethod
    def tidy(state: State) -> RigState:
        """The state with its cameras' rotations made orthonormal again after many small steps."""
        found = RigState(*state)
        return found._replace(rotation=nearest_rotation(found.rotation))
