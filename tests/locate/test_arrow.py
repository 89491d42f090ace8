"""Results as tables of other libraries, and positions as GeoParquet and GeoPackage, read back by their own readers."""

import io
import json
import math
import sys
from pathlib import Path

import numpy as np
import pandas
import polars
import pyarrow.parquet
import pyogrio
import pytest
import torch
from calibrate_scenes import BOARD, motions, observe, pixels_of

from kcal import Camera, InputError, Localizer, Origin, Rig, calibrate_camera, locate_points
from kcal.locate import Marks, write_positions
from kcal.locate.export import PositionWriter
from kcal.locate.points import PointLocator
from kcal.locate.positions import Located

CAMERA = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
RIG = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
# Located; a parallax below three sigma; lines of sight that diverge.
MARKS = Marks(
    ("mast", "far, = away", "beyond"),
    torch.tensor([[[960.0, 540.0], [944.0, 540.0]], [[960, 540], [959.9, 540]], [[960, 540], [999, 540]]]),
    extras={"class": ["ship", "", "007"]},
)


def located(lon: float = 72.87, rig: Rig | Localizer | None = None) -> Located:
    place = Localizer(RIG.placed(origin=Origin(lat=19.07, lon=lon, height=14.0), heading_deg=90.0))
    return locate_points(rig or place, MARKS)


def test_libraries_of_tables_take_positions_as_they_are() -> None:
    run = located()
    ours, theirs = polars.DataFrame(run), pandas.DataFrame.from_arrow(run)
    assert ours["name"].to_list() == list(theirs["name"]) == list(MARKS.names)
    assert ours["status"].to_list() == ["ok", "bearing_only", "parallel"]
    assert ours["class"].to_list() == ["ship", "", "007"]
    assert ours["range_m"].to_list() == [run.positions[0].range_m, None, None]
    assert ours["range_high_m"].to_list()[1] == math.inf
    for name in ("lat", "range_low_m", "cov_nn_m2"):
        assert np.array_equal(theirs[name].to_numpy(), run.columns.column(name), equal_nan=True)


def test_positions_in_the_frame_of_a_rig_have_its_axes_and_no_geometry() -> None:
    run = located(rig=RIG)
    table = run.to_arrow()
    assert {"x_m", "y_m", "z_m", "cov_xz_m2"} < set(table.column_names)
    assert not {"lat", "geometry", "east_m"} & set(table.column_names)
    assert json.loads(table.schema.metadata[b"kcal"])["frame"] == run.frame


@pytest.mark.parametrize("piece", [1, 2, 10])
def test_a_geoparquet_file_is_the_same_in_pieces(tmp_path: Path, piece: int) -> None:
    run, file = located(), io.BytesIO()
    writer = PositionWriter(file, ".parquet", run)
    for part in run.columns.pieces(piece):
        writer.add(part)
    writer.close()
    assert pyarrow.parquet.read_table(io.BytesIO(file.getvalue())).equals(run.to_arrow(), check_metadata=True)


def test_a_geopackage_holds_points_and_regions(tmp_path: Path) -> None:
    run = located()
    path = write_positions(tmp_path / "positions.gpkg", run)
    about, table = pyogrio.read_arrow(path, layer="positions")
    assert (about["crs"], about["geometry_type"]) == ("EPSG:4326", "Point Z")
    assert table["name"].to_pylist() == list(MARKS.names)
    assert table["range_m"].to_pylist() == [run.positions[0].range_m, None, None]
    wkb = table[about["geometry_name"] or "wkb_geometry"].to_pylist()
    place = run.positions[0]
    assert np.frombuffer(wkb[0][-24:], "<f8").tolist() == [place.lon, place.lat, place.height]
    assert wkb[1:] == [None, None]
    info = pyogrio.read_info(path, layer="regions")
    assert (info["features"], info["geometry_type"]) == (1, "MultiPolygon")
    west, south, east, north = info["total_bounds"]
    assert west < place.lon < east
    assert south < place.lat < north


def test_a_region_across_the_antimeridian_is_cut(tmp_path: Path) -> None:
    """The mast is a kilometer east of a camera, which is as far from the line."""
    run = located(lon=180.0 - 1000 / 111_320 / math.cos(math.radians(19.07)))
    west, _, east, _ = pyogrio.read_info(write_positions(tmp_path / "p.gpkg", run), layer="regions")["total_bounds"]
    assert (west, east) == (-180.0, 180.0)


def test_a_rig_without_a_place_has_parquet_but_no_geopackage(tmp_path: Path) -> None:
    run = located(rig=RIG)
    assert polars.read_parquet(write_positions(tmp_path / "own.parquet", run))["z_m"][0] == pytest.approx(1000.0)
    with pytest.raises(InputError, match="no place on the Earth"):
        write_positions(tmp_path / "own.gpkg", run)


def test_without_pyarrow_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run = located()
    for name in ("pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"pip install 'kcal\[tables\]'"):
        run.to_arrow()
    path = tmp_path / "p.parquet"
    path.write_bytes(b"an old one")
    with pytest.raises(InputError, match=r"pip install 'kcal\[tables\]'"):
        write_positions(path, run)
    assert path.read_bytes() == b"an old one"


def test_an_empty_table_has_the_same_columns() -> None:
    run = located()
    empty = PointLocator(Localizer(RIG.placed(origin=run.origin, heading_deg=90.0))).located().to_arrow()
    assert empty.schema.equals(run.to_arrow().drop_columns("class").schema)


def test_corners_and_residuals_are_tables() -> None:
    pixels = pixels_of(CAMERA, motions(CAMERA, 4, 1))
    pixels[:, 0] = math.nan
    seen = observe(pixels, size=CAMERA.size)
    corners = polars.DataFrame(seen)
    assert corners.height == 4 * 41
    assert corners.row(0) == ("v00", 1, *BOARD.points[1].tolist(), *seen.views[0].pixels[1])
    result = calibrate_camera(seen)
    table = polars.DataFrame(result)
    assert table.columns == [*corners.columns, "residual_u", "residual_v"]
    assert math.sqrt((table["residual_u"].pow(2) + table["residual_v"].pow(2)).mean()) == pytest.approx(result.rms)
