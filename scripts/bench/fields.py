"""Kinds of fields of the hybrid lens on views that were held out (docs/measured/one-camera.md).

    KCAL_DATA=... python -m scripts.bench.fields [--wide-folds 5] [--stereo-folds 13] [--write]

The wide lens in blocks of views, and OpenCV's stereo images with one view left out, as `scripts/bench/one_camera.py`
does: on held-out views the poses alone are solved again; camera and board stay as fitted.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal import Board, Observations, detect
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.corners.images import expand_images
from kcal.lens.field_modes import FieldModes, GaussianModes, NetworkModes
from kcal.lens.zernike import ZernikeModes
from kcal.nets import FieldTraining
from scripts.shared.page import table, write_section
from scripts.shared.timing import show
from scripts.shared.wide_lens import folds, held_out, load

Fitter = Callable[[Observations, Tensor], HybridFit]
TRAINED = 40


class Case(NamedTuple):
    """Views, the weights (V, N) of their corners, and which views are held out together."""

    name: str
    seen: Observations
    weight: Tensor
    parts: Sequence[np.ndarray]


def with_modes(modes: FieldModes, training: FieldTraining | None = None) -> Fitter:
    def fit(seen: Observations, weight: Tensor) -> HybridFit:
        return fit_hybrid(
            seen.board.points, seen.pixels(), seen.image_size, weight, FitOptions(modes=modes, training=training)
        )

    return fit


KINDS: dict[str, Fitter] = {
    "zernike": with_modes(ZernikeModes()),
    "gaussian, 3 widths": with_modes(GaussianModes()),
    "gaussian, 4 widths": with_modes(GaussianModes(widths=(1.0, 0.5, 0.25, 0.125))),
    "network, 60 random features": with_modes(NetworkModes.random(60)),
    f"network, {TRAINED} trained features": with_modes(NetworkModes.random(TRAINED), FieldTraining()),
}


def wide_lens(count: int) -> list[Case]:
    seen, weights = load()
    return [Case("wide lens, whole blocks", seen, torch.from_numpy(weights), folds("blocks20", len(weights))[:count])]


def stereo(count: int) -> list[Case]:
    cases, folder = [], Path(os.environ["KCAL_DATA"], "opencv_stereo")
    for side in ("left", "right"):
        paths = [path for path in expand_images([str(folder)]) if path.name.startswith(side)]
        seen = detect(paths, Board(columns=9, rows=6, square=0.025))
        weight = torch.isfinite(seen.pixels()).all(-1).double()
        parts = [np.array([i]) for i in range(len(seen.views))][:count]
        cases.append(Case(f"{side}, each view", seen, weight, parts))
    return cases


def measure(case: Case, fit: Fitter) -> tuple[float, float]:
    """Held-out RMS over all parts, and CPU seconds per fit."""
    total, count, clock = 0.0, 0, 0.0
    for out in case.parts:
        train = np.setdiff1d(np.arange(len(case.seen.views)), out)
        start = time.process_time()
        found = fit(case.seen.subset([case.seen.names[i] for i in train]), case.weight[train])
        clock += time.process_time() - start
        print(
            f"    {case.name}: {found.effective:.1f} effective parameters, tempering {found.tempering:.2f}", flush=True
        )
        test = case.seen.subset([case.seen.names[i] for i in out])
        error, corners = held_out(found.camera, found.board_points, test, case.weight[out])
        total, count = total + error, count + corners
    return math.sqrt(total / count), clock / len(case.parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wide-folds", type=int, default=5)
    parser.add_argument("--stereo-folds", type=int, default=13)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--write", action="store_true", help="also write the table of docs/measured/one-camera.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cases = [*wide_lens(arguments.wide_folds), *stereo(arguments.stereo_folds)]
    rows = []
    for kind in arguments.kinds:
        found = [measure(case, KINDS[kind]) for case in cases]
        rows.append([kind, *(f"{error:.4f}" for error, _ in found), f"{found[0][1]:.1f}"])
        show([" | ".join(rows[-1])])
    if arguments.write:
        heads = ["field", *(case.name for case in cases), "CPU s, wide lens"]
        write_section("one-camera.md", "fields", table(heads, rows))


if __name__ == "__main__":
    main()
