"""What to think of a calibration: what is refused, and what the user should doubt."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.priors import Prior, Term
from kcal.calibrate.camera.outliers import corners_beyond
from kcal.calibrate.camera.prior_comparison import PriorComparison
from kcal.calibrate.search.model_ladder import Minimum
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError
from kcal.lens.camera import Camera
from kcal.solve.result import SolverStatus, State

# A focal length known to worse than this is not a calibration: 5 % of range at every distance.
_MAX_FOCAL_SIGMA = 0.05
# A rival that is worse by less χ² than this cannot be ruled out: the gain that chance gives 14 more parameters.
_CLOSE_RIVAL = 25.0
# Mean square of what priors are missed by, in their standard deviations, from which on they are contradicted.
_CONTRADICTION = 3.0
# A corner this many times farther off than noise explains is told of.
_GROSS = 2.0
NO_ERROR_BARS = (
    "no error bars: a corner lies where the lens model folds, so that σ cannot be computed; choose a smaller model"
)


def check_focal(sigma: Mapping[str, float], parameters: Tensor) -> None:
    """Raise `DegenerateError` where the focal length is hardly known: that is no calibration.

    Args:
        sigma: standard deviations of the free parameters by name, infinite where not determined; NaN, of which nothing
            is known, counts as that.
        parameters: (5 + P,).
    """
    shares = [sigma.get(name, 0.0) / float(parameters[i]) for i, name in enumerate(("fx", "fy"))]
    worst = max(math.inf if math.isnan(share) else share for share in shares)
    if not worst <= _MAX_FOCAL_SIGMA:
        known = "not at all" if math.isinf(worst) else f"only to ±{100 * worst:.1f} %"
        raise DegenerateError(
            f"the views determine the focal length {known}: they are parallel to the image or too much alike; add "
            "views with the board tilted by 30 to 45 degrees in different directions, or choose a smaller model"
        )


def contradicted(terms: Sequence[Term], state: State, noise: float) -> list[str]:
    """A warning where parameters lie much farther from where priors expect them than the priors allow for.

    Args:
        terms: the priors among them are looked at.
        state: the solution.
        noise: pixels, beside which the priors counted.
    """
    values = torch.cat([state[0], state[1]])
    rows = [term.rows(values)[-1] for term in terms if isinstance(term, Prior)]
    squared = sum(float((row / noise).square().sum()) for row in rows)
    count = sum(len(row) for row in rows)
    if squared <= _CONTRADICTION * count:
        return []
    return [
        f"the views contradict the priors: the parameters lie {(squared / count) ** 0.5:.1f} of their standard "
        "deviations away; give wider ones, for a strong lens a larger weak prior or none"
    ]


def rival_warnings(
    camera: Camera, sigma: dict[str, float | None], minimum: Minimum, cost: float, residual_count: int
) -> list[str]:
    """A warning where another solution fits almost as well and is farther away than the error bars say."""
    variance = max(2.0 * cost / residual_count, 1e-300)
    here = dict(zip(camera.names, camera.params.tolist(), strict=True))
    for other, state in minimum.rivals:
        if not 2.0 * (other - cost) / variance < _CLOSE_RIVAL:
            continue
        there = dict(zip(camera.names, state[0].tolist(), strict=True))
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


def comparison_warnings(opinion: PriorComparison) -> list[str]:
    """A warning where a milder lens fits nearly as well and sees the image elsewhere than σ explains."""
    if opinion.explained:
        return []
    off = f"sees the picture up to {opinion.shift:.1f} px off" if math.isfinite(opinion.shift) else "reaches farther"
    return [
        f"a milder lens fits almost as well (RMS {opinion.rms:.4f} px) and {off}: the views do not determine this "
        "model; use a weak prior (0.3), a smaller model or more views"
    ]


def standing_out(names: Sequence[str], residuals: Tensor) -> list[str]:
    """A warning where a corner is off by twice what noise explains; residuals (V, N, 2), NaN where not seen.

    Those that are off by less are as often the lens model's fault.
    """
    beyond = corners_beyond(residuals)
    if not bool(corners_beyond(residuals, _GROSS).any()):
        return []
    count = int(beyond.sum())
    length = residuals.nan_to_num(0.0).norm(dim=-1)
    view, corner = divmod(int(length.argmax()), length.shape[1])
    return [
        f"{count} of {int(residuals.isfinite().all(-1).sum())} corners are farther off than noise explains, corner "
        f"{corner} of view {names[view]} by {float(length.max()):.2f} px: look at them, choose a richer model, or "
        "leave them out (reject)"
    ]


def warnings_of(
    observations: Observations,
    camera: Camera,
    rms: float,
    per_view: Tensor,
    determined: Tensor,
    names: list[str],
    status: SolverStatus,
) -> list[str]:
    """Sentences about what the user should doubt."""
    found = []
    if status not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        found.append(f"the solver {status.message}")
    if rms > 1.0:
        found.append(f"RMS {rms:.2f} px is high: corners, board or lens model do not fit each other")
    typical = float(per_view.median())
    for i in (per_view > max(3.0 * typical, 0.1)).nonzero()[:, 0].tolist():
        found.append(
            f"view {observations.names[i]}: RMS {float(per_view[i]):.2f} px against {typical:.2f} px typically"
        )
    lost = [name for name, known in zip(names, determined.tolist(), strict=False) if not known]
    if lost:
        found.append(f"the views do not determine {', '.join(lost)}: choose a smaller model or add views")
    if not bool(camera.covers_image()):
        _, valid = camera.unproject(camera.grid(33, 25))
        share = 100.0 * float((~valid).double().mean())
        found.append(f"the lens model folds inside the image: {share:.0f} % of it gives no ray")
    return found
