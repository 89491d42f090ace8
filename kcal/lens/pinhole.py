"""Which pinhole camera shows an undistorted image: OpenCV's alpha, where only the lens's valid region counts.

A rectangle on the plane z = 1 that is stretched over the new image is a pinhole camera. The inner rectangle (alpha 0)
holds no point without a source pixel; the outer one (alpha 1) holds every source pixel that has a ray.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera

# Source positions this far outside the outer pixel centers still count, in pixels: an undistorted pixel that should
# lie exactly on the image's edge must not be lost to rounding.
SLACK = 1e-6
_SAMPLES = 129
_RIM = 1440
# Rays farther from the axis count for neither rectangle: a pinhole's plane has no place for them.
_WIDEST = math.radians(89.0)


def source_pixels(camera: Camera, points_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Where a lens put points, and whether the image has a value there.

    Args:
        camera: the camera that took the image.
        points_cam: (..., N, 3), rays for example.

    Returns:
        pixels (..., N, 2) and seen (..., N): before the lens folds, and between the centers of the outer pixels, so
        that bilinear interpolation has all its neighbors. Pixels within 1e-6 px of that are moved onto it.

    Example:
        >>> camera = Camera.build(focal=(100, 100), center=(50, 40), size=(101, 81), model="pinhole")
        >>> pixels, seen = source_pixels(camera, torch.tensor([[1.0, 0.0, 4.0], [4.0, 3.0, 8.0], [51.0, 0.0, 100.0]]))
        >>> pixels[0].tolist(), seen.tolist()
        ([75.0, 40.0], [True, True, False])
    """
    pixels, valid = camera.project(points_cam)
    last = torch.tensor(camera.size, dtype=pixels.dtype, device=pixels.device) - 1
    near = ((pixels >= -SLACK) & (pixels <= last + SLACK)).all(-1)
    # On the bounds themselves clamp passes the gradient on.
    return torch.clamp(pixels, torch.zeros_like(last), last), valid & near


@torch.no_grad()
def new_pinhole(camera: Camera, alpha: float = 0.0, size: tuple[int, int] | None = None) -> Camera:
    """The pinhole camera for undistorted images, chosen as OpenCV's `getOptimalNewCameraMatrix` does.

    Convention: the centers of the outer pixels lie on the rectangle's sides. Between 0 and 1, focal lengths and
    principal point are interpolated linearly. As with OpenCV, fx and fy differ even where the source's are equal,
    because the rectangle need not have the image's shape. OpenCV looks at 9 x 9 points; here the extremes along the
    image's border are narrowed down, and alpha 0 is checked at every border pixel of the new image.

    A part of the image where the lens model folds, or has no preimage, counts for neither rectangle. With a very wide
    lens the outer one is huge, and the middle of an image with alpha 1 small: a pinhole cannot show 180°. For such a
    lens, a fisheye above all, choose the new focal length yourself: `Camera.build(..., model="pinhole")`.

    Args:
        camera: one camera or a batch.
        alpha: 0: every pixel of the new image is valid; 1: every pixel of the source that has a ray, less than 89°
            from the axis, is kept.
        size: (width, height) of the new image, the camera's own if not given.

    Returns:
        A camera with the model `"pinhole"` and the batch shape of `camera`.

    Raises:
        InputError: alpha not from 0 to 1, or an image less than two pixels wide or high.
        DegenerateError: the ray of the image's center is not valid, or nothing round it is.

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
        values = values + (1 - alpha) * _pinhole(*_inner(camera, (width, height)), (width, height))
    if alpha > 0:
        values = values + alpha * _pinhole(*_outer(camera), (width, height))
    return Camera(values, size=(width, height), model="pinhole")


def _pinhole(low: Tensor, high: Tensor, size: tuple[int, int]) -> Tensor:
    """The rectangle from low (..., 2) to high (..., 2) over an image: (..., 5) fx, fy, cx, cy and no skew."""
    if not bool((high > low).all()):
        raise DegenerateError("no valid pixels round the image's center; check the camera's coefficients")
    last = torch.tensor(size, dtype=low.dtype, device=low.device) - 1
    focal = last / (high - low)
    return torch.cat([focal, -focal * low, torch.zeros_like(focal[..., :1])], -1)


def _border(low: Tensor, high: Tensor, along: Tensor) -> Tensor:
    """Points on the left, right, top and bottom side of a rectangle, (..., 4, N, 2); `along` (..., 4, N) is 0 to 1."""
    x, y = (low[..., i, None, None] + (high - low)[..., i, None, None] * along for i in (0, 1))
    side = torch.tensor([0.0, 1.0], dtype=along.dtype, device=along.device)[:, None]
    x_side, y_side = (low[..., i, None, None] + (high - low)[..., i, None, None] * side for i in (0, 1))
    return torch.stack(
        [
            torch.cat([x_side.expand_as(x[..., :2, :]), x[..., 2:, :]], -2),
            torch.cat([y[..., :2, :], y_side.expand_as(y[..., 2:, :])], -2),
        ],
        -1,
    )


def _extremes(camera: Camera, outermost: bool) -> Tensor:
    """Where the image's four sides reach farthest in (or out): (..., 4) x left, x right, y top, y bottom.

    A side none of whose pixels has a ray is infinite.
    """
    vector = camera.params
    last = torch.tensor(camera.size, dtype=vector.dtype, device=vector.device) - 1
    step = torch.linspace(0, 1, _SAMPLES, dtype=vector.dtype, device=vector.device)
    # Inward is +x on the left and -x on the right.
    inward = torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=vector.dtype, device=vector.device)
    sign = -inward if outermost else inward
    start, end = torch.zeros_like(sign), torch.ones_like(sign)
    value = torch.zeros_like(sign)
    # 129 samples of a side, then twice the two steps round the best one: the rest is below 1e-9 px.
    for _ in range(3):
        along = start[..., None] + (end - start)[..., None] * step
        pixels = _border(torch.zeros_like(last), last, along)
        rays, valid = camera.unproject(pixels.flatten(-3, -2))
        rays, valid = rays.unflatten(-2, (4, _SAMPLES)), valid.unflatten(-1, (4, _SAMPLES))
        valid = valid & (rays[..., 2] > math.cos(_WIDEST))
        reach = torch.cat([rays[..., :2, :, 0], rays[..., 2:, :, 1]], -2) / rays[..., 2] * sign[:, None]
        best, index = torch.where(valid, reach, -math.inf).max(-1)
        value = best * sign
        along = along.expand(reach.shape)
        start = torch.gather(along, -1, (index - 1).clamp(min=0)[..., None])[..., 0]
        end = torch.gather(along, -1, (index + 1).clamp(max=_SAMPLES - 1)[..., None])[..., 0]
    return value


def _inner(camera: Camera, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The rectangle of which every pixel of a new image of this size has a source."""
    vector = camera.params
    shape = torch.tensor(size, dtype=vector.dtype, device=vector.device) - 1
    # A side without rays lies beyond the fold: there the rectangle of the image's shape in the valid disc ends it.
    disc = torch.linalg.vector_norm(_rim(camera), dim=-1).amin(-1, keepdim=True) * shape / shape.norm()
    sides = _extremes(camera, outermost=False)
    low = torch.where(sides[..., 0::2].isfinite(), sides[..., 0::2], -disc)
    high = torch.where(sides[..., 1::2].isfinite(), sides[..., 1::2], disc)

    middle = (torch.tensor(camera.size, dtype=vector.dtype, device=vector.device) - 1) / 2
    rays, valid = camera.unproject(middle[None])
    ray, valid = rays[..., 0, :], valid[..., 0]
    center = ray[..., :2] / ray[..., 2:]
    if not bool((valid & (ray[..., 2] > 0) & (center > low).all(-1) & (center < high).all(-1)).all()):
        raise DegenerateError("the image's center has no valid ray; check the camera, or build the new one by hand")

    columns, rows = (torch.linspace(0, 1, n, dtype=vector.dtype, device=vector.device) for n in size)
    longest = max(size)
    along = torch.stack([torch.nn.functional.pad(t, (0, longest - t.numel())) for t in (rows, rows, columns, columns)])

    def clear(scale: Tensor) -> Tensor:
        """Whether all pixels along the border have a source when the rectangle shrinks towards the center."""
        border = _border(*_towards(center, low, high, scale), along)
        return source_pixels(camera, _points(border.flatten(-3, -2)))[1].all(-1)

    good, bad = torch.zeros_like(center[..., 0]), torch.ones_like(center[..., 0])
    good = torch.where(clear(bad), bad, good)
    while bool((bad - good > 1e-9).any()):
        trial = (good + bad) / 2
        passed = clear(trial) | (good == bad)
        good, bad = torch.where(passed, trial, good), torch.where(passed, bad, trial)
    return _towards(center, low, high, good)


def _towards(center: Tensor, low: Tensor, high: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """The rectangle shrunk towards a point: scale 1 leaves it, 0 is the point."""
    scale = scale[..., None]
    return center + scale * (low - center), center + scale * (high - center)


def _outer(camera: Camera) -> tuple[Tensor, Tensor]:
    """The rectangle round every source pixel that has a ray."""
    sides = _extremes(camera, outermost=True)
    low, high = sides[..., 0::2], sides[..., 1::2]
    # Where the fold crosses the image, the valid region ends on its rim instead of on the image's border.
    rim = _rim(camera)
    _, seen = source_pixels(camera, _points(rim))
    low = torch.minimum(low, torch.where(seen[..., None], rim, math.inf).amin(-2))
    high = torch.maximum(high, torch.where(seen[..., None], rim, -math.inf).amax(-2))
    return low, high


def _rim(camera: Camera) -> Tensor:
    """The last valid points of the plane z = 1 along 1440 directions from the axis, (..., 1440, 2)."""
    vector = camera.params
    turn = torch.arange(_RIM, dtype=vector.dtype, device=vector.device) * (2 * math.pi / _RIM)
    circle = torch.stack([torch.cos(turn), torch.sin(turn)], -1)
    low, high = torch.zeros_like(turn), torch.full_like(turn, _WIDEST)
    # Halved until neither angle can be told from the other.
    for _ in range(52):
        middle = (low + high) / 2
        _, valid = camera.project(_points(circle * torch.tan(middle)[..., None]))
        low, high = torch.where(valid, middle, low), torch.where(valid, high, middle)
    return circle * torch.tan(low)[..., None]


def _points(normalized: Tensor) -> Tensor:
    """Points (..., 3) on the plane z = 1."""
    return torch.cat([normalized, torch.ones_like(normalized[..., :1])], -1)
