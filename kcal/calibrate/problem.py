"""Bundle adjustment of boards seen by one or more cameras that are rigidly joined (Eq. 5, 7 of the paper).

Shared parameters: each camera's free parameters, the poses of all cameras but the first, the board's warp. Local ones:
the pose of the board in each view. Everything is in the frame of the first camera.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from kcal.lens.model import LensModel
from kcal.lens.pose import move, nearest_rotation, step_rows
from kcal.lens.projection import INTRINSICS, project_components
from kcal.solve.result import State
from kcal.solve.schur import SchurProblem


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoardState:
    """A readable view of a solver state.

    Args:
        parameters: one vector (5 + P) a camera.
        warp: (2,) metres, see `warp_shape`.
        cam_from_first_rotation: (C - 1, 3, 3).
        cam_from_first_translation: (C - 1, 3) metres.
        first_from_board_rotation: (V, 3, 3).
        first_from_board_translation: (V, 3) metres.
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
    corners, so that a warp is the greatest deflection in metres along each direction (as mrcal's first warp model).
    """
    low, high = board_points[:, :2].amin(0), board_points[:, :2].amax(0)
    scaled = (2.0 * board_points[:, :2] - low - high) / (high - low)
    return (1.0 - scaled**2).T


class BoardProblem(SchurProblem):
    """Reprojection residuals (pixels) of boards; every tensor of a state may have leading batch dimensions.

    Args:
        board_points: (N, 3) metres, z = 0.
        pixels: (..., V, C, N, 2) observed corners; NaN where not seen. Leading dimensions broadcast with `batch`.
        models: one lens model a camera.
        free: for each camera the indices of its free parameters.
        free_warp: whether the board's warp is estimated.
        whitening: (..., V, C, N, 2, 2) by which each corner's residual is multiplied (`kcal.calibrate.weights`), or
            None: all corners count alike.
        guard: (3, K) points in front of the camera at which every camera's lens must be regular, whether a corner was
            seen there or not; None: only at seen corners. States that break this have no cost.
        batch: leading shape of the states, () for one solve.
    """

    local_size = 6

    def __init__(
        self,
        board_points: Tensor,
        pixels: Tensor,
        models: Sequence[LensModel],
        free: Sequence[Sequence[int]],
        *,
        free_warp: bool = False,
        whitening: Tensor | None = None,
        guard: Tensor | None = None,
        batch: tuple[int, ...] = (),
    ) -> None:
        self.models = tuple(models)
        self.free = tuple(tuple(indices) for indices in free)
        self.free_warp = free_warp
        self.batch = batch
        self._guard = guard
        self._board = board_points.T.contiguous()
        self._shape = warp_shape(board_points)
        self._seen = torch.isfinite(pixels).all(-1)
        self._all_seen = bool(self._seen.all())
        self._target = torch.where(self._seen[..., None], pixels, 0.0).transpose(-1, -2).contiguous()
        self._whitening: Tensor | None = None
        if whitening is not None:
            seen = self._seen[..., None, None]
            self._whitening = torch.where(seen, whitening, 0.0).movedim(-3, -1).contiguous()  # (..., V, C, 2, 2, N)
        self.residual_count = 2 * int(self._seen.sum((-3, -2, -1)).max())
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
    def whitened(self) -> bool:
        """Whether corners count by their own weights."""
        return self._whitening is not None

    def unpack(self, state: State) -> BoardState:
        """The solver's tuple as named tensors."""
        parameters, *rest = state
        return BoardState(
            parameters=tuple(parameters.split(self._sizes, -1)),
            **dict(zip([field.name for field in dataclasses.fields(BoardState)][1:], rest, strict=True)),
        )

    def _points(self, s: BoardState) -> tuple[Tensor, Tensor]:
        """Board points rotated into the first camera (..., V, 3, N), and moved there."""
        flat = self._board
        if self.free_warp or bool(s.warp.any()):
            height = (s.warp[..., None, :] @ self._shape)[..., None, :, :]
            plane = flat[:2].expand(*height.shape[:-2], -1, -1)
            flat = torch.cat([plane, height], -2)
        rotated = s.first_from_board_rotation @ flat
        return rotated, rotated + s.first_from_board_translation[..., None]

    def _views(self, s: BoardState) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
        """For each camera: its number, points rotated by its pose, points in its frame, its parameters."""
        _, points = self._points(s)
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
        if self._whitening is not None:
            errors = torch.einsum("...uwn,...wn->...un", self._whitening, errors)
        return errors.flatten(-3)

    def pixel_errors(self, state: State) -> Tensor:
        """Projected minus observed, (..., V, C, 2, N) pixels, not weighted; 0 where not seen."""
        out = []
        for c, _, points, parameters in self._views(self.unpack(state)):
            projected = project_components(points, parameters, self.models[c])
            error = projected.pixels - self._target[..., c, :, :]
            seen = self._seen[..., c, None, :]
            bad = torch.where(projected.regular, 0.0, torch.nan)[..., None, :]
            error = torch.where(seen, error + bad, 0.0)
            if self._guard is not None:
                kept = project_components(self._guard, parameters[..., 0, :], self.models[c]).regular.all(-1)
                error = torch.where(kept[..., None, None, None], error, torch.nan)
            out.append(error)
        return torch.stack(out, -3)

    def rows(self, state: State) -> Tensor:
        """See `SchurProblem.rows`."""
        s = self.unpack(state)
        rotated_board, points = self._points(s)
        shape = (*points.shape[:-2], 6 + self.shared_size + 1, len(self.models), 2, points.shape[-1])
        rows = points.new_zeros(shape)
        shared = rows[..., 6:-1, :, :, :]
        for c, rotated, moved, parameters in self._views(s):
            projected = project_components(moved, parameters, self.models[c], self.free[c])
            by_first = projected.by_point
            if c > 0:
                turn = s.cam_from_first_rotation[..., c - 1, :, :]
                shared[..., self._pose_slots[c - 1], c, :, :] = step_rows(projected.by_point, rotated)
                by_first = torch.einsum("...vkun,...kj->...vjun", projected.by_point, turn)
            rows[..., :6, c, :, :] = step_rows(by_first, rotated_board)
            shared[..., self._camera_slots[c], c, :, :] = projected.by_camera
            if self.free_warp:
                normal = s.first_from_board_rotation[..., 2]
                along = torch.einsum("...vkun,...vk->...vun", by_first, normal)
                shared[..., self._warp_slot, c, :, :] = along[..., None, :, :] * self._shape[:, None]
            # As in `residuals`, so that a start that is no projection is told from one that is.
            bad = torch.where(projected.regular, 0.0, torch.nan)[..., None, :]
            rows[..., -1, c, :, :] = projected.pixels - self._target[..., c, :, :] + bad
        if not self._all_seen:
            rows = torch.where(self._seen[..., None, :, None, :], rows, 0.0)
        if self._whitening is not None:
            rows = torch.einsum("...cuwn,...pcwn->...pcun", self._whitening, rows)
        return rows.flatten(-3)

    def retract(self, state: State, step: State) -> State:
        """See `SchurProblem.retract`."""
        s = self.unpack(state)
        shared, local = step
        parameters = []
        for before, indices, slot in zip(s.parameters, self.free, self._camera_slots, strict=True):
            after = before.clone()
            after[..., list(indices)] += shared[..., slot]
            parameters.append(after)
        rotation, translation = s.cam_from_first_rotation, s.cam_from_first_translation
        if self._pose_slots:
            poses = torch.stack([shared[..., slot] for slot in self._pose_slots], -2)
            rotation, translation = move(rotation, translation, poses)
        board = move(s.first_from_board_rotation, s.first_from_board_translation, local)
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
