"""Boards held by hand before rolling shutters: rigs find the motion and take it out; on stands there is none."""

import copy
import functools
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from calibrate_scenes import calibration_record, observe
from torch import Tensor

from kcal import Board, Boards, Camera, InputError, Observations, RigOptions, calibrate_camera, calibrate_rig
from kcal.calibrate.hybrid.evidence import EvidenceLoss, view_data
from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies
from kcal.calibrate.rig.motion import CameraRows, RigRows, WithoutMotion
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.source import Context, PosedCamera, RigState, as_items
from kcal.calibrate.rig.unknowns import held
from kcal.lens import CameraCalibration
from kcal.lens.pose import Pose, rotation_from_vector, vector_from_rotation
from kcal.rig import pair_by_name
from kcal.sim.captures import BoardSize, sample_board_poses
from kcal.solve.schur import Products, without_local
from scripts.shared.simulated import Hands, moving_capture

F64 = torch.float64
BOARD, SIZE = Board(columns=9, rows=6, square=0.05), BoardSize(9, 6, 0.05)
CAMERA = Camera.build(focal=(1100, 1100), center=(639.5, 479.5), size=(1280, 960), coefficients=[-0.1])
TURN = rotation_from_vector(torch.tensor([0.0, -0.15, 0.0], dtype=F64))
SHIFT = torch.tensor([-0.25, 0.0, 0.0], dtype=F64)
HANDS = Hands(turning=(0.4, 0.4), speed=(0.1, 0.1), readout=(0.02, 0.02), exposure=(0.005, 0.005))


def observed(sides: list[Tensor]) -> tuple[Observations, Observations]:
    """Of the left and the right camera, in pairs that show a dozen corners in both."""
    seen = [torch.where((CAMERA.inside(own) & own.isfinite().all(-1))[..., None], own, torch.nan) for own in sides]
    kept = (torch.stack(seen).isfinite().all(-1).sum(-1) >= 12).all(0).nonzero()[:, 0].tolist()
    names = [f"{i:02d}" for i in kept]
    left, right = (observe(own[kept], board=BOARD, size=CAMERA.size, names=names) for own in seen)
    return left, right


@functools.cache
def captured(by_hand: bool, seed: int) -> tuple[Observations, Observations]:
    poses = sample_board_poses(CAMERA, SIZE, 10, torch.Generator().manual_seed(seed), fill=(0.25, 0.4))
    right = [Pose(TURN @ pose.rotation, TURN @ pose.translation + SHIFT) for pose in poses]
    hands = HANDS if by_hand else None
    sides = [
        moving_capture(CAMERA, own, sigma=0.1, seed=2 * seed + k, hands=hands, board=SIZE).pixels
        for k, own in enumerate((poses, right))
    ]
    return observed(sides)


def solve(by_hand: bool, seed: int, camera: Camera = CAMERA, *, motion: bool = True) -> RigResult:
    left, right = captured(by_hand, seed)
    pairs = [(name, name) for name in left.names]
    # Two cameras of one type, and not one at two places.
    return calibrate_rig(camera, copy.deepcopy(camera), left, right, pairs, RigOptions(motion=motion))


def error(result: RigResult) -> Tensor:
    rig = result.stereo()
    turn = vector_from_rotation(rig.right_from_left_rotation @ TURN.T)
    return torch.cat([turn, rig.right_from_left_translation - SHIFT])


def surprise(result: RigResult) -> float:
    """The squared error over what the covariance states: one on the average."""
    off = error(result)
    return float(off @ torch.linalg.solve(result.relative_covariance(), off)) / 6.0


def test_whitening_is_that_of_the_dense_covariance() -> None:
    generator = torch.Generator().manual_seed(5)
    white = torch.randn(3, 12, 14, generator=generator, dtype=F64)
    rows = torch.randn(3, 4, 14, generator=generator, dtype=F64)
    found = WithoutMotion(white)(rows)
    covariance = torch.eye(14, dtype=F64) + white.transpose(1, 2) @ white
    dense = rows @ torch.linalg.solve(covariance, rows.transpose(1, 2))
    # A condition of some thousands.
    torch.testing.assert_close(found @ found.transpose(1, 2), dense, rtol=1e-9, atol=1e-9)


def test_rows_are_read_at_the_times_of_the_pixels_shown() -> None:
    """Derivatives by motions do not depend on the noise of the corners."""
    found = []
    poses = sample_board_poses(CAMERA, SIZE, 3, torch.Generator().manual_seed(1), fill=(0.25, 0.4))
    at = Pose(torch.stack([pose.rotation for pose in poses]), torch.stack([pose.translation for pose in poses]))
    nothing = torch.zeros(0, dtype=F64)
    state = RigState(
        CAMERA.params.detach(), nothing, nothing.sum(), torch.eye(3, dtype=F64)[None], torch.zeros(1, 3, dtype=F64),
        nothing, as_items(*at),
    )  # fmt: skip
    posed = PosedCamera(
        CAMERA, CAMERA.params.detach(), state.rotation[0], state.center[0], nothing[:, None], None, None
    )
    for noise in (0.0, 5.0):
        pixels = CAMERA.project(BOARD.points @ at.rotation.mT + at.translation[:, None])[0][:, None] + noise
        shown = Boards(board=BOARD, pixels=pixels, names=("a", "b", "c"))
        block = shown.block(torch.ones(3, dtype=torch.bool), Context([CAMERA], state, held([CAMERA]), state.center[0]))
        found.append(block.motion_columns(0, posed, state, reads=True)[0])
    assert torch.equal(*found)


@pytest.mark.parametrize("shared", [8, 70])
def test_what_is_told_of_motions_is_that_of_all_rows(shared: int) -> None:
    """Fewer and more unknowns that boards share than motions: the evidence is that of rows with all columns."""
    generator = torch.Generator().manual_seed(shared)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=F64)

    views, corners = 4, 40
    own = torch.arange(shared - 2), torch.arange(2, shared)
    parts = [CameraRows(c, own[c], draw(views, 6 + len(own[c]) + 1, corners)) for c in range(2)]
    moving = 0.3 * draw(views, 12, corners)
    rig = RigRows(parts, torch.ones(views, dtype=torch.bool), shared)
    data, families = rig.told(1, moving)
    rows = torch.zeros(views, 6 + 12 + shared + 1, 2 * corners, dtype=F64)
    for c, part in enumerate(parts):
        rows[:, [*range(6), *(18 + own[c]).tolist(), 18 + shared], c * corners : (c + 1) * corners] = part.rows
    rows[:, 6:18, corners:] = moving
    off = without_local(rows, 6)
    counts = float(views * (2 * corners - 6))
    whole = view_data(
        Products.of_rows(off, 12), torch.zeros(shared, dtype=F64), torch.zeros(views, 12, dtype=F64), counts
    )
    length = off[:, 12:-1].transpose(0, 1).flatten(1).norm(dim=1)
    none = torch.full((shared,), -1)
    wide = PriorFamilies(torch.zeros(shared).double(), (1e3 / length).log(), none, none, torch.zeros(shared).double())
    zero = torch.zeros(1, dtype=F64)
    losses = [
        EvidenceLoss(*one, Hyperprior(zero, torch.ones_like(zero)), 1.0) for one in ((whole, wide), (data, families))
    ]
    assert rig.variance == pytest.approx(float(off[:, -1].square().sum()) / counts)
    # Up to a constant: at several ratios of motions to the noise, and at two levels of that.
    places = [np.array([0.0, a, b, a, b, noise]) for a, b, noise in ((-9, -9, 0), (-1, 0, 0), (1, -2, 0), (0, 1, 0.3))]
    dense, told = ([loss.value(place) for place in places] for loss in losses)
    np.testing.assert_allclose(np.subtract(told, told[0]), np.subtract(dense, dense[0]), rtol=1e-4, atol=1e-3)


@pytest.mark.slow
def test_motion_is_found_and_taken_out() -> None:
    moving = [solve(True, seed) for seed in range(5)]
    still = [solve(True, seed, motion=False) for seed in range(5)]
    found, without = (sum(surprise(result) for result in results) / 5 for results in (moving, still))
    # Thirty numbers whose squares are one on the average, or twice that where amplitudes are hardly known.
    assert found < 3.0
    # Not taken out, it is at least known: boards contradict each other, and error bars are wider by so many times.
    told = [re.search(r"boards differ from each other by ([0-9.]+) times", " ".join(one.warnings)) for one in still]
    times = [float(one[1]) if one else 1.0 for one in told]
    assert sum(surprise(one) * wide**2 for one, wide in zip(still, times, strict=True)) / 5 > 10.0 * found
    assert 1.5 * found < without < 5.0 * found
    turns, others = (sum(float(error(result)[:3].square().sum()) for result in results) for results in (moving, still))
    assert turns < 0.5 * others
    assert all(result.sigma_corner == pytest.approx(0.1, rel=0.35) for result in moving)
    moved = [text for result in moving for text in result.warnings if "moved while rows were read" in text]
    assert len(moved) >= 8
    # Exposures are together; only rows are apart.
    assert not any("same moment" in text for result in moving for text in result.warnings)


@pytest.mark.slow
def test_nothing_moves_on_a_stand() -> None:
    for seed in range(3):
        found, still = solve(False, seed), solve(False, seed, motion=False)
        assert found.warnings == still.warnings == ()
        # To the last digit: where no motion is found, nothing else happens.
        assert torch.equal(error(found), error(still))
        assert torch.equal(found.relative_covariance(), still.relative_covariance())


def test_before_a_lens_that_is_calibrated_with_few_coefficients_only_pairs_scatter() -> None:
    """What it cannot show would be taken for motion of rows; that pairs differ is known all the same."""
    camera = Camera(CAMERA.params, size=CAMERA.size, model=CAMERA.model)
    camera.calibration = CameraCalibration(covariance=1e-12 * torch.eye(len(CAMERA.params), dtype=F64))
    found = solve(True, 0, camera)
    assert not any("moved while rows were read" in text for text in found.warnings)
    assert "taken at the same moment" in found.warnings[0]
    assert surprise(found) < 4.0
    assert math.isfinite(found.rms)


def taken_apart(seed: int, turn: float, *, later: int = 0, bump: float = 0.0, shift: float = 0.0) -> RigResult:
    """A rig whose boards turn, and move by as much, in between; the second half of the pairs after a bump.

    A stabilizer shifts the right camera's images by so many pixels.

    Views of the right camera are paired with those that the left one took `later`.
    """
    random = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(CAMERA, SIZE, 12, random, fill=(0.25, 0.4))
    twist = turn * torch.randn(len(poses), 6, generator=random, dtype=F64)
    bumped = rotation_from_vector(torch.tensor([0.0, bump, 0.0], dtype=F64))
    right = []
    for i, (pose, step) in enumerate(zip(poses, twist, strict=True)):
        rotation = TURN @ pose.rotation @ rotation_from_vector(step[:3])
        moved = Pose(rotation, TURN @ (pose.translation + step[3:]) + SHIFT)
        right.append(moved if i < 6 else Pose(bumped @ moved.rotation, bumped @ moved.translation))
    sides = [
        moving_capture(CAMERA, own, sigma=0.1, seed=2 * seed + k, board=SIZE).pixels
        for k, own in enumerate((poses, right))
    ]
    sides[1] = sides[1].roll(later, 0) + shift * torch.randn(len(poses), 1, 2, generator=random, dtype=F64)
    seen = observed(sides)
    return calibrate_rig(CAMERA, CAMERA, *seen, [(name, name) for name in seen[0].names])


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0.001, 0.005])
def test_pairs_that_were_not_taken_at_one_moment_scatter(turn: float) -> None:
    found = [taken_apart(seed, turn) for seed in range(3)]
    assert sum(map(surprise, found)) / 3 < 2.5
    for result in found:
        assert not result.left_out
        # The boards are 1 m away: a turn of 1 mrad of a board of 0.45 m, and 1 mm, are some 1 px.
        text = result.warnings[0]
        assert "were both views of each pair taken at the same moment" in text
        assert 0.4 < float(text.split("by some ")[1].split(" px")[0]) / (1000 * turn) < 2.5
        assert not any("moved while rows were read" in one or "lens" in one for one in result.warnings)
        assert result.sigma_corner == pytest.approx(0.1, rel=0.3)
        # Of a dozen pairs, each is off by as much.
        assert 0.15 * turn < result.relative_covariance()[:3, :3].diagonal().max().sqrt() < turn


@pytest.mark.slow
def test_images_that_a_stabilizer_shifts() -> None:
    """They are told from boards that moved, and error bars contain the shift of the next frame."""
    for result in (taken_apart(seed, 0.0, shift=3.0) for seed in range(2)):
        assert [finding.name for finding in result.findings] == ["moving-lens"]
        shift = float(result.warnings[0].split("by some ")[1].split(" px")[0])
        assert 1.8 < shift < 5.0
        sigma = result.relative_covariance().diagonal().sqrt()
        assert shift / 1100 < float(sigma[:2].min())
        assert float(sigma[:2].max()) < 1.3 * shift / 1100


def test_a_lens_whose_calibration_says_that_it_moves() -> None:
    record = calibration_record(BOARD.record, moves=(0.01, 5.0, 7.0))
    cameras = [CAMERA.with_parameters(CAMERA.params.detach() + 1e-9 * c) for c in range(2)]
    for camera in cameras:
        known = 1e-6 * torch.eye(len(CAMERA.params), dtype=F64)
        camera.calibration = CameraCalibration(covariance=known, record=record)
    seen = captured(False, 1)
    found = calibrate_rig(*cameras, *seen, [(name, name) for name in seen[0].names])
    assert [finding.name for finding in found.findings] == ["moving-lens"] * 2
    # Of both cameras: shifts to the right are turns about the axis that points down.
    expected = math.sqrt(2.0) * torch.tensor([7.0, 5.0], dtype=F64) / 1100
    torch.testing.assert_close(found.relative_covariance().diagonal()[:2].sqrt(), expected, rtol=0.05, atol=0.0)
    assert found.stereo().left.calibration.sigma["fx"] == pytest.approx(11.0, rel=0.02)


def test_views_that_are_paired_with_those_of_other_moments_are_refused() -> None:
    with pytest.raises(InputError, match=r"typical right view .* px if 01 belongs with 02, and so on: .*--match"):
        taken_apart(0, 0.001, later=1)
    with pytest.raises(InputError, match=r"the same moment, and of one board\?"):
        taken_apart(0, 0.001, later=5)


def test_a_rig_that_was_moved_in_between_is_refused() -> None:
    with pytest.raises(InputError, match=r"left and right moved against each other between pair 05 and pair 06: .* px"):
        taken_apart(0, 0.0, bump=0.005)
    # 0.1 mrad are a tenth of a pixel.
    assert not taken_apart(0, 0.0, bump=1e-4).left_out


@pytest.mark.slow  # Two calibrations and two rigs
def test_two_webcams_that_are_not_synchronized(kcal_data: Path) -> None:
    """Both halves of a real capture agree within what they state; motions are those that each camera finds alone."""
    seen = [Observations.load(kcal_data / "captures" / f"gavin_{side}.obs.json") for side in "lr"]
    calibrated = [calibrate_camera(one) for one in seen]
    # Nor is a second camera to blame for anything.
    assert all(one.by_view is None and not one.rejected_views for one in calibrated)
    cameras = [one.camera for one in calibrated]
    pairs = pair_by_name(seen[0].names, seen[1].names)
    first, second = (calibrate_rig(*cameras, *seen, some) for some in (pairs[:9], pairs[9:]))
    one, other = first.stereo(), second.stereo()
    turn = vector_from_rotation(one.right_from_left_rotation @ other.right_from_left_rotation.T)
    off = torch.cat([turn, one.right_from_left_translation - other.right_from_left_translation])
    both = first.relative_covariance() + second.relative_covariance()
    assert float(off @ torch.linalg.solve(both, off)) < 16.8  # Of six numbers, 1 %
    for result in (first, second):
        assert "taken at the same moment" in result.warnings[0]
        moved = [float(text.split("by some ")[1].split()[0]) for text in result.warnings if "rolling" in text]
        assert max(moved) < 1.0
        assert result.sigma_corner == pytest.approx(0.04, abs=0.01)  # of corners, each at its own place
    zoomed = cameras[1].params.detach().clone()
    zoomed[:2] *= 2.0
    other = cameras[1].with_parameters(zoomed)
    other.calibration = CameraCalibration(record=cameras[1].calibration.record)
    with pytest.raises(InputError, match=r"do not fit the right camera \(RMS .* px; 0\.05\d px when it was calibrated"):
        calibrate_rig(cameras[0], other, *seen, pairs)
