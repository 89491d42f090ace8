"""Undistortion of 1080p images: kcal beside `cv2.remap` and kornia's `undistort_image`, eager, on the CPU.

One image, one lens of 8 coefficients. The maps of kcal and OpenCV are made beforehand, as one would for a video;
kornia's function has no way to keep them. All three keep the source's intrinsics. In each round every side runs once,
in turn, and ratios are taken within a round; medians, one thread.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import torch
from kornia.geometry.calibration import undistort_image

from kcal import Camera, Rig
from kcal.lens import cylinder_view, looking, pinhole_view
from kcal.lens.images import StereoRectification, Undistort, UndistortMaps, undistort_maps
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.timing import median, ratio, times

SIZE = (1920, 1080)
LENS = [-0.28, 0.1, 1e-3, -1e-3, 0.02, 0.05, 0.02, 0.01]
# Name, channels, dtype. kornia takes floats only.
CASES = (
    ("gray, float32", 1, torch.float32),
    ("color, float32", 3, torch.float32),
    ("gray, uint8", 1, torch.uint8),
    ("color, uint8", 3, torch.uint8),
)


@section("lens.md", "rectification", rounds=1)
def views(rounds: int = 30) -> Iterator[str]:
    heads = ["view", "maps, once", "float32, color", "`cv2.remap`", "uint8, color", "`cv2.remap`"]
    return table(heads, view_rows(rounds))


def view_rows(rounds: int) -> Iterator[list[object]]:
    """Kinds of rectification, in CPU milliseconds a megapixel of the new image."""
    camera = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, coefficients=LENS, model="opencv8")
    fisheye = Camera.build(focal=(600, 600), center=(957, 541), size=SIZE, coefficients=[0.02], model="fisheye4")
    turn = looking(1.0, 0.5)
    rig = Rig.pair(camera, camera, turn, -turn @ torch.tensor([10.0, 0.1, 0.2], dtype=torch.float64))
    kinds: list[tuple[str, Callable[[], list[Undistort]]]] = [
        ("pinhole, alpha 0", lambda: [Undistort(camera)]),
        ("fisheye, 60 degrees at 40 degrees", lambda: [Undistort(fisheye, pinhole_view(60, SIZE), looking(40, 0))]),
        ("fisheye on a cylinder", lambda: [Undistort(fisheye, cylinder_view(fisheye))]),
        ("stereo pair", lambda: [getattr(StereoRectification(rig), side) for side in ("left", "right")]),
    ]
    for name, make in kinds:
        start = time.process_time()
        modules = make()
        spent = time.process_time() - start
        pixels = sum(module.mask.numel() for module in modules) / 1e6
        cells = [f"{1e3 * spent / pixels:.0f}"]
        for dtype in (torch.float32, torch.uint8):
            image = _image(3, dtype)
            array = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())
            maps = [undistort_maps(one.camera, one.new_camera, one.rotation) for one in modules]
            calls: list[Callable[[], object]] = [
                functools.partial(_each, modules, image),
                functools.partial(_each_by_opencv, maps, array),
            ]
            for call in calls:
                taken = []
                for _ in range(rounds):
                    start = time.process_time()
                    with torch.no_grad():
                        call()
                    taken.append(1e3 * (time.process_time() - start) / pixels)
                cells.append(median(taken))
        yield [name, *cells]


@section("lens.md", "images", rounds=1)
def images(rounds: int = 30) -> Iterator[str]:
    camera = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, coefficients=LENS, model="opencv8")
    new = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, model="pinhole")
    milliseconds = _milliseconds(times([lambda: undistort_maps(camera, new)], 3)[0])
    print(f"Making kcal's maps, once for each camera: {milliseconds} ms.")
    heads = ["image", "kcal, maps kept", "`cv2.remap`", "kornia `undistort_image`", "kcal / cv2", "kcal / kornia"]
    undistort = Undistort(camera, new)
    rows = (_row(name, camera, undistort, _image(channels, dtype), rounds) for name, channels, dtype in CASES)
    return table([*heads, "largest difference to cv2, levels of 255"], rows)


def _each(modules: list[Undistort], image: torch.Tensor) -> list[object]:
    return [module(image) for module in modules]


def _each_by_opencv(maps: list[UndistortMaps], array: np.ndarray) -> list[object]:
    return [cv2.remap(array, one.map_x, one.map_y, cv2.INTER_LINEAR) for one in maps]


def _image(channels: int, dtype: torch.dtype) -> torch.Tensor:
    """Levels 0 to 255 of a smooth pattern with some noise, (1, C, H, W)."""
    width, height = SIZE
    x, y = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    pattern = 127.5 + 90 * torch.sin(x / 17) * torch.cos(y / 23)
    noise = 8 * torch.randn(channels, height, width, generator=torch.Generator().manual_seed(0))
    return (pattern + noise).clamp(0, 255).round()[None].to(dtype)


@torch.no_grad()
def _row(name: str, camera: Camera, undistort: Undistort, image: torch.Tensor, rounds: int) -> list[object]:
    maps = undistort_maps(undistort.camera, undistort.new_camera)
    # OpenCV's images have their channels last.
    array = np.ascontiguousarray(image[0].permute(1, 2, 0).squeeze(-1).numpy())
    matrix, lens = camera.matrix[None].to(torch.float32), camera.coefficients[None].to(torch.float32)
    calls: list[Callable[[], object]] = [
        lambda: undistort(image),
        lambda: cv2.remap(array, maps.map_x, maps.map_y, cv2.INTER_LINEAR),
    ]
    if image.is_floating_point():
        calls.append(lambda: undistort_image(image, matrix, lens))
    found = times(calls, rounds)
    faster = [ratio(found[0], other) for other in found[1:]]
    theirs = torch.from_numpy(np.atleast_3d(cv2.remap(array, maps.map_x, maps.map_y, cv2.INTER_LINEAR)))
    difference = float((undistort(image)[0][0].double() - theirs.permute(2, 0, 1).double()).abs().max())
    cells: list[object] = [name, *(_milliseconds(t) for t in found), *["–"] * (3 - len(found))]
    cells += [*faster, *["–"] * (2 - len(faster)), f"{difference:.3f}"]
    return cells


def _milliseconds(seconds: list[float]) -> str:
    return median([1e3 * value for value in seconds])
