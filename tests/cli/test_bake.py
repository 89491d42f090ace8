"""`kcal bake`: tables beside the camera, with their error in words."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from kcal.cli.main import main
from kcal.io.camera_file import save_camera
from kcal.io.lookup_file import load_lookup
from kcal.lens.camera import Camera


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["kcal", "bake", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    return int(stop.value.code or 0)


def test_it_writes_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = Camera.build(focal=(60, 60), center=(31, 24), size=(64, 48), coefficients=[-0.2, 0.02, 1e-3, -1e-3])
    path = save_camera(camera, tmp_path / "left.camera.json")
    assert run(monkeypatch, str(path), "--tolerance", "1e-4") == 0
    said = capsys.readouterr().out
    lookup = load_lookup(tmp_path / "left_lookup.npz")
    assert lookup.source == camera.fingerprint
    assert max(lookup.bound) <= 1e-4
    for bound in lookup.bound:
        assert f"error at most {bound:.1e} px" in said
    assert "left_lookup.npz" in said
    assert "answers for" not in said


def test_it_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, str(tmp_path / "none.json")) == 1
    assert "cannot read" in capsys.readouterr().err
    camera = Camera.build(focal=(60, 60), center=(31, 24), size=(64, 48), model="pinhole")
    path = save_camera(camera, tmp_path / "left.camera.json")
    assert run(monkeypatch, str(path), "-o", str(path)) == 1
    assert "input" in capsys.readouterr().err
    assert run(monkeypatch, str(path), "--tolerance", "0") == 2
    # A table fine enough for a focal length of 1 px would take minutes, only to fail.
    camera = Camera.build(focal=(60, 0.1), center=(31, 24), size=(64, 48), coefficients=[-0.2, 0.05])
    assert run(monkeypatch, str(save_camera(camera, path))) == 1
    assert "check the camera's focal lengths" in capsys.readouterr().err
