"""Keys that must differ, in memory and beyond it: found if they are doubled, and only then."""

import errno
import random
import tempfile
from pathlib import Path
from unittest.mock import Mock

import pytest
from command_line import ran
from locate_rigs import real_rig

from kcal import FileError, save_rig
from kcal.locate import marks, tables
from kcal.locate.marks import read_mark_chunks
from kcal.locate.tables import DistinctKeys, Doubled, read_chunks


@pytest.fixture(autouse=True)
def little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_IN_MEMORY", 16)


def found(keys: list[str], step: int) -> Doubled | None:
    checked = DistinctKeys(Path("marks.csv"), lambda: zip(keys, range(2, 2 + len(keys)), strict=True))
    parts = (checked.add(keys[start : start + step]) for start in range(0, len(keys), step))
    doubled = next((one for one in parts if one is not None), None) or checked.finish()
    assert len(checked._latest) < 16 + step
    checked.close()
    return doubled


@pytest.mark.parametrize("unlike", [None, 100, 5, 1], ids=lambda unlike: f"hashes {unlike or 'as they are'}")
@pytest.mark.parametrize("step", [1, 7, 16, 1000])
@pytest.mark.parametrize("count", [1, 15, 16, 17, 300])
def test_a_doubled_key_is_found_wherever_it_is(
    count: int, step: int, unlike: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where unlike keys have equal hashes."""
    if unlike is not None:
        own = lambda key: (hash(key) % unlike - unlike // 2) << 56  # noqa: E731
        monkeypatch.setattr(tables, "hash", own, raising=False)
    keys = [f"thing {i}" for i in range(count)]
    assert found(keys, step) is None
    draw = random.Random(count)
    for _ in range(5):
        first, again = sorted(draw.sample(range(count + 1), 2))
        assert found([*keys[:again], keys[first], *keys[again:]], step) == (keys[first], 2 + first, 2 + again)


def test_a_table_that_is_longer_than_memory(tmp_path: Path) -> None:
    path = tmp_path / "long.csv"
    lines = ["name,u", *(f"a{i},{i}" for i in range(100))]
    path.write_text("\n".join(lines) + "\n")
    assert sum(len(chunk.names) for chunk in read_chunks(path, "name,u", ("name", "u"), ("u",), at_once=10)) == 100
    path.write_text("\n".join([*lines, '"a1",7']) + "\n")
    with pytest.raises(FileError, match=r"long.csv: line 102: the name 'a1' was used on line 3; names must differ"):
        list(read_chunks(path, "name,u", ("name", "u"), ("u",), at_once=10))


def test_a_long_table_of_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(marks, "_WHOLE", 0)
    monkeypatch.setattr(marks, "read_chunks", lambda *given, **more: read_chunks(*given, **more, at_once=8))
    path = tmp_path / "views.csv"
    lines = ["name,camera,u,v,time", *(f"a{i // 2 % 50},{'lr'[i % 2]},{i},1,{i // 100}" for i in range(300))]
    path.write_text("\n".join(lines) + "\n")
    parts = [views for views, _ in read_mark_chunks(path, ("l", "r"))]
    assert len({name for views in parts for name in views.names}) == 150
    path.write_text("\n".join([*lines, "a3,l,1,2,0"]) + "\n")
    with pytest.raises(
        FileError, match=r"line 302: lines of 'a3' stand at several places; .* sort it by name and time"
    ):
        list(read_mark_chunks(path, ("l", "r")))


def test_nothing_is_written_of_a_refused_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_rig(real_rig(), tmp_path / "rig.json")
    rows = [f"a{i},320,240,310,240" for i in range(40)]
    (tmp_path / "marks.csv").write_text("\n".join(["name,left_u,left_v,right_u,right_v", *rows, rows[0]]) + "\n")
    whole = tables.read_chunks
    monkeypatch.setattr("kcal.locate.marks.read_chunks", lambda *given, **more: whole(*given, **more | {"at_once": 5}))
    words = ["locate", str(tmp_path / "rig.json"), str(tmp_path / "marks.csv"), "-o", str(tmp_path / "out.csv")]
    words += ["--site", "0,0,0", "--heading", "0"]
    assert "line 42: the name 'a0' was used on line 2" in str(ran(*words).exception)
    assert not (tmp_path / "out.csv").exists()


def test_a_full_disk_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(tempfile, "TemporaryFile", Mock(side_effect=full))
    with pytest.raises(FileError, match=r"marks.csv: .* No space left on device; set TMPDIR to a folder"):
        found([f"thing {i}" for i in range(17)], 4)
