"""Rendered boards and scenes, backdrops, and captures by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from kcal import Board, Camera, InputError
from kcal.lens import rotation_from_vector
from kcal.lens.pose import Pose
from kcal.sim import coast
from kcal.sim.captures import (
    BoardSize,
    PrintedBoard,
    area_colors,
    board_points,
    check_pose,
    project_board,
    sample_board_poses,
)
from kcal.sim.coast import _random_lattice, smooth_noise
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.scene import RenderOptions, invert_window, render_board, render_light
from kcal.sim.truth import PixelRectangle, TruthLens, pixel_axes
from scripts.shared.captures import PAPER_BOARD
from scripts.shared.simulated import HandMotion, Hands, draw_motion, moving_capture, noise_root, rolling_corners

BOARD = BoardSize(9, 6, 0.06)

CLEAN = RenderOptions(noise=0, vignetting=0, blur=1.0)

# Barrel distortion of 130 px in the corners, tangential and prism terms.
LENS = [-0.20, 0.055, 4e-4, -3e-4, 0.0, 0.10, 0.012, 0.0, 3e-4, 0.0, -2e-4, 0.0]


def camera_of(coefficients=(), size=(1280, 720), focal=1067.0, model="opencv12"):
    center = ((size[0] - 1) / 2 + 3.3, (size[1] - 1) / 2 - 2.6)
    return Camera.build(focal=(focal, focal - 1.2), center=center, size=size, coefficients=coefficients, model=model)


def pose_of(vector, middle, board=BOARD):
    rotation = rotation_from_vector(torch.tensor(vector, dtype=torch.float64))
    return Pose(rotation, torch.tensor(middle, dtype=torch.float64) - rotation @ board_points(board).mean(0))


POSES = {
    "square to the axis, edges along pixels": pose_of((0, 0, 0), (0.013, -0.021, 0.8)),
    "nearly along pixels": pose_of((0.01, -0.02, 0.004), (-0.05, 0.02, 1.1)),
    "tilted": pose_of((0.6, -0.3, 0.2), (0.17, -0.08, 0.9)),
    "in a corner of the image": pose_of((-0.3, 0.4, -0.3), (-0.62, 0.31, 1.6)),
}


def cubic_saddle(image, start):
    """Stationary point of a cubic fitted to the image on a disc of 3.6 px.

    The image is blurred by 1.5 px to be sampled between pixels. The cubic terms follow the curvature of edges, which
    would bias a quadratic.
    """
    reach = torch.arange(-3.5, 4, 0.5, dtype=torch.float64)
    y, x = (grid.reshape(-1) for grid in torch.meshgrid(reach, reach, indexing="ij"))
    keep = x**2 + y**2 <= 3.6**2
    x, y = x[keep], y[keep]
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    inverse = torch.linalg.pinv(torch.stack([x**i * y**j for i, j in powers], -1))
    rows, columns = (torch.arange(size, dtype=torch.float64) for size in image.shape)
    where = start.clone()
    for _ in range(8):
        # A Gaussian of 1.5 px summed over pixels is the integral to all digits.
        across = torch.exp(-((where[0] + reach[:, None] - columns) ** 2) / 4.5) / (1.5 * math.sqrt(2 * math.pi))
        down = torch.exp(-((where[1] + reach[:, None] - rows) ** 2) / 4.5) / (1.5 * math.sqrt(2 * math.pi))
        c = dict(zip(powers, (inverse @ (down @ image @ across.T).reshape(-1)[keep]).tolist(), strict=True))
        u = v = 0.0
        for _ in range(5):
            gu = sum(i * c[i, j] * u ** max(i - 1, 0) * v**j for i, j in powers)
            gv = sum(j * c[i, j] * u**i * v ** max(j - 1, 0) for i, j in powers)
            uu, uv, vv = 2 * c[2, 0] + 6 * c[3, 0] * u + 2 * c[2, 1] * v, 0.0, 2 * c[0, 2] + 6 * c[0, 3] * v
            uv, vv = c[1, 1] + 2 * c[2, 1] * u + 2 * c[1, 2] * v, vv + 2 * c[1, 2] * u
            determinant = uu * vv - uv * uv
            u, v = u - (vv * gu - uv * gv) / determinant, v - (uu * gv - uv * gu) / determinant
        where = where + torch.tensor([u, v], dtype=torch.float64)
    return where


@pytest.mark.parametrize("coefficients", [(), LENS], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("name", POSES)
def test_corners_are_where_the_camera_projects_them(name, coefficients):
    camera = camera_of(coefficients)
    image = render_light(camera, POSES[name], BOARD, CLEAN)
    pixels, visible = project_board(camera, POSES[name], BOARD)
    assert visible.all()
    some = pixels[::5]
    error = torch.stack([cubic_saddle(image, pixel) for pixel in some]) - some
    # Measured: 0.001 px RMS and 0.0025 px at most, for the fit and the rendering together.
    assert float(error.square().mean().sqrt()) < 0.0015
    assert float(error.abs().max()) < 0.003
    assert float(error.mean(0).abs().max()) < 0.001


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_corners_are_where_the_true_lens_sees_them(gamma):
    # All of the pupil's wander, at 45 cm: lines of sight from one point would be wrong by a pixel.
    lens = TruthLens(SURVEILLANCE, size=(960, 600), focal=700.0, wander=1.0, focal_mm=8.0)
    pose = pose_of((0.3, -0.2, 0.1), (-0.02, 0.01, 0.45))
    image = render_light(lens, pose, BOARD, RenderOptions(noise=0, vignetting=0, blur=1.0, gamma=gamma))
    pixels, visible = project_board(lens, pose, BOARD)
    assert visible.all()
    central = TruthLens(SURVEILLANCE, size=(960, 600), focal=700.0, wander=0.0, focal_mm=8.0)
    assert float((project_board(central, pose, BOARD)[0] - pixels).abs().max()) > 0.3
    some = pixels[::7]
    error = torch.stack([cubic_saddle((image / 255) ** gamma, pixel) for pixel in some]) - some
    assert float(error.square().mean().sqrt()) < 0.0015


def test_corners_of_a_print_are_where_its_errors_put_them():
    lens = TruthLens(SURVEILLANCE, size=(960, 600), focal=700.0, wander=1.0, focal_mm=8.0)
    pose, board = pose_of((0.3, -0.2, 0.1), (-0.02, 0.01, 0.45)), PrintedBoard(9, 6, 0.06, seed=3)
    image = render_light(lens, pose, board, RenderOptions(noise=0, vignetting=0, blur=1.0))
    pixels, visible = project_board(lens, pose, board)
    assert visible.all()
    off = pixels - project_board(lens, pose, BOARD)[0]
    assert 0.3 < float(off.norm(dim=-1).max()) < 3.0
    some = pixels[::7]
    error = torch.stack([cubic_saddle(image, pixel) for pixel in some]) - some
    assert float(error.square().mean().sqrt()) < 0.0015


def test_gamma_is_a_curve_of_gray_levels():
    camera, pose = camera_of(), POSES["tilted"]
    plain, curved = (
        render_light(camera, pose, BOARD, replace(CLEAN, black=0, white=255, background=20, gamma=gamma))
        for gamma in (1.0, 2.0)
    )
    assert float(curved.min()) >= 0
    flat = plain > 254.999
    assert bool(flat.any())
    torch.testing.assert_close(curved[flat], plain[flat], atol=0.01, rtol=0)
    # Half way over an edge half the light arrives, which is more than half the level.
    edge = (plain - 127.5).abs() < 2
    assert float(curved[edge].mean()) == pytest.approx(255 * math.sqrt(0.5), abs=4)


def test_gray_levels_are_the_blurred_scene_averaged_over_the_pixels():
    """Against 12 x 12 rays a pixel, each inverted through the lens on its own, with hard edges, blurred, averaged."""
    camera = camera_of(LENS, size=(64, 48), focal=55.0)
    pose = pose_of((0.5, -0.4, 0.3), (0.02, 0.01, 0.75))
    options = RenderOptions(noise=0, vignetting=0, blur=0.6, black=0, white=255, background=0)
    image = render_light(camera, pose, BOARD, options)
    n = 12
    offset = (torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5
    x = (torch.arange(64, dtype=torch.float64)[:, None] + offset).reshape(-1)
    y = (torch.arange(48, dtype=torch.float64)[:, None] + offset).reshape(-1)
    rays, valid = camera.unproject(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2))
    assert valid.all()
    normal = pose.rotation[:, 2]
    depth = (normal @ pose.translation) / (rays @ normal)
    a, b, _ = (((rays * depth[:, None] - pose.translation) @ pose.rotation) / BOARD.square).unbind(-1)
    scene = 255 * ((a > -2) & (a < 10) & (b > -2) & (b < 7)).double()
    black = (a > -1) & (a < 9) & (b > -1) & (b < 6) & ((a.floor() + b.floor()) % 2 == 0)
    scene = torch.where(black, 0.0, scene).reshape(48 * n, 64 * n)
    blurred = torch.exp(-0.5 * ((y[:, None] - y) / 0.6) ** 2) @ scene @ torch.exp(-0.5 * ((x[:, None] - x) / 0.6) ** 2)
    light = (blurred / (2 * math.pi * (0.6 * n) ** 2)).reshape(48, n, 64, n).mean((1, 3))
    error = (image - light)[4:-4, 4:-4]
    assert float(light.max()) > 200
    # Of 255, and mostly of the rays: twice as many along x and y halve the largest.
    assert float(error.abs().max()) < 3
    assert float(error.square().mean().sqrt()) < 0.5
    assert abs(float(error.mean())) < 0.03


def test_inverse_is_interpolated_below_a_thousandth_of_a_pixel():
    camera = camera_of(LENS)
    normalized, valid = invert_window(camera, PixelRectangle(-7, 300, 160, 97))
    x, y = pixel_axes(PixelRectangle(-7, 300, 160, 97))
    exact, valid_exact = camera.normalize(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2))
    assert valid.all()
    assert valid_exact.all()
    # Cubic interpolation over 8 px: 1e-5 px are 1e-8 in normalized coordinates.
    torch.testing.assert_close(normalized.reshape(-1, 2), exact, rtol=0, atol=1e-8)


def test_nothing_is_painted_beyond_the_fold():
    # r - 0.5 r³ folds at r = 0.816, which is 0.544 after distortion: 272 px from the center of a 640 x 480 image.
    camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.5])
    window = PixelRectangle(0, 0, 640, 480)
    normalized, valid = invert_window(camera, window)
    x, y = pixel_axes(window)
    radius = torch.hypot(x - 319.5, (y - 239.5)[:, None])
    fold = 500 * math.sqrt(2 / 3) * 2 / 3
    assert torch.equal(valid, radius < fold)
    back, _ = camera.project(torch.cat([normalized, torch.ones_like(normalized[..., :1])], -1))
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    # Interpolated beside a fold, where the inverse is steep.
    assert float((back - pixels)[radius < fold - 1].abs().max()) < 1e-3

    # A wall of a board: the image shows it up to the fold and the background beyond.
    wall = BoardSize(40, 40, 0.1)
    image = render_board(
        camera,
        pose_of((0, 0, 0), (0, 0, 1), wall),
        wall,
        RenderOptions(noise=0, vignetting=0, blur=0, background=0, black=100, white=200),
    )
    assert int(image[radius >= fold].max()) == 0
    assert int(image[radius < fold - 2].min()) >= 100


def test_a_cut_board_is_drawn_as_far_as_it_is_seen():
    """A small image is the same as the part of a larger one, to its very edge and including the blur from outside."""
    options = RenderOptions(noise=0, vignetting=0, blur=1.5, background=0)
    large = Camera.build(focal=(500, 500), center=(300, 200), size=(600, 400), coefficients=[-0.2, 0.04])
    small = Camera.build(focal=(500, 500), center=(100, 80), size=(250, 200), coefficients=[-0.2, 0.04])
    pose = pose_of((0.2, 0.3, 0.1), (0.02, 0.01, 0.6))
    part = render_board(small, pose, BOARD, options)
    whole = render_board(large, pose, BOARD, options)[120:320, 200:450]
    # The grid of the inverse lies elsewhere: gray levels may round differently.
    assert int((part.int() - whole.int()).abs().max()) <= 1
    assert not project_board(small, pose, BOARD)[1].all()
    assert int(render_board(small, pose_of((0, 0, 0), (5.0, 0.0, 1.0)), BOARD, options).max()) == 0


def test_optics_and_sensor():
    camera = camera_of(size=(320, 200), focal=250.0)
    pose = POSES["tilted"]
    plain = render_board(camera, pose, BOARD, CLEAN).double()
    noisy = render_board(
        camera, pose, BOARD, RenderOptions(noise=3, vignetting=0, blur=1.0), torch.Generator().manual_seed(5)
    ).double()
    difference = noisy - plain
    assert float(difference.std()) == pytest.approx(3.0, abs=0.1)
    assert abs(float(difference.mean())) < 0.05
    dimmed = render_board(camera, pose, BOARD, RenderOptions(noise=0, vignetting=0.4, blur=1.0)).double()
    assert float(dimmed[0, 0] / plain[0, 0]) == pytest.approx(0.6, abs=0.01)
    assert float(dimmed[100, 160] / plain[100, 160]) == pytest.approx(1.0, abs=0.01)
    assert int(plain.min()) >= 40
    assert int(plain.max()) <= 215


def test_same_generator_same_bytes_and_the_global_one_is_left_alone():
    camera, options = camera_of(size=(160, 120), focal=130.0), RenderOptions()
    torch.manual_seed(11)
    before = torch.get_rng_state()
    images = [
        render_board(camera, POSES["tilted"], BOARD, options, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
    ]
    assert images[0].dtype == torch.uint8
    assert images[0].shape == (120, 160)
    assert torch.equal(images[0], images[1])
    assert not torch.equal(images[0], images[2])
    assert torch.equal(before, torch.get_rng_state())


def test_refusals():
    camera = camera_of()
    with pytest.raises(InputError, match="behind the camera"):
        render_board(camera, pose_of((0, 0, 0), (0, 0, -1.0)), BOARD, CLEAN)
    with pytest.raises(InputError, match="behind the camera"):
        render_board(camera, pose_of((0, 1.5, 0), (0, 0, 0.2)), BOARD, CLEAN)
    with pytest.raises(InputError, match="shows its back"):
        render_board(camera, pose_of((0, math.pi, 0), (0, 0, 1.0)), BOARD, CLEAN)
    with pytest.raises(InputError, match="Generator"):
        render_board(camera, POSES["tilted"], BOARD, RenderOptions(noise=1))
    batch = Camera(camera.params[None].expand(2, -1), size=camera.size, model=camera.model)
    with pytest.raises(InputError, match="single camera"):
        render_board(batch, POSES["tilted"], BOARD, CLEAN)


@pytest.mark.parametrize(
    "option",
    [{"blur": -1}, {"noise": float("nan")}, {"black": 300}, {"margin": 0}, {"margin": 1.5}, {"vignetting": 2}],
    ids=str,
)
def test_bad_options(option):
    with pytest.raises(InputError, match=next(iter(option))):
        RenderOptions(**option)


# Waves, clouds and the sea of pictures: smooth where they should be, and brighter the flatter water is looked at.


def test_noise_joins_its_random_values_smoothly() -> None:
    lattice = _random_lattice().reshape(256, 256)
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    np.testing.assert_allclose(smooth_noise(x, y, 1), lattice[:4, :5])
    # It goes around, and on both sides of zero.
    np.testing.assert_allclose(smooth_noise(x - 256, y + 256, 1), lattice[:4, :5])
    np.testing.assert_allclose(smooth_noise(x - 5, y, 1), lattice[:4, -5:])
    # Between two values along a line of the lattice: 3 u² - 2 u³ of the way.
    for u in (0.2, 0.7):
        share = u * u * (3 - 2 * u)
        np.testing.assert_allclose(
            smooth_noise(x + u, y, 1), lattice[:4, :5] + share * np.diff(lattice[:4, :6]), atol=1e-6
        )
        down = np.diff(lattice[:5, :5], axis=0)
        np.testing.assert_allclose(smooth_noise(x, y + u, 1), lattice[:4, :5] + share * down, atol=1e-6)
    # No step anywhere.
    line = smooth_noise(np.linspace(0, 9, 9001), 0.37 + 0.2 * np.linspace(0, 9, 9001), 1)
    assert np.abs(np.diff(line)).max() < 4e-3


def test_octaves_have_half_the_weight_and_twice_the_detail() -> None:
    x = np.linspace(0, 5, 40)
    parts = [smooth_noise(x * 2**k + 17.3 * k, x * 2**k + 5.1 * k, 1) for k in range(3)]
    np.testing.assert_allclose(smooth_noise(x, x, 3), (parts[0] + parts[1] / 2 + parts[2] / 4) / 1.75, atol=1e-6)
    assert smooth_noise(np.zeros((2, 1)), np.zeros(3)).shape == (2, 3)


def test_water_mirrors_the_sky_more_the_flatter_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coast, "smooth_noise", lambda x, y, octaves: np.zeros_like(x))
    haze = SimpleNamespace(color=np.array([200.0, 210.0, 220.0]), seen=lambda color, distance: color)
    shore = SimpleNamespace(water=(40.0, 60.0, 80.0), haze=haze)
    down = np.array([0.0, -0.05, -1.0])
    heading = np.stack([np.sqrt(1 - down**2), 0 * down, down], -1)[:, None] * np.ones((1, 2, 1))
    camera = SimpleNamespace(center=(0.0, 0.0, 10.0))
    found = coast._sea(camera, heading, np.ones((3, 2)), shore)[:, 0]  # type: ignore[arg-type]
    for color, share in zip(found, 0.45 * np.exp(down / 0.05), strict=True):
        np.testing.assert_allclose(color, np.array(shore.water) + share * (haze.color - shore.water))


def test_values_of_every_fourth_pixel_are_joined_by_lines() -> None:
    few = np.add.outer(10.0 * np.arange(4), np.arange(3.0))
    found = coast._joined_values(few, (13, 9))
    np.testing.assert_allclose(found, np.add.outer(2.5 * np.arange(13), 0.25 * np.arange(9)))
    # Beyond the last one nothing changes.
    np.testing.assert_allclose(coast._joined_values(few, (15, 11))[12:, 8:], found[12, 8])


def test_points_are_those_of_the_library_board():
    assert torch.equal(board_points(BoardSize(9, 6, 0.06)), Board(columns=9, rows=6, square=0.06).points)


def test_a_library_board_can_be_used_as_it_is():
    assert torch.equal(board_points(Board(columns=5, rows=4, square=0.1)), board_points(BoardSize(5, 4, 0.1)))


def test_border_goes_on_outside():
    grid = board_points(BoardSize(3, 2, 0.5), border=1).reshape(4, 5, 3)
    assert grid[0, 0].tolist() == [-0.5, -0.5, 0.0]
    assert torch.equal(grid[1:-1, 1:-1].reshape(-1, 3), board_points(BoardSize(3, 2, 0.5)))


def test_area_averages_are_integrals():
    # Midpoint sums over boxes of any size, also many squares wide; n midpoints err by less than edges * width / n.
    generator = torch.Generator().manual_seed(3)
    board, n = BoardSize(5, 4, 1.0), 400
    center = 9 * torch.rand((40, 2), dtype=torch.float64, generator=generator) - 2.5
    width = 2.5 * torch.rand((40, 2), dtype=torch.float64, generator=generator) + 1e-3
    colors = area_colors(center[:, 0], center[:, 1], width[:, 0], width[:, 1], board, 1)
    step = (torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5
    a = (center[:, 0, None] + width[:, 0, None] * step)[:, :, None]
    b = (center[:, 1, None] + width[:, 1, None] * step)[:, None, :]
    paper = (a > -2) & (a < 6) & (b > -2) & (b < 5)
    black = (a > -1) & (a < 5) & (b > -1) & (b < 4) & ((a.floor() + b.floor()) % 2 == 0)
    torch.testing.assert_close(colors.paper, paper.double().mean((1, 2)), rtol=0, atol=6 / n)
    torch.testing.assert_close(colors.black, black.double().mean((1, 2)), rtol=0, atol=6 / n)


def test_visible_is_valid_and_inside():
    camera = Camera.build(focal=(800, 800), center=(319.0, 239.5), size=(640, 480))
    pixels, visible = project_board(camera, Pose(torch.eye(3), torch.tensor([0.0, 0.0, 1.0])), BoardSize(9, 2, 0.1))
    assert pixels[:, 0].tolist() == pytest.approx([319.0 + 80 * i for i in range(9)] * 2)
    assert visible.tolist() == ([True] * 5 + [False] * 4) * 2  # the fifth lies half a pixel inside the edge at 639.5


def test_bad_boards_and_poses():
    for board in (BoardSize(1, 6, 0.1), BoardSize(9, 6, 0.0), BoardSize(9, 6, float("nan"))):
        with pytest.raises(InputError, match="at least 2x2"):
            board_points(board)
    identity, zero = torch.eye(3), torch.zeros(3)
    with pytest.raises(InputError, match="not a rotation"):
        check_pose((-identity, zero))
    with pytest.raises(InputError, match="shapes"):
        check_pose((identity, zero[None]))
    with pytest.raises(InputError, match="not finite"):
        check_pose((identity, zero / 0))


# Captures by hand: the rolling shutter's implicit equation, blur, and noise along it.


PINHOLE = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")

POINTS = torch.tensor([[0.0, 0.0, 2.0], [0.3, 0.4, 2.0], [-0.3, -0.5, 2.0]]).double()

READOUT, EXPOSURE = 0.02, 0.01

MOVING_POSES = sample_board_poses(PINHOLE, PAPER_BOARD, 6, torch.Generator().manual_seed(4), fill=(0.25, 0.8))


def steady(*rates: float) -> HandMotion:
    """Constant rates of turn and shift."""
    zero = torch.zeros(1, 6, dtype=torch.float64)
    return HandMotion(torch.tensor(rates, dtype=torch.float64), zero, zero + 1.0, zero)


def test_a_shift_along_the_rows_shears_the_image() -> None:
    still = PINHOLE.project(POINTS)[0]
    pixels, blur = rolling_corners(
        PINHOLE, POINTS, steady(0, 0, 0, 0.5, 0, 0), torch.zeros(3).double(), READOUT, EXPOSURE
    )
    speed = 800 * 0.5 / 2.0  # px/s
    times = ((still[:, 1] + 0.5) / 480 - 0.5) * READOUT
    assert torch.allclose(pixels[:, 0], still[:, 0] + speed * times)
    assert torch.allclose(pixels[:, 1], still[:, 1])
    assert torch.allclose(blur, torch.tensor([speed * EXPOSURE, 0.0]).double().expand(3, 2))


def test_a_shift_down_the_rows_stretches_the_image() -> None:
    """v = v0 + speed · time(v) has a closed form; one iteration of it does not."""
    still = PINHOLE.project(POINTS)[0]
    pixels, _ = rolling_corners(PINHOLE, POINTS, steady(0, 0, 0, 0, 4.0, 0), torch.zeros(3).double(), READOUT, EXPOSURE)
    rows = 800 * 4.0 / 2.0 * READOUT / 480  # share of the image by which the board moves during the readout
    assert torch.allclose(pixels[:, 1] - 239.5, (still[:, 1] - 239.5) / (1 - rows))


def test_things_turn_about_their_middle() -> None:
    spin = steady(0, 0, 2.0, 0, 0, 0)
    pixels, _ = rolling_corners(PINHOLE, POINTS[1:2], spin, POINTS[1], READOUT, EXPOSURE)
    assert torch.allclose(pixels, PINHOLE.project(POINTS[1:2])[0])
    other, _ = rolling_corners(PINHOLE, POINTS[1:2], spin, torch.zeros(3).double(), READOUT, EXPOSURE)
    assert float((other - pixels).norm()) > 1.0


def test_what_is_detected_is_the_mean_over_the_exposure() -> None:
    zero, one = torch.zeros(1, 6).double(), torch.zeros(1, 6).double()
    one[0, 3] = 1.0
    swing = HandMotion(zero[0], one, zero + 5.0, zero + math.pi / 2)
    pixels, _ = rolling_corners(PINHOLE, POINTS[:1], swing, zero[0, :3], READOUT, 0.04)
    circular = 2 * math.pi * 5
    shift = (
        math.sin(circular * 0.02) / (circular * 0.02) - 1
    ) / circular  # the mean of (cos(circular t) - 1) / circular
    assert float(pixels[0, 0]) == pytest.approx(319.5 + 800 * shift / 2.0, abs=1e-4)
    late = swing.at(torch.tensor([0.0, 0.05]).double())  # a quarter of a period
    assert late[0].abs().max() == 0
    assert float(late[1, 3]) == pytest.approx(-1 / circular)


def test_points_behind_are_not_seen() -> None:
    behind = torch.cat([POINTS, torch.tensor([[0.0, 0.0, -1.0]]).double()])
    pixels, _ = rolling_corners(PINHOLE, behind, steady(0, 0, 0, 0, 4.0, 0), torch.zeros(3).double(), READOUT, EXPOSURE)
    assert pixels.isfinite().all(-1).tolist() == [True, True, True, False]


def test_rates_are_as_large_as_asked_for() -> None:
    generator = torch.Generator().manual_seed(5)
    moments = torch.tensor([-0.01, 0.01]).double()
    rates = torch.stack(
        [draw_motion(0.4, 0.1, (2.0, 10.0), generator).at(moments).diff(dim=0)[0] / 0.02 for _ in range(2000)]
    )
    found = rates.square().mean(0).sqrt()
    assert found[:3].tolist() == pytest.approx([0.4] * 3, rel=0.06)  # a mean over 20 ms of up to 10 Hz loses 2 %
    assert found[3:].tolist() == pytest.approx([0.1] * 3, rel=0.06)


def test_noise_grows_along_the_blur_alone() -> None:
    length = 0.7 * math.sqrt(12.0) * math.sqrt(15.0)  # widens the edge fourfold
    root = noise_root(torch.tensor([0.6, 0.8]).double() * length, 0.1)
    value, vector = torch.linalg.eigh(root)
    assert value.tolist() == pytest.approx([0.1, 0.2])
    assert vector[:, 1].abs().tolist() == pytest.approx([0.6, 0.8])


def test_noise_is_drawn_from_its_covariance() -> None:
    # The largest blur is as long as the motion wants.
    moving = moving_capture(
        PINHOLE, 7 * MOVING_POSES, sigma=0.1, seed=2, hands=Hands(turning=(0.5, 0.5), exposure=(0.02, 0.02))
    )
    off = moving.pixels - moving.true_pixels
    distance = (off * torch.linalg.solve(moving.covariance, off[..., None])[..., 0]).sum(-1)
    assert float(distance.mean()) == pytest.approx(2.0, rel=0.08)
    assert float(moving.covariance.diagonal(dim1=-2, dim2=-1).max()) > 1.5 * 0.1**2


def test_on_a_stand_corners_are_where_the_lens_shows_them() -> None:
    still = moving_capture(PINHOLE, MOVING_POSES, sigma=0.1, seed=2)
    assert torch.allclose(still.true_pixels[1], project_board(PINHOLE, MOVING_POSES[1], PAPER_BOARD)[0])
    assert torch.allclose(still.covariance[1, 3], 0.01 * torch.eye(2).double())
    assert float((still.pixels - still.true_pixels).square().mean().sqrt()) == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("holds", ["board", "camera"])
def test_blurred_pictures_are_taken_again(holds: str) -> None:
    fast = Hands(holds=holds, turning=(1.0, 1.0), exposure=(0.02, 0.02), most_blur=3.0)  # type: ignore[arg-type]
    moving = moving_capture(PINHOLE, MOVING_POSES, sigma=0.1, seed=4, hands=fast)
    assert 0.5 < float(moving.blur.norm(dim=-1).max()) <= 3.0
    assert moving.exposure == pytest.approx(0.02)
    assert 0.01 <= moving.readout <= 0.03


def test_bad_values_are_refused() -> None:
    with pytest.raises(InputError, match="readout"):
        Hands(readout=(0.03, 0.01))
    with pytest.raises(InputError, match="holds"):
        Hands(holds="tripod")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="most_blur"):
        Hands(most_blur=0.0)
    with pytest.raises(InputError, match="sigma"):
        moving_capture(PINHOLE, MOVING_POSES, sigma=-0.1, seed=1)
    with pytest.raises(InputError, match="0 poses"):
        moving_capture(PINHOLE, list[Pose](), sigma=0.1, seed=1)
