"""The bright stars: positions, proper motions and magnitudes, and names for the brightest.

The catalogue in the package is the Yale Bright Star Catalogue, 5th revised edition (D. Hoffleit and W. H. Warren Jr.,
1991, Astronomical Data Center; CDS V/50): 9,096 stars to magnitude 6.5 and some fainter ones, with positions good to
about 1 second of arc. It is a compilation of facts that is distributed without a license text.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.files import read_bytes
from kcal.texts import brief

PACKED_FILE = Path(__file__).with_name("bright_stars.bin")
# Angles are 2**-32 of a turn, proper motions milliarcseconds a year (in right ascension times cos δ).
PACKED = np.dtype([
    ("number", "<u2"), ("ra", "<i4"), ("dec", "<i4"), ("pm_ra", "<i2"), ("pm_dec", "<i2"), ("magnitude", "<i2"),
])  # fmt: skip
# Proper motions are linear only for so long: outside, fast and near stars leave their places by seconds of arc.
FIRST_YEAR, LAST_YEAR = 1900.0, 2100.0
_TURN = 2.0 * np.pi / 2**32
_MILLIARCSECOND = np.pi / 180 / 3_600_000

# Names by the International Astronomical Union's catalog of star names, by Harvard Revised number.
_NAMES = {
    15: "Alpheratz", 21: "Caph", 168: "Schedar", 188: "Diphda", 337: "Mirach", 424: "Polaris", 472: "Achernar",
    603: "Almach", 617: "Hamal", 936: "Algol", 1017: "Mirfak", 1457: "Aldebaran", 1708: "Capella", 1713: "Rigel",
    1790: "Bellatrix", 1791: "Elnath", 1852: "Mintaka", 1903: "Alnilam", 1948: "Alnitak", 2061: "Betelgeuse",
    2088: "Menkalinan", 2294: "Mirzam", 2326: "Canopus", 2421: "Alhena", 2491: "Sirius", 2618: "Adhara", 2693: "Wezen",
    2891: "Castor", 2943: "Procyon", 2990: "Pollux", 3307: "Avior", 3685: "Miaplacidus", 3748: "Alphard",
    3982: "Regulus", 4295: "Merak", 4301: "Dubhe", 4534: "Denebola", 4554: "Phecda", 4660: "Megrez", 4730: "Acrux",
    4763: "Gacrux", 4853: "Mimosa", 4905: "Alioth", 5054: "Mizar", 5056: "Spica", 5191: "Alkaid", 5267: "Hadar",
    5340: "Arcturus", 5459: "Rigil Kentaurus", 5460: "Toliman", 5563: "Kochab", 5793: "Alphecca", 6134: "Antares",
    6217: "Atria", 6527: "Shaula", 6553: "Sargas", 6556: "Rasalhague", 6705: "Eltanin", 6879: "Kaus Australis",
    7001: "Vega", 7121: "Nunki", 7417: "Albireo", 7557: "Altair", 7790: "Peacock", 7796: "Sadr", 7924: "Deneb",
    8162: "Alderamin", 8308: "Enif", 8425: "Alnair", 8728: "Fomalhaut", 8775: "Scheat", 8781: "Markab",
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarCatalog:
    """Stars by number: places at J2000 in the International Celestial Reference System, motions and magnitudes.

    Args:
        number: (N,) of the star in its catalogue; Harvard Revised (HR) in the one that kcal brings along.
        ra: (N,) right ascension, radians.
        dec: (N,) declination, radians.
        pm_ra: (N,) proper motion in right ascension times cos δ, radians a year.
        pm_dec: (N,) proper motion in declination, radians a year.
        magnitude: (N,) visual.

    Raises:
        InputError: arrays of other shapes, values that are not finite, or a declination beyond ±90°.

    Example:
        >>> stars = StarCatalog.bundled()
        >>> len(stars), stars.name_of(2491), round(float(stars.magnitude.min()), 2)
        (9096, 'Sirius', -1.46)
    """

    __repr__ = brief

    number: NDArray[np.int64]
    ra: NDArray[np.float64]
    dec: NDArray[np.float64]
    pm_ra: NDArray[np.float64]
    pm_dec: NDArray[np.float64]
    magnitude: NDArray[np.float64]

    def __post_init__(self) -> None:
        columns = [self.ra, self.dec, self.pm_ra, self.pm_dec, self.magnitude]
        if any(column.shape != self.number.shape or column.ndim != 1 for column in columns):
            raise InputError("star catalogue: six arrays of the same shape (N,) are needed")
        if not all(np.isfinite(column).all() for column in columns) or (np.abs(self.dec) > np.pi / 2).any():
            raise InputError("star catalogue: a value is not finite, or a declination is beyond 90 degrees")

    def __len__(self) -> int:
        """How many stars there are."""
        return len(self.number)

    @staticmethod
    @functools.cache
    def bundled() -> StarCatalog:
        """The Yale Bright Star Catalogue, which is part of kcal: 9,096 stars."""
        table = np.frombuffer(read_bytes(PACKED_FILE), PACKED)
        ra, dec = (table[name].astype(np.float64) * _TURN for name in ("ra", "dec"))
        return StarCatalog(
            number=table["number"].astype(np.int64),
            ra=ra % (2 * np.pi),
            dec=dec,
            pm_ra=table["pm_ra"] * _MILLIARCSECOND,
            pm_dec=table["pm_dec"] * _MILLIARCSECOND,
            magnitude=table["magnitude"] / 100.0,
        )

    def name_of(self, number: int) -> str:
        """A star's proper name, where it has a well known one, otherwise `HR 1234`."""
        return _NAMES.get(int(number), f"HR {int(number)}")

    def directions(self, year: float = 2000.0) -> NDArray[np.float64]:
        """(N, 3) unit vectors in the celestial frame, with proper motion to `year`, without aberration.

        Raises:
            InputError: a year for which proper motions are not linear any more.
        """
        if not FIRST_YEAR <= year <= LAST_YEAR:
            raise InputError(f"star catalogue: the year {year:.0f} is outside {FIRST_YEAR:.0f} to {LAST_YEAR:.0f}")
        time, cos = year - 2000.0, np.cos(self.dec)
        ra, dec = self.ra + time * self.pm_ra / np.maximum(cos, 1e-9), self.dec + time * self.pm_dec
        return unit_vectors(ra, dec)


def unit_vectors(longitude: NDArray[np.float64], latitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) from angles in radians.

    Example:
        >>> unit_vectors(np.array([np.pi / 2]), np.array([0.0])).round(12).tolist()
        [[0.0, 1.0, 0.0]]
    """
    cos = np.cos(latitude)
    return np.stack([np.cos(longitude) * cos, np.sin(longitude) * cos, np.sin(latitude)], -1)
