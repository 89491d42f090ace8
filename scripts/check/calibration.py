"""Whether calibration ends where it should, on real views.

Richer models must not end above poorer ones (5 to 24 coefficients), and neither the start nor the units of the
parameters may matter. Corners count alike (`weighted=False`), so that the RMS is what is minimized.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from kcal import KcalError, Observations
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import free_parameters
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.projection import INTRINSICS
from kcal.solve.lm import SolverStatus, State, minimize
from scripts.shared import wide_lens
from scripts.shared.page import table
from scripts.shared.real_captures import stereo_images
from scripts.shared.sections import section

LADDER = {5: "opencv5", 8: "opencv8", 12: "opencv12", 14: "opencv14", 16: "ext16", 18: "ext18", 20: "ext20"} | {
    22: "ext22", 24: "ext24"
}  # fmt: skip
# Coefficients and weak prior.
STARTED = ((5, None), (8, None), (14, None), (14, 0.3), (20, 0.3))
UNITS = 1e6
SETS = ("left", "right", "wide")
# Relative, of the RMS: what counts as the same optimum, and as not rising.
SAME_RMS, SAME_PIXELS = 1e-6, 1e-3


def real_sets(names: tuple[str, ...]) -> Iterator[tuple[str, Observations]]:
    """The real views by name: both cameras of OpenCV's sample, and a very wide lens."""
    for name in names:
        seen = wide_lens.load()[0] if name == "wide" else stereo_images(name)
        yield name, seen


def options(coefficients: int, focal: float | None = None, weak: float | None = None) -> CalibrationOptions:
    return CalibrationOptions(model=LADDER[coefficients], weighted=False, focal=focal, weak_prior=weak)


@section("solver.md", "richer models", sets=("left",), most=8)
def ladder(sets: tuple[str, ...] = SETS, most: int = 24) -> Iterator[str]:
    """RMS over the models, rises marked."""
    models = [count for count in LADDER if count <= most]

    def rows() -> Iterator[list[str]]:
        for name, seen in real_sets(sets):
            cells, rises, before = [], [], np.inf
            for coefficients in models:
                result = calibrate_camera(seen, options(coefficients))
                mark = {SolverStatus.AT_BOUND: "ᵇ", SolverStatus.FLAT: "ᶠ"}.get(result.status, "")
                cells.append(f"{result.rms:.6f}{mark}")
                if result.rms > before * (1 + SAME_RMS):
                    rises.append(f"{coefficients}: {result.rms / before - 1:+.1e}")
                before = min(before, result.rms)
            yield [name, *cells, ", ".join(rises) or "none"]

    return table(["views", *models, "rises"], rows())


class Rescaled(BoardProblem):
    """The same problem in other units of the camera's parameters: θ' = θ / unit."""

    units: Tensor

    def rows(self, state: BoardState, views: slice = slice(None)) -> Tensor:
        """Derivatives by θ' are those by θ times the unit."""
        out = super().rows(state, views)
        out[..., 6:-1, :] *= self.units[:, None]
        return out

    def retract(self, state: BoardState, step: State) -> BoardState:
        """A step in θ' is one in θ times the unit."""
        return super().retract(state, (step[0] * self.units, step[1]))


@dataclasses.dataclass(frozen=True)
class End:
    """Where one start ended: RMS and the residuals of the corners (V, N, 2)."""

    rms: float
    residuals: Tensor
    status: SolverStatus


def _public(seen: Observations, coefficients: int, focal: float | None, weak: float | None) -> End | None:
    try:
        result = calibrate_camera(seen, options(coefficients, focal, weak))
    except KcalError:
        return None
    return End(result.rms, result.residuals, result.status)


def _in_units(seen: Observations, coefficients: int, unit: float, weak: float | None) -> End | None:
    """Lengths, and with them all translations, in other units."""
    board = seen.board.model_copy(update={"square": seen.board.square * unit})
    return _public(seen.model_copy(update={"board": board}), coefficients, None, weak)


def _alone(
    seen: Observations, model: LensModel, solution: CameraCalibrationResult, draw: np.random.Generator, unit: bool
) -> End | None:
    """The solver without the searches around it, from far away: no lens, wrong focal length, shaken boards."""
    shape = (len(seen.views), 3)
    factor = 2.0 ** draw.uniform(-1, 1)
    parameters = torch.zeros(len(INTRINSICS) + model.size, dtype=torch.float64)
    parameters[:4] = solution.camera.params.detach()[:4]
    parameters[:2] *= factor
    turn = rotation_from_vector(torch.from_numpy(draw.normal(0, np.deg2rad(5), shape)))
    scale = torch.from_numpy(draw.normal(1, 0.05, shape)) * torch.tensor([1.0, 1.0, factor]).double()
    pose = turn @ solution.cam_from_board_rotation, solution.cam_from_board_translation * scale
    kind = Rescaled if unit else BoardProblem
    problem = kind(seen.board.points, seen.pixels(), model, free_parameters(model))
    if isinstance(problem, Rescaled):
        problem.units = 10.0 ** torch.from_numpy(draw.uniform(-6, 6, problem.shared_size))
    solved = minimize(problem, BoardState.flat(parameters, *pose), CalibrationOptions().solver)
    if not bool(solved.cost.isfinite()):
        return None
    residuals = problem.corner_residuals(solved.state)
    return End(float(torch.sqrt(4 * solved.cost / problem.residual_count)), residuals, SolverStatus(int(solved.status)))


@section("solver.md", "starts", sets=("left",), count=1)
def starts(sets: tuple[str, ...] = SETS, count: int = 20) -> Iterator[str]:
    """How far ends lie apart."""
    heads = ["views", "coefficients", "starts", "at the optimum", "worst RMS", "worst projection px", "CPU s each"]
    return table(heads, _starts(sets, count))


def _starts(sets: tuple[str, ...], count: int) -> Iterator[list[str]]:
    for name, seen in real_sets(sets):
        for coefficients, weak in STARTED:
            draw = np.random.default_rng(coefficients)
            model = LensModel.named(LADDER[coefficients])
            solution = calibrate_camera(seen, options(coefficients, weak=weak))
            focal = float(solution.camera.focal[0])
            runs: dict[str, list[End | None]] = {}
            took: dict[str, float] = {}
            clock = time.process_time()
            runs["focal length given wrongly, factor 1/2 to 2"] = [
                _public(seen, coefficients, focal * 2.0 ** draw.uniform(-1, 1), weak) for _ in range(count)
            ]
            took["focal length given wrongly, factor 1/2 to 2"] = (time.process_time() - clock) / count
            clock = time.process_time()
            runs["lengths in units of 1e6 and 1e-6"] = [
                _in_units(seen, coefficients, unit, weak) for unit in (UNITS, 1 / UNITS)
            ]
            took["lengths in units of 1e6 and 1e-6"] = (time.process_time() - clock) / 2
            alone = (("solver alone", False), ("solver alone, parameters in units 1e-6 to 1e6", True))
            for label, unit in () if weak else alone:
                clock = time.process_time()
                runs[label] = [_alone(seen, model, solution, draw, unit) for _ in range(count)]
                took[label] = (time.process_time() - clock) / count
            plain = End(solution.rms, solution.residuals, solution.status)
            best = min([plain, *[e for k in runs if "alone" not in k for e in runs[k] if e]], key=lambda end: end.rms)
            for label, ends in runs.items():
                found = [e for e in ends if e is not None]
                gaps = [(e.rms / best.rms - 1, float((e.residuals - best.residuals).nan_to_num().abs().max()))
                        for e in found]  # fmt: skip
                good = sum(abs(r) <= SAME_RMS and p <= SAME_PIXELS for r, p in gaps)
                worst = [f"{max(g[k] for g in gaps):{form}}" if gaps else "-" for k, form in ((0, "+.1e"), (1, ".1e"))]
                prior = ", weak prior" if weak else ""
                yield [
                    name, f"{coefficients}{prior}", label, f"{good} of {len(ends)}", *worst, f"{took[label]:.2f}"
                ]  # fmt: skip
