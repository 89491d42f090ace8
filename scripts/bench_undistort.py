"""Undistortion of 1080p images: kcal beside `cv2.remap` and kornia's `undistort_image`, eager, on the CPU.

    python scripts/bench_undistort.py [--quick] [--markdown FILE]

One image, one lens of 8 coefficients. The maps of kcal and OpenCV are made beforehand, as one would for a video;
kornia's function has no way to keep them. All three keep the source's intrinsics. In each round every side runs once,
in turn, and ratios are taken within a round; median (smallest to largest). One thread, then two.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import kornia
import numpy as np
import torch
from kornia.geometry.calibration import undistort_image

import kcal
from kcal.lens.camera import Camera
from kcal.lens.images import Undistort, undistort_maps

SIZE = (1920, 1080)
LENS = [-0.28, 0.1, 1e-3, -1e-3, 0.02, 0.05, 0.02, 0.01]
# Name, channels, dtype. kornia takes floats only.
CASES = (
    ("grey, float32", 1, torch.float32),
    ("colour, float32", 3, torch.float32),
    ("grey, uint8", 1, torch.uint8),
    ("colour, uint8", 3, torch.uint8),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="3 rounds in place of 30")
    parser.add_argument("--markdown", type=Path, help="also write the tables to this file")
    arguments = parser.parse_args()
    rounds = 3 if arguments.quick else 30

    camera = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, coefficients=LENS, model="opencv8")
    new = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, model="pinhole")
    lines = _show(
        [
            "# Undistortion of 1080p images",
            "",
            f"Made by `scripts/bench_undistort.py` with kcal {kcal.__version__}, torch {torch.__version__}, kornia "
            f"{kornia.__version__}, OpenCV {cv2.__version__}, {platform.processor() or platform.machine()}; "
            f"{rounds} rounds, milliseconds: median (smallest to largest). A ratio is the other's time over kcal's: "
            "above 1, kcal is faster.",
            "",
            f"Making kcal's maps, once a camera: {_spread(_times([lambda: undistort_maps(camera, new)], 3)[0])} ms.",
            "",
            "| image | threads | kcal, maps kept | `cv2.remap` | kornia `undistort_image` | cv2 / kcal | kornia / kcal "
            "| largest difference to cv2, levels of 255 |",
            "|---|---|---|---|---|---|---|---|",
        ]
    )
    undistort = Undistort(camera, new)
    for threads in (1, 2):
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
        for name, channels, dtype in CASES:
            lines += _show([_row(name, threads, camera, undistort, _image(channels, dtype), rounds)])
    if arguments.markdown:
        arguments.markdown.write_text("\n".join(lines) + "\n")


def _image(channels: int, dtype: torch.dtype) -> torch.Tensor:
    """Levels 0 to 255 of a smooth pattern with some noise, (1, C, H, W)."""
    width, height = SIZE
    x, y = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    pattern = 127.5 + 90 * torch.sin(x / 17) * torch.cos(y / 23)
    noise = 8 * torch.randn(channels, height, width, generator=torch.Generator().manual_seed(0))
    return (pattern + noise).clamp(0, 255).round()[None].to(dtype)


@torch.no_grad()
def _row(name: str, threads: int, camera: Camera, undistort: Undistort, image: torch.Tensor, rounds: int) -> str:
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
    times = _times(calls, rounds)
    ratios = [
        _spread([other / own for own, other in zip(times[0], other_times, strict=True)], 2) for other_times in times[1:]
    ]
    theirs = torch.from_numpy(np.atleast_3d(cv2.remap(array, maps.map_x, maps.map_y, cv2.INTER_LINEAR)))
    difference = float((undistort(image)[0][0].double() - theirs.permute(2, 0, 1).double()).abs().max())
    cells = [name, str(threads), *(_spread(t) for t in times), *["–"] * (3 - len(times))]
    cells += [*ratios, *["–"] * (2 - len(ratios)), f"{difference:.3f}"]
    return f"| {' | '.join(cells)} |"


def _times(calls: list[Callable[[], object]], rounds: int) -> list[list[float]]:
    """Milliseconds of each call in each round; one run of each first, not counted."""
    for call in calls:
        call()
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(rounds):
        for which, call in enumerate(calls):
            start = time.perf_counter()
            call()
            times[which].append(1e3 * (time.perf_counter() - start))
    return times


def _spread(values: list[float], digits: int = 1) -> str:
    return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def _show(lines: list[str]) -> list[str]:
    print("\n".join(lines), flush=True)
    return lines


if __name__ == "__main__":
    main()
