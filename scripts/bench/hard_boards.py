"""Render boards that are hard to find, with known corners: blurred, moving, overexposed, cut by the image's edge, ...

Each kind changes one thing of a plain picture, of a 9x6 board if no other scene is given. `NOT_THE_BOARD` are pictures
without a 9x6 board (other boards, stripes), in which anything found is a false grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal import Board, Camera
from kcal.corners.print_board import pattern_shapes
from kcal.lens.pose import Pose
from kcal.sim.captures import BoardSize, PoseOptions, sample_board_poses
from kcal.sim.scene import RenderOptions, render_light
from scripts.shared.printed_board import Paper, light_of, points_of, through_lens

SIZE = 640, 480
Light = NDArray[Any]


class Shown(NamedTuple):
    """Gray levels before the sensor, and the true corners (N, 2) in the board's order."""

    light: Light
    truth: Tensor


def camera(size: tuple[int, int] = SIZE, focal: float = 0.9) -> Camera:
    """A camera with barrel distortion; the focal length is a share of the width."""
    width, height = size
    f = focal * width
    return Camera.build(
        focal=(f, f), center=((width - 1) / 2 + 1.3, (height - 1) / 2 - 0.7), size=size,
        coefficients=[-0.2, 0.06, 0.0005, -0.0003],
    )  # fmt: skip


class Scene:
    """A plain checkerboard.

    Attributes:
        fine: the share of a square in which a picture must stay sharp.
        small: the share of the image that the board takes where it is small.
    """

    fine = 1.0
    small = 0.165, 0.185

    def __init__(self, board: Board, size: tuple[int, int] = SIZE) -> None:
        self.board, self.lens = board, camera(size)
        self.extent = BoardSize(board.columns, board.rows, board.square)

    def pose(self, generator: torch.Generator, fill: tuple[float, float] = (0.45, 0.85), tilt: float = 40.0) -> Pose:
        """Draw a pose of the whole board."""
        options = PoseOptions(max_tilt=math.radians(tilt))
        return sample_board_poses(self.lens, self.extent, 1, generator, fill=fill, options=options)[0]

    def places(self, pose: Pose) -> Tensor:
        """The true corners, inside the image and outside."""
        return points_of(self.board, self.lens, *pose)

    def light(self, pose: Pose, **look: float) -> Light:
        """Gray levels before the sensor; `look` changes `RenderOptions`."""
        return render_light(self.lens, pose, self.extent, _look(look)).numpy()

    def draw(
        self, generator: torch.Generator, fill: tuple[float, float] = (0.45, 0.85), tilt: float = 40.0, **look: float
    ) -> Shown:
        """The board in a pose that is drawn."""
        pose = self.pose(generator, fill, tilt)
        return Shown(self.light(pose, **look), self.places(pose))

    def side(self, truth: Tensor) -> float:
        """The smallest square or tag, px."""
        grid = truth.reshape(self.board.rows, self.board.columns, 2)
        step = 2 if self.board.pattern == "aprilgrid" else 1  # between them are the gaps
        sides = (grid.diff(dim=0)[::step], grid.diff(dim=1)[:, ::step])
        return float(min(torch.linalg.vector_norm(side, dim=-1).min() for side in sides))

    def sharp(self, truth: Tensor) -> float:
        """The length that blur is measured in, px."""
        return self.fine * self.side(truth)


class Marked(Scene):
    """A ChArUco board or an AprilGrid. Its markers are read if their cells are sharp: 0.09 to 0.12 of a square."""

    fine = 0.4
    small = 0.27, 0.33

    def __init__(self, board: Board, size: tuple[int, int] = SIZE) -> None:
        super().__init__(board, size)
        self.paper, shapes = Paper(board), pattern_shapes(board)
        # The checkerboard of the same size, and where the pattern's origin lies on it.
        self.extent = self.extent._replace(square=0.001 * shapes.width / (board.columns + 1))
        x, y = (0.001 * place - self.extent.square for place in shapes.origin)
        self._origin = torch.tensor([x, y, 0.0], dtype=torch.float64)

    def pose(self, generator: torch.Generator, fill: tuple[float, float] = (0.45, 0.85), tilt: float = 40.0) -> Pose:
        """Draw a pose of the whole board."""
        rotation, translation = super().pose(generator, fill, tilt)
        return Pose(rotation, translation + rotation @ self._origin)

    def light(self, pose: Pose, **look: float) -> Light:
        """Gray levels before the sensor; `look` changes `RenderOptions`."""
        options = _look(look)
        black, white, wall = (
            (level / 255) ** options.gamma for level in (options.black, options.white, options.background)
        )
        fine = light_of([(self.paper, *pose)], self.lens, wall=(wall - black) / (white - black))
        light = black + (white - black) * through_lens(fine, *self.lens.size, options.blur)
        return 255 * light.clip(0) ** (1 / options.gamma)


def _look(changed: dict[str, float]) -> RenderOptions:
    return replace(RenderOptions(gamma=2.2, noise=0.0), **changed)  # type: ignore[arg-type]


BOARD = Board(columns=9, rows=6, square=0.025)
CHECKERS = Scene(BOARD)
_GRAY = 0.114, 0.587, 0.299  # OpenCV's weights of blue, green and red


class Picture(NamedTuple):
    """An image, and the true corners (N, 2) of the board in its order, NaN where not visible; None without."""

    image: NDArray[Any]
    truth: Tensor | None


def _sensor(light: Light, generator: torch.Generator, noise: float = 2.0, quality: int = 92) -> NDArray[np.uint8]:
    levels = light + noise * torch.randn(light.shape, generator=generator, dtype=torch.float64).numpy()
    raw = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    packed = cv2.imencode(".jpg", raw, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _random(generator: torch.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def _axes(light: Light) -> tuple[Light, Light]:
    y, x = np.mgrid[: light.shape[0], : light.shape[1]].astype(np.float64)
    return x, y


def motion_kernel(length: float, angle: float) -> Light:
    """A line of `length` pixels, drawn with subpixels."""
    reach = math.ceil(length / 2) + 1
    size, fine = 2 * reach + 1, 16
    at = np.linspace(-length / 2, length / 2, 64 * max(1, math.ceil(length)))
    u = (at * math.cos(angle) + reach + 0.5) * fine
    v = (at * math.sin(angle) + reach + 0.5) * fine
    drawn, _, _ = np.histogram2d(v, u, bins=size * fine, range=((0, size * fine), (0, size * fine)))
    drawn = drawn.reshape(size, fine, size, fine).sum((1, 3))
    return np.asarray(0.25 * (drawn + drawn[::-1, ::-1]) * 2.0 / drawn.sum())


def plain(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    light, truth = scene.draw(generator)
    return Picture(_sensor(light, generator), truth)


def blurred(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """Out of focus: sigma of 0.1 to 0.2 of the smallest square."""
    light, truth = scene.draw(generator, gamma=1.0)
    sigma = _random(generator, 0.1, 0.2) * scene.sharp(truth)
    return Picture(_sensor(cv2.GaussianBlur(light, (0, 0), sigma), generator), truth)


def moving(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """Smeared along one direction by 0.2 to 0.6 of the smallest square."""
    light, truth = scene.draw(generator, gamma=1.0)
    kernel = motion_kernel(_random(generator, 0.2, 0.6) * scene.sharp(truth), _random(generator, 0, math.pi))
    return Picture(_sensor(cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REPLICATE), generator), truth)


def overexposed(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """White clips, blooms into the black squares, and black is raised."""
    light, truth = scene.draw(generator, gamma=1.0, blur=1.2)
    levels = light * _random(generator, 1.8, 2.6) + 20.0
    bloom = np.clip(levels - 255.0, 0, None)
    levels = levels + 0.5 * cv2.GaussianBlur(bloom, (0, 0), 3.0)
    return Picture(_sensor(255.0 * (np.clip(levels, 0, 255) / 255.0) ** (1 / 1.8), generator), truth)


def screen(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """Shown on a screen: its raster beats with the camera's pixels (moire), and lines of its refresh run across."""
    light, truth = scene.draw(generator, black=8.0, background=30.0)
    x, y = _axes(light)
    points = truth.reshape(scene.board.rows, scene.board.columns, 2).numpy()
    first, far, low = points[0, 0], points[0, -1], points[-1, 0]
    dots = _random(generator, 12, 40)  # of the screen in a square
    a = ((x - first[0]) * (far - first)[0] + (y - first[1]) * (far - first)[1]) / ((far - first) ** 2).sum()
    b = ((x - first[0]) * (low - first)[0] + (y - first[1]) * (low - first)[1]) / ((low - first) ** 2).sum()
    raster = np.cos(2 * math.pi * a * (scene.board.columns - 1) * dots) + np.cos(
        2 * math.pi * b * (scene.board.rows - 1) * dots
    )
    bands = 1.0 + 0.15 * np.sin(2 * math.pi * y / _random(generator, 60, 160))
    return Picture(_sensor(light * (1.0 + 0.2 * raster) * bands, generator), truth)


def small(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """Squares of about 10 px; of boards with markers 16."""
    light, truth = scene.draw(generator, fill=scene.small, tilt=30.0)
    return Picture(_sensor(light, generator), truth)


def sixteen_bits(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """12 bits in 16, most of them unused: a dark scene, with a few hot pixels."""
    light, truth = scene.draw(generator, gamma=1.0)
    levels = light * 1.5 + 64.0 + 3.0 * torch.randn(light.shape, generator=generator, dtype=torch.float64).numpy()
    hot = torch.randint(0, light.size, (20,), generator=generator).numpy()
    levels.reshape(-1)[hot] = 4095.0
    return Picture(np.clip(np.rint(levels), 0, 4095).astype(np.uint16), truth)


def fringed(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """Red and blue are magnified differently (lateral color), by up to 2 px in the corners."""
    light, truth = scene.draw(generator)
    middle = torch.tensor([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2], dtype=torch.float64)
    gray, place = np.zeros_like(light), torch.zeros_like(truth)
    for weight, scale in zip(_GRAY, (1.005, 1.0, 0.996), strict=True):
        shift = np.hstack([scale * np.eye(2), (1 - scale) * middle.numpy()[:, None]])
        gray += weight * cv2.warpAffine(light, shift, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        place += weight * (middle + scale * (truth - middle))
    return Picture(_sensor(gray, generator), place)


def glaring(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """A lamp's reflection: about six squares are white."""
    light, truth = scene.draw(generator)
    x, y = _axes(light)
    u, v = truth[int(torch.randint(0, scene.board.corners, (1,), generator=generator))].tolist()
    reach = scene.side(truth)
    spot = np.exp(-0.5 * (((x - u) / (1.4 * reach)) ** 2 + ((y - v) / reach) ** 2))
    return Picture(_sensor(light + 400.0 * spot, generator), truth)


def shaded(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """A hard shadow across the board, and light that falls off."""
    light, truth = scene.draw(generator)
    x, y = _axes(light)
    u, v = truth.mean(0).tolist()
    angle = _random(generator, 0, 2 * math.pi)
    away = (x - u) * math.cos(angle) + (y - v) * math.sin(angle)
    shade = 0.25 + 0.75 / (1.0 + np.exp(-away / 2.0))
    return Picture(_sensor(light * shade * (1.0 - 0.4 * x / SIZE[0]), generator), truth)


def noisy(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """Little light: contrast of 40 levels, noise of 10, JPEG of low quality."""
    light, truth = scene.draw(generator, blur=1.0)
    return Picture(_sensor(30.0 + 0.23 * light, generator, noise=10.0, quality=60), truth)


def sharpened(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """The camera's sharpening leaves halos and jagged edges."""
    light, truth = scene.draw(generator, blur=0.4)
    soft = cv2.GaussianBlur(light, (0, 0), 1.2)
    return Picture(_sensor(40.0 + 0.5 * (light + 1.5 * (light - soft)), generator, quality=75), truth)


def textured(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """Stripes around the board."""
    state = generator.get_state()
    dark, truth = scene.draw(generator, background=0.0)
    generator.set_state(state)
    lit, _ = scene.draw(generator, background=255.0)
    share = np.clip((lit - dark) / np.maximum(lit, 1.0) * 1.1, 0, 1)
    x, y = _axes(dark)
    angle, period = _random(generator, 0, math.pi), _random(generator, 6, 14)
    stripes = 110.0 + 90.0 * np.sin(2 * math.pi * (x * math.cos(angle) + y * math.sin(angle)) / period)
    return Picture(_sensor(dark * (1 - share) + stripes * share, generator), truth)


def cut(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """One to three columns or rows are outside the image."""
    pose = scene.pose(generator, fill=(0.6, 0.8), tilt=25.0)
    side = int(torch.randint(0, 4, (1,), generator=generator))
    axis, sign = side % 2, 1 if side < 2 else -1
    limit = torch.tensor([SIZE[0] - 1.0, SIZE[1] - 1.0], dtype=torch.float64)
    step = torch.zeros(3, dtype=torch.float64)
    step[axis] = 0.002 * sign
    lost = _random(generator, 0.12, 0.3)
    for _ in range(400):
        truth = scene.places(pose)
        inside = ((truth > 0) & (truth < limit)).all(-1)
        if float((~inside).double().mean()) >= lost:
            break
        pose = Pose(pose.rotation, pose.translation + step)
    light = scene.light(pose)
    return Picture(_sensor(light, generator), torch.where(inside[:, None], truth, math.nan))


def covered(generator: torch.Generator, scene: Scene = CHECKERS) -> Picture:
    """A finger, two squares wide, reaches from outside to a corner of the board and over it."""
    light, truth = scene.draw(generator)
    u, v = truth[int(torch.randint(0, scene.board.corners, (1,), generator=generator))].tolist()
    angle, reach = _random(generator, 0, 2 * math.pi), scene.side(truth)

    def away(x: Light, y: Light) -> Light:
        along = (x - u) * math.cos(angle) + (y - v) * math.sin(angle)
        across = (y - v) * math.cos(angle) - (x - u) * math.sin(angle)
        return np.asarray(np.hypot(np.minimum(along, 0), across) - reach)

    share = 1.0 / (1.0 + np.exp(np.clip(away(*_axes(light)) / 0.7, -50, 50)))
    hidden = torch.from_numpy(away(*truth.numpy().T) < 0)
    return Picture(_sensor(light + share * (90.0 - light), generator), truth.masked_fill(hidden[:, None], math.nan))


def large(generator: torch.Generator) -> Picture:
    """100 megapixels, not quite in focus."""
    light, truth = Scene(BOARD, (11600, 8700)).draw(generator, blur=4.0)
    return Picture(np.clip(np.rint(light + 1.0), 0, 255).astype(np.uint8), truth)


def other_board(generator: torch.Generator) -> Picture:
    """A board of another size, of 4 to 12 corners each way."""
    while True:
        columns, rows = (int(n) for n in torch.randint(4, 13, (2,), generator=generator))
        if {columns, rows} != {BOARD.columns, BOARD.rows}:
            break
    light, _ = Scene(Board(columns=columns, rows=rows, square=BOARD.square)).draw(generator)
    return Picture(_sensor(light, generator), None)


def lacking_a_line(generator: torch.Generator) -> Picture:
    """An 8x6 board whose narrow margin and the ground beside it pass for a ninth column."""
    narrow = Scene(Board(columns=8, rows=6, square=BOARD.square))
    light, truth = narrow.draw(generator, background=60.0, tilt=20.0)
    corners = truth.reshape(6, 8, 2).numpy()
    # Paper ends a tenth of a square outside the outer squares: dark ground is painted over the rest of the margin.
    right, left = 1.1 * (corners[:, -1] - corners[:, -2]), 1.1 * (corners[:, 0] - corners[:, 1])
    for line, out in ((corners[:, -1], right), (corners[:, 0], left)):
        ends = np.concatenate([line[:1] - 3 * (line[1:2] - line[:1]), line, line[-1:] + 3 * (line[-1:] - line[-2:-1])])
        outs = np.concatenate([out[:1], out, out[-1:]])
        area = np.concatenate([ends + outs, (ends + 4 * outs)[::-1]])
        cv2.fillPoly(light, [np.rint(area).astype(np.int32)], 60.0)
    return Picture(_sensor(cv2.GaussianBlur(light, (0, 0), 0.7), generator), None)


def stripes_and_tiles(generator: torch.Generator) -> Picture:
    """A checkered floor without an end, seen at a slant."""
    light, _ = Scene(Board(columns=40, rows=40, square=0.025)).draw(generator, fill=(0.9, 1.0), tilt=30.0)
    u, v = int(_random(generator, 40, 200)), int(_random(generator, 40, 120))
    part = cv2.resize(light[v : v + 200, u : u + 260], SIZE, interpolation=cv2.INTER_CUBIC)
    return Picture(_sensor(part, generator), None)


Kind = Callable[..., Picture]  # of a generator, and of a scene where another board can be shown
HARD: tuple[Kind, ...] = (
    plain, blurred, moving, overexposed, screen, small, sixteen_bits, fringed, glaring, shaded, noisy, sharpened,
    textured, cut, covered,
)  # fmt: skip
NOT_THE_BOARD: tuple[Kind, ...] = (other_board, lacking_a_line, stripes_and_tiles)


def pictures(kind: Kind, count: int, *scene: Scene) -> Iterator[Picture]:
    """The same `count` pictures each time."""
    for number in range(count):
        yield kind(torch.Generator().manual_seed(1000 * number + 7), *scene)
