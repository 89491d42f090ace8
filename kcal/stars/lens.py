"""A camera from night images alone: stars named by their pattern, the field of view unknown, then the lens fitted."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.stars.attitude import fit_attitude
from kcal.stars.catalog import StarCatalog
from kcal.stars.detect import DetectedStars
from kcal.stars.identification import Identification, identify, turn_between
from kcal.stars.lens_fit import StarLens, fit_star_lens
from kcal.stars.night import SkyView
from kcal.stars.sky import celestial_directions
from kcal.stars.star_problem import StarField
from kcal.stars.with_boards import Agreement, joint_calibration, refine_by_stars
from kcal.threads import in_one_thread

# Degrees between opposite corners: the widest and narrowest lens that is looked for, and steps between.
_WIDEST, _NARROWEST, _STEP = 115.0, 6.0, 1.02
_SCALE_ERROR = 0.012
# Of the half diagonal: stars nearer the middle, where all lenses are alike, are named first.
_MIDDLE = 0.5
# How many of the brightest stars make triangles in each pass over all fields of view, most of which are wrong.
_CORNERS, _SEARCHED = (4, 6), 24
_ROUGH_PX = 3.0
# Images in which the field of view is looked for.
_TRIES = 3


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarCamera:
    """A camera that was calibrated by stars.

    Args:
        lens: the fit: camera, residuals, rotations of the images that were used.
        images: their numbers.
        stars: (N,) index in the catalogue of each of their named stars.
        pixels: (N, 2) where these were seen.
        refused: number of each other image, and why it was not used.
        agreement: of the stars with the boards that calibrated the camera before; None where none did.
        joint: the calibration by boards, refined by the stars; None likewise.
    """

    lens: StarLens
    images: tuple[int, ...]
    stars: tuple[np.ndarray, ...]
    pixels: tuple[np.ndarray, ...]
    refused: dict[int, str]
    agreement: Agreement | None = None
    joint: CameraCalibrationResult | None = None


@in_one_thread
def calibrate_by_stars(
    images: Sequence[DetectedStars],
    views: Sequence[SkyView],
    size: tuple[int, int],
    *,
    focal: float | None = None,
    boards: CameraCalibrationResult | None = None,
    catalog: StarCatalog | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> StarCamera:
    """Calibrate a camera at infinity from the stars of several night images, alone or together with boards.

    Tilt the camera up: stars then cover the whole image, and refraction bends little. By stars alone the camera has no
    entrance pupil: it is right for what is far away. Boards tell the pupil and the lens where they were seen: together
    both give one posterior.

    Args:
        images: the stars of each.
        views: when and where each was taken; with both, refraction is taken out.
        size: of the images, px.
        focal: px, where it is known to 3 %; otherwise it is looked for.
        boards: what boards said of the camera; names are then found with it.
        catalog: the stars; kcal's own if left out.
        progress: called after each step.

    Raises:
        InputError: no image whose stars have names, or too few of them.

    Example:
        >>> calibrate_by_stars([], [], (1920, 1080))
        Traceback (most recent call last):
        kcal.errors.InputError: in none of 0 images stars have names: too few are seen, or this is not the night sky
    """
    catalog = catalog or StarCatalog.bundled()
    order = sorted(range(len(images)), key=lambda number: -len(images[number].pixels))
    rotations: dict[int, np.ndarray] = {}
    if boards is None:
        camera, rotations = _first_lens(images, views, order, size, focal, catalog, progress)
    else:
        camera = boards.camera
        if camera.size != size:
            width, height = camera.size
            raise InputError(f"the night images have {size[0]}x{size[1]} pixels, those of boards {width}x{height}")
    refused: dict[int, str] = {}
    for number in order:
        if number in rotations:
            continue
        found_here = _by_camera(images[number], camera, catalog)
        if found_here is None:
            refused[number] = f"{len(images[number].pixels)} points of light have no names"
        else:
            rotations[number] = found_here.rotation
    progress("names")
    if not rotations:
        raise InputError(f"in none of {len(images)} images stars have names by the boards' camera: is it of this lens?")
    lens: StarLens | None = None
    agreement: Agreement | None = None
    for _ in range(3):
        fields, star, pixels, kept = _star_fields(images, views, camera, rotations, catalog)
        turns = [rotation for _, rotation in kept]
        if boards is None:
            lens = fit_star_lens(fields, turns, size, float(camera.params[0]))
        else:
            lens, agreement = refine_by_stars(fields, turns, boards)
        camera = lens.camera
        rotations = {n: found.numpy() for (n, _), found in zip(kept, lens.rotations, strict=True)}
        progress("lens")
    assert lens is not None
    return StarCamera(
        lens=lens,
        images=tuple(n for n, _ in kept),
        stars=tuple(star),
        pixels=tuple(pixels),
        refused=refused,
        agreement=agreement,
        joint=None if boards is None or agreement is None else joint_calibration(boards, lens, agreement),
    )


def _first_lens(
    images: Sequence[DetectedStars],
    views: Sequence[SkyView],
    order: Sequence[int],
    size: tuple[int, int],
    focal: float | None,
    catalog: StarCatalog,
    progress: Callable[[str], object],
) -> tuple[Camera, dict[int, np.ndarray]]:
    """A rough camera from the first image whose stars have names, and its rotation."""
    named: dict[int, Identification] = {}
    for number in order[:_TRIES]:
        found = _search(images[number], size, focal, catalog)
        progress(f"field of view of image {number + 1}")
        if found is not None:
            named[number], focal = found
            break
    if focal is None or not named:
        raise InputError(
            f"in none of {len(images)} images stars have names: too few are seen, or this is not the night sky"
        )
    first = next(iter(named))
    return _from_middle_outward(images, views, size, focal, {first: named[first].rotation}, catalog)


def _pinhole(focal: float, size: tuple[int, int]) -> Camera:
    center = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    return Camera.build(focal=(focal, focal), center=center, size=size, model="pinhole")


def _rays(pixels: np.ndarray, size: tuple[int, int], focal: float) -> np.ndarray:
    plane = (pixels - [(size[0] - 1) / 2, (size[1] - 1) / 2]) / focal
    rays = np.c_[plane, np.ones(len(plane))]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _search(
    found: DetectedStars, size: tuple[int, int], focal: float | None, catalog: StarCatalog
) -> tuple[Identification, float] | None:
    """Names of the stars in the middle of an image, and the focal length, tried from wide to narrow."""
    half = 0.5 * math.hypot(*size)
    away = np.linalg.norm(found.pixels - [(size[0] - 1) / 2, (size[1] - 1) / 2], axis=1)
    inside = np.flatnonzero(away < _MIDDLE * half)[:_SEARCHED]
    if len(inside) < 5:
        return None
    steps = round(math.log(_WIDEST / _NARROWEST) / math.log(_STEP))
    angles = [math.radians(_WIDEST * _STEP**-k) for k in range(steps + 1)]
    tried = (
        [half / math.tan(angle / 2) for angle in angles]
        if focal is None
        else [focal * _STEP**k for k in (0, 1, -1, 2, -2)]
    )
    for corners, guess in itertools.product(_CORNERS, tried):
        rays = _rays(found.pixels[inside], size, guess)
        field = 2 * math.atan(_MIDDLE * half / guess)
        here = identify(rays, 1.5 / guess, catalog=catalog, scale_error=_SCALE_ERROR, field=field, corners=corners)
        if here is None:
            continue
        known = np.flatnonzero(here.star >= 0)
        seen = catalog.directions()[here.star[known]] @ here.rotation.T
        plane = seen[:, :2] / seen[:, 2:]
        centered = found.pixels[inside[known]] - [(size[0] - 1) / 2, (size[1] - 1) / 2]
        star = np.full(len(found.pixels), -1)
        star[inside[: len(here.star)]] = here.star
        scale = float((plane * centered).sum() / (plane**2).sum())
        return here._replace(star=star), scale
    return None


def _by_camera(found: DetectedStars, camera: Camera, catalog: StarCatalog) -> Identification | None:
    rays, valid = camera.unproject(torch.from_numpy(found.pixels))
    rays = (rays / rays.norm(dim=-1, keepdim=True))[valid]
    focal = float(camera.params[0])
    return identify(rays.numpy(), _ROUGH_PX / focal, catalog=catalog, scale_error=0.003)


def _from_middle_outward(
    images: Sequence[DetectedStars],
    views: Sequence[SkyView],
    size: tuple[int, int],
    focal: float,
    rotations: dict[int, np.ndarray],
    catalog: StarCatalog,
) -> tuple[Camera, dict[int, np.ndarray]]:
    """A camera from one image, whose stars get names from the middle outward while the lens becomes better known."""
    camera = _pinhole(focal, size)
    for share in (0.6, 0.8, 1.0, 1.2):
        near = {n: _near_middle(images[n], size, share) for n in rotations}
        fields, _, _, kept = _star_fields(near, views, camera, rotations, catalog)
        lens = fit_star_lens(fields, [rotation for _, rotation in kept], size, float(camera.params[0]))
        camera = lens.camera
        rotations = {n: found.numpy() for (n, _), found in zip(kept, lens.rotations, strict=True)}
    return camera, rotations


def _near_middle(found: DetectedStars, size: tuple[int, int], share: float) -> DetectedStars:
    away = np.linalg.norm(found.pixels - [(size[0] - 1) / 2, (size[1] - 1) / 2], axis=1)
    use = away < share * 0.5 * math.hypot(*size)
    return found._replace(pixels=found.pixels[use], sigma=found.sigma[use], flux=found.flux[use])


def _star_fields(
    images: Sequence[DetectedStars] | dict[int, DetectedStars],
    views: Sequence[SkyView],
    camera: Camera,
    rotations: dict[int, np.ndarray],
    catalog: StarCatalog,
) -> tuple[list[StarField], list[np.ndarray], list[np.ndarray], list[tuple[int, Tensor]]]:
    """Stars with names of each image whose attitude is roughly known, in its own frame."""
    fields, stars, pixels, kept = [], [], [], []
    for number, rotation in sorted(rotations.items()):
        found, directions = images[number], _directions(views[number], catalog)
        # At another time the axes are the same, but aberration and refraction move stars by some seconds of arc.
        ahead = _ahead(rotation, directions, catalog, views[number])
        best = fit_attitude(found.pixels, found.sigma, directions, catalog.magnitude, camera, ahead)
        if best is None:
            continue
        use = best.star >= 0
        fields.append(
            StarField(
                torch.from_numpy(directions[best.star[use]]),
                torch.from_numpy(found.pixels[use]),
                torch.from_numpy(found.sigma[use]),
            )
        )
        stars.append(best.star[use])
        pixels.append(found.pixels[use])
        kept.append((number, best.rotation))
    return fields, stars, pixels, kept


def _directions(view: SkyView, catalog: StarCatalog) -> np.ndarray:
    if not view.on_earth:
        return celestial_directions(catalog, view.time)
    # Refracted, but in the catalogue's axes, in which rotations of other images and the first names are.
    there = view.directions(catalog)
    up = there[:, 2] > math.sin(math.radians(3.0))
    celestial = celestial_directions(catalog, view.time)
    turn = turn_between(there[up], celestial[up])
    return np.where(up[:, None], there @ turn.T, celestial)


def _ahead(rotation: np.ndarray, directions: np.ndarray, catalog: StarCatalog, view: SkyView) -> np.ndarray:
    near = catalog.directions() @ rotation[2] > 0.95
    return rotation @ turn_between(directions[near], catalog.directions()[near]) if near.sum() > 2 else rotation
