"""Tables of marks of any length: read, located and written in chunks, with the same result as in one piece."""

import csv
import io
import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import Command, contents, rows_of
from locate_rigs import located_pairs, real_rig, spread_points, standing

from kcal import FileError, InputError, Origin, PositionStatus, save_rig
from kcal.locate import marks, points, stereo, tables
from kcal.locate.export import PositionWriter, write_positions
from kcal.locate.geodesy import azimuth_elevation
from kcal.locate.marks import Marks, read_mark_chunks, read_marks
from kcal.locate.points import PointLocator, PositionSample
from kcal.locate.tables import NUMBERS, number_lines
from kcal.locate.tabulate import circular_error
from kcal.rig import RigCovariance, mounting_covariance

ORIGIN = Origin(lat=-33.9, lon=151.2, height=40.0)
ROWS = 250


def pixels() -> torch.Tensor:
    """(250, 2, 2): located ones, and one of each failure that marks can cause."""
    left, right = real_rig()(spread_points(torch.logspace(2, 4.5, ROWS, dtype=torch.float64)))[0].unbind(-2)
    both = torch.stack([left, right], 1).detach()
    both[3] = torch.tensor([[-5.0, 3.0], [1.0, 3.0]])
    both[100, 1, 0] += 40.0
    both[101, 1, 1] += 12.0
    return both


def locator_of_everything() -> PointLocator:
    rig = real_rig()
    pose = torch.diag(torch.tensor([1e-5, 2e-5, 1e-5, 1e-3, 1e-3, 1e-3], dtype=torch.float64) ** 2)
    return PointLocator(standing(
        rig, origin=ORIGIN, heading_deg=200.0, pitch_deg=3.0, calibration=RigCovariance.of(rig, pose=pose),
        covariance=mounting_covariance(origin_m=[0.1] * 3, attitude_deg=(0.01, 0.01, 0.02)),
    ))  # fmt: skip


def table(path: Path, extra: bool = False) -> Path:
    lines = ["name,left_u,left_v,right_u,right_v" + (",class,score,track" if extra else "")]
    for i, row in enumerate(pixels().flatten(1).tolist()):
        cells = [f"p{i}", *map(repr, row)] + ([f"=boat {i}", f"{0.001 * i:.3f}", f"{i:04d}"] if extra else [])
        lines.append(",".join(cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def written(suffix: str, path: Path, at_once: int, piece: int = 10_000) -> bytes:
    locate, file = locator_of_everything(), io.BytesIO()
    writer = PositionWriter(file, suffix, locate.located())
    # The moment of Cursor-on-Target.
    writer._time = writer._time.replace(year=2026, month=5, day=4, hour=12, minute=0, second=0, microsecond=0)
    for chunk, _ in read_mark_chunks(path, at_once=at_once):
        for columns in locate(chunk).pieces(piece):
            writer.add(columns)
    writer.close()
    return file.getvalue()


@pytest.mark.parametrize("suffix", [".csv", ".geojson", ".geojsonl", ".kml", ".cot"])
def test_chunks_change_no_bit(tmp_path: Path, suffix: str) -> None:
    path = table(tmp_path / "points.csv", extra=True)
    whole = written(suffix, path, 10_000)
    assert whole.count(b"p200") >= 1
    assert written(suffix, path, 10_000, piece=1) == whole
    assert written(suffix, path, 10_000, piece=64) == whole


def test_a_streamed_table_is_that_of_one_call_to_the_last_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks are the pieces in which the localizer does many points anyway."""
    assert tables.CHUNK_ROWS == stereo.CHUNK
    monkeypatch.setattr(stereo, "CHUNK", 100)
    locate, both = locator_of_everything(), pixels()
    found = locate.localize(both[:, 0], both[:, 1])
    rows = csv.DictReader(io.StringIO(written(".csv", table(tmp_path / "points.csv"), 100).decode()))
    for row, status, geodetic, low in zip(rows, found.status, found.geodetic, found.range_low, strict=True):
        assert row["status"] == PositionStatus(int(status)).name.lower()
        if row["status"] == "ok":
            cells = [float(row[name]) for name in ("lat", "lon", "height_ellipsoidal_m", "range_low_m")]
            assert cells == [*geodetic.tolist(), low.item()]


def test_numbers_are_those_of_the_localizer_to_the_last_bit() -> None:
    locate, both = locator_of_everything(), pixels()
    columns = locate(Marks([str(i) for i in range(ROWS)], both))
    found = locate.localize(both[:, 0], both[:, 1])
    slopes = locate.localize.sensitivity(both[:, 0], both[:, 1])
    assert np.array_equal(columns.status, found.status.numpy())
    ok = (found.status == int(PositionStatus.OK)).numpy()
    aimed = ok | np.isin(columns.status, [PositionStatus.BEARING_ONLY, PositionStatus.PARALLEL])
    assert 150 < ok.sum() < aimed.sum() < ROWS
    for where, first, values in (
        (ok, "lat", found.geodetic),
        (ok, "east_m", found.enu),
        (ok, "range_m", 1.0 / found.inverse_range[:, None]),
        (ok, "cov_ee_m2", found.covariance.flatten(1)[:, [0, 1, 2, 4, 5, 8]]),
        (ok, "range_low_m", torch.stack([found.range_low, found.range_high], -1)),
        (ok, "cep50_m", circular_error(found.enu, found.covariance)),
        (ok, "range_m_per_px", torch.stack(slopes, -1)),
        (aimed, "azimuth_deg", azimuth_elevation(found.bearing)),
        (ok, "reprojection_left_px", found.reprojection),
    ):
        start = NUMBERS.index(first)
        own = columns.numbers[:, start : start + values.shape[1]]
        assert np.array_equal(own[where], values.numpy()[where]), first
        assert np.isnan(own[~aimed]).all()


def test_positions_and_columns_are_the_same() -> None:
    columns = locator_of_everything()(Marks([str(i) for i in range(ROWS)], pixels()))
    located = locator_of_everything().located(columns)
    fields = {
        "lat": "lat", "lon": "lon", "height": "height_ellipsoidal_m", "geoid_height": "geoid_height_m",
        "range_m": "range_m", "range_low_m": "range_low_m", "range_high_m": "range_high_m", "cep50_m": "cep50_m",
        "cep95_m": "cep95_m", "meters_per_pixel": "range_m_per_px", "meters_per_degree": "range_m_per_deg_yaw",
        "azimuth_deg": "azimuth_deg", "elevation_deg": "elevation_deg",
    }  # fmt: skip
    groups = {
        "enu": ("east_m", "north_m", "up_m"),
        "covariance": tuple(f"cov_{key}_m2" for key in ("ee", "en", "eu", "en", "nn", "nu", "eu", "nu", "uu")),
        "reprojection_px": ("reprojection_left_px", "reprojection_right_px"),
    }
    assert len(located.positions) == ROWS
    for row, position in enumerate(located.positions):
        assert (position.name, position.reason) == (columns.names[row], columns.reasons[row])
        assert int(position.status) == columns.status[row]
        for field, name in fields.items():
            value, wanted = getattr(position, field), columns.column(name)[row]
            assert math.isnan(wanted) if value is None else value == wanted
        for field, names in groups.items():
            value, wanted = getattr(position, field), [columns.column(name)[row] for name in names]
            assert np.isnan(wanted).all() if value is None else np.ravel(value).tolist() == wanted
    assert np.array_equal(located.enu.numpy(), columns.numbers[:, 4:7], equal_nan=True)
    assert located.count == sum(position.lat is not None for position in located.positions)


def test_a_long_list_of_points_is_located_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    both = pixels()
    cov = (torch.rand(ROWS, 1, 1, dtype=torch.float64) + 0.1) * torch.eye(4, dtype=torch.float64)
    for options in ({}, {"cov": cov}, {"cov": cov[:1]}):
        whole = located_pairs(real_rig(), both[:, 0], both[:, 1], origin=ORIGIN, heading_deg=0.0, **options)
        monkeypatch.setattr("kcal.locate.points.CHUNK_ROWS", 50)
        pieces = located_pairs(real_rig(), both[:, 0], both[:, 1], origin=ORIGIN, heading_deg=0.0, **options)
        monkeypatch.undo()
        one, other = whole.columns, pieces.columns
        assert (one.names, one.status.tolist()) == (other.names, other.status.tolist())
        # The piece decides when Newton's method ends.
        assert np.allclose(one.numbers, other.numbers, rtol=1e-9, atol=1e-9, equal_nan=True)


def test_further_columns_are_carried(tmp_path: Path) -> None:
    path = table(tmp_path / "points.csv", extra=True)
    rows = list(csv.DictReader(io.StringIO(written(".csv", path, 100).decode())))
    # A spreadsheet must not compute a class, and a number is as it was written.
    assert [rows[7][name] for name in ("name", "class", "score", "track")] == ["p7", "'=boat 7", "0.007", "0007"]
    points = [feature for feature in json.loads(written(".geojson", path, 100))["features"] if "status" in
              feature["properties"]]  # fmt: skip
    assert [points[7]["properties"][name] for name in ("class", "score", "track")] == ["=boat 7", 0.007, "0007"]
    with pytest.raises(FileError, match="unknown column 'class'"):
        read_marks(path)


@pytest.mark.parametrize(
    ("cell", "value"),
    [
        ("", None),
        ("-1.50e3", -1500.0),
        ("9007199254740993", "9007199254740993"),
        ("nan", "nan"),
        ("+1", "+1"),
        ("9" * 5000, "9" * 5000),
        ("1e999", "1e999"),
        ("-9007199254740992", -9007199254740992),
    ],
)
def test_cells_of_further_columns_in_json(tmp_path: Path, cell: str, value: object) -> None:
    path = tmp_path / "points.csv"
    path.write_text(f"left_u,left_v,right_u,right_v,more,end\n960,540,950,540,{cell},x\n")
    features = [json.loads(line) for line in written(".geojsonl", path, 10).splitlines()]
    assert features[2]["properties"]["more"] == value


def with_names(path: Path, names: list[str]) -> Path:
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["name", "left_u", "left_v", "right_u", "right_v"])
        out.writerows([name, 960, 540, 950, 540] for name in names)
    return path


def test_names_that_would_act_are_texts_and_come_back(tmp_path: Path) -> None:
    names = ["=1+1", "@a", "-5", "-5 m", "a,b", 'say "x"', "semi;colon", "'quoted'"]
    path = with_names(tmp_path / "points.csv", names)
    assert [name for chunk, _ in read_mark_chunks(path) for name in chunk.names] == names
    text = written(".csv", path, 10).decode()
    column = [row["name"] for row in csv.DictReader(io.StringIO(text))]
    assert column[:4] == ["'=1+1", "'@a", "-5", "'-5 m"]
    # The same table as kcal wrote it, its marks put back.
    again = with_names(tmp_path / "again.csv", column)
    assert [name for chunk, _ in read_mark_chunks(again) for name in chunk.names] == names
    # A name that begins as if it had been guarded is guarded once more.
    located = located_pairs(real_rig(), *pixels()[:1].unbind(1), names=["'=1"], origin=ORIGIN, heading_deg=0.0)
    text = write_positions(tmp_path / "guarded.csv", located).read_text(encoding="utf-8")
    assert text.splitlines()[1].startswith("''=1,")


def test_columns_that_positions_have_too_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("left_u,left_v,right_u,right_v,status\n960,540,950,540,x\n")
    with pytest.raises(InputError, match="a column 'status'"):
        written(".csv", path, 10)
    path.write_text("Name,left_u,left_v,right_u,right_v\nx,960,540,950,540\n")
    with pytest.raises(FileError, match="did you mean 'name'"):
        written(".csv", path, 10)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("bad,1,2,three,4", "line 11: right_u is 'three'"),
        ("bad,1,2,nan,4", "line 11: right_u is 'nan'"),
        ("bad,1,2,null,4", "line 11: right_u is 'null'"),
        ("bad,1,2,true,4", "line 11: right_u is 'true'"),
        ("bad,1,2,1_0,4", "line 11: right_u is '1_0'"),
        ("bad,1,2,,4", "line 11: right_u is empty"),
        ("bad,1,2,3", "line 11: 4 fields, the header has 5"),
        ("a1,1,2,3,4", "line 11: the name 'a1' was used on line 3"),
        (",1,2,3,4", "line 11: the name is empty"),
        ('"bad,1,2,3,4', "line 13: .*check the quotation marks"),
        ("b\0d,1,2,3,4", "not a text file"),
    ],
)
@pytest.mark.parametrize("quoted", [False, True])
def test_a_bad_line_of_the_third_chunk_is_named(tmp_path: Path, line: str, message: str, quoted: bool) -> None:
    path = tmp_path / "points.csv"
    name = '"a1"' if quoted else "a1"
    lines = ["name,left_u,left_v,right_u,right_v", "a0,960,540,950,540", f"{name},960,540,950,540"]
    lines += [f"a{i},960,540,950,540" for i in range(2, 9)]
    path.write_text("\n".join([*lines, line, "z1,1,2,3,4", "z2,1,2,3,4"]) + "\n")
    with pytest.raises(FileError, match=message):
        list(read_mark_chunks(path, at_once=4))


def test_blank_and_folded_lines_keep_their_numbers(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    header, rows = b"name,left_u,left_v,right_u,right_v\r\n", b'\r\n"two\nlines",1,2,3,4\r\nb, 1,2 ,3,+4\r\n,,,,\r\n'
    path.write_bytes(header + rows + b"c,1,2,x,4\r\n")
    for at_once in (1, 2, 3, 100):
        with pytest.raises(FileError, match="line 7: right_u is 'x'"):
            list(read_mark_chunks(path, at_once=at_once))
    path.write_bytes(path.read_bytes().replace(b"x", b"5."))
    for at_once in (1, 2, 3, 100):
        chunks = [chunk for chunk, _ in read_mark_chunks(path, at_once=at_once)]
        assert [name for chunk in chunks for name in chunk.names] == ["two\nlines", "b", "c"]
        assert torch.cat([chunk.pixels for chunk in chunks]).flatten(1).tolist() == [[1, 2, 3, 4]] * 2 + [[1, 2, 5, 4]]


def test_plain_lines_are_read_like_any(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = table(tmp_path / "points.csv", extra=True)
    quick = [chunk for chunk, _ in read_mark_chunks(path, at_once=100)]
    monkeypatch.setattr(tables, "_split_plain", lambda texts, names: None)
    for one, (other, _) in zip(quick, read_mark_chunks(path, at_once=100), strict=True):
        assert (list(one.names), one.extras) == (list(other.names), other.extras)
        assert torch.equal(one.pixels, other.pixels)


def test_number_lines_keep_every_digit() -> None:
    values = np.array([0.1, 1 / 3, 5e-324, 1.7976931348623157e300, -0.0, 1e16, 1e-5, 123456789.0, math.inf, math.nan])
    (line,) = number_lines(values[None])
    cells = line.split(",")
    assert [float(cell) for cell in cells[:-1]] == values[:-1].tolist()
    assert (cells[-2], cells[-1]) == ("inf", "")


def test_a_sample_is_even_and_does_not_depend_on_chunks() -> None:
    def sampled(size: int) -> PositionSample:
        sample = PositionSample(frozenset({"7", "247"}), most=20)
        columns = locator_of_everything()(Marks([str(i) for i in range(ROWS)], pixels()))
        for piece in columns.pieces(size):
            sample.add(piece)
        return sample

    locate = locator_of_everything()
    whole = sampled(1000).located(locate)
    names = [position.name for position in whole.positions]
    assert names == sorted([*map(str, range(0, ROWS, 16)), "7", "247"], key=int)
    assert whole.count_note.endswith(", a sample of the 250 in the table")
    for size in (1, 10, 100):
        sample = sampled(size)
        assert sample.located(locate).positions == whole.positions
        assert sample.located(locate).rows == whole.rows
        assert sum(sample.statuses.values()) == ROWS
    assert sample.statuses["outside_image"] == 1


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    save_rig(real_rig(), tmp_path / "rig.json")
    table(tmp_path / "points.csv", extra=True)
    monkeypatch.chdir(tmp_path)
    read = marks.read_chunks
    monkeypatch.setattr(marks, "read_chunks", lambda *a, **options: read(*a, **options | {"at_once": 100}))
    return tmp_path


LOCATE = "locate rig.json points.csv --site=-33.9,151.2,40 --heading 200"


def test_what_is_interrupted_leaves_old_files_as_they_were(
    folder: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    (folder / "out.csv").write_text("old")
    before = contents()
    calls: Iterator[int] = iter(range(10))
    explain = points._pair_reason

    def stops(*arguments: object) -> str:
        if next(calls) == 3:
            raise KeyboardInterrupt
        return explain(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(points, "_pair_reason", stops)
    said = command(LOCATE, "-o out.csv -o out.geojson", code=130).err
    assert "interrupted after 200 rows; written: nothing" in said
    assert contents() == before


def test_a_line_that_cannot_be_read_leaves_old_files_as_they_were(folder: Path, command: Command) -> None:
    (folder / "out.csv").write_text("old")
    lines = (folder / "points.csv").read_text().splitlines()
    lines[230] = lines[230].replace(",", ",x", 1)
    (folder / "points.csv").write_text("\n".join(lines))
    assert "points.csv: line 231: left_u is 'x" in command.refuses(LOCATE, "-o out.csv -o out.kml")


def test_long_tables_are_summed_up(folder: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    (folder / "truth.csv").write_text("name,east,north,up\np5,1,2,3\n")
    monkeypatch.setattr(PositionSample.__init__, "__defaults__", (frozenset(), 20))
    printed = command(LOCATE, "--truth truth.csv --map map.html -o out.csv").out
    assert "250 rows: " in printed
    assert [line.split()[0] for line in printed.splitlines()[2:4]] == ["name", "p5"]
    assert "a sample of the 250 in the table" in (folder / "map.html").read_text()
    assert len((folder / "out.csv").read_text().splitlines()) == ROWS + 1


def test_one_stream(folder: Path, command: Command) -> None:
    printed = command(LOCATE, "-o - -o out.csv")
    assert printed.out == (folder / "out.csv").read_text()
    assert "250 rows: " in printed.err
    lines = command(LOCATE, "-o - --format geojsonl").out.splitlines()
    kinds = [json.loads(line)["properties"]["kind"] for line in lines]
    assert kinds[:6] == ["camera", "camera", "point", "region", "point", "region"]
    command(LOCATE, "-o - --json", code=2)
    command(LOCATE, "-o - --format shp", code=1)


def test_a_summary_for_programs(folder: Path, command: Command) -> None:
    summary = json.loads(command(LOCATE, "--json -o out.csv").out)
    assert (summary["rows"], summary["wrote"]) == (ROWS, ["out.csv"])
    assert summary["statuses"]["ok"] == sum(row["status"] == "ok" for row in rows_of(folder / "out.csv"))
