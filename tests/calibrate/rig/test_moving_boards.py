"""Boards held by hand before rolling shutters: rigs find the motion and take it out; on stands there is none."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch
from calibrate_scenes import observe
from torch import Tensor

from kcal.calibrate.hybrid.evidence import EvidenceLoss, view_data
from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies
from kcal.calibrate.rig.motion import CameraRows, RigRows, WithoutMotion
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, calibrate_rig
from kcal.corners.board import Board
from kcal.corners.observations import Observations
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector, vector_from_rotation
from kcal.sim.board import BoardPose, BoardSize
from kcal.sim.captures import sample_board_poses
from kcal.solve.schur import Products, without_local
from scripts.shared.moving_captures import Hands, moving_capture

F64 = torch.float64
BOARD, SIZE = Board(columns=9, rows=6, square=0.05), BoardSize(9, 6, 0.05)
CAMERA = Camera.build(focal=(1100, 1100), center=(639.5, 479.5), size=(1280, 960), coefficients=[-0.1])
TURN = rotation_from_vector(torch.tensor([0.0, -0.15, 0.0], dtype=F64))
SHIFT = torch.tensor([-0.25, 0.0, 0.0], dtype=F64)
HANDS = Hands(turning=(0.4, 0.4), speed=(0.1, 0.1), readout=(0.02, 0.02), exposure=(0.005, 0.005))


@functools.cache
def captured(by_hand: bool, seed: int) -> tuple[Observations, Observations]:
    poses = sample_board_poses(CAMERA, SIZE, 10, torch.Generator().manual_seed(seed), fill=(0.25, 0.4))
    right = [BoardPose(TURN @ pose.rotation, TURN @ pose.translation + SHIFT) for pose in poses]
    hands = HANDS if by_hand else None
    sides = [
        moving_capture(CAMERA, own, sigma=0.1, seed=2 * seed + k, hands=hands, board=SIZE).pixels
        for k, own in enumerate((poses, right))
    ]
    seen = [CAMERA.inside(pixels) & pixels.isfinite().all(-1) for pixels in sides]
    kept = (torch.stack(seen).sum(-1) >= 12).all(0).nonzero()[:, 0].tolist()
    names = [str(i) for i in kept]
    corners = (torch.where(inside[..., None], own, torch.nan)[kept] for own, inside in zip(sides, seen, strict=True))
    left_seen, right_seen = (observe(own, board=BOARD, size=CAMERA.size, names=names) for own in corners)
    return left_seen, right_seen


def solve(by_hand: bool, seed: int, camera: Camera = CAMERA, *, motion: bool = True) -> RigResult:
    left, right = captured(by_hand, seed)
    pairs = [(name, name) for name in left.names]
    return calibrate_rig(camera, camera, left, right, pairs, RigOptions(motion=motion))


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
    columns = torch.randn(3, 12, 2, 7, generator=generator, dtype=F64)
    whitening = torch.randn(3, 2, 2, 7, generator=generator, dtype=F64)
    rows = torch.randn(3, 4, 14, generator=generator, dtype=F64)
    found = WithoutMotion(columns, whitening)(rows)
    white = torch.einsum("vuwn,vpwn->vpun", whitening, columns).flatten(-2)
    covariance = torch.eye(14, dtype=F64) + white.transpose(1, 2) @ white
    dense = rows @ torch.linalg.solve(covariance, rows.transpose(1, 2))
    # A condition of some thousands.
    torch.testing.assert_close(found @ found.transpose(1, 2), dense, rtol=1e-9, atol=1e-9)


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
        columns = [*range(6), *(18 + own[c]).tolist(), 18 + shared]
        rows[:, columns, c * corners : (c + 1) * corners] = part.rows
    rows[:, 6:18, corners:] = moving
    off = without_local(rows, 6)
    counts = float(views * (2 * corners - 6))
    whole = view_data(
        Products.of_rows(off, 12),
        torch.zeros(shared, dtype=F64),
        torch.zeros(views, 12, dtype=F64),
        counts,
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
    dense, told = (loss.values(np.stack(places)) for loss in losses)
    np.testing.assert_allclose(np.subtract(told, told[0]), np.subtract(dense, dense[0]), rtol=1e-4, atol=1e-3)


@pytest.mark.slow
def test_motion_is_found_and_taken_out() -> None:
    moving = [solve(True, seed) for seed in range(5)]
    still = [solve(True, seed, motion=False) for seed in range(5)]
    found, without = (sum(surprise(result) for result in results) / 5 for results in (moving, still))
    # Thirty numbers whose squares are one on the average, or twice that where amplitudes are hardly known.
    assert found < 3.0
    assert without > 10.0 * found
    turns, others = (sum(float(error(result)[:3].square().sum()) for result in results) for results in (moving, still))
    assert turns < 0.5 * others
    assert all(result.sigma_corner == pytest.approx(0.1, rel=0.35) for result in moving)
    told = [text for result in moving for text in result.warnings if "moved while rows were read" in text]
    assert len(told) >= 8


def test_nothing_moves_on_a_stand() -> None:
    for seed in range(3):
        found, still = solve(False, seed), solve(False, seed, motion=False)
        assert found.warnings == still.warnings == ()
        # To the last digit: where no motion is found, nothing else happens.
        assert torch.equal(error(found), error(still))
        assert torch.equal(found.relative_covariance(), still.relative_covariance())


def test_not_before_a_lens_that_is_calibrated_with_few_coefficients() -> None:
    """What it cannot show would be taken for motion."""
    camera = Camera(CAMERA.params, size=CAMERA.size, model=CAMERA.model)
    camera.calibration = CameraCalibration(covariance=1e-12 * torch.eye(len(CAMERA.params), dtype=F64))
    found = solve(True, 0, camera)
    assert not any("moved while rows were read" in text for text in found.warnings)
    assert found.sigma_corner is not None
    assert math.isfinite(found.rms)
    assert found.sigma_corner > 0.2
