"""`kcal rig --tracks`: a rig from a drone's flight, and refusals."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.io.camera_file import save_camera
from kcal.io.rig_file import load_rig
from scripts.check.moving import CAMERA, CENTERS, LATE, NAMES, simulated


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("moving")
    site = simulated("drone", 3)
    focal = CAMERA.params.clone()
    focal[0] += 1e-3  # two cameras of one fingerprint would be one camera
    save_camera(CAMERA, folder / "left.camera.json")
    save_camera(CAMERA.with_parameters(focal), folder / "right.camera.json")
    rows = ["name,time,east,north,up,sigma"]
    for track in site.tracks:
        rows += [
            f"{track.name},{t:.3f},{x:.4f},{y:.4f},{z:.4f},0.02"
            for t, (x, y, z) in zip(track.times.tolist(), track.points.tolist(), strict=True)
        ]
    (folder / "tracks.csv").write_text("\n".join(rows) + "\n")
    rows = ["name,camera,time,u,v"]
    for one in site.sightings:
        rows += [
            f"{one.label},{NAMES[one.camera]},{t:.3f},{u:.3f},{v:.3f}"
            for t, (u, v) in zip(one.times.tolist(), one.pixels.tolist(), strict=True)
        ]
    (folder / "seen.csv").write_text("\n".join(rows) + "\n")
    rows = ["name,east,north,up,sigma"]
    rows += [
        f"{name},{','.join(f'{x:.3f}' for x in center)},0.02"
        for name, center in zip(NAMES, CENTERS.tolist(), strict=False)
    ]
    (folder / "gnss.csv").write_text("\n".join(rows) + "\n")
    return folder


def arguments(folder: Path, tracks: str = "tracks.csv") -> list[str]:
    cameras = [str(folder / f"{name}.camera.json") for name in NAMES]
    files = [str(folder / tracks), str(folder / "seen.csv")]
    return ["rig", *cameras, "--tracks", *files, "-o", str(folder / "rig.json")]


def test_a_rig_from_a_drone(given: Path) -> None:
    more = ["--positions", str(given / "gnss.csv"), "--baseline", "10.0+-0.02", "--intrinsics", "fixed"]
    result = CliRunner().invoke(app, [*arguments(given), *more])
    assert result.exit_code == 0, result.output
    assert "1 things in 2 of 2 sightings" in result.output
    (line,) = [line for line in result.output.splitlines() if "ahead of the cameras" in line]
    assert float(line.split(" is ")[1].split()[0]) == pytest.approx(LATE, abs=0.01)
    assert float(load_rig(given / "rig.json").baseline) == pytest.approx(10.0, abs=0.05)


def test_latitudes_beside_local_positions_are_refused(given: Path) -> None:
    rows = "".join(f"drone0,{t},54.1,7.9,{t},0.02\n" for t in range(60))
    (given / "earth.csv").write_text("name,time,lat,lon,height,sigma\n" + rows)
    result = CliRunner().invoke(app, [*arguments(given, "earth.csv"), "--positions", str(given / "gnss.csv")])
    assert result.exit_code == 1
    assert "--origin" in str(result.exception)
