import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kcal import Camera, InputError, Rig
from kcal.sim.captures import BoardSize, PoseOptions, board_points, project_board, sample_board_poses
from kcal.sim.scene import demo_rig
from scripts.shared.captures import rig_pose, sample_pair_poses

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
