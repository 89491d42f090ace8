"""What calibrations know of lenses and board enters a rig once, whole, and leaves it refined."""

import copy
import dataclasses
import functools

import pytest
import torch
from calibrate_scenes import observe
from printed_boards import printed_points, seen_whole, shown
from torch import Tensor

from kcal import Board, CalibrationOptions, Camera, Observations, RigOptions, calibrate_camera, calibrate_rig
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.unknowns import gathered, joint_unknowns, less
from kcal.lens import pixel_covariance, rotation_from_vector
from kcal.lens.information import CameraInformation

BOARD = Board(columns=7, rows=6, square=0.05)
SIZE = (1280, 960)
ROTATION = rotation_from_vector(torch.tensor([0.01, -0.05, 0.02], dtype=torch.float64))
TRANSLATION = torch.tensor([-0.15, 0.01, 0.02], dtype=torch.float64)
FOCAL, CENTER = (800.0, 810.0), ((640.0, 480.0), (650.0, 470.0))


def truth(side: int) -> Camera:
    return Camera.build(focal=(FOCAL[side],) * 2, center=CENTER[side], size=SIZE, coefficients=[-0.1, 0.02, 0, 0, 0])


@functools.cache
def pairs(count: int) -> tuple[Observations, Observations]:
    """Boards that both cameras see, as printed."""
    points, generator = printed_points(BOARD, 3), torch.Generator().manual_seed(9)
    sides: tuple[list[Tensor], list[Tensor]] = ([], [])
    while len(sides[0]) < count:
        cam = shown(BOARD, points, generator)
        seen = [truth(0).project(cam), truth(1).project(cam @ ROTATION.T + TRANSLATION)]
        if all(seen_whole(truth(side), *found) for side, found in enumerate(seen)):
            for side, (pixels, _) in zip(sides, seen, strict=True):
                side.append(pixels + 0.1 * torch.randn(pixels.shape, generator=generator, dtype=torch.float64))
    names = [f"{i}.png" for i in range(count)]
    left, right = (observe(torch.stack(side), board=BOARD, size=SIZE, names=names) for side in sides)
    return left, right


def known(camera: Camera) -> CameraInformation:
    found = camera.calibration.known(camera.params)
    assert found is not None
    return found


@functools.cache
def cameras(model: str, names: tuple[str, ...]) -> tuple[Camera, Camera]:
    left, right = (
        calibrate_camera(seen.subset(list(names)), CalibrationOptions(model=model, reject=None)).camera
        for seen in pairs(14)
    )
    return left, right


def rig(model: str, calibrated: int, paired: int, **options: object) -> RigResult:
    names = [f"{i}.png" for i in range(14)]
    both = cameras(model, tuple(names[:calibrated]))
    return calibrate_rig(*both, *pairs(14), [(n, n) for n in names[:paired]], RigOptions(reject=False, **options))  # type: ignore[arg-type]


@pytest.mark.slow
def test_views_in_both_count_once() -> None:
    """Cameras calibrated from the rig's own views know nothing more: refining them is solving everything at once."""
    prior, free = rig("opencv5", 14, 14), rig("opencv5", 14, 14, intrinsics="free")
    assert prior.rms == pytest.approx(free.rms, rel=1e-6)
    for one, other in zip(prior.cameras, free.cameras, strict=True):
        torch.testing.assert_close(one.params, other.params, rtol=1e-4, atol=1e-4)
    sigma = [found.joint_covariance().diagonal().sqrt() for found in (prior, free)]
    torch.testing.assert_close(sigma[0], sigma[1], rtol=1e-3, atol=0)


@pytest.mark.slow
def test_further_views_help() -> None:
    """Eight of the calibration's fourteen views in the rig: better than these alone, no better than all of them."""
    some, alone, everything = rig("hybrid", 14, 8), rig("hybrid", 8, 8), rig("hybrid", 14, 14)
    # Of a coefficient of the lens, which views near the border tell.
    bend = [float(found.joint_covariance()[9, 9].sqrt()) for found in (alone, some, everything)]
    assert bend[0] > 1.5 * bend[1]
    assert bend[2] < bend[1] < 1.2 * bend[2]


@pytest.mark.slow
def test_hybrid_cameras_are_refined_with_their_board() -> None:
    """The default of all: lenses, board and pose from 14 pairs, better than with the cameras as they were."""
    prior, held = rig("hybrid", 14, 14), rig("hybrid", 14, 14, intrinsics="fixed")
    assert prior.exact == ()
    assert held.exact == ("left", "right")
    assert prior.rms < held.rms
    stereo = prior.stereo()
    assert stereo.covariance is not None
    # Uncertain lenses are an uncertain yaw.
    assert prior.relative_covariance()[1, 1] > 4.0 * held.relative_covariance()[1, 1]
    error = float((stereo.right_from_left_translation - TRANSLATION).norm())
    assert error < 4.0 * float(prior.sigma_translation.norm())


def test_single_corners_are_off_by_what_both_cameras_found() -> None:
    """Found: the second camera had those of the first, which a few views do not tell well."""
    both = [copy.deepcopy(camera) for camera in cameras("hybrid", tuple(f"{i}.png" for i in range(14)))]
    parts = gathered(both, [known(camera) for camera in both], BOARD)[0]
    before = joint_unknowns(both, parts, BOARD)[1]
    planted = 1e-4 * torch.randn(2, BOARD.corners, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for camera, off in zip(both, planted, strict=True):
        record = camera.calibration.record
        moved = torch.tensor(record.board_deviation, dtype=torch.float64) + off
        record = dataclasses.replace(record, board_deviation=tuple(map(tuple, moved.tolist())))
        camera.calibration = dataclasses.replace(camera.calibration, record=record)
    torch.testing.assert_close(joint_unknowns(both, parts, BOARD)[1] - before, planted.mean(0), rtol=0, atol=1e-12)


def test_rows_taken_out_and_put_back() -> None:
    """`less` is a subtraction of information and of its pull."""
    whole = known(cameras("hybrid", tuple(f"{i}.png" for i in range(14)))[0])
    part = torch.cat([whole.rows[::3], whole.residuals[::3, None]], 1)
    rest = less(whole, part)
    scale = torch.linalg.vector_norm(whole.whole.rows[:, :-1], dim=0)
    together = rest.rows.T @ rest.rows + part[:, :-1].T @ part[:, :-1]
    unit = (together - whole.rows.T @ whole.rows) / scale / scale[:, None]
    assert float(unit.abs().max()) < 1e-9
    pull = rest.rows.T @ rest.residuals + part[:, :-1].T @ part[:, -1]
    # Directions without information left over have no pull either, to the square root of rounding.
    torch.testing.assert_close(pull / scale, whole.rows.T @ whole.residuals / scale, rtol=0, atol=1e-4)


def test_unknowns_have_the_cameras_covariance() -> None:
    """Unit variances of the unknowns are the calibrations' covariances."""
    both = cameras("opencv14", tuple(f"{i}.png" for i in range(14)))
    found, deviation = joint_unknowns(both, gathered(both, [known(camera) for camera in both], None)[0], None)
    assert deviation is None
    assert bool(found.known.all())
    for camera, by_unknown in zip(both, found.cameras, strict=True):
        sigma = known(camera).covariance().diagonal().sqrt()
        torch.testing.assert_close(by_unknown.square().sum(1).sqrt(), sigma, rtol=1e-6, atol=1e-12)


def test_default_lenses_without_a_board_in_view() -> None:
    """Of a rig of landmarks: the lenses as they were calibrated, and what they share through the board of that time."""
    both = cameras("hybrid", tuple(f"{i}.png" for i in range(14)))
    parts = [known(camera) for camera in both]
    found, deviation = joint_unknowns(both, gathered(both, parts, None)[0], None)
    assert deviation is None
    assert found.board.shape == (0, found.cameras[0].shape[1])
    assert bool(found.known.all())
    pixels = both[0].grid(9, 7).reshape(-1, 2)
    for camera, by_unknown, information in zip(both, found.cameras, parts, strict=True):
        covariance = by_unknown @ by_unknown.T
        own = information.by_parameter(information.half())
        stated, wanted = (pixel_covariance(camera, pixels, one) for one in (covariance, own.T @ own))
        good = wanted.isfinite().all(-1).all(-1)
        sigma = [one[good].diagonal(dim1=-2, dim2=-1).sqrt() for one in (stated, wanted)]
        # Directions that nothing seen feels are left out; and two cameras of one board know it better than one.
        ratio = sigma[0] / sigma[1]
        assert 0.5 < float(ratio.min()) <= float(ratio.median()) < 1.001


def test_lenses_depend_on_each_other_through_their_board_alone() -> None:
    """Each unknown is of one camera, or moves the board: so rows of a camera have no columns of another one."""
    both = cameras("hybrid", tuple(f"{i}.png" for i in range(14)))
    found, _ = joint_unknowns(both, gathered(both, [known(camera) for camera in both], BOARD)[0], BOARD)
    left, right = (by_unknown.any(0) for by_unknown in found.cameras)
    board = found.board.any(0)
    assert 0 < int(board.sum()) <= len(found.shapes)
    assert bool((left & right).any())
    assert not bool((left & right & ~board).any())
    assert bool((left | right).all())


def sharing(both: tuple[Camera, Camera], known: list[CameraInformation], board: Board) -> tuple[bool, ...]:
    return tuple(part is not None and part.board_size > 0 for part in gathered(both, known, board)[0])


@pytest.mark.slow
def test_one_board_is_shared_and_two_are_not() -> None:
    """By the evidence: both cameras saw this board; the same pattern printed again is another board."""
    left, right = cameras("hybrid", tuple(f"{i}.png" for i in range(14)))
    informations = [known(left), known(right)]
    assert sharing((left, right), informations, BOARD) == (True, True)
    # A board that differs by 20 of its standard deviations.
    own = informations[1]
    sigma = own.half()[:, own.lens_size :].norm(dim=0)
    moved = own.estimate.clone()
    moved[own.lens_size :] += 20.0 * sigma
    other = dataclasses.replace(own, estimate=moved)
    assert sharing((left, right), [informations[0], other], BOARD) == (True, False)
    assert gathered((left, right), [informations[0], other], BOARD)[1] == ((0, 1),)
    changed = Camera(right.params.detach(), size=SIZE, model=right.model)
    assert right.calibration is not None
    changed.calibration = dataclasses.replace(right.calibration, information=other)
    views = pairs(14)[0].names[:6]
    for camera, said in ((right, False), (changed, True)):
        found = calibrate_rig(left, camera, *pairs(14), [(n, n) for n in views], RigOptions(reject=False))
        text = f"the calibrations of left and right contradict each other about their board ({BOARD}): two prints"
        assert any(warning.startswith(text) for warning in found.warnings) == said
    # A rig's board of another size is nobody's.
    assert sharing((left, right), informations, Board(columns=9, rows=6, square=0.1)) == (False, False)


def test_a_board_that_no_camera_knows() -> None:
    """Another board in a rig is as printers make them, unless it was measured; parametric cameras take it flat."""
    names = tuple(f"{i}.png" for i in range(14))
    other = Board(columns=9, rows=6, square=0.1)
    for model, measured, modes in (("hybrid", False, 28), ("hybrid", True, 0), ("opencv5", False, 0)):
        both = cameras(model, names)
        parts = gathered(both, [known(camera) for camera in both], other)[0]
        found, deviation = joint_unknowns(both, parts, other, measured=measured)
        assert len(found.shapes) == modes
        assert (deviation is None) == (modes == 0)
        if modes:
            sigma = found.board.square().sum(1).sqrt()
            # Bending of the board, before any view of it: about half a permille of its length.
            assert 1e-4 < float(sigma[0]) < 2e-3
