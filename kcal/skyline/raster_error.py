"""Errors that a skyline has beside the noise of the image: of the raster's heights, and of light's refraction."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.lens.mounting import REFRACTION, REFRACTION_SIGMA, check_refraction

Floats = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RasterError:
    """How well the heights of a raster, and the bending of light, are known.

    Errors of neighboring heights are alike: with the correlation exp(-d / `correlation`) over the distance d. So
    a hundred columns that look at one ridge are not a hundred measurements of it, and more images do not help.

    Args:
        sigma: meters, of a height. Copernicus GLO-30 states 4 m at 90 % for all its errors, 2.2 m with `offset`.
        correlation: meters.
        offset: meters, of all heights together: datum, geoid, the height of what grows there.
        refraction: coefficient k.
        refraction_sigma: its standard deviation.

    Raises:
        InputError: sigmas that are negative, or a correlation that is not positive.

    Example:
        >>> lidar = RasterError(sigma=0.3, correlation=50.0, offset=0.1)
        >>> lidar.heights(np.array([[0.0, 0, 0], [50.0, 0, 0]])).round(3).tolist()
        [[0.1, 0.043], [0.043, 0.1]]
    """

    sigma: float = 2.0
    correlation: float = 150.0
    offset: float = 1.0
    refraction: float = REFRACTION
    refraction_sigma: float = REFRACTION_SIGMA

    def __post_init__(self) -> None:
        for name in ("sigma", "offset"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InputError(f"raster {name} {getattr(self, name)}: meters, not below 0, are needed")
        if not 0.0 < self.correlation < np.inf:
            raise InputError(f"raster correlation {self.correlation}: a positive number of meters is needed")
        check_refraction(self.refraction, self.refraction_sigma)

    def heights(self, points: Floats, blunted: Floats | float = 0.0) -> Floats:
        """(M, M) m², covariance of the raster's heights at places (M, 3) of one frame, meters.

        With `blunted` (M,) meters, by which cells lower a crest, that is one more standard deviation.
        """
        level = points[:, :2]
        apart = np.hypot(*(level[:, None] - level).transpose(2, 0, 1))
        own = np.hypot(np.broadcast_to(self.sigma, len(points)), blunted)
        found: Floats = own[:, None] * own * np.exp(-apart / self.correlation) + self.offset**2
        return found

    def alike(self, distance: Floats, spacing: Floats) -> Floats:
        """(M,) how many columns share one error of the raster: columns `spacing` radians apart that see `distance`."""
        return np.maximum(2.0 * self.correlation / np.maximum(distance * spacing, 1e-9), 1.0)


class SkylineErrors(NamedTuple):
    """All errors of a skyline but the image's noise.

    Attributes:
        raster: of heights and refraction.
        place: (3,) meters, sigma of the camera's place, east, north, up.
        lens: (P, K) changes of the camera's parameters at one sigma of what its calibration does not know.
        radius: of the Earth, meters.
    """

    raster: RasterError
    place: Floats
    lens: Floats
    radius: float
