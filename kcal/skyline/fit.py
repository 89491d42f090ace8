"""Find a camera's heading by a skyline, and fit its rotation."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.calibrate.rig.unknowns import gathered, joint_unknowns
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import fit_turn, rotation_from_vector
from kcal.skyline.horizon import Columns, Comparison, Horizon, RasterError, SkylineErrors, compare

# All headings in which a border of sky and ground could fit the horizon of a terrain, without any rough pose.

Floats = NDArray[np.float64]

# Columns that are compared with every heading, and rounds in which those that do not fit lose their weight.
_COLUMNS, _HEADING_ROUNDS = 160, 4
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
_HEADING_STEPS = 12


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

    def weight(seen: Comparison) -> Floats:
        """Columns count by what they tell alone, and less the worse they fit."""
        rough = column_sigma(seen, errors) + np.abs(seen.by_elevation) * _ROUGH * 0.25
        return seen.known / np.square(rough) / np.square(1.0 + np.square(seen.residual / (3.0 * rough)))

    found = []
    for number in _minima(cost, horizon.azimuth):
        psi = horizon.azimuth[number]
        turned = np.array([[math.cos(psi), math.sin(psi), 0.0], [-math.sin(psi), math.cos(psi), 0.0], [0.0, 0.0, 1.0]])
        # A horizon that stands higher by p ahead and q on the right: the camera looks up by p and is rolled by q.
        p, q = tilt[number]
        tilted = rotation_by(np.array([p, -q, 0.0])) @ leveled
        rotation = _reweighted(some, horizon, (turned @ tilted).T, camera, weight, _HEADING_STEPS, 0.05)
        found.append(Candidate(rotation, column_cost(compare(some, horizon, rotation, camera), errors, some)))
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
    for _ in range(_HEADING_ROUNDS):
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


def _robust_rotation(
    columns: Columns, horizon: Horizon, rotation: Floats, camera: Camera, errors: SkylineErrors, used: Bools | None
) -> Floats:
    """A rotation after some steps: columns count by what they tell alone, and less the worse they fit."""

    def weight(seen: Comparison) -> Floats:
        sigma = column_sigma(seen, errors)
        ratio = seen.residual / sigma
        limit = np.where(ratio > 0, _ABOVE, _FAR_BELOW)
        soft = 1.0 / (1.0 + np.square(ratio / limit)) if used is None else used.astype(np.float64)
        return seen.known * soft / np.square(sigma)

    return _reweighted(columns, horizon, rotation, camera, weight, _STEPS, math.radians(1.0))


def _reweighted(
    columns: Columns, horizon: Horizon, rotation: Floats, camera: Camera, weight: Callable[[Comparison], Floats],
    steps: int, longest: float,
) -> Floats:  # fmt: skip
    """A rotation after some steps of weighted least squares, none longer than so many radians."""

    def look(rotation: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:
        seen = compare(columns, horizon, rotation.numpy(), camera)
        root = np.sqrt(weight(seen))
        return torch.from_numpy(root[:, None] * seen.by_turn), torch.from_numpy(root * seen.residual)

    # A flat horizon leaves the heading open: steps are short.
    return fit_turn(torch.from_numpy(rotation), look, steps=steps, settled=1e-8, longest=longest).rotation.numpy()


def column_sigma(seen: Comparison, errors: SkylineErrors) -> Floats:
    """(N,) px, of each column alone: noise of the image, errors of the raster and of the camera's place."""
    height = seen.by_height() * np.hypot(errors.raster.sigma, errors.raster.offset)
    place = np.linalg.norm(seen.by_shift * errors.place, axis=1)
    return np.sqrt(np.square(seen.sigma) + np.square(height) + np.square(place))


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
    return rotation_from_vector(torch.from_numpy(vector)).numpy()


# Fit a camera's rotation to a skyline by generalized least squares, and say where its variance comes from.

Bools = NDArray[np.bool_]

# Bins into which columns are put, and columns over which errors of a border are alike (rendered hills).
_BINS, _ALIKE = 240, 4.0
# px: what moves a whole border: how a lens blurs it, and what haze and texture do to a step. 0.02 to 0.05 px were seen
# on rendered hills.
COMMON = 0.05
# Sigmas above and below the raster's skyline at which a column is left out. What grows or was built on the terrain
# only adds to it, so that columns below pull in full until they are farther away than trees are high.
_ABOVE, _BELOW, _FAR_BELOW = 3.0, 4.0, 15.0
# Columns beside those left out that go with them.
_BESIDE = 6
_ROUNDS, _STEPS = 12, 4
# Least columns that a fit needs.
_LEAST = 8


class SkylineFit(NamedTuple):
    """A rotation and what it rests on.

    Attributes:
        rotation: (3, 3) the camera's axes from east, north, up.
        used: (N,) which columns agree.
        below: share of the columns in which the image's skyline is below the raster's, which no tree explains.
        binned: the columns that agree, in bins, at this rotation.
        covariance: (3, 3) rad² of a turn about the camera's axes.
        parts: of that covariance by where it comes from.
        chi2: of the bins.
        freedom: its degrees of freedom.
    """

    rotation: Floats
    used: Bools
    below: float
    binned: Comparison
    covariance: Floats
    parts: dict[str, Floats]
    chi2: float
    freedom: int


def lens_errors(camera: Camera) -> Floats:
    """(P, K) changes of a camera's parameters by K independent standard normals; none without a calibration."""
    known = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
    if known is None:
        return np.zeros((camera.params.shape[-1], 0))
    unknowns, _ = joint_unknowns((camera,), gathered((camera,), (known,), None)[0], None)
    return unknowns.cameras[0][:, unknowns.known].numpy()


def terrain_covariances(seen: Comparison, raster: RasterError, radius: float) -> dict[str, Floats]:
    """(M, M) px² of residuals by errors of a raster and of refraction, which images share; over the Earth's radius."""
    height, raised = seen.by_height(), seen.by_elevation * seen.raised
    bent = raster.refraction_sigma * seen.by_refraction(radius)
    heights = raster.heights(seen.point, seen.blunted) * height[:, None] * height
    return {"raster": heights + raised[:, None] * raised, "refraction": bent[:, None] * bent}


def covariances(seen: Comparison, errors: SkylineErrors) -> dict[str, Floats]:
    """(M, M) px² of residuals by where errors come from."""
    shift = seen.by_shift * errors.place
    lens = seen.by_lens @ errors.lens if seen.by_lens.shape[1] else np.zeros((len(shift), 0))
    return {
        "image": np.diag(np.square(seen.sigma)) + COMMON**2,
        **terrain_covariances(seen, errors.raster, errors.radius),
        "position": shift @ shift.T,
        "lens": lens @ lens.T,
    }


def fit_rotation(
    columns: Columns, horizon: Horizon, rotation: Floats, camera: Camera, errors: SkylineErrors
) -> SkylineFit | None:
    """Fit a rotation from a rough one; columns that contradict the others are left out.

    Args:
        columns: clear ones of the border.
        horizon: as the eye sees it.
        rotation: (3, 3) to begin with.
        camera: which lens.
        errors: of everything.

    Returns:
        None if fewer than eight columns agree.
    """
    used = np.ones(len(columns.pixel), dtype=np.bool_)
    for number in range(_ROUNDS):
        rotation = _robust_rotation(columns, horizon, rotation, camera, errors, used if number else None)
        before, used = used, _columns_that_agree(compare(columns, horizon, rotation, camera), errors, _FAR_BELOW)
        if used.sum() < _LEAST:
            return None
        if number and np.array_equal(before, used):
            break
    close = _columns_that_agree(compare(columns, horizon, rotation, camera), errors, _BELOW)
    below, used = float((used & ~close).mean()), close
    if used.sum() < _LEAST:
        return None

    def whitened(rotation: Floats) -> tuple[Comparison, dict[str, Floats], NDArray[np.floating], NDArray[np.floating]]:
        """The columns in bins, their covariance by its parts and its root, and rows with residuals over the root."""
        seen = _in_bins(columns, compare(columns, horizon, rotation, camera, lens=True), used, camera.size[0])
        parts = covariances(seen, errors)
        # What correlates all columns, a lens and a place, is integrated out with the rest.
        root = np.linalg.cholesky(sum(parts.values(), 1e-12 * np.eye(len(seen.residual))))
        return seen, parts, root, np.linalg.solve(root, np.column_stack([seen.by_turn, seen.residual]))

    def look(rotation: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:
        rows = torch.from_numpy(whitened(rotation.numpy())[3])
        return rows[:, :3], rows[:, 3]

    rotation = fit_turn(torch.from_numpy(rotation), look, steps=_STEPS, settled=1e-9).rotation.numpy()
    binned, parts, root, rows = whitened(rotation)
    gain = np.linalg.lstsq(rows[:, :3], np.linalg.inv(root), rcond=None)[0]
    by_part = {name: gain @ part @ gain.T for name, part in parts.items()}
    left = rows[:, 3]
    covariance = sum(by_part.values(), np.zeros((3, 3)))
    return SkylineFit(rotation, used, below, binned, covariance, by_part, float(left @ left), len(left) - 3)


def _columns_that_agree(seen: Comparison, errors: SkylineErrors, most_below: float) -> Bools:
    ratio = seen.residual / column_sigma(seen, errors)
    wrong = ~seen.known | (ratio > _ABOVE) | (ratio < -most_below)
    return ~(np.convolve(wrong, np.ones(2 * _BESIDE + 1), mode="same") > 0)


def _in_bins(columns: Columns, seen: Comparison, used: Bools, width: int) -> Comparison:
    """Means of the columns used, in bins of neighbors."""
    each = max(math.ceil(width / _BINS), 1)
    number = (columns.pixel[used, 0] // each).astype(int)
    names, index, count = np.unique(number, return_inverse=True, return_counts=True)

    def mean(values: NDArray[np.generic]) -> Floats:
        some = values[used].astype(np.float64)
        total = np.zeros((len(names), *some.shape[1:]))
        np.add.at(total, index, some)
        return total / count.reshape(-1, *[1] * (some.ndim - 1))

    parts = {field.name: mean(getattr(seen, field.name)) for field in dataclasses.fields(seen)}
    square = mean(np.square(seen.sigma)) * np.minimum(_ALIKE / count, 1.0)
    return Comparison(**{**parts, "sigma": np.sqrt(square), "known": np.ones(len(names), dtype=np.bool_)})
