"""Files of the wrong kind and damaged ones, small commands for boards and lookups."""

import dataclasses
import itertools
import json
import random
import shlex
import shutil
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from calibrate_scenes import observe
from command_line import Command, invoked, ran
from printed_boards import printed_points, printed_views
from typer.main import get_command

from kcal import Board, Camera, FileError, KcalError, Observations, View, load_camera, load_rig, save_camera, save_rig
from kcal.calibrate import load_measured_board
from kcal.cli.main import app
from kcal.file_kind import file_kind
from kcal.lens import load_lookup
from scripts.fuzz import commands as fuzz
from scripts.fuzz.damage import damage_json

# Every command with every file in the wrong place: what it is, what is needed, and a command that can be pasted.


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
    ("foreign.yaml", "picture.png"),
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
    """Every wrong file in place of every right one, and some of them at each place of each command."""
    places = []
    for line in LINES:
        words = line.split()
        inputs = [
            place for place, word in enumerate(words) if words[place - 1] != "-o" and word in (*FILES, "right.json")
        ]
        places += [(line, place) for place in inputs]
    alike = Counter(line.split()[place] for line, place in places)
    found, turns = [], Counter[str]()
    for line, place in places:
        words = line.split()
        right = words[place]
        turns[right] += 1
        for number, wrong in enumerate(FILES):
            if right == wrong or (right, wrong) in FINE or (number - turns[right]) % min(alike[right], 3):
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
        ("rig right.json camera.json --baseline 10±1 -o n", "kcal rig camera.json right.json --baseline '10±1' -o n"),
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
    Observations.load("seen.json").model_copy(update={"image_size": (1280, 720)}).save("small.json")
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
    for camera, side in zip([load_camera("camera.json"), load_camera("right.json")], names, strict=True):
        record = dataclasses.replace(
            camera.calibration.record, per_view_rms={f"{side}-{name}": rms for name, rms in names[side].items()}
        )
        camera.calibration = dataclasses.replace(camera.calibration, record=record)
        save_camera(camera, f"{side}.camera.json")
    line = "rig left.camera.json right.camera.json --pairs right.obs.json left.obs.json -o n.json"
    text = run(line.split(), monkeypatch)
    assert "exchanged" in text
    assert text.endswith("kcal rig left.camera.json right.camera.json --pairs left.obs.json right.obs.json -o n.json")


# A short seeded run of `scripts/fuzz/commands.py`, and that it sees what it is there for.


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return fuzz.make_files(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("case", [*range(24), 134, 1171])
def test_nothing_is_found(case: int, whole: dict[str, bytes]) -> None:
    fuzz.run_case(case, whole)


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
    fuzz.run_case(case, small)

    def lenient(path: Path) -> object:
        return json.loads(path.read_bytes())

    monkeypatch.setitem(fuzz.COMMANDS, "board.json", [lenient])
    with pytest.raises(AssertionError, match="must be refused"):
        fuzz.run_case(case, small)
    monkeypatch.setitem(fuzz.COMMANDS, "board.json", [lambda _: 1 / 0])
    with pytest.raises(ZeroDivisionError):
        fuzz.run_case(case, small)


# `kcal board`: printing is the default, measuring a command of its own.


BOARD = Board(columns=8, rows=6, square=0.03)

SIZE = (1280, 960)


def capture(folder: Path, name: str, points: torch.Tensor, seed: int) -> Path:
    camera = Camera.build(focal=(800, 800), center=(645, 476), size=SIZE, coefficients=[-0.12, 0.03], model="opencv5")
    pixels = printed_views(camera, BOARD, points, 8, seed, noise=0.1)
    return observe(pixels, board=BOARD, size=SIZE).save(folder / f"{name}.obs.json")


@pytest.mark.slow
def test_one_board(tmp_path: Path) -> None:
    points = printed_points(BOARD, 3)
    output, picture = tmp_path / "plate.board.json", tmp_path / "plate.png"
    files = [capture(tmp_path, name, points, seed) for name, seed in (("left", 1), ("right", 2))]
    result = invoked("board", "measure", *files, "-o", output, "--picture", picture)
    board = load_measured_board(output)
    assert (board.name, board.observations) == ("plate", ("left", "right"))
    assert f"bending {1e3 * board.bending.value:.3f} ± {1e3 * board.bending.sigma:.3f} mm" in result
    assert "2 of 2 observations: left, right" in result
    assert "evidence that they saw one board" in result
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_two_boards(tmp_path: Path) -> None:
    files = [capture(tmp_path, name, printed_points(BOARD, seed), seed) for name, seed in (("left", 3), ("right", 4))]
    result = invoked("board", "measure", *files, "-o", tmp_path / "plate.board.json")
    assert "these observations show 2 boards" in result
    assert load_measured_board(tmp_path / "plate.board.json").observations == ("left",)


def test_refusals(tmp_path: Path) -> None:
    for arguments, message in (
        (["none.obs.json", "-o", tmp_path / "x.board.json"], "cannot read"),
        ([tmp_path / "a.obs.json", "-o", tmp_path / "none" / "x.board.json"], "does not exist"),
    ):
        result = ran("board", "measure", *arguments)
        assert isinstance(result.exception, FileError)
        assert message in str(result.exception)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [["board"], ["board", "print"]])
def test_printing_is_the_default(tmp_path: Path, command: list[str]) -> None:
    output = tmp_path / "board.svg"
    invoked(*command, "--board", "9x6", "--square", "25mm", "-o", output)
    assert output.read_bytes().startswith(b"<?xml")


# `kcal bake`: tables beside the camera, with their error in words.


def test_it_writes_what_it_says(tmp_path: Path, command: Command) -> None:
    camera = Camera.build(focal=(60, 60), center=(31, 24), size=(64, 48), coefficients=[-0.2, 0.02, 1e-3, -1e-3])
    said = command("bake", save_camera(camera, tmp_path / "left.camera.json"), "--tolerance 1e-4").out
    lookup = load_lookup(tmp_path / "left_lookup.npz")
    assert lookup.source == camera.fingerprint
    assert max(lookup.bound) <= 1e-4
    for bound in lookup.bound:
        assert f"error at most {bound:.1e} px" in said
    assert "left_lookup.npz" in said
    assert "answers for" not in said


def test_it_refuses(tmp_path: Path, command: Command) -> None:
    assert "cannot read" in command("bake", tmp_path / "none.json", code=1).err
    camera = Camera.build(focal=(60, 60), center=(31, 24), size=(64, 48), model="pinhole")
    path = save_camera(camera, tmp_path / "left.camera.json")
    assert "input" in command("bake", path, "-o", path, code=1).err
    command("bake", path, "--tolerance 0", code=2)
    # A table fine enough for a focal length of 1 px would take minutes, only to fail.
    camera = Camera.build(focal=(60, 0.1), center=(31, 24), size=(64, 48), coefficients=[-0.2, 0.05])
    assert "check the camera's focal lengths" in command("bake", save_camera(camera, path), code=1).err
