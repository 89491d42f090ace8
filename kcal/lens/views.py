"""Views that images are resampled to: a pinhole of a chosen field of view, a cylinder, and what of the image they show.

A view is a camera or a `Cylinder`, and a rotation: where it looks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import StatedModule, as_points, keep_float64
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector

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

    def grid(self, columns: int, rows: int) -> Tensor:
        """Pixels (rows, columns, 2) spread evenly over the picture, as `Camera.grid`."""
        width, height = self.size
        axes = [torch.linspace(0, last - 1, count) for last, count in ((width, columns), (height, rows))]
        return torch.stack(torch.meshgrid(*axes, indexing="xy"), -1).to(self.params)

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

    def _apply(self, fn, recurse: bool = True):  # type: ignore[no-untyped-def]
        return super()._apply(keep_float64(fn), recurse)


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
    return Camera.build(
        focal=(focal, focal), center=(0.5 * (width - 1), 0.5 * (height - 1)), size=size, model="pinhole"
    )


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
    """Largest distance in pixels between images of things at that range and far away, in one direction.

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
