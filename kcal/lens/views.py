"""Views that images are resampled to: pinholes, cylinders, and what of the image they show."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcal.checks import StatedModule, as_points
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector

# Choose a pinhole camera for undistorted images: OpenCV's alpha, restricted to the valid region of the lens.
#
# A pinhole camera stretches a rectangle of the plane z = 1 over its image. Every point of the inner rectangle (alpha 0)
# has a source pixel; the outer rectangle (alpha 1) contains every source pixel that has a ray.

# Source positions this far outside the outer pixel centers still count, in pixels, so that rounding does not lose an
# undistorted pixel that lies exactly on the image's edge.
_SLACK = 1e-6
# Points per side of the image in the search for its extremes.
_SIDE_SAMPLES = 129
# Rays farther from the axis count for neither rectangle: on a pinhole's plane they lie too far out.
_WIDEST = math.radians(89.0)
# Which side of the image is at the left, right, top and bottom of a frame, by quarter turns of the image.
_SIDES = (0, 1, 2, 3), (3, 2, 0, 1), (1, 0, 3, 2), (2, 3, 1, 0)


class TurnedCamera:
    """A camera whose rays are those of a frame that is turned against its own; far away, or at a range.

    Args:
        camera: a camera or a batch.
        rotation: (..., 3, 3) camera_from_frame.
        at: range of what is seen, meters.
    """

    def __init__(self, camera: Camera, rotation: Tensor, at: float = math.inf) -> None:
        self.camera, self.rotation, self.at = camera, rotation, at
        self.params, self.size = camera.params, camera.size

    @property
    def roll(self) -> float:
        """Degrees from the frame's x axis to the camera's, towards the frame's y axis."""
        x, y = self.rotation[..., 0, :2].reshape(-1, 2)[0].tolist()
        return math.degrees(math.atan2(y, x))

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """As `Camera.unproject`, in the turned frame."""
        rays, valid = self.camera.unproject(pixels)
        return rays @ self.rotation, valid

    def project_rays(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels of what is seen in directions (..., N, 3) of the turned frame, at the range."""
        rays = rays @ self.rotation.mT
        if math.isinf(self.at):
            return self.camera.project_rays(rays)
        return self.camera.project(self.at * rays / rays.norm(dim=-1, keepdim=True))


def source_pixels(camera: Camera | TurnedCamera, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Project directions to pixels, and say whether the image has a value there.

    Args:
        camera: the camera that took the image.
        rays: (..., N, 3) of any length.

    Returns:
        pixels (..., N, 2) and seen (..., N): valid for the lens, and between the centers of the outer pixels, so that
        bilinear interpolation has all its neighbors. Pixels up to 1e-6 px outside are moved onto the edge.

    Example:
        >>> camera = Camera.build(focal=(100, 100), center=(50, 40), size=(101, 81), model="pinhole")
        >>> pixels, seen = source_pixels(camera, torch.tensor([[1.0, 0.0, 4.0], [4.0, 3.0, 8.0], [51.0, 0.0, 100.0]]))
        >>> pixels[0].tolist(), seen.tolist()
        ([75.0, 40.0], [True, True, False])
    """
    pixels, valid = camera.project_rays(rays)
    last = torch.tensor(camera.size, dtype=pixels.dtype, device=pixels.device) - 1
    near = ((pixels >= -_SLACK) & (pixels <= last + _SLACK)).all(-1)
    # On the bounds themselves, clamp still passes gradients.
    return torch.clamp(pixels, torch.zeros_like(last), last), valid & near


@torch.no_grad()
def new_pinhole(camera: Camera, alpha: float = 0.0, size: tuple[int, int] | None = None) -> Camera:
    """Choose the pinhole camera for undistorted images, like OpenCV's `getOptimalNewCameraMatrix`.

    Convention: the centers of the outer pixels lie on the sides of the rectangle that the new image shows.

    With alpha 0 every pixel of the new image is valid; with alpha 1 every source pixel is kept that has a ray less than
    89° from the axis. In between, focal lengths and principal point are interpolated linearly. As with OpenCV, fx and
    fy differ even if those of the source are equal, because the new image shows a rectangle of another shape. OpenCV
    looks at 9 x 9 points; this function searches for the extremes along the image's border, and with alpha 0 checks
    every border pixel of the new image.

    Parts of the image where the lens model folds or has no preimage do not count. A pinhole cannot show 180°: with a
    very wide lens and alpha 1, the middle of the image becomes small. For such a lens, above all a fisheye, choose the
    new focal length yourself: `Camera.build(..., model="pinhole")`.

    Args:
        camera: a camera or a batch of cameras.
        alpha: 0 (only valid pixels) to 1 (all source pixels).
        size: (width, height) of the new image; by default that of `camera`.

    Returns:
        A camera with the model `"pinhole"` and the batch shape of `camera`.

    Raises:
        InputError: alpha outside 0 to 1, or an image less than two pixels wide or high.
        DegenerateError: the pixel at the image's center or those around it have no valid ray.

    Example:
        >>> camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.2])
        >>> [round(value) for value in new_pinhole(camera, alpha=0).focal.tolist()]
        [449, 475]
        >>> [round(value) for value in new_pinhole(camera, alpha=1).focal.tolist()]
        [401, 401]
    """
    if not 0.0 <= alpha <= 1.0:
        raise InputError(f"alpha {alpha}: a number from 0 (only valid pixels) to 1 (all source pixels) is needed")
    width, height = camera.size if size is None else (int(size[0]), int(size[1]))
    if min(width, height, *camera.size) < 2:
        raise InputError(f"images of {camera.size} and ({width}, {height}): at least 2 pixels each way are needed")

    values = torch.zeros_like(camera.params[..., :5])
    if alpha < 1:
        values = values + (1 - alpha) * _pinhole_parameters(*inner_rectangle(camera, (width, height)), (width, height))
    if alpha > 0:
        values = values + alpha * _pinhole_parameters(*outer_rectangle(camera), (width, height))
    return Camera(values, size=(width, height), model="pinhole")


def _pinhole_parameters(low: Tensor, high: Tensor, size: tuple[int, int]) -> Tensor:
    """Stretch the rectangle from low (..., 2) to high (..., 2) over an image: (..., 5) fx, fy, cx, cy and no skew."""
    if not bool((high > low).all()):
        raise DegenerateError("new_pinhole: no valid pixels around the image's center; check the coefficients")
    last = torch.tensor(size, dtype=low.dtype, device=low.device) - 1
    focal = last / (high - low)
    return torch.cat([focal, -focal * low, torch.zeros_like(focal[..., :1])], -1)


def _points_on_sides(low: Tensor, high: Tensor, along: Tensor) -> Tensor:
    """Points (..., 4, N, 2) on the left, right, top and bottom side of a rectangle; `along` (..., 4, N) is 0 to 1."""
    side = along.new_tensor([0.0, 1.0])[:, None].expand_as(along[..., :2, :])
    across, down = torch.cat([side, along[..., 2:, :]], -2), torch.cat([along[..., :2, :], side], -2)
    return low[..., None, None, :] + (high - low)[..., None, None, :] * torch.stack([across, down], -1)


def _side_extremes(camera: Camera | TurnedCamera, outermost: bool) -> Tensor:
    """Innermost (or outermost) x of the left and right side and y of the top and bottom side of the image, (..., 4).

    Infinite for a side on which no pixel has a ray. Left is the side that is at the left in the camera's frame.
    """
    vector = camera.params
    sides = list(_SIDES[round(camera.roll / 90.0) % 4 if isinstance(camera, TurnedCamera) else 0])
    last = torch.tensor(camera.size, dtype=vector.dtype, device=vector.device) - 1
    step = torch.linspace(0, 1, _SIDE_SAMPLES, dtype=vector.dtype, device=vector.device)
    # Inward is +x on the left and -x on the right.
    inward = torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=vector.dtype, device=vector.device)
    sign = -inward if outermost else inward
    start, end = torch.zeros_like(sign), torch.ones_like(sign)
    value = torch.zeros_like(sign)
    # 129 samples per side, then twice the two steps around the best one: the remaining error is below 1e-9 px.
    for _ in range(3):
        along = start[..., None] + (end - start)[..., None] * step
        pixels = _points_on_sides(torch.zeros_like(last), last, along)[..., sides, :, :]
        rays, valid = camera.unproject(pixels.flatten(-3, -2))
        rays, valid = rays.unflatten(-2, (4, _SIDE_SAMPLES)), valid.unflatten(-1, (4, _SIDE_SAMPLES))
        valid = valid & (rays[..., 2] > math.cos(_WIDEST))
        reach = torch.cat([rays[..., :2, :, 0], rays[..., 2:, :, 1]], -2) / rays[..., 2] * sign[:, None]
        best, index = torch.where(valid, reach, -math.inf).max(-1)
        value = best * sign
        along = along.expand(reach.shape)
        start = torch.gather(along, -1, (index - 1).clamp(min=0)[..., None])[..., 0]
        end = torch.gather(along, -1, (index + 1).clamp(max=_SIDE_SAMPLES - 1)[..., None])[..., 0]
    return value


def inner_rectangle(camera: Camera | TurnedCamera, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The rectangle in which every pixel of a new image of this size has a source."""
    vector = camera.params
    shape = torch.tensor(size, dtype=vector.dtype, device=vector.device) - 1
    # A side without rays lies beyond the fold. There the limit is the rectangle of the image's shape in the valid disc.
    disc = torch.linalg.vector_norm(_valid_rim(camera), dim=-1).amin(-1, keepdim=True) * shape / shape.norm()
    sides = _side_extremes(camera, outermost=False)
    low = torch.where(sides[..., 0::2].isfinite(), sides[..., 0::2], -disc)
    high = torch.where(sides[..., 1::2].isfinite(), sides[..., 1::2], disc)

    middle = (torch.tensor(camera.size, dtype=vector.dtype, device=vector.device) - 1) / 2
    rays, valid = camera.unproject(middle[None])
    ray, valid = rays[..., 0, :], valid[..., 0]
    center = ray[..., :2] / ray[..., 2:]
    valid = valid & (ray[..., 2] > 0)
    around = valid & (center > low).all(-1) & (center < high).all(-1)
    boxes = [(low, high)] if bool(around.all()) else []
    if isinstance(camera, TurnedCamera) and bool(valid):
        # Of an image that is rolled, innermost points of its sides leave little, or nothing.
        reach = (_side_extremes(camera, outermost=True) - center.repeat_interleave(2)).abs()
        half = reach.where(reach.isfinite(), disc.repeat_interleave(2)).amax() * shape / shape.amin()
        boxes.append((center - half, center + half))
    if not boxes:
        raise DegenerateError(
            "new_pinhole: the image's center has no valid ray; check the camera, or make the new one by `Camera.build`"
        )

    columns, rows = (torch.linspace(0, 1, n, dtype=vector.dtype, device=vector.device) for n in size)
    longest = max(size)
    along = torch.stack([torch.nn.functional.pad(t, (0, longest - t.numel())) for t in (rows, rows, columns, columns)])

    def all_seen(box: tuple[Tensor, Tensor], scale: Tensor) -> Tensor:
        """Whether all pixels along the border have a source, after the rectangle is shrunk towards the center."""
        border = _points_on_sides(*_shrunk(center, *box, scale), along)
        return source_pixels(camera, _on_plane(border.flatten(-3, -2)))[1].all(-1)

    found = []
    for box in boxes:
        good, bad = torch.zeros_like(center[..., 0]), torch.ones_like(center[..., 0])
        good = torch.where(all_seen(box, bad), bad, good)
        while bool((bad - good > 1e-9).any()):
            trial = (good + bad) / 2
            passed = all_seen(box, trial) | (good == bad)
            good, bad = torch.where(passed, trial, good), torch.where(passed, bad, trial)
        found.append(_shrunk(center, *box, good))
    return max(found, key=lambda box: float(((box[1] - box[0]) / shape).amin()))


def _shrunk(center: Tensor, low: Tensor, high: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Shrink a rectangle towards a point: scale 1 leaves it as it is, 0 gives the point."""
    scale = scale[..., None]
    return center + scale * (low - center), center + scale * (high - center)


def outer_rectangle(camera: Camera | TurnedCamera) -> tuple[Tensor, Tensor]:
    """The rectangle around every source pixel that has a ray."""
    sides = _side_extremes(camera, outermost=True)
    low, high = sides[..., 0::2], sides[..., 1::2]
    # Where the fold crosses the image, the valid region ends there and not at the image's border.
    rim = _valid_rim(camera)
    _, seen = source_pixels(camera, _on_plane(rim))
    low = torch.minimum(low, torch.where(seen[..., None], rim, math.inf).amin(-2))
    high = torch.maximum(high, torch.where(seen[..., None], rim, -math.inf).amax(-2))
    return low, high


def _valid_rim(camera: Camera | TurnedCamera) -> Tensor:
    """Last valid points (..., 1440, 2) of the plane z = 1 along as many directions from the axis."""
    vector = camera.params
    turn = torch.arange(1440, dtype=vector.dtype, device=vector.device) * (2 * math.pi / 1440)
    circle = torch.stack([torch.cos(turn), torch.sin(turn)], -1)
    low, high = torch.zeros_like(turn), torch.full_like(turn, _WIDEST)
    # Bisection to rounding.
    for _ in range(52):
        middle = (low + high) / 2
        _, valid = camera.project_rays(_on_plane(circle * torch.tan(middle)[..., None]))
        low, high = torch.where(valid, middle, low), torch.where(valid, high, middle)
    return circle * torch.tan(low)[..., None]


def _on_plane(normalized: Tensor) -> Tensor:
    """Points (..., 3) on the plane z = 1 from their x, y (..., 2)."""
    return torch.cat([normalized, torch.ones_like(normalized[..., :1])], -1)


# Views that images are resampled to: a pinhole of a chosen field of view, a cylinder, and what of the image they show.
#
# A view is a camera or a `Cylinder`, and a rotation: where it looks.

# Pinholes with wider fields of view stretch their borders beyond use.
_WIDEST_PINHOLE = 170.0
# Columns and rows of the source over which it is told what a view shows, and what the pupil does.
_GRID = (65, 49)


class Cylinder(StatedModule):
    """A picture on an upright cylinder around the camera: columns are angles, and vertical lines stay straight.

    Convention: the axis of the cylinder is the y axis. Column u sees the azimuth (u - cx) / f, row v the height
    (v - cy) / f on the cylinder of radius one, with one focal length f in pixels a radian.

    Args:
        focal: pixels a radian.
        center: pixel of the direction straight ahead.
        size: (width, height).

    Raises:
        InputError: a focal length that is not positive, or more than a whole turn.

    Example:
        >>> strip = Cylinder(focal=100.0, center=(157.0, 50.0), size=(315, 101))
        >>> rays, valid = strip.unproject(torch.tensor([[157.0, 50.0], [314.0, 50.0]]))
        >>> [[round(value, 2) for value in ray] for ray in rays.tolist()]
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
        >>> bool(torch.allclose(strip.project(rays)[0], torch.tensor([[157.0, 50.0], [314.0, 50.0]]).double()))
        True
    """

    params: Tensor

    def __init__(self, *, focal: float, center: tuple[float, float], size: tuple[int, int]) -> None:
        super().__init__()
        if not (focal > 0 and all(map(math.isfinite, (focal, *center)))):
            raise InputError(f"cylinder: a positive focal length and a finite center are needed, got {focal}, {center}")
        if (size[0] - 1) / focal > 2.0 * math.pi:
            raise InputError(f"cylinder: {size[0]} columns at {focal:g} px a radian are more than a whole turn")
        self.size = size
        self.register_buffer("params", torch.tensor([focal, *center], dtype=torch.float64))

    @property
    def constants(self) -> object:
        """Size."""
        return self.size

    grid: Any = Camera.grid

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Map pixels (..., N, 2) to rays (..., N, 3) of length one, and valid (..., N): not behind the seam."""
        focal, cx, cy = self.params.unbind(-1)
        u, v = as_points("pixels", pixels, 2).unbind(-1)
        angle, height = (u - cx) / focal, (v - cy) / focal
        rays = torch.stack([angle.sin(), height, angle.cos()], -1)
        return rays / rays.norm(dim=-1, keepdim=True), angle.abs() <= math.pi

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Map points (..., N, 3) to pixels (..., N, 2), and valid (..., N): not on the axis."""
        focal, cx, cy = self.params.unbind(-1)
        X, Y, Z = as_points("points_cam", points_cam, 3).unbind(-1)
        away = torch.hypot(X, Z)
        valid = away > 0
        height = Y / torch.where(valid, away, 1.0)
        return torch.stack([focal * torch.atan2(X, Z) + cx, focal * height + cy], -1), valid

    def inside(self, pixels: Tensor) -> Tensor:
        """Whether pixels (..., N, 2) lie in the picture, whose edges are half a pixel beyond the outer centers."""
        edge = torch.tensor(self.size, dtype=pixels.dtype, device=pixels.device) - 0.5
        return ((pixels >= -0.5) & (pixels <= edge)).all(-1)


def pinhole_view(field_of_view: float, size: tuple[int, int]) -> Camera:
    """A pinhole camera with square pixels and a horizontal field of view in degrees, its axis in the middle.

    Raises:
        InputError: a field of view outside 0 to 170 degrees, or fewer than two pixels each way.

    Example:
        >>> pinhole_view(90.0, (641, 481)).params.round().tolist()
        [320.0, 320.0, 320.0, 240.0, 0.0]
    """
    if not 0 < field_of_view <= _WIDEST_PINHOLE:
        raise InputError(
            f"a pinhole's field of view of {field_of_view:g} degrees: more than 0 and at most {_WIDEST_PINHOLE:g} are "
            "needed; a cylinder shows more"
        )
    width, height = size
    if min(size) < 2:
        raise InputError(f"a view of {width}x{height} px: at least 2 pixels each way are needed")
    focal = 0.5 * (width - 1) / math.tan(math.radians(0.5 * field_of_view))
    center = (0.5 * (width - 1), 0.5 * (height - 1))
    return Camera.build(focal=(focal, focal), center=center, size=size, model="pinhole")


def cylinder_view(camera: Camera, field_of_view: float | None = None, size: tuple[int, int] | None = None) -> Cylinder:
    """A cylinder for a camera's images: as wide as its middle row sees, as high as its middle column, if not given.

    Args:
        camera: a single camera.
        field_of_view: horizontal, degrees, straight ahead in the middle.
        size: (width, height) of the picture; by default as wide as the image, and with all that the columns show.

    Raises:
        InputError: a field of view that is not above 0 and at most 360 degrees, or a batch of cameras.
        DegenerateError: the middle row or the middle column has no rays.
    """
    if camera.params.ndim != 1:
        raise InputError("cylinder_view: a single camera is needed, not a batch")
    if field_of_view is not None and not 0 < field_of_view <= 360:
        raise InputError(f"a cylinder's field of view of {field_of_view:g} degrees: at most 360 are possible")
    middle = camera.grid(_GRID[0], 3)[1], camera.grid(3, _GRID[1])[:, 1]
    (across, seen), (along, visible) = (camera.unproject(pixels) for pixels in middle)
    visible = visible & (along[:, 2] > 0)
    if not (bool(seen.any()) and bool(visible.any())):
        raise DegenerateError("cylinder_view: the middle of the image has no rays; check the camera")
    angles = torch.atan2(across[seen, 0], across[seen, 2])
    heights = along[visible, 1] / torch.hypot(along[visible, 0], along[visible, 2])
    left, right = float(angles.min()), float(angles.max())
    if field_of_view is not None:
        left, right = -math.radians(0.5 * field_of_view), math.radians(0.5 * field_of_view)
    width = camera.size[0] if size is None else size[0]
    focal = (width - 1) / (right - left)
    top, bottom = float(heights.min()), float(heights.max())
    if size is None:
        size = width, max(2, math.floor((bottom - top) * focal) + 1)
        cy = -top * focal
    else:
        cy = 0.5 * (size[1] - 1) - 0.5 * (top + bottom) * focal
    return Cylinder(focal=focal, center=(-left * focal, cy), size=size)


def looking(pan: float, tilt: float) -> Tensor:
    """(3, 3) camera_from_view of a view that is turned right by `pan` and up by `tilt`, degrees.

    Example:
        >>> [round(value, 2) for value in (looking(90.0, 0.0) @ torch.tensor([0.0, 0, 1]).double()).tolist()]
        [1.0, 0.0, 0.0]
    """
    turns = torch.deg2rad(torch.tensor([[0.0, pan, 0.0], [tilt, 0.0, 0.0]], dtype=torch.float64))
    first, second = rotation_from_vector(turns)
    return first @ second


class Shown(NamedTuple):
    """What a view shows.

    Attributes:
        valid: share of its pixels that the source shows.
        source: share of the source's pixels that it shows.
        degrees: its field of view along the middle row and the middle column.
    """

    valid: float
    source: float
    degrees: tuple[float, float]


@torch.no_grad()
def shown_by(camera: Camera, view: Camera | Cylinder, rotation: Tensor, mask: Tensor) -> Shown:
    """Tell what a view (its mask (H, W) of pixels with a source) shows of a single camera's image, and what is cut."""
    rays, valid = camera.unproject(camera.grid(*_GRID).reshape(-1, 2))
    seen, visible = view.project(rays @ rotation)
    source = float((valid & visible & view.inside(seen)).double().sum() / valid.double().sum().clamp_min(1.0))
    degrees = []
    for middle in (view.grid(3, 3)[1], view.grid(3, 3)[:, 1]):
        rays, _ = view.unproject(middle)
        halves = [math.acos(max(-1.0, min(1.0, float(rays[1] @ rays[end])))) for end in (0, 2)]
        degrees.append(math.degrees(sum(halves)))
    return Shown(float(mask.double().mean()), source, (degrees[0], degrees[1]))


@torch.no_grad()
def pupil_shift(camera: Camera, at: float) -> float:
    """Largest distance in pixels between images of points at that range and far away, in one direction.

    The entrance pupil of a hybrid lens moves with the angle. No map can be right for all ranges then: one that is right
    far away errs by so much at that range, and by half of it at twice the range. 0 for other lenses.

    Args:
        camera: a single camera.
        at: meters.

    Example:
        >>> pupil_shift(Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480)), 1.0)
        0.0
    """
    if camera.model.hybrid is None:
        return 0.0
    pixels = camera.grid(*_GRID).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    near, seen = camera.project(at * rays)
    apart = (near - pixels).norm(dim=-1)[valid & seen]
    return float(apart.max()) if len(apart) else math.nan
