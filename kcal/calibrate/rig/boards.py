"""Boards that several cameras saw at the same moment, as a source of a rig."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import apply_twist
from kcal.calibrate.problem.poses import spread_out
from kcal.calibrate.problem.state import MOTION, Readout
from kcal.calibrate.problem.views import whitening
from kcal.calibrate.rig.motion import WithoutMotion
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.source import (
    LOCAL_SIZE,
    Block,
    Context,
    ItemFit,
    ItemSource,
    PosedCamera,
    RigState,
    Start,
    as_items,
    check_names,
    require_positive,
    typical_ratio,
)
from kcal.calibrate.rig.unknowns import held
from kcal.checks import chi2_quantile
from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.solve.lm import LMOptions, minimize
from kcal.texts import brief

MINIMUM_CORNERS = 6
# Whether a board contradicts the others. Its χ² has two parts. What each camera alone leaves over, with a board pose of
# its own, is due to corners and lens: a lens that is not quite its model fits one board worse than another, which no
# noise explains and no rig can mend. The rest, six degrees of freedom for every further camera, is what the board says
# about the rig. Only that part tells of a board that moved between two exposures.
#
# px along an axis, RMS of a board, that lenses which are not quite their models may add to each of the two parts.
# Measured: five coefficients on simulated ray-traced wide lenses, ordinarily put together, add 0.04 and 0.017.
_LENS, _BETWEEN = 0.1, 0.02
# With fewer boards nobody can say what is typical: one does not belong if its residuals are so many times as large as
# their noise.
_FEW_BOARDS, _WORSE_BOARD = 4, 3.0
# A board pose needs that many corners.
_CORNERS = 4
_POSES = LMOptions(max_iterations=30, tolerance=1e-8, residual_floor=1e-8)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Boards(ItemSource):
    """Boards shown to several cameras at the same moment.

    Args:
        board: the board.
        pixels: (V, C, N, 2) its corners.
        names: one for each moment.
        deviation: (N, 3) meters of each corner, as measured, from where it should be by the order; zero if left out.
        views: for each camera the names of its views, where that is known: those that its calibration used as well are
            taken out of what it knows, so that they do not count twice.
        covariance: (V, C, N, 2, 2) px² of corners, by which they weigh; all alike if left out.
        sigma: of a corner along an axis, px; estimated from the residuals if left out.
    """

    __repr__ = brief
    kind = "boards"
    few: ClassVar[str] = "fewer than two cameras see enough of it"
    checks: ClassVar[str] = "were both views of each pair taken at the same moment, of one board, and by these cameras?"
    least: ClassVar[int] = MINIMUM_CORNERS
    told_by: ClassVar[int] = 4
    own_noise: ClassVar[bool] = True

    board: Board
    pixels: Tensor
    names: tuple[str, ...]
    deviation: Tensor | None = None
    views: tuple[tuple[str, ...], ...] | None = None
    covariance: Tensor | None = None
    sigma: float | None = None

    @property
    def points(self) -> Tensor:
        """(N, 3) meters: the board's corners as measured, or as ordered."""
        return self.board.points if self.deviation is None else self.board.points + self.deviation

    def __post_init__(self) -> None:
        if self.deviation is not None and self.deviation.shape != (self.board.corners, 3):
            raise InputError(
                f"boards: a deviation ({self.board.corners}, 3) is needed, got {tuple(self.deviation.shape)}"
            )
        if self.pixels.ndim != 4 or self.pixels.shape[2:] != (self.board.corners, 2):
            raise InputError(
                f"boards: pixels (V, C, {self.board.corners}, 2) are needed, got {tuple(self.pixels.shape)}"
            )
        check_names("boards", self.names, len(self.pixels))
        if self.views is not None and [len(own) for own in self.views] != [len(self.pixels)] * self.pixels.shape[1]:
            raise InputError("boards: a name of each camera's view is needed for every moment")
        if self.covariance is not None and self.covariance.shape != (*self.pixels.shape, 2):
            raise InputError(
                f"boards: a covariance {(*self.pixels.shape, 2)} is needed, got {tuple(self.covariance.shape)}"
            )
        if self.sigma is not None:
            require_positive("boards: sigma", self.sigma)

    def whitening(self, sigma: float) -> Tensor:
        """(V, C, N, 2, 2) by which residuals are multiplied; corners have `sigma` on average."""
        if self.covariance is None:
            return (torch.eye(2, dtype=torch.float64) / sigma).expand(*self.pixels.shape, 2)
        flat = self.covariance.flatten(0, 2)
        return (whitening(flat, sigma**2) / sigma).unflatten(0, self.pixels.shape[:3])

    def seen_well(self, cameras: Sequence[Camera]) -> Tensor:
        """(V, C) whether a camera alone can tell how a board lies."""
        found = []
        for c, camera in enumerate(cameras):
            _, valid = camera.normalize(self.pixels[:, c])
            with_ray = torch.where(valid[..., None], self.pixels[:, c], math.nan)
            found.append((valid.sum(-1) >= MINIMUM_CORNERS) & spread_out(self.points, with_ray))
        return torch.stack(found, -1)

    def enough(self, cameras: Sequence[Camera]) -> Tensor:
        """See `ItemSource.enough`."""
        return self.seen_well(cameras).sum(-1) >= 2

    def begin(self, cameras: Sequence[Camera], start: Start) -> Tensor:
        """See `ItemSource.begin`."""
        return start.boards

    def block(self, mask: Tensor, given: Context) -> Block:
        """See `ItemSource.block`."""
        motion = [one and one.columns[mask] for one in given.motion]
        white = self.whitening(given.sigma_corner)[mask]
        return BoardBlock(self.pixels[mask], white, self.points, given.shapes, given.unknowns.board, motion)

    def over_limit(self, fit: ItemFit, level: float, given: Context, *, certain: bool) -> Tensor:
        """See `ItemSource.over_limit`; each board by the part of its χ² that is farther over its limit."""
        if not bool(fit.mask.any()):
            return torch.zeros(fit.mask.shape, dtype=torch.float64)
        dof, (alone, further) = fit.freedom, self._each_camera_alone(fit.mask, given)
        lens, between = (share**2 * dof / given.sigma_corner**2 for share in (_LENS, _BETWEEN))
        own = (dof - further).clamp_min(0)
        scales = (1.0, 1.0) if certain else (typical_ratio(alone, own), typical_ratio(fit.square - alone, further))
        first = max(1.0, scales[0]) * chi2_quantile(own, level) + lens
        second = max(1.0, scales[1]) * chi2_quantile(further, level) + between
        if int((dof > 0).sum()) < _FEW_BOARDS:
            first, second = (torch.maximum(limit, _WORSE_BOARD**2 * dof) for limit in (first, second))
        return torch.where(fit.mask, torch.maximum(alone / first, (fit.value - alone) / second), 0.0)

    def _each_camera_alone(self, mask: Tensor, given: Context) -> tuple[Tensor, Tensor]:
        """χ² of every board with a pose of its own for each camera, and how many degrees of freedom that costs."""
        cameras = given.cameras
        squares = torch.full(mask.shape, torch.nan, dtype=torch.float64)
        squares[mask] = 0.0
        further = torch.zeros(mask.shape, dtype=torch.int64)
        whitening, still = self.whitening(given.sigma_corner), [False] * len(cameras)
        for c in range(len(cameras)):
            some = mask & (torch.isfinite(self.pixels[:, c]).all(-1).sum(-1) >= _CORNERS)
            if not bool(some.any()):
                continue
            pixels = torch.full_like(self.pixels[some], torch.nan)
            pixels[:, c] = self.pixels[some, c]
            block = BoardBlock(pixels, whitening[some], self.points, given.shapes)
            problem = RigProblem(cameras, [block], (), held(cameras), still, still)
            start = given.state._replace(items=given.state.items[some])
            found = RigState(*minimize(problem, start, _POSES).state)
            squares[some] += problem.item_squares(found)[0]
            further[some] += LOCAL_SIZE
        return squares, (further - LOCAL_SIZE).clamp_min(0)

    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """See `ItemSource.doubt`."""
        why = "it moved between the views, or a lens differs from its model"
        # A board of many corners is wrong at few sigmas. One that is within its own limit was left out because the
        # others fit better without it.
        if over > 1.0:
            most = f"{sigmas:.2f} sigma on average, where so many corners allow {sigmas / math.sqrt(over):.2f}"
            return f"it does not fit the other boards: off by {off} ({most}): {why}"
        return (
            "it does not fit the other boards: with it, these fit worse than chance explains, though it is off by only "
            f"{off} ({sigmas:.2f} sigma on average): {why}"
        )

    def places(self, items: Tensor, anchor: Tensor) -> Tensor:
        """See `ItemSource.places`; of the middle of each board."""
        rotation, translation = board_pose(items)
        return rotation @ self.points.mean(0) + translation


def board_pose(items: Tensor) -> tuple[Tensor, Tensor]:
    """world_from_board of items (V, 12): rotation (V, 3, 3) and translation (V, 3) meters."""
    return items[:, :9].unflatten(1, (3, 3)), items[:, 9:12]


class BoardBlock(Block):
    """Boards, of which each has a pose of its own, as `board_pose` has it; all have the same shape.

    Args:
        pixels: see `Block`.
        whitening: see `Block`.
        board_points: (N, 3) meters.
        shapes: (B, 3, N) by which the state's amplitudes displace the corners.
        by_unknown: (B, K) these amplitudes by the unknowns.
        motion: for each camera (V, 12, 2, N) what boards move while it reads its rows; None where they stand still.
    """

    kind = "boards"
    size = 6
    many: ClassVar[bool] = True

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        board_points: Tensor,
        shapes: Tensor | None = None,
        by_unknown: Tensor | None = None,
        motion: Sequence[Tensor | None] = (),
    ) -> None:
        super().__init__(pixels, whitening)
        self._motion = [
            None if one is None else WithoutMotion(one, self.whitening[:, c]) for c, one in enumerate(motion)
        ]
        self._board, self._shapes, self._by_unknown = board_points.T.contiguous(), shapes, by_unknown

    def _white(self, camera: int, rows: Tensor) -> Tensor:
        white = super()._white(camera, rows)
        taken_out = self._motion[camera] if self._motion else None
        return white if taken_out is None else taken_out(white)

    def shaped(self, state: RigState) -> Tensor:
        """(3, N) the board, meters."""
        if self._shapes is None or not len(self._shapes):
            return self._board
        return self._board + torch.einsum("b,bkn->kn", state.board, self._shapes)

    def motion_columns(self, posed: PosedCamera, state: RigState, camera: int, *, reads: bool) -> tuple[Tensor, float]:
        """(V, M, 2, N) derivatives of a camera's pixels by motions, and how far a board reaches, in distances of it.

        Args:
            posed: the camera.
            state: where.
            camera: its number.
            reads: whether boards may move while its rows are read, too.
        """
        turn, shift = board_pose(state.items)
        points, rotation = self.shaped(state), posed.rotation @ turn
        translation = (shift - posed.center) @ posed.rotation.T
        found = project_components(rotation @ points + translation[..., None], posed.parameters, posed.camera.model, [])
        distance = float(translation.norm(dim=-1).median())
        readout = Readout(center=points.mean(-1), distance=distance, size=posed.camera.size)
        time = readout.time(self.target[:, camera].mT)
        columns = readout.columns_of(found.by_point, rotation, time, points, apart=True).nan_to_num(0.0)
        return columns if reads else columns[:, MOTION:], readout.reach(points.T)

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        rotation, translation = board_pose(state.items)
        points = rotation @ self.shaped(state) + translation[..., None]
        return points, points.new_ones(len(self), 1, 1)

    def _by_own(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        # By ω through ω × (R x), then by v.
        return step_rows(by_q, board_pose(state.items)[0] @ self.shaped(state))

    def _by_shared(self, state: RigState, by_q: Tensor, offset: Tensor) -> tuple[Tensor, Tensor] | None:
        if self._shapes is None or self._by_unknown is None or not bool(self._by_unknown.any()):
            return None
        by_point = torch.einsum("vjun,vjl->vlun", by_q, board_pose(state.items)[0])
        return torch.einsum("vlun,bln->vbun", by_point, self._shapes), self._by_unknown

    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """See `Block.moved`."""
        return as_items(*apply_twist(*board_pose(items), step))
