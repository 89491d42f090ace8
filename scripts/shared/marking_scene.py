"""Rendered targets of known position in both images of a rig: crosses, corners, poles, lamp heads, cars; and clutter.

A target is painted by area coverage on a grid eight times finer than the pixels, blurred there, and averaged over the
pixels. No model of `kcal.mark.shapes` takes part.

Textured objects of known position in both images of a rig, before a background at infinity.

An object is an elliptic plate that faces the rig; its gray levels are a sum of waves on the plate. Each pixel is the
mean over four by four rays through the true cameras, of the plate and of what is behind it; then both images are
blurred and get noise. Nothing of `kcal.pipeline` takes part.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from kcal import Camera, Rig
from kcal.lens import rotation_from_vector

Floats = NDArray[np.float64]
Inside = Callable[[Floats, Floats], NDArray[np.bool_]]
FINE = 8
_HALF = 26  # pixels around a target that are painted
KINDS = ("corner", "cross", "quadrants", "pole", "lamp", "car")


def inside_of(kind: str, random: np.random.Generator) -> Inside:
    """Which positions, in pixels of the left image from the true point, a target covers; drawn at random.

    `corner`: an angle of 60 to 120° in any direction. `cross`: two bars. `quadrants`: a checkered disc. `pole`: its
    upper end. `lamp`: an ellipse. `car`: a box with a smaller one on top.
    """
    turn = random.uniform(0, 2 * math.pi)
    cosine, sine = math.cos(turn), math.sin(turn)
    a, b, c = random.uniform(0, 1, 3)

    def turned(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        return x * cosine + y * sine, y * cosine - x * sine

    def corner(x: Floats, y: Floats) -> NDArray[np.bool_]:
        p, q = turned(x, y)
        angle = math.radians(60 + 60 * a)
        return (p > 0) & (p * math.cos(angle) + q * math.sin(angle) > 0)

    def cross(x: Floats, y: Floats) -> NDArray[np.bool_]:
        p, q = turned(x, y)
        width, length = 1.25 + 1.25 * a, 7 + 7 * b
        return ((np.abs(p) < width) & (np.abs(q) < length)) | ((np.abs(q) < width) & (np.abs(p) < length))

    def quadrants(x: Floats, y: Floats) -> NDArray[np.bool_]:
        p, q = turned(x, y)
        return (p * q > 0) & (p * p + q * q < (10 + 8 * a) ** 2)

    def pole(x: Floats, y: Floats) -> NDArray[np.bool_]:
        return (y > 0) & (np.abs(x - 0.1 * (a - 0.5) * y) < 1 + 2 * b)

    def lamp(x: Floats, y: Floats) -> NDArray[np.bool_]:
        return (x / (2 + 3 * a)) ** 2 + (y / (2 + 3 * b)) ** 2 < 1

    def car(x: Floats, y: Floats) -> NDArray[np.bool_]:
        long, high = 5 + 3 * a, 2 + 1.5 * b
        return ((np.abs(x) < long) & (np.abs(y) < high)) | ((np.abs(x) < 0.6 * long) & (y > -high - 2 * c) & (y < 0))

    shapes: dict[str, Inside] = {
        "corner": corner, "cross": cross, "quadrants": quadrants, "pole": pole, "lamp": lamp, "car": car,
    }  # fmt: skip
    return shapes[kind]


def paint(image: Floats, at: Floats, left_from_here: Floats, inside: Inside, contrast: float, blur: float) -> None:
    """Add a target to an image, at a pixel (2,), with the matrix (2, 2) from its pixels to those of the left image."""
    column, row = round(float(at[0])), round(float(at[1]))
    fine = (np.arange((2 * _HALF + 1) * FINE) + 0.5) / FINE - 0.5 - _HALF
    x, y = np.meshgrid(fine + column - at[0], fine + row - at[1])
    local = np.stack([x, y], -1) @ left_from_here.T
    covered = gaussian_filter(inside(local[..., 0], local[..., 1]).astype(float), blur * FINE, mode="nearest")
    size = 2 * _HALF + 1
    patch = contrast * covered.reshape(size, FINE, size, FINE).mean((1, 3))
    height, width = image.shape
    rows = slice(max(row - _HALF, 0), min(row + _HALF + 1, height))
    columns = slice(max(column - _HALF, 0), min(column + _HALF + 1, width))
    top, left = rows.start - (row - _HALF), columns.start - (column - _HALF)
    image[rows, columns] += patch[top : top + rows.stop - rows.start, left : left + columns.stop - columns.start]


def finished(image: Floats, noise: float, random: np.random.Generator) -> NDArray[np.uint8]:
    """The image with noise, as 8 bits."""
    return np.clip(np.rint(image + random.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)


def site_rig(width: int = 1280, height: int = 720) -> Rig:
    """Two unlike, distorted cameras 10 m apart; f 1600 px at a width of 1920."""
    unit = width / 1920
    lenses = ((1602, 4.3, -3.2, [-0.18, 0.05, 3e-4, -2e-4]), (1611, -6.1, 4.4, [-0.17, 0.04, -2e-4, 3e-4]))
    cameras = [
        Camera.build(
            focal=(f * unit, f * unit), center=(width / 2 + u, height / 2 + v), size=(width, height), coefficients=lens
        )
        for f, u, v, lens in lenses
    ]
    rotation = rotation_from_vector(torch.tensor([0.003, 0.006, -0.008], dtype=torch.float64))
    center = torch.tensor([10.0, 0.04, -0.06], dtype=torch.float64)
    return Rig.pair(cameras[0], cameras[1], rotation, -rotation @ center)


class SitePoint(NamedTuple):
    """Something on the site: name, what it looks like, meters from the rig, degrees right of its axis, and up."""

    name: str
    kind: str
    distance: float
    azimuth: float
    elevation: float


LANDMARKS = tuple(
    SitePoint(f"post {i + 1}", kind, *place)
    for i, (kind, *place) in enumerate(
        (
            ("cross", 60.0, -22.0, -8.0), ("corner", 90.0, 15.0, -9.0), ("quadrants", 130.0, -10.0, -6.0),
            ("cross", 180.0, 24.0, 6.0), ("quadrants", 240.0, 3.0, -8.5), ("corner", 320.0, -26.0, 5.0),
            ("cross", 430.0, 10.0, 7.0), ("quadrants", 560.0, -16.0, 8.0), ("cross", 750.0, 19.0, -2.0),
            ("corner", 1000.0, -5.0, 4.0), ("quadrants", 1500.0, 27.0, -4.0), ("cross", 2200.0, -20.0, -1.0),
        )
    )
)  # fmt: skip
TARGETS = (
    SitePoint("gate", "quadrants", 150.0, -3.0, -3.5),
    SitePoint("mast", "pole", 600.0, 7.0, 1.0),
    SitePoint("lamp", "lamp", 1800.0, 13.0, 3.0),
)


@dataclass(frozen=True, kw_only=True)
class MarkingSite:
    """Images and truth.

    Args:
        rig: as it is.
        images: of the left and right camera.
        pixels: true pixels of each point in both images, by name.
        points: (3,) meters east, north, up of the left camera, which looks north, by name.
    """

    rig: Rig
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    pixels: dict[str, tuple[Floats, Floats]]
    points: dict[str, Tensor]

    def survey(self, sigma: float, random: np.random.Generator) -> str:
        """The landmarks as a surveyor hands them over, with errors."""
        lines = ["name,east,north,up,sigma"]
        for point in LANDMARKS:
            at = self.points[point.name].numpy() + random.normal(0, sigma, 3)
            lines.append(",".join([point.name, *(f"{value:.3f}" for value in at), f"{sigma:g}"]))
        return "\n".join(lines) + "\n"


def marking_site(seed: int = 0, width: int = 1280, height: int = 720, noise: float = 1.5) -> MarkingSite:
    """Twelve landmarks and three targets before far hills; every background is at infinity."""
    random = np.random.default_rng(seed)
    rig = site_rig(width, height)
    images = [background(rig, side, np.random.default_rng(seed)) for side in (0, 1)]
    pixels, points = {}, {}
    for place in (*LANDMARKS, *TARGETS):
        turn, rise = math.radians(place.azimuth), math.radians(place.elevation)
        ray = torch.tensor([math.sin(turn) * math.cos(rise), -math.sin(rise), math.cos(turn) * math.cos(rise)]).double()
        point = place.distance * ray
        inside = inside_of(place.kind, random)
        contrast = random.choice([-1.0, 1.0]) * random.uniform(45, 75)
        blur = random.uniform(0.6, 1.0)
        both = []
        for side in (0, 1):
            at, matrix = seen(rig, point, side)
            paint(images[side], at, matrix, inside, contrast, blur)
            both.append(at)
        pixels[place.name] = both[0], both[1]
        # Camera x right, y down, z forward; it looks north.
        points[place.name] = torch.stack([point[0], point[2], -point[1]])
    first, second = (finished(image, noise, random) for image in images)
    return MarkingSite(rig=rig, images=(first, second), pixels=pixels, points=points)


def seen(rig: Rig, point: Tensor, side: int) -> tuple[Floats, Floats]:
    """Pixel (2,) of a point of the rig frame, and the matrix from pixels there to pixels of the left image."""
    reach = 1e-3 * float(point.norm())
    around = torch.stack([point, point + torch.tensor([reach, 0, 0]), point + torch.tensor([0, reach, 0])])
    left, _ = rig.left.project(around)
    here, _ = (left, None) if side == 0 else rig.right.project(rig.right_from_left(around))
    slopes = [(pixels[1:] - pixels[0]).T.numpy() / reach for pixels in (left, here)]
    return here[0].numpy(), slopes[0] @ np.linalg.inv(slopes[1])


def background(rig: Rig, side: int, random: np.random.Generator, amplitude: float = 1.6) -> Floats:
    """Sky, hills and ground as a function of the direction alone, so that both images show the same at infinity.

    The hills' gray levels vary by 3.5 times the amplitude (standard deviation), over 10 px and more.
    """
    camera = rig.left if side == 0 else rig.right
    width, height = camera.size
    grid = camera.grid(width // 4 + 2, height // 4 + 2).reshape(-1, 2)
    rays, _ = camera.unproject(grid)
    if side == 1:
        rays = rays @ rig.right_from_left_rotation
    azimuth, elevation = (torch.atan2(rays[:, 0], rays[:, 2]).numpy(), -torch.asin(rays[:, 1]).numpy())
    light = np.full(len(azimuth), 118.0) + 40 * elevation
    for _ in range(24):
        frequency, turn, phase = random.uniform(10, 400), random.uniform(0, math.pi), random.uniform(0, 2 * math.pi)
        wave = np.sin(frequency * (azimuth * math.cos(turn) + elevation * math.sin(turn)) + phase)
        light += amplitude * wave * (elevation < 0.06)
    coarse = torch.from_numpy(light.reshape(1, 1, height // 4 + 2, width // 4 + 2))
    fine = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bicubic", align_corners=True)
    return fine[0, 0].numpy()


_RAYS = 4  # across a pixel
OPTICAL_BLUR = 0.6  # pixels


@dataclass(frozen=True, kw_only=True)
class Plate:
    """An object.

    Args:
        point: (3,) its middle in the left camera's frame, meters.
        half: half its width and height, meters.
        waves: (K, 4) frequencies in x and y in radians per meter, phase, and amplitude in gray levels.
        level: its mean gray level.
    """

    point: Tensor
    half: tuple[float, float]
    waves: Floats
    level: float

    def gray(self, x: Floats, y: Floats) -> Floats:
        """Gray levels at positions in meters from the middle."""
        value = np.full(x.shape, self.level)
        for along, down, phase, amplitude in self.waves:
            value += amplitude * np.sin(along * x + down * y + phase)
        return value


def plate(
    point: Tensor, size: tuple[float, float], focal: float, contrast: float, random: np.random.Generator,
    wavelengths: tuple[float, float] = (5.0, 14.0),
) -> Plate:  # fmt: skip
    """An object of `size` pixels; `contrast`: four standard deviations of its gray levels; wavelengths in pixels."""
    meter = float(point[2]) / focal
    count = 12
    turn, length = random.uniform(0, 2 * math.pi, count), random.uniform(*wavelengths, count) * meter
    frequency = 2 * math.pi / length
    amplitude = np.full(count, contrast / 4 * math.sqrt(2.0 / count))
    waves = np.stack(
        [frequency * np.cos(turn), frequency * np.sin(turn), random.uniform(0, 2 * math.pi, count), amplitude], -1
    )  # fmt: skip
    half = 0.5 * size[0] * meter, 0.5 * size[1] * meter
    return Plate(point=point, half=half, waves=waves, level=120.0 + random.uniform(-30, 30))


def paint_plate(image: Floats, rig: Rig, side: int, item: Plate) -> None:
    """Paint an object over what an image (H, W) of the left (0) or right (1) camera shows."""
    rotation, shift = rig.right_from_left_rotation, rig.right_from_left_translation
    camera = rig.left if side == 0 else rig.right
    corners = item.point + torch.tensor([[x * item.half[0], y * item.half[1], 0.0] for x in (-1, 1) for y in (-1, 1)])
    seen, _ = camera.project(corners if side == 0 else rig.right_from_left(corners))
    height, width = image.shape
    low = np.maximum(np.floor(seen.min(0).values.numpy()).astype(int) - 2, 0)
    high = np.minimum(np.ceil(seen.max(0).values.numpy()).astype(int) + 3, (width, height))
    if (high <= low).any():
        return
    parts = (np.arange(_RAYS) + 0.5) / _RAYS - 0.5
    u = (np.arange(low[0], high[0])[:, None] + parts).ravel()
    v = (np.arange(low[1], high[1])[:, None] + parts).ravel()
    pixels = torch.from_numpy(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    rays, _ = camera.unproject(pixels)
    origin = torch.zeros(3, dtype=torch.float64)
    if side == 1:
        rays, origin = rays @ rotation, -rotation.T @ shift
    at = origin + (item.point[2] - origin[2]) / rays[:, 2:] * rays - item.point
    x, y = at[:, 0].numpy(), at[:, 1].numpy()
    inside = (x / item.half[0]) ** 2 + (y / item.half[1]) ** 2 <= 1
    shape = high[1] - low[1], _RAYS, high[0] - low[0], _RAYS
    gray = np.where(inside, item.gray(x, y), 0.0).reshape(shape).mean((1, 3))
    share = inside.reshape(shape).mean((1, 3))
    window = image[low[1] : high[1], low[0] : high[0]]
    window[:] = gray + (1 - share) * window


def texture_gradient(image: Floats, box: Floats) -> float:
    """Root mean square of the slope along the rows in a box, gray levels per pixel."""
    left, top, right, bottom = (round(float(value)) for value in box)
    part = image[max(top, 0) : bottom + 1, max(left, 1) - 1 : right + 2]
    slope = (part[:, 2:] - part[:, :-2]) / 2
    return float(np.sqrt(np.mean(slope**2)))


def exposed(image: Floats, sigma: float, random: np.random.Generator) -> Tensor:
    """The image after optics and sensor: blurred, with noise, not rounded."""
    return torch.from_numpy(gaussian_filter(image, OPTICAL_BLUR) + random.normal(0, sigma, image.shape))


def true_box(rig: Rig, side: int, item: Plate) -> Floats:
    """Edges (4,) of the object's box in an image."""
    angle = torch.linspace(0, 2 * math.pi, 65, dtype=torch.float64)[:-1]
    ring = torch.stack([item.half[0] * angle.cos(), item.half[1] * angle.sin(), torch.zeros_like(angle)], -1)
    points = item.point + ring
    camera = rig.left if side == 0 else rig.right
    seen, _ = camera.project(points if side == 0 else rig.right_from_left(points))
    return torch.cat([seen.min(0).values, seen.max(0).values]).numpy()
