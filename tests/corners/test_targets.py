"""What boards are, and files of corners: kcal's own and those of other programs."""

import json
import math
import re
from math import nan
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from opencv_files import file_storage
from scipy.io import savemat

from kcal import FileError, InputError, Observations, View
from kcal.corners.board import DICTIONARIES, Board
from kcal.corners.detect import Detection, view_of
from kcal.corners.foreign_corners import import_corners
from kcal.corners.markers import opencv_dictionary
from kcal.corners.print_board import Circle, Drawing, board_sheet, pattern_shapes, tag_cells, to_pdf, to_svg
from kcal.io.formats import import_cameras
from kcal.lens.calibration import BoardRecord

# What boards are: texts, target files of Kalibr, where their points lie, and what files keep of them.


def test_texts():
    circles = Board.parse("circles:7x6:12mm", "25mm")
    assert (circles.pattern, circles.columns, circles.rows, circles.diameter) == ("circles", 7, 6, 0.012)
    assert str(circles) == "7x6 circles, 25 mm apart, 12 mm wide"
    assert Board.parse("asymmetric:4x11", "20mm").pattern == "asymmetric"
    april = Board.parse("aprilgrid:6x5:0.25:id36", "88mm")
    assert (april.columns, april.rows, april.markers, april.first) == (12, 10, 30, 36)
    assert april.gap == pytest.approx(0.022, abs=1e-15)
    assert april == Board.parse("aprilgrid:6x5:id36:22mm", "88mm")
    assert str(april) == "6x5 tags of 88 mm, 22 mm apart from number 36"
    charuco = Board.parse("charuco:9x6:5x5_100:id40", "25mm")
    assert (charuco.dictionary, charuco.marker, charuco.first) == ("5x5_100", 0.7 * 0.025, 40)
    assert Board.parse("charuco:9x6:id10:15mm", "25mm").marker == 0.015


@pytest.mark.parametrize(
    ("text", "square", "message"),
    [
        ("hexagons:7x6", "25mm", "'hexagons' is no kind of board; choose one of charuco, circles"),
        ("circles:7x6:30mm", "25mm", "smaller than the distance"),
        ("circles:7x6:12", "25mm", "diameter '12': write a length with its unit"),
        ("circles:7x6:12mm:3", "25mm", r"write circles:COLUMNSxROWS\[:DIAMETER\]"),
        ("asymmetric:4", "25mm", "write asymmetric:COLUMNSxROWS"),
        ("aprilgrid:6x6:0.3:0.4", "88mm", "write aprilgrid:TAGSxTAGS"),
        ("aprilgrid:6x6:1.2", "88mm", "gap between tags must not exceed"),
        ("aprilgrid:300x6", "88mm", "1 to 250 tags each way"),
        ("aprilgrid:6x6:id560", "88mm", "36 markers from number 560 on, dictionary apriltag_36h11 fewer"),
        ("charuco:9x6:id20", "25mm", "35 markers from number 20 on, dictionary 4x4_50 fewer"),
        ("9x6:id3", "25mm", "is no kind of board"),
        ("9x6", None, "give the side of its squares as well"),
        ("asymmetric:4x11", None, "give the distance of its rows of circles as well"),
    ],
)
def test_refused_texts(text, square, message):
    with pytest.raises(InputError, match=message) as caught:
        Board.parse(text, square)
    assert "\n" not in str(caught.value)


def test_aprilgrid_has_the_points_of_kalibr():
    """Its class GridCalibrationTargetAprilgrid: row by row upward, x = (c / 2) (1 + spacing) size + (c % 2) size."""
    board, size, spacing = Board.parse("aprilgrid:3x2:0.3", "50mm"), 0.05, 0.3
    expected = [
        ((c // 2) * (1 + spacing) * size + (c % 2) * size, (r // 2) * (1 + spacing) * size + (r % 2) * size)
        for r in range(4)
        for c in range(6)
    ]
    upward = board.points[:, :2] * torch.tensor([1.0, -1.0])  # kcal's y points down, z into the board
    assert torch.allclose(upward, torch.tensor(expected, dtype=torch.float64), atol=1e-15)
    # Tag 0 is the lower left one: its cells are drawn between points 0, 1, 6 and 7.
    shapes = pattern_shapes(board)
    x, y = shapes.origin
    inside = [r for r in shapes.rectangles if x - 1e-9 <= r.x < x + 50 - 1e-9 and y - 50 - 1e-9 <= r.y < y - 1e-9]
    assert sum(r.width * r.height for r in inside) == pytest.approx(tag_cells(0).sum() * 25.0)


def test_tags_are_those_of_the_apriltag_library():
    """Its codes of family 36h11, most significant bit first from the left upper cell; 1 is white."""
    for number, code in enumerate((0xD5D628584, 0xD97F18B49, 0xDD280910E)):
        cells = tag_cells(number)
        assert cells.shape == (10, 10)
        assert cells[:2].all()
        assert cells[-2:].all()
        assert cells[:, :2].all()
        assert cells[:, -2:].all()
        bits = [not cells[2 + i, 2 + j] for i in range(6) for j in range(6)]
        assert sum(bit << (35 - place) for place, bit in enumerate(bits)) == code


def test_asymmetric_circles_are_counted_as_opencv_does():
    """Its samples: ((2 j + i % 2) square, i square) for row i, column j."""
    board = Board.parse("asymmetric:4x11", "20mm")
    expected = [((2 * j + i % 2) * 0.02, i * 0.02, 0.0) for i in range(11) for j in range(4)]
    assert torch.allclose(board.points, torch.tensor(expected, dtype=torch.float64), atol=1e-15)
    assert board.extent == pytest.approx((0.14, 0.2))


@pytest.mark.parametrize(
    ("text", "turns"),
    [
        ("9x6", (0,)),
        ("7x5", (0, 2)),
        ("6x6", (0, 1, 2, 3)),
        ("7x7", (0, 2)),
        ("charuco:7x5", (0,)),
        ("circles:9x6", (0, 2)),
        ("circles:5x5", (0, 1, 2, 3)),
        ("asymmetric:4x11", (0,)),
        ("asymmetric:4x10", (0, 2)),
        ("aprilgrid:4x4", (0,)),
    ],
)
def test_turns_that_look_alike(text, turns):
    board = Board.parse(text, "20mm")
    assert board.quarter_turns == turns
    assert board.unambiguous == (turns == (0,)) == (not board.stereo_advice)
    grid = torch.arange(board.corners).view(board.rows, board.columns)
    flat = board.points[:, :2] - board.points[:, :2].mean(0)
    for turn in turns:
        # The points, turned and in the order that is then read, are the board's points again.
        angle = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64)  # x becomes -y, y becomes x
        turned = flat[torch.rot90(grid, turn).flatten()] @ torch.linalg.matrix_power(angle, turn).T
        middle = 0.5 * (flat.amax(0) + flat.amin(0))
        again = 0.5 * (turned.amax(0) + turned.amin(0))
        assert torch.allclose(turned - again, flat - middle, atol=1e-12), turn


def test_all_dictionaries_of_opencv():
    named = {name.removeprefix("DICT_").lower() for name in dir(cv2.aruco) if name.startswith("DICT_")}
    assert named == set(DICTIONARIES)
    for name, count in DICTIONARIES.items():
        assert opencv_dictionary(name).bytesList.shape[0] == count


def test_files_of_older_boards_stay_as_they_were():
    content = json.loads(Board.parse("9x6", "25mm").model_dump_json())
    assert content == {"columns": 9, "rows": 6, "square": 0.025, "dictionary": None, "marker": None}
    assert Board.model_validate_json('{"columns": 9, "rows": 6, "square": 0.025}') == Board.parse("9x6", "25mm")


@pytest.mark.parametrize("text", ["circles:3x3:9mm", "asymmetric:3x3", "aprilgrid:2x2:id8", "charuco:3x3:id12"])
def test_observations_keep_the_board(tmp_path, text):
    board = Board.parse(text, "20mm")
    view = View(name="a", pixels=tuple((float(i), float(i % 7)) for i in range(board.corners)))
    seen = Observations(board=board, image_size=(50, 50), views=(view,))
    assert Observations.load(seen.save(tmp_path / "a.obs.json")) == seen
    assert torch.equal(Board.of(board.record).points, board.points)


def test_records():
    with pytest.raises(InputError, match="has a gap"):
        BoardRecord(columns=4, rows=4, square=0.1, pattern="aprilgrid")
    with pytest.raises(InputError, match="has a gap"):
        BoardRecord(columns=4, rows=4, square=0.1, gap=0.1)


class TestKalibrFiles:
    APRIL = "target_type: 'aprilgrid' #gridtype\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n"

    def parse(self, folder, text, square=None):
        path = folder / "target.yaml"
        path.write_text(text)
        return Board.parse(str(path), square)

    def test_targets(self, tmp_path):
        assert self.parse(tmp_path, self.APRIL) == Board.parse("aprilgrid:6x5:0.3", "88mm")
        checks = "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: "
        assert self.parse(tmp_path, checks + "0.06\n") == Board.parse("6x7", "60mm")
        circles = "target_type: circlegrid\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\nasymmetricGrid: "
        assert self.parse(tmp_path, circles + "True") == Board.parse("asymmetric:4x11", "20mm")
        assert self.parse(tmp_path, circles + "False") == Board.parse("circles:4x11", "20mm")
        with pytest.raises(FileError, match=r"colSpacingMeters 0\.05: squares are needed"):
            self.parse(tmp_path, checks + "0.05\n")

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("tagSize: 0.088", "", "tagSize must be a positive number, it is None"),
            ("tagSize: 0.088", "tagSize: .nan", "tagSize must be a positive number"),
            ("tagCols: 6", "tagCols: 6.5", "tagCols must be a whole number"),
            ("tagCols: 6", "tagCols: true", "tagCols must be a whole number"),
            ("tagSpacing: 0.3", "tagSpacing: 1.3", "gap between tags"),
            ("'aprilgrid'", "'assymetric_aprilgrid'", "kcal reads aprilgrid, checkerboard and circlegrid"),
            ("target_type", "type", "target_type is missing"),
            ("target_type:", "target_type: [", "no YAML file"),
        ],
    )
    def test_bad_files(self, tmp_path, old, new, message):
        with pytest.raises(FileError, match=message) as caught:
            self.parse(tmp_path, self.APRIL.replace(old, new))
        assert "\n" not in str(caught.value)

    def test_sizes_are_in_the_file(self, tmp_path):
        with pytest.raises(InputError, match="the file has all sizes; leave --square 25mm out"):
            self.parse(tmp_path, self.APRIL, "25mm")
        with pytest.raises(FileError, match="cannot read"):
            Board.parse(str(tmp_path / "nowhere.yaml"))


@pytest.mark.parametrize("text", ["circles:7x6", "asymmetric:4x11", "aprilgrid:5x4"])
def test_everything_is_on_the_page(text):
    board = Board.parse(text, "20mm")
    sheet = board_sheet(board, "A4")
    page = sheet.drawing
    for circle in page.circles:
        r = circle.diameter / 2
        assert r <= circle.x <= page.width - r
        assert r <= circle.y <= page.height - r
    for r in page.rectangles:
        assert r.x >= 0
        assert r.x + r.width <= page.width
        assert r.y >= 0
        assert r.y + r.height <= page.height
    # Every point of the board is on the page, and black and white meet there or a circle is around it.
    points = 1000 * board.points[:, :2] + torch.tensor(sheet.origin, dtype=torch.float64)
    if page.circles:
        centers = torch.tensor([[c.x, c.y] for c in page.circles], dtype=torch.float64)
        assert torch.allclose(centers, points, atol=1e-9)
    else:
        # The lower left ends of the lowest row of tags are right upper ends of small squares.
        ends = {(round(r.x + r.width, 6), round(r.y, 6)) for r in page.rectangles}
        assert {(round(x, 6), round(y, 6)) for x, y in points[0 : board.columns : 2].tolist()} <= ends
    caption = page.texts[1].text
    # The caption says the board again.
    again = caption.removeprefix("kcal board ").split(",")[0]
    assert torch.allclose(Board.parse(again, "20mm").points, board.points)
    with pytest.raises(InputError, match="does not fit A5"):
        board_sheet(Board.parse(text, "60mm"), "A5")


def test_drawn_circles_are_round():
    """The curves of the PDF and the arcs of the SVG, evaluated."""
    page = Drawing(width=50, height=40, title="t", rectangles=(), circles=(Circle(x=20, y=15, diameter=12),))
    text = to_pdf(page).decode("latin-1")
    point = 72 / 25.4
    stream = re.search(r"stream\n(.*?)\nendstream", text, re.DOTALL).group(1)
    numbers = [float(number) for number in re.findall(r"-?[\d.]+", re.search(r"\n([\d.].* m .* c)", stream).group(1))]
    ends = np.array(numbers).reshape(-1, 2) / point - [20, 40 - 15]
    assert len(ends) == 13
    for start in range(0, 12, 3):
        a, b, c, d = ends[start : start + 4]
        t = np.linspace(0, 1, 21)[:, None]
        curve = (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d
        assert np.linalg.norm(curve, axis=1) == pytest.approx(np.full(21, 6.0), abs=0.003)
    assert ends[-1] == pytest.approx(ends[0], abs=1e-3)
    assert ends[3] == pytest.approx([0, 6], abs=1e-3)
    assert "M14 15a6 6 0 1 0 12 0a6 6 0 1 0 -12 0z" in to_svg(page)


# Corners of other programs: their order, pixel origins and weights.


BOARD = Board(columns=3, rows=2, square=0.025)

SIZE = (640, 480)


def test_vnl_levels_are_weights(tmp_path: Path) -> None:
    lines = ["## made by mrgingham", "# filename x y level", "none.png - - -"]
    lines += [f"a.png {10 * i}.5 {i} {level}" for i, level in enumerate((0, 1, 2, 0, 0))] + ["a.png - - -"]
    path = tmp_path / "corners.vnl"
    path.write_text("\n".join(lines))
    seen = import_corners(path, BOARD, SIZE)
    assert seen.names == ("a.png",)
    assert seen.views[0].pixels[1] == (10.5, 1.0)
    assert seen.views[0].pixels[5] is None
    assert seen.views[0].covariance is not None
    assert [spread and spread[0] for spread in seen.views[0].covariance] == [1.0, 4.0, 16.0, 1.0, 1.0, None]


def test_vnl_weights_and_outliers(tmp_path: Path) -> None:
    path = tmp_path / "corners.vnl"
    rows = [f"a.png {i} {i} {weight}" for i, weight in enumerate((1, 0.5, 0, -1, 1, 1))]
    path.write_text("\n".join(["# filename x y weight", *rows]))
    view = import_corners(path, BOARD, SIZE).views[0]
    assert [pixel is None for pixel in view.pixels] == [False, False, True, True, False, False]
    assert view.covariance[1] == (4.0, 0.0, 4.0)


@pytest.mark.parametrize("by", ["corner", "column,row"])
def test_csv_in_any_order(tmp_path: Path, by: str) -> None:
    path = tmp_path / "corners.csv"
    places = {"corner": ("4", "0"), "column,row": ("1,1", "0,0")}[by]
    path.write_text(f"image,{by},u,v,weight\na,{places[0]},7,8,1\na,{places[1]},1,2,0.25\n")
    view = import_corners(path, BOARD, SIZE).views[0]
    assert (view.pixels[4], view.pixels[0], view.pixels[1]) == ((7.0, 8.0), (1.0, 2.0), None)
    assert view.covariance[0] == (16.0, 0.0, 16.0)


def test_opencv(tmp_path: Path) -> None:
    points = np.arange(24, dtype=np.float32).reshape(2, 6, 2)
    path = file_storage(tmp_path / "out.yml", image_width=640, image_height=480, image_points=points)
    seen = import_corners(path, BOARD)
    assert (seen.image_size, seen.names) == (SIZE, ("001", "002"))
    assert seen.views[1].pixels[5] == (22.0, 23.0)
    assert seen.views[1].covariance is None
    # The data of cv::omnidir's samples: a matrix of each view.
    view = "<_ type_id='opencv-matrix'><rows>6</rows><cols>1</cols><dt>'2f'</dt><data>{}</data></_>"
    views = "".join(view.format(" ".join(map(str, range(first, first + 12)))) for first in (0, 12))
    stored = f"<imagePoints>{views}</imagePoints><imageSize>640 480</imageSize>"
    path = tmp_path / "omni.xml"
    path.write_text(f'<?xml version="1.0"?><opencv_storage>{stored}</opencv_storage>')
    assert import_corners(path, BOARD) == seen
    with pytest.raises(FileError, match="corners are read with --board"):
        import_cameras(path)


@pytest.mark.parametrize("world", [True, False])
def test_matlab_goes_down_the_columns_from_pixel_one(tmp_path: Path, world: bool) -> None:
    path = tmp_path / "corners.mat"
    columns, rows = np.repeat(np.arange(3), 2), np.tile(np.arange(2), 3)
    points = np.stack([100.0 * columns + 1, 10.0 * rows + 1], 1)[..., None].repeat(2, 2)
    points[3, :, 1] = np.nan
    content = {"imagePoints": points, "imageSize": [480, 640]}
    savemat(path, content | ({"worldPoints": 25.0 * np.stack([columns, rows], 1)} if world else {}))
    seen = import_corners(path, BOARD)
    assert seen.image_size == SIZE
    assert seen.views[0].pixels == tuple((100.0 * (i % 3), 10.0 * (i // 3)) for i in range(6))
    assert seen.views[1].pixels[4] is None


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("a.vnl", "# filename x y level\na 1 2 0\n", "a has 1 corners, the board 6"),
        ("a.vnl", "# file x y\na 1 2 0\n", "the header is"),
        ("a.vnl", "# filename x y level\na 1 2\n", "line 2"),
        ("a.csv", "image,u,v,size\na,1,2,3\n", "the header is"),
        ("a.csv", "image,corner,u,v\na,6,1,2\n", "line 2: corner 6"),
        ("a.csv", "image,corner,u,v\na,1,1,2\na,1,1,2\n", "occurs twice"),
        ("a.csv", "image,corner,u,v\na,1,inf,2\n", "no finite numbers"),
        ("a.csv", "image,corner,u,v\na,1,,2\n", "no view with corners"),
        ("a.mat", "nothing", r"not a \.mat file"),
    ],
)
def test_bad_files(tmp_path: Path, name: str, text: str, what: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FileError, match=what):
        import_corners(tmp_path / name, BOARD, SIZE)


def test_columns_and_rows_that_are_exchanged_are_named(tmp_path: Path) -> None:
    """Six corners in a row, seen askew; some were not found."""
    column, row = np.meshgrid(np.arange(6), np.arange(8))
    lines = ["image,corner,u,v"]
    for view, (turn, depth) in enumerate(((0.2, 0.02), (1.4, 0.0), (-0.7, 0.03))):
        across = math.cos(turn) * column - math.sin(turn) * row
        down = math.sin(turn) * column + math.cos(turn) * row
        u, v = (300.0 + 20.0 * side / (1.0 + depth * down) for side in (across, down))
        lines += [f"a{view},{i},{a:.3f},{b:.3f}" for i, (a, b) in enumerate(zip(u.flat, v.flat, strict=True)) if i != 9]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(FileError, match=r"corners are in rows of 6, not of 8: the board seems to be 6x8"):
        import_corners(tmp_path / "a.csv", Board(columns=8, rows=6, square=0.025), SIZE)
    assert len(import_corners(tmp_path / "a.csv", Board(columns=6, rows=8, square=0.025), SIZE).views) == 3


def test_what_is_not_in_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("image,corner,u,v\na,1,1,2\n")
    with pytest.raises(InputError, match="--size"):
        import_corners(tmp_path / "a.csv", BOARD)
    with pytest.raises(InputError, match=r"\.vnl"):
        import_corners(tmp_path / "a.doc", BOARD)


# Files of observed corners: their covariances read as they were packed, and what contradicts itself refused.


SMALL_BOARD = Board(columns=2, rows=2, square=0.1)

PIXELS = ((1.0, 2.0), (8.0, 2.5), None, (8.5, 7.0))

SPREAD = ((0.01, 0.002, 0.04), (0.02, -0.01, 0.03), None, (0.5, 0.0, 0.1))


def observed(**changes):
    view = {"name": "a.png", "pixels": PIXELS, "covariance": SPREAD, **changes}
    return Observations(board=SMALL_BOARD, image_size=(10, 9), views=(View(**view),))


def test_covariances_are_uu_uv_vv():
    found = observed().covariances()
    for n, spread in enumerate(SPREAD):
        if spread is None:
            assert bool(found[0, n].isnan().all())
        else:
            uu, uv, vv = spread
            assert found[0, n].tolist() == [[uu, uv], [uv, vv]]
    assert observed(covariance=None).covariances() is None


def test_a_detection_comes_back_from_its_file(tmp_path):
    root = torch.randn(4, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    pixels = torch.tensor([[nan if x is None else x for x in pixel or (None,) * 2] for pixel in PIXELS]).double()
    spread = root @ root.mT + 0.1 * torch.eye(2).double()
    spread[2] = nan
    view = view_of(Detection(pixels, covariance=spread), "a")
    path = Observations(board=SMALL_BOARD, image_size=(10, 9), views=(view,)).save(tmp_path / "a.json")
    found = Observations.load(path)
    seen = torch.tensor([0, 1, 3])
    assert bool(found.pixels()[0, 2].isnan().all())
    torch.testing.assert_close(found.pixels()[0, seen], pixels[seen], rtol=0, atol=0)
    torch.testing.assert_close(found.covariances()[0, seen], spread[seen], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"covariance": (*SPREAD[:3], None)}, "seen corners, and only these"),
        ({"covariance": (*SPREAD[:2], (1.0, 0.0, 1.0), SPREAD[3])}, "seen corners, and only these"),
        ({"covariance": SPREAD[:3]}, "has 3 covariances"),
        ({"covariance": ((0.01, 0.021, 0.04), *SPREAD[1:])}, "not positive definite"),
        ({"covariance": ((-0.01, 0.0, -0.04), *SPREAD[1:])}, "not positive definite"),
        ({"pixels": PIXELS[:3], "covariance": None}, "has 3 corners, the board 4"),
    ],
)
def test_what_contradicts_itself_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        observed(**changes)


@pytest.mark.parametrize("outside", [(-2.6, 2.0), (11.6, 2.0), (1.0, -2.6), (1.0, 10.6), (2.0, 14.0)])
def test_corners_outside_the_image_are_refused(outside, tmp_path):
    # Two pixels beyond the edges are noise.
    assert observed(pixels=((-2.5, -2.5), (11.5, 10.5), None, (11.5, -2.5))).image_size == (10, 9)
    message = rf"view 'a\.png': 1 corner\(s\) lie outside the image of 10x9 px, one at \({outside[0]:.1f}, "
    with pytest.raises(InputError, match=message):
        observed(pixels=(*PIXELS[:3], outside))
    path = observed().save(tmp_path / "a.json")
    path.write_text(path.read_text().replace("8.5", str(outside[0]), 1).replace("7.0", str(outside[1]), 1))
    with pytest.raises(FileError, match=message):
        Observations.load(path)


def test_subset_keeps_the_order_that_was_asked_for():
    one = observed()
    both = Observations(board=SMALL_BOARD, image_size=(10, 9), views=(*one.views, View(name="b.png", pixels=PIXELS)))
    assert both.subset(["b.png", "a.png"]).names == ("b.png", "a.png")
    assert both.covariances() is None
    with pytest.raises(InputError, match=r"no view named 'c\.png'"):
        both.subset(["a.png", "c.png"])
    with pytest.raises(InputError, match=r"share the name 'a\.png'"):
        Observations(board=SMALL_BOARD, image_size=(10, 9), views=(*one.views, *one.views))
    with pytest.raises(InputError, match="no view with a board"):
        both.subset([]).pixels()
