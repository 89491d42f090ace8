"""Run every command on one damaged file of every kind: no traceback, no hang, no wrong number in silence.

Each case damages one file in one place by its own seed.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import random
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import torch
from hypothesis import strategies

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.hybrid.measured_board import MeasuredBoard, load_measured_board, save_measured_board
from kcal.cli.main import main as command_line
from kcal.corners.board import Board
from kcal.corners.images import read_gray
from kcal.errors import KcalError
from kcal.files import make_folder
from kcal.io.lookup_file import load_lookup, save_lookup
from kcal.io.rig_file import save_rig
from kcal.lens import bake, rotation_from_vector
from kcal.lens.camera import Camera
from kcal.lens.rig import Mounting, Origin, Rig
from scripts.fuzz.damage import damage_bytes, damage_json, damage_table
from scripts.fuzz.hunt import Prepared
from scripts.shared.captures import as_observations
from scripts.shared.small_photographs import photographs

_SECONDS = 30.0  # for one command
BOARD = Board(columns=6, rows=5, square=0.02)


def make_files(folder: Path) -> dict[str, bytes]:
    """A valid file of every kind."""
    camera = Camera.build(
        focal=(300, 301), center=(159.5, 119.5), size=(320, 240), coefficients=[-0.1, 0.02, 0.0, 0.0], model="opencv4"
    )
    generator = torch.Generator().manual_seed(1)
    views, points = [], BOARD.points - BOARD.points.mean(0)
    for _ in range(6):
        turn = rotation_from_vector(0.4 * torch.randn(3, generator=generator, dtype=torch.float64))
        pixels, _ = camera.project(points @ turn.T + torch.tensor([0.0, 0.0, 0.25]))
        views.append(pixels + 0.05 * torch.randn(pixels.shape, generator=generator, dtype=torch.float64))
    names = [f"{number}.png" for number in range(6)]
    observations = as_observations(torch.stack(views), (320, 240), BOARD, names=names)
    observations.save(folder / "obs.json")
    calibrate_camera(observations, CalibrationOptions(model="opencv4")).file(name="left").save(folder / "camera.json")
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
    rig.mounting = Mounting(origin=Origin(lat=10.0, lon=20.0, height=3.0), heading_deg=30.0)
    save_rig(rig, folder / "rig.json")
    half = 1e-5 * torch.eye(28, dtype=torch.float64)
    plate = Board(columns=9, rows=6, square=0.025)
    flat = MeasuredBoard(name="A", board=plate, amplitudes=0 * half[0], half=half, log_evidence=0.0)
    save_measured_board(flat, folder / "board.json")
    save_lookup(bake(camera, 0.05), folder / "lookup.npz")
    left, right = rig(torch.tensor([[0.0, 0.0, 50.0], [5.0, 1.0, 100.0]]))[0].unbind(-2)
    rows = [f"p{i},{a},{b},{c},{d}" for i, (a, b, c, d) in enumerate(torch.cat([left, right], 1).tolist())]
    (folder / "marks.csv").write_text("\n".join(["name,left_u,left_v,right_u,right_v", *rows]) + "\n")
    photographs(folder / "photographs", 0, 1)
    image = read_gray(folder / "photographs" / "0.png")
    for suffix in ("png", "jpg", "tif"):
        cv2.imwrite(str(folder / f"image.{suffix}"), image)
    shutil.rmtree(folder / "photographs")
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def _project(path: Path) -> None:
    lookup = load_lookup(path)
    pixels, valid = lookup.project(torch.tensor([[0.1, 0.1, 1.0], [0.0, 0.0, 1.0]]))
    if not bool(pixels[valid].isfinite().all()):
        raise AssertionError("valid pixels that are not finite")


# What is run on each kind of file; FILE is the damaged one, the others are whole.
COMMANDS: dict[str, list[str | Callable[[Path], object]]] = {
    "camera.json": ["bake FILE -o out.npz --tolerance 0.5", "rectify FILE image.png -o u", "rays FILE -o r.npz"],
    "rig.json": ["locate FILE marks.csv -o out.csv -o out.kml -o out.cot -o out.geojson", "budget FILE"],
    "obs.json": ["calibrate FILE --model pinhole -o out.json", "compare FILE --model pinhole --parts 2"],
    "board.json": [load_measured_board],
    "lookup.npz": [_project],
    "marks.csv": ["locate rig.json FILE -o out.csv -o out.kml --picture out.png --map out.html"],
    "image.png": ["detect FILE --board 6x5 --square 20mm -o out.json"],
    "image.jpg": ["detect FILE --board 6x5 --square 20mm -o out.json"],
    "image.tif": ["detect FILE --board 6x5 --square 20mm -o out.json"],
}


def _run(command: str | Callable[[Path], object], path: Path) -> bool:
    """Whether the file was accepted."""
    if not isinstance(command, str):
        try:
            command(path)
        except KcalError:
            return False
        return True
    argv, sys.argv = sys.argv, ["kcal", *command.replace("FILE", str(path)).split(" ")]
    try:
        command_line()
    except SystemExit as end:
        return end.code in (0, None)
    finally:
        sys.argv = argv
    return True


def odd_numbers(folder: Path) -> str:
    """What is wrong with the numbers in what the command wrote, or ""."""
    table = folder / "out.csv"
    if table.exists():
        for line in table.read_text().splitlines()[1:]:
            # The first cell is a name, which may be any text.
            if "nan" in line.lower().split(",")[1:]:
                return f"NaN in {line[:80]}"
    for path in folder.glob("out*.json"):
        if not all(math.isfinite(value) for value in _numbers(json.loads(path.read_bytes()))):
            return f"{path.name} is not finite"
    return ""


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, dict | list):
        for inside in value.values() if isinstance(value, dict) else value:
            yield from _numbers(inside)
    elif isinstance(value, int | float):
        yield value


def run_case(case: int, whole: dict[str, bytes], *, one: bool = False) -> None:
    """Damage one file by the seed `case`, and run what reads it: all commands, or one by turns.

    Raises:
        AssertionError: a file that must be refused was accepted, or numbers that are not finite were written.
        Exception: whatever else a command ended with.
    """
    rng = random.Random(case)
    kind = rng.choice(sorted(whole))
    damage = {".json": damage_json, ".csv": damage_table}.get(Path(kind).suffix, damage_bytes)
    data, done, refused = (damage if rng.random() < 0.85 else damage_bytes)(whole[kind], rng)
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        for file, content in whole.items():
            Path(file).write_bytes(content)
        Path("u").mkdir()
        path = Path(f"damaged-{kind}")
        path.write_bytes(data)
        commands = COMMANDS[kind]
        for command in [commands[case % len(commands)]] if one else commands:
            said = io.StringIO()
            with warnings.catch_warnings(), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                warnings.simplefilter("ignore")
                accepted = _run(command, path)
            odd = odd_numbers(Path(name)) if accepted else ""
            if accepted and refused:
                odd = "accepted, though it must be refused"
            if "\x1b" in said.getvalue():
                odd = "an escape sequence reached the terminal"
            assert not odd, f"{odd}: `{command}` after {done}"


def commands(folder: Path) -> Prepared:
    """The harness: a case is its number as text."""
    whole = make_files(make_folder(folder / "whole"))

    def check(case: bytes) -> None:
        run_case(int(case), whole, one=True)

    return Prepared(strategies.integers(0, 2**40).map(lambda number: str(number).encode()), check, _SECONDS)
