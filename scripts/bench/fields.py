"""Kinds of fields of the hybrid lens on views that were held out (docs/measured/fields.md).

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

from kcal.calibrate.lensfit.hybrid_fit import HybridFit, fit_hybrid
from kcal.corners.board import Board
from kcal.corners.detect import detect_images
from kcal.corners.images import expand_images
from kcal.corners.observations import Observations
from kcal.lens.field_modes import FieldModes
from kcal.lens.gaussian_modes import GaussianModes
from kcal.lens.network_modes import NetworkModes
from kcal.lens.projection import from_pixels
from kcal.lens.zernike import ZernikeModes
from scripts.shared.field_features import train_features
from scripts.shared.page import CONCLUSIONS, DOCS, table
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


def with_modes(modes: FieldModes) -> Fitter:
    def fit(seen: Observations, weight: Tensor) -> HybridFit:
        return fit_hybrid(seen.board.points, seen.pixels(), seen.image_size, weight, modes=modes)

    return fit


def trained(seen: Observations, weight: Tensor) -> HybridFit:
    """A first fit; a network trained on its field and its residuals; the last layer with everything else again."""
    first = with_modes(ZernikeModes())(seen, weight)
    form, camera = first.camera.model.hybrid, first.camera
    assert form is not None
    pixels = seen.pixels()[(weight > 0) & torch.isfinite(seen.pixels()).all(-1)]
    x, y = (part / form.radius for part in from_pixels(pixels[:, 0], pixels[:, 1], camera.params))
    field = torch.stack(form.modes.field(camera.coefficients[3:], x, y, slopes=False), -1)
    # Projected minus observed; inside the network's unit the residuals are a small part.
    residuals = first.residuals[torch.isfinite(first.residuals).all(-1)]
    corrections = field - residuals / camera.focal
    modes = train_features(torch.stack([x, y], -1), corrections, count=TRAINED, iterations=40)
    return with_modes(modes)(seen, weight)


KINDS: dict[str, Fitter] = {
    "zernike": with_modes(ZernikeModes()),
    "gaussian, 3 widths": with_modes(GaussianModes()),
    "gaussian, 4 widths": with_modes(GaussianModes(widths=(1.0, 0.5, 0.25, 0.125))),
    "network, 60 random features": with_modes(NetworkModes.random(60)),
    f"network, {TRAINED} trained features": trained,
}


def wide_lens(count: int) -> list[Case]:
    seen, weights = load()
    return [Case("wide lens, blocks20", seen, torch.from_numpy(weights), folds("blocks20", len(weights))[:count])]


def stereo(count: int) -> list[Case]:
    cases, folder = [], Path(os.environ["KCAL_DATA"], "opencv_stereo")
    for side in ("left", "right"):
        paths = [path for path in expand_images([str(folder)]) if path.name.startswith(side)]
        seen = detect_images(paths, Board(columns=9, rows=6, square=0.025))
        weight = torch.isfinite(seen.pixels()).all(-1).double()
        parts = [np.array([i]) for i in range(len(seen.views))][:count]
        cases.append(Case(f"OpenCV's images, {side}", seen, weight, parts))
    return cases


def measure(case: Case, fit: Fitter) -> list[str]:
    """Held-out RMS over all parts, effective parameters (median), evidence (median), CPU seconds per fit."""
    total, count, effective, tempering, clock = 0.0, 0, [], [], 0.0
    for out in case.parts:
        train = np.setdiff1d(np.arange(len(case.seen.views)), out)
        start = time.process_time()
        found = fit(case.seen.subset([case.seen.names[i] for i in train]), case.weight[train])
        clock += time.process_time() - start
        effective.append(found.effective)
        tempering.append(found.tempering)
        test = case.seen.subset([case.seen.names[i] for i in out])
        error, corners = held_out(found.camera, found.board_points, test, case.weight[out])
        total, count = total + error, count + corners
    weights = len(found.camera.names) - 8
    return [
        f"{math.sqrt(total / count):.4f}", str(weights), f"{np.median(effective):.1f}",
        f"{np.median(tempering):.2f}", f"{clock / len(case.parts):.1f}",
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wide-folds", type=int, default=5)
    parser.add_argument("--stereo-folds", type=int, default=13)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--write", action="store_true", help="also write docs/measured/fields.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        "# Kinds of fields",
        "",
        CONCLUSIONS["fields.md"],
        "",
        "Made by `scripts/bench/fields.py`. A field is features times weights (`kcal.lens.field_modes`), and "
        "`fit_hybrid(..., modes=...)` sets the priors of all weights by the same evidence. *zernike*: the default, "
        "sorted by how modes turn around the axis. *gaussian*: units on square grids, from one radius of the disc down "
        "by halves. *network*: the last layer over a fixed hidden layer of tanh features, which are random or trained "
        "on the field and the residuals of a first fit with Zernike modes (that fit is part of the CPU seconds). "
        f"Held out: RMS in pixels of {arguments.wide_folds} folds of whole blocks of views of the wide lens (by the "
        f"file's weights), and of {arguments.stereo_folds} single views of OpenCV's images, poses solved again. "
        "Effective: parameters of lens and board that the views determine, of the weights of the field and some more "
        "(medians). Tempering: by how much residuals repeat within views. CPU seconds: per fit, one thread.",
    ]
    heads = ["field", "held out, px", "weights", "effective", "tempering", "CPU s"]
    for case in [*wide_lens(arguments.wide_folds), *stereo(arguments.stereo_folds)]:
        print(case.name, flush=True)
        rows = []
        for kind in arguments.kinds:
            rows.append([kind, *measure(case, KINDS[kind])])
            show([" | ".join(rows[-1])])
        lines += ["", f"## {case.name[0].upper()}{case.name[1:]}", "", *table(heads, rows)]
    if arguments.write:
        (DOCS / "fields.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
