"""Render a board as a camera sees it, and what is seen through a window of the image."""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Literal, NamedTuple

import torch
from torch import Tensor

import kcal.sim.captures as captures
from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose
from kcal.sim.captures import BoardLike, LensLike, PrintedBoard, TrueRig
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.truth import PixelRectangle, TruthLens, grow, pixel_axes

# Invert a lens at every pixel of a rectangle: exactly on a grid, interpolated in between, never past a fold.

_NODE_SPACING = 8  # pixels at most between the places where the lens is inverted; cubic interpolation between them
_NODES_PER_FOCAL = 50  # at least so many of them in a focal length
_FOLD = 6  # steps around a place without inverse that are inverted pixel by pixel
_PIXELS_AT_ONCE = 1 << 15  # pixels inverted at a time; more would leave the processor's cache


@torch.no_grad()
def invert_window(lens: LensLike, window: PixelRectangle) -> tuple[Tensor, Tensor]:
    """Find where every pixel of a window looks.

    The lens is inverted at every eighth pixel (more densely if the focal length is below 400 px) and interpolated by
    cubic Lagrange polynomials. The error is 2e-6 px for the demonstration's lenses and at most 5e-4 px close to a fold
    (measured by projecting back). Around pixels that have no inverse, every pixel is inverted.

    Returns:
        slopes x / z and y / z (height, width, 2), followed for a `TruthLens` by where the line of sight crosses the
        plane z = 0 in meters (height, width, 4); and valid (height, width).

    Example:
        >>> camera = Camera.build(focal=(400, 400), center=(159.5, 119.5), size=(320, 240))
        >>> normalized, valid = invert_window(camera, PixelRectangle(100, 50, 20, 10))
        >>> [round(value, 9) for value in normalized[0, 0].tolist()], bool(valid.all())
        ([-0.14875, -0.17375], True)
    """
    step = min(_NODE_SPACING, max(1, int(float(lens.focal.min()) / _NODES_PER_FOCAL)))
    across, nodes_x = _lagrange(window.left, window.width, step)
    down, nodes_y = _lagrange(window.top, window.height, step)
    node_y, node_x = torch.meshgrid(nodes_y, nodes_x, indexing="ij")
    nodes, valid_nodes = _look(lens, torch.stack([node_x, node_y], -1).reshape(-1, 2))
    shape = (len(nodes_y), len(nodes_x))
    looks = torch.stack([down @ column.reshape(shape) @ across.T for column in nodes.unbind(-1)], -1)

    invalid = (~valid_nodes).reshape(1, 1, *shape).double()
    near = torch.nn.functional.max_pool2d(invalid, 2 * _FOLD + 1, stride=1, padding=_FOLD)[0, 0]
    exact = (down.ne(0).double() @ near @ across.ne(0).double().T) > 0
    valid = ~exact
    if bool(exact.any()):
        x, y = pixel_axes(window)
        pixels = torch.stack([x.expand(exact.shape)[exact], y[:, None].expand(exact.shape)[exact]], -1)
        looks[exact], valid[exact] = _look(lens, pixels)
    return looks, valid


def _look(lens: LensLike, pixels: Tensor) -> tuple[Tensor, Tensor]:
    if isinstance(lens, TruthLens):
        valid = lens.covers(pixels)
        lines = lens.lines(pixels.clamp(lens.low, lens.high))
        return torch.cat([lines.slopes, lines.origins], -1), valid
    parts = [lens.normalize(part) for part in pixels.split(_PIXELS_AT_ONCE)]
    return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])


def _lagrange(start: int, count: int, step: int) -> tuple[Tensor, Tensor]:
    """Weights (count, nodes) of cubic interpolation at start, start + 1, ..., and positions of the nodes."""
    # As many nodes outside the window as a fold there could disturb.
    nodes = start + step * torch.arange(-_FOLD, (count - 1) // step + 2 + _FOLD, dtype=torch.float64)
    where = torch.arange(count)
    first = where // step + _FOLD - 1  # of the four nodes used
    t = (where % step).double() / step  # from the second node to the third
    basis = torch.stack(
        [
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        ],
        -1,
    )
    weights = torch.zeros((count, len(nodes)), dtype=torch.float64)
    weights.scatter_(1, first[:, None] + torch.arange(4), basis)
    return weights, nodes


# Render images of a checkerboard through a distorting lens, with known corners: light, then optics, then the sensor.
#
# Each pixel is unprojected through the inverse of the lens to the board's plane; near an edge the pattern is integrated
# over parts of the pixel. Then follow blur and averaging over the pixel's area (both in linear light, and before the
# pixel grid could alias), vignetting, noise, and rounding to 8 bits.

_FAR = 1e9  # squares: nothing is painted there
_SAMPLE_REACH = 0.625  # pixels from a pixel's center to where its outermost samples end


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How a rendered image looks; gray levels are 0 to 255.

    Args:
        black: gray level of the black squares.
        white: of the white squares and the margin.
        background: mean level around the board; it varies slowly by a fifth.
        margin: width of the white margin in squares.
        blur: sigma of the optics' Gaussian in pixels, on top of the averaging over the pixel's area; below 0.13 it is
            0.13.
        noise: sigma of the sensor's noise in gray levels.
        vignetting: share of light lost in the image's corners.
        gamma: of the camera: gray levels are 255 times the share of light to the power of 1 / gamma. Blur and
            vignetting act on light, noise on gray levels.

    Raises:
        InputError: a value out of range.
    """

    black: float = 40.0
    white: float = 215.0
    background: float = 115.0
    margin: int = 1
    blur: float = 0.7
    noise: float = 2.0
    vignetting: float = 0.15
    gamma: float = 1.0

    def __post_init__(self) -> None:
        for name in ("black", "white", "background"):
            if not 0 <= getattr(self, name) <= 255:
                raise InputError(f"render option {name}: a gray level from 0 to 255 is needed")
        for name, high in (("blur", 20.0), ("noise", 255.0), ("vignetting", 1.0)):
            if not 0 <= getattr(self, name) <= high:
                raise InputError(f"render option {name}: a value from 0 to {high:g} is needed")
        if not 0.2 <= self.gamma <= 5:
            raise InputError("render option gamma: a value from 0.2 to 5 is needed")
        if not isinstance(self.margin, int) or not 1 <= self.margin <= 20:
            raise InputError("render option margin: a whole number of squares from 1 to 20 is needed")


def render_board(
    camera: LensLike,
    cam_from_board: tuple[Tensor, Tensor],
    board: BoardLike,
    options: RenderOptions | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Render a checkerboard as the camera sees it.

    The square diagonally outside corner 0 is black. `board_points` gives the corners on the board, `project_board`
    their true pixels and which of them are visible. A board that reaches beyond the image, or beyond what the lens can
    image, is drawn as far as it is visible.

    The lens is inverted every 8 px and interpolated by cubics; edges are integrated in closed form over quarters of a
    pixel. A straight edge lies within 1e-9 px of where it should, and a cubic fitted to the noise-free image finds
    corners to 0.001 px RMS.

    Args:
        camera: a single camera, or a true lens.
        cam_from_board: rotation (3, 3) and translation (3,) in meters.
        board: columns, rows and square.
        options: how the image looks.
        generator: source of the noise; needed when `options.noise` is not zero.

    Returns:
        (height, width) uint8.

    Raises:
        InputError: a batch of cameras, a board that reaches behind the camera or is seen from its back, a bad board
            or pose, or noise without a generator.

    Example:
        >>> from kcal.sim.captures import BoardSize
        >>> camera = Camera.build(focal=(400, 400), center=(159.5, 119.5), size=(320, 240))
        >>> pose = Pose(torch.eye(3), torch.tensor([-0.2, -0.125, 1.0]))
        >>> image = render_board(camera, pose, BoardSize(9, 6, 0.05), RenderOptions(noise=0, vignetting=0))
        >>> image.shape, int(image[60, 70]), int(image[60, 90])
        (torch.Size([240, 320]), 40, 215)
    """
    options = options or RenderOptions()
    if options.noise > 0 and generator is None:
        raise InputError("render_board: noise needs a torch.Generator; give one or set noise to 0")
    image = render_light(camera, cam_from_board, board, options)
    if options.noise > 0:
        image += options.noise * torch.randn(image.shape, dtype=torch.float64, generator=generator)
    return image.round_().clamp_(0, 255).to(torch.uint8)


@torch.no_grad()
def render_light(
    camera: LensLike, cam_from_board: tuple[Tensor, Tensor], board: BoardLike, options: RenderOptions | None = None
) -> Tensor:
    """Render the image as it falls on the sensor, before noise and rounding: (height, width) float64 gray levels.

    Arguments and errors are those of `render_board`.

    Example:
        >>> from kcal.sim.captures import BoardSize
        >>> camera = Camera.build(focal=(400, 400), center=(159.5, 119.5), size=(320, 240))
        >>> pose = Pose(torch.eye(3), torch.tensor([-0.2, -0.125, 1.0]))
        >>> light = render_light(camera, pose, BoardSize(9, 6, 0.05), RenderOptions(vignetting=0))
        >>> [round(value, 6) for value in light[60, 78:82].tolist()]  # an edge half way between columns 79 and 80
        [44.244125, 84.751421, 170.248754, 210.755908]
    """
    options = _in_light(options or RenderOptions())
    if isinstance(camera, Camera) and camera.params.ndim != 1:
        raise InputError("render_board: a single camera is needed, got a batch")
    captures.check_board(board)
    pose = captures.check_pose(cam_from_board)
    radius = math.ceil(4 * options.blur)
    width, height = camera.size
    image = _background(PixelRectangle(0, 0, width, height), camera.size, options)
    paper = _paper_window(camera, pose, board, options.margin, radius)
    if paper.width > 0 and paper.height > 0:
        # Light from just outside the window is blurred into it.
        light = _light(camera, pose, board, grow(paper, radius), options)
        rows, columns = slice(paper.top, paper.top + paper.height), slice(paper.left, paper.left + paper.width)
        image[rows, columns] = _blur_to_pixels(light, options.blur, radius)
    x, y = pixel_axes(PixelRectangle(0, 0, width, height))
    x, y = x - (width - 1) / 2, y - (height - 1) / 2
    image *= 1 - options.vignetting * (x**2 + y[:, None] ** 2) / (x[-1] ** 2 + y[-1] ** 2)
    return image if options.gamma == 1 else 255 * (image.clamp_min(0) / 255) ** (1 / options.gamma)


def _in_light(options: RenderOptions) -> RenderOptions:
    """Options whose gray levels are converted to shares of light, times 255."""
    levels = {name: 255 * (getattr(options, name) / 255) ** options.gamma for name in ("black", "white", "background")}
    return options if options.gamma == 1 else replace(options, **levels)


def _light(camera: LensLike, pose: Pose, board: BoardLike, window: PixelRectangle, options: RenderOptions) -> Tensor:
    """The scene in gray levels, before the optics: (2 height, 2 width), four samples in each pixel of a window.

    Along x and y, a sample is the average over half a pixel, and of two such averages a quarter of a pixel apart: what
    sampling folds back is then too little to move a corner.
    """
    around = _background(window, camera.size, options)
    grown_a, grown_b = _board_coordinates(camera, pose, board, grow(window, 1), options.margin)
    a, b = grown_a[1:-1, 1:-1], grown_b[1:-1, 1:-1]
    tiny = torch.tensor(1e-6, dtype=torch.float64)
    light = _paint(a, b, tiny, tiny, board, options, around)
    light = light.repeat_interleave(2, 0).repeat_interleave(2, 1)

    # Board squares per pixel, along x and y. Every edge of the pattern and of the paper lies at a whole number.
    a_x, a_y, b_x, b_y = *_slopes(grown_a), *_slopes(grown_b)
    edge_a = (a - a.round()).abs() <= _SAMPLE_REACH * (a_x.abs() + a_y.abs())
    edge_b = (b - b.round()).abs() <= _SAMPLE_REACH * (b_x.abs() + b_y.abs())
    outside = 1.5 + options.margin
    near = (a > -outside) & (a < board.columns - 1 + outside) & (b > -outside) & (b < board.rows - 1 + outside)
    rows, columns = ((edge_a | edge_b) & near).nonzero(as_tuple=True)
    a, b, a_x, a_y, b_x, b_y, around = (value[rows, columns] for value in (a, b, a_x, a_y, b_x, b_y, around))
    # Boxes with the variance of a square of a quarter pixel along the board's axes: exact for straight edges along the
    # pixels, and never off center.
    width_a = 0.25 * torch.hypot(a_x, a_y).clamp_min(1e-9)
    width_b = 0.25 * torch.hypot(b_x, b_y).clamp_min(1e-9)
    for i, j in itertools.product((0, 1), repeat=2):
        mixed = torch.zeros_like(a)
        for m, n in itertools.product((-1, 0, 1), repeat=2):
            dx, dy = 0.5 * j - 0.25 + 0.25 * m, 0.5 * i - 0.25 + 0.25 * n
            sample = _paint(a + a_x * dx + a_y * dy, b + b_x * dx + b_y * dy, width_a, width_b, board, options, around)
            mixed.add_(sample, alpha=(2 - abs(m)) * (2 - abs(n)) / 16)
        light[2 * rows + i, 2 * columns + j] = mixed
    return light


def _slopes(grown: Tensor) -> tuple[Tensor, Tensor]:
    """Change per pixel along x and y, one pixel smaller on every side."""
    return 0.5 * (grown[1:-1, 2:] - grown[1:-1, :-2]), 0.5 * (grown[2:, 1:-1] - grown[:-2, 1:-1])


def _paint(
    a: Tensor, b: Tensor, width_a: Tensor, width_b: Tensor, board: BoardLike, options: RenderOptions, around: Tensor
) -> Tensor:
    """Gray levels of boxes around board positions, where the background has the gray levels `around`."""
    paper, black = captures.area_colors(a, b, width_a, width_b, board, options.margin)
    return around + (options.white - around) * paper - (options.white - options.black) * black


def _board_coordinates(
    camera: LensLike, pose: Pose, board: BoardLike, window: PixelRectangle, margin: int
) -> tuple[Tensor, Tensor]:
    """Find where each pixel's ray meets the board, x and y in squares; far away where it does not."""
    looks, valid = invert_window(camera, window)
    x, y, *origins = looks.unbind(-1)
    plane = torch.stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation / board.square], -1)
    rows = torch.linalg.inv(plane)
    a, b, depth = (row[0] * x + row[1] * y + row[2] for row in rows)
    # depth is square / z of the meeting point: not positive for rays that leave the plane behind.
    unseen = ~valid | (depth <= 1e-12)
    a, b = a / depth, b / depth
    if origins:
        # Lines of sight that start beside the camera's origin.
        start_a, start_b, nearer = ((row[0] * origins[0] + row[1] * origins[1]) / board.square for row in rows)
        a, b = start_a + a * (1 - nearer), start_b + b * (1 - nearer)
    if isinstance(board, PrintedBoard):
        a, b = _on_print(a, b, torch.stack([x, y, torch.ones_like(x)], -1) @ pose.rotation, board, margin)
    return a.masked_fill_(unseen, _FAR), b.masked_fill_(unseen, _FAR)


def _on_print(a: Tensor, b: Tensor, sight: Tensor, board: PrintedBoard, margin: int) -> tuple[Tensor, Tensor]:
    """Coordinates of the print that lines of sight (H, W, 3) see, from where they meet the board as it should be.

    Errors of the print change by 1 % of what the coordinates do, so that each step leaves 1 % of the error. They are so
    smooth that linear interpolation over 8 px is wrong by less than 1e-4 px.
    """
    (down, rows), (across, columns) = (_linear(count, 8) for count in a.shape)
    plane = torch.stack([a, b], -1)[rows][:, columns]
    slopes = sight[rows][:, columns]
    slopes, found = slopes[..., :2] / slopes[..., 2:], plane
    # Beyond the paper nothing is seen, and a bend would grow without limit.
    outside = 1.0 + margin
    high = torch.tensor([board.columns - 1 + outside, board.rows - 1 + outside], dtype=torch.float64)
    for _ in range(4):
        at = torch.minimum(found.clamp_min(-outside), high)
        errors = board.errors(torch.nn.functional.pad(at * board.square, (0, 1))) / board.square
        found = plane + errors[..., 2:] * slopes - errors[..., :2]
    moved_a, moved_b = (down @ moved @ across.T for moved in (found - plane).nan_to_num().unbind(-1))
    return a + moved_a, b + moved_b


def _linear(count: int, step: int) -> tuple[Tensor, Tensor]:
    """Weights (count, nodes) of linear interpolation at 0, 1, ..., and the nodes: each `step`-th place and the last."""
    nodes = torch.cat([torch.arange(0, count - 1, step), torch.tensor([count - 1])])
    place = torch.arange(count)
    first = (place // step).clamp_max(max(len(nodes) - 2, 0))
    share = (place - nodes[first]) / (nodes[(first + 1).clamp_max(len(nodes) - 1)] - nodes[first]).clamp_min(1)
    weights = torch.zeros((count, len(nodes)), dtype=torch.float64)
    weights[place, first] = 1.0 - share.double()
    weights[place, (first + 1).clamp_max(len(nodes) - 1)] += share.double()
    return weights, nodes


def _paper_window(camera: LensLike, pose: Pose, board: BoardLike, margin: int, radius: int) -> PixelRectangle:
    """Bound the part of the image that the paper and its blur reach; the whole image where that is uncertain."""
    outline = _outline(board, 1 + margin) @ pose.rotation.T + pose.translation
    if bool((outline[:, 2] <= 0).any()):
        raise InputError("render_board: the board reaches behind the camera; move it forward (z is depth)")
    if float(pose.rotation[:, 2] @ pose.translation) <= 0:
        raise InputError("render_board: the board shows its back; its z axis must point away from the camera")
    width, height = camera.size
    pixels, valid = camera.project(outline)
    if not bool(valid.all()):
        return PixelRectangle(0, 0, width, height)
    # The outline is known at points only, and bends a little between them.
    low, high = pixels.amin(0), pixels.amax(0)
    pad = radius + 3 + 0.01 * float((high - low).max())
    left, top = (max(0, math.floor(float(value) - pad)) for value in low)
    right, bottom = (
        min(size, math.ceil(float(value) + pad) + 1) for size, value in zip(camera.size, high, strict=True)
    )
    return PixelRectangle(left, top, max(0, right - left), max(0, bottom - top))


def _outline(board: BoardLike, border: int) -> Tensor:
    """Points around the rectangle that lies `border` squares outside the inner corners, (4 * 64, 3) meters."""
    corners = captures.board_points(board, border)
    columns = board.columns + 2 * border
    ring = corners[[0, columns - 1, -1, -columns, 0]]
    share = torch.arange(64, dtype=torch.float64)[:, None, None] / 64
    return ((1 - share) * ring[:-1] + share * ring[1:]).reshape(-1, 3)


def _background(window: PixelRectangle, size: tuple[int, int], options: RenderOptions) -> Tensor:
    x, y = pixel_axes(window)
    wave = torch.sin(4.0 * x / size[0] + (2.5 * y / size[1])[:, None] + 0.5)
    return options.background * (1 + 0.2 * wave)


def _blur_to_pixels(light: Tensor, sigma: float, radius: int) -> Tensor:
    """Apply the optics and the pixel's area: four samples per pixel become one, `radius` fewer on every side."""
    # In half pixels. The samples are a little wider than the half pixels that make up a pixel's area.
    variance = max((2 * sigma) ** 2 - 0.0625, 1e-4)
    reach = 2 * radius
    offset = torch.arange(-reach, reach + 1, dtype=torch.float64)
    gaussian = torch.exp(-0.5 * offset**2 / variance)
    both = torch.nn.functional.pad(gaussian, (0, 1)) + torch.nn.functional.pad(gaussian, (1, 0))
    weights = (both / both.sum()).tolist()
    rows, columns = (size - len(weights) + 2 for size in light.shape)
    vertical = torch.zeros((rows // 2, light.shape[1]), dtype=torch.float64)
    result = torch.zeros((rows // 2, columns // 2), dtype=torch.float64)
    for i, weight in enumerate(weights):
        vertical.add_(light[i : i + rows : 2], alpha=weight)
    for i, weight in enumerate(weights):
        result.add_(vertical[:, i : i + columns : 2], alpha=weight)
    return result


# A simulated site with known truth: a rig of two CCTV cameras, its boards, landmarks and far targets.
#
# Its lenses are ray-traced with the entrance pupil where it is, and its board is printed with errors, so that no model
# of kcal is the truth. docs/measured/paper.md tells which accuracy the marks and the calibration allow: 0.05 px of
# noise in each image alone is 2 % of range at 5 km.

# Name, horizontal distance in meters, degrees to the right of the heading, meters above the rig.
_PLAIN = json.loads(resources.files("kcal.sim").joinpath("plain.json").read_text(encoding="utf-8"))
_NEAR_BOARD = PrintedBoard(9, 6, 0.06, seed=1)
# mm: the focal length that 1600 px are on a sensor of 1/2.8 inch, whose pixels measure 2.9 µm.
FOCAL_MM = 4.64
_RENDER = RenderOptions(blur=1.0, noise=4.0, vignetting=0.3, gamma=2.2)
Places = tuple[tuple[str, float, float, float], ...]


class NamedPoints(NamedTuple):
    """Names, and positions (N, 3) in meters east, north and up of the left camera."""

    names: tuple[str, ...]
    enu: Tensor


class SceneMarks(NamedTuple):
    """Pixels (N, 2) at which points were marked in both images, and where they truly are."""

    left: Tensor
    right: Tensor
    true_left: Tensor
    true_right: Tensor


class DemoView(NamedTuple):
    """One rendered image.

    Attributes:
        camera: "left" or "right".
        name: of the view, for example "near-07".
        image: (height, width) uint8.
        corners: (N, 2) true pixels of the inner corners, row by row.
    """

    camera: Literal["left", "right"]
    name: str
    image: Tensor
    corners: Tensor


@functools.cache
def demo_rig() -> TrueRig:
    """Two CCTV cameras 10 m apart, 1920 x 1080, f 1600 px, wide glass lenses (72 degrees) of ordinary assembly.

    Their entrance pupils move with the angle, as in the real lens.

    Example:
        >>> round(float(demo_rig().baseline), 3)
        10.0
    """
    return captures.drawn_rig(SURVEILLANCE, 1.0, 1, focal_mm=FOCAL_MM, wander=1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class DemoScene:
    """The site, cameras, boards and marks of the demonstration; the same seed gives the same bytes.

    Convention: the rig frame is the left camera's; ENU has its origin in the left camera's center. Rotations are in
    degrees here, as a site plan has them.

    Args:
        seed: of poses, noise and marks.
        rig: the true cameras.
        lat: of the left camera's center, degrees (WGS 84); a salt flat.
        lon: degrees east.
        height: meters above the ellipsoid.
        heading_deg: azimuth of the left camera's axis, degrees clockwise from true north.
        pitch_deg: of that axis above the horizon, degrees.
        roll_deg: turn of the left camera about its axis, degrees, clockwise as seen from behind it.
        near_board: board for close views of one camera each, held at 0.7 to 1.6 m.
        near_views: how many per camera.
        render: how images look.
        mark_sigma: noise of marks in pixels along each axis in each image.
        survey_sigma: error of surveyed positions in meters, along each axis.
        targets_at: points to locate: name, distance in meters, bearing in degrees to the right of the heading, height
            in meters.
        landmarks_at: points surveyed to orient the rig, likewise.

    Example:
        >>> scene = DemoScene(seed=1, near_views=4)
        >>> scene.images
        8
        >>> scene.targets.names[-1], [round(value) for value in scene.targets.enu[-1].tolist()]
        ('drone', [1545, 4755, 180])
    """

    seed: int = 0
    rig: TrueRig = field(default_factory=demo_rig)
    lat: float = 40.762
    lon: float = -113.896
    height: float = 1282.0
    heading_deg: float = 16.0
    pitch_deg: float = -0.5
    roll_deg: float = 0.4
    near_board: BoardLike = _NEAR_BOARD
    near_views: int = 20
    render: RenderOptions = _RENDER
    mark_sigma: float = 0.1
    survey_sigma: float = 0.02
    targets_at: Places = tuple(map(tuple, _PLAIN["targets"]))
    landmarks_at: Places = tuple(map(tuple, _PLAIN["landmarks"]))

    @property
    def images(self) -> int:
        """How many images `render_demo` yields."""
        return 2 * self.near_views

    @property
    def enu_from_rig(self) -> Tensor:
        """(3, 3) rotation of the rig frame into east, north, up; both have the same origin."""
        heading, pitch, roll = (math.radians(angle) for angle in (self.heading_deg, self.pitch_deg, self.roll_deg))
        right = torch.tensor([math.cos(heading), -math.sin(heading), 0.0], dtype=torch.float64)
        forward = torch.tensor(
            [math.sin(heading) * math.cos(pitch), math.cos(heading) * math.cos(pitch), math.sin(pitch)],
            dtype=torch.float64,
        )
        level = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
        cosine, sine = math.cos(roll), math.sin(roll)
        return level @ torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=torch.float64)

    @property
    def targets(self) -> NamedPoints:
        """Points to be located, from 100 m to 5 km; two of them near the image's left and right edge."""
        return self.places(self.targets_at)

    @property
    def landmarks(self) -> NamedPoints:
        """Points for the orientation of the rig, from 120 m to 2.6 km, where they truly are."""
        return self.places(self.landmarks_at)

    def surveyed(self, points: NamedPoints) -> NamedPoints:
        """Add the surveyor's errors to points."""
        stream = -20 - sum(map(ord, points.names[0]))
        error = torch.randn(points.enu.shape, dtype=torch.float64, generator=self.generator(stream))
        return NamedPoints(points.names, points.enu + self.survey_sigma * error)

    @property
    def target_marks(self) -> SceneMarks:
        """The targets marked in both images, with the scene's noise."""
        return self.marked(self.targets, -1)

    @property
    def landmark_marks(self) -> SceneMarks:
        """The landmarks marked in both images, with the scene's noise."""
        return self.marked(self.landmarks, -2)

    def points_rig(self, points: NamedPoints) -> Tensor:
        """(N, 3) positions in the left camera's frame."""
        return points.enu @ self.enu_from_rig

    def generator(self, stream: int) -> torch.Generator:
        """Make the random source of one part of the scene, so that the parts do not depend on each other."""
        return torch.Generator().manual_seed((self.seed + 1) * 1_000_003 + stream)

    def marked(self, points: NamedPoints, stream: int) -> SceneMarks:
        """Points marked in both images, with the scene's noise."""
        return mark_points(self.rig, self.points_rig(points), self.mark_sigma, self.generator(stream))

    def places(self, table: Places) -> NamedPoints:
        """Points of a table such as `targets_at`, where they truly are."""
        azimuth = [math.radians(self.heading_deg + bearing) for _, _, bearing, _ in table]
        rows = [
            [distance * math.sin(angle), distance * math.cos(angle), up]
            for angle, (_, distance, _, up) in zip(azimuth, table, strict=True)
        ]
        return NamedPoints(tuple(name for name, *_ in table), torch.tensor(rows, dtype=torch.float64))


def mark_points(rig: TrueRig, points_rig: Tensor, sigma: float, generator: torch.Generator) -> SceneMarks:
    """Mark points in both images with Gaussian noise.

    Args:
        rig: two cameras.
        points_rig: (N, 3) meters in the left camera's frame.
        sigma: standard deviation in pixels, for each axis and image.
        generator: source of the noise.

    Raises:
        InputError: a bad sigma, or a point that is not finite or that one of the cameras does not see.

    Example:
        >>> point = torch.tensor([[0.0, 0.0, 1000.0]])
        >>> marks = mark_points(demo_rig(), point, 0.1, torch.Generator().manual_seed(0))
        >>> bool((marks.left - marks.true_left).abs().max() < 0.5)
        True
    """
    points = as_points("points_rig", points_rig, 3)
    require_finite("points_rig", points)
    if not (sigma >= 0 and math.isfinite(sigma)):
        raise InputError(f"sigma {sigma}: pixels, not negative, are needed")
    with torch.no_grad():
        pixels, valid = rig(points)
        (left, right), valid = pixels.unbind(-2), valid.all(-1)
    unseen = ~(valid & rig.left.inside(left) & rig.right.inside(right))
    if bool(unseen.any()):
        raise InputError(f"points_rig: point {int(unseen.nonzero()[0])} is not seen by both cameras")
    noise = sigma * torch.randn((2, *left.shape), dtype=torch.float64, generator=generator)
    return SceneMarks(left + noise[0], right + noise[1], left, right)


def render_demo(scene: DemoScene, progress: Callable[[str], None] | None = None) -> Iterator[DemoView]:
    """Render all images of a scene, one after the other: left's views of the board, then right's.

    Args:
        scene: what to render.
        progress: called with a short text after each image was made.

    Yields:
        `scene.images` views.

    Raises:
        InputError: the scene's boards cannot be seen as asked.

    Example:
        >>> view = next(render_demo(DemoScene(seed=1, near_views=1)))
        >>> view.camera, view.name, tuple(view.image.shape), tuple(view.corners.shape)
        ('left', 'near-01', (1080, 1920), (54, 2))
    """
    for index, (side, name, pose) in enumerate(scene_views(scene)):
        camera = getattr(scene.rig, side)
        image = render_board(camera, pose, scene.near_board, scene.render, scene.generator(index))
        corners, _ = captures.project_board(camera, pose, scene.near_board)
        if progress is not None:
            progress(f"{side} {name}")
        yield DemoView(side, name, image, corners)


def scene_views(scene: DemoScene) -> Iterator[tuple[Literal["left", "right"], str, Pose]]:
    """Camera, name and pose of each view of the board."""
    sides: tuple[Literal["left", "right"], ...] = ("left", "right")
    for stream, side in enumerate(sides):
        camera = getattr(scene.rig, side)
        poses = captures.sample_board_poses(camera, scene.near_board, scene.near_views, scene.generator(-10 - stream))
        for number, pose in enumerate(poses, 1):
            yield side, f"near-{number:02d}", pose
