"""What the pictures of `hard_boards` show: a plain checkerboard, or a board with markers, before a camera."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

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
        self,
        generator: torch.Generator,
        fill: tuple[float, float] = (0.45, 0.85),
        tilt: float = 40.0,
        **look: float,
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
