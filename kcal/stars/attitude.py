"""How a camera looks, from the named stars of one image: rotation, residuals of every star, and covariance."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector, step_rows
from kcal.lens.projection import project_components

Floats = NDArray[np.float64]

# m: so far away a camera sees stars; entrance pupils do not matter there.
FAR = 1e9
# A star is left out if its residual is more than so many times its sigma, which is widened where all are.
_CUT = 5.0
# px: stars are named within this distance first, while attitude and lens are rough.
_ROUGH = 4.0
# px: the sigma of the most disturbed star that is still worth naming.
_LEAST_REACH = 1.0
# Standard deviations by which refraction must differ from that of place and time, and px by which a good lens errs.
_SURE, _LENS = 5.0, 0.04
# px: another star of the catalogue that is nearer, and not fainter by more magnitudes, pulls a star's center.
_CROWDED, _FAINTER = 6.0, 2.5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Attitude:
    """How a camera stands among the stars.

    Args:
        rotation: (3, 3) camera from the frame of the directions.
        covariance: (3, 3) of a small turn of the camera about the axes of that frame, rad², from noise of the marks.
        star: (N,) index in the catalogue of each star of the image; -1 for stars without a name or left out.
        residual: (N, 2) projected minus seen, px; NaN for those.
        rms_px: root of the mean squared residual along an axis.
        widened: by how much residuals are larger than their sigmas say, at least 1; the covariance has it.
    """

    rotation: Tensor
    covariance: Tensor
    star: NDArray[np.int64]
    residual: Floats
    rms_px: float
    widened: float

    @property
    def count(self) -> int:
        """How many stars are named and used."""
        return int((self.star >= 0).sum())


def star_rows(directions: Tensor, rotation: Tensor, camera: Camera, parameters: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (2, N) of directions (N, 3), NaN where there are none, and (3, 2, N) their derivatives by a turn.

    The turn is about the camera's axes and comes after the rotation.
    """
    points = FAR * (rotation @ directions.T)
    seen = project_components(points, parameters, camera.model, ())
    rows = step_rows(seen.by_point, points)[:3]
    return torch.where(seen.regular, seen.pixels, torch.nan), rows


def fit_attitude(
    pixels: Floats, sigma: Floats, directions: Floats, magnitude: Floats, camera: Camera, rotation: Floats
) -> Attitude | None:
    """Name all stars of an image from a first attitude, and fit the attitude to them.

    Args:
        pixels: (N, 2) stars of the image.
        sigma: (N,) of each along an axis, px.
        directions: (M, 3) unit vectors of the catalogue, in any frame.
        magnitude: (M,).
        camera: which lens.
        rotation: (3, 3) camera from that frame, to begin with.

    Returns:
        None if fewer than three stars have a name.
    """
    turn = torch.from_numpy(np.ascontiguousarray(rotation))
    parameters = camera.params.detach()
    everywhere = torch.from_numpy(directions)
    star, reach = np.full(len(pixels), -1), np.full(len(pixels), _ROUGH)
    least = math.cos(min(_half_field(camera) + 0.01, math.pi))
    weights, target = torch.from_numpy(1.0 / sigma), torch.from_numpy(pixels).T
    for attempt in range(12):
        before = star
        star = _names_at(pixels, reach, everywhere, magnitude, camera, turn, least)
        known = torch.from_numpy(star >= 0)
        if int(known.sum()) < 3:
            return None
        for _ in range(3):
            seen, rows = star_rows(everywhere[star[star >= 0]], turn, camera, parameters)
            error = seen - target[:, known]
            white = (rows * weights[known]).flatten(1)
            step = -torch.linalg.lstsq(white.T, (error * weights[known]).flatten()[:, None]).solution[:, 0]
            turn = rotation_from_vector(step) @ turn
            if float(step.norm()) < 1e-10:
                break
        scale = max(float((error.norm(dim=0) * weights[known]).median()) / 1.18, 1.0)
        reach = np.maximum(_CUT * scale * sigma, min(_LEAST_REACH, _CUT * scale * float(np.median(sigma))))
        if attempt > 1 and np.array_equal(before, star):
            break
    seen, rows = star_rows(everywhere[star[star >= 0]], turn, camera, parameters)
    off = (seen - target[:, known]).T.numpy()
    residual = np.full(pixels.shape, np.nan)
    residual[star >= 0] = off
    freedom = max(2 * len(off) - 3, 1)
    chi2 = float(((off / sigma[star >= 0, None]) ** 2).sum())
    widened = max(math.sqrt(chi2 / freedom), 1.0)
    white = (rows * weights[known]).flatten(1)
    own = torch.linalg.inv(white @ white.T) * widened**2
    return Attitude(
        rotation=turn,
        covariance=turn.T @ own @ turn,
        star=star,
        residual=residual,
        rms_px=float(np.sqrt((off**2).mean())),
        widened=widened,
    )


def refraction_doubt(seen: Attitude, sigma: Floats, refracted: Tensor, straight: Tensor, camera: Camera) -> str | None:
    """Whether stars are refracted as they would be at the place and time that were given; None if they are.

    Args:
        seen: the attitude on the Earth, with its N named stars.
        sigma: (N,) of these, px.
        refracted: (N, 3) directions in which they would be seen there and then.
        straight: (N, 3) likewise without air.
        camera: which lens.
    """
    at, rows = star_rows(refracted, seen.rotation, camera, camera.params.detach())
    without, _ = star_rows(straight, seen.rotation, camera, camera.params.detach())
    weight = torch.from_numpy(1.0 / sigma) / seen.widened
    pattern = (at - without) * weight
    turns = (rows * weight).flatten(1)
    own = pattern.flatten() - turns.T @ torch.linalg.lstsq(turns.T, pattern.flatten()[:, None]).solution[:, 0]
    residual = torch.from_numpy(seen.residual[seen.star >= 0]).T * weight
    length = float(own.norm())
    if length == 0.0:
        return None
    # The residual is projected minus seen: seen refraction is (1 - excess) of what was assumed.
    excess = float(own @ residual.flatten()) / length**2
    moved = abs(excess) * float((own.reshape(2, -1) / weight).square().mean().sqrt())
    if abs(excess) * length < _SURE or moved < _LENS:
        return None
    return (
        f"refraction is {1.0 - excess:.2f} ± {1.0 / length:.2f} times what it would be there and then: the stars stand "
        f"{'lower' if excess < 0 else 'higher'} than place and time say; one of them is wrong, or the lens"
    )


def _names_at(
    pixels: Floats,
    reach: Floats,
    directions: Tensor,
    magnitude: Floats,
    camera: Camera,
    rotation: Tensor,
    least: float,
) -> NDArray[np.int64]:
    """(N,) the star of the catalogue at each pixel; -1 for none, or where another star pulls it.

    Stars whose cosine from the optical axis is at least `least` may be in the image.
    """
    ahead = np.flatnonzero((directions @ rotation[2] > least).numpy())
    seen, valid = camera.project(FAR * (directions[ahead] @ rotation.T))
    ahead, places = ahead[valid.numpy()], seen[valid].numpy()
    star = np.full(len(pixels), -1)
    if not len(ahead):
        return star
    tree = cKDTree(places)
    distance, nearest = tree.query(pixels)
    back = cKDTree(pixels).query(places)[1]
    pairs = tree.query_pairs(_CROWDED, output_type="ndarray")
    alone = np.ones(len(ahead), bool)
    for first, second in ((pairs[:, 0], pairs[:, 1]), (pairs[:, 1], pairs[:, 0])):
        alone[first[magnitude[ahead[second]] < magnitude[ahead[first]] + _FAINTER]] = False
    good = (distance < reach) & (back[nearest] == np.arange(len(pixels))) & alone[nearest]
    star[good] = ahead[nearest[good]]
    return star


def field_angle(camera: Camera) -> float:
    """Radians between the directions of opposite corners of the image, by the camera itself."""
    return 2.0 * _half_field(camera)


def _half_field(camera: Camera) -> float:
    width, height = camera.size
    across, down = (width - 1.0) / 8, (height - 1.0) / 8
    border = [(i * across, j * down) for i in range(9) for j in range(9) if i in (0, 8) or j in (0, 8)]
    rays, valid = camera.unproject(torch.tensor(border, dtype=torch.float64))
    if not bool(valid.any()):
        rays, valid = camera.unproject(camera.grid(9, 9).reshape(-1, 2))
    rays = rays[valid] / rays[valid].norm(dim=-1, keepdim=True)
    return min(float(torch.arccos(rays[:, 2].clamp(-1, 1)).max()), math.pi)
