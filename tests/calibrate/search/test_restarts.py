"""Local minima are left along the directions that the data hardly determine."""

from __future__ import annotations

import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, pixels_of

from kcal.calibrate.bundle.board_problem import BoardState
from kcal.calibrate.bundle.views import CameraViews
from kcal.calibrate.search.restarts import restart, restart_states
from kcal.solve.lm import LMOptions, minimize

OPTIONS = LMOptions(tolerance=1e-10)


def solved(noise: float = 0.2) -> tuple[CameraViews, BoardState]:
    truth = camera("opencv8")
    poses = motions(truth, 8, 4)
    pixels = pixels_of(truth, poses, noise=noise, seed=6)
    views = CameraViews(board_points=BOARD.points, pixels=pixels, size=SIZE)
    return views, BoardState.flat(truth.params.detach(), *poses)


def anything(_: BoardState) -> bool:
    return True


def test_starts_lie_as_far_away_as_they_say() -> None:
    """At 2 standard deviations along any direction the cost is higher by half of 2² noise variances, to first order."""
    views, start = solved()
    problem = views.lens_problem(camera("opencv8").model)
    end = minimize(problem, start, OPTIONS)
    variance = 2.0 * float(end.cost) / problem.residual_count
    starts = restart_states(problem, end.state)
    assert 4 <= len(starts) <= 8
    costs = torch.stack([problem.cost(state) for state in starts])
    assert bool(costs.isfinite().all())
    # The shortest length is 2: nothing begins nearer than half of that, however curved the cost is.
    assert float((costs - end.cost).min()) > 0.5 * variance


def test_never_ends_higher_and_leaves_an_exact_solution_alone() -> None:
    views, start = solved()
    problem = views.lens_problem(camera("opencv8").model)
    end = minimize(problem, start, OPTIONS)
    found = restart(problem, end, OPTIONS, anything)
    assert float(found.cost) <= float(end.cost)
    assert int(found.iterations) > 0
    views, start = solved(noise=0.0)
    problem = views.lens_problem(camera("opencv8").model)
    exact = minimize(problem, start, OPTIONS)
    assert int(restart(problem, exact, OPTIONS, anything).iterations) == 0


def test_finds_back_from_a_worse_minimum() -> None:
    """From where a solver gives up far too early, the lowest minimum is reached all the same."""
    views, start = solved()
    problem = views.lens_problem(camera("opencv8").model)
    best = minimize(problem, start, OPTIONS)
    early = minimize(problem, start._replace(parameters=start.parameters * 1.01), LMOptions(max_iterations=3))
    assert float(early.cost) > 1.001 * float(best.cost)
    assert float(restart(problem, early, OPTIONS, anything).cost) <= (1.0 + 1e-6) * float(best.cost)
    refused = restart(problem, early, OPTIONS, lambda _: False)
    assert float(refused.cost) == float(early.cost)
