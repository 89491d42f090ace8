"""`kcal rig` of many cameras, `kcal station` and `kcal locate` of what they saw."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from click.testing import Result
from command_line import Command, invoked, ran, rows_of

from kcal import Board, Camera, Observations, Origin, Rig, View, load_rig, save_camera, save_rig
from kcal.errors import DegenerateError, FileError, InputError
from kcal.lens.pose import enu_from_cam, rotation_from_vector
from kcal.locate.budget import station_sigmas
from kcal.locate.geodesy import enu_to_geodetic, geodetic_to_enu
from scripts.shared.station_scenes import ORIGIN, marks, ring, targets

NAMES = ("mill", "mast", "church", "hill")
FILES = (".json", ".csv", ".png", ".geojson", ".html")
SMOKE = torch.tensor([[300.0, 500, 200], [-900, -300, 180], [1200, -800, 150], [0, 0, -400]], dtype=torch.float64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out, rig, generator = tmp_path_factory.mktemp("stations"), ring(4, 5000.0), torch.Generator().manual_seed(3)
    groups = [targets(8, generator, 800.0)]
    for center in rig.center:
        share = 0.1 + 0.6 * torch.rand(6, 1, dtype=torch.float64, generator=generator)
        groups.append(center + share * (targets(6, generator, 1500.0) - center) - torch.tensor([0.0, 0.0, 60.0]))
    points = torch.cat(groups)
    pixels = marks(rig, points) + 0.3 * torch.randn(len(points), 4, 2, dtype=torch.float64, generator=generator)
    places = enu_to_geodetic(points, ORIGIN).tolist()
    survey = [f"post {i},{a:.9f},{b:.9f},{c:.4f},0.05" for i, (a, b, c) in enumerate(places)]
    (out / "survey.csv").write_text("\n".join(["name,lat,lon,height,sigma", *survey]) + "\n")
    lines = ["name,camera,u,v"]
    for c, (name, camera) in enumerate(zip(NAMES, rig.each, strict=True)):
        save_camera(camera, out / f"{name}.camera.json")
        inside = camera.inside(pixels[:, c]).tolist()
        own = [i for i in range(len(points)) if (i < 8 or (i - 8) // 6 == c) and inside[i]]
        lines += [f"post {i},{name},{pixels[i, c, 0]:.3f},{pixels[i, c, 1]:.3f}" for i in own]
    (out / "marks.csv").write_text("\n".join(lines) + "\n")
    seen = marks(rig, SMOKE)
    seen[1, 2, 0] += 60.0
    lines = ["name,camera,u,v,what"]
    for i in range(4):
        cameras = [1] if i == 3 else range(4)
        lines += [f"smoke {i},{NAMES[c]},{seen[i, c, 0]:.3f},{seen[i, c, 1]:.3f},smoke" for c in cameras]
    (out / "smoke.csv").write_text("\n".join(lines) + "\n")
    return out


def run(folder: Path, *words: str) -> str:
    return invoked(*(folder / word if word.endswith(FILES) else word for word in words))


def solve(folder: Path) -> None:
    cameras = [f"{name}.camera.json" for name in NAMES]
    text = run(folder, "rig", *cameras, "--landmarks", "survey.csv", "--marks", "marks.csv", "-o", "rig.json")
    assert all(name in text for name in NAMES)


@pytest.mark.slow
def test_four_cameras_are_solved_and_locate_what_some_of_them_saw(folder: Path) -> None:
    solve(folder)
    rig, truth = load_rig(folder / "rig.json"), ring(4, 5000.0)
    assert rig.names == NAMES
    assert rig.root is not None
    assert rig.origin is not None
    there = enu_to_geodetic(truth.center, ORIGIN)
    assert (enu_to_geodetic(rig.center, rig.origin) - there)[:, :2].abs().max() < 4e-5  # 4 m
    text = run(folder, "locate", "rig.json", "smoke.csv", "-o", "out.csv", "-o", "out.geojson", "--picture", "plan.png")
    assert "the mark in church contradicts the others" in text
    rows = rows_of(folder / "out.csv")
    assert [row["status"] for row in rows] == ["ok", "ok", "ok", "bearing_only"]
    assert rows[1]["left_out"] == "church"
    assert rows[1]["cameras"] == "mill mast hill"
    assert [row["what"] for row in rows] == ["smoke"] * 4
    for row, (lat, lon, _) in zip(rows[:3], enu_to_geodetic(SMOKE, ORIGIN).tolist(), strict=False):
        # Meters of a degree at this latitude.
        assert abs(float(row["lat"]) - lat) * 111_000 < 5 * float(row["cov_nn_m2"]) ** 0.5
        assert abs(float(row["lon"]) - lon) * 78_000 < 5 * float(row["cov_ee_m2"]) ** 0.5
    kinds = [one["properties"].get("kind") for one in json.loads((folder / "out.geojson").read_text())["features"]]
    assert kinds.count("camera") == 4
    assert (folder / "plan.png").stat().st_size > 10_000
    height = float(enu_to_geodetic(SMOKE[3], ORIGIN)[2])
    run(folder, "locate", "rig.json", "smoke.csv", "--height", f"{height:.1f}±3", "-o", "out.csv")
    last = rows_of(folder / "out.csv")[3]
    assert last["status"] == "ok"
    assert abs(float(last["lat"]) - float(enu_to_geodetic(SMOKE[3], ORIGIN)[0])) < 2e-3


def test_one_station_alone(folder: Path) -> None:
    text = run(
        folder, "station", "mill.camera.json", "--landmarks", "survey.csv", "--marks", "marks.csv", "-o", "mill.json"
    )
    assert "mill" in text
    assert load_rig(folder / "mill.json").names == ("mill",)


def test_one_station_in_local_meters(folder: Path, tmp_path: Path, command: Command) -> None:
    """Places and angles have their error bars there, too: those that an origin gives."""
    table = (folder / "survey.csv").read_text().splitlines()
    names, numbers = zip(
        *((line.split(",")[0], [float(x) for x in line.split(",")[1:4]]) for line in table[1:]), strict=True
    )
    local = geodetic_to_enu(torch.tensor(numbers, dtype=torch.float64), ORIGIN).tolist()
    lines = [f"{name},{','.join(f'{x:.4f}' for x in place)},0.05" for name, place in zip(names, local, strict=True)]
    (tmp_path / "local.csv").write_text("\n".join(["name,east,north,up,sigma", *lines]) + "\n")
    rows = []
    for more in ([], ["--site", f"{ORIGIN.lat},{ORIGIN.lon},{ORIGIN.height}"]):
        given = [folder / "mill.camera.json", "--landmarks", tmp_path / "local.csv", "--marks", folder / "marks.csv"]
        result = command("station", *given, "-o", tmp_path / "mill.rig.json", *more, "--json")
        rows.append(json.loads(result.out)["cameras"]["mill"])
    assert rows[0].keys() >= {"east_m", "heading_deg", "sigma_m"}
    assert abs(rows[0]["sigma_m"] / rows[1]["sigma_m"] - 1.0) < 0.2
    # The camera's own vertical is a little different from the origin's.
    assert abs(rows[0]["heading_deg"] - rows[1]["heading_deg"]) < 0.1


Columns = Callable[[int, float, float, float], tuple[object, ...]]


def surveyed(folder: Path, columns: Columns, *, flat: bool) -> Result:
    """`kcal station` on landmarks with these columns: latitude, longitude, height, of each number and place.

    Level ground has no other side, so that depths are told by landmarks at several heights.
    """
    origin = Origin(lat=43.32, lon=21.9, height=200.0)
    camera = Camera.build(focal=(1400, 1400), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    draw = torch.rand(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5
    points = draw * torch.tensor([30.0, 60.0, 0.0 if flat else 8.0]) + torch.tensor([0.0, 60.0, 0.0])
    pixels, _ = camera.project((points - torch.tensor([0.0, 0.0, 6.0])) @ enu_from_cam(0.0, -8.0, 0.5))
    save_camera(camera, folder / "cctv.camera.json")
    marked = [f"p{i},cctv,{u:.3f},{v:.3f}" for i, (u, v) in enumerate(pixels.tolist())]
    (folder / "marks.csv").write_text("\n".join(["name,camera,u,v", *marked]) + "\n")
    places = enumerate(enu_to_geodetic(points, origin).tolist())
    lines = [",".join(map(str, (f"p{i}", *columns(i, *place), 0.05))) for i, place in places]
    (folder / "survey.csv").write_text("\n".join(["name,lat,lon,height,sigma", *lines]) + "\n")
    given = [str(folder / "cctv.camera.json"), "--landmarks", str(folder / "survey.csv")]
    return ran("station", *given, "--marks", folder / "marks.csv", "-o", folder / "rig.json")


@pytest.mark.parametrize("flat", [True, False])
def test_a_survey_as_it_should_be(tmp_path: Path, flat: bool) -> None:
    assert surveyed(tmp_path, lambda i, *place: place, flat=flat).exit_code == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("columns", "text"),
    [
        (
            lambda i, lat, lon, h: (lon, lat, h),
            "are surveyed as in a mirror: latitude and longitude are exchanged; as given, ",
        ),
        (
            lambda i, lat, lon, h: (lat, -lon, h),
            "may be surveyed as in a mirror: latitudes or longitudes have the wrong sign",
        ),
        (lambda i, lat, lon, h: (lat, lon, -h), "are surveyed as in a mirror: heights count downward; as given, "),
        (
            lambda i, lat, lon, h: (lon, lat, h) if i % 3 == 1 else (lat, lon, h),
            "line 3: latitude and longitude are ex",
        ),
        (lambda i, lat, lon, h: (f"{100 * int(lat) + 60 * (lat - int(lat)):.7f}", lon, h), "write decimal degrees: as"),
        (lambda i, lat, lon, h: (f"{int(lat)}°{60 * (lat - int(lat)):.7f}'", lon, h), "decimal degrees are needed"),
        (lambda i, lat, lon, h: (lat, 200.0, lon), "unless lon and height are exchanged"),
    ],
    ids=["exchanged", "sign", "depths", "some", "ddmm", "dms", "height"],
)
def test_exchanged_columns_of_a_survey(tmp_path: Path, columns: Columns, text: str) -> None:
    """What is wrong with the table is said, whether landmarks contradict each other or put the camera upside down."""
    wrong = surveyed(tmp_path, columns, flat="downward" not in text)
    if "may be" in text:  # level ground looks alike from below: it is said, and who hangs a camera so has its place
        assert wrong.exit_code == 0
        assert text in wrong.output.replace("\n", " ")
        return
    assert isinstance(wrong.exception, InputError | FileError), wrong.output
    assert text in str(wrong.exception)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "camera", "text"),
    [("collinear", "cam", "nearly in one line"), ("mirror", "cctv", "latitude and longitude are exchanged")],
)
def test_surveys_of_strangers(kcal_data: Path, tmp_path: Path, folder: str, camera: str, text: str) -> None:
    """One line of landmarks gives no place; exchanged columns are said, and right ones place the camera."""

    def solved(survey: Path) -> Result:
        given = ["--landmarks", str(survey), "--marks", str(here / "marks.csv"), "--json"]
        return ran("station", here / f"{camera}.camera.json", *given, "-o", tmp_path / "rig.json")

    here = kcal_data / "field" / folder
    as_given = solved(here / "survey.csv")
    assert text in f"{as_given.exception} {as_given.output}"
    if folder == "collinear":
        assert isinstance(as_given.exception, InputError | DegenerateError)
        assert not (tmp_path / "rig.json").exists()
        return
    (tmp_path / "survey.csv").write_text((here / "survey.csv").read_text().replace("lon,lat", "lat,lon"))
    right = solved(tmp_path / "survey.csv")
    assert right.exit_code == 0
    assert "mirror" not in right.output
    stands = json.loads(right.stdout)["cameras"][camera]
    values = [stands[name] for name in ("lat", "lon", "height", "heading_deg", "pitch_deg", "roll_deg")]
    for value, true, off in zip(
        values, (43.32, 21.9, 206.1, 40.0, -8.0, 0.0), (1e-5, 1e-5, 0.5, 0.5, 0.5, 0.5), strict=True
    ):
        assert abs(value - true) < off


@pytest.mark.slow
def test_messages(folder: Path) -> None:
    solve(folder)
    three = [f"{name}.camera.json" for name in NAMES[:3]]
    (folder / "another").mkdir()
    shutil.copy(folder / "mill.camera.json", folder / "another")
    given = ["--landmarks", "survey.csv", "--marks", "marks.csv", "-o", "x.json"]
    with pytest.raises(FileError, match="no camera is named 'hill'"):
        run(folder, "rig", *three, *given)
    with pytest.raises(InputError, match="two cameras are named 'mill'"):
        run(folder, "rig", *three, "another/mill.camera.json", *given)
    with pytest.raises(FileError, match="a rig of 4 cameras; a rig of two is needed"):
        run(folder, "budget", "rig.json")
    refused = ran("locate", folder / "rig.json", folder / "smoke.csv", "--yaw-sigma", "0.1")
    assert refused.exit_code == 2
    assert "come from the rig file" in " ".join(refused.output.replace("│", " ").split())
    (folder / "twice.csv").write_text("name,camera,u,v\na,mill,1,2\na,mill,3,4\n")
    with pytest.raises(FileError, match="line 3: 'a' was marked in mill before"):
        run(folder, "locate", "rig.json", "twice.csv")
    with pytest.raises(InputError, match="height '3x'"):
        run(folder, "locate", "rig.json", "smoke.csv", "--height", "3x")


def test_two_cameras_take_the_long_table_too(folder: Path) -> None:
    others = {"church", "hill"}
    lines = [line for line in (folder / "marks.csv").read_text().splitlines() if not others & {*line.split(",")}]
    (folder / "two.csv").write_text("\n".join(lines) + "\n")
    other = Camera.build(focal=(1600.001, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    save_camera(other, folder / "mast.camera.json")
    given = ["--landmarks", "survey.csv", "--marks", "two.csv", "-o", "two.json"]
    run(folder, "rig", "mill.camera.json", "mast.camera.json", *given)
    assert json.loads((folder / "two.json").read_text())["names"] == ["left", "right"]


def test_show_says_how_each_camera_stands() -> None:
    stored = Path(__file__).parents[1] / "promises" / "files" / "1.0" / "camera-rig.json"
    text = ran("show", stored).stdout
    assert text.count("\ncamera ") == 4  # three cameras and the head of the table
    (line,) = [line for line in text.splitlines() if line.startswith("fisheye4 ")]
    rig = load_rig(stored)
    lat, lon = (float(word) for word in line.split()[1:3])
    assert (lat, lon) == pytest.approx(enu_to_geodetic(rig.center[1], rig.origin).tolist()[:2], abs=1e-7)
    assert "20 mm  50 mm" in line


def boards_of(rig: Rig, folder: Path) -> list[str]:
    """Observations of a board shown to three cameras of one mast, each to two or three of them; names of the files."""
    board = Board(columns=8, rows=6, square=0.25)
    generator, files = torch.Generator().manual_seed(1), []
    poses = [
        (rotation_from_vector(0.3 * torch.randn(3, generator=generator).double()),
         torch.tensor([-3.0 + 0.5 * i, 0.2 * (i % 3) - 0.4, 9.0 + i % 4]).double())
        for i in range(14)
    ]  # fmt: skip
    for c, name in enumerate(NAMES[:3]):
        views = []
        for i, (turn, shift) in enumerate(poses):
            points = board.points @ turn.T + shift
            pixels, seen = rig(points)
            if i % 4 != c and bool(seen[:, c].all()):
                noise = 0.1 * torch.randn(len(points), 2, generator=generator).double()
                views.append(View(name=f"{name}_{i:02d}.png", pixels=[*map(tuple, (pixels[:, c] + noise).tolist())]))
        files.append(f"{name}.obs.json")
        Observations(board=board, image_size=(1920, 1080), views=tuple(views)).save(folder / files[-1])
    return files


@pytest.mark.slow
def test_boards_seen_by_any_two_of_three_and_distances_of_named_pairs(tmp_path: Path) -> None:
    camera = [
        Camera.build(focal=(1600 + c, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        for c in range(3)
    ]
    centers = torch.tensor([[0.0, 0, 0], [1.5, 0.1, 0], [3.0, -0.1, 0.2]], dtype=torch.float64)
    turns = torch.stack([rotation_from_vector(torch.tensor([0.0, -0.1 * c, 0.02 * c]).double()) for c in range(3)])
    rig = Rig(camera, NAMES[:3], turns, center=centers, refraction=0.0)
    for one, name in zip(camera, NAMES, strict=False):
        save_camera(one, tmp_path / f"{name}.camera.json")
    three = [f"{name}.camera.json" for name in NAMES[:3]]
    boards = ["--pairs", *boards_of(rig, tmp_path)]
    run(tmp_path, "rig", *three, *boards, "-o", "rig.json")
    found = load_rig(tmp_path / "rig.json")
    assert float((found.center - centers).norm(dim=-1).max()) < 0.01
    assert found.root is not None
    # A distance that is known better than by boards moves the cameras to it, and only those two by all of it.
    far = float((centers[0] - centers[2]).norm()) * 1.01
    run(
        tmp_path, "rig", *three, *boards, "--baseline", f"mill:church={far:.5f}±0.00001", "--keep-all", "-o", "rig.json"
    )
    held = load_rig(tmp_path / "rig.json")
    assert float((held.center[0] - held.center[2]).norm()) == pytest.approx(far, abs=1e-4)
    with pytest.raises(InputError, match="of 3 cameras write FIRST:SECOND=LENGTH±SIGMA, the names being mill, mast"):
        run(tmp_path, "rig", *three, *boards, "--baseline", "3.0±0.1", "-o", "rig.json")
    with pytest.raises(InputError, match="of 3 cameras write FIRST:SECOND"):
        run(tmp_path, "rig", *three, *boards, "--baseline", "mill:hill=3.0±0.1", "-o", "rig.json")
    with pytest.raises(InputError, match=r"a second file of camera 'mill'"):
        run(tmp_path, "rig", *three, *boards, *boards[:2], "-o", "rig.json")
    with pytest.raises(InputError, match=r"--scene is for rigs of two cameras; give matches as a table by --features"):
        run(tmp_path, "rig", *three, "--scene", "mill.png", "mast.png", "-o", "rig.json")


@pytest.mark.slow
def test_a_rig_of_four_is_judged(folder: Path, command: Command) -> None:
    cameras = [f"{name}.camera.json" for name in NAMES]
    given = ["--landmarks", "survey.csv", "--marks", "marks.csv", "-o", "rig.json"]
    more = ["--report", "rig.html", "--picture", "rig.png"]
    assert "YES" in run(folder, "rig", *cameras, *given, "--require", "5km:2%", *more)
    page = (folder / "rig.html").read_text()
    assert "mill" in page
    assert "data:image/png" in page
    assert (folder / "rig.png").stat().st_size > 10_000
    result = command("report", folder / "rig.json", "--require 5km:0.001%", code=3)
    assert "at 5 km the range is known to ±" in result.out
    stated = ["--require", "5km:2%", "--pixel-sigma", "0.3", "--json"]
    told = json.loads(run(folder, "report", "rig.json", *stated))["verdict"]
    rig = load_rig(folder / "rig.json")
    answer = told["ranges"][0]
    worst = station_sigmas(rig, 5000.0)
    assert worst is not None
    assert answer["sigma_m"] == pytest.approx(float(worst.total))
    # Turned away from each other, no two see the same.
    away = rig.rotation @ torch.diag(torch.tensor([-1.0, -1, 1], dtype=torch.float64))
    save_rig(Rig(rig.each, NAMES, away, center=rig.center, origin=rig.origin), folder / "apart.json")
    result = command("report", folder / "apart.json", "--require 1km:5%", code=3)
    assert "no two cameras see one" in result.out


# `kcal place`: stations whose pose is known.

POSES = """name,lat,lon,height,sigma,sigma_up,heading,heading_sigma,pitch,pitch_sigma,roll,roll_sigma
west,46.0,7.0,1500,5,10,62,0.1,5,0.05,2,0.2
east,46.4,7.5,900,5,10,200,0.2,12,0.05,,
"""


@pytest.fixture
def known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("west", "east", "left", "right"):
        lens = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        save_camera(lens, f"{name}.camera.json")
    Path("poses.csv").write_text(POSES)
    return tmp_path


def test_known_poses_as_typed_and_in_a_table(known: Path, command: Command) -> None:
    said = command(
        "place west.camera.json east.camera.json --site 46.0,7.0,1500±5 46.4,7.5,900+-5 --heading 62±0.1 200±0.2 "
        "--pitch 5±0.05 12±0.05 --roll 2±0.2 0±0.05 -o typed.json"
    )
    assert "wrote typed.json" in said.out
    command("place west.camera.json east.camera.json --places poses.csv -o read.json")
    typed, read = load_rig("typed.json"), load_rig("read.json")
    assert typed.names == read.names == ("west", "east")
    assert torch.equal(typed.rotation, read.rotation)
    told = json.loads(command("place west.camera.json east.camera.json --places poses.csv -o read.json --json").out)
    east = told["cameras"]["east"]
    assert (east["lat"], east["heading_deg"], east["pitch_deg"]) == pytest.approx((46.4, 200.0, 12.0), abs=1e-9)
    assert east["sigma_m"] == pytest.approx(10.0, rel=1e-3)
    # As stated, though the axes of pitch and roll are neither east nor north.
    assert told["tables"][0][1][-3:] == ["62.00 ± 0.10", "5.000 ± 0.050", "2.00 ± 0.20"]
    # One file at several places is one lens, named by the table; without --roll it is level, and that is said.
    command("place west.camera.json --places poses.csv -o one.json")
    assert load_rig("one.json").names == ("west", "east")
    said = command("place west.camera.json --site -33.9,151.2,10 --heading 0±1 --pitch -30±0.5 -o down.json")
    assert "roll: 0, known as well as the pitch" in said.err
    assert load_rig("down.json").root is not None


@pytest.mark.parametrize("names", [("west", "east"), ("left", "right")])
def test_one_pixel_and_two_are_located(names: tuple[str, str], known: Path, command: Command) -> None:
    Path("poses.csv").write_text(POSES.replace("west", names[0]).replace("east", names[1]))
    command(f"place {names[0]}.camera.json {names[1]}.camera.json --places poses.csv -o rig.json")
    rig, airplane = load_rig("rig.json"), torch.tensor([46.15, 7.4, 9000.0]).double()
    assert rig.origin is not None
    # Straight lines of sight: light bends in `kcal locate`, by what the airplane is lower than it seems.
    left, right = rig(geodetic_to_enu(airplane, rig.origin)[None])[0][0].tolist()
    wide = f"a,{left[0]},{left[1]},{right[0]},{right[1]}"
    Path("wide.csv").write_text(f"name,left_u,left_v,right_u,right_v\n{wide}\n")
    Path("long.csv").write_text(
        f"name,camera,u,v\na,{names[0]},{left[0]},{left[1]}\na,{names[1]},{right[0]},{right[1]}\n"
    )
    for table in ("wide.csv", "long.csv"):
        command(f"locate rig.json {table} -o found.csv")
        (found,) = rows_of("found.csv")
        place = [float(found[name]) for name in ("lat", "lon", "height_ellipsoidal_m")]
        assert place[:2] == pytest.approx((46.15, 7.4), abs=1e-4)
        assert place[2] == pytest.approx(9000.0, abs=60.0)
    command("place west.camera.json --site 46,7,1500±5 --heading 62±0.1 --pitch -20±0.1 -o drone.json")
    Path("one.csv").write_text("name,camera,u,v\nhut,west,1200,700\n")
    assert "ok" in command("locate drone.json one.csv --height 600±2").out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--site 46,7,1500 --heading 62 --pitch 5±1", "--heading 62: say how well it is known, for example 62±1"),
        (
            "--site 46,7,1500 46,7,1 --heading 62±1 --pitch 5±1",
            "--site: one value for each of 1 cameras is needed, got 2",
        ),
        ("--site 46,7,1500 --heading 62±1 --pitch 95±1", "pitch 95"),
        ("east.camera.json --places short.csv", "no line is named 'east'"),
        ("east.camera.json --places turned.csv", "line 3: latitude and longitude are exchanged (east)"),
        ("--places bare.csv", "pitch_sigma is empty; write how well it is known, degrees"),
    ],
)
def test_what_is_missing_of_a_pose_is_asked_for(words: str, message: str, known: Path, command: Command) -> None:
    Path("short.csv").write_text("".join(POSES.splitlines(keepends=True)[:2]))
    Path("turned.csv").write_text(POSES.replace("46.4,7.5", "7.4,46.4"))
    Path("bare.csv").write_text(POSES.replace("5,0.05,2", "5,,2"))
    assert message in command(f"place west.camera.json {words} -o rig.json", code=1).err.replace("\n", " ")
    assert not Path("rig.json").exists()


def test_the_budget_of_a_pair_whose_poses_are_known(known: Path, command: Command) -> None:
    """10 m apart, both looking to 62°: as that of the planned rig, whose frame is the left camera's."""
    east, north = 10.0 * math.cos(math.radians(62)), -10.0 * math.sin(math.radians(62))
    ends = ",5,10,62,0.1,0,0.05,0,0.05"
    place = enu_to_geodetic(
        torch.tensor([east, north, 0.0]).double(), Origin(lat=46.0, lon=7.0, height=1500.0)
    ).tolist()
    rows = [f"left,46.0,7.0,1500{ends}", f"right,{place[0]!r},{place[1]!r},{place[2]!r}{ends}"]
    Path("poses.csv").write_text("\n".join([POSES.splitlines()[0], *rows]) + "\n")
    command("place left.camera.json right.camera.json --places poses.csv -o rig.json")
    placed = command("budget rig.json --distances 1000,5000 --pixel-sigma 0.3").out
    planned = command("budget --focal 1600 --baseline 10 --distances 1000,5000 --pixel-sigma 0.3").out
    told = [[line for line in text.splitlines() if "disparity" in line][-2:] for text in (placed, planned)]
    assert told[0] == told[1]


def test_one_camera_in_place_of_a_rig_is_told_of_known_poses(known: Path, command: Command) -> None:
    Path("one.csv").write_text("name,left_u,left_v,right_u,right_v\nhut,1,2,3,4\n")
    assert "kcal place west.camera.json --site" in command("locate west.camera.json one.csv", code=1).err
