"""Stations: time and memory of siting, of a frame of detections, of long tables, and of many cameras at once.

CPU seconds on one core (time.process_time). `many` runs mrcal in the same loop where KCAL_MRCAL names an interpreter
that has it: cameras in rows of four, 0.5 m apart, look at a board 4 m away, which all of them see; corners have 0.1 px
of noise; lenses have five coefficients, kcal fits its default.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal import Board, Camera, Localizer, Origin, Rig, RigData, calibrate_camera, save_rig, solve_rig
from kcal.calibrate.rig.pairs import boards_of_several
from kcal.lens import rotation_from_vector
from kcal.locate import terrain
from kcal.locate.siting import Site, area_of, rank_sites, siting_map
from kcal.rig import Mounting, RigCovariance, planned_rig
from scripts.shared.captures import as_observations
from scripts.shared.children import answer, interpreter, timed_process
from scripts.shared.page import DOCS, Lines, peak_megabytes, section, show, table, timed, times
from scripts.shared.station_scenes import drawn_errors, hills, marks, ring, targets

_CORNER, _CELL = (44.75, 5.72), 0.0014
_TOWERS = (("mill", 44.9, 5.85), ("church", 45.1, 5.9), ("mast", 45.15, 6.15), ("hill", 44.87, 6.1), ("dam", 45.0, 6.0))
_CANDIDATES = (
    (44.83, 5.8), (44.83, 5.97), (44.85, 6.2), (44.95, 6.2), (45.05, 6.22), (45.22, 6.2), (45.22, 6.0), (45.22, 5.82),
    (45.0, 5.8), (45.05, 6.1),
)  # fmt: skip
_NOISE_PX = 0.1


def _hilltop(ground: Tensor, name: str, lat: float, lon: float) -> Site:
    """A mast of 30 m on the highest ground within some 1.5 km."""
    row, column = len(ground) - 1 - int((lat - _CORNER[0]) / _CELL), int((lon - _CORNER[1]) / _CELL)
    near = ground[row - 12 : row + 12, column - 12 : column + 12]
    i, j = divmod(int(near.argmax()), near.shape[1])
    place = _CORNER[0] + (len(ground) - row + 12 - i - 0.5) * _CELL, _CORNER[1] + (column - 12 + j + 0.5) * _CELL
    return Site(name=name, origin=Origin(lat=place[0], lon=place[1], height=float(near[i, j]) + 30.0))


@section("stations.md", "sites", cells=20)
def sites(cells: int = 200, write: bool = False) -> Lines:
    """Time of a map and of the order of candidates, and the picture of the how-to page."""
    from kcal.report.figures import save_picture
    from kcal.report.positions import siting_figure

    raster = hills(460)
    head = (
        f"ncols {len(raster)}\nnrows {len(raster)}\nxllcorner {_CORNER[1]}\nyllcorner {_CORNER[0]}\ncellsize {_CELL}\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "hills.asc")
        path.write_text(head + "\n".join(" ".join(f"{height:.1f}" for height in row) for row in raster.tolist()) + "\n")
        ground = terrain(path)
    towers = [_hilltop(raster, *one) for one in _TOWERS]
    candidates = [_hilltop(raster, f"site {i}", *one) for i, one in enumerate(_CANDIDATES, start=1)]
    rows, start = [], time.process_time()

    def lap(what: str) -> None:
        nonlocal start
        rows.append([what, f"{time.process_time() - start:.2f}"])
        start = time.process_time()

    area = area_of((44.8, 5.73, 45.25, 6.36), ground, [*towers, *candidates], cells=cells, above=30.0)
    lap(f"ground and {math.prod(area.known.shape):,} points, raster of {ground.cell_m:.0f} m")
    siting_map(area, towers)
    lap("map of 5 towers")
    ranked = rank_sites(area, towers, candidates, build=2)
    lap("10 candidates, two of them chosen")
    rank_sites(area, towers, candidates)
    lap("10 candidates, all in order")
    if write:
        save_picture(DOCS.parent / "howto" / "sites.png", siting_figure(area, towers, ranked))
    yield from [["step", "CPU s"], *rows]
    yield f"Peak memory {peak_megabytes():.0f} MB, libraries included."


@section("stations.md", "frame", rounds=1)
def frame(rounds: int = 20) -> Lines:
    """Milliseconds of 1,000 detections in 8 cameras."""
    rig, generator = ring(8, 5000.0), torch.Generator().manual_seed(0)
    root = rig.with_errors(position_m=0.3, attitude_deg=(0.004, 0.004, 0.02), refraction=0.1)
    seen = marks(rig, targets(1000, generator), drawn_errors(root, 1000, generator))
    seen = seen + 0.3 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    spoiled = seen.clone()
    spoiled[torch.rand(1000, 8, generator=generator) < 0.1] = math.nan
    spoiled[torch.rand(1000, 8, generator=generator) < 0.05] += 60.0
    yield ["marks", "errors", "CPU ms a frame"]
    for name, pixels in (("all seen, none wrong", seen), ("10 % missing, 5 % wrong", spoiled)):
        for errors, known in (("marks alone", torch.zeros(1, rig.quantities).double()), ("all errors", root)):
            localize = Localizer(rig, root=known, pixel_sigma=0.3)
            with torch.no_grad():
                (spent,) = times([lambda: localize(pixels)], rounds, time.process_time)  # noqa: B023
            yield [name, errors, f"{1e3 * float(np.median(spent)):.0f}"]


@section("stations.md", "two", pairs=1000)
def two(pairs: int = 200_000) -> Lines:
    """Two ways to weigh two cameras, on the same pairs of marks."""
    yield ["errors", "weights by marks, CPU s per million", "by all errors", "times", "median difference in σ"]
    generator = torch.Generator().manual_seed(0)
    for name, pose in (("marks alone", None), ("and lenses and pose", 1e-10 * torch.eye(6).double())):
        rig = planned_rig()
        rig.mounting = Mounting(origin=Origin(lat=45.0, lon=6.0, height=800.0), heading_deg=35.0, pitch_deg=-1.0)
        if pose is not None:
            lens = 1e-4 * torch.eye(len(rig.left.names), dtype=torch.float64)
            rig.covariance = RigCovariance.of(rig, left=lens, right=lens, pose=pose)
        far = 200.0 + 2800.0 * torch.rand(pairs, 1, generator=generator).double()
        side = torch.randn(pairs, 2, generator=generator).double() * torch.tensor([0.15, 0.05]).double()
        left, right = rig(far * torch.cat([side, torch.ones(pairs, 1).double()], 1))[0].unbind(-2)
        marked = torch.stack([left, right], 1) + 0.2 * torch.randn(pairs, 2, 2, generator=generator).double()
        with torch.no_grad():
            (ours, by_pair), (theirs, by_views) = (
                _timed(Localizer(rig.placed(refraction_sigma=0.0), pixel_sigma=0.2), marked[:, 0], marked[:, 1]),
                _timed(Localizer(rig, weights="all", pixel_sigma=0.2), marked),
            )
        both = (ours.status == 0) & (theirs.status == 0)
        sigma = ours.covariance[both].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
        off = (ours.enu - theirs.enu)[both].norm(dim=-1) / sigma
        each = 1e6 / pairs
        yield [
            name, f"{by_pair * each:.2f}", f"{by_views * each:.1f}", f"{by_views / by_pair:.1f}",
            f"{float(off.median()):.1e}",
        ]  # fmt: skip


def _timed(localize: torch.nn.Module, *marked: Tensor) -> tuple[Any, float]:
    """The result, and CPU seconds of the second call."""
    localize(*marked)
    return timed(localize, *marked)


@section("stations.md", "table", sizes=(300,))
def long_tables(sizes: tuple[int, ...] = (100_000, 1_000_000)) -> Lines:
    """CPU seconds and peak memory of `kcal locate` of marks of three cameras, in a process of its own."""
    yield ["lines", "positions", "CPU s", "peak MB"]
    rig = ring(3, 5000.0)
    rig.root = rig.with_errors(attitude_deg=0.01)
    for size in sizes:
        with tempfile.TemporaryDirectory() as folder:
            save_rig(rig, Path(folder, "rig.json"))
            generator, things = torch.Generator().manual_seed(0), size // 3
            with Path(folder, "marks.csv").open("w") as file:
                file.write("name,camera,u,v\n")
                for first in range(0, things, 50_000):
                    pixels = marks(rig, targets(min(50_000, things - first), generator)).tolist()
                    for i, thing in enumerate(pixels, start=first):
                        for name, (u, v) in zip(rig.names, thing, strict=True):
                            file.write(f"t{i},{name},{u:.2f},{v:.2f}\n")
            code = (
                "import sys; from kcal.cli.main import app; from scripts.shared.page import peak_megabytes\n"
                "try: app(sys.argv[1:])\nexcept SystemExit: pass\nprint('peak', peak_megabytes(), file=sys.stderr)"
            )
            words = ["locate", "rig.json", "marks.csv", "-o", "out.csv", "--json"]
            done, spent = timed_process(sys.executable, "-c", code, *words, cwd=folder)
            peak = float(done.stderr.split("peak ")[-1])
            with Path(folder, "out.csv").open() as file:
                lines = sum(1 for _ in file) - 1
            yield [f"{3 * things:,}", f"{lines:,}", f"{spent:.0f}", f"{peak:.0f}"]


@section("stations.md", "many", sizes=(2, 4))
def many(sizes: tuple[int, ...] = (8, 24, 16, 60)) -> Iterator[str]:
    """Rigs of CAMERAS VIEWS, CAMERAS VIEWS...; the smallest first, as memory is told by its peak."""
    rows = (
        [f"{cameras} x {views}", *row]
        for cameras, views in zip(sizes[::2], sizes[1::2], strict=True)
        for row in together(cameras, views)
    )
    heads = ["cameras x views", "program", "CPU s", "of it one by one", "peak MB", "RMS error of centers mm"]
    return table([*heads, "after the best-fit rotation of all", "of attitudes °"], rows)


def together(cameras: int, views: int) -> Iterator[list[str]]:
    """Cameras calibrated together, beside mrcal where it is."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    lenses = [
        Camera.build(
            focal=(1400 + 10 * c, 1402 + 10 * c), center=(955.0 + c, 542.0), size=(1920, 1080),
            coefficients=[-0.2 + 0.002 * c, 0.06, 5e-4, -3e-4, -0.01],
        )
        for c in range(cameras)
    ]  # fmt: skip
    centers = torch.tensor([[0.5 * (c % 4), 0.5 * (c // 4), 0.0] for c in range(cameras)], dtype=torch.float64)
    aim = torch.tensor([0.75, 0.75, 4.0], dtype=torch.float64)
    toward = torch.stack([-(aim - centers)[:, 1], (aim - centers)[:, 0], torch.zeros(cameras)], -1).double() / 4.2
    turns = rotation_from_vector(-toward + 0.02 * draw(cameras, 3))
    rig = Rig(lenses, [f"c{c}" for c in range(cameras)], turns, center=centers, refraction=0.0)
    board, moments = Board(columns=9, rows=6, square=0.1), list[Tensor]()
    while len(moments) < views:
        shift = aim + draw(3) * torch.tensor([0.35, 0.2, 0.4]).double()
        points = (board.points - board.points.mean(0)) @ rotation_from_vector(0.35 * draw(3)).T + shift
        pixels, seen = rig(points)
        if bool(seen.all()):
            moments.append((pixels + _NOISE_PX * draw(*pixels.shape)).movedim(1, 0))
    corners = torch.stack(moments)  # (V, C, N, 2)
    start = time.process_time()
    observed = {c: as_observations(corners[:, c], (1920, 1080), board) for c in range(cameras)}
    calibrated = tuple(calibrate_camera(one).camera for one in observed.values())
    alone = time.process_time() - start
    data = RigData(cameras=calibrated, names=rig.names, boards=boards_of_several(calibrated, rig.names, observed))
    found = solve_rig(data)
    spent = time.process_time() - start
    errors = _errors(rig, found.rotation, found.center)
    yield ["kcal", f"{spent:.0f}", f"{alone:.0f}", f"{peak_megabytes():.0f}", *errors]
    if python := interpreter("mrcal"):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "problem.npz")
            np.savez(
                path, corners=corners.numpy(), image_size=[1920, 1080], board_size=[9, 6], square_m=0.1, focal=1400.0
            )
            other = answer(python, Path(__file__).with_name("peer_mrcal_many.py"), path)
            if "failed" in other:
                show([other["failed"]])
            else:
                poses = (torch.tensor(other[name], dtype=torch.float64) for name in ("rotation", "center"))
                yield ["mrcal, OPENCV8", f"{other['cpu']:.0f}", "", f"{other['peak']:.0f}", *_errors(rig, *poses)]


def _errors(rig: Rig, rotation: Tensor, center: Tensor) -> list[str]:
    """Against the truth, in the first camera's frame."""
    true_turn = rig.rotation @ rig.rotation[0].T
    true_center = (rig.center - rig.center[0]) @ rig.rotation[0].T
    own_turn, own_center = rotation @ rotation[0].T, (center - center[0]) @ rotation[0].T
    # A turn of the first camera's own frame, which its principal point makes up for, moves all others about it.
    left, _, right = torch.linalg.svd(own_center.T @ true_center)
    shape = own_center @ (left @ right)
    off, off_shape = ((one - true_center)[1:].norm(dim=-1).square().mean().sqrt() for one in (own_center, shape))
    turned = own_turn @ true_turn.mT
    angle = ((turned.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).arccos()[1:].square().mean().sqrt()
    return [f"{1e3 * float(off):.3f}", f"{1e3 * float(off_shape):.3f}", f"{math.degrees(float(angle)):.5f}"]
