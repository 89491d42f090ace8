"""All that a rig is solved from: boards, what was measured besides what cameras see, and the list of its sources."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import MOTION, BoardState, Readout
from kcal.calibrate.problem.views import Views, refine_poses, spread_out, whitening
from kcal.calibrate.rig.marks import Features, Landmarks, SkylineSource, StarSource
from kcal.calibrate.rig.motion import CameraRows, WithoutMotion
from kcal.calibrate.rig.source import (
    LOCAL_SIZE,
    Block,
    Context,
    ItemFit,
    ItemSource,
    Measurement,
    PosedCamera,
    RigState,
    Source,
    Start,
    as_items,
    check_names,
    require_positive,
    require_shape,
    typical_ratio,
)
from kcal.checks import chi2_quantile
from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.lens.calibration import ItemResidual
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose, apply_twist
from kcal.lens.projection import project_components
from kcal.solve.lm import LMOptions
from kcal.texts import brief

# Boards that several cameras saw at the same moment, as a source of a rig.

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
        require_shape("boards: a deviation", self.deviation, (self.board.corners, 3))
        if self.pixels.ndim != 4 or self.pixels.shape[2:] != (self.board.corners, 2):
            raise InputError(
                f"boards: pixels (V, C, {self.board.corners}, 2) are needed, got {tuple(self.pixels.shape)}"
            )
        check_names("boards", self.names, len(self.pixels))
        if self.views is not None and [len(own) for own in self.views] != [len(self.pixels)] * self.pixels.shape[1]:
            raise InputError("boards: a name of each camera's view is needed for every moment")
        require_shape("boards: a covariance", self.covariance, (*self.pixels.shape, 2))
        if self.sigma is not None:
            require_positive("boards: sigma", self.sigma)

    def whitening(self, sigma: float) -> Tensor:
        """(V, C, N), or (V, C, N, 2, 2), by which residuals are multiplied; corners have `sigma` on average."""
        if self.covariance is None:
            return torch.full(self.pixels.shape[:-1], 1.0 / sigma, dtype=torch.float64)
        return (whitening(self.covariance.flatten(0, 2), sigma**2) / sigma).unflatten(0, self.pixels.shape[:3])

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
        return BoardBlock(self, mask, given)

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
        squares, further = torch.where(mask, 0.0, torch.nan).double(), torch.zeros(mask.shape, dtype=torch.int64)
        weights, state = self.whitening(given.sigma_corner), given.state
        turn, shift = board_pose(state.items)
        board = self.points
        if len(state.board):
            board = board + torch.einsum("b,bkn->nk", state.board, given.unknowns.shapes)
        parameters = state.parameters.split([camera.params.shape[-1] for camera in given.cameras])
        for c, camera in enumerate(given.cameras):
            some = mask & (self.marked[:, c].sum(-1) >= _CORNERS)
            if bool(some.any()):
                views = Views(board_points=board, pixels=self.pixels[some, c], whitening=weights[some, c])
                pose = state.rotation[c] @ turn[some], (shift[some] - state.center[c]) @ state.rotation[c].T
                cost = refine_poses(views, camera.model, BoardState.flat(parameters[c], *pose), _POSES)[1]
                squares[some] += 2.0 * cost
                further[some] += LOCAL_SIZE
        return squares, (further - LOCAL_SIZE).clamp_min(0)

    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """See `ItemSource.doubt`."""
        why = "it moved between the views, or a lens differs from its model"
        # With many corners, a few sigmas on average are already significant. A board within that limit was left out
        # because the others fit significantly better without it.
        if over > 1.0:
            most = f"{sigmas:.2f} sigma on average, where so many corners allow {sigmas / math.sqrt(over):.2f}"
            return f"it does not fit the other boards: off by {off} ({most}): {why}"
        return (
            f"it does not fit the other boards: its own residuals are small ({off}; {sigmas:.2f} sigma on average), "
            f"but the others fit significantly better without it: {why}"
        )

    def places(self, items: Tensor, anchor: Tensor) -> Tensor:
        """See `ItemSource.places`; of the middle of each board."""
        rotation, translation = board_pose(items)
        return rotation @ self.points.mean(0) + translation


def board_pose(items: Tensor) -> Pose:
    """world_from_board (V) of items (V, 12)."""
    return Pose(items[:, :9].unflatten(1, (3, 3)), items[:, 9:12])


class BoardBlock(Block):
    """Boards, of which each has a pose of its own, as `board_pose` has it; all have the same shape.

    What a camera sees of them is its `BoardProblem`, whose poses cam_from_board follow from those of the board and of
    the camera in the world.
    """

    size = 6
    many: ClassVar[bool] = True

    def __init__(self, source: Boards, mask: Tensor, given: Context) -> None:
        pixels, points, unknowns = source.pixels[mask], source.points, given.unknowns
        super().__init__(source.kind, pixels)
        self._unknowns, flat = unknowns, points.new_zeros(0, *points.T.shape)
        weights = source.whitening(given.sigma_corner)[mask]
        # What each camera sees, and what takes motions out of its rows; nothing for cameras that see no board.
        self._seen_by: dict[int, tuple[BoardProblem, WithoutMotion | None]] = {}
        for c, camera in enumerate(given.cameras):
            if self._used[c]:
                problem = BoardProblem(
                    points,
                    pixels[:, c],
                    camera.model,
                    unknowns.cameras[c].any(1).nonzero()[:, 0].tolist(),
                    shapes=unknowns.shapes if len(unknowns.shapes) else flat,
                    free_board=bool(unknowns.board.any()),
                    weights=weights[:, c],
                )
                own = given.motion[c] if given.motion else None
                self._seen_by[c] = problem, own and WithoutMotion(problem.weighted(own.columns[mask]))

    def _each(
        self, cameras: Sequence[PosedCamera], state: RigState
    ) -> Iterator[tuple[int, PosedCamera, BoardProblem, BoardState, Callable[[Tensor], Tensor]]]:
        """For each camera that sees boards what it sees of them, where, and what takes motions out of its rows."""
        for c, (problem, off) in self._seen_by.items():
            yield c, cameras[c], problem, self._placed(cameras[c], state), off or (lambda rows: rows)

    def _placed(self, posed: PosedCamera, state: RigState) -> BoardState:
        """The boards in the frame of a camera."""
        turn, shift = board_pose(state.items)
        board = state.board[: len(self._unknowns.shapes)]
        place = (shift - posed.center) @ posed.rotation.T
        return BoardState.still(posed.parameters, board, posed.rotation @ turn, place)

    def errors(self, cameras: Sequence[PosedCamera], state: RigState) -> Tensor:
        """See `Block.errors`."""
        found = state.items.new_zeros(*self.seen.shape[:2], 2, self.seen.shape[2])
        for c, _, problem, placed, _ in self._each(cameras, state):
            found[:, c] = problem.pixel_errors(placed)
        return found

    def residuals(self, cameras: Sequence[PosedCamera], state: RigState) -> Tensor:
        """See `Block.residuals`."""
        each = self._each(cameras, state)
        return torch.cat([off(problem.residuals(at)[:, None])[:, 0] for _, _, problem, at, off in each], -1)

    def camera_rows(self, cameras: Sequence[PosedCamera], state: RigState) -> Iterator[CameraRows]:
        """See `Block.camera_rows`; a step of the camera moves the boards in its frame."""
        for c, posed, problem, placed, off in self._each(cameras, state):
            rows = off(problem.corner_rows(placed))
            by_turn, by_shift = rows[:, :3], rows[:, 3:6]
            # About the axes of the world.
            own = (posed.rotation.T @ rows[:, :6].unflatten(1, (2, 3))).flatten(1, 2)
            bends = self._unknowns.board[: problem.unknown_count - len(problem.free)]
            onto = torch.cat([posed.by_unknown[list(problem.free)], bends])
            columns = onto.any(0).nonzero()[:, 0]
            parts = [own, onto[:, columns].T @ rows[:, 6:-1]]
            if posed.turn is not None:
                # By ω × t, too.
                far = placed.translation[..., None].expand_as(by_shift)
                parts.append(by_turn + torch.linalg.cross(far, by_shift, dim=1))
            if posed.shift is not None:
                parts.append(-own[:, 3:])
            slots = [torch.arange(slot.start, slot.stop) for slot in (posed.turn, posed.shift) if slot is not None]
            yield CameraRows(c, torch.cat([columns, *slots]), torch.cat([*parts, rows[:, -1:]], 1))

    def motion_columns(self, c: int, posed: PosedCamera, state: RigState, *, reads: bool) -> tuple[Tensor, float]:
        """(V, M, 2, N) derivatives of a camera's pixels by motions, and how far a board reaches, in distances of it.

        Each row is read at the time of the pixel where the state shows it: at that of the observed one, motions would
        take up the noise of corners.

        Args:
            c: number of the camera.
            posed: the camera.
            state: where.
            reads: whether boards may move while its rows are read, too.
        """
        problem, placed = self._seen_by[c][0], self._placed(posed, state)
        points = problem.board_points.T + torch.einsum("b,bkn->kn", placed.board, problem.shapes)
        distance = float(placed.translation.norm(dim=-1).median())
        readout = Readout(center=points.mean(-1), distance=distance, size=posed.camera.size)
        q = placed.rotation @ points + placed.translation[..., None]
        found = project_components(q, posed.parameters, posed.camera.model, [])
        time = readout.time(found.pixels.mT)
        columns = readout.columns_of(found.by_point, placed.rotation, time, points, apart=True).nan_to_num(0.0)
        return columns if reads else columns[:, MOTION:], readout.reach(points.T)

    def weighted(self, camera: int, columns: Tensor) -> Tensor:
        """See `Block.weighted`."""
        return self._seen_by[camera][0].weighted(columns)

    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """See `Block.moved`."""
        return as_items(*apply_twist(*board_pose(items), step))


# All that a rig is solved from: the list of its sources, and what was measured besides what cameras see.

# What was measured of a rig's cameras besides what they see: distances between them and places of their centers.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Baseline(Measurement):
    """A measured distance between the centers of two cameras, meters."""

    __repr__ = brief

    kind = "baselines"
    count = 1

    first: int
    second: int
    length: float
    sigma: float

    def __post_init__(self) -> None:
        require_positive("baseline", self.length)
        require_positive("baseline: sigma", self.sigma)
        if self.first == self.second:
            raise InputError("baseline: two different cameras are needed")

    @property
    def about(self) -> tuple[int, ...]:
        """See `Measurement.about`."""
        return self.first, self.second

    def rows_at(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `Measurement.rows_at`."""
        apart = cameras[self.second].center - cameras[self.first].center
        length = torch.linalg.vector_norm(apart)
        out = apart.new_zeros((shared_size + 1, 1))
        for sign, number in zip((-1.0, 1.0), self.about, strict=True):
            shift = cameras[number].shift
            if shift is not None:
                out[shift, 0] = sign * apart / (length * self.sigma)
        out[-1, 0] = (length - self.length) / self.sigma
        return out

    def label(self, names: Sequence[str]) -> str:
        """See `Measurement.label`."""
        return f"the baseline {names[self.first]} to {names[self.second]}"

    def against(self, off: Tensor, sigma: Tensor) -> str:
        """See `Measurement.against`."""
        found, spread = self.length + self.sigma * float(off[0]), self.sigma * float(sigma[0])
        # Without it even lenses may tell a distance, by how entrance pupils move, and any if they are wrong.
        apart = f"the cameras are {found:.6g} ± {spread:.2g} m apart" if found > 0 else "no distance suits the rest"
        return f"{self.length:.6g} ± {self.sigma:.2g} m was stated, and without it {apart}"

    def told(self, center: Tensor, names: Sequence[str]) -> list[ItemResidual]:
        """See `Measurement.told`."""
        error = float(torch.linalg.vector_norm(center[self.first] - center[self.second])) - self.length
        name = f"{names[self.first]} to {names[self.second]}"
        return [ItemResidual(source=self.kind, name=name, meters=error, sigmas=abs(error) / self.sigma)]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredPosition(Measurement):
    """A camera's projection center, measured (by GNSS, say): (3,) meters in the local frame and its (3,) sigmas."""

    __repr__ = brief

    kind = "positions"
    absolute = True
    count = 3

    camera: int
    point: Tensor
    sigma: Tensor

    def __post_init__(self) -> None:
        if self.point.shape != (3,) or self.sigma.shape != (3,) or not bool(torch.isfinite(self.point).all()):
            raise InputError("position: three meters and three sigmas are needed")
        if not bool((torch.isfinite(self.sigma) & (self.sigma > 0)).all()):
            raise InputError("position: every sigma must be a positive number of meters")

    @property
    def about(self) -> tuple[int, ...]:
        """See `Measurement.about`."""
        return (self.camera,)

    def rows_at(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `Measurement.rows_at`."""
        posed = cameras[self.camera]
        out = self.point.new_zeros((shared_size + 1, 3))
        if posed.shift is not None:
            out[posed.shift] = torch.diag(1.0 / self.sigma)
        out[-1] = (posed.center - self.point) / self.sigma
        return out

    def label(self, names: Sequence[str]) -> str:
        """See `Measurement.label`."""
        return f"the position of {names[self.camera]}"

    def against(self, off: Tensor, sigma: Tensor) -> str:
        """See `Measurement.against`."""
        away, spread = off * self.sigma, float((sigma * self.sigma).norm())
        east, north, up = away.tolist()
        return (
            f"without it the camera stands {float(away.norm()):.3g} ± {spread:.2g} m from where it was measured "
            f"({east:+.3g} m east, {north:+.3g} m north, {up:+.3g} m up)"
        )

    def told(self, center: Tensor, names: Sequence[str]) -> list[ItemResidual]:
        """See `Measurement.told`."""
        off = center[self.camera] - self.point
        sigmas = math.sqrt(float((off / self.sigma).square().mean()))
        meters = float(torch.linalg.vector_norm(off))
        return [ItemResidual(source=self.kind, name=names[self.camera], meters=meters, sigmas=sigmas)]


# All that a rig is solved from: the list of its sources.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RigData:
    """The data that a rig is solved from; any of them may be missing.

    All of it is in one local frame in meters: east, north, up of an origin where anything is known on the Earth
    (`kcal.locate.survey` reads latitudes and longitudes), the first camera's frame where nothing is. The solver goes
    through `sources`; a new one needs a field here and nothing else.

    Args:
        cameras: calibrated, two or more, or one with landmarks; unlike sizes and models are welcome. One camera that
            was moved from place to place is given once for each place (`lenses`).
        names: of the cameras.
        boards: see `Boards`.
        landmarks: see `Landmarks`.
        features: see `Features`.
        stars: see `StarSource`.
        skyline: see `SkylineSource`.
        baselines: see `Baseline`.
        positions: see `MeasuredPosition`.

    Raises:
        InputError: names or shapes that do not fit each other, one camera without landmarks or skyline.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080))
        >>> RigData(cameras=(camera, camera), names=("left", "right")).absolute
        False
    """

    __repr__ = brief

    cameras: tuple[Camera, ...]
    names: tuple[str, ...]
    boards: Boards | None = None
    landmarks: Landmarks | None = None
    features: Features | None = None
    stars: StarSource | None = None
    skyline: SkylineSource | None = None
    baselines: tuple[Baseline, ...] = ()
    positions: tuple[MeasuredPosition, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.cameras)
        if not count or (count == 1 and self.landmarks is None and self.skyline is None):
            raise InputError("a rig has two cameras or more; one camera alone needs landmarks, or a skyline")
        check_names("cameras", self.names, count)
        if not all(isinstance(camera, Camera) and camera.params.ndim == 1 for camera in self.cameras):
            raise InputError("a rig is made of single cameras")
        for source in self.sources:
            source.check(count, absolute=self.absolute)

    @property
    def lenses(self) -> tuple[int, ...]:
        """For each camera, the number of the first one that has the same lens.

        Cameras have the same lens if they are one `Camera` with a calibration, or if their parameters are equal and
        come from a calibration, as its record says. Two cameras of one type have equal nominal parameters, and two
        lenses. A lens is one block of unknowns: its data count once, and its errors are the same at all places.
        """
        first = dict[object, int]()
        return tuple(first.setdefault(_lens_of(camera), c) for c, camera in enumerate(self.cameras))

    @property
    def sources(self) -> tuple[Source, ...]:
        """All that there are, in the order of their fields."""
        values = (getattr(self, field.name) for field in dataclasses.fields(self)[2:])
        each = (value if isinstance(value, tuple) else (value,) for value in values)
        return tuple(source for some in each for source in some if source is not None)

    @property
    def seen(self) -> tuple[ItemSource, ...]:
        """Those whose items have unknowns of their own."""
        return tuple(source for source in self.sources if isinstance(source, ItemSource))

    @property
    def measured(self) -> tuple[Measurement, ...]:
        """Those about the cameras alone."""
        return tuple(source for source in self.sources if isinstance(source, Measurement))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of what shifts many items of a source together."""
        return tuple(effect.name for source in self.seen for effect in source.effects)

    @property
    def absolute(self) -> bool:
        """Whether anything places the rig in the local frame; otherwise that is the first camera's."""
        return any(source.absolute for source in self.sources)


def _lens_of(camera: Camera) -> object:
    if (known := camera.calibration) is None:
        return object()
    return camera if known.record is None else camera.fingerprint
