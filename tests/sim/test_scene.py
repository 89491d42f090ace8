"""Pictures of a terrain: what both cameras see is the same thing where the truth says so, in any light."""

import functools
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from kcal import Camera, Rig
from kcal.errors import InputError
from kcal.lens.pose import enu_from_cam
from kcal.sim.captures import BoardSize, PoseOptions, board_points, drawn_rig, project_board, sample_board_poses
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.scene import FOCAL_MM, DemoScene, demo_rig, mark_points, render_demo, scene_views
from scripts.shared.captures import rig_pose, sample_pair_poses
from scripts.shared.terrain import Terrain, Weather


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
    left, right = rig(torch.tensor([[0.0, 0.0, 5000.0], [0.0, 0.0, 5156.25]], dtype=torch.float64))[0].unbind(-2)
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


CAMERA = Camera.build(focal=(800, 810), center=(330, 235), size=(640, 480), coefficients=[-0.25, 0.07, 1e-3, -1e-3])
BOARD = BoardSize(9, 6, 0.025)


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def tilt_of(pose, board, eye=None):
    """Angle between the board's normal and the line of sight, and the direction in which it leans."""
    sight = pose.rotation @ board_points(board).mean(0) + pose.translation
    sight = sight if eye is None else sight - eye
    cosine = pose.rotation[:, 2] @ sight / torch.linalg.vector_norm(sight)
    lean = pose.rotation[:, 2] - sight / torch.linalg.vector_norm(sight)
    return math.acos(min(1.0, float(cosine))), math.atan2(float(lean[1]), float(lean[0]))


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**40),
    columns=st.integers(3, 12),
    rows=st.integers(3, 9),
    square=st.floats(1e-3, 2.0),
    max_tilt=st.floats(0.0, 1.0),
)
def test_boards_are_seen_and_tilted_no_more_than_asked(seed, columns, rows, square, max_tilt):
    board = BoardSize(columns, rows, square)
    poses = sample_board_poses(CAMERA, board, 5, seeded(seed), options=PoseOptions(max_tilt=max_tilt))
    assert len(poses) == 5
    for pose in poses:
        pixels, visible = project_board(CAMERA, pose, board)
        assert visible.all()
        # Whole squares are in the image, so corners are at least the margin inside.
        assert bool(((pixels > 4) & (pixels < torch.tensor([635.0, 475.0]))).all())
        # acos loses half the digits next to zero.
        assert tilt_of(pose, board)[0] <= max_tilt + 1e-7
        torch.testing.assert_close(
            pose.rotation @ pose.rotation.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12
        )


@pytest.mark.parametrize("seed", range(3))
def test_poses_cover_image_depth_and_directions(seed):
    poses = sample_board_poses(CAMERA, BOARD, 20, seeded(seed))
    pixels = torch.cat([project_board(CAMERA, pose, BOARD)[0] for pose in poses])
    size = torch.tensor([640.0, 480.0])
    assert bool((pixels.amin(0) < 0.12 * size).all())
    assert bool((pixels.amax(0) > 0.88 * size).all())
    assert len({tuple(cell) for cell in (pixels / size * 4).long().clamp(0, 3).tolist()}) == 16
    tilts = [tilt_of(pose, BOARD) for pose in poses]
    assert max(tilt for tilt, _ in tilts) > math.radians(35)
    assert min(tilt for tilt, _ in tilts) < math.radians(25)
    assert len({int((lean + math.pi) / (math.pi / 2)) for _, lean in tilts}) == 4
    depths = [float(pose.translation[2]) for pose in poses]
    assert max(depths) > 1.6 * min(depths)


def test_same_seed_same_poses_and_the_global_generator_is_left_alone():
    torch.manual_seed(3)
    before = torch.get_rng_state()
    first, again, other = (sample_board_poses(CAMERA, BOARD, 4, seeded(seed)) for seed in (1, 1, 2))
    assert all(torch.equal(a.rotation, b.rotation) for a, b in zip(first, again, strict=True))
    assert all(torch.equal(a.translation, b.translation) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0].translation, other[0].translation)
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.slow
def test_pairs_are_seen_by_both_cameras():
    rig, board = demo_rig(), BoardSize(9, 6, 0.4)
    poses = sample_pair_poses(rig, board, 8, seeded(4), distance=(13.0, 28.0))
    middle = -0.5 * rig.right_from_left_rotation.T @ rig.right_from_left_translation
    for pose in poses:
        right = rig_pose(rig, pose)
        assert project_board(rig.left, pose, board)[1].all()
        assert project_board(rig.right, right, board)[1].all()
        points = board_points(board) @ pose.rotation.T + pose.translation
        torch.testing.assert_close(
            board_points(board) @ right.rotation.T + right.translation, rig.right_from_left(points)
        )
        assert 13.0 <= float(torch.linalg.vector_norm(points.mean(0))) <= 28.0
        assert tilt_of(pose, board, middle)[0] <= math.radians(45) + 1e-7


def test_impossible_views_are_refused():
    with pytest.raises(InputError, match="completely seen"):
        sample_board_poses(CAMERA, BOARD, 3, seeded(0), fill=(2.0, 3.0))
    apart = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="completely seen"):
        sample_pair_poses(apart, BOARD, 3, seeded(0), distance=(1.0, 2.0))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "count"),
        ({"count": 10**6}, "count"),
        ({"fill": (0.9, 0.4)}, "fill"),
        ({"fill": (0.0, 0.4)}, "fill"),
        ({"fill": (0.2, float("nan"))}, "fill"),
        ({"board": BoardSize(1, 5, 0.1)}, "board"),
    ],
    ids=str,
)
def test_bad_arguments(arguments, message):
    count, board = arguments.pop("count", 3), arguments.pop("board", BOARD)
    with pytest.raises(InputError, match=message):
        sample_board_poses(CAMERA, board, count, seeded(0), **arguments)


@pytest.mark.parametrize(
    "option", [{"max_tilt": 1.5}, {"max_roll": -0.1}, {"border": -1}, {"margin": math.inf}], ids=str
)
def test_bad_options(option):
    with pytest.raises(InputError, match=next(iter(option))):
        PoseOptions(**option)


@functools.cache
def terrain() -> Terrain:
    return Terrain(drawn_rig(SURVEILLANCE, 1.0, 1, focal_mm=FOCAL_MM, wander=1.0, scale=0.25), 1)


def shift_between(weather: Weather, *, ground: bool) -> np.ndarray:
    """Pixels by which the right picture is beside the truth, by least squares over what both cameras see."""
    site = terrain()
    width, height = site.rig.left.size
    axes = [torch.arange(8.0, size - 8.0, 3.0, dtype=torch.float64) for size in (width, height)]
    left = torch.stack(torch.meshgrid(*axes, indexing="xy"), -1).reshape(-1, 2)
    pictures = [site.picture(side, 1, weather) for side in (0, 1)]
    right, distance = site.true_right(left, 1, weather)
    near, there = left.long(), right.round().long().clamp(torch.zeros(2).long(), torch.tensor([width - 1, height - 1]))
    depth, other = (
        torch.from_numpy(one.depth)[at[:, 1], at[:, 0]] for one, at in zip(pictures, (near, there), strict=True)
    )
    level = torch.from_numpy(pictures[0].ground)[near[:, 1], near[:, 0]]
    seen = site.rig.right.inside(right) & (distance < 2000.0) & ((other / depth - 1.0).abs() < 0.02) & (level == ground)
    places = right[seen].numpy()[:, ::-1].T
    here = pictures[0].light[near[seen, 1], near[seen, 0]]
    step = np.stack([map_coordinates(part, places, order=1) for part in np.gradient(pictures[1].light)], -1)
    off = here - map_coordinates(pictures[1].light, places, order=3)
    # Edges have parts of two things.
    plain = (np.abs(off) < 3.0) & (np.abs(step) < 15.0).all(-1)
    assert plain.sum() > 1000
    return np.linalg.lstsq(step[plain], off[plain], rcond=None)[0]


@pytest.mark.parametrize(
    "weather",
    [Weather(), Weather(hour=16.5, haze=3000.0, season=0.5), Weather(shutter=0.02)],
    ids=["noon", "dim", "roll"],
)
@pytest.mark.parametrize("ground", [False, True])
def test_both_cameras_see_the_same_where_the_truth_says(weather: Weather, ground: bool) -> None:
    assert np.abs(shift_between(weather, ground=ground)).max() < 0.05


def test_light_follows_the_hour() -> None:
    site = terrain()
    mean = {hour: float(site.picture(0, None, Weather(hour=hour)).light.mean()) for hour in (9.0, 12.0, 18.0, 19.5)}
    assert mean[12.0] > mean[9.0] > mean[18.0] > 3.0 * mean[19.5] > 0.0
    # The sun is in the south at noon, behind the cameras, which look north-east; it is in their back right before.
    assert Weather().sun[1] < 0.0
    assert Weather(hour=8.0).sun[0] > Weather(hour=16.0).sun[0]


def test_shadows_turn_with_the_sun() -> None:
    site = terrain()
    dark = []
    for hour in (8.0, 16.5):
        picture = site.picture(0, None, Weather(hour=hour))
        level = np.median(picture.light[picture.ground & (picture.depth < 150.0)])
        dark.append(picture.ground & (picture.light < 0.62 * level) & (picture.depth < 400.0))
    assert min(one.sum() for one in dark) > 100
    assert (dark[0] & dark[1]).sum() < 0.4 * min(one.sum() for one in dark)


def test_season_changes_the_ground_and_no_block() -> None:
    site = terrain()
    summer, winter = (site.picture(0, None, Weather(season=share)) for share in (0.0, 1.0))
    block = ~summer.ground & (summer.depth < 1000.0)
    ground = summer.ground & (summer.depth < 300.0)
    # But for edges, which have a part of the ground.
    assert (summer.light[block] == winter.light[block]).mean() > 0.9
    assert abs(np.corrcoef(summer.light[ground], winter.light[ground])[0, 1]) < 0.6


def test_what_moves_is_elsewhere_at_another_moment() -> None:
    site = terrain()
    one, two = (site.picture(0, moment, Weather()).moving for moment in (1, 2))
    assert one.any()
    assert two.any()
    assert (one & two).sum() < 0.3 * one.sum()


def test_a_rolling_shutter_shears() -> None:
    still, rolled = (terrain().picture(0, None, Weather(shutter=shutter)).light for shutter in (0.0, 0.02))
    height, width = still.shape
    for row, expected in ((height // 2, 0.0), (height - 12, -0.02 * 400.0 * (0.5 - 12.0 / height))):
        middle = slice(width // 4, 3 * width // 4)
        misses = {
            shift: float(np.abs(np.roll(still[row], shift)[middle] - rolled[row][middle]).mean())
            for shift in range(-8, 9)
        }
        assert min(misses, key=lambda shift: misses[shift]) == pytest.approx(expected, abs=0.8)
