"""Bundle adjustment of boards seen by one or more cameras that are rigidly joined (Eq. 5, 7 of the paper).

Shared parameters: each camera's free parameters, the poses of all cameras but the first, the board's warp. Local ones:
the pose of the board in each view. Everything is in the frame of the first camera.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

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
            torch.cat(self.parameters),
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
    """Reprojection residuals (pixels) of boards.

    Args:
        board_points: (N, 3) metres, z = 0.
        pixels: (V, C, N, 2) observed corners; NaN where not seen.
        models: one lens model a camera.
        free: for each camera the indices of its free parameters.
        free_warp: whether the board's warp is estimated.
        weights: (V, C, N) multiplies residuals, 1 / σ for example; default 1.
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
        weights: Tensor | None = None,
    ) -> None:
        self.models = tuple(models)
        self.free = tuple(tuple(indices) for indices in free)
        self.free_warp = free_warp
        self._board = board_points.T.contiguous()
        self._shape = warp_shape(board_points)
        seen = torch.isfinite(pixels).all(-1)
        weight = seen.to(pixels.dtype) if weights is None else torch.where(seen, weights, 0.0)
        self._weight = weight[:, :, None, :]
        self._used = weight > 0
        self._target = torch.where(seen[..., None], pixels, 0.0).transpose(-1, -2).contiguous()
        self.residual_count = 2 * int(self._used.sum())
        self._sizes = [len(INTRINSICS) + model.size for model in self.models]
        counts = [len(indices) for indices in self.free]
        self._camera_slots = [slice(6 + sum(counts[:c]), 6 + sum(counts[: c + 1])) for c in range(len(self.models))]
        after = 6 + sum(counts)
        self._pose_slots = [slice(after + 6 * c, after + 6 * c + 6) for c in range(len(self.models) - 1)]
        self._warp_slot = after + 6 * (len(self.models) - 1)
        self.shared_size = self._warp_slot - 6 + 2 * free_warp

    def unpack(self, state: State) -> BoardState:
        """The solver's tuple as named tensors."""
        parameters, *rest = state
        return BoardState(
            parameters=tuple(parameters.split(self._sizes)),
            **dict(zip([f.name for f in dataclasses.fields(BoardState)][1:], rest, strict=True)),
        )

    def _points(self, s: BoardState) -> tuple[Tensor, Tensor]:
        """Board points rotated into the first camera (V, 3, N), and moved there."""
        flat = self._board
        if self.free_warp or bool(s.warp.any()):
            flat = torch.cat([flat[:2], flat[2:] + s.warp @ self._shape], 0)
        rotated = s.first_from_board_rotation @ flat
        return rotated, rotated + s.first_from_board_translation[..., None]

    def residuals(self, state: State) -> Tensor:
        """See `SchurProblem.residuals`; NaN where a used corner lies behind a camera or beyond a pole."""
        s = self.unpack(state)
        _, points = self._points(s)
        out = []
        for c, model in enumerate(self.models):
            if c > 0:
                points_c = s.cam_from_first_rotation[c - 1] @ points + s.cam_from_first_translation[c - 1][:, None]
            else:
                points_c = points
            projected = project_components(points_c, s.parameters[c], model)
            bad = self._used[:, c] & ~projected.positive
            error = (projected.pixels - self._target[:, c]) * self._weight[:, c]
            out.append(torch.where(bad[:, None, :], torch.nan, error))
        return torch.stack(out, 1).flatten(1)

    def rows(self, state: State) -> Tensor:
        """See `SchurProblem.rows`."""
        s = self.unpack(state)
        rotated, points = self._points(s)
        views, _, count = points.shape
        cameras = len(self.models)
        rows = points.new_zeros((views, 6 + self.shared_size + 1, cameras, 2, count))
        for c, model in enumerate(self.models):
            if c > 0:
                turn = s.cam_from_first_rotation[c - 1]
                rotated_c = turn @ points
                points_c = rotated_c + s.cam_from_first_translation[c - 1][:, None]
            else:
                points_c = points
            projected = project_components(points_c, s.parameters[c], model, self.free[c])
            by_first = projected.by_point
            if c > 0:
                rows[:, self._pose_slots[c - 1], c] = step_rows(projected.by_point, rotated_c)
                by_first = torch.einsum("vkun,kj->vjun", projected.by_point, turn)
            rows[:, :6, c] = step_rows(by_first, rotated)
            rows[:, self._camera_slots[c], c] = projected.by_camera
            if self.free_warp:
                along = torch.einsum("vkun,vk->vun", by_first, s.first_from_board_rotation[..., 2])
                rows[:, self._warp_slot : self._warp_slot + 2, c] = along[:, None] * self._shape[:, None]
            rows[:, -1, c] = projected.pixels - self._target[:, c]
        rows *= self._weight[:, None]
        # A corner that was not seen may have no finite derivative either.
        return (
            torch.where(self._used[:, None, :, None], rows, 0.0).flatten(2)
            if not bool(self._used.all())
            else (rows.flatten(2))
        )

    def retract(self, state: State, step: State) -> State:
        """See `SchurProblem.retract`."""
        s = self.unpack(state)
        shared, local = step
        parameters = []
        for c, indices in enumerate(self.free):
            moved = s.parameters[c].clone()
            moved[list(indices)] += shared[self._camera_slots[c].start - 6 : self._camera_slots[c].stop - 6]
            parameters.append(moved)
        warp = s.warp + shared[self._warp_slot - 6 :] if self.free_warp else s.warp
        cameras = len(self.models) - 1
        poses = shared[self._warp_slot - 6 - 6 * cameras : self._warp_slot - 6].reshape(cameras, 6)
        if cameras:
            rotation, translation = move(s.cam_from_first_rotation, s.cam_from_first_translation, poses)
        else:
            rotation, translation = s.cam_from_first_rotation, s.cam_from_first_translation
        board_rotation, board_translation = move(s.first_from_board_rotation, s.first_from_board_translation, local)
        return BoardState(
            parameters=tuple(parameters),
            warp=warp,
            cam_from_first_rotation=rotation,
            cam_from_first_translation=translation,
            first_from_board_rotation=board_rotation,
            first_from_board_translation=board_translation,
        ).pack()

    def tidy(self, state: State) -> BoardState:
        """The state with its rotations made orthonormal again after many small steps."""
        s = self.unpack(state)
        return dataclasses.replace(
            s,
            cam_from_first_rotation=nearest_rotation(s.cam_from_first_rotation),
            first_from_board_rotation=nearest_rotation(s.first_from_board_rotation),
        )
