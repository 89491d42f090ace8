"""Undistortion of 1080p images: kcal beside `cv2.remap` and kornia's `undistort_image`, eager, on the CPU.

    python -m scripts.bench.undistort [--quick]

`scripts/bench/lens.py` puts the same table into docs/measured/lens.md.

One image, one lens of 8 coefficients. The maps of kcal and OpenCV are made beforehand, as one would for a video;
kornia's function has no way to keep them. All three keep the source's intrinsics. In each round every side runs once,
in turn, and ratios are taken within a round; medians, one thread.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import cv2
import numpy as np
import torch
from kornia.geometry.calibration import undistort_image

from kcal.lens.camera import Camera
from kcal.lens.images import Undistort, undistort_maps
from scripts.shared.timing import median, ratio, row, show, times

SIZE = (1920, 1080)
LENS = [-0.28, 0.1, 1e-3, -1e-3, 0.02, 0.05, 0.02, 0.01]
# Name, channels, dtype. kornia takes floats only.
CASES = (
    ("gray, float32", 1, torch.float32),
    ("color, float32", 3, torch.float32),
    ("gray, uint8", 1, torch.uint8),
    ("color, uint8", 3, torch.uint8),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="3 rounds in place of 30")
    tables(3 if parser.parse_args().quick else 30)


def tables(rounds: int) -> list[str]:
    """Print the table and return its lines."""
    camera = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, coefficients=LENS, model="opencv8")
    new = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, model="pinhole")
    milliseconds = _milliseconds(times([lambda: undistort_maps(camera, new)], 3)[0])
    print(f"Making kcal's maps, once for each camera: {milliseconds} ms.")
    lines = show(
        [
            "| image | kcal, maps kept | `cv2.remap` | kornia `undistort_image` | cv2 / kcal | kornia / kcal "
            "| largest difference to cv2, levels of 255 |",
            "|---|---|---|---|---|---|---|",
        ]
    )
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    undistort = Undistort(camera, new)
    for name, channels, dtype in CASES:
        lines += show([_row(name, camera, undistort, _image(channels, dtype), rounds)])
    return lines


def _image(channels: int, dtype: torch.dtype) -> torch.Tensor:
    """Levels 0 to 255 of a smooth pattern with some noise, (1, C, H, W)."""
    width, height = SIZE
    x, y = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    pattern = 127.5 + 90 * torch.sin(x / 17) * torch.cos(y / 23)
    noise = 8 * torch.randn(channels, height, width, generator=torch.Generator().manual_seed(0))
    return (pattern + noise).clamp(0, 255).round()[None].to(dtype)


@torch.no_grad()
def _row(name: str, camera: Camera, undistort: Undistort, image: torch.Tensor, rounds: int) -> str:
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
    cells = [name, *(_milliseconds(t) for t in found), *["–"] * (3 - len(found))]
    cells += [*faster, *["–"] * (2 - len(faster)), f"{difference:.3f}"]
    return row(*cells)


def _milliseconds(seconds: list[float]) -> str:
    return median([1e3 * value for value in seconds])


if __name__ == "__main__":
    main()
