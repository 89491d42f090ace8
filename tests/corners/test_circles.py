import cv2
import numpy as np
import pytest
import torch

from kcal import Board, Camera, InputError, detect
from kcal.corners import CornerStatus, detect_board
from kcal.corners.circles import (
    _with_statuses,
    center_shift,
    circle_order,
    find_circles,
    fit_ellipses,
    homography,
    local_maps,
    refine_circles,
)
from scripts.shared.printed_board import Paper, errors, pose

CAMERA = Camera.build(focal=(430, 430), center=(243, 177), size=(480, 360), coefficients=[-0.1, 0.02])
ASYMMETRIC = Board.parse("asymmetric:4x11", "20mm")
CIRCLES = Board.parse("circles:8x6", "22mm")
TILTS = ([0.0, 0.0, 0.0], [0.6, 0.0, 0.2], [-0.3, 0.5, 0.4], [0.1, -0.8, 0.0])


@pytest.fixture(scope="module")
def papers():
    return {board: Paper(board, cell_mm=0.25) for board in (ASYMMETRIC, CIRCLES)}


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize(("board", "distance"), [(ASYMMETRIC, 0.42), (CIRCLES, 0.3)])
def test_centers_of_tilted_boards(papers, board, distance, tilt):
    image, truth = papers[board].shoot(CAMERA, *pose(board, tilt, distance))
    found = detect_board(image, board)
    rms, most, count = errors(found.pixels, truth)
    assert count == board.corners
    # 0.005 px is what noise of 1 % of the contrast leaves.
    assert rms < 0.01
    assert most < 0.03
    miss = found.pixels - truth
    chi2 = torch.einsum("ni,nij,nj->n", miss, torch.linalg.inv(found.covariance), miss).mean() / 2
    # Covariances describe these errors: the mean of 88 or 96 squares of normal numbers is within 0.6 to 1.6.
    assert 0.5 < float(chi2) < 2.0


@pytest.mark.parametrize(("board", "distance"), [(ASYMMETRIC, 0.42), (CIRCLES, 0.3)])
def test_the_center_of_the_ellipse_is_not_the_center_of_the_circle(papers, board, distance, monkeypatch):
    """What the correction is worth where the board is tilted by 45 degrees: measured, beside OpenCV's centers."""
    image, truth = papers[board].shoot(CAMERA, *pose(board, [0.8, 0.0, 0.0], distance))
    found, radius = find_circles(image, board)
    corrected, _ = refine_circles(image, found, board, radius)
    monkeypatch.setattr("kcal.corners.circles.center_shift", lambda maps, radius: torch.zeros(board.corners, 2))
    ellipses, _ = refine_circles(image, found, board, radius)
    opencv, plain, right = (errors(pixels, truth)[0] for pixels in (found, ellipses.pixels, corrected.pixels))
    assert right < 0.01
    assert plain > 0.04  # 0.05 to 0.1 px, all in the direction in which the board falls away
    assert opencv > plain
    bias = (ellipses.pixels - truth).mean(0)
    assert abs(float(bias[1])) > 0.9 * float(bias.norm()) > 0.035


def test_shift_of_a_projected_conic():
    """The center of the ellipse by the conic's matrix, and kcal's shift from derivatives: alike to third order."""
    h = torch.tensor([[800.0, 20.0, 100.0], [-30.0, 700.0, 120.0], [0.9, -1.4, 1.0]], dtype=torch.float64)
    axis = torch.linspace(0, 0.1, 5, dtype=torch.float64)
    points, radius = torch.cartesian_prod(axis, axis), 0.008
    there = torch.nn.functional.pad(points, (0, 1), value=1.0) @ h.T
    pixels = there[:, :2] / there[:, 2:]
    assert torch.allclose(homography(points, pixels), h, atol=1e-8)
    shift = center_shift(local_maps(points, pixels), radius)
    back = torch.linalg.inv(h)
    for point, pixel, own in zip(points, pixels, shift, strict=True):
        conic = torch.eye(3, dtype=torch.float64)
        conic[:2, 2] = conic[2, :2] = -point
        conic[2, 2] = point @ point - radius**2
        image = back.T @ conic @ back
        center = -torch.linalg.solve(image[:2, :2], image[:2, 2])
        assert torch.allclose(own, center - pixel, rtol=0.01, atol=1e-5)


def test_shift_that_a_lens_makes():
    """Without any tilt, distortion alone moves the centers: a ring of points shows by how much."""
    lens = Camera.build(focal=(400, 400), center=(240, 180), size=(480, 360), coefficients=[-0.25, 0.05])
    board = Board.parse("circles:9x7:20mm", "30mm")
    rotation, translation = pose(board, [0.0, 0.0, 0.0], 0.28)
    pixels = lens.project(board.points @ rotation.T + translation)[0]
    shift = center_shift(local_maps(board.points[:, :2], pixels), 0.01)
    angle = torch.arange(0, 2 * torch.pi, 0.01, dtype=torch.float64)
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1) * 0.01
    for point, pixel, own in zip(board.points, pixels, shift, strict=True):
        edge = lens.project((point + ring) @ rotation.T + translation)[0].numpy().astype(np.float32)
        (u, v), _, _ = cv2.fitEllipseDirect(edge)
        assert (u - float(pixel[0]), v - float(pixel[1])) == pytest.approx(own.tolist(), abs=0.01)
    assert float(shift.norm(dim=-1).max()) > 0.1


def test_diameter_is_measured_or_checked(papers):
    image, truth = papers[CIRCLES].shoot(CAMERA, *pose(CIRCLES, [0.5, 0.2, 0.1], 0.32))
    found, about = find_circles(image, CIRCLES)
    _, radius = refine_circles(image, found, CIRCLES, about)
    assert radius == pytest.approx(0.0055, rel=0.01)
    assert errors(detect_board(image, Board.parse("circles:8x6:11mm", "22mm")).pixels, truth)[0] < 0.01
    wrong = detect_board(image, Board.parse("circles:8x6:15mm", "22mm"))
    assert wrong.pixels is None
    assert "the circles are 10.9 mm wide where their distance is 22 mm, the board's are 15 mm" in wrong.reason


def test_light_circles_on_dark(papers):
    image, truth = papers[ASYMMETRIC].shoot(CAMERA, *pose(ASYMMETRIC, [0.3, 0.3, 0.0], 0.42))
    assert errors(detect_board(255 - image, ASYMMETRIC).pixels, truth)[0] < 0.01


def test_sixteen_bits(papers):
    image, truth = papers[ASYMMETRIC].shoot(CAMERA, *pose(ASYMMETRIC, [0.3, 0.3, 0.0], 0.42))
    assert errors(detect_board(image.astype(np.uint16) * 257, ASYMMETRIC).pixels, truth)[0] < 0.01


@pytest.mark.parametrize("roll", [0.3, 1.9, 3.0, -1.4])
def test_asymmetric_circles_are_read_from_one_end(papers, roll):
    image, truth = papers[ASYMMETRIC].shoot(CAMERA, *pose(ASYMMETRIC, [0.2, 0.1, roll], 0.5))
    assert errors(detect_board(image, ASYMMETRIC).pixels, truth)[1] < 0.05


def test_order():
    """Of eight orders of equal rows and columns, one upright; a mirrored one is never given."""
    board = Board.parse("circles:4x4", "10mm")
    grid = (board.points[:, :2] * 3000 + 50).reshape(4, 4, 2)
    for turn in range(4):
        for flip in (False, True):
            given = torch.rot90(grid, turn)
            given = given.flip(0) if flip else given
            assert torch.equal(circle_order(given.reshape(-1, 2), board), grid.reshape(-1, 2))
    lattice = ASYMMETRIC.points[:, :2] * 3000
    assert torch.equal(circle_order(lattice.flip(0), ASYMMETRIC), lattice)
    turned = lattice.flip(0) @ -torch.eye(2, dtype=torch.float64)  # by half a turn: the other end, told apart
    assert torch.equal(circle_order(turned, ASYMMETRIC), -lattice)


def test_covered_circle_becomes_unseen(papers):
    image, truth = papers[CIRCLES].shoot(CAMERA, *pose(CIRCLES, [0.2, 0.1, 0.0], 0.32))
    u, v = truth[20].round().int().tolist()
    image[v - 1 : v + 9, u - 9 : u + 9] = 125  # the lower half of one circle
    found = detect_board(image, CIRCLES)
    if found.pixels is not None:
        assert not bool(torch.isfinite(found.pixels[20]).any())
        assert errors(found.pixels, truth)[1] < 0.05


def test_a_part_of_the_board_is_not_the_board(papers):
    image, _ = papers[CIRCLES].shoot(CAMERA, *pose(CIRCLES, [0.2, 0.1, 0.0], 0.32))
    for text in ("circles:8x5", "circles:7x6"):
        assert detect_board(image, Board.parse(text, "22mm")).pixels is None, text


def test_wrong_target_says_what_was_seen(papers, tmp_path):
    image, _ = papers[ASYMMETRIC].shoot(CAMERA, *pose(ASYMMETRIC, [0.2, 0.1, 0.0], 0.42))
    path = str(tmp_path / "a.png")
    cv2.imwrite(path, image)
    with pytest.raises(InputError, match=r"some 44 circles were found, the board has 48: .*asymmetric"):
        detect([path], CIRCLES)
    with pytest.raises(InputError, match=r"44 circles were found: give --board circles:COLUMNSxROWS or asymmetric"):
        detect([path], Board.parse("9x6", "25mm"))


def test_refinements_for_corners_are_refused(papers):
    image, truth = papers[CIRCLES].shoot(CAMERA, *pose(CIRCLES, [0.0, 0.0, 0.0], 0.32))
    with pytest.raises(InputError, match="circles are fitted at their edges"):
        detect_board(image, CIRCLES, "saddle")
    plain = detect_board(image, CIRCLES, "none")
    assert plain.covariance is None
    assert errors(plain.pixels, truth)[0] < 0.5
    with pytest.raises(InputError, match="at least 3 circles"):
        detect_board(image, Board.parse("circles:2x6", "25mm"))


def test_ellipses_beside_each_other_do_not_matter():
    """Half the distance of two circles is used at most; blur of 1.5 px and a ramp of light as well."""
    v, u = (np.mgrid[:640, :960] + 0.5) / 8 - 0.5
    fine = 200 + 0.3 * u
    for center in (30.3, 60.4, 90.5):
        fine = fine - 150 * (np.hypot(u - center, v - 40.2) < 11)
    image = cv2.GaussianBlur(fine, (0, 0), 12).reshape(80, 8, 120, 8).mean((1, 3))
    found = fit_ellipses(
        image,
        torch.tensor([[61.0, 39.0]], dtype=torch.float64),
        torch.eye(2, dtype=torch.float64)[None] / 10,
        torch.tensor([1.6], dtype=torch.float64),
    )
    assert found.center[0].tolist() == pytest.approx([60.4, 40.2], abs=0.05)
    assert bool(found.converged[0])


@pytest.mark.parametrize(("known", "corrected"), [(6, True), (5, False)])
def test_circles_that_tell_how_others_are_shifted(known, corrected, monkeypatch):
    """Six good circles tell the homography that moves ellipses' centers to those of the circles; five do not."""
    board = Board.parse("circles:4x3", "30mm")
    lens = Camera.build(focal=(200, 200), center=(100, 75), size=(200, 150), model="pinhole")
    image, _ = Paper(board, cell_mm=0.5).shoot(lens, *pose(board, [0.7, 0.0, 0.0], 0.2))
    found, radius = find_circles(image, board)

    def some_good(*arguments):
        refined = _with_statuses(*arguments)
        status = torch.full_like(refined.status, int(CornerStatus.OCCLUDED))
        status[[0, 3, 5, 6, 8, 11][:known]] = int(CornerStatus.GOOD)
        return refined._replace(status=status, pixels=arguments[2].center)

    monkeypatch.setattr("kcal.corners.circles._with_statuses", some_good)
    moved, _ = refine_circles(image, found, board, radius)
    monkeypatch.setattr("kcal.corners.circles.center_shift", lambda maps, radius: torch.zeros(board.corners, 2))
    centers, _ = refine_circles(image, found, board, radius)
    assert (float((moved.pixels - centers.pixels).abs().max()) > 0.01) is corrected
