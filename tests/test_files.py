"""Files: atomic writing, kinds and locks."""

import datetime
import json
import math
import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import Mock

import pydantic
import pytest

from kcal.errors import FileError, InputError
from kcal.file_kind import WORDS, file_kind
from kcal.files import FileLock, check_writable, dump_json, read_bytes, try_lock, write_atomic
from kcal.lens.calibration import Exclusion
from kcal.native_file import NativeFile, digest
from kcal.strict_json import read_json

# Files are whole or absent, and are what they say they are.


def test_a_digest_is_of_the_values_and_not_of_their_order() -> None:
    content = {"kcal": "note", "version": 1, "b": 2.0, "a": {"d": 1, "c": [1, 2]}, "summary": {"of": "x"}}
    turned = {"a": {"c": [1, 2], "d": 1}, "b": 2.0}
    assert digest(content) == digest(turned)
    assert len(digest(content)) == 16
    assert digest({**turned, "b": 3.0}) != digest(turned)


class Note(NativeFile):
    KIND: ClassVar[str] = "note"
    VERSION: ClassVar[int] = 3

    text: str
    number: float = 0.0


class TestWriteAtomic:
    def test_text_and_bytes(self, tmp_path: Path) -> None:
        path = tmp_path / "a.txt"
        assert write_atomic(path, "ä\n") == path
        assert path.read_bytes() == b"\xc3\xa4\n"
        write_atomic(path, b"\x00\xff")
        assert path.read_bytes() == b"\x00\xff"

    def test_failure_leaves_the_old_file_and_nothing_else(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = tmp_path / "a.txt"
        write_atomic(path, "old")
        monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(FileError, match=r"a\.txt: cannot write: No space left"):
            write_atomic(path, "new")
        assert path.read_text() == "old"
        assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]

    def test_permissions_follow_the_umask(self, tmp_path: Path) -> None:
        before = os.umask(0o027)
        try:
            mode = write_atomic(tmp_path / "a.txt", "x").stat().st_mode
        finally:
            os.umask(before)
        assert stat.S_IMODE(mode) == 0o640

    def test_links_and_permissions_stay(self, tmp_path: Path) -> None:
        (tmp_path / "real").mkdir()
        target, link = tmp_path / "real" / "a.txt", tmp_path / "link.txt"
        target.write_text("old")
        target.chmod(0o600)
        link.symlink_to(Path("real", "a.txt"))
        assert write_atomic(link, "new") == link
        assert link.is_symlink()
        assert target.read_text() == "new"
        assert stat.S_IMODE(target.stat().st_mode) == 0o600
        dangling = tmp_path / "dangling.txt"
        dangling.symlink_to(tmp_path / "real" / "b.txt")
        write_atomic(dangling, "b")
        assert (tmp_path / "real" / "b.txt").read_text() == "b"
        loop = tmp_path / "loop.txt"
        loop.symlink_to(loop)
        with pytest.raises(FileError, match=r"loop\.txt: cannot write: .*levels"):
            write_atomic(loop, "x")
        assert {file.name for file in (tmp_path / "real").iterdir()} == {"a.txt", "b.txt"}

    def test_the_umask_is_never_changed(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        changed = AssertionError("other threads would create files with this umask")
        monkeypatch.setattr(os, "umask", Mock(side_effect=changed))
        assert write_atomic(tmp_path / "a.txt", "x").read_text() == "x"

    def test_long_names(self, tmp_path: Path) -> None:
        assert write_atomic(tmp_path / ("a" * 251 + ".txt"), "x").read_text() == "x"
        for write in (check_writable, lambda path: write_atomic(path, "x")):
            with pytest.raises(FileError, match="cannot write: File name too long"):
                write(tmp_path / ("a" * 300))
            with pytest.raises(FileError, match=r"cannot write: .*null"):
                write(tmp_path / "a\0b")

    def test_what_is_no_file_is_not_replaced(self, tmp_path: Path) -> None:
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        for path in (pipe, Path(os.devnull)):
            with pytest.raises(FileError, match="not a regular file"):
                write_atomic(path, "x")
        assert stat.S_ISFIFO(pipe.stat().st_mode)

    def test_refused_early(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(FileError, match="is a folder"):
            check_writable(tmp_path)
        with pytest.raises(FileError, match="does not exist; make it first"):
            check_writable(tmp_path / "missing" / "a.txt")
        monkeypatch.setattr(os, "access", lambda *_: False)
        with pytest.raises(FileError, match="no permission"):
            check_writable(tmp_path / "a.txt")


KILLED = """
import sys
from kcal.files import open_atomic
with open_atomic(sys.argv[1]) as one, open_atomic(sys.argv[2]) as other:
    one.write(b"half")
    one.flush()
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="parts are locked on POSIX systems only")
class TestParts:
    """What a killed process leaves of a file."""

    @staticmethod
    def _start(folder: Path) -> subprocess.Popen[bytes]:
        child = subprocess.Popen(
            [sys.executable, "-c", KILLED, str(folder / "a.csv"), str(folder / "b.csv")], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        )  # fmt: skip
        assert child.stdout.readline() == b"ready\n"
        return child

    def test_the_next_process_removes_its_own(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("kcal.files._parts", {})
        dead = self._start(tmp_path)
        dead.kill()
        dead.wait()
        alive = self._start(tmp_path)
        try:
            # The one that lives was started later, and removed what the dead one had left of both files.
            assert len(list(tmp_path.glob(".kcal-*.part"))) == 2
            (tmp_path / ".kcal-0123456789abcdef.part").write_bytes(b"of something else")
            write_atomic(tmp_path / "a.csv", "x")
            assert len(list(tmp_path.glob(".kcal-*.part"))) == 3
        finally:
            alive.kill()
            alive.wait()
        monkeypatch.setattr("kcal.files._parts", {})
        write_atomic(tmp_path / "a.csv", "y")
        assert len(list(tmp_path.glob(".kcal-*.part"))) == 2
        write_atomic(tmp_path / "b.csv", "y")
        assert [path.name for path in tmp_path.glob(".kcal-*.part")] == [".kcal-0123456789abcdef.part"]


class TestReadBytes:
    def test_content(self, tmp_path: Path) -> None:
        path = tmp_path / "a"
        path.write_bytes(b"abc")
        assert read_bytes(path) == b"abc"
        with pytest.raises(FileError, match="a: 0 MiB; at most 0 MiB are read"):
            read_bytes(path, 2)
        with pytest.raises(FileError, match="cannot read: Is a directory"):
            read_bytes(tmp_path)
        with pytest.raises(FileError, match="cannot read: File name too long"):
            read_bytes(tmp_path / ("a" * 300))

    def test_a_pipe_is_refused_and_not_waited_for(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe")
        for path in (tmp_path / "pipe", Path(os.devnull)):
            with pytest.raises(FileError, match="not a regular file"):
                read_bytes(path)


class TestJson:
    @pytest.mark.parametrize("value", [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -0.0, 2**53 + 0.0])
    def test_floats_are_exact(self, value: float) -> None:
        back = json.loads(dump_json({"v": value}))["v"]
        assert (back, math.copysign(1, back)) == (value, math.copysign(1, value))

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_what_json_has_not(self, value: float) -> None:
        with pytest.raises(InputError, match="not finite"):
            dump_json({"v": [value]})


class TestStrictJson:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("[" * 33 + "]" * 33, "nested deeper than 32 levels"),
            ("[" * 10**6, "nested deeper than 32 levels"),
            ('{"a":' * 10**5, "nested deeper than 32 levels"),
            ('"' + "[" * 100, "not a JSON file"),
            ("1" + "0" * 400, r"the integer 100000000000\.\.\. has 401 digits"),
            ("-1" + "0" * 5000, "has 5002 digits"),
            ('{"a": 1, "b": 2, "a": 3}', "the key 'a' occurs twice"),
            ('{"x": [{"a": 1, "a": 1}]}', "the key 'a' occurs twice"),
            ("\ufeff{}", "BOM"),
        ],
    )
    def test_refused(self, text: str, message: str) -> None:
        with pytest.raises(FileError, match=message) as error:
            read_json(text.encode(), "x.json")
        assert len(str(error.value)) < 200

    def test_size(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("kcal.strict_json.MOST_BYTES", 2**20)
        with pytest.raises(FileError, match="x: 2 MiB of JSON; at most 1 MiB are read"):
            read_json(b"[" + b" " * 2**21, "x")

    def test_read(self) -> None:
        deep = "[" * 32 + "]" * 32
        assert json.dumps(read_json(deep.encode(), "x")) == deep
        brackets = json.dumps(["[" * 100, '\\"' + "{" * 100, "}"])
        assert read_json(brackets.encode(), "x") == json.loads(brackets)
        assert read_json(b"100000000000000000000000", "x") == 10**23


class Block(pydantic.BaseModel):
    on: bool
    sizes: tuple[int, ...]


class Strict(NativeFile):
    KIND: ClassVar[str] = "strict"
    VERSION: ClassVar[int] = 1

    number: float = 0.0
    count: int = 0
    name: str = ""
    when: datetime.datetime | None = None
    block: Block | None = None
    record: Exclusion | None = None
    anything: Any = None


class TestOnlyJsonsTypes:
    @pytest.mark.parametrize(
        ("content", "field"),
        [
            ('"number": true', "number"),
            ('"number": "1.5"', "number"),
            ('"number": 1e400', "number"),
            ('"count": "3"', "count"),
            ('"count": 3.0', "count"),
            ('"count": false', "count"),
            ('"name": 3', "name"),
            ('"when": 3', "when"),
            ('"block": {"on": 1, "sizes": []}', "block.on"),
            ('"block": {"on": true, "sizes": ["1"]}', "block.sizes.0"),
            ('"record": {"name": 1, "reason": ""}', "record.name"),
            ('"anything": NaN', "not finite"),
            ('"anything": [1e999]', "not finite"),
        ],
    )
    def test_refused(self, tmp_path: Path, content: str, field: str) -> None:
        path = tmp_path / "strict.json"
        path.write_text('{"kcal": "strict", "version": 1, ' + content + "}")
        with pytest.raises(FileError, match=f"bad strict file: .*{field}"):
            Strict.load(path)

    def test_read(self, tmp_path: Path) -> None:
        path = tmp_path / "strict.json"
        path.write_text(
            '{"kcal": "strict", "version": 1, "number": 3, "when": "2026-01-01T00:00:00Z", '
            '"block": {"on": true, "sizes": [1, 2]}, "record": {"name": "a", "reason": "b"}}'
        )
        read = Strict.load(path)
        assert (read.number, read.block, read.record) == (3.0, Block(on=True, sizes=(1, 2)), Exclusion("a", "b"))

    def test_a_version_is_a_number(self, tmp_path: Path) -> None:
        path = tmp_path / "strict.json"
        for version in ("true", "1.0", '"1"', "[1]", "{}", "1" * 300):
            path.write_text('{"kcal": "strict", "version": ' + version + "}")
            with pytest.raises(FileError, match="of the strict format; this kcal reads version 1"):
                Strict.load(path)


class TestNativeFile:
    def test_round_trip(self, tmp_path: Path) -> None:
        note = Note(text="Höhe", number=0.1)
        path = note.save(tmp_path / "note.json")
        assert json.loads(path.read_text(encoding="utf-8")) == {
            "kcal": "note",
            "version": 3,
            "text": "Höhe",
            "number": 0.1,
        }
        assert Note.load(path) == note

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("", "not a JSON file"),
            ('{"kcal": "note"', "not a JSON file"),
            ("[1, 2]", "not a kcal file; a kcal note file is needed"),
            ('{"text": "a"}', "not a kcal file"),
            ('{"kcal": "rig", "version": 3}', "this is a kcal rig file; a kcal note file is needed"),
            ('{"kcal": "note", "version": 4, "text": "a"}', "version 4 of the note format; this kcal reads version 3"),
            ('{"kcal": "note", "text": "a"}', "version None"),
            ('{"kcal": "note", "version": 3}', "bad note file: text: Field required"),
            ('{"kcal": "note", "version": 3, "text": "a", "extra": 1}', "bad note file: extra"),
            ('{"kcal": "note", "version": 3, "text": "a", "number": NaN}', "bad note file: number"),
        ],
    )
    def test_refused(self, tmp_path: Path, content: str, message: str) -> None:
        path = tmp_path / "note.json"
        path.write_text(content)
        with pytest.raises(FileError, match=message) as error:
            Note.load(path)
        assert str(error.value).startswith(str(path))
        assert len(str(error.value).splitlines()) == 1

    def test_unreadable(self, tmp_path: Path) -> None:
        with pytest.raises(FileError, match="cannot read: No such file"):
            Note.load(tmp_path / "missing.json")
        with pytest.raises(FileError, match="cannot read"):
            Note.load(tmp_path)
        binary = tmp_path / "binary.json"
        binary.write_bytes(b"\xff\xfe\x00")
        with pytest.raises(FileError, match="not a JSON file"):
            Note.load(binary)


# What a file is, by its first bytes; each of the kinds that messages name.


PNG = b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("a", b"", "empty"),
        ("a", b" \n\t", "empty"),
        ("a.txt", b'{"kcal": "camera", "version": 1}', "camera"),
        ("a.txt", b' \n{ "kcal" : "rig"}', "rig"),
        ("a.json", b'{"version": 1, "kcal": "board"}', "board"),
        ("a.json", b'{"version": 1, "kcal": 5}', "json"),
        ("a.json", b'{"version": 1, "kcal": "board"', "json"),
        ("a.json", b'[1, "kcal"]', "json"),
        ("a.json", b'{"a": 1}', "json"),
        ("a.json", b'\xef\xbb\xbf{"a": 1}', "json"),
        ("a.json", b'{"type": "FeatureCollection", "features": []}', "geojson"),
        ("a.json", b'{"type": "Feature"}', "geojson"),
        ("a.png", b'{"type": "Point"}', "json"),
        ("a.csv", PNG + bytes(50), "image"),
        ("a.txt", b"\xff\xd8\xff\xe0" + bytes(50), "image"),
        ("a.txt", b"BMW, a car, and more than thirty letters of it", "table"),
        ("a", b"\0\0\0\x18ftypmp42", "video"),
        ("a", b"\x1aE\xdf\xa3" + bytes(9), "video"),
        ("a", b"RIFF....AVI LIST", "video"),
        ("a", b"\0\0\1\xba" + bytes(9), "video"),
        ("a.xml", b'<?xml version="1.0"?>\n<gpx version="1.1">', "gpx"),
        ("a.xml", b"<?xml version='1.0'?><opencv_storage>", "foreign"),
        ("a.yml", b"%YAML:1.0\n---\n", "foreign"),
        ("a.yaml", b"cam0:\n  resolution: [1, 2]", "foreign"),
        ("a.yaml", b"image_width: 640", "foreign"),
        ("a.cameramodel", b"# generated\n{ 'lensmodel': 1 }", "foreign"),
        ("a.mat", b"MATLAB 5.0" + bytes(120), "foreign"),
        ("a.npz", b"PK\3\4" + bytes(120), "foreign"),
        ("a.xyz", b"PK\3\4" + bytes(120), "unknown"),
        ("a.html", b"<!DOCTYPE HTML>\n<p>", "page"),
        ("a.html", b"\n<html lang=en>", "page"),
        ("a.csv", b"name,left_u,left_v,right_u,right_v\n", "marks"),
        ("a.csv", b'name;"LEFT_U"\n', "marks"),
        ("a.csv", b"name\tlat\tlon\n", "survey"),
        ("a.csv", b"name, East, up\n", "survey"),
        ("a.csv", b"name,place\n1,2\n", "table"),
        ("a.csv", "name\nHafen\n".encode("utf-8-sig"), "table"),
        ("a.csv", b"words without a comma\n1,2\n", "unknown"),
    ],
)
def test_kinds(name: str, content: bytes, kind: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert file_kind(path) == kind
    assert kind in WORDS


def test_what_is_no_file(tmp_path: Path) -> None:
    assert file_kind(tmp_path) == "folder"
    assert file_kind(tmp_path / "none") == "missing"
    assert file_kind("a\0b") == "missing"
    os.mkfifo(tmp_path / "pipe")
    assert file_kind(tmp_path / "pipe") == "device"


# One process at a time: who has a file is said, and what a process leaves behind locks nothing.


OTHER = (
    "import sys\nfrom pathlib import Path\nfrom kcal.errors import FileError\nfrom kcal.files import FileLock\n"
    "try: lock = FileLock([Path(part) for part in sys.argv[1:]], 'the other')\n"
    "except FileError as error: print(error)\n"
    "else: print('locked')\n"
)


def other(*paths: Path) -> str:
    done = subprocess.run([sys.executable, "-c", OTHER, *map(str, paths)], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_another_process_is_told_who_has_it(tmp_path: Path) -> None:
    a, b, link = tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "link.csv"
    link.symlink_to(a)
    with FileLock([a, link, b], "the first"):
        assert sorted(os.listdir(tmp_path)) == [".a.csv.lock", ".b.csv.lock", "link.csv"]
        written = (tmp_path / ".a.csv.lock").read_text()
        assert written.startswith(f"the first, process {os.getpid()}, since 20")
        assert written.endswith("\n")
        said = other(b)
        assert said.startswith(f"{b}: the first, process {os.getpid()}, since 20")
        assert said.endswith("writes it; end that first, or choose another output")
        # What it got before it was refused it lets go.
        assert other(tmp_path / "c.csv", link).startswith(f"{a}: the first")
        assert not (tmp_path / ".c.csv.lock").exists()
    assert os.listdir(tmp_path) == ["link.csv"]
    assert other(a, b) == "locked"


def test_what_a_process_left_behind_locks_nothing(tmp_path: Path) -> None:
    left = tmp_path / ".a.csv.lock"
    left.write_text("a long text of a process that was killed long ago\n" * 9)
    with FileLock([tmp_path / "a.csv"], "x"):
        assert left.read_text().startswith("x, process ")
        assert left.read_text().count("\n") == 1


def test_a_lock_that_says_nothing(tmp_path: Path) -> None:
    path = tmp_path / ".a.csv.lock"
    handle = os.open(path, os.O_RDWR | os.O_CREAT)
    assert try_lock(handle)
    again = os.open(path, os.O_RDWR)
    assert not try_lock(again)
    with pytest.raises(FileError, match="another process writes it"):
        FileLock([tmp_path / "a.csv"], "x")
    os.close(handle)
    assert try_lock(again)
    os.close(again)


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"cannot lock it with .*\.a\.csv\.lock: No such file"):
        FileLock([tmp_path / "none" / "a.csv"], "x")
