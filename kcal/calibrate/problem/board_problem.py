"""Least squares of one camera and the boards that it sees, for every lens alike (Eq. 5 and 7 of the paper).

Shared unknowns: those of the camera's parameters that are free, and amplitudes of the board's modes. Local ones: for
each view the pose of the board, and its motion while the image is read (`kcal.calibrate.problem.readout`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from kcal.calibrate.problem.board_images import ALL, POSE, BoardImages
from kcal.calibrate.problem.parameters import FreeParameters
from kcal.calibrate.problem.priors import GaussianPrior, Term
from kcal.calibrate.problem.readout import MOTION, Readout
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.twist import apply_twist
from kcal.gaussian import triangular
from kcal.lens.model import LensModel
from kcal.lens.pose import nearest_rotation
from kcal.lens.projection import INTRINSICS
from kcal.solve.result import State
from kcal.solve.robust import RobustLoss
from kcal.solve.schur import Products, SchurLinearization, SchurProblem, without_local

# Numbers in the rows of derivatives that are formed at a time: with fewer, default cameras took longer (measured).
_CHUNK = 600_000


class BoardProblem(BoardImages, SchurProblem[BoardState]):
    """Reprojection residuals (pixels) of one camera's views of a board, for `kcal.solve.lm.minimize`.

    Args:
        board_points: (N, 3) meters.
        pixels: (..., V, N, 2) observed corners; NaN where not seen. Leading dimensions broadcast with `batch`.
        model: the lens model.
        free: indices of the camera's free parameters, or which of them are tied.
        shapes: (B, 3, N) displacements of the corners by the board's modes, meters; None: the two parabolas of a warp.
        free_board: whether the amplitudes of these modes are estimated.
        held: (S,) unknowns that keep their values all the same; None: none does.
        weights: (..., V, N) or (..., V, N, 2, 2) by which each corner's residual is multiplied; 0 leaves it out. None:
            all corners count alike.
        loss: of the length of each corner's residual (after weighting), or None for plain least squares.
        terms: priors and barriers on the camera's parameters and the board's amplitudes, as further residuals.
        readout: how views move while they are read; None: they stand still.
        stillness: (12,) the squared noise over the variance of each number of a motion.
        batch: leading shape of the states, () for one solve.

    Attributes:
        moving: (M,) numbers of the unknowns that are not held.
        slots: (5 + P + B,) for each of `values` its place among these; -1 where it has none.

    Example:
        >>> from kcal import Camera
        >>> from kcal.lens import rotation_from_vector
        >>> from kcal.solve.lm import minimize
        >>> camera = Camera.build(focal=(800, 805), center=(322, 238), size=(640, 480), model="pinhole")
        >>> board = 0.05 * torch.cartesian_prod(torch.arange(6.0), torch.arange(5.0), torch.zeros(1)).double()
        >>> tilts = torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.1, 0.0], [0.0, 0.5, 0.2]], dtype=torch.float64)
        >>> rotation, translation = rotation_from_vector(tilts), torch.tensor([[-0.1, -0.1, 0.6]] * 3).double()
        >>> pixels, _ = camera.project(board @ rotation.mT + translation[:, None])
        >>> problem = BoardProblem(board, pixels, camera.model, free=[0, 1, 2, 3])  # fx, fy, cx, cy
        >>> guess = torch.tensor([700.0, 700.0, 320.0, 240.0, 0.0], dtype=torch.float64)
        >>> result = minimize(problem, BoardState.flat(guess, rotation, translation))
        >>> [round(float(value), 6) for value in result.state.parameters[:4]], bool(result.converged)
        ([800.0, 805.0, 322.0, 238.0], True)
    """

    def __init__(
        self,
        board_points: Tensor,
        pixels: Tensor,
        model: LensModel,
        free: Sequence[int] | FreeParameters = (),
        *,
        shapes: Tensor | None = None,
        free_board: bool = False,
        held: Tensor | None = None,
        weights: Tensor | None = None,
        loss: RobustLoss | None = None,
        terms: Sequence[Term] = (),
        readout: Readout | None = None,
        stillness: Tensor | None = None,
        batch: tuple[int, ...] = (),
    ) -> None:
        super().__init__(board_points, pixels, model, free, shapes, free_board, weights, loss, readout, batch)
        self.terms = tuple(terms)
        self.residual_count = 2 * int(self.seen.sum((-2, -1)).max())
        if readout is not None:
            self._still = torch.zeros(MOTION, dtype=pixels.dtype) if stillness is None else stillness
        self.moving = torch.arange(self.unknown_count) if held is None else (~held).nonzero()[:, 0]
        self.shared_size = len(self.moving)
        self._all_move = self.shared_size == self.unknown_count
        self._kept: list[tuple[BoardState, Products]] = []
        self.slots = self._places(model.size)

    def _places(self, coefficients: int) -> Tensor:
        """(5 + P + B,) the place of each of `values` among the unknowns of a step; -1 where it has none."""
        slots = torch.full((len(INTRINSICS) + coefficients + len(self.shapes),), -1)
        slots[list(self.free.indices)] = torch.tensor(self.free.slots, dtype=torch.long)
        if self.free_board:
            slots[len(slots) - len(self.shapes) :] = torch.arange(len(self.free), self.unknown_count)
        # One more, for values that are no unknowns.
        place = torch.full((self.unknown_count + 1,), -1)
        place[self.moving] = torch.arange(self.shared_size)
        return place[slots]

    def with_weights(self, weights: Tensor) -> BoardProblem:
        """The same problem with other weights (V, N) of its corners."""
        changed = copy.copy(self)
        changed._weigh(weights)
        changed._kept = []
        return changed

    def with_priors(self, terms: Sequence[Term], stillness: Tensor) -> BoardProblem:
        """The same corners and unknowns under other priors of these; both keep what corners say."""
        changed = copy.copy(self)
        changed.terms, changed._still = tuple(terms), stillness
        return changed

    @property
    def prior_count(self) -> int:
        """Number of scalar residuals that are priors."""
        return sum(len(term.index) for term in self.terms if isinstance(term, GaussianPrior))

    def select(self, elements: Tensor) -> BoardProblem | None:
        """See `Problem.select`."""
        if len(self.batch) != 1:
            return None
        part = copy.copy(self)
        part._kept, part._shown = [], []
        part.batch = (len(elements),)
        if self.seen.ndim > 2:
            part.seen, part._target, part._counts = self.seen[elements], self._target[elements], self._counts[elements]
            part._all_count = bool(part._counts.all())
            if self.weights is not None:
                part.weights = self.weights[elements]
        return part

    def values(self, state: BoardState) -> Tensor:
        """(..., 5 + P + B) the camera's parameters and the board's amplitudes, which terms are about."""
        return torch.cat([state.parameters, state.board], -1)

    def unknowns(self, state: BoardState) -> Tensor:
        """(..., S) values of the shared unknowns, those that are held among them."""
        own = state.parameters[..., list(self.free.leading)]
        return torch.cat([own, state.board], -1) if self.free_board else own

    def residuals(self, state: BoardState) -> Tensor:
        """See `SchurProblem.residuals`: weighted `pixel_errors`, u of all corners, then v; last those of motions."""
        errors = self._weighted(self.pixel_errors(state)[..., None, :, :])[..., 0, :, :].flatten(-2)
        return errors if self.readout is None else torch.cat([errors, self._still.sqrt() * state.motion], -1)

    def view_cost(self, state: BoardState) -> Tensor:
        """See `SchurProblem.view_cost`."""
        residuals = self.residuals(state)
        if self.loss is None:
            return 0.5 * residuals.square().sum(-1)
        corners = 2 * self._board.shape[-1]
        squared = residuals[..., :corners].unflatten(-1, (2, -1)).square().sum(-2)
        return 0.5 * (self.loss.value(squared).sum(-1) + residuals[..., corners:].square().sum(-1))

    def rows(self, state: BoardState, views: slice = ALL) -> Tensor:
        """See `SchurProblem.rows`; of some views. Zero by unknowns that are held."""
        rows = self.corner_rows(state, views)
        if not self._all_move:
            held = torch.ones(self.unknown_count, dtype=torch.bool).index_fill_(0, self.moving, False)
            rows[..., self.local_size : -1, :].masked_fill_(held[:, None], 0.0)
        if self.readout is None:
            return rows
        prior = rows.new_zeros(*rows.shape[:-1], MOTION)
        prior[..., POSE : self.local_size, :] = torch.diag(self._still.sqrt())
        prior[..., -1, :] = self._still.sqrt() * state.motion[views]
        return torch.cat([rows, prior], -1)

    def _chunks(self, state: BoardState) -> Iterator[slice]:
        """A few views at a time, so that their rows stay in the cache."""
        count, row = state.rotation.shape[-3], 2 * self._board.shape[-1] * max(1, math.prod(self.batch))
        size = max(1, _CHUNK // (row * (self.local_size + self.unknown_count + 1)))
        yield from (slice(start, start + size) for start in range(0, count, size)) if size < count else (ALL,)

    def products(self, state: BoardState) -> Products:
        """What the corners alone say near a state, by the unknowns that are not held; the last ones are kept."""
        if self._kept and self._kept[0][0] is state:
            return self._kept[0][1]
        memory: list[Tensor] = []
        found = Products.together(
            [Products.of_rows(self.corner_rows(state, views, memory), self.local_size) for views in self._chunks(state)]
        )
        if not self._all_move:
            found = found.of_shared(self.moving)
        if not found.total.requires_grad:
            self._kept[:] = [(state, found)]
        return found

    def linearize(self, state: BoardState) -> SchurLinearization:
        """See `Problem.linearize`; by the unknowns that are not held."""
        by_pose, by_both, _, by_corners = self.products(state)
        total = self.shared_gram(state) + by_corners
        if self.readout is not None:
            # The prior of motions.
            pull = self._still * state.motion
            by_pose, by_both = by_pose.clone(), by_both.clone()
            by_pose.diagonal(dim1=-2, dim2=-1)[..., POSE:] += self._still
            by_both[..., POSE:, -1] += pull
            total[..., -1, -1] += (pull * state.motion).sum((-2, -1))
        linear = SchurLinearization(by_pose, by_both, total)
        if self.loss is not None:
            linear.cost = self.cost(state)
        return linear

    def off_poses(self, state: BoardState) -> Tensor:
        """(V, S + 1, R) derivatives by the shared unknowns, and residuals, off what poses and motions can do (QR)."""
        return torch.cat([without_local(self.rows(state, views), self.local_size) for views in self._chunks(state)])

    def reduced_rows(self, state: BoardState) -> Tensor:
        """(S + 1, S + 1) triangle with the same products as the rows of `off_poses`, some views at a time."""
        parts = [
            triangular(without_local(self.rows(state, views), self.local_size).transpose(0, 1).flatten(1).T)
            for views in self._chunks(state)
        ]
        return parts[0] if len(parts) == 1 else triangular(torch.cat(parts))

    def shared_gram(self, state: BoardState) -> Tensor:
        """See `SchurProblem.shared_gram`: of the terms."""
        values = self.values(state)
        total = values.new_zeros(*values.shape[:-1], self.shared_size + 1, self.shared_size + 1)
        for term in self.terms:
            term.add_to(total, values, self.slots)
        return total

    def shared_cost(self, state: BoardState) -> Tensor:
        """See `SchurProblem.shared_cost`: of the terms."""
        values = self.values(state)
        return sum((term.cost(values) for term in self.terms), start=values.new_zeros(values.shape[:-1]))

    def retract(self, state: BoardState, step: State) -> BoardState:
        """See `SchurProblem.retract`."""
        shared, local = step
        if not self._all_move:
            shared = shared.new_zeros(self.unknown_count).index_copy(0, self.moving, shared)
        count = len(self.free)
        parameters = state.parameters.clone()
        parameters[..., list(self.free)] += self.free.expand(shared[..., :count])
        board = state.board + shared[..., count:] if self.free_board else state.board
        rotation, translation = apply_twist(state.rotation, state.translation, local[..., :POSE])
        motion = state.motion if self.readout is None else state.motion + local[..., POSE:]
        return BoardState(parameters, board, rotation, translation, motion)

    def tidy(self, state: BoardState) -> BoardState:
        """The state with its rotations made orthonormal again after many small steps."""
        return state._replace(rotation=nearest_rotation(state.rotation))
