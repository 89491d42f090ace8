"""Gradients through a calibration: time, and what Gauss and Newton's matrix would get wrong."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from kcal.calibrate.camera.layer import CalibratedViews, calibrate_views
from kcal.calibrate.camera.result import CalibrationOptions
from kcal.calibrate.problem.board_problem import BoardProblem
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.timing import times
from scripts.shared.views import MODELS, SIZE, simulate

VIEWS, REPEATS, STEP = (30, 200, 800), 3, 1e-3
LENSES = {
    "5": CalibrationOptions(model=MODELS[5]), "14": CalibrationOptions(model=MODELS[14]),
    "default": CalibrationOptions(),
}  # fmt: skip
MOST_DEFAULT = 200  # views


def timed(call: Callable[[], object]) -> float:
    """Median of the CPU seconds of some calls."""
    return statistics.median(times([call], REPEATS, time.process_time)[0])


def linear_gradient(found: CalibratedViews, pixels: Tensor, board: Tensor, options: CalibrationOptions) -> Tensor:
    """What Gauss and Newton's matrix in place of the Hessian makes of the derivative of fx by the corners."""
    free = options.constraints(found.size).free_parameters(found.model)
    problem = BoardProblem(board, pixels, found.model, free)
    rows, size = problem.rows(found.state()), len(free)
    whole = rows.new_zeros(size + 6 * len(rows), len(rows), rows.shape[-1])
    whole[:size] = rows[:, 6:-1].transpose(0, 1)
    for view in range(len(rows)):
        whole[size + 6 * view : size + 6 * view + 6, view] = rows[view, :6]
    flat = whole.flatten(1)
    scale = flat.norm(dim=1, keepdim=True)
    gradient = torch.linalg.lstsq((flat / scale).T, torch.eye(flat.shape[1], dtype=flat.dtype)).solution[0]
    return (gradient / scale[0]).unflatten(0, (len(rows), 2, -1)).transpose(-1, -2)


def study(views: int, lens: str) -> list[object]:
    """A row of the table."""
    drawn = simulate(views)
    board, pixels = torch.from_numpy(drawn["board"]), torch.from_numpy(drawn["pixels"])
    options = LENSES[lens]
    first = calibrate_views(pixels, board, SIZE, options, backward="none")
    again = pixels.clone().requires_grad_(True)
    found = calibrate_views(again, board, SIZE, options, start=first)
    (exact,) = torch.autograd.grad(found.parameters[0], again, retain_graph=True)

    generator = torch.Generator().manual_seed(views)
    along = torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    ends = [
        calibrate_views(pixels + sign * STEP * along, board, SIZE, options, start=first, backward="none").parameters[0]
        for sign in (1.0, -1.0)
    ]
    resolved = float(ends[0] - ends[1]) / (2.0 * STEP)
    error = abs(float((exact * along).sum()) - resolved) / abs(resolved)
    linear = "-"
    if lens == "5" and views == VIEWS[0]:
        off = linear_gradient(first, pixels, board, options) - exact
        linear = f"{100.0 * float(off.norm() / exact.norm()):.2f} %"
    cells = (
        timed(lambda: calibrate_views(pixels, board, SIZE, options, backward="none")),
        timed(lambda: calibrate_views(again, board, SIZE, options, start=first)),
        timed(lambda: torch.autograd.grad(found.parameters[0], again, retain_graph=True)),
    )
    return [views, lens, *(f"{value:.3f}" for value in cells), f"{error:.1e}", linear]


@section("solver.md", "gradients", most=VIEWS[0], lenses=("5",))
def gradients(most: int = VIEWS[-1], lenses: tuple[str, ...] = tuple(LENSES)) -> Iterator[str]:
    heads = ["views", "lens", "from nothing, s", "again, s", "gradient, s", "error", "Gauss-Newton"]
    wanted = [(n, lens) for n in VIEWS if n <= most for lens in lenses if lens != "default" or n <= MOST_DEFAULT]
    return table(heads, (study(n, lens) for n, lens in wanted))
