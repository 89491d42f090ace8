"""Every command with every file in the wrong place: what it is, what is needed, and a command that can be pasted."""

from __future__ import annotations

import dataclasses
import itertools
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.main import get_command

from kcal import Board, Observations, View, load_camera, load_rig, save_camera, save_rig
from kcal.cli.main import app
from kcal.errors import KcalError
from kcal.file_kind import file_kind

ROOT = Path(__file__).parents[2]
# Each line is right; the words that name files are exchanged one by one.
LINES = [
    "calibrate seen.json -o new.json",
    "calibrate seen.json -o new.json --camera camera.json",
    "calibrate seen.json -o new.json --board-shape board.json",
    "compare seen.json --model opencv5",
    "interpolate camera.json --setting focus=2 -o new.json",
    "detect picture.png --board 9x6 --square 25mm -o new.json",
    "rectify camera.json picture.png -o straight",
    "bake camera.json -o new.npz",
    "board measure seen.json -o new.json",
    "diff camera.json rig.json:left",
    "export camera.json -o new.yaml",
    "import foreign.yaml -o new.json",
    "show camera.json",
    "report camera.json --observations seen.json",
    "budget rig.json",
    "locate rig.json marks.csv --truth survey.csv",
    "live rig.json --detections lines.jsonl -o new.csv",
    "mark picture.png picture.png --rig rig.json -o new.csv --landmarks survey.csv",
    "mark picture.png picture.png --reference marks.csv --reference-images picture.png picture.png -o new.csv",
    "rig camera.json right.json --pairs seen.json seen.json -o new.json",
    "rig camera.json right.json --landmarks survey.csv --marks marks.csv -o new.json",
    "rig camera.json right.json --positions survey.csv --features marks.csv -o new.json",
    "rig check rig.json --marks marks.csv --landmarks survey.csv",
    "rig check rig.json --marks marks.csv --reference marks.csv",
]
FILES = {
    "camera.json": "camera",
    "rig.json": "rig",
    "seen.json": "observations",
    "marks.csv": "marks",
    "survey.csv": "survey",
    "picture.png": "image",
    "empty.json": "empty",
    "folder": "folder",
    "foreign.yaml": "foreign",
    "other.json": "json",
    "board.json": "board",
}
# Of these, a file of the other kind will do as well, or the reader says more of what is wrong in it.
FINE = {
    ("picture.png", "folder"), ("picture.png", "empty.json"), ("picture.png", "foreign.yaml"),
    ("survey.csv", "other.json"), ("right.json", "camera.json"), ("rig.json", "camera.json:left"),
    *itertools.product(["foreign.yaml"], ["camera.json", "rig.json", "marks.csv", "survey.csv", "other.json"]),
}  # fmt: skip

ANY_CAMERA = ("rig.json", "seen.json", "foreign.yaml", "other.json")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    rig = load_rig(ROOT / "assets" / "sample-rig.json")
    save_rig(rig, folder / "rig.json")
    save_camera(rig.left, folder / "camera.json")
    save_camera(rig.right, folder / "right.json")
    pixels = tuple((100.0 + 50.0 * column, 100.0 + 50.0 * row) for row in range(3) for column in range(4))
    view = View(name="a.png", pixels=pixels)
    Observations(board=Board(columns=4, rows=3, square=0.1), image_size=(1920, 1080), views=(view,)).save(
        folder / "seen.json"
    )
    (folder / "marks.csv").write_text("name,left_u,left_v,right_u,right_v\na,1,2,3,4\n")
    (folder / "survey.csv").write_text("name,lat,lon,height,sigma\na,1,2,3,4\n")
    cv2.imwrite(str(folder / "picture.png"), np.arange(64 * 64, dtype=np.uint8).reshape(64, 64))
    (folder / "empty.json").touch()
    (folder / "folder").mkdir()
    (folder / "foreign.yaml").write_text("%YAML:1.0\n---\nK: 1\n")
    (folder / "other.json").write_text('{"a": 1}')
    (folder / "board.json").write_text('{"kcal": "board", "version": 1}')
    (folder / "lines.jsonl").write_text("{}\n")
    return folder


COMMANDS = get_command(app)


def run(words: list[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """What a command says of an input before it ends."""
    # A marking page that opens in spite of a wrong file ends at once.
    monkeypatch.setattr("kcal.web.serving.LocalServer.run", lambda server: None)
    with pytest.raises(KcalError) as refused:
        COMMANDS.main(args=words, prog_name="kcal", standalone_mode=False)
    return str(refused.value)


def test_kinds_are_found_by_content(folder: Path) -> None:
    assert {name: file_kind(folder / name) for name in FILES} == FILES


def accepted(words: list[str]) -> bool:
    """Whether the command line takes these words."""
    command = COMMANDS
    while hasattr(command, "commands"):
        named = words[0] in command.commands
        command = command.commands[words[0]] if named else next(iter(command.commands.values()))
        words = words[1:] if named else words
    command.make_context(command.name, list(words))
    return True


def cases() -> list[object]:
    found = []
    for line in LINES:
        words = line.split()
        for place, wrong in itertools.product(range(len(words)), FILES):
            right = words[place]
            outputs = words[place - 1] == "-o"
            if right not in (*FILES, "right.json") or outputs or right == wrong or (right, wrong) in FINE:
                continue
            # These commands take cameras of any program.
            if words[0] in ("diff", "export", "show", "report") and place < 3 and wrong in ANY_CAMERA:
                continue
            if words[0] == "rectify" and place == 1 and wrong in set(ANY_CAMERA) - {"seen.json"}:
                continue
            found.append(pytest.param(words, place, wrong, id=f"{line} [{place}: {wrong}]"))
    return found


@pytest.mark.parametrize(("words", "place", "wrong"), cases())
def test_a_wrong_file_is_named(
    words: list[str], place: int, wrong: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    text = run([*words[:place], wrong, *words[place + 1 :]], monkeypatch)
    assert text.startswith(f"{wrong}: this is ")
    assert "is needed here" in text
    assert accepted(shlex.split(text.rpartition(": kcal ")[2]))
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("line", "right"),
    [
        ("locate marks.csv rig.json", "kcal locate rig.json marks.csv"),
        ("rectify picture.png camera.json -o s", "kcal rectify camera.json picture.png -o s"),
        ("report seen.json --observations=camera.json", "kcal report camera.json --observations=seen.json"),
        ("bake rig.json -o new.npz", "kcal bake rig.json:left -o new.npz"),
        (
            "rig right.json camera.json --baseline 10±1 -o n.json",
            "kcal rig camera.json right.json --baseline '10±1' -o n.json",
        ),
    ],
)
def test_files_in_each_others_place_are_exchanged(
    line: str, right: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert run(line.split(), monkeypatch).rpartition(": ")[2] == right


def test_the_only_fitting_file_of_a_folder_is_proposed(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rigs").mkdir()
    shutil.copyfile(folder / "rig.json", tmp_path / "rigs" / "a.json")
    shutil.copyfile(folder / "marks.csv", tmp_path / "rigs" / "marks.csv")
    monkeypatch.chdir(tmp_path)
    assert run(["budget", "rigs"], monkeypatch).endswith("Perhaps: kcal budget rigs/a.json")


def test_views_of_another_camera_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    seen = Observations.load("seen.json")
    seen.model_copy(update={"image_size": (1280, 720)}).save("small.json")
    for line in (
        "report camera.json --observations small.json",
        "report rig.json --observations seen.json --observations small.json",
    ):
        text = run(line.split(), monkeypatch)
        assert text.startswith("small.json: images of 1280x720 px, but the camera")
        assert accepted(shlex.split(text.rpartition(": kcal ")[2]))
    Path("small.json").unlink()


def test_views_of_the_left_camera_given_for_the_right_one_are_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    names = {
        side: load_camera(f"{file}.json").calibration.record.per_view_rms
        for side, file in (("left", "camera"), ("right", "right"))
    }
    seen = Observations.load("seen.json")
    for side in names:
        views = tuple(seen.views[0].model_copy(update={"name": f"{side}-{name}"}) for name in names[side])
        seen.model_copy(update={"views": views}).save(f"{side}.obs.json")
    cameras = [load_camera("camera.json"), load_camera("right.json")]
    for camera, side in zip(cameras, names, strict=True):
        record = dataclasses.replace(
            camera.calibration.record, per_view_rms={f"{side}-{name}": rms for name, rms in names[side].items()}
        )
        camera.calibration = dataclasses.replace(camera.calibration, record=record)
        save_camera(camera, f"{side}.camera.json")
    line = "rig left.camera.json right.camera.json --pairs right.obs.json left.obs.json -o n.json"
    text = run(line.split(), monkeypatch)
    assert "exchanged" in text
    assert text.endswith("kcal rig left.camera.json right.camera.json --pairs left.obs.json right.obs.json -o n.json")
