import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.cli.main import app
from kcal.corners.board import Board
from kcal.corners.detect import detect_board, view_of
from kcal.corners.images import read_gray
from kcal.corners.marker_boards import free_side
from kcal.corners.markers import marker_cells
from kcal.corners.observations import Observations
from kcal.corners.print_board import board_sheet
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector

BOARD = Board.parse("charuco:9x6", "25mm")
FINE = 8  # printed pixels a millimeter


@pytest.fixture(scope="module")
def paper():
    """The printed page, FINE pixels a millimeter, 1 white; and where corner 0 is, in millimeters."""
    drawing = board_sheet(BOARD, "A4").drawing
    page = np.ones((round(drawing.height * FINE), round(drawing.width * FINE)), np.float32)
    for r in drawing.rectangles:
        page[round(r.y * FINE) : round((r.y + r.height) * FINE), round(r.x * FINE) : round((r.x + r.width) * FINE)] = 0
    first = drawing.rectangles[0]
    return torch.from_numpy(page), torch.tensor([first.x + 25, first.y + 25], dtype=torch.float64)


def shoot(paper, camera, rotation, translation, seed=0):
    """A photograph of the page: 2x2 samples a pixel of the blurred page, then noise; and the true corners."""
    page, origin = paper
    width, height = camera.size
    page = torch.nn.functional.avg_pool2d(page[None, None], 4)  # a quarter of the print's resolution: 2 px a mm
    scale = FINE / 4
    light = torch.zeros(height, width, dtype=torch.float64)
    for dy in (-0.25, 0.25):
        for dx in (-0.25, 0.25):
            pixels = camera.grid(width, height) + torch.tensor([dx, dy], dtype=torch.float64)
            rays = camera.unproject(pixels)[0] @ rotation  # into the board's frame
            center = -rotation.T @ translation
            hit = center + rays * (-center[2] / rays[..., 2])[..., None]
            where = (1000 * hit[..., :2] + origin) * scale - 0.5
            size = torch.tensor([page.shape[-1] - 1.0, page.shape[-2] - 1.0], dtype=torch.float64)
            sample = torch.nn.functional.grid_sample(
                page.double(), (2 * where / size - 1)[None], align_corners=True, padding_mode="zeros"
            )
            light += sample[0, 0] / 4
    noise = torch.randn(light.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    image = (40 + 170 * light + 1.5 * noise).round().clamp(0, 255).to(torch.uint8).numpy()
    points = BOARD.points @ rotation.T + translation
    return image, camera.project(points)[0]


FINE_CAMERA = Camera.build(focal=(1400, 1400), center=(600, 450), size=(1200, 900))
CAMERA = Camera.build(focal=(560, 560), center=(241, 178), size=(480, 360), coefficients=[-0.1, 0.02])


def pose(tilt, shift, distance=0.36):
    rotation = rotation_from_vector(torch.tensor(tilt, dtype=torch.float64))
    middle = BOARD.points.mean(0)
    place = torch.tensor([*shift, distance], dtype=torch.float64)
    return rotation, place - rotation @ middle


class TestBoard:
    def test_syntax(self):
        assert (BOARD.columns, BOARD.rows, BOARD.dictionary) == (9, 6, "4x4_50")
        assert BOARD.marker == pytest.approx(0.0175, abs=1e-15)
        other = Board.parse("charuco:5x4:DICT_6X6_250:3cm", "40mm")
        assert (other.dictionary, other.marker, other.square) == ("6x6_250", 0.03, 0.04)
        assert str(other) == "5x4 inner corners, 40 mm squares, 30 mm markers 6x6_250"
        assert Board.parse("charuco:7x5", "1cm").unambiguous
        assert not Board.parse("7x5", "1cm").unambiguous

    @pytest.mark.parametrize(
        ("size", "message"),
        [
            ("charuco:9", "COLUMNSxROWS"),
            ("charuco:9x6:best", "choose one of"),
            ("charuco:9x6:4x4_50:30mm", "smaller than its square"),
            ("charuco:9x6:4x4_50:30", "with its unit"),
            ("charuco:20x20", "markers, dictionary 4x4_50 fewer"),
            ("charuco:9x6:4x4_50:9mm:x", "charuco:COLUMNSxROWS"),
        ],
    )
    def test_refusals(self, size, message):
        with pytest.raises(InputError, match=message) as caught:
            Board.parse(size, "25mm")
        assert "\n" not in str(caught.value)

    def test_half_a_description_is_refused(self):
        with pytest.raises(InputError, match="neither"):
            Board(columns=4, rows=3, square=0.1, marker=0.05)

    def test_markers_have_a_black_border(self):
        cells = marker_cells(BOARD)
        assert len(cells) == 35
        assert all(cell.shape == (6, 6) and cell[0].all() and cell[:, -1].all() for cell in cells)
        assert len({cell.tobytes() for cell in cells}) == 35
        with pytest.raises(InputError, match="not a ChArUco"):
            marker_cells(Board(columns=4, rows=3, square=0.1))


class TestDetection:
    def test_printed_board_is_found_in_order(self, paper):
        image, truth = shoot(paper, CAMERA, *pose([0.2, -0.15, 0.1], [0.0, 0.0], 0.4))
        found = detect_board(image, BOARD)
        error = found.pixels - truth
        assert bool(torch.isfinite(error).all())
        # 0.03: a window of 6 px, and the page is drawn on a grid of half a millimeter.
        assert float(error.square().mean().sqrt()) < 0.03
        assert found.covariance is not None

    def test_upside_down(self, paper):
        image, truth = shoot(paper, CAMERA, *pose([0.1, 0.05, 3.1], [0.0, 0.0], 0.4))
        assert float((detect_board(image, BOARD).pixels - truth).abs().nan_to_num().max()) < 0.2

    def test_a_board_printed_white_on_black(self, paper):
        image, _ = shoot(paper, CAMERA, *pose([0.2, -0.15, 0.1], [0.0, 0.0], 0.4))
        pixels, inverted = (detect_board(each, BOARD).pixels for each in (image, 255 - image))
        assert float((inverted - pixels).abs().max()) < 0.05

    @pytest.mark.parametrize("tilt", [[1.25, 0.0, 0.0], [0.75, 1.0, 0.0]])
    def test_a_board_seen_at_seventy_degrees(self, tilt, paper):
        image, truth = shoot(paper, FINE_CAMERA, *pose(tilt, [0.0, 0.0], 0.3))
        found = detect_board(image, BOARD).pixels
        seen = torch.isfinite(found).all(-1)
        assert int(seen.sum()) >= 20
        assert float((found - truth)[seen].square().mean().sqrt()) < 0.06

    def test_another_number_of_columns_is_no_board(self, paper):
        """Half of the markers lie as on a board of other columns: rows of markers are parallel on both."""
        image, _ = shoot(paper, CAMERA, *pose([0.2, -0.15, 0.1], [0.0, 0.0], 0.4))
        for size in ("charuco:6x9", "charuco:8x6", "charuco:10x6"):
            assert detect_board(image, Board.parse(size, "25mm")).reason.startswith("the markers do not lie as on this")

    @pytest.mark.parametrize(
        ("name", "size", "square", "corners"),
        [
            ("captures/single/inverted_charuco.png", "charuco:3x4:4x4_1000:40.5mm", "54mm", 12),
            ("field/charuco/v2.png", "charuco:16x10:5x5_100:4mm", "8mm", 120),
        ],
    )
    def test_boards_of_strangers(self, name, size, square, corners, kcal_data):
        board = Board.parse(size, square)
        pixels = detect_board(read_gray(kcal_data / name), board).pixels
        seen = torch.isfinite(pixels).all(-1).numpy()
        assert seen.sum() >= corners
        places, pixels = board.points[:, :2].numpy()[seen], pixels.numpy()[seen]
        plane = cv2.perspectiveTransform(places[None], cv2.findHomography(places, pixels)[0])[0]
        # A wide lens bends the first one by 2 px.
        assert np.abs(plane - pixels).max() < (0.12 if corners > 12 else 2.5)

    def test_a_part_at_the_border_is_enough(self, paper):
        image, truth = shoot(paper, CAMERA, *pose([0.1, -0.2, 0.0], [0.12, 0.08], 0.4))
        found = detect_board(image, BOARD)
        seen = torch.isfinite(found.pixels).all(-1)
        assert 8 <= int(seen.sum()) <= 40
        assert float((found.pixels - truth)[seen].square().mean().sqrt()) < 0.03
        view = view_of(found, "a")
        assert [pixel is None for pixel in view.pixels] == [spread is None for spread in view.covariance]

    def test_partial_views_calibrate(self, paper):
        tilts = [[0.4, 0.1, 0.0], [-0.4, 0.0, 0.1], [0.1, 0.45, 0.0], [0.0, -0.4, -0.1], [0.3, 0.3, 0.2]]
        shifts = [[0.1, 0.06], [-0.1, 0.05], [0.08, -0.06], [-0.09, -0.05], [0.0, 0.0]]
        views = []
        for i, (tilt, shift) in enumerate(zip(tilts, shifts, strict=True)):
            image, _ = shoot(paper, CAMERA, *pose(tilt, shift), seed=i)
            views.append(view_of(detect_board(image, BOARD), f"{i}"))
        assert any(None in view.pixels for view in views)
        result = calibrate_camera(Observations(board=BOARD, image_size=(480, 360), views=tuple(views)))
        assert result.rms < 0.06
        assert float(result.camera.focal[0]) == pytest.approx(560, abs=4)

    def test_nothing_and_too_little(self, paper):
        image, _ = shoot(paper, CAMERA, *pose([0.0, 0.0, 0.0], [0.0, 0.0], 0.4))
        assert "fewer than 6 corners" in detect_board(np.full_like(image, 200), BOARD).reason
        image[:, 90:] = 200
        assert detect_board(image, BOARD).pixels is None

    def test_window_ends_before_the_marker(self):
        pixels = BOARD.points[:, :2] * 1000
        side = free_side(pixels, BOARD)
        # From the corner to the marker's own corner: 3.75 mm along each axis.
        assert float(side[0]) * 0.5 < 3.75 * np.sqrt(2)
        assert float(side[0]) * 0.5 > 0.7 * 3.75 * np.sqrt(2)


def test_commands(paper, tmp_path):
    import cv2

    image, _ = shoot(paper, CAMERA, *pose([0.2, -0.15, 0.1], [0.0, 0.0], 0.4))
    cv2.imwrite(str(tmp_path / "a.png"), image)
    run = CliRunner()
    output = tmp_path / "a.obs.json"
    what = ["--board", "charuco:9x6", "--square", "25mm", "-o"]
    result = run.invoke(app, ["detect", str(tmp_path / "a.png"), *what, str(output)])
    assert result.exit_code == 0
    assert Observations.load(output).board == BOARD
    result = run.invoke(app, ["board", *what, str(tmp_path / "b.pdf"), "--page", "A4"])
    assert result.exit_code == 0
    assert b"charuco:9x6:4x4_50:17.5mm" in (tmp_path / "b.pdf").read_bytes()
