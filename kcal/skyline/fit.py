"""Fit a camera's rotation to a skyline by generalized least squares, and say where its variance comes from."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcal.calibrate.rig.prior_information import gathered, joint_unknowns
from kcal.lens.camera import Camera
from kcal.skyline.heading import column_sigma, rotation_by, turned_to
from kcal.skyline.horizon import Horizon
from kcal.skyline.raster_error import RasterError, SkylineErrors
from kcal.skyline.seen_horizon import Columns, Comparison, compare

Floats = NDArray[np.float64]
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
    found: Floats = unknowns.cameras[0][:, unknowns.known].numpy()
    return found


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
    for _ in range(_STEPS):
        binned = _in_bins(columns, compare(columns, horizon, rotation, camera, lens=True), used, camera.size[0])
        parts = covariances(binned, errors)
        # What correlates all columns, a lens and a place, is integrated out with the rest.
        root = np.linalg.cholesky(sum(parts.values(), 1e-12 * np.eye(len(binned.residual))))
        rows = np.linalg.solve(root, np.column_stack([binned.by_turn, binned.residual]))
        gain = np.linalg.lstsq(rows[:, :3], np.linalg.inv(root), rcond=None)[0]
        turn = -gain @ binned.residual
        rotation = rotation_by(turn) @ rotation
        if float(np.linalg.norm(turn)) < 1e-9:
            break
    by_part = {name: gain @ part @ gain.T for name, part in parts.items()}
    left = rows[:, 3] + rows[:, :3] @ turn
    return SkylineFit(
        rotation,
        used,
        below,
        binned,
        sum(by_part.values(), np.zeros((3, 3))),
        by_part,
        float(left @ left),
        len(left) - 3,
    )


def _robust_rotation(
    columns: Columns, horizon: Horizon, rotation: Floats, camera: Camera, errors: SkylineErrors, used: Bools | None
) -> Floats:
    """A rotation after some steps: columns count by what they tell alone, and less the worse they fit."""
    for _ in range(_STEPS):
        seen = compare(columns, horizon, rotation, camera)
        sigma = column_sigma(seen, errors)
        ratio = seen.residual / sigma
        limit = np.where(ratio > 0, _ABOVE, _FAR_BELOW)
        soft = 1.0 / (1.0 + np.square(ratio / limit)) if used is None else used.astype(np.float64)
        weight = seen.known * soft / np.square(sigma)
        # A flat horizon leaves the heading open; no step is longer than a degree.
        rotation, size = turned_to(seen, weight, rotation, math.radians(1.0))
        if size < 1e-8:
            break
    return rotation


def _columns_that_agree(seen: Comparison, errors: SkylineErrors, most_below: float) -> Bools:
    ratio = seen.residual / column_sigma(seen, errors)
    wrong = ~seen.known | (ratio > _ABOVE) | (ratio < -most_below)
    near = np.convolve(wrong, np.ones(2 * _BESIDE + 1), mode="same") > 0
    found: Bools = ~near
    return found


def _in_bins(columns: Columns, seen: Comparison, used: Bools, width: int) -> Comparison:
    """Means of the columns used, in bins of neighbors."""
    each = max(math.ceil(width / _BINS), 1)
    number = (columns.pixel[used, 0] // each).astype(int)
    names, index, count = np.unique(number, return_inverse=True, return_counts=True)

    def mean(values: NDArray[np.generic]) -> Floats:
        some = values[used].astype(np.float64)
        total = np.zeros((len(names), *some.shape[1:]))
        np.add.at(total, index, some)
        found: Floats = total / count.reshape(-1, *[1] * (some.ndim - 1))
        return found

    parts = {field.name: mean(getattr(seen, field.name)) for field in dataclasses.fields(seen)}
    square = mean(np.square(seen.sigma)) * np.minimum(_ALIKE / count, 1.0)
    return Comparison(**{**parts, "sigma": np.sqrt(square), "known": np.ones(len(names), dtype=np.bool_)})
