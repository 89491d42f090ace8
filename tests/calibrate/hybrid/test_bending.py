"""A board that bends from view to view: found where it does, told from motion, and named."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import pytest
import torch

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult
from kcal.corners.observations import Observations
from scripts.shared.infinity import error_at_infinity
from scripts.shared.simulated import Simulated, bends, simulated, terms

SIGMA = 0.08
# Seed, whether by hand, millimeters by which the board bends, and in what share of the views.
CASES = {
    "stand": (1, False, 0.0, 1.0),
    "bent": (1, False, 1.0, 1.0),
    "few": (1, False, 3.0, 0.2),
    "both": (2, True, 1.0, 1.0),
    "hand": (2, True, 0.0, 1.0),
}


@functools.cache
def case(name: str) -> Simulated:
    seed, by_hand, bent, share = CASES[name]
    return simulated(seed, 20, SIGMA, by_hand, bent=1e-3 * bent, share=share)


@functools.cache
def found(name: str, bending: bool = True) -> CameraCalibrationResult:
    return calibrate_camera(case(name).seen, CalibrationOptions(bending=bending))


def said(result: CameraCalibrationResult) -> list[str]:
    return [text for text in result.warnings if "the board bends" in text]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("stand", []), ("bent", ["bending"]), ("few", ["bending"]), ("both", ["motion", "bending"]), ("hand", ["motion"])],
)
def test_what_views_do_is_told_by_the_evidence(name: str, wanted: list[str]) -> None:
    fit = found(name).hybrid
    assert fit is not None
    assert terms(fit) == wanted
    assert len(said(found(name))) == ("bending" in wanted)
    assert fit.sigma == pytest.approx(SIGMA, rel=0.1 if name != "both" else 0.6)


def test_bending_is_taken_out() -> None:
    """The camera is nearer the truth than that of a board that is held to be stiff; heights are those of the views."""
    fit, stiff = found("bent").hybrid, found("bent", bending=False).hybrid
    assert fit is not None
    assert fit.bends is not None
    assert stiff is not None
    assert stiff.bends is None
    off, other = (error_at_infinity(one.camera, case("bent").lens).rms for one in (fit, stiff))
    assert off < 0.7 * other
    true = bends(20, 1e-3, 1.0, torch.Generator().manual_seed(9001))
    # A shape that all views share, and a plane in each, are no bending by view.
    flat = torch.cat([case("bent").seen.board.points[:, :2], torch.ones(true.shape[1], 1).double()], 1)
    basis, _ = torch.linalg.qr(flat)
    ours, theirs = (
        (one - one.mean(0)) @ (torch.eye(len(basis)).double() - basis @ basis.T) for one in (fit.bends, true)
    )
    assert float((ours - theirs).square().mean().sqrt()) < 0.2 * float(theirs.square().mean().sqrt())
    again = fit.residuals_of(case("bent").seen.pixels())
    torch.testing.assert_close(again, fit.residuals, rtol=0, atol=1e-9, equal_nan=True)


def test_a_few_views_do_not_loosen_the_others() -> None:
    """They have large factors of their own, and are named."""
    result = found("few")
    fit = result.hybrid
    assert fit is not None
    assert fit.relative is not None
    bent = bends(20, 3e-3, 0.2, torch.Generator().manual_seed(9001)).abs().amax(1) > 0.0
    assert int(bent.sum()) == 4
    assert float(fit.relative[bent].min()) > 2.0
    assert float(fit.relative[~bent].max()) < 1.0
    (text,) = said(result)
    assert f"most in {int(bent.sum())} of 20 views" in text
    assert all(result.observations.names[i] in text for i in bent.nonzero()[:, 0].tolist())
    # Views are refitted as they were: a part of them keeps its own factors.
    part = fit.only([3, 5])
    torch.testing.assert_close(part.own_stillness, fit.own_stillness[[3, 5]])


def real(name: str) -> Observations:
    path = Path(os.environ.get("KCAL_DATA", "")) / f"captures/{name}.obs.json"
    if not path.exists():
        pytest.skip("KCAL_DATA has no such capture")
    return Observations.load(path)


@pytest.mark.parametrize(
    ("name", "wanted", "noise"),
    [("camodocal", ["motion", "bending"], 0.04), ("carnd18", ["bending"], 0.3), ("st1_r", ["motion"], 0.06)],
)
def test_captures_of_strangers(name: str, wanted: list[str], noise: float) -> None:
    """Boards that bend, of a car's fisheye and on a wall: no second camera is blamed for it, nor a shutter alone."""
    result = calibrate_camera(real(name))
    assert result.hybrid is not None
    assert terms(result.hybrid) == wanted
    assert result.hybrid.sigma < noise
    assert len(said(result)) == ("bending" in wanted)
    assert not any("not of one camera" in text for text in result.warnings)
