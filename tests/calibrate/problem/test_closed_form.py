"""Closed-form starts are exact where the theory says so, without any iteration."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, Motions, camera, motions, pixels_of
from torch import Tensor

from kcal.calibrate.problem.poses import (
    flipped_poses,
    homographies,
    poses_from_homographies,
    poses_under,
    refine_poses,
    spread_out,
    unflip,
)
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import Views
from kcal.corners.board import Board
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.solve.lm import LMOptions

CENTERED = Camera.build(focal=(500, 505), center=(319.5, 239.5), size=SIZE, model="pinhole")
OFF_CENTER = Camera.build(focal=(500, 505), center=(341.5, 221.0), size=SIZE, model="pinhole")


def true_homographies(truth: Camera, poses: Motions) -> Tensor:
    rotation, translation = poses
    h = truth.matrix @ torch.cat([rotation[..., :2], translation[..., None]], -1)
    return h / h[:, 2:, 2:]


def state_of(truth: Camera, poses: Motions) -> BoardState:
    return BoardState.flat(truth.params.detach().clone(), *poses)


class TestHomographies:
    def test_exact(self) -> None:
        poses = motions(OFF_CENTER, 5, 1)
        expected = true_homographies(OFF_CENTER, poses)
        found = homographies(BOARD.points, pixels_of(OFF_CENTER, poses))
        # Entries reach 1e3; the smallest eigenvector of a 9 x 9 system loses some digits.
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-9)

    def test_corners_that_were_not_seen_have_no_say(self) -> None:
        poses = motions(OFF_CENTER, 3, 1)
        pixels = pixels_of(OFF_CENTER, poses)
        pixels[0, 12:] = torch.nan
        pixels[1, ::2] = torch.nan
        # Four corners of a quadrilateral are the fewest.
        four = [0, 6, 35, 41]
        pixels[2, [i for i in range(BOARD.corners) if i not in four]] = torch.nan
        found = homographies(BOARD.points, pixels)
        # Two rows of corners alone leave the last digits to rounding.
        torch.testing.assert_close(found, true_homographies(OFF_CENTER, poses), rtol=1e-7, atol=1e-6)


class TestSpreadOut:
    @pytest.mark.parametrize(
        ("seen", "enough"),
        [
            (range(42), True),
            (range(7), False),
            (range(8), False),
            (range(9), True),
            (range(0, 42, 7), False),
            (range(0, 41, 8), False),
            ([0, 6, 35, 41], True),
            ([0, 3, 6, 20], False),
            ([0, 6, 35], False),
            ([], False),
        ],
    )
    def test_lines(self, seen: list[int], enough: bool) -> None:
        pixels = pixels_of(CENTERED, motions(CENTERED, 2, 1))
        pixels[1, [i for i in range(42) if i not in seen]] = torch.nan
        assert spread_out(BOARD.points, pixels).tolist() == [True, enough]

    @pytest.mark.parametrize("square", [1e-6, 1e3])
    def test_size_of_the_board_does_not_matter(self, square: float) -> None:
        board = Board(columns=40, rows=3, square=square)
        pixels = torch.zeros(3, 120, 2, dtype=torch.float64)
        pixels[1, 41:] = torch.nan
        pixels[2, 42:] = torch.nan
        assert spread_out(board.points, pixels).tolist() == [True, False, True]


class TestPoses:
    @pytest.mark.parametrize("truth", [CENTERED, OFF_CENTER], ids=["centered", "off center"])
    def test_exact(self, truth: Camera) -> None:
        poses = motions(truth, 6, 2)
        rotation, translation = poses_from_homographies(true_homographies(truth, poses), truth.params[:4])
        torch.testing.assert_close(rotation, poses[0], rtol=0, atol=1e-12)
        torch.testing.assert_close(translation, poses[1], rtol=0, atol=1e-12)

    def test_board_is_in_front_whatever_the_sign(self) -> None:
        poses = motions(CENTERED, 4, 2)
        homography = -3.0 * true_homographies(CENTERED, poses)
        rotation, translation = poses_from_homographies(homography, CENTERED.params[:4])
        torch.testing.assert_close(rotation, poses[0], rtol=0, atol=1e-12)
        torch.testing.assert_close(translation, poses[1], rtol=0, atol=1e-12)


class TestFlippedPoses:
    def test_is_an_involution(self) -> None:
        poses = motions(CENTERED, 6, 5)
        twice = flipped_poses(BOARD.points, *flipped_poses(BOARD.points, *poses))
        for before, after in zip(poses, twice, strict=True):
            torch.testing.assert_close(after, before, rtol=0, atol=1e-14)

    def test_keeps_the_center_and_mirrors_the_tilt(self) -> None:
        rotation, translation = motions(CENTERED, 6, 5)
        twin = flipped_poses(BOARD.points, rotation, translation)
        middle = BOARD.points.mean(0)
        center = rotation @ middle + translation
        torch.testing.assert_close(twin[0] @ middle + twin[1], center, rtol=0, atol=1e-14)
        identity = torch.eye(3).double().expand(6, 3, 3)
        torch.testing.assert_close(twin[0] @ twin[0].transpose(-1, -2), identity, rtol=0, atol=1e-14)
        torch.testing.assert_close(torch.linalg.det(twin[0]), torch.ones(6).double(), rtol=0, atol=1e-14)
        # The normals make the same angle with the line of sight, on opposite sides of it.
        d = center / torch.linalg.vector_norm(center, dim=-1, keepdim=True)
        before, after = rotation[..., 2], twin[0][..., 2]
        along = (before * d).sum(-1, keepdim=True)
        torch.testing.assert_close((after * d).sum(-1, keepdim=True), along, rtol=0, atol=1e-14)
        torch.testing.assert_close(after - along * d, -(before - along * d), rtol=0, atol=1e-14)

    def test_twins_look_alike_from_afar_and_ever_more_so(self) -> None:
        """Pixels of the twins differ by second order in (board / distance): a hundredth at ten times the distance."""
        board = Board(columns=7, rows=6, square=0.01)
        gaps = []
        for far in (3.0, 30.0):
            truth = Camera.build(focal=(500 * far, 505 * far), center=(319.5, 239.5), size=SIZE, model="pinhole")
            rotation = motions(CENTERED, 5, 5)[0]
            translation = torch.tensor([0.0, 0.0, far]).double() - rotation @ board.points.mean(0)
            pixels = pixels_of(truth, (rotation, translation), board=board)
            twin = flipped_poses(board.points, rotation, translation)
            gaps.append(float((pixels_of(truth, twin, board=board) - pixels).abs().max()))
        # The size of the image is the same, 30 px or so.
        assert gaps[0] < 0.5
        assert gaps[1] == pytest.approx(gaps[0] / 10, rel=0.1)


class TestUnflip:
    def test_repairs_planted_flips_and_leaves_good_poses_alone(self) -> None:
        truth = camera()
        poses = motions(truth, 12, 6, fill=0.12)
        views = Views(board_points=BOARD.points, pixels=pixels_of(truth, poses, noise=0.1))
        best, cost = refine_poses(views, truth.model, state_of(truth, poses), LMOptions())
        flipped = state_of(truth, flipped_poses(BOARD.points, best.rotation, best.translation))
        twin, worse = refine_poses(views, truth.model, flipped, LMOptions(max_iterations=1000))
        # Where the twin leads to a minimum of its own, every second of them.
        planted = worse > 1.2 * cost
        planted[planted.nonzero()[::2, 0]] = False
        assert int(planted.sum()) >= 3
        mixed = best._replace(
            rotation=torch.where(planted[:, None, None], twin.rotation, best.rotation),
            translation=torch.where(planted[:, None], twin.translation, best.translation),
        )
        repaired, changed = unflip(views, truth.model, mixed)
        assert changed == planted.nonzero()[:, 0].tolist()
        # The search stops early, within 1e-3 of the cost.
        final, _ = refine_poses(views, truth.model, repaired, LMOptions())
        torch.testing.assert_close(final.rotation, best.rotation, rtol=0, atol=1e-6)
        torch.testing.assert_close(final.translation, best.translation, rtol=0, atol=1e-6)
        _, changed = unflip(views, truth.model, repaired)
        assert changed == []

    def test_refining_poses_moves_nothing_else_and_returns_the_cost_of_each_view(self) -> None:
        truth = camera()
        poses = motions(truth, 4, 6)
        pixels = pixels_of(truth, poses)
        pixels[2] += 0.5
        state = state_of(truth, poses)
        views = Views(board_points=BOARD.points, pixels=pixels)
        refined, cost = refine_poses(views, truth.model, state, LMOptions())
        assert torch.equal(refined.parameters, state.parameters)
        assert torch.equal(refined.board, state.board)
        assert cost.shape == (4,)
        assert bool((cost[[0, 1, 3]] < 1e-18).all())
        assert float(cost[2]) > 1e-4


class TestPosesUnder:
    def test_poses_are_found_and_views_without_one_are_told(self) -> None:
        truth = camera()
        # Boards this small have twins: from closed forms alone, the first pose ends at the wrong tilt.
        poses = motions(truth, 6, 2, fill=0.04)
        pixels = pixels_of(truth, poses, noise=0.2)
        # One row of corners, and nothing at all.
        pixels[1, 7:] = torch.nan
        pixels[4] = torch.nan
        views = Views(board_points=BOARD.points, pixels=pixels)
        state, cost = poses_under(truth, views, LMOptions())
        assert cost.isnan().nonzero()[:, 0].tolist() == [1, 4]
        assert state.rotation.isnan().any(-1).any(-1).tolist() == cost.isnan().tolist()
        good = [0, 2, 3, 5]
        best, least = refine_poses(views.some(good), truth.model, state_of(truth, poses).views(good), LMOptions())
        torch.testing.assert_close(cost[good], least, rtol=1e-6, atol=0)
        torch.testing.assert_close(state.rotation[good], best.rotation, rtol=0, atol=1e-4)
        assert poses_under(truth, views.some([4]), LMOptions())[1].isnan().all()

    def test_boards_beside_a_wide_camera_have_their_poses(self) -> None:
        """At 70 to 110 degrees from the axis, where a plane in front of the camera has no place for them."""
        truth = Camera.build(focal=(150, 150), center=(320, 320), size=(640, 640), model="fisheye4")
        rotation, translation = motions(camera(), 5, 6, tilt=40.0)
        angle = torch.linspace(70.0, 110.0, 5, dtype=torch.float64).deg2rad()
        turn = rotation_from_vector(torch.stack([0 * angle, angle, 0 * angle], -1))
        middle = rotation @ BOARD.points.mean(0) + translation
        central = translation + middle.norm(dim=-1, keepdim=True) * torch.tensor([0.0, 0.0, 1.0]) - middle
        poses = turn @ rotation, (turn @ central[..., None])[..., 0]
        pixels, valid = truth.project(BOARD.points @ poses[0].transpose(1, 2) + poses[1][:, None])
        assert bool(valid.all())
        state, cost = poses_under(truth, Views(board_points=BOARD.points, pixels=pixels), LMOptions())
        assert float(cost.max()) < 1e-12
        torch.testing.assert_close(state.translation, poses[1], rtol=0, atol=1e-6)
