"""Kinds of fields of the hybrid lens on views that were held out.

The wide lens in blocks of views, and OpenCV's stereo images with one view left out, as `scripts/bench/one_camera.py`
does: on held-out views the poses alone are solved again; camera and board stay as fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal import Camera, Observations
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.lens.field_modes import FieldModes, GaussianModes, NetworkModes
from kcal.lens.zernike import ZernikeModes
from kcal.nets import FieldTraining
from scripts.shared.page import table
from scripts.shared.real_captures import stereo_images
from scripts.shared.sections import section
from scripts.shared.wide_lens import folds, load, over_parts

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
    cases = []
    for side in ("left", "right"):
        seen = stereo_images(side)
        parts = [np.array([i]) for i in range(len(seen.views))][:count]
        cases.append(Case(f"{side}, each view", seen, torch.isfinite(seen.pixels()).all(-1).double(), parts))
    return cases


def measure(case: Case, fit: Fitter) -> tuple[float, float]:
    """Held-out RMS over all parts, and CPU seconds per fit."""

    def fitted(seen: Observations, weight: Tensor) -> tuple[Camera, Tensor]:
        found = fit(seen, weight)
        print(f"    {found.effective:.1f} effective parameters, tempering {found.tempering:.2f}", flush=True)
        return found.camera, found.board_points

    return over_parts(fitted, case.seen, case.weight, case.parts)


@section("one-camera.md", "fields", wide_folds=1, stereo_folds=1, kinds=("zernike",))
def fields(wide_folds: int = 5, stereo_folds: int = 13, kinds: tuple[str, ...] = tuple(KINDS)) -> Iterator[str]:
    cases = [*wide_lens(wide_folds), *stereo(stereo_folds)]
    found = ((kind, [measure(case, KINDS[kind]) for case in cases]) for kind in kinds)
    rows = ([kind, *(f"{error:.4f}" for error, _ in each), f"{each[0][1]:.1f}"] for kind, each in found)
    return table(["field", *(case.name for case in cases), "CPU s, wide lens"], rows)
