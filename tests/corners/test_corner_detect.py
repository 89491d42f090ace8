"""Detection: boards, parts of boards, the order of corners, and the filters that images go through."""

import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.optimize
import torch
from board_render import homography, render
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from kcal import Board, InputError, Observations, detect
from kcal.corners import detect_board
from kcal.corners.grid import (
    as_grid,
    first_square_dark,
    goes_on,
    grid_trouble,
    local_side,
)
from kcal.corners.images import read_gray
from kcal.corners.patches import filtered, gaussian_kernel
from kcal.corners.search import board_ends, canonical_order, find_sector

BOARD = Board(columns=9, rows=6, square=0.025)

SMALL = Board(columns=6, rows=5, square=0.02)


def scene(board, size, square, **options):
    return render(board, size, homography(board, size, square, (0.1, 0.05), 0.1, (0.3, 0.2)), **options)


def rms(pixels, truth):
    return float((pixels - truth).square().mean().sqrt())


@pytest.fixture(scope="module")
def stereo():
    folder = os.environ.get("KCAL_DATA")
    if not folder:
        pytest.skip("KCAL_DATA is not set: no real images")
    return sorted(Path(folder, "opencv_stereo").glob("*.jpg"))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    image, truth = scene(SMALL, (240, 200), 22, supersample=3)
    cv2.imwrite(f"{folder}/a.png", image)
    cv2.imwrite(f"{folder}/b.png", np.ascontiguousarray(image[::-1, ::-1]))
    return folder, image, truth


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "square"), [((240, 180), 8), ((320, 240), 24), ((1500, 1000), 100), ((2500, 1250), 35)]
)
def test_small_and_large_images(size, square):
    image, truth = scene(BOARD, size, square, blur=1.2, supersample=2)
    found = detect_board(image, BOARD)
    # Large images are searched small; what remains is the refinement's error at full size. A half-pixel slip of the
    # scales would leave 0.5 px in each coarse step, more than the refinement may move at 8 px squares.
    assert rms(found.pixels, truth) < 0.02


@pytest.mark.parametrize("refine", ["saddle", "opencv"])
def test_sixteen_bits_give_the_corners_of_eight(refine):
    H = homography(SMALL, (240, 200), 22, (0.1, 0.05), 0.1)
    eight, truth = render(SMALL, (240, 200), H, noise=2, supersample=3)
    one = detect_board(eight, SMALL, refine).pixels
    two = detect_board(eight.astype(np.uint16) * 257, SMALL, refine).pixels
    # The search sees a stretched image and starts elsewhere; cornerSubPix stops at steps of 1e-4 px, in float32.
    torch.testing.assert_close(one, two, rtol=0, atol=1e-4 if refine == "saddle" else 2e-3)
    assert rms(two, truth) < 0.03


def test_refinement_uses_all_sixteen_bits():
    H = homography(SMALL, (240, 200), 22, (0.1, 0.05), 0.1)
    dim, truth = render(SMALL, (240, 200), H, noise=0, supersample=6, dtype=np.float64)
    deep = np.rint(dim * 16).astype(np.uint16)  # 12 bits
    coarse = np.rint(dim / 12).astype(np.uint8)  # the same scene in 18 levels
    fine_error = rms(detect_board(deep, SMALL).pixels, truth)
    assert fine_error < 0.005
    assert rms(detect_board(coarse, SMALL).pixels, truth) > 2 * fine_error


def test_nothing_there():
    noise = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8), (0, 0), 2)
    found = detect_board(noise, BOARD)
    assert found.pixels is None
    assert found.reason == "no board of 9x6 inner corners found"


def test_a_part_of_the_board_is_not_the_board():
    image, _ = render(BOARD, (640, 480), homography(BOARD, (640, 480), 25, (0.2, 0.1), 0.1), supersample=2)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    assert cv2.findChessboardCorners(image, (8, 6), flags=flags)[0]  # OpenCV is content with a part
    found = detect_board(image, Board(columns=8, rows=6, square=0.025))
    assert found.pixels is None
    assert found.reason == "a board of 9x6 inner corners was found, not 8x6: give --board 9x6"


@pytest.mark.slow
@pytest.mark.parametrize(("columns", "rows"), [(8, 6), (7, 6), (5, 5)])
def test_a_part_of_a_real_board_is_not_the_board(stereo, columns, rows):
    part = Board(columns=columns, rows=rows, square=0.025)
    found = [detect_board(read_gray(path), part) for path in stereo[::6]]
    assert all(one.pixels is None for one in found)
    assert sum("9x6 inner corners was found" in one.reason for one in found) >= 2


def test_no_view_of_a_board_is_taken_for_a_small_board(stereo):
    """Asked for 5x4, a detector of OpenCV finds every other row of the 9x6 board in left05.jpg."""
    image = read_gray(next(path for path in stereo if path.name == "left05.jpg"))
    found = detect_board(image, Board(columns=5, rows=4, square=0.025))
    assert found.pixels is None
    assert re.match("a (board|grid) of 9x6 inner corners was found", found.reason)


@pytest.mark.parametrize(("dx", "dy", "radius"), [(3, 2, 5), (4, 0, 6), (5, 5, 8), (0, 0, 9)])
def test_covered_corner_becomes_unseen(dx, dy, radius):
    image, truth = scene(SMALL, (240, 200), 22, supersample=3)
    x, y = truth[8].round().int().tolist()
    assert not bool(detect_board(image, SMALL).pixels.isnan().any())
    cv2.circle(image, (x + dx, y + dy), radius, 128, -1)
    found = detect_board(image, SMALL)
    seen = torch.isfinite(found.pixels).all(-1)
    assert (~seen).nonzero().tolist() == [[8]]
    assert rms(found.pixels[seen], truth[seen]) < 0.02


def test_blur_is_refused_before_it_moves_the_corners():
    reasons = []
    for blur in (2.0, 4.0, 5.5, 7.0, 9.0):
        image, truth = scene(SMALL, (240, 200), 22, blur=blur, supersample=3)
        found = detect_board(image, SMALL)
        if found.pixels is None:
            reasons.append(found.reason)
        else:
            assert not reasons
            # At a blur of 4 px the saddle is flat: 0.1 px of the worst corner comes from noise.
            assert float((found.pixels - truth).abs().max()) < 0.15
    assert len(reasons) >= 3
    assert reasons[0].startswith("too blurred")


def test_bad_arguments():
    image = np.zeros((100, 100), np.uint8)
    with pytest.raises(InputError, match="at least 3"):
        detect_board(image, Board(columns=2, rows=5, square=1))
    with pytest.raises(InputError, match="uint8 or uint16"):
        detect_board(image.astype(np.int64), BOARD)
    with pytest.raises(InputError, match="uint8 or uint16"):
        detect_board(image[..., None], BOARD)
    with pytest.raises(InputError, match="choose one of"):
        detect_board(image, BOARD, "best")
    with pytest.raises(InputError, match="no images"):
        detect([], BOARD)


def test_detect_images_lists_views_and_failures(pictures, tmp_path):
    folder, image, truth = pictures
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "words.png").write_bytes(b"words")
    (tmp_path / "cut.jpg").write_bytes(cv2.imencode(".jpg", image)[1].tobytes()[:-200])
    cv2.imwrite(f"{tmp_path}/blank.png", np.random.default_rng(0).integers(200, 210, image.shape, dtype=np.uint8))
    done = []
    files = [folder / "a.png", *sorted(tmp_path.iterdir()), folder / "b.png"]
    seen = detect(files, SMALL, progress=done.append)
    assert seen.names == ("a.png", "b.png")
    assert done == [file.name for file in files]
    assert {failure.name: failure.reason for failure in seen.failures} == {
        "blank.png": "no board of 6x5 inner corners found",
        "cut.jpg": "the image is truncated or corrupt; copy it again or leave it out",
        "empty.png": "the file is empty; copy it again",
        "words.png": "not an image that can be read; use JPEG, PNG, TIFF, BMP, WebP or PGM",
    }
    assert seen.image_size == (240, 200)
    assert seen.views[0].image == str(folder / "a.png")
    assert rms(seen.pixels()[0], truth) < 0.02
    # b.png is a.png turned by 180 degrees: the same corners in the same order, at mirrored places.
    turned = torch.tensor([239.0, 199.0], dtype=torch.float64) - seen.pixels()[0]
    torch.testing.assert_close(seen.pixels()[1], turned, rtol=0, atol=1e-4)
    seen.save(tmp_path / "seen.obs.json")
    assert Observations.load(tmp_path / "seen.obs.json") == seen


def test_same_file_name_in_two_folders(pictures, tmp_path):
    folder, image, _ = pictures
    cv2.imwrite(f"{tmp_path}/a.png", image)
    seen = detect([folder / "a.png", tmp_path / "a.png"], SMALL)
    assert seen.names == (f"{folder.name}/a.png", f"{tmp_path.name}/a.png")


def test_two_sizes_name_the_images(pictures, tmp_path):
    folder, image, _ = pictures
    cv2.imwrite(f"{tmp_path}/odd.png", image[:-2])
    (tmp_path / "words.png").write_bytes(b"words")
    cv2.imwrite(f"{tmp_path}/odd.png", image[:-3])
    with pytest.warns(UserWarning, match="1 of 4 images were left out.*: odd.png"):
        seen = detect([folder / "a.png", tmp_path / "words.png", tmp_path / "odd.png", folder / "b.png"], SMALL)
    assert [failure.name for failure in seen.failures if failure.name != "b.png"] == ["words.png", "odd.png"]


def test_squares_counted_instead_of_corners(pictures):
    folder, _, _ = pictures
    with pytest.raises(InputError, match=r"no board in any of 1 images .*a board of 6x5 was found: count inner"):
        detect([folder / "a.png"], Board(columns=7, rows=6, square=0.02))


@pytest.mark.slow
def test_real_images_all_found_and_three_methods_agree(stereo):
    assert len(stereo) == 26
    ours, opencv, skimage = (detect(stereo, BOARD, refine) for refine in ("saddle", "opencv", "skimage"))
    assert len(ours.views) == len(opencv.views) == len(skimage.views) == 26
    pixels = ours.pixels()
    assert float(torch.isfinite(pixels).double().mean()) > 0.999
    assert all(view.sha256 and len(view.sha256) == 64 for view in ours.views)
    for other, limit in ((opencv, 0.13), (skimage, 0.16)):
        apart = (other.pixels() - pixels).norm(dim=-1)
        seen = torch.isfinite(apart)
        assert float(seen.double().mean()) > 0.99
        # What the methods make of JPEG blocks and blur; a slip of half a pixel or of an axis would be far more.
        assert float(apart[seen].square().mean().sqrt()) < limit


def test_detection_does_not_depend_on_what_was_called_before(stereo):
    # With 3x3 the second detector finds some part of the board, and which one depends on OpenCV's random numbers.
    part = Board(columns=3, rows=3, square=0.025)
    images = [read_gray(path) for path in stereo[::5]]

    def corners(seed):
        cv2.setRNGSeed(seed)
        return [find_sector(image, part) for image in images]

    for one, two in zip(corners(1), corners(2), strict=True):
        assert (one is None) == (two is None)
        assert one is None or bool((one == two).all())
    cv2.setRNGSeed(3)
    before = cv2.randu(np.zeros(4), 0.0, 1.0).tolist()
    cv2.setRNGSeed(3)
    find_sector(images[0], part)
    assert cv2.randu(np.zeros(4), 0.0, 1.0).tolist() == before  # the caller's random numbers are left alone


def test_a_board_near_a_fisheye(kcal_data):
    """Its corners are those of a flat board in OpenCV's fisheye."""
    board = Board(columns=8, rows=6, square=1.0)
    pixels = detect_board(read_gray(kcal_data / "captures" / "single" / "fisheye_8x6.jpg"), board).pixels.numpy()

    def misses(at):
        lens = np.array([[at[6], 0, at[7]], [0, at[6], at[8]], [0, 0, 1]])
        return (
            cv2.fisheye.projectPoints(board.points.numpy()[None], at[:3], at[3:6], lens, at[9:])[0][0] - pixels
        ).ravel()

    start = [0.25, -0.4, 0.0, -3.5, -2.0, 4.0, 340, 515.5, 388.5, 0, 0, 0, 0]
    fitted = scipy.optimize.least_squares(misses, np.array(start), x_scale="jac")
    assert np.sqrt(2 * np.square(fitted.fun).mean()) < 0.4


SIZE = (220, 220)


def orders(grid):
    """All orders of a grid of corners that a detector could return for its columns and rows."""
    turned = [grid, grid.flip(0), grid.flip(1), grid.flip(0, 1)]
    if grid.shape[0] == grid.shape[1]:
        turned += [order.transpose(0, 1) for order in turned]
    return [order.reshape(-1, 2) for order in turned]


def flat(board, degrees, square=16, dark_first=True):
    H = homography(board, SIZE, square, roll=np.radians(degrees))
    return render(board, SIZE, H, noise=1, supersample=2, dark_first=dark_first)


@pytest.mark.parametrize("degrees", range(0, 360, 30))
@pytest.mark.parametrize(("columns", "rows"), [(6, 5), (5, 6)])
def test_unambiguous_board_keeps_its_order_however_it_is_held(columns, rows, degrees):
    board = Board(columns=columns, rows=rows, square=0.02)
    image, truth = flat(board, degrees)
    for order in orders(truth.reshape(rows, columns, 2)):
        assert bool((canonical_order(image, order, board) == truth).all())


@pytest.mark.parametrize("degrees", [0, 25, 90, 155, 180, 270, 335])
def test_detected_corners_are_the_true_ones(degrees):
    board = Board(columns=6, rows=5, square=0.02)
    image, truth = flat(board, degrees)
    found = detect_board(image, board)
    # A wrong order would be off by whole squares; 0.05 px is five sigma of the refinement.
    assert float((found.pixels - truth).abs().max()) < 0.05


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.floats(-89, 89), st.sampled_from([(6, 4), (5, 3), (7, 5)]), st.booleans())
def test_ambiguous_board_is_read_upright(degrees, size, dark_first):
    board = Board(columns=size[0], rows=size[1], square=0.02)
    image, truth = flat(board, degrees, dark_first=dark_first)
    results = [canonical_order(image, order, board) for order in orders(truth.reshape(size[1], size[0], 2))]
    for result in results:
        assert bool((result == truth).all())
    upside_down, turned = flat(board, degrees + 180, dark_first=dark_first)
    result = canonical_order(upside_down, turned, board)
    assert bool((result == turned.flip(0)).all())


@pytest.mark.parametrize("count", [4, 5])
@pytest.mark.parametrize("degrees", [0, 20, 70, 90, 110, 180, 250, 290])
def test_square_boards(count, degrees):
    board = Board(columns=count, rows=count, square=0.02)
    image, truth = flat(board, degrees)
    results = [canonical_order(image, order, board) for order in orders(truth.reshape(count, count, 2))]
    for result in results:
        assert bool((result == results[0]).all())  # whatever the detector began with
    grid = as_grid(results[0], count, count)
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    assert float(across[0] * down[1] - across[1] * down[0]) > 0  # never mirrored
    lean = np.degrees(np.arctan2(float(across[1]), float(across[0])))
    if count % 2 == 0:  # all four corners look alike: nearest to upright
        assert abs(lean) <= 45 + 1e-6
    else:  # two of four have a dark outer square
        assert first_square_dark(image, results[0].reshape(count, count, 2))[0]
        assert abs(lean) <= 90 + 1e-6


def test_uneven_light_does_not_change_the_order():
    board = Board(columns=6, rows=5, square=0.02)
    image, truth = flat(board, 200)
    ramp = np.linspace(0.2, 1, SIZE[0])[None] * np.linspace(0.3, 1, SIZE[1])[:, None]
    dim = np.rint(image * ramp).astype(np.uint8)
    assert dim[:60, :60].max() < image.min() * 2  # its light squares are nearly as dark as dark ones elsewhere
    assert bool((canonical_order(dim, truth.flip(0), board) == truth).all())


def test_local_side():
    board = Board(columns=4, rows=3, square=0.02)
    points = board.points[:, :2] / board.square * torch.tensor([10.0, 7.0])
    assert local_side(points, 4, 3).tolist() == [7.0] * 12
    stretched = points.clone()
    stretched[points[:, 0] == 30, 0] = 36
    stretched[:, 1] *= 2
    assert local_side(stretched, 4, 3).tolist() == [10.0, 10.0, 10.0, 14.0] * 3
    with pytest.raises(InputError, match=r"shape \(12, 2\) is needed for 4x3"):
        local_side(points[:-1], 4, 3)


@pytest.mark.parametrize("degrees", [0, 40, 180])
@pytest.mark.parametrize("part", ["left", "right", "top", "bottom", "middle"])
def test_part_of_a_larger_board_is_refused(part, degrees):
    image, truth = flat(Board(columns=7, rows=6, square=0.02), degrees)
    cut = {
        "left": (slice(None), slice(0, 6)),
        "right": (slice(None), slice(1, 7)),
        "top": (slice(0, 5), slice(None)),
        "bottom": (slice(1, 6), slice(None)),
        "middle": (slice(1, 5), slice(1, 5)),
    }[part]
    grid = truth.reshape(6, 7, 2)[cut]
    rows, columns = grid.shape[:2]
    assert "go on beyond" in str(grid_trouble(image, grid.reshape(-1, 2), columns, rows))
    assert grid_trouble(image, truth, 7, 6) is None


@pytest.mark.parametrize("surround", [0, 40, 128, 215, 255])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.35, 0.2), (-0.3, 0.35)])
def test_the_whole_board_is_accepted_on_any_background(surround, tilt):
    board = Board(columns=7, rows=6, square=0.02)
    H = homography(board, SIZE, 18, tilt, 0.3)
    image, truth = render(board, SIZE, H, noise=3, supersample=2)
    outline = np.array([[-1, -1, 1], [7, -1, 1], [7, 6, 1], [-1, 6, 1]]) @ H.T
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    inside = np.ones(x.shape, bool)
    corners = outline[:, :2] / outline[:, 2:]
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, 0), strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0
    image[~inside] = surround
    assert not goes_on(image, truth.reshape(6, 7, 2))
    assert grid_trouble(image, truth, 7, 6) is None


def test_wrong_grids_are_refused_with_a_reason():
    image, truth = flat(Board(columns=6, rows=5, square=0.02), 15)
    grid = truth.reshape(5, 6, 2)

    def trouble(changed, picture=image):
        return str(grid_trouble(picture, changed.reshape(-1, 2), 6, 5))

    skipped = grid.clone()
    skipped[:, 3:] += grid[:, 4:5] - grid[:, 3:4]  # a column jumped over
    assert "uneven" in trouble(skipped)
    one_off = grid.clone()
    one_off[2, 2] += torch.tensor([6.0, -5.0])
    assert "uneven" in trouble(one_off)
    folded = grid.clone()
    folded[2] = grid[4]
    assert "folded" in trouble(folded)
    swapped = grid.clone()
    swapped[2, 2], swapped[2, 3] = grid[2, 3], grid[2, 2]
    assert "folded" in trouble(swapped)
    assert "dark and light" in trouble(grid, np.random.default_rng(0).integers(0, 255, image.shape, dtype=np.uint8))
    assert "move closer" in trouble(grid / 5)
    assert "finite" in trouble(grid * float("nan"))


def test_strong_barrel_distortion_is_no_reason_to_refuse():
    board = Board(columns=9, rows=7, square=0.02)
    plane = (board.points[:, :2] / board.square - torch.tensor([4.0, 3.0])) / 4
    radius = plane.norm(dim=-1, keepdim=True)
    bent = plane * (radius.clamp(min=1e-9) * 1.1).atan() / radius.clamp(min=1e-9) * 90 + 110
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    direction = np.stack([x - 110, y - 110], -1) / 90
    length = np.linalg.norm(direction, axis=-1, keepdims=True).clip(1e-9, 1.4)
    cell = np.floor(np.tan(length) / 1.1 / length * direction * 4 + np.array([4.0, 3.0])).astype(int)
    on_board = (cell >= -1).all(-1) & (cell[..., 0] < 9) & (cell[..., 1] < 7)
    image = np.where(on_board & (cell.sum(-1) % 2 == 0), 40, 215).astype(np.uint8)
    assert grid_trouble(image, bent, 9, 7) is None


# Gaussian kernels and filters of single images.


@pytest.mark.parametrize("sigma", [0.8, 1.5, 3.0])
def test_kernel_is_a_gaussian_of_its_sigma(sigma: float) -> None:
    reach = round(6 * sigma)
    kernel = gaussian_kernel(sigma, reach)
    offset = torch.arange(-reach, reach + 1, dtype=torch.float64)
    assert kernel.sum().item() == pytest.approx(1.0, rel=1e-14)
    # Whole pixels sample the narrowest to 2e-4.
    assert (kernel * offset**2).sum().item() == pytest.approx(sigma**2, rel=3e-4)
    assert torch.equal(kernel, kernel.flip(0))


def test_filtering_is_that_of_scipy() -> None:
    """Along rows with one kernel and down columns with another; edges repeat."""
    image = torch.rand(20, 31, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    across, down = torch.tensor([1.0, 2.0, 4.0]).double(), torch.tensor([-1.0, 0.5, 3.0]).double()
    expected = ndimage.correlate1d(image.numpy(), across.numpy(), axis=1, mode="nearest")
    expected = ndimage.correlate1d(expected, down.numpy(), axis=0, mode="nearest")
    torch.testing.assert_close(filtered(image, across, down), torch.from_numpy(expected), rtol=1e-13, atol=1e-13)


# Parts of boards, boards of another size, and pictures that cameras sharpened.


PART_SIZE = (480, 360)


def picture(board=BOARD, shift=(0.0, 0.0), **options):
    H = homography(board, PART_SIZE, 30, (0.1, 0.05), 0.08, shift)
    return render(board, PART_SIZE, H, supersample=2, **options)


def part_rms(pixels, truth):
    seen = torch.isfinite(pixels).all(-1)
    return float((pixels - truth)[seen].square().mean().sqrt())


@pytest.mark.parametrize("shift", [(140, 0), (-150, 0), (0, 120), (0, -115)])
def test_a_board_cut_by_the_image_keeps_its_numbers(shift):
    image, truth = picture(shift=shift)
    found = detect_board(image, BOARD)
    assert 20 <= int(torch.isfinite(found.pixels).all(-1).sum()) < 54
    # A part one column off would be wrong by a square of 30 px.
    assert part_rms(found.pixels, truth) < 0.03


def test_glare_leaves_out_corners_only():
    image, truth = picture()
    y, x = np.mgrid[: PART_SIZE[1], : PART_SIZE[0]]
    u, v = truth[22].tolist()
    spot = 500 * np.exp(-0.5 * (((x - u) / 22) ** 2 + ((y - v) / 18) ** 2))
    found = detect_board(np.clip(image + spot, 0, 255).astype(np.uint8), BOARD)
    assert 30 <= int(torch.isfinite(found.pixels).all(-1).sum()) < 54
    assert bool(found.pixels[22].isnan().all())
    assert float((found.pixels - truth).norm(dim=-1).nan_to_num().max()) < 1.0


def test_an_uncertain_part_is_refused_with_its_side():
    # Left and right are both outside: which 6 or so of the 9 columns these are cannot be known.
    image, _ = picture()
    found = detect_board(np.ascontiguousarray(image[:, 150:330]), BOARD)
    assert found.pixels is None
    assert "cut by the image's edge at the" in found.reason
    assert "left" in found.reason
    assert "right" in found.reason
    assert found.rejected is not None
    assert len(found.rejected) >= 12


def test_the_edge_of_a_cover_is_not_the_end_of_the_board():
    """A gray sheet hides the last columns along a line of the board, and the first ones are outside the image."""
    image, truth = render(BOARD, PART_SIZE, homography(BOARD, PART_SIZE, 30, shift=(-165, 0)), supersample=2)
    image[:, round(float(truth[6, 0])) + 30 :] = 120
    grid = truth.reshape(6, 9, 2)[:, 3:7]
    assert board_ends(image, grid)[3]
    assert not board_ends(image, grid, paper=True)[3]
    assert detect_board(image, BOARD).pixels is None


def test_sharpened_edges_lose_no_corners():
    light, truth = picture(blur=0.3, noise=0, dtype=np.float64)
    image = np.clip(40 + 0.5 * (light + 1.5 * (light - cv2.GaussianBlur(light, (0, 0), 1.2))), 0, 255)
    packed = cv2.imencode(".jpg", np.rint(image).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
    found = detect_board(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), BOARD)
    assert int(torch.isfinite(found.pixels).all(-1).sum()) == 54
    assert part_rms(found.pixels, truth) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "columns", "rows"), [("pi640", 7, 7), ("gloworm960", 8, 6)])
def test_real_boards_are_all_found(folder, columns, rows):
    data = os.environ.get("KCAL_DATA")
    if not data:
        pytest.skip("KCAL_DATA is not set: no real images")
    paths = sorted(Path(data, "captures", folder).glob("*.jpg"))
    board = Board(columns=columns, rows=rows, square=0.025)
    found = [detect_board(read_gray(path), board).pixels for path in paths]
    assert len(found) == 25
    assert all(one is not None and bool(torch.isfinite(one).all()) for one in found)
