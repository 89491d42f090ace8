"""Whether richer models end above poorer ones on real views, which must not be: 5 to 24 coefficients.

Corners count alike (`weighted=False`), so that the RMS is what is minimized.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kcal import Observations
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.solve.lm import SolverStatus
from scripts.shared import wide_lens
from scripts.shared.page import table
from scripts.shared.real_captures import stereo_images
from scripts.shared.sections import section

LADDER = {5: "opencv5", 8: "opencv8", 12: "opencv12", 14: "opencv14", 16: "ext16", 18: "ext18", 20: "ext20"} | {
    22: "ext22", 24: "ext24"
}  # fmt: skip
SETS = ("left", "right", "wide")


# Relative, of the RMS: what counts as not rising.
SAME_RMS = 1e-6


def real_sets(names: tuple[str, ...]) -> Iterator[tuple[str, Observations]]:
    """The real views by name: both cameras of OpenCV's sample, and a very wide lens."""
    for name in names:
        seen = wide_lens.load()[0] if name == "wide" else stereo_images(name)
        yield name, seen


@section("solver.md", "richer models", sets=("left",), most=8)
def ladder(sets: tuple[str, ...] = SETS, most: int = 24) -> Iterator[str]:
    """RMS over the models, rises marked."""
    models = [count for count in LADDER if count <= most]

    def rows() -> Iterator[list[str]]:
        for name, seen in real_sets(sets):
            cells, rises, before = [], [], np.inf
            for coefficients in models:
                options = CalibrationOptions(model=LADDER[coefficients], weighted=False, weak_prior=None)
                result = calibrate_camera(seen, options)
                mark = {SolverStatus.AT_BOUND: "ᵇ", SolverStatus.FLAT: "ᶠ"}.get(result.status, "")
                cells.append(f"{result.rms:.6f}{mark}")
                if result.rms > before * (1 + SAME_RMS):
                    rises.append(f"{coefficients}: {result.rms / before - 1:+.1e}")
                before = min(before, result.rms)
            yield [name, *cells, ", ".join(rises) or "none"]

    return table(["views", *models, "rises"], rows())
