"""All headings in which a border of sky and ground could fit the horizon of a terrain, without any rough pose."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.skyline.horizon import Horizon
from kcal.skyline.raster_error import SkylineErrors
from kcal.skyline.seen_horizon import Columns, Comparison, compare

Floats = NDArray[np.float64]

# Columns that are compared with every heading, and rounds in which those that do not fit lose their weight.
_COLUMNS, _ROUNDS = 160, 4
# Radians: how far from level a camera is held, one sigma, and how much a horizon differs from a plane.
_LEVEL, _HILLY = math.radians(10.0), math.radians(2.0)
# Radians: of the difference from a horizon that counts fully, so that some trees do not hide the right heading.
_ROUGH = math.radians(0.08)
# χ² of a column at most, in the search and in the comparison of headings: three sigmas.
_MOST = 9.0
# Headings that are adjusted, and how far apart they are.
_TRIED, _APART = 8, math.radians(1.0)
# Least share of columns in whose azimuths the raster has a horizon.
_REACHED = 0.5
_STEPS = 12


class Candidate(NamedTuple):
    """An attitude that fits roughly.

    Attributes:
        rotation: (3, 3) camera from east, north, up.
        cost: χ² of the columns, each at most nine, those that share an error of the raster counting once.
    """

    rotation: Floats
    cost: float

    @property
    def heading(self) -> float:
        """Degrees clockwise from north."""
        return math.degrees(math.atan2(self.rotation[2, 0], self.rotation[2, 1])) % 360.0


def candidates(
    columns: Columns, horizon: Horizon, camera: Camera, errors: SkylineErrors, near: tuple[float, float] | None = None
) -> list[Candidate]:
    """Attitudes that fit, the best first.

    Args:
        columns: of the border.
        horizon: all around, in equal steps of azimuth.
        camera: which lens.
        errors: of raster and place.
        near: heading and the most it is off, degrees, if it is known roughly.

    Raises:
        InputError: the raster has no horizon in half of the columns, whichever the heading.
    """
    some = columns.some(np.unique(np.linspace(0, len(columns.pixel) - 1, _COLUMNS).round().astype(int)))
    leveled = _leveled(some.ray)
    ray = some.ray @ leveled.T
    off, elevation = np.arctan2(ray[:, 0], ray[:, 1]), np.arcsin(ray[:, 2])
    cost, tilt = _search_headings(off, elevation, horizon)
    if near is not None:
        away = np.degrees(horizon.azimuth) - near[0]
        cost = np.where(np.abs((away + 180.0) % 360.0 - 180.0) <= near[1], cost, np.inf)
    if not np.isfinite(cost).any():
        raise InputError(
            "the raster has no horizon for half of the image's skyline in any heading: it ends before the terrain "
            f"falls away, {_reach_text(horizon)} from the camera, or has cells without a height; give one that reaches "
            "beyond the hills that are seen"
        )
    found = []
    for number in _minima(cost, horizon.azimuth):
        psi = horizon.azimuth[number]
        turned = np.array([[math.cos(psi), math.sin(psi), 0.0], [-math.sin(psi), math.cos(psi), 0.0], [0.0, 0.0, 1.0]])
        # A horizon that stands higher by p ahead and q on the right: the camera looks up by p and is rolled by q.
        p, q = tilt[number]
        tilted = rotation_by(np.array([p, -q, 0.0])) @ leveled
        found.append(_adjusted(some, horizon, (turned @ tilted).T, camera, errors))
    return sorted(found, key=lambda one: one.cost)


def _reach_text(horizon: Horizon) -> str:
    low, high = horizon.reach.min() / 1000.0, horizon.reach.max() / 1000.0
    return f"{low:.1f} km" if high < 1.1 * low else f"{low:.1f} to {high:.1f} km"


def _leveled(ray: Floats) -> Floats:
    """(3, 3) level axes (right, ahead, up) from the camera's: skylines are nearly level, and so are cameras."""
    prior = np.array([0.0, -1.0, 0.0])
    rows = np.concatenate([ray / _HILLY / math.sqrt(len(ray) / 10.0), np.eye(3) / _LEVEL])
    up = np.linalg.lstsq(rows, np.concatenate([np.zeros(len(ray)), prior / _LEVEL]), rcond=None)[0]
    up = up / np.linalg.norm(up)
    ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def _search_headings(off: Floats, elevation: Floats, horizon: Horizon) -> tuple[Floats, Floats]:
    """Cost (A,) of each heading, and how the camera is tilted then (A, 2)."""
    step = horizon.azimuth[1] - horizon.azimuth[0]
    count = len(horizon.azimuth)
    index = (np.arange(count)[:, None] + np.rint(off / step).astype(int)) % count
    known = horizon.known[index]
    difference = np.where(known, np.where(horizon.known, horizon.elevation, 0.0)[index] - elevation, 0.0)
    rows = np.stack([np.cos(off), np.sin(off)], -1)
    products = (rows[:, :, None] * rows[:, None]).reshape(-1, 4)
    weight = known.astype(np.float64)
    for _ in range(_ROUNDS):
        normal = (weight @ products).reshape(-1, 2, 2) + np.eye(2) * (_ROUGH / _LEVEL) ** 2
        tilt = np.linalg.solve(normal, ((weight * difference) @ rows)[..., None])[..., 0]
        left = difference - tilt @ rows.T
        spread = np.maximum(1.5 * np.median(np.abs(left), axis=1, keepdims=True), _ROUGH)
        weight = known / (1.0 + np.square(left / spread))
    square = np.minimum(np.square(left / _ROUGH), _MOST)
    used = known.sum(1)
    cost = np.where(used >= _REACHED * len(off), (square * known).sum(1) / np.maximum(used, 1), np.inf)
    return cost, tilt


def _minima(cost: Floats, azimuth: Floats) -> list[int]:
    """The best headings, some way apart."""
    found: list[int] = []
    for number in np.argsort(cost, kind="stable"):
        if not math.isfinite(cost[number]) or len(found) == _TRIED:
            break
        apart = np.abs((azimuth[found] - azimuth[number] + math.pi) % (2.0 * math.pi) - math.pi)
        if not found or apart.min() > _APART:
            found.append(int(number))
    return found


def _adjusted(columns: Columns, horizon: Horizon, rotation: Floats, camera: Camera, errors: SkylineErrors) -> Candidate:
    """An attitude after some robust steps, all columns counting by what they tell alone."""
    for _ in range(_STEPS):
        seen = compare(columns, horizon, rotation, camera)
        sigma = column_sigma(seen, errors)
        rough = sigma + np.abs(seen.by_elevation) * _ROUGH * 0.25
        weight = seen.known / np.square(rough) / np.square(1.0 + np.square(seen.residual / (3.0 * rough)))
        rotation, size = turned_to(seen, weight, rotation, 0.05)
        if size < 1e-8:
            break
    return Candidate(rotation, column_cost(compare(columns, horizon, rotation, camera), errors, columns))


def turned_to(seen: Comparison, weight: Floats, rotation: Floats, most: float) -> tuple[Floats, float]:
    """A rotation after one step of weighted least squares, no longer than `most` radians, and how far it would go."""
    normal = np.einsum("n,ni,nj->ij", weight, seen.by_turn, seen.by_turn)
    turn = -np.linalg.lstsq(normal, np.einsum("n,ni,n->i", weight, seen.by_turn, seen.residual), rcond=None)[0]
    size = float(np.linalg.norm(turn))
    return rotation_by(turn * min(1.0, most / max(size, 1e-12))) @ rotation, size


def column_sigma(seen: Comparison, errors: SkylineErrors) -> Floats:
    """(N,) px, of each column alone: noise of the image, errors of the raster and of the camera's place."""
    height = seen.by_height() * np.hypot(errors.raster.sigma, errors.raster.offset)
    place = np.linalg.norm(seen.by_shift * errors.place, axis=1)
    found: Floats = np.sqrt(np.square(seen.sigma) + np.square(height) + np.square(place))
    return found


def column_cost(seen: Comparison, errors: SkylineErrors, columns: Columns) -> float:
    """χ² of the columns, each at most nine, those that share an error of the raster counting once."""
    # Unknown columns say nothing for a heading, and so they count like ones that do not fit.
    square = np.where(seen.known, np.square(seen.residual / column_sigma(seen, errors)), _MOST)
    heading = columns.ray[1:] * columns.ray[:-1]
    spacing = np.arccos(np.clip(heading.sum(1), -1.0, 1.0))
    alike = errors.raster.alike(seen.distance, np.append(spacing, np.median(spacing)))
    return float((np.minimum(square, _MOST) / alike).sum())


def rotation_by(vector: Floats) -> Floats:
    """(3, 3) by a rotation vector (3,)."""
    found: Floats = rotation_from_vector(torch.from_numpy(vector)).numpy()
    return found
