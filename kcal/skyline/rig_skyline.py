"""From images of the skyline by the cameras of a rig to what the rig is solved from."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.calibrate.rig.skyline_source import SkylineSource
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.mounting import Origin
from kcal.lens.pose import vector_from_rotation
from kcal.locate.ellipsoid import ecef_from_enu_rotation, mean_radius
from kcal.locate.geodesy import enu_to_geodetic
from kcal.locate.raster import Raster
from kcal.skyline.attitude import SkylineAttitude, attitude_against, horizon_around
from kcal.skyline.fit import COMMON, lens_errors, terrain_covariances
from kcal.skyline.raster_error import RasterError
from kcal.skyline.seen_horizon import Comparison
from kcal.threads import in_one_thread

Floats = NDArray[np.float64]

# Of all residuals, in sigmas: what moves them by less says nothing.
_TELLS = 1e-2


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SkylineImage:
    """An image of the skyline.

    Args:
        name: of the image.
        camera: number of the camera that took it.
        image: (H, W) gray levels.
    """

    name: str
    camera: int
    image: NDArray[np.generic]


@in_one_thread
def skyline_source(
    images: Sequence[SkylineImage],
    cameras: Sequence[Camera],
    raster: Raster,
    origin: Origin,
    centers: Tensor,
    center_sigma: Tensor,
    *,
    error: RasterError | None = None,
) -> tuple[SkylineSource, list[SkylineAttitude]]:
    """What skylines tell of a rig: the attitude of each camera on the Earth, in one Gaussian for all images.

    Images of one camera at several times average the noise of the image; the errors of the raster and of refraction
    stay as they are, and are shared by cameras that look at the same terrain.

    Args:
        images: of one or more cameras.
        cameras: of the rig.
        raster: heights above the ellipsoid, from `kcal.locate.terrain`.
        origin: of the rig's frame.
        centers: (C, 3) meters, where the cameras were measured, in that frame; anything for those without images.
        center_sigma: (C, 3) meters.
        error: of the raster and of refraction.

    Returns:
        what `solve_rig` takes, and the attitude from each image alone.

    Raises:
        InputError: no images; what `skyline_attitude` refuses, with the image's name; images of one camera that
            contradict each other.
        DegenerateError: likewise.

    Example:
        >>> camera = Camera.build(focal=(300, 300), center=(159.5, 99.5), size=(320, 200), model="pinhole")
        >>> here, place = Origin(lat=47.0, lon=11.0, height=600.0), torch.zeros(1, 3)
        >>> skyline_source([], [camera], None, here, place, place + 1.0)
        Traceback (most recent call last):
        kcal.errors.InputError: skyline: no images
    """
    error = error or RasterError()
    if not images:
        raise InputError("skyline: no images")
    eyes = {c: _eye(origin, centers[c]) for c in sorted({image.camera for image in images})}
    around = {c: functools.cache(functools.partial(horizon_around, raster, eye, error)) for c, eye in eyes.items()}
    found = []
    for image in images:
        c, (east, north, up) = image.camera, center_sigma[image.camera].tolist()
        try:
            found.append(
                attitude_against(around[c], image.image, cameras[c], eyes[c], raster, (east, north, up), error)
            )
        except InputError as problem:
            raise type(problem)(f"{image.name}: {problem}") from problem
    return _joined(images, found, cameras, origin, eyes, centers, center_sigma, error), found


def _eye(origin: Origin, center: Tensor) -> Origin:
    lat, lon, height = enu_to_geodetic(center[None].double(), origin)[0].tolist()
    return Origin(lat=lat, lon=lon, height=height)


def _joined(
    images: Sequence[SkylineImage], found: Sequence[SkylineAttitude], cameras: Sequence[Camera], origin: Origin,
    eyes: dict[int, Origin], centers: Tensor, center_sigma: Tensor, error: RasterError,
) -> SkylineSource:  # fmt: skip
    """All images in the rig's frame, whitened together, and in as few rows as there are unknowns."""
    count, sizes = len(cameras), [camera.params.shape[-1] for camera in cameras]
    rotation, center = torch.full((count, 3, 3), math.nan).double(), torch.full((count, 3), math.nan).double()
    world_from_eye = {c: _world_from_eye(origin, eye) for c, eye in eyes.items()}
    rows, residual, widened, image_of, seen_of = [], [], [], [], []
    begin = np.cumsum([6 * count, *sizes])
    for number, (image, one) in enumerate(zip(images, found, strict=True)):
        c, seen, turn = image.camera, one.fit.binned, world_from_eye[image.camera]
        here = torch.from_numpy(one.rotation @ turn.T)
        if not bool(torch.isfinite(rotation[c]).all()):
            rotation[c], center[c] = here, centers[c]
        part = np.zeros((len(seen.residual), int(begin[-1])))
        part[:, 3 * c : 3 * c + 3] = seen.by_turn
        part[:, 3 * (count + c) : 3 * (count + c) + 3] = seen.by_shift @ turn.T
        part[:, begin[c] : begin[c + 1]] = seen.by_lens
        # At the attitude of the camera's first image.
        off = _vector((rotation[c] @ here.T).numpy())
        rows.append(part)
        residual.append(seen.residual + seen.by_turn @ off)
        widened += len(part) * [one.widened]
        image_of += len(part) * [number]
        seen_of.append(dataclasses.replace(seen, point=seen.point @ turn.T + centers[c].numpy()))
    together, number_of, times = Comparison.together(seen_of), np.array(image_of), np.array(widened)
    covariance = np.diag(np.square(together.sigma)) + COMMON**2 * (number_of[:, None] == number_of)
    covariance += sum(terrain_covariances(together, error, mean_radius(origin.lat)).values())
    root = np.linalg.cholesky(covariance * times[:, None] * times)
    white = np.linalg.solve(root, np.column_stack([np.concatenate(rows), np.concatenate(residual)]))
    # Only what moves by turns, and by what is not known of places and lenses, is kept: the rest says how well the
    # skylines fit, which each image has told.
    moves = [white[:, : 3 * count], white[:, 3 * count : 6 * count] * center_sigma.numpy().reshape(-1)]
    moves += [white[:, a:b] @ lens_errors(camera) for camera, a, b in zip(cameras, begin[:-1], begin[1:], strict=True)]
    basis, size, _ = np.linalg.svd(np.column_stack(moves), full_matrices=False)
    compact = basis[:, size > _TELLS].T @ white
    return SkylineSource(
        cameras=tuple(image.camera for image in images),
        names=tuple(image.name for image in images),
        rotation=rotation,
        center=center,
        parameters=tuple(camera.params.detach() for camera in cameras),
        rows=torch.from_numpy(compact[:, :-1].copy()),
        residual=torch.from_numpy(compact[:, -1].copy()),
        columns=tuple(int(one.used.sum()) for one in found),
        rms_px=tuple(float(np.sqrt(np.mean(np.square(one.fit.binned.residual)))) for one in found),
        sigmas=tuple(math.sqrt(one.fit.chi2 / max(one.fit.freedom, 1)) for one in found),
    )


def _world_from_eye(origin: Origin, eye: Origin) -> Floats:
    """(3, 3) from east, north, up of an eye to those of the rig's origin."""
    world, own = (ecef_from_enu_rotation(place.lat, place.lon).numpy() for place in (origin, eye))
    found: Floats = world.T @ own
    return found


def _vector(rotation: Floats) -> Floats:
    """Rotation vector of a small rotation."""
    found: Floats = vector_from_rotation(torch.from_numpy(np.ascontiguousarray(rotation))).numpy()
    return found
