from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pyproj
import pytest

from kcal.errors import FileError, InputError
from kcal.lens.rig import Origin
from kcal.locate.tabulate import find_geoid, geoid_column, true_from_grid


def grid(path: Path) -> Path:
    """A .gtx file of one degree around 19° N, 73° E: N = -60 m + 10 m for each degree east."""
    header = struct.pack(">4d2i", 18.0, 72.0, 1.0, 1.0, 3, 3)
    rows = [[-70.0, -60.0, -50.0]] * 3
    path.write_bytes(header + b"".join(struct.pack(">3f", *row) for row in rows))
    return path


def test_heights_of_a_grid_and_outside_of_it(tmp_path: Path) -> None:
    geoid = find_geoid(grid(tmp_path / "here.gtx"))
    assert geoid is not None
    assert geoid.name == "here"
    heights = geoid_column(geoid, np.array([19.0, 18.5, 50.0]), np.array([73.0, 72.25, 8.0]))
    assert heights[:2] == pytest.approx([-60.0, -67.5], abs=1e-6)
    assert np.isnan(heights[2])


def test_no_grid_and_bad_grids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pyproj.datadir, "get_data_dir", lambda: str(tmp_path))
    monkeypatch.setattr(pyproj.datadir, "get_user_data_dir", lambda *_: str(tmp_path / "none"))
    assert find_geoid() is None
    found = grid(tmp_path / "egm96_15.gtx")
    assert find_geoid() == (found, "egm96_15")
    (tmp_path / "bad.gtx").write_bytes(b"no grid")
    with pytest.raises(FileError, match="cannot read this geoid grid"):
        geoid_column(find_geoid(tmp_path / "bad.gtx"), np.array([19.0]), np.array([73.0]))
    (tmp_path / "grid.txt").write_text("")
    with pytest.raises(FileError, match=r"ends with \.tif"):
        find_geoid(tmp_path / "grid.txt")


def test_grid_north_is_not_true_north() -> None:
    # Mumbai lies west of its zone's central meridian: grid north points west of true north there, by 0.70°.
    mumbai = Origin(lat=19.07, lon=72.87, height=14.0)
    assert true_from_grid(90.0, mumbai, "EPSG:32643") == pytest.approx(89.304, abs=1e-3)
    # Independent of PROJ's factors: the grid azimuth of a short step due north.
    project = pyproj.Proj("EPSG:32643")
    (e0, n0), (e1, n1) = project(72.87, 19.07), project(72.87, 19.0701)
    assert (e1 - e0) / (n1 - n0) == pytest.approx(0.01215, abs=1e-5)
    assert true_from_grid(12.0, Origin(lat=19.07, lon=75.0, height=0.0), "EPSG:32643") == pytest.approx(12.0, abs=1e-9)


@pytest.mark.parametrize(("crs", "message"), [("EPSG:4326", "has no grid"), ("nonsense", "does not know")])
def test_what_has_no_grid_north(crs: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        true_from_grid(0.0, Origin(lat=19.0, lon=73.0, height=0.0), crs)
