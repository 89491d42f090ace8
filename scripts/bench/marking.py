"""How long `kcal mark` takes to start and for each moved mark, with two cameras of the default lens; CPU seconds.

Both cameras are calibrated from simulated captures, so that their calibrations bring a whole posterior, and a rig is
solved from landmarks. Then one landmark after the other is moved by a tenth of a pixel, as by an arrow key: the rig is
solved anew, with what its ranges and its epipolar curves are worth. With --cameras its lenses are refined each time;
with --rig they stay as they are.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import torch

from kcal import Rig, calibrate_camera, load_camera, load_rig, save_camera, save_rig
from kcal.io.images import write_png
from kcal.lens import rotation_from_vector
from kcal.locate import Marks
from kcal.mark.guide import open_pictures
from kcal.mark.items import SIDES, Mark, Put
from kcal.mark.marking_service import Desk, solve_live
from kcal.mark.session import Session
from kcal.rig import Survey
from scripts.shared.children import marking_server
from scripts.shared.page import section, table, timed
from scripts.shared.simulated import simulated

# Of captures by a machine-vision lens.
_SEEDS = 1, 4
_SIGMA = 0.05  # px, of marks
_SURVEY = 0.02  # m


def seen_landmarks(rig: Rig, count: int, random: np.random.Generator) -> Iterator[tuple[torch.Tensor, ...]]:
    """Places (3,) east, north, up and true marks (2, 2) of landmarks that both cameras see, 60 m to 2 km away."""
    width, height = rig.left.size
    found = 0
    while found < count:
        at = torch.tensor([[random.uniform(0.1, 0.9) * width, random.uniform(0.2, 0.8) * height]], dtype=torch.float64)
        rays, _ = rig.left.unproject(at)
        point = 10 ** random.uniform(1.8, 3.3) * rays
        pixels, seen = rig(point)
        left, right = pixels.unbind(-2)
        if bool(seen.all()):
            found += 1
            yield torch.stack([point[0, 0], point[0, 2], -point[0, 1]]), torch.cat([left, right])


def make_site(folder: Path, count: int, views: int) -> Marks:
    """Write pictures, a survey and a rig with its covariance, and return the marks of the landmarks."""
    left, right = (calibrate_camera(simulated(seed, views, 0.1, False).seen).camera for seed in _SEEDS)
    rotation = rotation_from_vector(torch.tensor([0.003, 0.006, -0.008], dtype=torch.float64))
    rig = Rig.pair(left, right, rotation, -rotation @ torch.tensor([10.0, 0.04, -0.06], dtype=torch.float64))
    random = np.random.default_rng(0)
    points, pixels = (torch.stack(part) for part in zip(*seen_landmarks(rig, count, random), strict=True))
    points = points + _SURVEY * torch.from_numpy(random.normal(size=points.shape))
    pixels = pixels + _SIGMA * torch.from_numpy(random.normal(size=pixels.shape))
    names = tuple(f"post {i + 1}" for i in range(count))
    lines = [f"{name},{e},{n},{u},{_SURVEY}" for name, (e, n, u) in zip(names, points.tolist(), strict=True)]
    (folder / "survey.csv").write_text("\n".join(["name,east,north,up,sigma", *lines]) + "\n")
    marks = Marks(names, pixels, _SIGMA**2 * torch.eye(4).double().expand(count, 4, 4))
    survey = Survey(names, points, torch.full_like(points, _SURVEY), None)
    solved = solve_live((rig.left, rig.right), survey, marks, 0.3)
    assert solved.rig is not None, solved.text
    save_rig(solved.rig, folder / "rig.json")
    for side, camera in zip(SIDES, (left, right), strict=True):
        save_camera(camera, folder / f"{side}.camera.json")
        write_png(folder / f"{side}.png", random.integers(0, 255, camera.size[::-1]).astype(np.uint8))
    return marks


def until_address(folder: Path, *arguments: str) -> float:
    """CPU seconds of `kcal mark` until it prints the page's address."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path.cwd()), os.environ.get("PYTHONPATH", "")])}
    with marking_server(folder, *arguments, "-o", "new.csv", env=environment) as (address, process):
        assert "http://" in address
        return sum(psutil.Process(process).cpu_times()[:2])


@contextmanager
def opened(folder: Path, by: str) -> Iterator[Desk]:
    """The marking service on the site, by `--cameras` or `--rig`."""
    session = Session(folder / f"{by}.csv", folder / "survey.csv")
    known = load_rig(folder / "rig.json") if by == "rig" else None
    cameras = load_camera(folder / "left.camera.json"), load_camera(folder / "right.camera.json")
    pictures = open_pictures(folder / "left.png", folder / "right.png")
    desk = Desk(pictures, session, cameras if known is None else None, known)
    yield desk
    desk.close()


def report(desk: Desk, marks: Marks, moves: int) -> float:
    """Mark all landmarks, move some of them, and tell what each took, CPU seconds."""

    def put(row: int, side: int, shift: float) -> None:
        u, v = marks.pixels[row, side].tolist()
        mark = Mark(u=u + shift, v=v, cov=(_SIGMA**2, 0.0, _SIGMA**2), frame=desk.pictures.names[0])
        action = Put(do="put", name=marks.names[row], side=SIDES[side], mark=mark)
        desk.act(action, f"key-{row}-{side}-{shift}")

    def curve(row: int) -> None:
        desk.curve("left", *marks.left[row].tolist())

    def moved(row: int) -> None:
        put(row, 1, 0.1)
        while desk.state()["pending"]:
            time.sleep(0.02)
        curve(row)

    for row in range(len(marks.names)):
        put(row, 0, 0.0)
        put(row, 1, 0.0)
    while desk.state()["pending"]:
        time.sleep(0.02)
    return float(np.median([timed(moved, row)[1] for row in range(moves)]))


@section("marking.md", "time", landmarks=6, moves=1, views=6)
def moved_marks(landmarks: int = 12, moves: int = 12, views: int = 25) -> Iterator[str]:
    """So many landmarks, how many of them are moved, and views of which each camera is calibrated."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        marks = make_site(folder, landmarks, views)
        found = {"`kcal mark --rig` to its address": until_address(folder, "--rig", "rig.json")}
        for by in ("cameras", "rig"):
            with opened(folder, by) as desk:
                found[f"each moved mark, `--{by}`"] = report(desk, marks, min(moves, landmarks))
    first = next(iter(found.values()))
    rows = ([what, f"{seconds:.2f}", f"{seconds / first:.2g}"] for what, seconds in found.items())
    yield from table(["", "CPU s", "of the first"], rows)
