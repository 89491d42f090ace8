"""Inverse nets and lookup tables, measured.

Inverse nets: how many evaluations of the lens they save as a start, and what that is worth in time.
Lookup tables: size, stated bound, the largest error found at random points, and time beside the camera itself.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

import kcal.lens.inverse
from kcal import Camera
from kcal.lens import LensModel, bake
from kcal.lens.inverse import InverseStart
from kcal.lens.model import HybridForm, distort_components
from kcal.lens.zernike import ZernikeModes
from kcal.nets import train_inverse
from scripts.bench.lens import LENS, SIZE
from scripts.bench.lens import build as build_hd
from scripts.shared.page import Lines
from scripts.shared.sections import section
from scripts.shared.timing import ratio, times

POINTS = 10_000
# A lens of some 150 degrees, as fitted to a real one.
WIDE = [0.4749, 0.02579, 3e-5, -9e-6, 8.2e-5, 0.7623, 0.09433, 1.329e-3, 3.1e-5, -2e-7, -2.6e-5, 3e-8, 1.1e-3, 1e-3]
# Corners beyond the fold: kornia issue 3273.
FOLDING = [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191]


def hybrid() -> Camera:
    """A lens between pinhole and stereographic with all default modes, decaying with their degree as real ones do."""
    modes = ZernikeModes()
    form = HybridForm(shape=0.7, radius=0.8, modes=modes)
    degree = torch.tensor([mode[-1] for mode in modes.real_modes], dtype=torch.float64)
    noise = torch.randn(len(degree), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = (3e-4 * torch.exp(-0.5 * (degree - 3)) * noise).tolist()
    return Camera.build(
        focal=(1500, 1500), center=(957, 541), size=SIZE, coefficients=[0, 2e-3, 1e-3, *weights],
        model=LensModel(hybrid=form),
    )  # fmt: skip


CAMERAS: dict[str, Callable[[], Camera]] = {
    "opencv5": lambda: Camera.build(focal=(1600, 1605), center=(957, 541), size=SIZE, coefficients=LENS[:5]),
    "opencv14": lambda: build_hd("opencv14"),
    "ext20": lambda: build_hd("ext20"),
    "opencv14, 150°": lambda: Camera.build(
        focal=(2073.8, 2077.7), center=(3003.5, 2001.4), size=(6016, 4016), coefficients=WIDE, model="opencv14"
    ),
    "opencv5, corners beyond the fold": lambda: Camera.build(
        focal=(1917.36, 1917.36), center=(1920, 1080), size=(3840, 2160), coefficients=FOLDING
    ),
    "fisheye4": lambda: Camera.build(
        focal=(400, 402), center=(637, 481), size=(1280, 960), coefficients=[0.02, -0.01, 0.003], model="fisheye4"
    ),
    "hybrid": hybrid,
}


def random_pixels(camera: Camera, count: int) -> Tensor:
    """Pixels of the image that have a ray."""
    generator = torch.Generator().manual_seed(5)
    pixels = torch.rand(2 * count, 2, generator=generator, dtype=torch.float64) * torch.tensor(camera.size) - 0.5
    return pixels[camera.unproject(pixels)[1]][:count]


def evaluations(camera: Camera, pixels: Tensor, start: InverseStart | None) -> int:
    """How often one call of `unproject` evaluates the lens for all its pixels."""
    with mock.patch.object(kcal.lens.inverse, "distort_components", wraps=distort_components) as counted:
        camera.unproject(pixels, start=start)
    return counted.call_count


@section("lens.md", "inverse nets", rounds=1, cameras=("opencv5",))
@torch.no_grad()
def inverse_nets(rounds: int = 15, cameras: tuple[str, ...] = tuple(CAMERAS)) -> Lines:
    """Evaluations and time of `unproject` with and without a net."""
    yield ["camera", "evaluations of the lens a call", "with the net", "time with / without"]
    for name in cameras:
        camera = CAMERAS[name]()
        guess = train_inverse(camera).net.guess
        pixels = random_pixels(camera, POINTS)
        plain, helped = camera.unproject(pixels), camera.unproject(pixels, start=guess)
        assert torch.equal(plain[1], helped[1])
        assert float((plain[0] - helped[0]).abs().max()) < 1e-6
        found = times([lambda: camera.unproject(pixels), lambda: camera.unproject(pixels, start=guess)], rounds)  # noqa: B023
        saved = (evaluations(camera, pixels, start) for start in (None, guess))
        yield [name, *saved, ratio(found[1], found[0])]


@section("lens.md", "lookup tables", rounds=1, cameras=("opencv5",))
@torch.no_grad()
def lookup_tables(rounds: int = 15, cameras: tuple[str, ...] = tuple(CAMERAS)) -> Lines:
    yield [
        "camera", "tolerance, px", "baking, s", "file, kB", "bound, px", "largest error found, px", "answers for",
        "project: table / camera", "unproject: table / camera",
    ]  # fmt: skip
    for name in cameras:
        camera = CAMERAS[name]()
        pixels = random_pixels(camera, 10 * POINTS)
        rays, _ = camera.unproject(pixels)
        few, few_rays = pixels[:POINTS], rays[:POINTS]
        for tolerance in (1e-2, 1e-3):
            clock = time.process_time()
            lookup = bake(camera, tolerance)
            seconds = time.process_time() - clock
            again, valid = lookup.unproject(pixels)
            largest = float((camera.project_rays(again)[0] - pixels).norm(dim=-1)[valid].max())
            there, seen = lookup.project(rays)
            largest = max(largest, float((there - pixels).norm(dim=-1)[seen].max()))
            calls: list[Callable[[], Any]] = [
                lambda: camera.project_rays(few_rays),  # noqa: B023
                lambda: lookup.project(few_rays),  # noqa: B023
                lambda: camera.unproject(few),  # noqa: B023
                lambda: lookup.unproject(few),  # noqa: B023
            ]
            found = times(calls, rounds)
            buffer = io.BytesIO()
            np.savez(buffer, **{key: value.numpy() for key, value in lookup.state_dict().items()})
            yield [
                name, f"{tolerance:.0e}", f"{seconds:.1f}", round(len(buffer.getvalue()) / 1000),
                f"{max(lookup.bound):.1e}", f"{largest:.1e}", f"{100 * min(lookup.coverage):.1f} %",
                ratio(found[1], found[0]), ratio(found[3], found[2]),
            ]  # fmt: skip
