"""Checks and warnings for a finished calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.outliers import corners_beyond
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.problem.priors import GaussianPrior, Term
from kcal.calibrate.problem.state import BoardState
from kcal.lens.camera import Camera
from kcal.solve.result import SolverStatus

# Another solution with a χ² higher by less than this cannot be excluded: 14 parameters more gain as much by chance.
_CLOSE_RIVAL = 25.0
# Mean square of the differences from priors, in their standard deviations, beyond which the data contradict them.
_CONTRADICTION = 3.0
# A corner is reported if it is this many times farther off than noise explains.
_GROSS = 2.0
# Tempering that chance and rounding do not explain: it is 1 on simulated captures, 2.2 on the wide lens's.
REPEATING = 2.0
# Of the principal point, in standard deviations of its prior.
_FAR_CENTER = 3.0
NO_ERROR_BARS = (
    "no error bars: σ cannot be computed, because a corner lies where the lens model folds; choose a smaller model"
)


def prior_warnings(terms: Sequence[Term], state: BoardState, noise: float) -> list[str]:
    """A warning where parameters differ from their priors by much more than the priors allow.

    Args:
        terms: the priors among them are checked.
        state: the solution.
        noise: pixels, in proportion to which the priors counted.
    """
    values = torch.cat([state.parameters, state.board])
    rows = [term.rows(values)[-1] for term in terms if isinstance(term, GaussianPrior)]
    squared = sum(float((row / noise).square().sum()) for row in rows)
    count = sum(len(row) for row in rows)
    if squared <= _CONTRADICTION * count:
        return []
    return [
        f"the views contradict the priors: the parameters differ from them by {(squared / count) ** 0.5:.1f} standard "
        "deviations; give wider priors, for a strong lens a larger weak prior or none"
    ]


def rival_warnings(
    camera: Camera,
    sigma: Mapping[str, float | None],
    rivals: Sequence[tuple[float, BoardState]],
    cost: float,
    residual_count: int,
) -> list[str]:
    """A warning where another solution, of (cost, state), fits almost as well and lies outside the error bars."""
    variance = max(2.0 * cost / residual_count, 1e-300)
    here = dict(zip(camera.names, camera.params.tolist(), strict=True))
    for other, state in rivals:
        if not 2.0 * (other - cost) / variance < _CLOSE_RIVAL:
            continue
        there = dict(zip(camera.names, state.parameters.tolist(), strict=True))
        apart = {
            name: there[name] - here[name]
            for name in ("fx", "fy", "cx", "cy")
            if abs(there[name] - here[name]) > max(1.0, 4.0 * (sigma.get(name) or 0.0))
        }
        if apart:
            rms = (2.0 * variance * other / cost) ** 0.5
            where = ", ".join(f"{name} {shift:+.1f} px" for name, shift in apart.items())
            return [
                f"another solution fits almost as well (RMS {rms:.4f} px) with {where}: do not trust this model's "
                "parameters; choose a smaller model or add views"
            ]
    return []


def hybrid_warnings(fit: HybridFit) -> list[str]:
    """Warnings about the evidence: residuals that repeat within views, a principal point far from the middle."""
    found = []
    if fit.tempering > REPEATING:
        found.append(
            f"residuals repeat within views (tempering {fit.tempering:.1f}, where noise alone gives 1): blur, motion "
            "or a board that flexes; error bars are widened for it; use a stiff board, a stand and a short exposure"
        )
    off = (fit.state.parameters[2:4] - fit.families.mean[1:3]).norm() / fit.families.log_unit[1].exp()
    if float(off) > _FAR_CENTER:
        cx, cy = (float(value) for value in fit.state.parameters[2:4])
        found.append(
            f"the principal point ({cx:.0f}, {cy:.0f}) is far from the middle of the image: give images that are not "
            "cropped, and turn the board by 90 degrees in a third of the views"
        )
    return found


def outlier_warnings(names: Sequence[str], residuals: Tensor) -> list[str]:
    """A warning where a corner is off by twice what noise explains; residuals (V, N, 2), NaN where not seen.

    Smaller deviations are as often the lens model's fault.
    """
    beyond = corners_beyond(residuals)
    if not bool(corners_beyond(residuals, _GROSS).any()):
        return []
    count = int(beyond.sum())
    length = residuals.nan_to_num(0.0).norm(dim=-1)
    view, corner = divmod(int(length.argmax()), length.shape[1])
    return [
        f"{count} of {int(residuals.isfinite().all(-1).sum())} corners are farther off than noise explains, corner "
        f"{corner} of view {names[view]} by {float(length.max()):.2f} px: look at them, and leave wrong ones out "
        "(--reject); a parametric lens may need a richer model"
    ]


def general_warnings(
    names: Sequence[str], camera: Camera, rms: float, per_view: Tensor, lost: Sequence[str], status: SolverStatus
) -> list[str]:
    """Warnings about the solver, the RMS, parameters that are not determined, and folds of the lens.

    Args:
        names: of the views.
        camera: the calibrated camera.
        rms: over all corners, pixels.
        per_view: (V,) likewise.
        lost: names of parameters that the views do not determine.
        status: of the solver.
    """
    found = []
    hybrid = camera.model.hybrid is not None
    if status not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        rest = ": the camera may be farther off than its error bars say; add views, and see which of them fit worst"
        found.append(f"the solver {status.message}{rest if hybrid else ''}")
    if rms > 1.0:
        found.append(
            f"RMS {rms:.2f} px is high: corners, board and lens model do not fit each other; check the board's size, "
            "and look at the views that fit worst"
        )
    typical = float(per_view.median())
    for i in (per_view > max(3.0 * typical, 0.1)).nonzero()[:, 0].tolist():
        found.append(f"view {names[i]}: RMS {float(per_view[i]):.2f} px is high, {typical:.2f} px is typical; check it")
    if lost:
        found.append(f"the views do not determine {', '.join(lost)}: choose a smaller model or add views")
    if not bool(camera.covers_image()):
        _, valid = camera.unproject(camera.grid(33, 25))
        share = 100.0 * float((~valid).double().mean())
        if hybrid:
            found.append(
                f"{share:.0f} % of the image has no ray: no board was there, and the lens found from the rest ends "
                "before; if the lens shows anything there, add views with the board in these parts"
            )
        else:
            found.append(
                f"the lens model folds inside the image: {share:.0f} % of it has no ray; choose a smaller model, or "
                "add views with corners there"
            )
    return found
