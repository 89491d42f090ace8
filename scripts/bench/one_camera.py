"""The hybrid camera, fitted by evidence, on real captures: views that were held out, beside parametric models.

    KCAL_DATA=DATA python -m scripts.bench.one_camera --split blocks20        # the wide lens, whole blocks held out
    KCAL_DATA=DATA python -m scripts.bench.one_camera --split evenodd
    KCAL_DATA=DATA python -m scripts.bench.one_camera --views 8               # fitted to 8 of its views, three draws
    KCAL_DATA=DATA python -m scripts.bench.one_camera --stereo                # OpenCV's images, one view left out
    KCAL_DATA=DATA python -m scripts.bench.one_camera --epipolar              # the same, 9 pairs fitted and 4 held out
    KCAL_MRCAL=/usr/bin/python3 ... --models mrcal                            # mrcal's spline too, of the wide lens

With --write the row goes into the table of docs/measured/one-camera.md.

On each held-out view only its pose is solved again; camera and board stay as fitted. Measure: sqrt(sum w² |r|² / count)
over all folds, with the weights of the file (OpenCV's images: all one). Epipolar error:
Sampson's distance of held-out corners in pixels, which needs no board.
"""

from __future__ import annotations

import argparse
import functools
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kcal import Board, Camera, Observations, Rig, RigOptions, calibrate_rig, detect
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.hybrid.fit import fit_hybrid
from kcal.corners.images import expand_images
from scripts.shared.mrcal_spline import splined
from scripts.shared.page import write_row
from scripts.shared.timing import row, show
from scripts.shared.wide_lens import folds, held_out, load, warped

# The spline of mrcal that predicts held-out views of the wide lens best, and about its focal length, pixels.
SPLINE, FOCAL = "SPLINED11x8", 1900.0
SPLITS = {"blocks20": "whole blocks of views", "evenodd": "every other view"}
# A camera and the corners of its board (N, 3), from views and their weights (V, N).
Fitter = Callable[[Observations, Tensor], tuple[Camera, Tensor]]


def hybrid(seen: Observations, weight: Tensor) -> tuple[Camera, Tensor]:
    found = fit_hybrid(seen.board.points, seen.pixels(), seen.image_size, weight)
    print(
        f"    sigma {found.sigma:.3f} px, tempering {found.tempering:.2f}, {found.effective:.1f} effective parameters",
        flush=True,
    )
    return found.camera, found.board_points


def parametric(model: str, weak_prior: float | None) -> Fitter:
    def fit(seen: Observations, weight: Tensor) -> tuple[Camera, Tensor]:
        found = calibrate_camera(seen, CalibrationOptions(model=model, board_warp=True, weak_prior=weak_prior))
        assert found.board_warp is not None
        return found.camera, warped(seen, found.board_warp)

    return fit


MODELS: dict[str, Fitter] = {
    "hybrid": hybrid,
    "opencv5": parametric("opencv5", None),
    "opencv14, weak prior": parametric("opencv14", 0.3),
    "ext20, weak prior": parametric("ext20", 0.3),
}


def with_mrcal(seen: Observations, weight: Tensor, parts: list[np.ndarray]) -> str:
    """Mrcal's splined lens with a warped board."""
    corners, weights = seen.pixels().numpy(), weight.numpy()
    found = [
        splined(SPLINE, corners, weights, out, size=seen.image_size, board=seen.board, focal=FOCAL) for out in parts
    ]
    total, seconds, count = (sum(one[key] for one in found) for key in ("sum", "cpu_s", "count"))
    return f"{math.sqrt(total / count):.4f} ({seconds / len(parts):.1f} s)"


def measure(name: str, seen: Observations, weight: Tensor, parts: list[np.ndarray]) -> str:
    if name == "mrcal":
        return with_mrcal(seen, weight, parts)
    total, seconds, count = 0.0, 0.0, 0
    for out in parts:
        train = np.setdiff1d(np.arange(len(seen.views)), out)
        start = time.process_time()
        camera, points = MODELS[name](seen.subset([seen.names[i] for i in train]), weight[train])
        seconds += time.process_time() - start
        test = seen.subset([seen.names[i] for i in out])
        error, corners = held_out(camera, points, test, weight[out])
        total, count = total + error, count + corners
    return f"{math.sqrt(total / count):.4f} ({seconds / len(parts):.1f} s)"


def epipolar(rig: Rig, left: Tensor, right: Tensor) -> Tensor:
    """Sampson's distances (N,) in pixels of matched corners (N, 2) from coplanarity."""
    pixels = torch.cat([left, right], -1).requires_grad_(True)
    rays = [camera.unproject(part)[0] for camera, part in zip((rig.left, rig.right), pixels.split(2, -1), strict=True)]
    turned = rays[0] @ rig.right_from_left_rotation.T
    volume = (torch.linalg.cross(turned, rays[1]) * rig.right_from_left_translation).sum(-1)
    (slope,) = torch.autograd.grad(volume.sum(), pixels)
    return (volume / slope.norm(dim=-1)).detach()


def rig_of(model: str, sides: list[Observations]) -> Rig:
    """Both cameras and the rig by default, from the same pairs: lenses, board and pose are refined together."""
    name, _, prior = model.partition(", ")
    options = CalibrationOptions(model=name, weak_prior=0.3 if prior else None)
    cameras = [calibrate_camera(seen, options if name != "hybrid" else None).camera for seen in sides]
    pairs = list(zip(sides[0].names, sides[1].names, strict=True))
    return calibrate_rig(cameras[0], cameras[1], sides[0], sides[1], pairs, RigOptions(reject=False)).stereo()


def measure_epipolar(name: str, sides: list[Observations]) -> float:
    """RMS over all rotations of 9 pairs fitted and 4 held out."""
    count, errors = len(sides[0].views), []
    for begin in range(count):
        out = [(begin + 3 * i) % count for i in range(4)]
        train = [[seen.names[i] for i in range(count) if i not in out] for seen in sides]
        rig = rig_of(name, [seen.subset(names) for seen, names in zip(sides, train, strict=True)])
        left, right = (seen.pixels()[out].reshape(-1, 2) for seen in sides)
        both = torch.isfinite(left).all(-1) & torch.isfinite(right).all(-1)
        errors.append(epipolar(rig, left[both], right[both]))
    return float(torch.cat(errors).square().mean().sqrt())


def stereo_images() -> list[Observations]:
    """OpenCV's stereo images."""
    paths = expand_images([str(Path(os.environ["KCAL_DATA"], "opencv_stereo"))])
    board = Board(columns=9, rows=6, square=0.025)
    sides = ("left", "right")
    return [detect([path for path in paths if path.name.startswith(side)], board) for side in sides]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=list(SPLITS), help="of the wide lens")
    parser.add_argument("--views", type=int, help="fitted of the wide lens, all others held out")
    parser.add_argument("--stereo", action="store_true", help="OpenCV's stereo images, both cameras")
    parser.add_argument("--epipolar", action="store_true", help="OpenCV's stereo images, pairs")
    parser.add_argument("--models", nargs="*", default=list(MODELS), choices=[*MODELS, "mrcal"])
    parser.add_argument("--write", action="store_true", help="write the tables into the page")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    columns = [*MODELS, "mrcal"]

    def tell(name: str, measured: Callable[[str], str]) -> None:
        cells = [measured(model) if model in arguments.models else None for model in columns]
        show([row(name, *(cell or "" for cell in cells))])
        if arguments.write:
            write_row("one-camera.md", "held-out", ["held out", *MODELS, f"mrcal, {SPLINE}"], [name, *cells])

    if arguments.split:
        seen, weights = load()
        parts = folds(arguments.split, len(seen.views))
        tell(
            f"wide lens, {SPLITS[arguments.split]}", lambda name: measure(name, seen, torch.from_numpy(weights), parts)
        )
    if arguments.views:
        seen, weights = load()
        draws = [
            np.random.default_rng(seed).permutation(len(seen.views))[arguments.views :] for seed in (100, 101, 102)
        ]
        name = f"wide lens, all but {arguments.views} views"
        tell(name, lambda name: measure(name, seen, torch.from_numpy(weights), draws))
    if arguments.stereo:
        for side, seen in zip(("left", "right"), stereo_images(), strict=True):
            weight = torch.isfinite(seen.pixels()).all(-1).double()
            each = [np.array([i]) for i in range(len(seen.views))]
            fitted = functools.partial(measure, seen=seen, weight=weight, parts=each)
            tell(f"OpenCV's images, {side}, each view", fitted)
    if arguments.epipolar:
        sides = stereo_images()
        tell("OpenCV's pairs, 4 of 13", lambda name: f"{measure_epipolar(name, sides):.4f}")


if __name__ == "__main__":
    main()
