"""Views that no lens fits, or that say nothing of their pose, are left out by name before anything is refused."""

from __future__ import annotations

import math

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of
from torch import Tensor

from kcal.calibrate.camera import hybrid
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.checks import least_planar
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.errors import DegenerateError, InputError

VIEWS = 12


def corners() -> Tensor:
    return pixels_of(camera(), motions(camera(), VIEWS, 1), noise=0.1)


def shuffled(pixels: Tensor, views: list[int], seed: int = 1) -> Tensor:
    """Corners of some views in any order."""
    generator = torch.Generator().manual_seed(seed)
    changed = pixels.clone()
    for i in views:
        changed[i] = changed[i][torch.randperm(BOARD.corners, generator=generator)]
        # Not the other way round, which is noticed without a fit.
        if float(torch.det(torch.linalg.lstsq(_affine_rows(), changed[i]).solution[:2])) < 0:
            changed[i] = changed[i].reshape(6, 7, 2).flip(1).reshape(-1, 2)
    return changed


def _affine_rows() -> Tensor:
    return torch.cat([BOARD.points[:, :2], torch.ones(BOARD.corners, 1, dtype=torch.float64)], 1)


def reasons(result: CameraCalibrationResult) -> dict[str, str]:
    return {view.view: view.reason for view in result.rejected_views}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [[3], [3, 7]])
def test_a_few_views_that_no_lens_fits(wrong: list[int]) -> None:
    pixels = shuffled(corners(), wrong)
    found = calibrate_camera(observe(pixels))
    assert list(reasons(found)) == [f"v{i:02}" for i in wrong]
    assert f"{len(wrong)} of {VIEWS} views were left out: v03 (" in found.warnings[0]
    kept = [i for i in range(VIEWS) if i not in wrong]
    alone = calibrate_camera(observe(pixels[kept], names=[f"v{i:02}" for i in kept]))
    # The same fit; where memory lies decides the order of its sums.
    for name in ("fx", "cx", "cy"):
        one, other = (float(result.camera.params[result.camera.names.index(name)]) for result in (found, alone))
        assert one == pytest.approx(other, abs=1e-3 * (alone.sigma[name] or 0.0))
    assert found.residuals[wrong].isnan().all()
    assert len(found.observations.views) == VIEWS


@pytest.mark.slow
def test_many_such_views_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"no lens shows all corners.* 3 of 12 views .* v02 \(.* v05 \(.* v08 \("):
        calibrate_camera(observe(shuffled(corners(), [2, 5, 8], seed=3)))


def test_mirrored_views() -> None:
    pixels = corners()
    pixels[5, :, 0] = pixels[5, :, 0].max() + pixels[5, :, 0].min() - pixels[5, :, 0]
    found = calibrate_camera(observe(pixels))
    assert "mirrored" in reasons(found)["v05"]
    # Where all are, nothing tells which: they are used, and `kcal report` says so.
    flipped = corners()
    flipped[..., 0] = SIZE[0] - 1 - flipped[..., 0]
    assert reasons(calibrate_camera(observe(flipped), CalibrationOptions(model="opencv5"))) == {}


def test_a_start_that_shows_nothing_is_not_used() -> None:
    plain = calibrate_camera(observe(corners()))
    given = calibrate_camera(observe(corners()), CalibrationOptions(focal=5.0))
    assert "focal length that was given for the start (5 px)" in given.warnings[0]
    assert "not used" in given.warnings[0]
    assert given.warnings[1:] == plain.warnings
    near = calibrate_camera(observe(corners()), CalibrationOptions(focal=420.0))
    assert near.warnings == plain.warnings
    assert given.rms == pytest.approx(plain.rms, rel=1e-3)


def test_what_is_left_must_be_enough() -> None:
    pixels = corners()[:4]
    pixels[:2, 4:] = torch.nan
    with pytest.raises(DegenerateError, match=r"^2 of 4 views .* of no use: v00 \(it has 4 corners.*, v01 \(it has 4"):
        calibrate_camera(observe(pixels))


def test_an_arithmetic_failure_is_an_error_of_the_views(monkeypatch: pytest.MonkeyPatch) -> None:
    def divided(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(hybrid, "calibrate_hybrid", divided)
    with pytest.raises(InputError, match=r"no lens shows all corners where they are\. Look first at v0\d \("):
        calibrate_camera(observe(corners()[:6]))


def test_views_are_named_where_the_fit_names_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise DegenerateError("the views do not determine the focal length")

    monkeypatch.setattr(hybrid, "calibrate_hybrid", refuse)
    with pytest.raises(DegenerateError, match=r"focal length; the views are v00, v01, v02, v03, v04 and 7 more"):
        calibrate_camera(observe(corners()))


def test_copies_among_what_is_left() -> None:
    """Both kinds of views that add nothing are listed."""
    pixels = corners()
    pixels[6] = pixels[2]
    pixels[4, 5:] = torch.nan
    found = calibrate_camera(observe(pixels))
    assert reasons(found) == {"v04": "it has 5 corners, and at least 6 are needed", "v06": "it is a copy of v02"}
    assert math.isnan(float(found.per_view_rms[4]))
    assert math.isnan(float(found.per_view_rms[6]))
    assert found.camera.calibration is not None


@pytest.mark.slow
@pytest.mark.parametrize("model", ["opencv5", "hybrid"])
def test_views_without_a_board_at_all(model: str) -> None:
    """Corners anywhere: whatever is refused names the views to look at."""
    pixels = 400.0 * torch.rand(6, BOARD.corners, 2, generator=torch.Generator().manual_seed(1)).double()
    with pytest.raises((InputError, DegenerateError), match=r"v0\d"):
        calibrate_camera(observe(pixels), CalibrationOptions(model=model))


def test_which_views_look_least_like_a_board() -> None:
    pixels = shuffled(corners(), [4])
    assert least_planar(BOARD.points, pixels, [str(i) for i in range(VIEWS)]).startswith("4 (its corners are ")
    assert "," not in least_planar(BOARD.points, pixels, [str(i) for i in range(VIEWS)])
    both = least_planar(BOARD.points, shuffled(corners(), [4, 9]), [str(i) for i in range(VIEWS)])
    assert {text.strip().split(" ")[0] for text in both.split(",")} == {"4", "9"}
