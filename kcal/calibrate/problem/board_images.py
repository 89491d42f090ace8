"""What a camera shows of boards at a state: pixels, errors, and derivatives of the corners by all unknowns.

Of a hybrid lens there may be hundreds of derivatives. They are written where they belong, each once, and what the cost
of a trial step needed of them is kept for the linearization that follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.parameters import FreeParameters
from kcal.calibrate.problem.readout import MOTION, Readout
from kcal.calibrate.problem.state import BoardState, warp_modes
from kcal.lens.hybrid_terms import LEADING, fill_field_columns
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import INTRINSICS, Projection, project_components
from kcal.solve.robust import RobustLoss

# All views.
ALL = slice(None)
# Numbers of a pose's step.
POSE = 6


class BoardImages:
    """Corners of boards in the views of one camera; see `kcal.calibrate.problem.board_problem.BoardProblem`.

    Attributes:
        seen: (..., V, N) corners that count.
        weights: (..., V, N) or (..., V, 2, 2, N).
        local_size: unknowns of each view: of its pose, and of its motion.
        unknown_count: of camera and board, those that are held among them.
        joint: whether a linearization costs little more than the cost alone: with hundreds of columns it costs more.
    """

    def __init__(
        self,
        board_points: Tensor,
        pixels: Tensor,
        model: LensModel,
        free: Sequence[int] | FreeParameters,
        shapes: Tensor | None,
        free_board: bool,
        weights: Tensor | None,
        loss: RobustLoss | None,
        readout: Readout | None,
        batch: tuple[int, ...],
    ) -> None:
        self.model, self.loss, self.batch = model, loss, batch
        self.free, self.free_board = FreeParameters.of(free), free_board
        self.board_points, self._board = board_points, board_points.T.contiguous()
        self.shapes = warp_modes(board_points) if shapes is None else shapes
        self.seen = torch.isfinite(pixels).all(-1)
        if weights is not None and weights.ndim == self.seen.ndim:
            self.seen = self.seen & (weights > 0)
        self._target = torch.where(self.seen[..., None], pixels, 0.0).transpose(-1, -2).contiguous()
        self._weigh(weights)
        self.readout = readout
        self.local_size = POSE + (MOTION if readout else 0)
        if readout is not None:
            self._time = readout.time(pixels)
        self.unknown_count = len(self.free) + len(self.shapes) * free_board
        self.joint = not model.hybrid
        self._shown: list[tuple[BoardState, _Imaged]] = []
        self._slots = torch.tensor(self.free.slots, dtype=torch.long, device=pixels.device)
        first = len(INTRINSICS) + len(LEADING)
        self._leading = [index for index in self.free.indices if index < first]
        self._field = self._field_slots(first, weights) if model.hybrid and not batch else None

    def _weigh(self, weights: Tensor | None) -> None:
        self.weights: Tensor | None = None  # (..., V, N) or (..., V, 2, 2, N)
        self._counts = self.seen
        if weights is not None and weights.ndim > self.seen.ndim:
            self.weights = torch.where(self.seen[..., None, None], weights, 0.0).movedim(-3, -1).contiguous()
        elif weights is not None and not bool((weights[self.seen] == 1.0).all()):
            self.weights = torch.where(self.seen, weights, 0.0)
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
        return torch.where(self.seen[..., None], self._target.transpose(-1, -2), torch.nan)

    def _placed(self, state: BoardState, views: slice = ALL) -> _Placed:
        flat = self._board
        if len(self.shapes) and (self.free_board or bool(state.board.any())):
            flat = flat + torch.einsum("...b,bkn->...kn", state.board, self.shapes)[..., None, :, :]
        if self.readout is None:
            rotated = state.rotation @ flat
            return _Placed(flat, rotated, rotated + state.translation[..., None], None)
        flat = flat.squeeze(0)
        moved = self.readout.moved(state.motion, self._time[views], flat)
        rotated = state.rotation @ moved.points
        return _Placed(flat, rotated, rotated + state.translation[..., None] + moved.shift, moved.turn)

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
        """(..., V, N, 3) the board's corners in the camera's frame, meters."""
        return self._placed(state).points.transpose(-1, -2)

    def pixel_errors(self, state: BoardState) -> Tensor:
        """Projected minus observed, (..., V, 2, N) pixels, not weighted; 0 where not seen.

        NaN where a seen corner lies behind the camera, or beyond a pole or a fold of the lens.
        """
        if self._by_field(state):
            projected = self._imaged(state).seen
        else:
            points = self._placed(state).points
            projected = project_components(points, state.parameters[..., None, :], self.model)
        bad = torch.where(projected.regular, 0.0, torch.nan)[..., None, :]
        return torch.where(self.seen[..., None, :], projected.pixels - self._target + bad, 0.0)

    def corner_residuals(self, state: BoardState, *, weighted: bool = False) -> Tensor:
        """(..., V, N, 2) residuals by corner; NaN where not seen."""
        errors = self.pixel_errors(state)
        if weighted:
            errors = self._weighted(errors[..., None, :, :])[..., 0, :, :]
        return torch.where(self.seen[..., None], errors.transpose(-1, -2), torch.nan)

    def _weighted(self, vectors: Tensor, views: slice = ALL) -> Tensor:
        """Vectors (..., V, Q, 2, N) of pixels, multiplied by the corners' weights; 0 where these are zero."""
        if self.weights is None:
            return vectors
        if self.weights.ndim > self.seen.ndim:
            return torch.einsum("...uwn,...qwn->...qun", self.weights[..., views, :, :, :], vectors)
        weights = self.weights[..., views, None, None, :]
        # Without an image a corner of weight zero is NaN.
        return torch.where(weights > 0, vectors * weights, 0.0)

    def _counted(self, vectors: Tensor, views: slice) -> Tensor:
        """Vectors as in `_weighted`, zero where a corner does not count."""
        if not self._all_count:
            vectors = torch.where(self._counts[..., views, None, None, :], vectors, 0.0)
        return self._weighted(vectors, views)

    def corner_rows(self, state: BoardState, views: slice = ALL, memory: list[Tensor] | None = None) -> Tensor:
        """(..., V, L + S + 1, 2 N) as `rows`, of the corners alone, and as if no unknown were held.

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
        rows = self._memory(by_point, L + self.unknown_count + 1, memory)
        rows[..., :POSE, :, :] = step_rows(by_point, placed.rotated)
        if self.readout is not None:
            rows[..., POSE:L, :, :] = self.readout.columns_of(by_point, rotation, self._time[views], placed.flat)
        shared = rows[..., L:-1, :, :]
        slots = self._slots[: by_camera.shape[-3]]
        shared.index_fill_(-3, slots, 0.0).index_add_(-3, slots, by_camera)
        if len(slots) < len(self._slots):
            self._fill_field(shared, seen, state, views)
        if self.free_board:
            by_board = (rotation.mT @ by_point.flatten(-2)).unflatten(-1, (2, -1))
            if placed.turn is not None:
                # What displaces a corner of the board turns with it.
                by_board = by_board + torch.linalg.cross(by_board, placed.turn[:, :, None].expand_as(by_board), dim=1)
            along = zip(by_board.split(1, -3), self.shapes[:, :, None].unbind(1), strict=True)
            shared[..., count:, :, :] = sum(slope * shape for slope, shape in along)
        rows[..., -1:, :, :] = error
        if self.loss is not None:
            rows = rows * self.loss.weight(error.square().sum(-2)).sqrt()[..., None, :]
        return rows.flatten(-2)

    def _memory(self, like: Tensor, count: int, memory: list[Tensor] | None) -> Tensor:
        """(..., V, count, 2, N), of one camera such that each column is in one piece."""
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
            counts = self._counts[views]
            x, y = torch.where(counts, x, 0.0), torch.where(counts, y, 0.0)
        if self.weights is not None:
            scale = scale * self.weights[views, None]
        fill_field_columns(shared[:, self._field].transpose(0, 1), x, y, scale, self.model.hybrid)


class _Placed(NamedTuple):
    """The board (..., 3, N) in its frame; in each view rotated, and in the camera's frame; turns while it is read."""

    flat: Tensor
    rotated: Tensor
    points: Tensor
    turn: Tensor | None

    def of(self, views: slice) -> _Placed:
        """The same of some of all views of one camera."""
        turn = None if self.turn is None else self.turn[views]
        return self._replace(rotated=self.rotated[views], points=self.points[views], turn=turn)


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
