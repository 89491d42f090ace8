"""Rigs from other things than boards: stars, the scene, the skyline, moving cameras."""

import json
import math
from pathlib import Path

import cv2
import pytest
import torch
from command_line import Command, invoked, ran, rows_of
from rig_scenes import CAMERAS, spread_points
from torch import Tensor

from kcal import KcalError, Origin
from kcal.cli.rig_sources import Sources, read_sources
from kcal.io.camera_file import camera_to_file, save_camera
from kcal.io.images import write_png
from kcal.io.rig_file import RigFile, load_rig
from kcal.lens.pose import enu_from_cam, rotation_from_vector, vector_from_rotation
from kcal.locate.geodesy import enu_to_geodetic
from kcal.locate.marks import read_marks, write_marks
from kcal.locate.stations import station_mounting
from scripts.check.moving import CAMERA, CENTERS, LATE, NAMES, simulated
from tests.helpers.scene_pairs import pair, small_rig
from tests.helpers.skyline_site import camera, heights, small_site, write_raster

# `kcal rig` from a survey, `kcal rig check`, `kcal locate` with what the rig file knows; across the antimeridian.


ORIGIN = Origin(lat=-17.5, lon=179.9999, height=40.0)

ROTATION = [enu_from_cam(16.0, -0.5, 0.4).T, enu_from_cam(16.2, -0.3, -0.2).T]

CENTER = torch.tensor([[2.0, -1.0, 3.0], [11.6, -3.7, 3.1]], dtype=torch.float64)

HEADER = "name,left_u,left_v,right_u,right_v"


def points(count: int, near: float, far: float, seed: int) -> Tensor:
    return spread_points(count, near, far, seed, ROTATION[0], CENTER[0])


def marked(where: Tensor, seed: int, yaw: float = 0.0) -> Tensor:
    """(N, 2, 2) marks with 0.1 px of noise; the right camera turned by `yaw` radians."""
    turns = rotation_from_vector(torch.tensor([[0.0, 0, 0], [0, yaw, 0]], dtype=torch.float64))
    sides = [CAMERAS[c].project((where - CENTER[c]) @ (turns[c] @ ROTATION[c]).T)[0] for c in (0, 1)]
    exact = torch.stack(sides, 1)
    return exact + 0.1 * torch.randn(exact.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def table(path: Path, header: str, rows: list[tuple]) -> None:
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")


def marks_table(path: Path, prefix: str, pixels: Tensor, header: str = HEADER, *more: tuple) -> None:
    table(path, header, [(f"{prefix}{i}", *a, *b) for i, (a, b) in enumerate(pixels.tolist())] + list(more))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name, one in zip(("left", "right"), CAMERAS[:2], strict=True):
        camera_to_file(one, name=name).save(tmp_path / f"{name}.json")
    posts = points(12, 60.0, 2000.0, 5)
    places = enu_to_geodetic(posts, ORIGIN)
    places[4, 2] += 3.0
    rows = [(f"post{i}", *place, 0.02) for i, place in enumerate(places.tolist())]
    table(tmp_path / "survey.csv", "name,lat,lon,height,sigma", [*rows, ("tree", -17.5, 179.99, 50, 0.1)])
    marks_table(tmp_path / "marks.csv", "post", marked(posts, 1))
    marks_table(tmp_path / "later.csv", "post", marked(posts, 2, math.radians(0.02)))
    far = points(15, 8000.0, 30_000.0, 9)
    rows = [
        (f"peak{i}", *a, *b, distance, 0.1 * distance)
        for i, ((a, b), distance) in enumerate(
            zip(marked(far, 3).tolist(), (far - CENTER.mean(0)).norm(dim=-1).tolist(), strict=True)
        )
    ]
    table(tmp_path / "far.csv", f"{HEADER},range,range_sigma", rows)
    static = points(25, 400.0, 6000.0, 33)
    marks_table(tmp_path / "then.csv", "s", marked(static, 4))
    now = marked(static, 5, math.radians(0.01))
    now[3] += 9.0
    marks_table(tmp_path / "now.csv", "s", now)
    positions = enu_to_geodetic(CENTER, ORIGIN).tolist()
    table(tmp_path / "gnss.csv", "name,lat,lon,height,sigma,sigma_up", [
        (name, *place, 0.02, 0.04) for name, place in zip(("left", "right"), positions, strict=True)
    ])  # fmt: skip
    targets = points(5, 100.0, 4000.0, 77)
    marks_table(tmp_path / "points.csv", "t", marked(targets, 6))
    table(tmp_path / "truth.csv", "name,lat,lon,height", [
        (f"t{i}", *place) for i, place in enumerate(enu_to_geodetic(targets, ORIGIN).tolist())
    ])  # fmt: skip
    return tmp_path


SOLVE = "rig left.json right.json --landmarks survey.csv --marks marks.csv --pixel-sigma 0.1"


def test_two_cameras_by_the_names_of_their_files(site: Path, command: Command) -> None:
    """Measured positions, as marks; a table for `locate` names left and right."""
    for old, new in (("left", "mill"), ("right", "mast")):
        (site / f"{new}.camera.json").write_bytes((site / f"{old}.json").read_bytes())
    text = (site / "gnss.csv").read_text()
    (site / "named.csv").write_text(text.replace("left,", "mill,").replace("right,", "mast,"))
    solve = "rig mill.camera.json mast.camera.json --landmarks survey.csv --marks marks.csv --pixel-sigma 0.1"
    found = [command(solve, f"--positions {name}.csv -o {name}.json").out for name in ("gnss", "named")]
    assert [line for line in found[0].splitlines() if "baseline" in line] == [
        line for line in found[1].splitlines() if "baseline" in line
    ]
    (site / "long.csv").write_text("name,camera,u,v\nt0,mill,500,500\nt0,mast,480,500\n")
    said = command("locate named.json long.csv", code=1).err.replace("\n", " ")
    assert "they are left, right, in the order in which the rig was solved" in said


def test_from_survey_to_positions(site: Path, command: Command) -> None:
    more = "--features far.csv --positions gnss.csv --baseline 9.97+-0.05 --picture rig.png"
    printed = command(SOLVE, more, "-o rig.json")
    assert "surveyed, but not marked: tree" in printed.err
    assert "left out: landmark post4: its marks are off the surveyed place by" in printed.err
    assert (site / "rig.png").read_bytes().startswith(b"\x89PNG")
    file = RigFile.load(site / "rig.json")
    assert [entry.name for entry in file.calibration.excluded] == ["landmarks post4"]
    assert {source.name for source in file.calibration.sources} == {"landmarks", "features", "baselines", "positions"}
    # The mounting is the left camera's own, within its sigmas, on the other side of the antimeridian.
    stands = file.mounting
    covariance = file.rig().mounting.covariance
    true = enu_to_geodetic(CENTER[0], ORIGIN).tolist()
    assert [stands.lat, stands.lon] == pytest.approx(true[:2], abs=1e-6)
    assert stands.height == pytest.approx(true[2], abs=4.5 * float(covariance[2, 2]) ** 0.5)
    assert stands.heading_deg == pytest.approx(16.0, abs=4.5 * math.degrees(float(covariance[5, 5]) ** 0.5))
    joint = file.rig().covariance.matrix
    turn = vector_from_rotation(file.rig().right_from_left_rotation @ (ROTATION[1] @ ROTATION[0].T).T)
    assert bool((turn.abs() < 4.5 * joint.diagonal()[-6:-3].sqrt()).all())

    outputs = "-o out.geojson --map map.html --picture map.png"
    printed = command("locate rig.json points.csv --truth truth.csv --pixel-sigma 0.1", outputs)
    assert "95 % of the noise in the marks and of the errors in calibration and mounting" in printed.out
    rows = [line.split() for line in printed.out.splitlines() if line.startswith("t")]
    assert len(rows) == 5
    assert [row[-2] for row in rows].count("yes") >= 4
    # Level distances from the truth: a few percent of the range at the most.
    assert all(abs(float(row[-4])) < 0.1 * float(row[4]) for row in rows)
    assert '"truth": [[' in (site / "map.html").read_text()
    assert len(json.loads((site / "out.geojson").read_text())["features"]) == 12


@pytest.mark.slow
def test_landmarks_from_geojson_and_a_requirement(site: Path, command: Command) -> None:
    features = [
        {
            "type": "Feature",
            "properties": {"name": row["name"]},
            "geometry": {"type": "Point", "coordinates": [float(row[key]) for key in ("lon", "lat", "height")]},
        }
        for row in rows_of(site / "survey.csv")
    ]
    (site / "survey.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    words = SOLVE.replace("survey.csv", "survey.geojson")
    assert "say how well the places are known" in command(words, "-o rig.json", code=1).err
    more = "--survey-sigma 0.02 -o rig.json --report rig.html"
    command(words, more, "--require 1km:50%")
    assert ">YES<" in (site / "rig.html").read_text()
    assert "NO: at 4 km" in command(words, more, "--require 4km:0.1%", code=3).out
    assert ">NO<" in (site / "rig.html").read_text()


def test_check_and_relock(site: Path, command: Command) -> None:
    command(SOLVE, "-o rig.json")
    before = (site / "rig.json").read_bytes()
    check = "rig check rig.json --reference then.csv --marks now.csv --pixel-sigma 0.1"
    printed = command(check, code=3)
    assert "left out: s3: it has moved by" in printed.err
    assert "has changed beyond chance" in printed.out
    line = next(line for line in printed.out.splitlines() if line.startswith("right from left"))
    yaw, sigma = float(line.split()[6]), float(line.split()[8])
    assert abs(yaw - 0.01) < 4.5 * sigma < 0.01
    assert "a target at 5000 m is found at" in printed.out
    assert (site / "rig.json").read_bytes() == before

    command(check, "--relock rig.json", code=3)
    (kept,) = site.glob("rig.before-*.json")
    assert kept.read_bytes() == before
    old, new = RigFile.load(kept), RigFile.load(site / "rig.json")
    assert new.cameras[0] == old.cameras[0]
    assert new.calibration.relocked.endswith("from now.csv")
    turn = vector_from_rotation(new.rig().right_from_left_rotation @ old.rig().right_from_left_rotation.T)
    assert math.degrees(float(turn[1])) == pytest.approx(yaw, abs=1e-5)
    assert float(new.rig().baseline) == pytest.approx(float(old.rig().baseline), rel=1e-9)
    spread = [file.rig().covariance.matrix for file in (old, new)]
    assert float(spread[1][-5, -5]) > float(spread[0][-5, -5])


def test_check_of_equal_marks(site: Path, command: Command) -> None:
    """Exactly no drift, no warning, exit code 0, and nothing written, though the rig itself is not exact."""
    command(SOLVE, "-o rig.json")
    files = {path.name: path.read_bytes() for path in site.iterdir()}
    check = "rig check rig.json --reference then.csv --marks then.csv --relock rig.json"
    # With a hundredth of their true noise, errors of the rig would be seen.
    printed = command(check, "--pixel-sigma 0.001")
    assert printed.err == ""
    for part in ("left camera", "right camera", "right from left"):
        (line,) = (line for line in printed.out.splitlines() if line.startswith(part))
        assert line.split("°")[0].count("+0.00000 ±") == 3
    assert "at 5000 m is found at 5000.0 m (+0.0 ±" in printed.out
    assert "no change of the relative attitude beyond chance" in printed.out
    assert printed.out.endswith("nothing was written\n")
    assert {path.name: path.read_bytes() for path in site.iterdir()} == files


def test_check_without_a_drift(site: Path, command: Command) -> None:
    """New marks with noise of their own, and the marks of the survey from which the rig was solved."""
    command(SOLVE, "-o rig.json")
    before = (site / "rig.json").read_bytes()
    marks_table(site / "now.csv", "s", marked(points(25, 400.0, 6000.0, 33), 8))
    for *source, now in (("--reference", "then.csv", "now.csv"), ("--landmarks", "survey.csv", "marks.csv")):
        printed = command("rig check rig.json", *source, "--marks", now, "--pixel-sigma 0.1 --relock rig.json")
        assert "nothing was written" in printed.out
        assert "warning" not in printed.err
        assert (site / "rig.json").read_bytes() == before
        assert not list(site.glob("rig.before-*.json"))


def test_check_of_a_rig_that_turned_as_a_whole(site: Path, command: Command) -> None:
    command(SOLVE, "-o rig.json")
    heading = RigFile.load(site / "rig.json").mounting.heading_deg
    where = points(25, 400.0, 6000.0, 33)
    sine, cosine = math.sin(math.radians(0.05)), math.cos(math.radians(0.05))
    # Seen from a rig that has turned to the right by 0.05°, things have moved to the left.
    turn = torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=torch.float64)
    sides = [CAMERAS[c].project((where - CENTER[c]) @ turn.T @ ROTATION[c].T)[0] for c in (0, 1)]
    now = torch.stack(sides, 1)
    noise = torch.Generator().manual_seed(8)
    marks_table(site / "now.csv", "s", now + 0.1 * torch.randn(now.shape, dtype=torch.float64, generator=noise))
    check = "rig check rig.json --reference then.csv --marks now.csv --pixel-sigma 0.1"
    printed = command(check, "--relock rig.json", code=3)
    assert "no change of the relative attitude beyond chance" in printed.out
    assert "the left camera has turned beyond chance" in printed.out
    assert RigFile.load(site / "rig.json").mounting.heading_deg == pytest.approx(heading + 0.05, abs=0.005)


def test_check_by_landmarks(site: Path, command: Command) -> None:
    told = json.loads(command(SOLVE, "-o rig.json --json").out)
    # Of what was read as well as of the solution.
    assert told["warnings"][0] == "surveyed, but not marked: tree"
    arguments = "rig check rig.json --landmarks survey.csv --marks later.csv --pixel-sigma 0.1"
    printed = command(arguments, "--relock rig.json", code=3)
    line = next(line for line in printed.out.splitlines() if line.startswith("right from left"))
    assert abs(float(line.split()[6]) - 0.02) < 4.5 * float(line.split()[8])
    assert RigFile.load(site / "rig.json").mounting.heading_deg == pytest.approx(16.0, abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--landmarks survey.csv", "--landmarks and --marks belong together"),
        ("--features far.csv --baseline 10", "write LENGTH±SIGMA in meters"),
        ("--features far.csv", "nothing tells where right stands"),
        ("--landmarks survey.csv --marks marks.csv --geoid 60", "heights are ellipsoidal there"),
        ("--landmarks survey.csv --marks then.csv", "names must be the same in both files"),
        ("--landmarks survey.csv --marks marks.csv --board-warp", "cannot be estimated without boards"),
        ("--landmarks survey.csv --marks marks.csv --picture a.jpg", "end with .png"),
    ],
)
def test_refusals(site: Path, command: Command, arguments: str, message: str) -> None:
    assert message in command("rig left.json right.json", arguments, "-o rig.json", code=1).err
    assert not (site / "rig.json").exists()


def test_a_wrong_baseline_is_measured_again_and_wrong_marks_are_marked_again(site: Path, command: Command) -> None:
    said = command(SOLVE, "--baseline 10.3±0.001 -o rig.json", code=1).err
    assert "baseline left to right contradicts" in said
    assert "kcal " not in said
    rows = (site / "marks.csv").read_text().splitlines()
    (site / "marks.csv").write_text(
        "\n".join([*rows[:1], *(row.replace(f"post{i}", f"post{(i + 5) % 12}") for i, row in enumerate(rows[1:]))])
    )
    assert "kcal mark left.png right.png --cameras left.json right.json" in command(SOLVE, "-o rig.json", code=1).err


def test_usage(site: Path, command: Command) -> None:
    command(SOLVE, "-o rig.json")
    assert "--reference" in command("rig check rig.json --marks now.csv", code=1).err
    both = "--reference then.csv --landmarks survey.csv"
    assert "not both" in command("rig check rig.json --marks now.csv", both, code=1).err
    command("locate rig.json points.csv --site 1,2,3", code=2)
    command("locate rig.json points.csv --pitch 1", code=2)


def test_marks_count_with_their_own_noise(site: Path) -> None:
    marks = read_marks(site / "marks.csv")
    spread = torch.full((12, 4), 0.2**2, dtype=torch.float64)
    spread[3], spread[5] = 0.4**2, math.nan
    write_marks(site / "own.csv", marks._replace(covariance=torch.diag_embed(spread)))
    sources = Sources(landmarks=site / "survey.csv", marks=site / "own.csv", pixel_sigma=0.1)
    read = read_sources((CAMERAS[0], CAMERAS[1]), sources)
    found = read.data.landmarks
    expected = torch.full((12, 2), 0.2, dtype=torch.float64)
    # Of one mark nothing is stated: it has the noise of the option.
    expected[3], expected[5] = 0.4, 0.1
    torch.testing.assert_close(found.pixel_sigma, expected)
    # The median: one vague mark does not count for all.
    assert read.pixel_sigma == pytest.approx(0.2)


@pytest.mark.slow
def test_the_rig_file_states_the_noise_of_its_marks(site: Path, command: Command) -> None:
    marks = read_marks(site / "marks.csv")
    write_marks(site / "own.csv", marks._replace(covariance=0.2**2 * torch.eye(4).double().expand(12, 4, 4)))
    given = "rig left.json right.json --landmarks survey.csv --marks"
    for marked_in, more, stated, said in (
        ("own.csv", "", 0.2, "noise of marks: 0.2 px, from the rig's file"),
        ("own.csv", "--pixel-sigma 0.15", 0.15, ""),
        ("marks.csv", "", None, "noise of marks: 0.3 px, assumed"),
    ):
        printed = command(given, marked_in, more, "-o rig.json")
        calibration = RigFile.load(site / "rig.json").calibration
        assert calibration.pixel_sigma == (None if stated is None else pytest.approx(stated))
        assert said in printed.out


# `kcal rig --tracks`: a rig from a drone's flight, and refusals.


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


@pytest.mark.slow
def test_a_rig_from_a_drone(given: Path, command: Command) -> None:
    more = ["--positions", str(given / "gnss.csv"), "--baseline", "10.0+-0.02", "--intrinsics", "fixed"]
    result = command(*arguments(given), *more)
    assert "1 targets in 2 of 2 sightings" in result.out
    (line,) = [line for line in result.out.splitlines() if "ahead of the cameras" in line]
    assert float(line.split(" is ")[1].split()[0]) == pytest.approx(LATE, abs=0.01)
    assert float(load_rig(given / "rig.json").baseline) == pytest.approx(10.0, abs=0.05)


def test_latitudes_beside_local_positions_are_refused(given: Path) -> None:
    rows = "".join(f"drone0,{t},54.1,7.9,{t},0.02\n" for t in range(60))
    (given / "earth.csv").write_text("name,time,lat,lon,height,sigma\n" + rows)
    with pytest.raises(KcalError, match="--site"):
        invoked(*arguments(given, "earth.csv"), "--positions", given / "gnss.csv")


# `kcal rig --scene`: a rig from images and a tape; without a length it is refused.


@pytest.fixture
def scene_given(tmp_path: Path) -> list[str]:
    rig, images = small_rig(), pair(1)
    names = []
    for side in ("left", "right"):
        save_camera(getattr(rig, side), tmp_path / f"{side}.camera.json")
        write_png(tmp_path / f"{side}.png", getattr(images, side))
        names.append(str(tmp_path / side))
    cameras = [f"{name}.camera.json" for name in names]
    return ["rig", *cameras, "--scene", *(f"{name}.png" for name in names), "-o", str(tmp_path / "rig.json")]


@pytest.mark.slow
def test_a_rig_from_images_and_a_tape(scene_given: list[str], tmp_path: Path, command: Command) -> None:
    length = float(small_rig().baseline)
    result = command(*scene_given, f"--baseline {length:.4f}+-0.002")
    assert "off the line" in result.out
    assert "one pair: what moves cannot be told" in result.out
    assert float(load_rig(tmp_path / "rig.json").baseline) == pytest.approx(length, abs=0.002)


def test_without_a_length_it_is_refused(scene_given: list[str], tmp_path: Path) -> None:
    with pytest.raises(KcalError, match="leaves the scale open"):
        invoked(*scene_given)
    assert not (tmp_path / "rig.json").exists()


# `kcal rig --skyline` and `kcal station --skyline`.


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


def run_skyline(folder: Path, *options: str) -> tuple[int, str]:
    """`kcal station` with a camera."""
    result = ran(*["station", str(folder / "mast.camera.json"), "-o", str(folder / "mast.rig.json")], *options)
    return result.exit_code, " ".join(f"{result.stdout} {result.stderr} {result.exception}".split())


@pytest.mark.slow
def test_a_station_from_its_skyline(files: Path) -> None:
    code, text = run_skyline(
        files, "--positions", str(files / "gnss.csv"), "--terrain", str(files / "dem.asc"), "--skyline",
        str(files / "noon.png"), "--terrain-sigma", "0.5", "--skyline-picture", str(files / "fit.png"),
    )  # fmt: skip
    assert code == 0, text
    assert "variance of its heading: " in text
    assert "next best heading" in text
    assert (files / "fit.png").stat().st_size > 10_000
    stands = station_mounting(load_rig(files / "mast.rig.json"), 0)
    assert stands.heading_deg == pytest.approx(40.0, abs=3 * float(stands.covariance[5, 5].sqrt().rad2deg()))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--terrain", "dem.asc"], "--terrain needs images"),
        (["--skyline", "noon.png"], "give surveyed places and --marks, or a raster"),
        (["--terrain", "dem.asc", "--skyline", "noon.png"], "needs the place of mast"),
        (["--terrain", "dem.asc", "--skyline", "left=noon.png", "--positions", "gnss.csv"], "cameras are mast"),
        (["--terrain", "noon.png", "--skyline", "noon.png", "--positions", "gnss.csv"], "coordinate|raster"),
    ],
)  # fmt: skip
def test_what_is_missing(files: Path, options: list[str], said: str) -> None:
    given = [
        str(files / one) if one.endswith((".asc", ".csv")) or one == "noon.png" else
        one.replace("noon.png", str(files / "noon.png")) for one in options
    ]  # fmt: skip
    code, text = run_skyline(files, *given)
    assert code != 0
    assert any(part in text for part in said.split("|")), text
