"""A short seeded run of `scripts/fuzz/commands.py`, and that it sees what it is there for."""

from __future__ import annotations

import json
import random
import time
from pathlib import Path

import pytest

from scripts.fuzz import commands as fuzz
from scripts.fuzz.damage import damage_json


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return fuzz.make_files(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("case", [*range(24), 134, 1171])
def test_nothing_is_found(case: int, whole: dict[str, bytes]) -> None:
    assert fuzz.run_case(case, whole, 60.0) == []


@pytest.mark.slow
def test_whole_files_are_accepted(
    whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "u").mkdir()
    for name, content in whole.items():
        (tmp_path / name).write_bytes(content)
    for name, commands in fuzz.COMMANDS.items():
        for command in commands:
            assert fuzz._run(command, tmp_path / name), (command, capsys.readouterr())
    assert fuzz.odd_numbers(tmp_path) == ""


def _case(whole: dict[str, bytes], kind: str, damage: str) -> int:
    """The first case that does this damage to this kind of file."""
    for case in range(20_000):
        rng = random.Random(case)
        right = rng.choice(sorted(whole)) == kind and rng.random() < 0.85
        if right and damage in damage_json(whole[kind], rng)[1]:
            return case
    raise AssertionError("no such case")


def test_what_is_planted_is_found(whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    small = {name: whole[name] for name in ("board.json", "camera.json")}
    case = _case(small, "board.json", ": true")
    assert fuzz.run_case(case, small, 60.0) == []

    def lenient(path: Path) -> object:
        return json.loads(path.read_bytes())

    monkeypatch.setitem(fuzz.COMMANDS, "board.json", [lenient])
    assert [finding.what for finding in fuzz.run_case(case, small, 60.0)] == ["silent number"]
    monkeypatch.setitem(fuzz.COMMANDS, "board.json", [lambda _: 1 / 0])
    assert [finding.what for finding in fuzz.run_case(case, small, 60.0)] == ["traceback"]
    monkeypatch.setitem(fuzz.COMMANDS, "board.json", [lambda _: time.sleep(5)])
    assert [finding.what for finding in fuzz.run_case(case, small, 0.1)] == ["hang"]
