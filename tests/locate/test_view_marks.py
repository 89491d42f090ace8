"""Long tables of marks: any order, any subset of cameras, times, in parts as in one, and features of many cameras."""

import csv
import math
import random
from pathlib import Path

import pytest
import torch
from command_line import Command, ran, rows_of

from kcal import FileError, InputError, Localizer, save_rig
from kcal.cli.rig_sources import images_by_camera
from kcal.locate import enu_to_geodetic, geodetic_to_enu
from kcal.locate import marks as tables
from kcal.locate.budget import range_sigmas, station_sigmas
from kcal.locate.marks import Marks, read_mark_chunks, read_marks
from kcal.locate.points import PointLocator, PositionSample
from kcal.locate.stations import stations_of
from kcal.locate.tables import read_chunks
from kcal.rig import RigCovariance, planned_rig
from scripts.shared.station_scenes import ORIGIN, marks, ring, targets

CAMERAS = ("a", "b", "c")


def table(path: Path, things: int, times: int = 1) -> list[str]:
    """Lines of things at several times, each seen by one to three cameras."""
    draw, lines = random.Random(3), []
    for i in range(things):
        for t in range(times):
            seen = [camera for camera in CAMERAS if draw.random() < 0.7] or ["b"]
            moment = f",{t}" if times > 1 else ""
            lines += [f"thing {i},{camera},{draw.random() * 900:.2f},{100 + i},{i % 3}{moment}" for camera in seen]
    head = "name,camera,u,v,kind" + (",time" if times > 1 else "")
    path.write_text("\n".join([head, *lines]) + "\n")
    return lines


def joined(path: Path) -> Marks:
    parts = [views for views, _ in read_mark_chunks(path, CAMERAS)]
    assert len(parts) > 3
    extras = {name: [cell for part in parts for cell in part.extras[name]] for name in parts[0].extras}
    names = tuple(name for part in parts for name in part.names)
    return Marks(names, torch.cat([p.pixels for p in parts]), extras=extras)


def small_parts(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    monkeypatch.setattr(tables, "_WHOLE", 0)
    monkeypatch.setattr(tables, "read_chunks", lambda *given, **more: read_chunks(*given, **more, at_once=rows))


@pytest.mark.parametrize("times", [1, 3])
@pytest.mark.parametrize("rows", [1, 2, 7, 50])
def test_parts_are_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int, times: int) -> None:
    path = tmp_path / "long.csv"
    table(path, 80, times)
    whole = read_marks(path, CAMERAS)
    small_parts(monkeypatch, rows)
    parts = joined(path)
    assert parts.names == whole.names
    torch.testing.assert_close(parts.pixels, whole.pixels, equal_nan=True, rtol=0, atol=0)
    assert parts.extras == whole.extras


def test_a_long_table_must_be_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "long.csv"
    lines = table(path, 80)
    head = "name,camera,u,v,kind"
    own = [line for line in lines if line.startswith("thing 0,")]
    lines.remove(own[-1])
    other = own[-1].split(",")[1]
    path.write_text("\n".join([head, *lines, f"thing 0,{other},1,2,0"]) + "\n")
    found = read_marks(path, CAMERAS)  # in any order, if it is short
    assert bool(found.pixels[0, CAMERAS.index(other)].isfinite().all())
    small_parts(monkeypatch, 7)
    with pytest.raises(FileError, match="lines of 'thing 0' stand at several places"):
        list(read_mark_chunks(path, CAMERAS))
    path.write_text("\n".join([head, *lines[:2], lines[-1], f"thing 0,{other},1,2,0", *lines[2:]]) + "\n")
    with pytest.raises(FileError, match="lines of 'thing 0' stand at several places"):
        list(read_mark_chunks(path, CAMERAS))


@pytest.mark.slow
def test_a_long_table_is_located_as_a_short_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    """In parts as in one, and the sample remembers from where bearings count."""
    rig, generator = ring(3, 4000.0), torch.Generator().manual_seed(0)
    rig.root = rig.with_errors(attitude_deg=0.01)
    save_rig(rig, tmp_path / "rig.json")
    pixels = marks(rig, targets(60, generator))
    lines = [
        f"t{i},{name},{pixels[i, c, 0]:.3f},{pixels[i, c, 1]:.3f}"
        for i in range(60) for c, name in enumerate(rig.names) if (i + c) % 4
    ]  # fmt: skip
    (tmp_path / "marks.csv").write_text("\n".join(["name,camera,u,v", *lines]) + "\n")
    words = ["locate", str(tmp_path / "rig.json"), str(tmp_path / "marks.csv"), "--picture", str(tmp_path / "p.png")]
    outputs, samples = [], []
    for number, rows in enumerate((10_000, 5)):
        if number:
            small_parts(monkeypatch, rows)
        out = [tmp_path / f"out{number}{suffix}" for suffix in (".csv", ".geojson")]
        command(*words, *(word for path in out for word in ("-o", str(path))))
        outputs.append([cell for row in csv.reader(out[0].read_text().splitlines()) for cell in row])
        locate, sample = PointLocator(Localizer(rig, weights="all")), PositionSample(most=20)
        for views, _ in read_mark_chunks(tmp_path / "marks.csv", rig.names):
            sample.add(locate(views))
        samples.append(sample.located(locate))
    for whole, part in zip(*outputs, strict=True):
        assert whole == part or float(whole) == pytest.approx(float(part), rel=1e-6, abs=1e-9)
    assert samples[0].columns.names == samples[1].columns.names
    assert 10 <= len(samples[0].columns.names) <= 20
    numbers = [int(name[1:]) for name in samples[0].columns.names]
    feet = torch.stack([rig.center[next(c for c in range(3) if (i + c) % 4)] for i in numbers])
    for sample in samples:
        torch.testing.assert_close(sample.feet, feet)


def test_one_camera_and_a_terrain(tmp_path: Path, command: Command) -> None:
    rig = ring(3, 4000.0)
    rig.root = rig.with_errors(attitude_deg=0.01)
    save_rig(rig, tmp_path / "rig.json")
    # A plain that rises to the north, far below the towers.
    rows = [" ".join(f"{600 + i}" for _ in range(90)) for i in range(60, 0, -1)]
    head = "ncols 90\nnrows 60\nxllcorner 5.955\nyllcorner 44.97\ncellsize 0.001\n"
    (tmp_path / "hills.asc").write_text(head + "\n".join(rows) + "\n")
    spot = torch.tensor([45.0 + 0.0005, 6.0, 631.0], dtype=torch.float64)  # in the middle of the 31st row

    pixel = marks(rig, geodetic_to_enu(spot, ORIGIN)[None])[0, 0]
    (tmp_path / "smoke.csv").write_text(f"name,camera,u,v\nsmoke,tower 1,{pixel[0]:.4f},{pixel[1]:.4f}\n")
    words = ["locate", str(tmp_path / "rig.json"), str(tmp_path / "smoke.csv"), "-o", str(tmp_path / "out.csv")]
    assert ran(*words).exit_code != 0, "a bearing is no position"
    given = ["--terrain", str(tmp_path / "hills.asc"), "--terrain-sigma", "2"]
    command(*words, *given)
    (row,) = rows_of(tmp_path / "out.csv")
    there = enu_to_geodetic(geodetic_to_enu(spot, ORIGIN), ORIGIN)
    assert float(row["lat"]) == pytest.approx(float(there[0]), abs=2e-5)
    assert float(row["height_ellipsoidal_m"]) == pytest.approx(631.0, abs=0.5)
    # A level error of two meters of height over the slope of the line of sight, 270 m over 4 km.
    assert 15 < math.sqrt(float(row["cov_ee_m2"]) + float(row["cov_nn_m2"])) < 60
    command(*words, *given, "--height 631", code=2)


def test_range_errors_of_many_cameras_are_those_of_a_pair() -> None:
    """Of the same two cameras, correlated errors of lenses and pose included."""
    pair = planned_rig()
    size = len(pair.left.names)
    together = torch.zeros(3, 2 * size + 6, dtype=torch.float64)
    together[0, pair.left.names.index("cx")], together[0, 2 * size + 1] = 1.0, 0.8 / 1600
    together[1, 2 * size + 1], together[2, size + pair.left.names.index("fx")] = 0.1 / 1600, 2.0
    pair.covariance = RigCovariance.of(pair, joint=together.T @ together)
    many = stations_of(pair)
    for distance in (500.0, 2000.0):
        found = station_sigmas(many, distance, pixel_sigma=0.1)
        assert found is not None
        places = [
            range_sigmas(pair, [distance], pixel_sigma=0.1, pixel=[share * pair.left.size[0], 0.5 * pair.left.size[1]])
            for share in (0.2, 0.35, 0.5, 0.65, 0.8)
        ]
        worst = max(places, key=lambda place: float(place.total))
        for name in ("marks", "lenses", "pose", "total"):
            torch.testing.assert_close(getattr(found, name), getattr(worst, name), rtol=0.05, atol=0.0, msg=name)
        parts = found.marks.square() + found.lenses.square() + found.pose.square()
        torch.testing.assert_close(parts.sqrt(), found.total)
    with pytest.raises(InputError, match="distance 0"):
        station_sigmas(many, 0.0)


def test_images_are_given_in_order_by_name_or_in_folders() -> None:
    assert images_by_camera("--stars", ["l", "r"], ("left", "right")) == {"left": ["l"], "right": ["r"]}
    named = ["mill=a/*.png", "mast=b", "mill=c"]
    assert images_by_camera("--stars", named, ("mill", "mast", "hill")) == {"mill": ["a/*.png", "c"], "mast": ["b"]}
    files = ["a/1.png", "b/1.png", "a/2.png"]
    assert images_by_camera("--scene", files, ("left", "right")) == {"left": files[::2], "right": ["b/1.png"]}
    assert images_by_camera("--skyline", files, ("mast",)) == {"mast": files}
    for words, message in ((["=a", "b"], "for each camera, LEFT RIGHT"), (["x"], "LEFT RIGHT"),
                           (["mast="], "write NAME=IMAGES"), (["hill=a"], "the cameras are left, right")):  # fmt: skip
        with pytest.raises(InputError, match=message):
            images_by_camera("--stars", words if len(words) == 1 else [*words, "c"], ("left", "right"))
