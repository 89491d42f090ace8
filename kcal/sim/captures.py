"""Simulated captures of boards: poses, observations, and rigs with their truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose, check_motion, rotation_from_vector
from kcal.sim.raytrace import Misalignment, Prescription
from kcal.sim.truth import TruthLens

# What projects: a camera of kcal, or a true lens.
LensLike = Camera | TruthLens

# Choose poses of a board that are completely visible, tilted in all directions, and spread over image and depth.
#
# Poses are drawn at random, those that are not completely visible are dropped, and of the rest the ones farthest from
# each other are chosen (T. Gonzalez, "Clustering to minimize the maximum intercluster distance", 1985). Extreme poses
# come first, as a calibration needs them, and the number of draws is fixed.

_POSE_DRAWS = 4096


@dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """How boards are held.

    Args:
        max_tilt: largest angle between the board's normal and the line of sight, radians.
        max_roll: largest turn of the board about its normal, radians.
        border: squares around the inner corners that must be in the image too; 1 keeps all squares whole.
        margin: pixels between them and the image's edge.

    Raises:
        InputError: a value out of range.
    """

    max_tilt: float = math.radians(45.0)
    max_roll: float = math.radians(25.0)
    border: int = 1
    margin: float = 4.0

    def __post_init__(self) -> None:
        if not 0 <= self.max_tilt <= math.radians(80.0):
            raise InputError("pose option max_tilt: radians from 0 to 80 degrees are needed")
        if not 0 <= self.max_roll <= math.pi:
            raise InputError("pose option max_roll: radians from 0 to pi are needed")
        if not isinstance(self.border, int) or self.border < 0 or not 0 <= self.margin < math.inf:
            raise InputError("pose options border and margin: a whole number of squares and pixels, not negative")


def sample_board_poses(
    camera: LensLike,
    board: BoardLike,
    count: int,
    generator: torch.Generator,
    *,
    fill: tuple[float, float] = (0.4, 0.9),
    options: PoseOptions | None = None,
) -> list[Pose]:
    """Choose poses to calibrate one camera: over the whole image, at several distances, tilted in all directions.

    Args:
        camera: a single camera, or a true lens.
        board: its size.
        count: how many poses.
        generator: source of the draws; the same state gives the same poses.
        fill: smallest and largest share of the image's width or height that the board takes when it is not tilted.
        options: limits of tilt, roll and margins.

    Returns:
        cam_from_board poses; the first lies near the middle of all.

    Raises:
        InputError: fewer than `count` of 4096 drawn boards are completely seen, or an argument out of range.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> from kcal.sim.captures import BoardSize, project_board
        >>> board = BoardSize(9, 6, 0.025)
        >>> poses = sample_board_poses(camera, board, 12, torch.Generator().manual_seed(1))
        >>> all(bool(project_board(camera, pose, board)[1].all()) for pose in poses)
        True
    """
    options = options or PoseOptions()
    check_draws(count, "fill", fill)
    width, height = camera.size
    extent = ((board.columns + 1) * board.square, (board.rows + 1) * board.square)
    focal = camera.focal.detach()
    unit = max(float(focal[0]) * extent[0] / width, float(focal[1]) * extent[1] / height)
    drawn = draw_poses(camera, board, (unit / fill[1], unit / fill[0]), None, generator, options)
    return choose_poses(drawn, [(camera, *Pose.still())], board, count, options)


def check_draws(count: int, name: str, limits: tuple[float, float]) -> None:
    """Raise `InputError` for a number of poses, or limits called `name`, that cannot be."""
    if not isinstance(count, int) or not 1 <= count <= _POSE_DRAWS:
        raise InputError(f"count: a whole number from 1 to {_POSE_DRAWS} is needed, got {count!r}")
    if not 0 < limits[0] <= limits[1] < math.inf:
        raise InputError(f"{name} {limits}: two positive numbers are needed, the smaller first")


class DrawnPoses(NamedTuple):
    """Random poses, and where they lie in the space in which they are to be spread out (draws, 3)."""

    rotation: Tensor
    translation: Tensor
    features: Tensor


def draw_poses(
    camera: LensLike,
    board: BoardLike,
    distance: tuple[float, float],
    eye: Tensor | None,
    generator: torch.Generator,
    options: PoseOptions,
) -> DrawnPoses:
    """Draw poses over the image, at distances of the board's center, tilted against the line from `eye` (3,)."""
    random = torch.rand((_POSE_DRAWS, 6), dtype=torch.float64, generator=generator)
    with torch.no_grad():
        aim = random[:, :2] * torch.tensor(camera.size, dtype=torch.float64) - 0.5
        # A pixel without a ray gives the optical axis: one more board in the middle.
        rays, _ = camera.unproject(aim)
    near, far = distance
    depth = near * (far / near) ** random[:, 2]
    center = rays * depth[:, None]
    sight = center - eye if eye is not None else center
    # Between a quarter of the largest tilt and all of it: untilted boards do not determine the focal length.
    tilt, towards = options.max_tilt * (0.25 + 0.75 * random[:, 3]), 2 * math.pi * random[:, 4]
    roll = options.max_roll * (2 * random[:, 5] - 1)
    zero = torch.zeros_like(tilt)
    axis = torch.stack([torch.cos(towards), torch.sin(towards), zero], -1)
    rotation = _turn_to(sight) @ rotation_from_vector(tilt[:, None] * axis)
    rotation = rotation @ rotation_from_vector(torch.stack([zero, zero, roll], -1))
    points = board_points(board)
    middle = 0.5 * (points[0] + points[-1])
    translation = center - rotation @ middle
    share = tilt / max(options.max_tilt, 1e-9)
    features = 0.4 * torch.stack([share * torch.cos(towards), share * torch.sin(towards), random[:, 2]], -1)
    return DrawnPoses(rotation, translation, features)


def choose_poses(
    drawn: DrawnPoses,
    cameras: list[tuple[LensLike, Tensor, Tensor]],
    board: BoardLike,
    count: int,
    options: PoseOptions,
) -> list[Pose]:
    """Choose drawn poses, far from each other, that all cameras (lens, rotation, translation) see completely."""
    points = board_points(board, options.border)
    columns = board.columns + 2 * options.border
    # Most draws end here: the outermost four points are a few percent of the work.
    seen, _ = _see(drawn, torch.arange(_POSE_DRAWS), cameras, points[[0, columns - 1, -columns, -1]], options)
    index = seen.nonzero()[:, 0]
    whole, places = _see(drawn, index, cameras, points, options)
    index, places = index[whole], places[whole]
    found = len(index)
    if found < count:
        raise InputError(
            f"only {found} of {_POSE_DRAWS} drawn boards are completely seen and {count} are needed; "
            "use a smaller board, another distance, less tilt or a smaller margin"
        )
    rotation, translation = drawn.rotation[index], drawn.translation[index]
    chosen = [int(torch.linalg.vector_norm(places - places.mean(0), dim=-1).argmin())]
    apart = torch.full((found,), math.inf, dtype=torch.float64)
    while len(chosen) < count:
        apart = torch.minimum(apart, torch.linalg.vector_norm(places - places[chosen[-1]], dim=-1))
        chosen.append(int(apart.argmax()))
    return [Pose(rotation[i].clone(), translation[i].clone()) for i in chosen]


def _see(
    drawn: DrawnPoses,
    index: Tensor,
    cameras: list[tuple[LensLike, Tensor, Tensor]],
    points: Tensor,
    options: PoseOptions,
) -> tuple[Tensor, Tensor]:
    """Which draws show all points to all cameras (D,), and where the draws lie among the others (D, F)."""
    points_rig = points @ drawn.rotation[index].transpose(-1, -2) + drawn.translation[index][:, None]
    seen = torch.ones(len(index), dtype=torch.bool)
    features = [drawn.features[index]]
    for camera, rotation, translation in cameras:
        with torch.no_grad():
            pixels, valid = camera.project(points_rig @ rotation.T + translation)
        size = torch.tensor(camera.size, dtype=torch.float64)
        inside = (pixels >= options.margin) & (pixels <= size - 1 - options.margin)
        seen &= (valid & inside.all(-1)).all(-1)
        # The right camera adds nothing to the left one but the parallax.
        features.append(pixels.mean(1) / size / len(cameras))
    return seen, torch.cat(features, -1)


def _turn_to(sight: Tensor) -> Tensor:
    """The smallest rotations that turn the z axis to directions (N, 3), which must not point straight back."""
    direction = sight / torch.linalg.vector_norm(sight, dim=-1, keepdim=True)
    x, y, z = direction.unbind(-1)
    sine = torch.hypot(x, y)
    safe = sine.clamp_min(1e-12)
    angle = torch.atan2(sine, z) / safe
    return rotation_from_vector(torch.stack([-y * angle, x * angle, torch.zeros_like(x)], -1))


# Misalignment of the sensor at a strength of 1: its tilt, and the axis's distance from its middle in pixels.
_SENSOR_TILT, _AXIS = math.radians(0.2), 8.0


def drawn_lens(
    prescription: Prescription,
    strength: float,
    seed: int,
    *,
    focal_mm: float = 2.8,
    wander: float = 0.1,
    scale: float = 1.0,
) -> TruthLens:
    """Draw a ray-traced lens with errors of assembly: a strength of 1 is ordinary, 3 poor, 0 perfect.

    A strength of 1 means one sigma along each axis: glass is decentered by the prescription's tolerance (22 µm of
    2.8 mm for the surveillance lens, with 0.2 degrees of tilt), the sensor is tilted by 0.2 degrees, and the axis meets
    it 8 px from its middle.

    Args:
        prescription: of the lens.
        strength: of the misalignment.
        seed: of its draw.
        focal_mm: see `TruthLens`.
        wander: see `TruthLens`.
        scale: of the image of 1920 x 1080 px, with the same lens and field of view; smaller for quick tests.

    Example:
        >>> from kcal.sim.raytrace import SURVEILLANCE
        >>> lens = drawn_lens(SURVEILLANCE, 1.0, 7)
        >>> lens.size, round(float(lens.focal[0]))
        ((1920, 1080), 1600)
    """
    generator = torch.Generator().manual_seed(seed)
    misalignment = Misalignment.draw(prescription, strength, generator)
    tilt, shift = (strength * torch.randn((2, 2), dtype=torch.float64, generator=generator)).tolist()
    size = round(1920 * scale), round(1080 * scale)
    return TruthLens(
        prescription,
        focal=scale * prescription.focal,
        size=size,
        focal_mm=focal_mm,
        center=(0.5 * (size[0] - 1) + scale * _AXIS * shift[0], 0.5 * (size[1] - 1) + scale * _AXIS * shift[1]),
        misalignment=misalignment,
        sensor_tilt=(_SENSOR_TILT * tilt[0], _SENSOR_TILT * tilt[1]),
        wander=wander,
    )


# Two ray-traced cameras, rigidly joined.


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueRig:
    """Two ray-traced cameras; the convention is `Rig`'s.

    Args:
        left: the first camera, whose frame is the rig's.
        right: the second camera.
        right_from_left_rotation: (3, 3).
        right_from_left_translation: (3,) meters.
    """

    left: TruthLens
    right: TruthLens
    right_from_left_rotation: Tensor
    right_from_left_translation: Tensor

    @property
    def baseline(self) -> Tensor:
        """Distance between the cameras' origins, meters."""
        return torch.linalg.vector_norm(self.right_from_left_translation)

    def right_from_left(self, points_left: Tensor) -> Tensor:
        """Move points (..., N, 3) from the left camera's frame into the right camera's."""
        return points_left @ self.right_from_left_rotation.T + self.right_from_left_translation

    def __call__(self, points_left: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (..., N, 3) of the left frame: pixels (..., N, 2, 2), and which are valid (..., N, 2)."""
        left, right = self.left.project(points_left), self.right.project(self.right_from_left(points_left))
        return torch.stack([left[0], right[0]], -2), torch.stack([left[1], right[1]], -1)


def drawn_rig(
    lens: Prescription, strength: float, seed: int, *, focal_mm: float = 2.8, wander: float = 0.1, scale: float = 1.0
) -> TrueRig:
    """Draw two cameras 10 m apart whose lenses have one design and separate errors of assembly.

    The right camera is toed in by 0.34 degrees, and turned by 0.17 degrees in pitch and 0.46 in roll.

    Args:
        lens: prescription of both.
        strength: of the misalignment, see `drawn_lens`.
        seed: of both draws.
        focal_mm: see `TruthLens`.
        wander: see `TruthLens`.
        scale: of the image, see `drawn_lens`.

    Example:
        >>> from kcal.sim.raytrace import SURVEILLANCE
        >>> rig = drawn_rig(SURVEILLANCE, 1.0, 3)
        >>> round(float(rig.baseline), 3), rig.left.size
        (10.0, (1920, 1080))
    """
    rotation = rotation_from_vector(torch.tensor([0.003, 0.006, -0.008], dtype=torch.float64))
    center = torch.tensor([10.0, 0.04, -0.06], dtype=torch.float64)
    left, right = (
        drawn_lens(lens, strength, 2 * seed + side, focal_mm=focal_mm, wander=wander, scale=scale) for side in (0, 1)
    )
    return TrueRig(
        left=left, right=right, right_from_left_rotation=rotation, right_from_left_translation=-rotation @ center
    )


# The simulator's checkerboard: size, errors of its print, pose, true corners, and colors averaged over small areas.


class BoardLike(Protocol):
    """Anything with a number of inner corners and a square size in meters."""

    @property
    def columns(self) -> int:
        """Inner corners in a row."""

    @property
    def rows(self) -> int:
        """Inner corners in a column."""

    @property
    def square(self) -> float:
        """Side of a square in meters."""


class BoardSize(NamedTuple):
    """A checkerboard with `columns` x `rows` inner corners and squares of `square` meters."""

    columns: int
    rows: int
    square: float


@dataclass(frozen=True)
class PrintedBoard:
    """A checkerboard whose print and paper have errors; its poses and sizes are those of the ordered board.

    It is stretched by 0.15 % along x, sheared by 0.02 %, bent by 0.7 mm about an oblique axis, and off by smooth errors
    of 0.03 mm.

    Args:
        columns: inner corners in a row.
        rows: inner corners in a column.
        square: side of a square in meters.
        seed: of the axis of the bend and of the smooth errors.

    Example:
        >>> board = PrintedBoard(9, 6, 0.06, seed=1)
        >>> points = board_points(board)
        >>> [round(1e3 * float(value), 1) for value in board.errors(points).abs().amax(0)]  # millimeters
        [0.4, 0.1, 0.7]
    """

    columns: int
    rows: int
    square: float
    seed: int

    def errors(self, points: Tensor) -> Tensor:
        """Return how far points (..., 3) of the board are from where they should be, meters."""
        generator = torch.Generator().manual_seed(5000 + self.seed)
        half = 0.5 * self.square * torch.tensor([self.columns - 1, self.rows - 1], dtype=torch.float64)
        off = points[..., :2] - half
        a, b = (off / half).unbind(-1)
        angle, phase = (math.pi * torch.rand(2, generator=generator, dtype=torch.float64)).tolist()
        across = a * math.cos(angle) + b * math.sin(angle)
        waves = 3e-5 * torch.randn(3, 2, generator=generator, dtype=torch.float64)
        shapes = torch.stack([torch.sin(2 * a + phase), torch.sin(2 * b + phase), torch.cos(2 * (a + b))], -1)
        x, y = (shapes @ waves / math.sqrt(1.5)).unbind(-1)
        return torch.stack([x + 1.5e-3 * off[..., 0] + 2e-4 * off[..., 1], y, 0.7e-3 * (1.0 - across**2)], -1)


def check_board(board: BoardLike) -> None:
    """Raise `InputError` unless the board has at least 2 x 2 inner corners and squares of a positive size."""
    if board.columns < 2 or board.rows < 2 or not (board.square > 0 and math.isfinite(board.square)):
        raise InputError(
            f"board {board.columns}x{board.rows}, squares of {board.square} m: at least 2x2 inner corners and a "
            "positive size are needed"
        )


def check_pose(cam_from_board: tuple[Tensor, Tensor]) -> Pose:
    """Return the pose as float64.

    Raises:
        InputError: wrong shapes, values that are not finite, or a matrix that is no rotation.
    """
    rotation = as_points("cam_from_board rotation", cam_from_board[0], 3)
    translation = as_points("cam_from_board translation", cam_from_board[1], 3)
    check_motion("cam_from_board", rotation, translation)
    return Pose(rotation, translation)


def board_points(board: BoardLike, border: int = 0) -> Tensor:
    """Return the corners on the board, row by row: (columns * rows, 3) float64 meters, corner 0 at the origin.

    `border` adds that many squares on every side; 1 reaches the outer edge of the outer squares.

    Example:
        >>> board_points(BoardSize(3, 2, 0.5))[:, :2].tolist()
        [[0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [0.0, 0.5], [0.5, 0.5], [1.0, 0.5]]
        >>> board_points(BoardSize(3, 2, 0.5), border=1).shape
        torch.Size([20, 3])
    """
    check_board(board)
    y, x = (torch.arange(-border, count + border, dtype=torch.float64) for count in (board.rows, board.columns))
    return torch.nn.functional.pad(torch.cartesian_prod(y, x).flip(-1), (0, 1)) * board.square


def true_corners(board: BoardLike) -> Tensor:
    """Return where the inner corners truly are, in the order of `board_points`: (N, 3) meters."""
    points = board_points(board)
    return points + board.errors(points) if isinstance(board, PrintedBoard) else points


def project_board(camera: LensLike, cam_from_board: tuple[Tensor, Tensor], board: BoardLike) -> tuple[Tensor, Tensor]:
    """Project the inner corners to their true pixels.

    Args:
        camera: a single camera, or a true lens.
        cam_from_board: rotation (3, 3) and translation (3,).
        board: its size.

    Returns:
        pixels (N, 2) in the order of `board_points`, and visible (N,): projected validly and inside the image.

    Raises:
        InputError: a board or pose that cannot be.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> pose = Pose(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
        >>> pixels, visible = project_board(camera, pose, BoardSize(9, 6, 0.05))
        >>> pixels[1].tolist(), bool(visible.all())
        ([339.5, 239.5], True)
    """
    rotation, translation = check_pose(cam_from_board)
    pixels, valid = camera.project(true_corners(board) @ rotation.T + translation)
    return pixels, valid & camera.inside(pixels)


class Colors(NamedTuple):
    """Shares (0 to 1) of a small area that are paper (board and its white margin), and that are black squares."""

    paper: Tensor
    black: Tensor


def area_colors(a: Tensor, b: Tensor, width_a: Tensor, width_b: Tensor, board: BoardLike, margin: int) -> Colors:
    """Average the pattern over boxes around board positions, by exact integrals, so that edges do not move.

    The black share of a checkerboard is (1 + q(a) q(b)) / 2 with a square wave q along each axis. Box averages of
    both factors come from their antiderivatives (the triangle wave for q), as in I. Quilez, "Box-filtered procedural
    textures".

    Args:
        a: board x in squares from corner 0, any shape.
        b: board y likewise.
        width_a: width of each box along x in squares, positive.
        width_b: width along y.
        board: its size.
        margin: width of the white margin in squares.

    Example:
        >>> a = torch.tensor([-0.5, 0.5, 0.0], dtype=torch.float64)
        >>> narrow = torch.full_like(a, 0.1)
        >>> area_colors(a, a[:1], narrow, narrow[:1], BoardSize(9, 6, 0.05), 1).black.round(decimals=9).abs().tolist()
        [1.0, 0.0, 0.5]
    """

    def averages(t: Tensor, width: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        low, high = t - 0.5 * width, t + 0.5 * width
        paper = high.clamp(-1 - margin, count + margin) - low.clamp(-1 - margin, count + margin)
        low, high = low.clamp(-1, count), high.clamp(-1, count)
        # |t mod 2 - 1| falls with slope 1 on (0, 1), so that q = +1 there and -1 on (-1, 0).
        wave = (low.remainder(2) - 1).abs() - (high.remainder(2) - 1).abs()
        return paper / width, (high - low) / width, wave / width

    paper_a, squares_a, wave_a = averages(a, width_a, board.columns)
    paper_b, squares_b, wave_b = averages(b, width_b, board.rows)
    return Colors(paper_a * paper_b, 0.5 * (squares_a * squares_b + wave_a * wave_b))
