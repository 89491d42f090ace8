"""What depends on grids and map projections: height above the sea, and grid north. Through PROJ, outside any graph."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj.exceptions import ProjError

from kcal.errors import FileError, InputError
from kcal.lens.mounting import Origin

# Global geoid grids by the names PROJ gives them, the finer first.
_KNOWN_GRIDS = ("us_nga_egm08_25.tif", "egm08_25.gtx", "us_nga_egm96_15.tif", "egm96_15.gtx")
_SUFFIXES = (".tif", ".tiff", ".gtx", ".byn")


class Geoid(NamedTuple):
    """A geoid grid: the file, and the name under which results state it."""

    path: Path
    name: str


def find_geoid(path: str | Path | None = None) -> Geoid | None:
    """The geoid grid to use: the file given, or one that PROJ finds on this machine, or None; nothing is downloaded.

    Args:
        path: a grid that PROJ reads (.tif, .gtx, .byn), for example `us_nga_egm08_25.tif` from cdn.proj.org.

    Raises:
        FileError: a file was given and is not there, or is no grid.

    Example:
        >>> find_geoid("no-such-grid.gtx")
        Traceback (most recent call last):
        kcal.errors.FileError: no-such-grid.gtx: no such geoid grid
    """
    if path is not None:
        path = Path(path)
        if not path.is_file():
            raise FileError(f"{path}: no such geoid grid")
        if path.suffix.lower() not in _SUFFIXES:
            raise FileError(f"{path}: a geoid grid ends with {', '.join(_SUFFIXES)}")
        return Geoid(path, path.stem)
    folders = [*pyproj.datadir.get_data_dir().split(os.pathsep), pyproj.datadir.get_user_data_dir()]
    for name in _KNOWN_GRIDS:
        for folder in folders:
            if (found := Path(folder, name)).is_file():
                return Geoid(found, found.stem)
    return None


def geoid_column(geoid: Geoid, lat: NDArray[np.float64], lon: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height (N,) of the geoid above the WGS84 ellipsoid, meters; NaN outside the grid.

    Height above the geoid, which is close to height above mean sea level, is ellipsoidal height minus this.

    Args:
        geoid: the grid.
        lat: (N,) degrees.
        lon: (N,) degrees.

    Raises:
        FileError: PROJ cannot read the grid.
    """
    try:
        shift = pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f'+step +proj=vgridshift +multiplier=1 +grids="{geoid.path.resolve()}" '
            "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
        # Above the geoid 0 m is above the ellipsoid N m.
        heights = shift.transform(lon, lat, np.zeros(len(lon)))[2]
    except ProjError as error:
        raise FileError(f"{geoid.path}: PROJ cannot read this geoid grid: {error}") from error
    return np.where(np.isfinite(heights), heights, np.nan)


def true_from_grid(grid_heading_deg: float, origin: Origin, crs: str) -> float:
    """Heading from true north of a heading measured from a map's grid north.

    Grid north and true north differ by the meridian convergence, up to 3° in UTM: 61 m at 5 km for each 0.7°.

    Args:
        grid_heading_deg: clockwise from grid north.
        origin: where it was measured.
        crs: the map's projected coordinate system, for example `"EPSG:32643"` (UTM zone 43 north).

    Raises:
        InputError: not a projected coordinate system, or the place lies outside of it.

    Example:
        >>> mumbai = Origin(lat=19.07, lon=72.87, height=14.0)
        >>> round(true_from_grid(0.0, mumbai, "EPSG:32643"), 3)
        -0.696
    """
    try:
        system = pyproj.CRS.from_user_input(crs)
    except ProjError as error:
        raise InputError(f"{crs}: PROJ does not know this coordinate system; write for example EPSG:32643") from error
    if not system.is_projected:
        raise InputError(f"{crs}: {system.name} has no grid; a projected system such as EPSG:32643 is needed")
    try:
        # The azimuth of grid north from true north.
        grid_north = pyproj.Proj(system).get_factors(origin.lon, origin.lat, errcheck=True).meridian_convergence
    except ProjError as error:
        raise InputError(f"{crs}: {system.name} does not reach {origin.lat:g}, {origin.lon:g}") from error
    return float(grid_heading_deg + grid_north)
