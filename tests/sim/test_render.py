import math
from dataclasses import replace

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.sim.captures import BoardPose, BoardSize, PrintedBoard, board_points, project_board
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.scene import RenderOptions, invert_window, render_board, render_light
from kcal.sim.truth import PixelRectangle, TruthLens, pixel_axes

BOARD = BoardSize(9, 6, 0.06)
CLEAN = RenderOptions(noise=0, vignetting=0, blur=1.0)
# Barrel distortion of 130 px in the corners, tangential and prism terms.
LENS = [-0.20, 0.055, 4e-4, -3e-4, 0.0, 0.10, 0.012, 0.0, 3e-4, 0.0, -2e-4, 0.0]


def camera_of(coefficients=(), size=(1280, 720), focal=1067.0, model="opencv12"):
    center = ((size[0] - 1) / 2 + 3.3, (size[1] - 1) / 2 - 2.6)
    return Camera.build(focal=(focal, focal - 1.2), center=center, size=size, coefficients=coefficients, model=model)


def pose_of(vector, middle, board=BOARD):
    rotation = rotation_from_vector(torch.tensor(vector, dtype=torch.float64))
    points = board_points(board)
    return BoardPose(rotation, torch.tensor(middle, dtype=torch.float64) - rotation @ points.mean(0))


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
    design = torch.stack([x**i * y**j for i, j in powers], -1)
    inverse = torch.linalg.pinv(design)
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
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    exact, valid_exact = camera.normalize(pixels.reshape(-1, 2))
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
    outside = pose_of((0, 0, 0), (5.0, 0.0, 1.0))
    assert int(render_board(small, outside, BOARD, options).max()) == 0


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
