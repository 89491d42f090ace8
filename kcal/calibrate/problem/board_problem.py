"""Least squares of one camera and the boards that it sees, for every lens alike (Eq. 5 and 7 of the paper)."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.parameters import FreeParameters, GaussianPrior, Term
from kcal.calibrate.problem.state import BoardState, Readout, warp_modes
from kcal.gaussian import triangular
from kcal.lens.model import LEADING, LensModel, fill_field_columns
from kcal.lens.pose import apply_twist, nearest_rotation, step_rows
from kcal.lens.projection import INTRINSICS, Projection, project_components
from kcal.solve.lm import RobustLoss, State
from kcal.solve.schur import Products, SchurLinearization, SchurProblem, matrix_product, without_local

# Of a hybrid lens there may be hundreds of derivatives. They are written where they belong, each once, and what the
# cost of a trial step needed of them is kept for the linearization that follows.

# Share of a step over which residuals bend.
_AHEAD = 0.1
# All views.
ALL = slice(None)
# Numbers of a pose's step, and of its turn alone.
POSE, TURN = 6, 3


# Numbers in the rows of derivatives that are formed at a time: with fewer, default cameras took longer (measured).
_CHUNK = 600_000


def _shown_corners(seen: Tensor) -> Tensor | None:
    """(V, K) numbers of the corners that each view shows, then of others; None where most are seen, or in batches."""
    if seen.ndim > 2 or 2 * int(seen.sum()) > seen.numel():
        return None
    return (~seen).byte().argsort(dim=-1, stable=True)[:, : max(1, int(seen.sum(-1).max()))]


def _of_views(values: Tensor, views: slice) -> Tensor:
    """Some of values (V, ...) by view; all of values (1, ...) that all views share."""
    return values if len(values) == 1 else values[views]


class _Placed(NamedTuple):
    """The board (..., 3, K) in its frame; in each view rotated, and in the camera's frame; turns while it is read."""

    flat: Tensor
    rotated: Tensor
    points: Tensor
    turn: Tensor | None

    def of(self, views: slice) -> _Placed:
        """The same of some of all views of one camera."""
        turn = None if self.turn is None else self.turn[views]
        return _Placed(_of_views(self.flat, views), self.rotated[views], self.points[views], turn)


class _Imaged(NamedTuple):
    """Boards in some views as the camera shows them: placed, projected, and cam_from_board (..., V, 3, 3)."""

    placed: _Placed
    seen: Projection
    rotation: Tensor
    views: slice

    def of(self, views: slice) -> _Imaged:
        """The same of some of all views of one camera."""
        if views == ALL:
            return self
        return _Imaged(self.placed.of(views), self.seen.of(views), self.rotation[views], views)


# Least squares of one camera and the boards that it sees, for every lens alike (Eq. 5 and 7 of the paper).
#
# Shared unknowns: the camera's free parameters (`FreeParameters`; tied ones share one), then the amplitudes of the
# board's modes. A `Gaussian` of them has the names (LENS_SLOT, 0), ... and (BOARD_SLOT, 0), ... in that order, without
# those that are held. Local unknowns are eliminated view by view: the pose of the board, of which only the rotation is
# unknown where points are infinitely far, and its motion while the image is read (`kcal.calibrate.problem.state`).
# Terms are residuals of the shared unknowns alone: priors, barriers, what other data say.


class BoardProblem(SchurProblem[BoardState]):
    """Reprojection residuals (pixels) of one camera's views of a board, for `kcal.solve.lm.minimize`.

    Where views show few of the board's N corners, work is done on K corners of each view: those that it shows come
    first, and K is the largest number of them. Otherwise K = N.

    Args:
        board_points: (N, 3) meters, or (V, N, 3) where each view shows points of its own.
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
        readout: how views move while they are read, and how the board bends in them; None: neither.
        stillness: (M,) or (V, M) the squared noise over the variance of each of these numbers.
        batch: leading shape of the states, () for one solve.
        turning: the points are so far away that views differ by their rotations alone; translations are held.
        displaced: whether each corner lies off its place on the board by unknowns of its own in x and y, meters: 2 N
            more amplitudes, those in x first, after those of the modes. Not in batches, nor with a loss.

    Attributes:
        weights: (..., V, K) or (..., V, 2, 2, K).
        pose: unknowns of each view's pose, the first of its local ones.
        local_size: unknowns of each view: of its pose, and of its motion.
        unknown_count: of camera and board, those that are held among them.
        joint: whether a linearization costs little more than the cost alone: with hundreds of columns it costs more.
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
        turning: bool = False,
        displaced: bool = False,
    ) -> None:
        self.model, self.loss, self.batch = model, loss, batch
        self.free, self.free_board = FreeParameters.of(free), free_board
        self.board_points, self.shapes = board_points, warp_modes(board_points) if shapes is None else shapes
        seen = torch.isfinite(pixels).all(-1)
        if weights is not None and weights.ndim == seen.ndim:
            seen = seen & (weights > 0)
        self._numbers = _shown_corners(seen)
        self._seen, pixels = self.shown(seen), self.shown(pixels)
        self._target = torch.where(self._seen[..., None], pixels, 0.0).transpose(-1, -2).contiguous()
        self._weigh(weights)
        self.readout = readout
        self.pose = TURN if turning else POSE
        self.local_size = self.pose + (readout.numbers if readout else 0)
        if readout is not None:
            self._time = readout.time(pixels)
            if self._numbers is not None and readout.bends is not None:
                self.readout = dataclasses.replace(readout, bends=self._of_board(readout.bends))
        own = board_points.ndim > 2
        self._board = self.shown(board_points).mT.contiguous() if own else self._of_board(board_points.mT)
        self._shapes = self._of_board(self.shapes)
        self.displaced = displaced
        self.amplitudes = len(self.shapes) + 2 * board_points.shape[-2] * displaced
        self.unknown_count = len(self.free) + self.amplitudes * free_board
        self.joint = not model.hybrid
        self._shown: list[tuple[BoardState, _Imaged]] = []
        self._slots = torch.tensor(self.free.slots, dtype=torch.long, device=pixels.device)
        first = len(INTRINSICS) + len(model.hybrid.leading if model.hybrid else LEADING)
        self._leading = [index for index in self.free.indices if index < first]
        self._field = self._field_slots(first, weights) if model.hybrid and not batch else None
        self.terms = tuple(terms)
        self.residual_count = 2 * int(self._seen.sum((-2, -1)).max())
        if readout is not None:
            self._still = torch.zeros(readout.numbers, dtype=pixels.dtype) if stillness is None else stillness
        self.moving = torch.arange(self.unknown_count) if held is None else (~held).nonzero()[:, 0]
        self.shared_size = len(self.moving)
        self._all_move = self.shared_size == self.unknown_count
        self._kept: list[tuple[BoardState, Products]] = []
        self.slots = self._places(model.size)

    def shown(self, values: Tensor) -> Tensor:
        """(..., V, K, ...) of values (..., V, N, ...) of all corners, in the order in which work is done."""
        if self._numbers is None:
            return values
        return values[torch.arange(len(self._numbers))[:, None], self._numbers]

    def _of_board(self, values: Tensor) -> Tensor:
        """(V, ..., K) of values (..., N) that all views share; (1, ..., N) where all views have all corners."""
        return (values[None] if self._numbers is None else values[..., self._numbers].movedim(-2, 0)).contiguous()

    def _of_all(self, values: Tensor, fill: float | bool) -> Tensor:
        """(V, ..., N) of values (V, ..., K)."""
        if self._numbers is None:
            return values
        numbers = self._numbers.view(len(values), *[1] * (values.ndim - 2), -1).expand_as(values)
        return values.new_full((*values.shape[:-1], self.board_points.shape[-2]), fill).scatter(-1, numbers, values)

    @property
    def seen(self) -> Tensor:
        """(..., V, N) corners that count."""
        return self._of_all(self._seen[..., None, :], False)[..., 0, :]

    def _weigh(self, weights: Tensor | None) -> None:
        self.weights: Tensor | None = None
        self._counts, seen = self._seen, self._seen
        weights = None if weights is None else self.shown(weights)
        if weights is not None and weights.ndim > seen.ndim:
            self.weights = torch.where(seen[..., None, None], weights, 0.0).movedim(-3, -1).contiguous()
        elif weights is not None and not bool((weights[seen] == 1.0).all()):
            self.weights = torch.where(seen, weights, 0.0)
            self._counts = self.weights > 0
        self._all_count = bool(self._counts.all())

    def _field_slots(self, first: int, weights: Tensor | None) -> slice | None:
        """Where all weights of the field, or none, stand among the unknowns; None where they stand elsewhere."""
        begin = len(self._leading)
        indices, slots = self.free.indices[begin:], self.free.slots[begin:]
        start = min(slots, default=0)
        apart = bool(indices) and indices != tuple(range(first, len(INTRINSICS) + self.model.size))
        if apart or slots != tuple(range(start, start + len(slots))) or (weights is not None and weights.ndim > 2):
            return None
        return slice(start, start + len(slots))

    @property
    def pixels(self) -> Tensor:
        """(..., V, N, 2) observed corners; NaN where not seen."""
        target = torch.where(self._seen[..., None, :], self._target, torch.nan)
        return self._of_all(target, torch.nan).transpose(-1, -2)

    def _placed(self, state: BoardState, views: slice = ALL) -> _Placed:
        flat = _of_views(self._board, views)
        if len(self.shapes) and (self.free_board or bool(state.board.any())):
            amplitudes = state.board[..., : len(self.shapes)]
            flat = flat + torch.einsum("...b,vbkn->...vkn", amplitudes, _of_views(self._shapes, views))
        if self.displaced:
            off = torch.nn.functional.pad(state.board[len(self.shapes) :].view(2, -1), (0, 0, 0, 1))
            flat = flat + _of_views(self._of_board(off), views)
        if self.readout is None:
            rotated = state.rotation @ flat
            return _Placed(flat, rotated, rotated + state.translation[..., None], None)
        points, shift, turn = self.readout.of_views(views).moved(state.motion, self._time[views], flat)
        rotated = state.rotation @ points
        return _Placed(flat, rotated, rotated + state.translation[..., None] + shift, turn)

    def _imaged(self, state: BoardState, views: slice = ALL) -> _Imaged:
        """Corners of a state, with derivatives by all parameters but those of a field whose columns follow."""
        if not self._by_field(state):
            part = state if views == ALL else state.views(views)
            placed = self._placed(part, views)
            seen = project_components(placed.points, part.parameters[..., None, :], self.model, self.free.indices)
            return _Imaged(placed, seen, part.rotation, views)
        if not (self._shown and self._shown[0][0] is state):
            # What the cost of a trial needs serves its derivatives, too, if it is accepted.
            placed = self._placed(state)
            seen = project_components(placed.points, state.parameters[None], self.model, self._leading)
            self._shown[:] = [(state, _Imaged(placed, seen, state.rotation, ALL))]
        return self._shown[0][1].of(views)

    def _by_field(self, state: BoardState) -> bool:
        """Whether derivatives by the field's weights are written where they belong, as nothing is differentiated."""
        fixed = (self._board, self.shapes, *(() if self.readout is None else (self._time,)))
        if self._field is None or any(each.requires_grad for each in (*state, *fixed)):
            return False
        return float(state.parameters[INTRINSICS.index("skew")]) == 0.0

    def points(self, state: BoardState) -> Tensor:
        """(..., V, N, 3) the board's corners in the camera's frame, meters; NaN for those that no work is done on."""
        return self._of_all(self._placed(state).points, torch.nan).transpose(-1, -2)

    def pixel_errors(self, state: BoardState) -> Tensor:
        """Projected minus observed, (..., V, 2, N) pixels, not weighted; 0 where not seen.

        NaN where a seen corner lies behind the camera, or beyond a pole or a fold of the lens.
        """
        return self._of_all(self._errors(state), 0.0)

    def _errors(self, state: BoardState) -> Tensor:
        """(..., V, 2, K) the same of the corners that work is done on."""
        if self._by_field(state):
            projected = self._imaged(state).seen
        else:
            points = self._placed(state).points
            projected = project_components(points, state.parameters[..., None, :], self.model)
        bad = torch.where(projected.regular, 0.0, torch.nan)[..., None, :]
        return torch.where(self._seen[..., None, :], projected.pixels - self._target + bad, 0.0)

    def corner_residuals(self, state: BoardState, *, weighted: bool = False) -> Tensor:
        """(..., V, N, 2) residuals by corner; NaN where not seen."""
        errors = self._errors(state)
        if weighted:
            errors = self._weighted(errors[..., None, :, :])[..., 0, :, :]
        return self._of_all(torch.where(self._seen[..., None, :], errors, torch.nan), torch.nan).transpose(-1, -2)

    def _weighted(self, vectors: Tensor, views: slice = ALL) -> Tensor:
        """Vectors (..., V, Q, 2, K) of pixels, multiplied by the corners' weights; 0 where these are zero."""
        if self.weights is None:
            return vectors
        if self.weights.ndim > self._seen.ndim:
            return torch.einsum("...uwn,...qwn->...qun", self.weights[..., views, :, :, :], vectors)
        weights = self.weights[..., views, None, None, :]
        # Without an image a corner of weight zero is NaN.
        return torch.where(weights > 0, vectors * weights, 0.0)

    def weighted(self, vectors: Tensor) -> Tensor:
        """(V, Q, 2 K) vectors (V, Q, 2, N) of pixels, in the order in which work is done, times the weights."""
        return self._counted(self.shown(vectors.movedim(-1, 1)).movedim(1, -1), ALL).flatten(-2)

    def _counted(self, vectors: Tensor, views: slice) -> Tensor:
        """Vectors as in `_weighted`, zero where a corner does not count."""
        if not self._all_count:
            vectors = torch.where(self._counts[..., views, None, None, :], vectors, 0.0)
        return self._weighted(vectors, views)

    def corner_rows(self, state: BoardState, views: slice = ALL) -> Tensor:
        """(..., V, L + S + 1, 2 K) as `rows`, of the corners alone, and as if no unknown were held."""
        rows, slopes = self._own_rows(state, views)
        if not self.displaced:
            return rows.flatten(-2)
        # Each residual depends on the displacement of its own corner alone.
        each = torch.einsum("vaun,nm->vamun", slopes, torch.eye(slopes.shape[-1], dtype=slopes.dtype))
        each = self._of_all(each.movedim(2, -1), 0.0).movedim(-1, 2).flatten(1, 2)
        return torch.cat([rows[:, :-1], each, rows[:, -1:]], 1).flatten(-2)

    def _own_rows(self, state: BoardState, views: slice, memory: list[Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Rows (..., V, L + S + 1, 2, K) without displacements of the corners; derivatives (V, 2, 2, K) by these.

        With `memory` given, an empty list at first, the next call may overwrite what this one returns: new memory costs
        as much time as what is written there.
        """
        placed, seen, rotation, _ = self._imaged(state, views)
        error = seen.pixels - self._target[..., views, :, :]
        if self.joint:
            # A hybrid lens has values beyond its disc, too: a start may have corners there, but no state that follows.
            error = error + torch.where(seen.regular, 0.0, torch.nan)[..., None, :]
        by_point, by_camera, error = (
            self._counted(part, views) for part in (seen.by_point, seen.by_camera, error[..., None, :, :])
        )
        L, count = self.local_size, len(self.free)
        rows = self._memory(by_point, L + count + len(self.shapes) * self.free_board + 1, memory)
        rows[..., : self.pose, :, :] = step_rows(by_point, placed.rotated)[..., : self.pose, :, :]
        if self.readout is not None:
            readout, time = self.readout.of_views(views), self._time[views]
            rows[..., self.pose : L, :, :] = readout.columns_of(by_point, rotation, time, placed.flat)
        shared = rows[..., L:-1, :, :]
        slots = self._slots[: by_camera.shape[-3]]
        shared.index_fill_(-3, slots, 0.0).index_add_(-3, slots, by_camera)
        if len(slots) < len(self._slots):
            self._fill_field(shared, seen, state, views)
        by_board = by_point
        if self.free_board:
            by_board = (rotation.mT @ by_point.flatten(-2)).unflatten(-1, (2, -1))
            if placed.turn is not None:
                # What displaces a corner of the board turns with it.
                by_board = by_board + torch.linalg.cross(by_board, placed.turn[:, :, None].expand_as(by_board), dim=1)
            shapes = _of_views(self._shapes, views)[..., None, :]
            along = zip(by_board.split(1, -3), shapes.unbind(-3), strict=True)
            shared[..., count:, :, :] = sum(slope * shape for slope, shape in along)
        rows[..., -1:, :, :] = error
        if self.loss is not None:
            rows = rows * self.loss.weight(error.square().sum(-2)).sqrt()[..., None, :]
        return rows, by_board[..., :2, :, :]

    def _memory(self, like: Tensor, count: int, memory: list[Tensor] | None) -> Tensor:
        """(..., V, count, 2, K), of one camera such that each column is in one piece."""
        *views, _, axes, corners = like.shape
        if len(views) > 1:
            return like.new_empty(*views, count, axes, corners)
        if memory is None or like.requires_grad:
            return like.new_empty(count, *views, axes, corners).transpose(0, 1)
        size = count * views[0] * axes * corners
        memory[:] = memory if memory and len(memory[0]) >= size else [like.new_empty(size)]
        return memory[0][:size].view(count, *views, axes, corners).transpose(0, 1)

    def _fill_field(self, shared: Tensor, seen: Projection, state: BoardState, views: slice) -> None:
        """Write derivatives by the field's weights."""
        assert self._field is not None
        assert self.model.hybrid is not None
        assert seen.plane is not None
        x, y = seen.plane.unbind(-2)
        scale = state.parameters[:2, None]
        if not self._all_count:
            # The field itself is not zero in the middle of the disc, where corners that do not count are put.
            counts = self._counts[views]
            x, y, scale = torch.where(counts, x, 0.0), torch.where(counts, y, 0.0), scale * counts[:, None]
        if self.weights is not None:
            scale = scale * self.weights[views, None]
        fill_field_columns(shared[:, self._field].transpose(0, 1), x, y, scale, self.model.hybrid)

    def _places(self, coefficients: int) -> Tensor:
        """(5 + P + B,) the place of each of `values` among the unknowns of a step; -1 where it has none."""
        slots = torch.full((len(INTRINSICS) + coefficients + self.amplitudes,), -1)
        slots[list(self.free.indices)] = torch.tensor(self.free.slots, dtype=torch.long)
        if self.free_board:
            slots[len(slots) - self.amplitudes :] = torch.arange(len(self.free), self.unknown_count)
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

    def read_as_shown(self, state: BoardState, beyond: float = 0.0) -> BoardProblem:
        """The same problem with each corner read at the time of the pixel where a state shows it.

        This very problem if no view's times would change by more pixels than `beyond` (RMS).

        At the time of the observed pixel, motions would reduce the noise of the corners that set their times: thousands
        of corners would have motions where nothing moves.
        """
        if self.readout is None:
            return self
        errors = self._errors(state)
        known = errors.isfinite().all(-2)
        time = torch.where(known, self.readout.time((self._target + errors).mT), self._time)
        off = torch.where(self._seen, time - self._time, 0.0).square().sum(-1)
        least = beyond * self.readout.per_pixel
        if beyond and bool((off <= least * least * self._seen.sum(-1)).all()):
            return self
        changed = copy.copy(self)
        changed._time = time
        changed._kept, changed._shown = [], []
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
        if self._seen.ndim > 2:
            part._seen, part._target = self._seen[elements], self._target[elements]
            part._counts = self._counts[elements]
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
        errors = self._weighted(self._errors(state)[..., None, :, :])[..., 0, :, :].flatten(-2)
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
        pull = self._still.sqrt().expand_as(state.motion)[views]
        prior = rows.new_zeros(*rows.shape[:-1], pull.shape[-1])
        prior[..., self.pose : self.local_size, :] = torch.diag_embed(pull)
        prior[..., -1, :] = pull * state.motion[views]
        return torch.cat([rows, prior], -1)

    def _chunks(self, state: BoardState) -> Iterator[slice]:
        """A few views at a time, so that their rows stay in the cache."""
        count, row = state.rotation.shape[-3], 2 * self._board.shape[-1] * max(1, math.prod(self.batch))
        size = max(1, _CHUNK // (row * (self.local_size + self.unknown_count + 1)))
        yield from (slice(start, start + size) for start in range(0, count, size)) if size < count else (ALL,)

    def _parts(self, state: BoardState) -> Iterator[tuple[BoardProblem, BoardState, slice]]:
        """A few views at a time, without corners where these show less than half as many as others."""
        for views in self._chunks(state):
            most = 0 if self._numbers is None else max(1, int(self._seen[views].sum(-1).max()))
            if self._numbers is None or 2 * most > self._numbers.shape[-1]:
                yield self, state, views
                continue
            part = copy.copy(self)
            part._kept, part._shown = [], []
            part._numbers, part._seen, part._target, part._counts, part._board, part._shapes = (
                each[views][..., :most]
                for each in (self._numbers, self._seen, self._target, self._counts, self._board, self._shapes)
            )
            part._all_count = bool(part._counts.all())
            part.weights = None if self.weights is None else self.weights[views][..., :most]
            if self.readout is not None:
                bends = None if self.readout.bends is None else self.readout.bends[views][..., :most]
                part.readout, part._time = dataclasses.replace(self.readout, bends=bends), self._time[views][..., :most]
                part._still = self._still.expand_as(state.motion)[views]
            yield part, state.views(views), ALL

    def products(self, state: BoardState) -> Products:
        """What the corners alone say near a state, by the unknowns that are not held; the last ones are kept."""
        if self._kept and self._kept[0][0] is state:
            return self._kept[0][1]
        memory: list[Tensor] = []
        found = Products.together([part._products(own, at, memory) for part, own, at in self._parts(state)])
        if not self._all_move:
            found = found.of_shared(self.moving)
        if not found.total.requires_grad:
            self._kept[:] = [(state, found)]
        return found

    def _products(self, state: BoardState, views: slice, memory: list[Tensor]) -> Products:
        rows, slopes = self._own_rows(state, views, memory)
        local, right, score, total = Products.of_rows(rows.flatten(-2), L := self.local_size)
        if self.displaced:
            # Corners meet lens, poses and residuals only in their own rows: these products cost little.
            along = rows[:, :, None, 0] * slopes[:, None, :, 0]
            with_rows = self._of_all(along.addcmul_(rows[:, :, None, 1], slopes[:, None, :, 1]), 0.0).flatten(2)
            own = self._of_all(torch.einsum("vaun,vbun->vabn", slopes, slopes), 0.0).sum(0)
            own = torch.einsum("abn,nm->anbm", own, torch.eye(own.shape[-1], dtype=own.dtype)).flatten(2).flatten(0, 1)
            beside = with_rows[:, L:].sum(0)
            right = torch.cat([with_rows[:, :L], right], -1)
            score = torch.cat([with_rows[:, -1], score], -1)
            total = torch.cat([torch.cat([own, beside.T], 1), torch.cat([beside, total], 1)])
            # Displacements come after the other unknowns.
            order = torch.arange(len(total) - 1).roll(-len(own))
            return Products(local, right, score, total).of_shared(order)
        return Products(local, right, score, total)

    def linearize(self, state: BoardState) -> SchurLinearization:
        """See `Problem.linearize`; by the unknowns that are not held."""
        by_pose, by_both, _, total = self._with_motion(state)
        linear = SchurLinearization(by_pose, by_both, self.shared_gram(state) + total)
        if self.loss is not None:
            linear.cost = self.cost(state)
        return linear

    def _with_motion(self, state: BoardState) -> Products:
        """The products with the prior of motions."""
        found = self.products(state)
        if self.readout is None:
            return found
        pull = self._still * state.motion
        by_pose, by_both, total = found.local.clone(), found.right.clone(), found.total.clone()
        by_pose.diagonal(dim1=-2, dim2=-1)[..., self.pose :] += self._still
        by_both[..., self.pose :, -1] += pull
        total[..., -1, -1] += (pull * state.motion).sum((-2, -1))
        return Products(by_pose, by_both, found.score, total)

    def off_poses(self, state: BoardState) -> Tensor:
        """(V, S + 1, R) derivatives by the shared unknowns, and residuals, off what poses and motions can do (QR)."""
        return torch.cat([without_local(self.rows(state, views), self.local_size) for views in self._chunks(state)])

    def reduced_rows(self, state: BoardState) -> Tensor:
        """(S + 1, S + 1) rows with the same products as those of `off_poses`, as a rule a triangle."""
        if self.displaced:
            # Of hundreds of unknowns more, to the precision of products.
            total = self._with_motion(state).off(self.local_size).total
            scale = total.diagonal().clamp_min(torch.finfo(total.dtype).tiny).sqrt()
            values, vectors = torch.linalg.eigh(total / scale / scale[:, None])
            kept = torch.cat([self.moving, torch.tensor([self.unknown_count])])
            rows = total.new_zeros(len(total), self.unknown_count + 1)
            return rows.index_copy(1, kept, values.clamp_min(0.0).sqrt()[:, None] * vectors.T * scale)
        parts = [
            triangular(without_local(part.rows(own, at), self.local_size).transpose(0, 1).flatten(1).T)
            for part, own, at in self._parts(state)
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
        twist = torch.nn.functional.pad(local[..., : self.pose], (0, POSE - self.pose))
        rotation, translation = apply_twist(state.rotation, state.translation, twist)
        motion = state.motion if self.readout is None else state.motion + local[..., self.pose :]
        return BoardState(parameters, board, rotation, translation, motion)

    def bent(self, state: BoardState, step: State, linear: SchurLinearization, damping: Tensor) -> State | None:
        """A step along the bent valley in which focal length, shape and field of a fisheye lie; None beyond the lens.

        Source: M. Transtrum, B. Machta, J. Sethna 2011, Phys. Rev. E 83, 036701: geodesic acceleration.
        """
        ahead, back = (self.retract(state, (way * step[0], way * step[1])) for way in (_AHEAD, -_AHEAD))
        second = (self.residuals(ahead) + self.residuals(back) - 2.0 * self.residuals(state)) / _AHEAD**2
        if not bool(second.isfinite().all()):
            return None
        by_view, L = torch.cat([self._slopes(state, second, views) for views in self._chunks(state)]), self.local_size
        shared, local = linear.solve(by_view[:, L:].sum(0)[self.moving], by_view[:, :L], damping)
        return step[0] - 0.5 * shared, step[1] - 0.5 * local

    def _slopes(self, state: BoardState, residuals: Tensor, views: slice) -> Tensor:
        """(V, L + S) products of derivatives with residuals (V, R) as of `residuals`, of some views."""
        rows, slopes = self._own_rows(state, views)
        corners, motions = residuals[views].split([2 * rows.shape[-1], self.local_size - self.pose], -1)
        found = matrix_product(rows[:, :-1].flatten(-2), corners[..., None])[..., 0]
        if self.readout is not None:
            found[:, self.pose : self.local_size] += self._still.sqrt().expand_as(state.motion)[views] * motions
        if not self.displaced:
            return found
        each = (slopes * corners.unflatten(-1, (2, -1))[:, None]).sum(2)
        return torch.cat([found, self._of_all(each, 0.0).flatten(1)], 1)

    def tidy(self, state: BoardState) -> BoardState:
        """The state with its rotations made orthonormal again after many small steps."""
        return state._replace(rotation=nearest_rotation(state.rotation))
