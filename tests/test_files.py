"""Files are whole or absent, and are what they say they are."""

from __future__ import annotations

import json
import math
import os
import stat
from pathlib import Path
from typing import ClassVar

import pytest

from kcal.errors import FileError, InputError
from kcal.files import NativeFile, check_writable, dump_json, write_atomic


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

        def full(*_: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
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

    def test_refused_early(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(FileError, match="is a folder"):
            check_writable(tmp_path)
        with pytest.raises(FileError, match="does not exist; make it first"):
            check_writable(tmp_path / "missing" / "a.txt")
        monkeypatch.setattr(os, "access", lambda *_: False)
        with pytest.raises(FileError, match="no permission"):
            check_writable(tmp_path / "a.txt")


class TestJson:
    @pytest.mark.parametrize("value", [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -0.0, 2**53 + 0.0])
    def test_floats_are_exact(self, value: float) -> None:
        back = json.loads(dump_json({"v": value}))["v"]
        assert (back, math.copysign(1, back)) == (value, math.copysign(1, value))

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_what_json_has_not(self, value: float) -> None:
        with pytest.raises(InputError, match="not finite"):
            dump_json({"v": [value]})


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
