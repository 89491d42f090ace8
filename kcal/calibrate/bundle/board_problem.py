"""Bundle adjustment of boards seen by one or more cameras that are rigidly joined (Eq. 5, 7 of the paper).

Shared parameters: each camera's free parameters, the poses of all cameras but the first, the board's warp. Local ones:
the pose of the board in each view. Everything is in the frame of the first camera.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
from collections.abc import Hashable, Iterator, Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.numpy_rows import board_rows, on_host
from kcal.calibrate.bundle.parameters import Free
from kcal.calibrate.bundle.priors import Prior, Term
from kcal.calibrate.bundle.twist import apply_twist
from kcal.lens.model import LensModel
from kcal.lens.pose import nearest_rotation, step_rows
from kcal.lens.projection import INTRINSICS, project_components
from kcal.lens.residual import Field
from kcal.solve.result import State
from kcal.solve.robust import RobustLoss
from kcal.solve.schur import SchurLinearization, SchurProblem

_ALL = slice(None)
# Numbers in the rows of derivatives that are formed at a time: as many as the cache of one core holds.
_CHUNK = 600_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoardState:
    """A readable view of a solver state.

    Args:
        parameters: one vector (5 + P) a camera.
        warp: (2,) meters, see `warp_shape`.
        cam_from_first_rotation: (C - 1, 3, 3).
        cam_from_first_translation: (C - 1, 3) meters.
        first_from_board_rotation: (V, 3, 3).
        first_from_board_translation: (V, 3) meters.
    """

    parameters: tuple[Tensor, ...]
    warp: Tensor
    cam_from_first_rotation: Tensor
    cam_from_first_translation: Tensor
    first_from_board_rotation: Tensor
    first_from_board_translation: Tensor

    def pack(self) -> State:
        """As the solver's tuple."""
        return (
            torch.cat(self.parameters, -1),
            self.warp,
            self.cam_from_first_rotation,
            self.cam_from_first_translation,
            self.first_from_board_rotation,
            self.first_from_board_translation,
        )


def warp_shape(board_points: Tensor) -> Tensor:
    """How a bent board bulges: two parabolas (2, N) that are 1 in the middle and 0 at the outer corners.

    The board's height above its plane is warp_x (1 - x²) + warp_y (1 - y²) with x, y scaled to ±1 at the outermost
    corners, so that a warp is the greatest deflection in meters along each direction (as mrcal's first warp model).
    """
    low, high = board_points[:, :2].amin(0), board_points[:, :2].amax(0)
    scaled = (2.0 * board_points[:, :2] - low - high) / (high - low)
    return (1.0 - scaled**2).T


def _turn_rows(by_point: Tensor, rotated: Tensor, out: Tensor) -> None:
    """The first half of `kcal.lens.pose.step_rows`, derivatives by ω, written in place: point × derivative."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        row = out[..., i, :, :]
        torch.mul(by_point[..., k, :, :], rotated[..., j, None, :], out=row)
        row.addcmul_(by_point[..., j, :, :], rotated[..., k, None, :], value=-1.0)


class BoardProblem(SchurProblem):
    """Reprojection residuals (pixels) of boards; every tensor of a state may have leading batch dimensions.

    Args:
        board_points: (N, 3) meters, z = 0.
        pixels: (..., V, C, N, 2) observed corners; NaN where not seen. Leading dimensions broadcast with `batch`.
        models: one lens model a camera.
        free: for each camera the indices of its free parameters, or which of them move together.
        free_warp: whether the board's warp is estimated.
        whitening: (..., V, C, N, 2, 2) by which each corner's residual is multiplied (`kcal.calibrate.bundle.weights`),
            or
            None: all corners count alike.
        loss: of the length of each corner's residual (after whitening), or None for plain least squares.
        terms: priors and bounds on the first camera's parameters and the warp, beside the corners.
        fields: for each camera what corrects its lens, held as it is, or None; nothing given: no camera has any.
        batch: leading shape of the states, () for one solve.
    """

    local_size = 6
    joint = True

    def __init__(
        self,
        board_points: Tensor,
        pixels: Tensor,
        models: Sequence[LensModel],
        free: Sequence[Sequence[int] | Free],
        *,
        free_warp: bool = False,
        whitening: Tensor | None = None,
        loss: RobustLoss | None = None,
        terms: Sequence[Term] = (),
        fields: Sequence[Field | None] = (),
        batch: tuple[int, ...] = (),
    ) -> None:
        self.models = tuple(models)
        self.fields = tuple(fields) or (None,) * len(self.models)
        self.free = tuple(Free.of(indices) for indices in free)
        self.free_warp = free_warp
        self.batch = batch
        self.terms = tuple(terms)
        self.loss = loss
        self.board_points = board_points
        self._board = board_points.T.contiguous()
        self._shape = warp_shape(board_points)
        self.seen = torch.isfinite(pixels).all(-1)
        self._all_seen = bool(self.seen.all())
        self._target = torch.where(self.seen[..., None], pixels, 0.0).transpose(-1, -2).contiguous()
        self.whitening: Tensor | None = None
        if whitening is not None:
            seen = self.seen[..., None, None]
            self.whitening = torch.where(seen, whitening, 0.0).movedim(-3, -1).contiguous()  # (..., V, C, 2, 2, N)
        self.residual_count = 2 * int(self.seen.sum((-3, -2, -1)).max())
        self._sizes = [len(INTRINSICS) + model.size for model in self.models]
        # Where each block of shared parameters stands in a step: cameras, poses of the further cameras, warp.
        counts = [*(len(indices) for indices in self.free), *[6] * (len(self.models) - 1), 2 * free_warp]
        ends = list(itertools.accumulate(counts))
        slots = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
        self._camera_slots = slots[: len(self.models)]
        self._pose_slots = slots[len(self.models) : -1]
        self._warp_slot = slots[-1]
        self.shared_size = ends[-1]

    @property
    def pixels(self) -> Tensor:
        """(..., V, C, N, 2) observed corners; NaN where not seen."""
        return torch.where(self.seen[..., None], self._target.transpose(-1, -2), torch.nan)

    @property
    def elements(self) -> int:
        """How many states are solved side by side."""
        return math.prod(self.batch)

    @property
    def corner_slots(self) -> int:
        """Places for corners in each of them."""
        return math.prod(self.seen.shape[-3:])

    @property
    def alike(self) -> Hashable:
        """Problems that agree in this can be joined into one of a batch."""
        terms = tuple(term.alike for term in self.terms)
        board = tuple(self.board_points.flatten().tolist())
        # A field is held by all of a batch, so that only those of the same one go together.
        fields = tuple(id(field) for field in self.fields if field is not None)
        return board, self.models, self.free, self.free_warp, self.whitened, self.loss, terms, fields

    def repeated(self, count: int) -> BoardProblem:
        """A batch of this problem, which is none yet."""
        batch = copy.copy(self)
        batch.batch = (count,)
        return batch

    def select(self, elements: Tensor) -> BoardProblem | None:
        """See `SchurProblem.select`."""
        if len(self.batch) != 1:
            return None
        part = copy.copy(self)
        part.batch = (len(elements),)
        part.terms = tuple(term.select(elements) for term in self.terms)
        if self.seen.ndim > 3:
            part.seen, part._target = self.seen[elements], self._target[elements]
            part._all_seen = bool(part.seen.all())
        if self.whitening is not None and self.whitening.ndim > 5:
            part.whitening = self.whitening[elements]
        return part

    @property
    def whitened(self) -> bool:
        """Whether corners count by their own weights."""
        return self.whitening is not None

    @property
    def robust(self) -> bool:
        """Whether a robust loss is minimized."""
        return self.loss is not None

    @property
    def prior_count(self) -> int:
        """Number of scalar residuals that are priors."""
        return sum(len(term.index) for term in self.terms if isinstance(term, Prior))

    def unpack(self, state: State) -> BoardState:
        """The solver's tuple as named tensors."""
        parameters, *rest = state
        return BoardState(
            parameters=tuple(parameters.split(self._sizes, -1)),
            **dict(zip([field.name for field in dataclasses.fields(BoardState)][1:], rest, strict=True)),
        )

    def points(self, s: BoardState) -> tuple[Tensor, Tensor]:
        """Board points rotated into the first camera (..., V, 3, N), and moved there."""
        flat = self._board
        if self.free_warp or bool(s.warp.any()):
            height = flat[2] + (s.warp[..., None, :] @ self._shape)[..., None, :, :]
            plane = flat[:2].expand(*height.shape[:-2], -1, -1)
            flat = torch.cat([plane, height], -2)
        rotated = s.first_from_board_rotation @ flat
        return rotated, rotated + s.first_from_board_translation[..., None]

    def _views(self, s: BoardState) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
        """For each camera: its number, points rotated by its pose, points in its frame, its parameters."""
        _, points = self.points(s)
        for c, parameters in enumerate(s.parameters):
            if c == 0:
                yield c, points, points, parameters[..., None, :]
            else:
                rotated = s.cam_from_first_rotation[..., None, c - 1, :, :] @ points
                moved = rotated + s.cam_from_first_translation[..., None, c - 1, :, None]
                yield c, rotated, moved, parameters[..., None, :]

    def residuals(self, state: State) -> Tensor:
        """See `SchurProblem.residuals`; NaN where a seen corner lies behind a camera, beyond a pole or a fold."""
        errors = self.pixel_errors(state)
        if self.whitening is not None:
            errors = torch.einsum("...uwn,...wn->...un", self.whitening, errors)
        return errors.flatten(-3)

    def view_cost(self, state: State) -> Tensor:
        """See `SchurProblem.view_cost`."""
        if self.loss is None:
            return super().view_cost(state)
        return 0.5 * self.loss.value(self._squared(self.residuals(state))).sum((-2, -1))

    def corner_weights(self, state: State) -> Tensor:
        """(..., V, C, N) by which the robust loss lets each corner's squared residual count; 1 without a loss."""
        squared = self._squared(self.residuals(state))
        return torch.ones_like(squared) if self.loss is None else self.loss.weight(squared)

    def _squared(self, residuals: Tensor) -> Tensor:
        """Squared lengths (..., V, C, N) of residuals (..., V, C 2 N)."""
        return residuals.unflatten(-1, (len(self.models), 2, -1)).square().sum(-2)

    def linearize(self, state: State) -> SchurLinearization:
        """See `Problem.linearize`."""
        linear = super().linearize(state)
        if self.loss is not None:
            linear.cost = self.cost(state)
        return linear

    def pixel_errors(self, state: State) -> Tensor:
        """Projected minus observed, (..., V, C, 2, N) pixels, not weighted; 0 where not seen."""
        out = []
        for c, _, points, parameters in self._views(self.unpack(state)):
            projected = project_components(points, parameters, self.models[c], None, self.fields[c])
            error = projected.pixels - self._target[..., c, :, :]
            seen = self.seen[..., c, None, :]
            bad = torch.where(projected.regular, 0.0, torch.nan)[..., None, :]
            error = torch.where(seen, error + bad, 0.0)
            out.append(error)
        return torch.stack(out, -3)

    def gram(self, state: State) -> Tensor:
        """See `SchurProblem.gram`; a few views at a time, so that their rows stay in the cache."""
        *shared, rotation, translation = state
        count = rotation.shape[-3]
        row = 2 * self._board.shape[-1] * len(self.models) * (6 + self.shared_size + 1) * max(1, math.prod(self.batch))
        size = max(1, _CHUNK // row)
        if count <= size:
            return super().gram(state)
        out = []
        for start in range(0, count, size):
            views = slice(start, start + size)
            part = (*shared, rotation[..., views, :, :], translation[..., views, :])
            rows = self.rows(part, views)
            out.append(rows @ rows.transpose(-1, -2))
        return torch.cat(out, -3)

    def whiten(self, vectors: Tensor, views: slice = _ALL) -> Tensor:
        """Vectors (V, Q, 2, N) of the first camera's pixels by the corners' weights, like its residuals."""
        if self.whitening is None:
            return vectors
        return torch.einsum("vuwn,vqwn->vqun", self.whitening[views, 0], vectors)

    def rows(self, state: State, views: slice = _ALL) -> Tensor:
        """See `SchurProblem.rows`; of a state that holds the poses of some views only, if these are given."""
        s = self.unpack(state)
        seen, target = self.seen[..., views, :, :], self._target[..., views, :, :, :]
        rotated_board, points = self.points(s)
        if self.fields == (None,) and on_host(self.models, points, s.parameters[0]):
            bend = None
            if self.free_warp:
                bend = s.first_from_board_rotation[..., None, :, 2, None] * self._shape[:, None]
            model, free = self.models[0], self.free[0]
            both = rotated_board, points
            rows = board_rows(both, s.parameters[0], model, free, target[..., 0, :, :], bend)[..., None, :, :]
            return self._masked(rows, seen, views)
        shape = (*points.shape[:-2], 6 + self.shared_size + 1, len(self.models), 2, points.shape[-1])
        # What a camera's rows do not depend on is zero: the parameters of the others.
        rows = points.new_empty(shape) if len(self.models) == 1 else points.new_zeros(shape)
        shared = rows[..., 6:-1, :, :, :]
        for c, rotated, moved, parameters in self._views(s):
            projected = project_components(moved, parameters, self.models[c], self.free[c].indices, self.fields[c])
            by_first = projected.by_point
            if c > 0:
                turn = s.cam_from_first_rotation[..., c - 1, :, :]
                shared[..., self._pose_slots[c - 1], c, :, :] = step_rows(projected.by_point, rotated)
                by_first = torch.einsum("...vkun,...kj->...vjun", projected.by_point, turn)
            _turn_rows(by_first, rotated_board, rows[..., :3, c, :, :])
            rows[..., 3:6, c, :, :] = by_first
            shared[..., self._camera_slots[c], c, :, :] = self.free[c].collapse(projected.by_camera, -3)
            if self.free_warp:
                normal = s.first_from_board_rotation[..., 2]
                along = torch.einsum("...vkun,...vk->...vun", by_first, normal)
                shared[..., self._warp_slot, c, :, :] = along[..., None, :, :] * self._shape[:, None]
            error = rows[..., -1, c, :, :]
            torch.sub(projected.pixels, target[..., c, :, :], out=error)
            # As in `residuals`, so that a start that is no projection is told from one that is.
            if not bool(projected.regular.all()):
                error += torch.where(projected.regular, 0.0, torch.nan)[..., None, :]
        return self._masked(rows, seen, views)

    def _masked(self, rows: Tensor, seen: Tensor, views: slice) -> Tensor:
        """Rows (..., V, L + S + 1, C, 2, N) of the corners that were seen, weighted: (..., V, L + S + 1, R)."""
        if not self._all_seen:
            rows = torch.where(seen[..., None, :, None, :], rows, 0.0)
        if self.whitening is not None:
            rows = torch.einsum("...cuwn,...pcwn->...pcun", self.whitening[..., views, :, :, :, :], rows)
        if self.loss is not None:
            squared = rows[..., -1, :, :, :].square().sum(-2)
            rows = rows * self.loss.weight(squared).sqrt()[..., None, :, None, :]
        return rows.flatten(-3)

    def shared_rows(self, state: State) -> Tensor | None:
        """See `SchurProblem.shared_rows`."""
        if not self.terms:
            return None
        s = self.unpack(state)
        values = torch.cat([s.parameters[0], s.warp], -1)
        found = torch.cat([term.rows(values) for term in self.terms], -1)
        if not found.shape[-1]:
            return None
        rows = found.new_zeros((*found.shape[:-2], self.shared_size + 1, found.shape[-1]))
        rows[..., self._camera_slots[0], :] = self.free[0].collapse(found[..., list(self.free[0]), :], -2)
        rows[..., self._warp_slot, :] = found[..., -3 : -3 + 2 * self.free_warp, :]
        rows[..., -1, :] = found[..., -1, :]
        return rows

    def retract(self, state: State, step: State) -> State:
        """See `SchurProblem.retract`."""
        s = self.unpack(state)
        shared, local = step
        parameters = []
        for before, indices, slot in zip(s.parameters, self.free, self._camera_slots, strict=True):
            after = before.clone()
            after[..., list(indices)] += indices.expand(shared[..., slot])
            parameters.append(after)
        rotation, translation = s.cam_from_first_rotation, s.cam_from_first_translation
        if self._pose_slots:
            poses = torch.stack([shared[..., slot] for slot in self._pose_slots], -2)
            rotation, translation = apply_twist(rotation, translation, poses)
        board = apply_twist(s.first_from_board_rotation, s.first_from_board_translation, local)
        return BoardState(
            parameters=tuple(parameters),
            warp=s.warp + shared[..., self._warp_slot] if self.free_warp else s.warp,
            cam_from_first_rotation=rotation,
            cam_from_first_translation=translation,
            first_from_board_rotation=board[0],
            first_from_board_translation=board[1],
        ).pack()

    def tidy(self, state: State) -> State:
        """The state with its rotations made orthonormal again after many small steps."""
        s = self.unpack(state)
        return dataclasses.replace(
            s,
            cam_from_first_rotation=nearest_rotation(s.cam_from_first_rotation),
            first_from_board_rotation=nearest_rotation(s.first_from_board_rotation),
        ).pack()
