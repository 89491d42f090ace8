"""Warnings about how views were taken: motion while rows were read, and images that were stretched."""

from __future__ import annotations

import torch

from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.problem.readout import FELT, LARGEST

# Of fewer views that moved, 95 % ellipses contain the truth in 86 to 93 % (`scripts.check.handheld`).
_FEW = 6
# A share of the largest motion, from which it is at its limit.
_LIMIT = 0.9


def motion_warnings(fit: HybridFit) -> list[str]:
    """A warning where the camera or the board moved while an image was read, with how much that moved corners."""
    if fit.motion_sigma is None or fit.readout is None:
        return []
    if max(fit.motion_sigma) > _LIMIT * LARGEST:
        return [
            "while an image is read, views move by more than any hand does: these motions stand for something else "
            "(wrong corners, a board that flexes, a cropped or stabilized video); look at the views that fit worst, "
            "and photograph a stiff board on a stand"
        ]
    lines = "column" if fit.readout.columns else "row"
    moved = fit.motion_sigma.moved(float(fit.state.parameters[0]), fit.readout.reach(fit.board_points))
    if moved < FELT * fit.sigma:
        return []
    views, few = len(fit.state.motion), []
    if views < _FEW:
        few = [
            f"{views} views that moved are few: error bars are wide, and may still be too small; use a stand, or "
            f"{_FEW} views or more"
        ]
    return [
        *few,
        f"the camera or the board moved while {lines}s were read (rolling shutter), by some {moved:.1f} px from the "
        f"first {lines} to the last: this is taken out, and error bars allow for it; put both on a stand, or take the "
        "still moments of a video, for smaller error bars",
    ]


def measured_aspect(fit: HybridFit) -> tuple[float, float]:
    """f_y / f_x of the base projection, and its standard deviation."""
    fx, fy = fit.state.parameters[:2].tolist()
    slope = torch.zeros(len(fit.state.parameters), dtype=torch.float64)
    slope[0], slope[1] = -fy / fx**2, 1.0 / fx
    return fy / fx, float(slope @ fit.covariance @ slope) ** 0.5


def pixel_warnings(fit: HybridFit) -> list[str]:
    """A warning where pixels are not square."""
    if fit.square:
        return []
    aspect, sigma = measured_aspect(fit)
    return [
        f"pixels are not square: f_y / f_x = {aspect:.4f} ± {sigma:.4f}; was the image or video resized, or taken in "
        "an anamorphic mode? The camera is right for images of this size and shape only: photograph boards and targets "
        "in the same mode"
    ]
