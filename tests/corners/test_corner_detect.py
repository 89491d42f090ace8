import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.optimize
import torch
from board_render import homography, render

from kcal.corners.board import Board
from kcal.corners.detect import detect, detect_board
from kcal.corners.images import read_gray
from kcal.corners.observations import Observations
from kcal.corners.search import find_sector
from kcal.errors import InputError

BOARD = Board(columns=9, rows=6, square=0.025)
SMALL = Board(columns=6, rows=5, square=0.02)


def scene(board, size, square, **options):
    H = homography(board, size, square, (0.1, 0.05), 0.1, (0.3, 0.2))
    return render(board, size, H, **options)


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
    H = homography(BOARD, (640, 480), 25, (0.2, 0.1), 0.1)
    image, _ = render(BOARD, (640, 480), H, supersample=2)
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


def test_another_size_is_told(tmp_path):
    H = homography(BOARD, (640, 480), 25, (0.2, 0.1), 0.1)
    image, _ = render(BOARD, (640, 480), H, supersample=2)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    with pytest.raises(InputError, match="a board of 9x6 was found: give --board 9x6"):
        detect([tmp_path / "a.png"], Board(columns=8, rows=6, square=0.025))


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


@pytest.mark.slow
def test_real_calibration_reaches_the_known_residual(stereo):
    for side in ("left", "right"):
        seen = detect([path for path in stereo if path.name.startswith(side)], BOARD)
        views = [p.numpy().astype(np.float32) for p in seen.pixels()]
        good = [np.isfinite(view).all(-1) for view in views]
        points = BOARD.points.numpy().astype(np.float32)
        result = cv2.calibrateCamera(
            [points[keep] for keep in good],
            [view[keep] for view, keep in zip(views, good, strict=True)],
            seen.image_size,
            None,
            None,
            criteria=(3, 300, 1e-12),
        )
        # 0.165 left and 0.163 right; cornerSubPix with a half-window of 11 leaves 0.41 and 0.46.
        assert result[0] < 0.17


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
