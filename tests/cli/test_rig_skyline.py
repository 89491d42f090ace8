"""`kcal rig --skyline` and `kcal station --skyline`."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.io.camera_file import save_camera
from kcal.locate.stations import load_camera_rig, station_mounting
from tests.helpers.skyline_site import camera, heights, small_site, write_raster


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera, its place, an image and a raster."""
    folder = tmp_path_factory.mktemp("skyline")
    site = small_site()
    save_camera(camera(), folder / "mast.camera.json")
    write_raster(folder / "dem.asc", heights())
    cv2.imwrite(str(folder / "noon.png"), site.image)
    height = site.place.height
    (folder / "gnss.csv").write_text(f"name,lat,lon,height,sigma\nmast,47.0,11.0,{height:.3f},0.3\n")
    return folder


def run(folder: Path, *options: str) -> tuple[int, str]:
    """`kcal station` with a camera."""
    given = ["station", str(folder / "mast.camera.json"), "-o", str(folder / "mast.rig.json")]
    result = CliRunner().invoke(app, [*given, *options])
    return result.exit_code, " ".join(f"{result.stdout} {result.stderr} {result.exception}".split())


def test_a_station_from_its_skyline(files: Path) -> None:
    code, text = run(
        files, "--position", str(files / "gnss.csv"), "--skyline", str(files / "dem.asc"), "--skyline-images",
        str(files / "noon.png"), "--skyline-sigma", "0.5", "--skyline-picture", str(files / "fit.png"),
    )  # fmt: skip
    assert code == 0, text
    assert "variance of its heading: " in text
    assert "next best heading" in text
    assert (files / "fit.png").stat().st_size > 10_000
    stands = station_mounting(load_camera_rig(files / "mast.rig.json"), 0)
    assert stands.covariance is not None
    assert stands.heading_deg == pytest.approx(40.0, abs=3 * float(stands.covariance[5, 5].sqrt().rad2deg()))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--skyline", "dem.asc"], "--skyline needs images"),
        (["--skyline-images", "noon.png"], "give surveyed places and --marks, or a raster"),
        (["--skyline", "dem.asc", "--skyline-images", "noon.png"], "needs the place of mast"),
        (["--skyline", "dem.asc", "--skyline-images", "left=noon.png", "--position", "gnss.csv"], "cameras are mast"),
        (["--skyline", "noon.png", "--skyline-images", "noon.png", "--position", "gnss.csv"], "coordinate|raster"),
    ],
)  # fmt: skip
def test_what_is_missing(files: Path, options: list[str], said: str) -> None:
    given = [
        str(files / one) if one.endswith((".asc", ".csv")) or one == "noon.png" else
        one.replace("noon.png", str(files / "noon.png")) for one in options
    ]  # fmt: skip
    code, text = run(files, *given)
    assert code != 0
    assert any(part in text for part in said.split("|")), text
