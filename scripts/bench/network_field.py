"""Compare the network field with fixed and trained features, the default field and ext20, by views that were held out.

For each capture: RMS over held-out blocks of views (`kcal.calibrate.camera.at_setting`), and CPU seconds of one fit of
all views. Also the error at infinity on a simulated lens with a dent (`scripts/bench/network_field.py`).

A lens with a local dent, a capture of it, and a small network for it: what no polynomial of the radius has.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor, nn

from kcal import Board, CalibrationOptions, Camera, KcalError, Observations, calibrate_camera
from kcal.calibrate import compare_models
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.field_modes import GaussianModes
from kcal.lens.model import HybridForm
from kcal.nets import FieldTraining
from scripts.shared.captures import as_observations
from scripts.shared.page import Lines, merged, section, table, timed
from scripts.shared.real_captures import data_folder

BOARD = Board(columns=9, rows=7, square=0.04)
SIZE, NOISE = (800, 600), 0.05


@functools.cache
def truth(dent: float = 3.0) -> Camera:
    """A local dent of three pixels off the middle, which no polynomial of the radius has."""
    modes = GaussianModes(widths=(0.2,))
    form = HybridForm(shape=0.9, radius=1.08 * 500.0 / 700.0, modes=modes)
    values = torch.zeros(8 + len(modes), dtype=torch.float64)
    values[:4] = torch.tensor([700.0, 700.0, 402.0, 297.0])
    x = modes.columns(torch.tensor([0.45], dtype=torch.float64), torch.tensor([-0.2], dtype=torch.float64))[:, 0, 0]
    values[8 + int(x.argmax())] = dent / 700.0
    return Camera(values, size=SIZE, model=LensModel(hybrid=form))


@functools.cache
def capture(count: int = 18, dent: float = 3.0) -> Observations:
    random, middle, views = torch.Generator().manual_seed(5), BOARD.points.mean(0), list[Tensor]()
    while len(views) < count:
        u = 2.0 * torch.rand(6, generator=random, dtype=torch.float64) - 1.0
        turn = rotation_from_vector(torch.stack([0.5 * u[0], 0.5 * u[1], math.pi * u[2]]))
        shift = torch.stack([0.2 * u[3], 0.14 * u[4], 0.5 + 0.06 * u[5]])
        pixels, valid = truth(dent).project((BOARD.points - middle) @ turn.T + shift)
        if bool((valid & truth().inside(pixels)).all()):
            views.append(pixels + NOISE * torch.randn(pixels.shape, generator=random, dtype=torch.float64))
    return as_observations(torch.stack(views), SIZE, BOARD, names=list(map(str, range(count))))


def network() -> nn.Module:
    """Twenty waves, whose bends cross the image."""
    torch.manual_seed(2)
    chain = nn.Sequential(nn.Linear(2, 20), nn.Tanh(), nn.Linear(20, 2))
    with torch.no_grad():
        chain.get_parameter("0.weight").mul_(4.0)
    return chain


def off(camera: Camera) -> float:
    """RMS of the error at infinity over the middle of the image, pixels, after the best rotation."""
    pixels = 0.75 * (truth().grid(21, 15).reshape(-1, 2) - truth().center) + truth().center
    rays, found = truth().unproject(pixels)[0], camera.unproject(pixels)[0]
    u, _, v = torch.linalg.svd(rays.T @ found)
    return float((camera.project_rays(rays @ u @ v)[0] - pixels).square().sum(-1).mean().sqrt())


CAPTURES = ("gavin_l", "gavin_r", "st1_l", "lanhp_l", "luisa39", "carnd18", "fish_l", "kaidan", "ch1280", "sq1280")
# Name -> lens model and training.
FITS: dict[str, tuple[str, FieldTraining | None]] = {
    "ext20": ("ext20", None),
    "default": ("hybrid", None),
    "network, last layer only": ("network", None),
    "network, Gauss-Newton": ("network", FieldTraining()),
    "network, Adam": ("network", FieldTraining(optimizer="adam")),
}


def measure(seen: Observations, name: str, parts: int) -> tuple[float, float]:
    """Held-out RMS in pixels, and CPU seconds of one fit."""
    model, training = FITS[name]
    options = CalibrationOptions(model="opencv5", board_warp=True, training=training)
    held = compare_models(seen, [model], options=options, parts=parts).rms[model]
    return held, timed(calibrate_camera, seen, CalibrationOptions(model=model, training=training))[1]


def cells(seen: Observations, parts: int, fits: tuple[str, ...]) -> list[str]:
    """For each lens the held-out RMS, and CPU seconds in brackets."""
    out = []
    for name in fits:
        try:
            held, seconds = measure(seen, name, parts)
            out.append(f"{held:.4f} ({seconds:.1f})")
        except KcalError as error:
            # A lens that does not fit is a result, too.
            print(f"{name}: {error}", flush=True)
            out.append("does not fit")
    return out


@section("network-field.md", "captures", names=("sq1280",), fits=("ext20",), parts=2)
def captures(names: tuple[str, ...] = CAPTURES, parts: int = 3, fits: tuple[str, ...] = tuple(FITS)) -> Lines:
    found = ((name, Observations.load(data_folder() / "captures" / f"{name}.obs.json")) for name in names)
    rows = ([name, len(seen.views), *cells(seen, parts, fits)] for name, seen in found)
    return merged("network-field.md", "captures", ["capture", "views", *fits], rows)


@section("network-field.md", "dent", fits=("ext20",))
def dent(fits: tuple[str, ...] = tuple(FITS)) -> Lines:
    """For each lens the error at infinity over the middle of the image of a lens with a dent, pixels."""
    out = []
    for model, training in map(FITS.__getitem__, fits):
        options = CalibrationOptions(model=model)
        if model == "hybrid":
            options = CalibrationOptions(board="exact", motion=False)
        elif model == "network":
            options = CalibrationOptions(field=network(), training=training, board="exact", motion=False)
        found, seconds = timed(calibrate_camera, capture(), options)
        out.append(f"{off(found.camera):.3f} ({seconds:.1f})")
    return table(["lens", *fits], [["with a dent of 3 px", *out]])
