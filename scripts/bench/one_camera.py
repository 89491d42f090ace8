"""The hybrid camera, fitted by evidence, on real captures: views that were held out, beside parametric models.

    KCAL_DATA=DATA python -m scripts.bench.one_camera --split blocks20        # the wide lens, whole blocks held out
    KCAL_DATA=DATA python -m scripts.bench.one_camera --split evenodd
    KCAL_DATA=DATA python -m scripts.bench.one_camera --stereo                # OpenCV's images, one view left out

On each held-out view only its pose is solved again; camera and board stay as fitted. Measure: sqrt(sum w² |r|² / count)
over all folds, with the weights of the file (OpenCV's images: all one).
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.lensfit.hybrid_fit import fit_hybrid
from kcal.corners.board import Board
from kcal.corners.detect import detect_images
from kcal.corners.images import expand_images
from kcal.corners.observations import Observations
from kcal.lens.camera import Camera
from scripts.shared.timing import row, show
from scripts.shared.wide_lens import folds, held_out, load, warped

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


def measure(name: str, seen: Observations, weight: Tensor, parts: list[np.ndarray]) -> str:
    total, seconds, count = 0.0, 0.0, 0
    for out in parts:
        train = np.setdiff1d(np.arange(len(seen.views)), out)
        start = time.process_time()
        camera, points = MODELS[name](seen.subset([seen.names[i] for i in train]), weight[train])
        seconds += time.process_time() - start
        test = seen.subset([seen.names[i] for i in out])
        error, corners = held_out(camera, points, test, weight[out])
        total, count = total + error, count + corners
    return row(name, f"{math.sqrt(total / count):.4f}", f"{seconds / len(parts):.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=["blocks20", "evenodd"], help="of the wide lens")
    parser.add_argument("--stereo", action="store_true", help="OpenCV's stereo images, both cameras")
    parser.add_argument("--models", nargs="*", default=list(MODELS), choices=list(MODELS))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    head = [row("model", "held out, RMS px", "CPU s per fit"), row("---", "---", "---")]
    if arguments.split:
        seen, weights = load()
        show([f"Wide lens, {arguments.split}", "", *head])
        for name in arguments.models:
            show([measure(name, seen, torch.from_numpy(weights), folds(arguments.split, len(seen.views)))])
    if arguments.stereo:
        folder = Path(os.environ["KCAL_DATA"], "opencv_stereo")
        for side in ("left", "right"):
            paths = [path for path in expand_images([str(folder)]) if path.name.startswith(side)]
            seen = detect_images(paths, Board(columns=9, rows=6, square=0.025))
            weight = torch.isfinite(seen.pixels()).all(-1).double()
            show(["", f"OpenCV's stereo images, {side}, one view left out", "", *head])
            for name in arguments.models:
                show([measure(name, seen, weight, [np.array([i]) for i in range(len(seen.views))])])


if __name__ == "__main__":
    main()
