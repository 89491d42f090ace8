"""The published schemas hold for what kcal writes, and refuse what it would refuse."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from command_line import ran

from kcal import Observations, load_camera, load_rig, save_camera, save_rig
from kcal.calibrate.hybrid.measured_board import load_measured_board, save_measured_board
from kcal.cli.cameras import FILES, file_schema

STORED = Path(__file__).parent / "files"
WRITTEN = {
    "camera": "1.0/hybrid.camera.json",
    "rig": "1.0/rig.json",
    "camera-rig": "1.0/camera-rig.json",
    "observations": "1.0/observations.json",
    "board": "1.0/board.json",
}


def content(kind: str, folder: Path) -> dict[str, Any]:
    """A file as the present version writes it."""
    path = STORED / WRITTEN[kind]
    if kind == "camera":
        path = save_camera(load_camera(path), folder / "camera.json")
    elif kind in ("rig", "camera-rig"):
        path = save_rig(load_rig(path), folder / "rig.json")
    elif kind == "observations":
        path = Observations.load(path).save(folder / "seen.json")
    else:
        path = save_measured_board(load_measured_board(path), folder / "board.json")
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("kind", WRITTEN)
def test_what_is_written_fits(kind: str, tmp_path: Path) -> None:
    assert set(FILES) <= set(WRITTEN)
    schema = file_schema(kind.removeprefix("camera-"))
    jsonschema.Draft202012Validator.check_schema(schema)
    written = content(kind, tmp_path)
    jsonschema.validate(written, schema, cls=jsonschema.Draft202012Validator)
    for damage in ({"kcal": "table"}, {"version": 99}, {"unknown": 1}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**written, **damage}, schema)
    first = list(written)[2]
    with pytest.raises(jsonschema.ValidationError, match=first):
        jsonschema.validate({key: value for key, value in written.items() if key != first}, schema)


def test_command() -> None:
    assert json.loads(ran("schema", "board", "--json").stdout)["schema"] == file_schema("board")
    assert json.loads(ran("schema", "rig").stdout) == file_schema("rig")
    assert [line.split()[0] for line in ran("schema").stdout.splitlines()[1:]] == [*FILES]
    assert "no kind of file is called 'car'" in str(ran("schema", "car").exception)
