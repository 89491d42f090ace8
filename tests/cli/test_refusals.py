"""Data that are refused: each refusal names what is wrong, and ends with a command that can be pasted."""

from __future__ import annotations

import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import typer
from board_render import homography, render
from calibrate_scenes import BOARD, camera, motions, observe, pixels_of
from locate_rigs import pinhole_rig

from kcal.cli.main import app, main
from kcal.corners.board import Board
from kcal.io.camera_file import save_camera
from kcal.io.rig_file import save_rig

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
PLACES = ["a,0,100,0,0.02", "b,30,120,5,0.02", "c,-30,140,-5,0.02", "d,10,200,3,0.02"]
RIG = "rig left.camera.json right.camera.json -o rig.json --origin 19,72,0"
FEW = "kcal capture camera:0 --board 7x6 --square 50mm -o"
SEEN = "kcal detect images/ --board 7x6 --square 50mm -o"
MARK = "kcal mark left.png right.png"
TWICE = "rig left.camera.json left.camera.json -o rig.json --pairs"
PAIRS = "rig left.camera.json right.camera.json -o rig.json --pairs"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    here = tmp_path_factory.mktemp("refused")
    truth = camera("opencv5")
    pixels = pixels_of(truth, motions(truth, 12, 1), noise=0.05)
    observe(pixels[:2]).save(here / "few.obs.json")
    wild = pixels.clone()
    wild[::2] = wild[::2][:, torch.randperm(42, generator=torch.Generator().manual_seed(0))]
    observe(wild).save(here / "wild.obs.json")
    flat = (
        torch.eye(3).double().expand(6, 3, 3),
        torch.tensor([[-0.15 + 0.02 * i, -0.12, 0.6] for i in range(6)]).double(),
    )
    observe(pixels_of(camera("pinhole"), flat)).save(here / "flat.obs.json")
    for name in ("a", "b"):
        (here / name).mkdir()
        observe(pixels).save(here / name / "left.obs.json")
    observe(pixels[:, :30], board=Board(columns=6, rows=5, square=0.05)).save(here / "other.obs.json")
    observe(pixels, names=[f"x{chr(97 + i)}" for i in range(12)]).save(here / "named.obs.json")
    save_rig(pinhole_rig(), here / "placeless.json")
    for side, focal in (("left", 500.0), ("right", 510.0)):
        save_camera(camera("opencv5", focal), here / f"{side}.camera.json", name=side)
    (here / "survey.csv").write_text("\n".join(["name,east,north,up,sigma", *PLACES]))
    (here / "marks.csv").write_text("name,left_u,left_v,right_u,right_v\na,1,2,3,4\nb,5,6,7,8\nc,9,9,9,9")
    (here / "far.csv").write_text("name,left_u,left_v,right_u,right_v\na,100,200,900,200")
    image, _ = render(
        Board(columns=7, rows=6, square=0.02), (640, 480), homography(BOARD, (640, 480), 40), supersample=2
    )
    cv2.imwrite(str(here / "board.png"), image)
    cv2.imwrite(str(here / "blank.png"), np.full((480, 640), 128, np.uint8))
    return here


@pytest.mark.parametrize(
    ("line", "named", "cure"),
    [
        ("calibrate few.obs.json -o x.json", "2 view(s)", f"{FEW} few.obs.json"),
        ("calibrate flat.obs.json -o x.json", "tilted", f"{FEW} flat.obs.json"),
        ("calibrate wild.obs.json -o x.json --model opencv5", "v0", f"{SEEN} wild.obs.json"),
        ("calibrate a/left.obs.json b/left.obs.json -o x", "both named left", "mv b/left.obs.json b/b-left.obs.json"),
        (f"{RIG} --landmarks survey.csv", "belong together", f"{MARK} --cameras left.camera.json"),
        (f"{RIG} --landmarks survey.csv --marks marks.csv", "left", f"{MARK} --cameras left.camera.json"),
        (f"{PAIRS} a/left.obs.json other.obs.json", "different boards", f"{SEEN} a/left.obs.json"),
        (f"{PAIRS} a/left.obs.json named.obs.json", "v00", f"{SEEN} a/left.obs.json"),
        (f"{TWICE} a/left.obs.json b/left.obs.json", "the same camera", "kcal calibrate left.obs.json right.obs.json"),
        (
            "locate placeless.json far.csv -o p.csv",
            "placeless.json",
            "kcal locate placeless.json far.csv -o p.csv --",
        ),
        ("locate placeless.json far.csv --origin 0,0,0 --heading 0", "far.csv", f"{MARK} --rig placeless.json"),
        ("detect board.png --board 9x6 --square 25mm -o x.json", "7x6", "kcal detect board.png --board 7x6 --square"),
        ("detect blank.png --board 9x6 --square 25mm -o x.json", "blank.png", "kcal board --board 9x6 --square 25mm"),
    ],
)
def test_it_ends_with_a_command(
    line: str, named: str, cure: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr("sys.argv", ["kcal", *line.split()])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("error: ")
    assert named in said
    assert cure in said
    assert not list(folder.glob("x.*"))
    if cure.startswith("kcal "):
        # Its options and arguments are those of the command.
        name, *words = shlex.split(said[said.rindex("kcal ") :])[1:]
        command = COMMANDS[name]
        if name == "board":
            words, command = ["print", *words], command
        command.make_context(name, words, resilient_parsing=False)
