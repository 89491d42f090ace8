import itertools
import math

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.pose import enu_from_cam
from kcal.sim.captures import project_board
from kcal.sim.scene import DemoScene, demo_rig, mark_points, render_demo, scene_views


def test_rig_frame_is_turned_as_the_locator_turns_it():
    scene = DemoScene(heading_deg=127.0, pitch_deg=-3.0, roll_deg=5.0)
    torch.testing.assert_close(scene.enu_from_rig, enu_from_cam(127.0, -3.0, 5.0), rtol=0, atol=1e-14)


def test_targets_lie_where_they_are_said_to_lie():
    scene = DemoScene(heading_deg=0.0, pitch_deg=0.0, roll_deg=0.0)
    assert scene.targets.names[-1] == "drone"
    east, north, up = scene.targets.enu[-1].tolist()
    assert math.hypot(east, north) == pytest.approx(5000)
    assert math.degrees(math.atan2(east, north)) == pytest.approx(2.0)
    # x right is east, y down, z forward is north.
    assert scene.points_rig(scene.targets)[-1].tolist() == pytest.approx([east, -up, north])


def test_both_cameras_see_every_target_and_two_lie_near_the_edges():
    scene = DemoScene()
    marks, landmarks = scene.target_marks, scene.landmark_marks
    assert marks.left.shape == (7, 2)
    assert landmarks.left.shape == (12, 2)
    x = marks.true_left[:, 0]
    assert float(x.min()) < 0.06 * 1920
    assert float(x.max()) > 0.94 * 1920
    assert not torch.equal(landmarks.left - landmarks.true_left, marks.left[:1] - marks.true_left[:1])


def test_a_tenth_of_a_pixel_is_156_m_at_5_km():
    """Z² / (f B) * 0.1 px with f = 1600 px and B = 10 m is 156 m; the demonstration's rig has these numbers."""
    rig = demo_rig()
    points = torch.tensor([[0.0, 0.0, 5000.0], [0.0, 0.0, 5156.25]], dtype=torch.float64)
    left, right = rig(points)[0].unbind(-2)
    disparity = float((left - right)[0, 0] - (left - right)[1, 0])
    # Farther out the same step is worth 3 % less.
    assert disparity == pytest.approx(0.1, rel=0.05)


def test_marks_have_the_noise_that_was_asked_for():
    points = torch.tensor([[0.0, 0.0, 1000.0]]).expand(20000, 3)
    marks = mark_points(demo_rig(), points, 0.1, torch.Generator().manual_seed(0))
    noise = torch.stack([marks.left - marks.true_left, marks.right - marks.true_right])
    # 20 000 draws: the standard deviation is known to 0.5 %.
    torch.testing.assert_close(noise.std(1), torch.full((2, 2), 0.1, dtype=torch.float64), rtol=0.03, atol=0)
    assert float(torch.corrcoef(torch.cat([*noise], -1).T).fill_diagonal_(0).abs().max()) < 0.03


def test_unseen_points_are_refused():
    points = torch.tensor([[5.0, 0.0, 10.0], [5.0, 0.0, -10.0]])
    with pytest.raises(InputError, match="point 1 is not seen"):
        mark_points(demo_rig(), points, 0.1, torch.Generator())
    with pytest.raises(InputError, match="sigma"):
        mark_points(demo_rig(), torch.ones(1, 3), -0.1, torch.Generator())


@pytest.mark.slow
def test_squares_are_large_enough_to_be_found():
    """Also far away, tilted and pressed together by the distortion at the image's edge."""
    scene = DemoScene(seed=5)
    board = scene.near_board
    for camera, _, pose in scene_views(scene):
        pixels, visible = project_board(getattr(scene.rig, camera), pose, board)
        assert visible.all()
        grid = pixels.reshape(board.rows, board.columns, 2)
        assert min(float(grid.diff(dim=axis).norm(dim=-1).min()) for axis in (0, 1)) > 30


@pytest.mark.slow
def test_rendered_demo():
    scene, told = DemoScene(seed=2, near_views=2), []
    views = list(render_demo(scene, told.append))
    assert len(views) == scene.images == len(told) == 4
    assert [(view.camera, view.name) for view in views] == [
        ("left", "near-01"),
        ("left", "near-02"),
        ("right", "near-01"),
        ("right", "near-02"),
    ]
    assert told[0] == "left near-01"
    for view in views:
        assert view.image.dtype == torch.uint8
        assert view.image.shape == (1080, 1920)
        # Black and white squares meet at each corner.
        x, y = view.corners[20].round().long().tolist()
        patch = view.image[y - 8 : y + 9, x - 8 : x + 9].int()
        assert int(patch.max() - patch.min()) > 100


@pytest.mark.slow
def test_same_seed_same_bytes():
    first, again, other = (next(render_demo(DemoScene(seed=seed, near_views=2))) for seed in (2, 2, 3))
    assert torch.equal(first.image, again.image)
    assert not torch.equal(first.corners, other.corners)
    marks = [DemoScene(seed=seed).target_marks.left for seed in (2, 2, 3)]
    assert torch.equal(marks[0], marks[1])
    assert not torch.equal(marks[0], marks[2])


def test_every_image_has_its_own_noise():
    scene = DemoScene(seed=1, near_views=2)
    images = [view.image[:40, :40].int() for view in itertools.islice(render_demo(scene), 2)]
    assert not torch.equal(images[0], images[1])
