"""Corners on the command line: images from folders and servers, printed boards, and the limit of time."""

import functools
import hashlib
import http.server
import os
import re
import struct
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from board_render import homography, render
from command_line import Command, invoked, ran
from hypothesis import given, settings
from hypothesis import strategies as st
from waiting import PATIENCE

from kcal import Board, FileError, InputError, Observations
from kcal.corners import detect as module
from kcal.corners.detect import detect, detect_board
from kcal.corners.images import exif_orientation, turned_images
from kcal.corners.print_board import EDGE, PAGES, Drawing, Rectangle, Text, board_sheet, to_pdf, to_svg
from kcal.corners.time_limit import Limited, TookTooLongError
from kcal.corners.video import detect_video, read_frames
from kcal.report.calibration import coverage_figure, gallery_figure
from kcal.threads import UNSTOPPABLE

BOARD = Board(columns=6, rows=5, square=0.02)

OPTIONS = ["--board", "6x5", "--square", "20mm", "-o"]


@pytest.fixture
def shots(tmp_path):
    folder = tmp_path / "shots"
    folder.mkdir()
    for k in range(2):
        H = homography(BOARD, (240, 200), 22, (0.1 * k, 0.05), 0.1)
        cv2.imwrite(f"{folder}/shot{k}.png", render(BOARD, (240, 200), H, seed=k, supersample=2)[0])
    return folder


def test_failures_are_listed_on_screen_and_in_the_file(shots, tmp_path):
    (shots / "bad.jpg").write_bytes(cv2.imencode(".jpg", cv2.imread(f"{shots}/shot0.png", 0))[1].tobytes()[:1500])
    output = tmp_path / "x.obs.json"
    result = invoked("detect", shots, *OPTIONS, output)
    assert "board found in 2 of 3 images" in result
    assert "failed bad.jpg: the image is truncated or corrupt" in result
    assert [failure.name for failure in Observations.load(output).failures] == ["bad.jpg"]


def test_each_image_is_read_once(shots, monkeypatch):
    read, whole = [], module.image_bytes
    monkeypatch.setattr(module, "image_bytes", lambda path: read.append(path) or whole(path))
    assert len(detect(shots, BOARD).views) == 2
    assert sorted(read) == sorted(shots.iterdir())


@pytest.mark.parametrize("method", ["saddle", "opencv", "skimage", "none"])
def test_refine_is_recorded(shots, tmp_path, method):
    output = tmp_path / "x.obs.json"
    invoked("detect", shots / "shot0.png", *OPTIONS, output, "--refine", method)
    assert Observations.load(output).refinement == method


def refused(error, match, *arguments):
    result = ran(*arguments)
    assert result.exit_code == 1
    assert isinstance(result.exception, error)
    message = str(result.exception)
    assert "\n" not in message
    assert match in message


def test_what_cannot_be_done_leaves_no_file(shots, tmp_path):
    output = tmp_path / "x.obs.json"
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(FileError, "no image in this folder", "detect", empty, *OPTIONS, output)
    refused(FileError, "no file matches", "detect", shots / "*.jpg", *OPTIONS, output)
    refused(FileError, "no such file", "detect", shots / "shot9.png", *OPTIONS, output)
    larger = ["--board", "9x8", "--square", "20mm", "-o", output]
    refused(InputError, "no board in any of 2 images", "detect", shots, *larger)
    refused(InputError, "with its unit", "detect", shots, "--board", "6x5", "--square", "20", "-o", output)
    refused(InputError, "COLUMNSxROWS", "detect", shots, "--board", "6", "--square", "20mm", "-o", output)
    for name in ("wide", "wider"):
        cv2.imwrite(f"{shots}/{name}.png", np.random.default_rng(0).integers(0, 255, (100, 300), dtype=np.uint8))
    counts = "2 of 240x200 px (shot0.png, shot1.png); 2 of 300x100 px (wide.png, wider.png)"
    refused(InputError, counts, "detect", shots, *OPTIONS, output)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "shots"]


def test_output_is_checked_before_the_work(shots, tmp_path, monkeypatch):
    monkeypatch.setattr("kcal.corners.detect.detect", lambda *_, **__: pytest.fail("work was begun"))
    refused(FileError, "does not exist", "detect", shots, *OPTIONS, tmp_path / "none" / "x.obs.json")
    refused(FileError, "is a folder", "detect", shots, *OPTIONS, tmp_path)


def test_old_file_survives_a_failure(shots, tmp_path):
    output = tmp_path / "x.obs.json"
    output.write_text("old")
    refused(InputError, "no board", "detect", shots, "--board", "9x8", "--square", "20mm", "-o", output)
    assert output.read_text() == "old"


def test_board_command_refuses(tmp_path):
    common = ["board", "--board", "9x6", "--square"]
    refused(InputError, "A2 would do", *common, "40mm", "--paper", "A4", "-o", tmp_path / "b.pdf")
    refused(InputError, ".svg or .pdf", *common, "25mm", "-o", tmp_path / "b.png")
    refused(FileError, "does not exist", *common, "25mm", "-o", tmp_path / "none" / "b.pdf")
    assert list(tmp_path.iterdir()) == []


def test_shipped_boards_are_what_the_command_draws(tmp_path):
    shipped = Path(__file__).parents[2] / "assets" / "boards"
    for size, square, page, sides in (("9x6", "25mm", "A4", "297x210"), ("7x6", "50mm", "A2", "594x420")):
        for suffix in (".svg", ".pdf"):
            output = tmp_path / f"board_{size}_{square}_{page}{suffix}"
            result = invoked("board", "--board", size, "--square", square, "--paper", page, "-o", output)
            assert f"{size} inner corners, {square[:2]} mm squares, page {sides} mm" in result
            assert output.read_bytes() == (shipped / output.name).read_bytes()


A4 = Board(columns=9, rows=6, square=0.025)


def raster(drawing, per_mm=4):
    """The drawing's rectangles as an image."""
    image = np.full((round(drawing.height * per_mm), round(drawing.width * per_mm)), 255, np.uint8)
    for r in drawing.rectangles:
        rows = slice(round(r.y * per_mm), round((r.y + r.height) * per_mm))
        image[rows, round(r.x * per_mm) : round((r.x + r.width) * per_mm)] = 0
    return image


def svg_rectangles(text):
    return np.array(re.findall(r"M([-\d.]+) ([-\d.]+)h([-\d.]+)v([-\d.]+)h-[\d.]+z", text), dtype=float)


def pdf_rectangles(data, height):
    """Rectangles in millimeters from the top left, read back from the page's content."""
    found = np.array(re.findall(rb"([-\d.]+) ([-\d.]+) ([-\d.]+) ([-\d.]+) re", data), dtype=float) * 25.4 / 72
    found[:, 1] = height - found[:, 1] - found[:, 3]
    return found


def test_a4_board_has_its_true_size_in_both_formats():
    drawing = board_sheet(A4, "A4").drawing
    svg, pdf = to_svg(drawing), to_pdf(drawing)
    assert 'width="297mm" height="210mm" viewBox="0 0 297 210"' in svg
    assert b"/MediaBox [0 0 841.8898 595.2756]" in pdf
    one, two = svg_rectangles(svg), pdf_rectangles(pdf, 210)
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-4)  # four decimals are written
    squares = one[one[:, 2] == 25]
    assert len(squares) == 35
    assert (squares[:, 3] == 25).all()
    assert squares[:, 0].max() + 25 - squares[:, 0].min() == pytest.approx(250, abs=1e-9)
    assert squares[:, 1].max() + 25 - squares[:, 1].min() == pytest.approx(175, abs=1e-9)
    assert len(one[one[:, 2] == 100]) == 1


def test_what_is_printed_is_what_is_detected():
    drawing = board_sheet(A4).drawing
    found = detect_board(raster(drawing), A4)
    corner = drawing.rectangles[0]
    # Corner 0 is the inner corner of the black square at the top left; a pixel's center lies half a pixel in.
    expected = np.array([corner.x + 25, corner.y + 25]) * 4 - 0.5
    np.testing.assert_allclose(found.pixels[0].numpy(), expected, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.pixels[9].numpy(), expected + np.array([0, 100]), rtol=0, atol=1e-3)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 14), st.integers(2, 14), st.floats(0.004, 0.06), st.sampled_from(["auto", *PAGES, "LETTER", "a3"])
)
def test_everything_lies_on_the_page(columns, rows, square, page):
    board = Board(columns=columns, rows=rows, square=square)
    try:
        sheet = board_sheet(board, page)
    except InputError as error:
        better = re.search(r"does not fit .*; (\w+) would do", str(error))
        if better:
            assert board_sheet(board, better.group(1)).page == better.group(1)
        return
    drawing = sheet.drawing
    squares = drawing.rectangles[: ((columns + 1) * (rows + 1) + 1) // 2]
    others = drawing.rectangles[len(squares) :]
    slack = 1e-9
    for r in drawing.rectangles:
        assert min(r.x, r.y) >= EDGE - 0.1 - slack
        assert r.x + r.width <= drawing.width - EDGE + 0.1 + slack
        assert r.y + r.height <= drawing.height - EDGE + slack
    foot = min(r.y for r in others)
    bottom = max(r.y + r.height for r in squares)
    letters = min(text.y - text.size for text in drawing.texts)
    assert min(foot, letters) - bottom >= sheet.quiet * square * 1000 - 0.5  # the caption stays out of the white
    for text in drawing.texts:
        assert text.x + len(text.text) * 0.6 * text.size <= drawing.width or drawing.width < 160
    if page == "auto":
        assert sheet.quiet >= 1 - slack


def test_pages_are_those_of_the_standards():
    """ISO 216: A0 is a square meter with sides as 1 to the root of 2, and each next page half of it, cut to mm."""
    width, height = 841.0, 1189.0
    assert width * height == pytest.approx(1e6, rel=1e-4)
    assert height / width == pytest.approx(2**0.5, rel=1e-3)
    for name in ("A0", "A1", "A2", "A3", "A4", "A5"):
        assert PAGES[name] == (width, height), name
        width, height = height // 2, width
    for name, (across, up) in {"letter": (8.5, 11.0), "legal": (8.5, 14.0), "tabloid": (11.0, 17.0)}.items():
        assert PAGES[name] == pytest.approx((25.4 * across, 25.4 * up), rel=1e-12), name


def test_page_choice():
    assert board_sheet(A4, "a4").page == "A4"
    tall = board_sheet(Board(columns=6, rows=9, square=0.02), "A4").drawing
    assert (tall.width, tall.height) == (210, 297)
    with pytest.raises(InputError, match=r"400x280 mm and does not fit A4 .*; A2 would do"):
        board_sheet(Board(columns=9, rows=6, square=0.04), "A4")
    with pytest.raises(InputError, match="use auto or smaller squares"):
        board_sheet(Board(columns=9, rows=6, square=0.4), "A4")
    with pytest.raises(InputError, match="choose one of auto, A5"):
        board_sheet(A4, "B5")


def test_ambiguous_board_says_so():
    texts = " ".join(text.text for text in board_sheet(Board(columns=8, rows=6, square=0.02)).drawing.texts)
    assert "not for stereo" in texts
    assert "not for stereo" not in " ".join(text.text for text in board_sheet(A4).drawing.texts)


def test_pdf_table_of_objects_is_right():
    data = to_pdf(board_sheet(A4, "A4").drawing)
    start = int(data.rsplit(b"startxref\n", 1)[1].split()[0])
    assert data[start:].startswith(b"xref\n0 7\n")
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n ", data), 1):
        assert data[int(offset) :].startswith(b"%d 0 obj\n" % number)
    length = int(re.search(rb"/Length (\d+)", data).group(1))
    assert data.split(b"stream\n", 1)[1][length:].startswith(b"\nendstream")


def test_texts_are_escaped():
    drawing = Drawing(
        width=50,
        height=20,
        title="<a> (b)",
        rectangles=(Rectangle(x=1, y=1, width=1, height=1),),
        texts=(Text(x=1, y=5, size=2, text="5 < 6 & (7)"),),
    )
    assert "5 &lt; 6 &amp; (7)</text>" in to_svg(drawing)
    assert rb"(5 < 6 & \(7\)) Tj" in to_pdf(drawing)
    with pytest.raises(InputError, match="Latin-1"):
        to_pdf(Drawing(width=5, height=5, title="Ω", rectangles=()))


SIZE = (240, 200)


@functools.cache
def still(shift, blur=0.8, seed=0):
    return render(BOARD, SIZE, homography(BOARD, SIZE, 20, (0.1, 0.05), 0.1, shift), blur, seed=seed, supersample=2)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Seven frames each at four places, the last like the first; only the third of each seven is sharp."""
    path = tmp_path_factory.mktemp("video") / "shots.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    assert writer.isOpened()
    places = [(-15, -10), (15, -10), (10, 12), (-15, -10)]
    for place in places:
        for i in range(7):
            writer.write(cv2.cvtColor(still(place, 0.8 if i == 2 else 3.0, seed=i)[0], cv2.COLOR_GRAY2BGR))
    writer.release()
    return path, places


class TestVideo:
    def test_sharp_and_new_frames_are_kept(self, video):
        path, places = video
        searched = []
        seen = detect_video(path, BOARD, progress=searched.append)
        assert searched == [f"shots.avi#{number:06d}" for number in (2, 9, 16, 23)]
        assert seen.names == ("shots.avi#000002", "shots.avi#000009", "shots.avi#000016")
        assert seen.image_size == SIZE
        for pixels, place in zip(seen.pixels(), places[:3], strict=True):
            # JPEG frames of a codec with color at half resolution.
            assert float((pixels - still(place)[1]).abs().max()) < 0.1

    def test_frames_and_a_limit(self, video):
        path, _ = video
        frames = list(read_frames(path))
        assert [frame.number for frame in frames] == list(range(28))
        assert frames[0].image.shape == SIZE[::-1]
        assert len(detect_video(path, BOARD, most=2).views) == 2

    def test_refusals(self, tmp_path, video):
        with pytest.raises(FileError, match="no such file"):
            detect_video(tmp_path / "none.avi", BOARD)
        (tmp_path / "text.avi").write_text("no video")
        with pytest.raises(FileError, match="not a video"):
            detect_video(tmp_path / "text.avi", BOARD)
        with pytest.raises(InputError, match="no board in any frame"):
            detect_video(video[0], Board(columns=9, rows=8, square=0.02))

    def test_command(self, video, tmp_path, command: Command):
        output = tmp_path / "v.obs.json"
        result = command("detect", video[0], "--board 6x5 --square 20mm -o", output)
        assert "board found in 3 of 4 sharp frames" in result.out
        assert len(Observations.load(output).views) == 3


@pytest.fixture(scope="module")
def stream(video):
    """The address at which a server of this machine sends the video."""
    path, _ = video

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0),
        lambda *a: Quiet(*a, directory=str(path.parent)),  # type: ignore[arg-type]
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://user:secret@127.0.0.1:{server.server_address[1]}/{path.name}"
    server.shutdown()
    server.server_close()


class TestStream:
    def test_views_equal_those_of_the_file(self, stream, video, tmp_path):
        path, _ = video
        folder = tmp_path / "frames"
        folder.mkdir()
        live, file = detect_video(stream, BOARD, keep=folder), detect_video(path, BOARD)
        assert live.names == tuple(name.replace("shots.avi", "127.0.0.1") for name in file.names)
        assert torch.equal(live.pixels(), file.pixels())
        # What was kept is what was measured; no password anywhere.
        kept = [view.image for view in live.views]
        assert sorted(map(str, folder.iterdir())) == sorted(kept)
        image = cv2.imread(kept[0], cv2.IMREAD_UNCHANGED)
        assert np.array_equal(image, next(f.image for f in read_frames(path) if f.number == 2))
        assert "secret" not in live.model_dump_json()

    def test_ends_in_time(self, stream):
        assert [frame.number for frame in read_frames(stream, duration=1e-9)] == [0]

    def test_refusals(self, stream, tmp_path):
        with pytest.raises(FileError, match=r"^127\.0\.0\.1: no stream that answers"):
            detect_video(stream.replace("shots", "other"), BOARD)
        with pytest.raises(FileError, match="camera:97: no stream that answers"):
            detect_video("camera:97", BOARD)
        base = ["--board", "6x5", "--square", "2cm", "-o", str(tmp_path / "o.json")]
        result = ran("detect", stream, "a.png", *base)
        assert result.exit_code == 1
        assert "searched alone" in str(result.exception) + result.output

    def test_command(self, stream, tmp_path, command: Command):
        path = tmp_path / "o.json"
        words = ["detect", stream, "--board", "6x5", "--square", "2cm", "-o", str(path), "--duration", "30"]
        result = command(*words, "--keep", str(tmp_path / "new" / "frames"))
        assert len(Observations.load(path).views) == 3
        # The folder is made.
        assert len(list((tmp_path / "new" / "frames").iterdir())) == 3
        assert "secret" not in path.read_text() + result.out + result.err


def with_orientation(jpeg, value, order):
    """A JPEG with an EXIF block of one entry."""
    tiff = {"<": b"II", ">": b"MM"}[order] + struct.pack(f"{order}HI", 42, 8)
    tiff += struct.pack(f"{order}HHHIHHI", 1, 0x0112, 3, 1, value, 0, 0)
    block = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + jpeg[2:]


class TestOrientation:
    @pytest.mark.parametrize("order", ["<", ">"])
    def test_is_read(self, order):
        jpeg = cv2.imencode(".jpg", still((0, 0))[0])[1].tobytes()
        assert exif_orientation(jpeg) == 1
        for value in range(1, 9):
            turned = with_orientation(jpeg, value, order)
            assert exif_orientation(turned) == value
            # OpenCV turns the picture where it should: the block is one that readers understand.
            shape = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE).shape
            assert shape == (SIZE if value >= 5 else SIZE[::-1])

    def test_damage_is_upright(self):
        jpeg = with_orientation(cv2.imencode(".jpg", still((0, 0))[0])[1].tobytes(), 6, ">")
        for end in (0, 1, 3, 8, 15, 20, 30):
            assert exif_orientation(jpeg[:end]) == 1
        with pytest.raises(FileError, match="cannot read"):
            turned_images(["none.jpg"])

    def test_is_reported_and_ignored(self, tmp_path, command: Command):
        jpeg = cv2.imencode(".jpg", cv2.cvtColor(still((0, 0))[0], cv2.COLOR_GRAY2BGR))[1].tobytes()
        (tmp_path / "a.jpg").write_bytes(with_orientation(jpeg, 6, ">"))
        (tmp_path / "b.jpg").write_bytes(jpeg)
        output = tmp_path / "x.obs.json"
        pictures = ["--gallery", str(tmp_path / "g.png"), "--coverage", str(tmp_path / "c.png")]
        result = command("detect", tmp_path, "--board 6x5 --square 20mm -o", output, *pictures)
        assert "1 images have an EXIF rotation" in result.out
        seen = Observations.load(output)
        assert seen.image_size == SIZE
        torch.testing.assert_close(seen.pixels()[0], seen.pixels()[1], rtol=0, atol=0)
        assert all((tmp_path / name).read_bytes()[:4] == b"\x89PNG" for name in ("g.png", "c.png"))


class TestPictures:
    def observations(self):
        pixels = still((0, 0))[1].tolist()
        views = []
        for name, sigma, unseen in (("good", 0.01, 0), ("vague", 0.2, 0), ("covered", 0.01, 3)):
            places = [None if i < unseen else tuple(pixel) for i, pixel in enumerate(pixels)]
            spread = [None if place is None else (sigma**2, 0.0, sigma**2) for place in places]
            views.append({"name": name, "pixels": places, "covariance": spread})
        content = {"board": BOARD.model_dump(), "image_size": SIZE, "views": views}
        return Observations.model_validate({**content, "failures": [{"name": "bad.png", "reason": "too blurred"}]})

    def test_worst_first_with_reasons(self):
        figure = gallery_figure(self.observations())
        titles = [axes.get_title(loc="left") for axes in figure.axes]
        assert [title.split()[0] for title in titles] == ["covered", "vague", "good"]
        assert "3 left out" in titles[0]
        assert "σ 0.200 px" in titles[1]
        texts = " ".join(text.get_text() for text in figure.texts)
        assert "3 views; the first 2 stand out" in texts
        assert "bad.png: too blurred" in texts

    def test_coverage_counts_what_was_reached(self):
        figure = coverage_figure(self.observations())
        (axes,) = figure.axes
        assert "3 views, 87 corners" in figure.texts[0].get_text()
        assert "boards reached 17 % of the image, hatched: not" in figure.texts[0].get_text()
        hatched, corners = axes.collections
        assert hatched.hatches == ["///"]
        assert len(hatched.get_paths()[0].vertices) > 10  # the border, which no corner reached
        assert len(corners.get_offsets()) == 87


found_by_the_library = module.detect_board


def busy(seconds):
    """Work for so much processor time, as a C++ library that never asks Python."""
    end = time.process_time() + seconds
    data = bytes(20_000_000)
    while time.process_time() < end:
        hashlib.sha256(data)


def slow_if_upright(image, board, refine):
    """A detector that loops for ever on one kind of image."""
    if image.shape[0] > image.shape[1] and image[0, 0] == 7:
        busy(3600.0)
    return found_by_the_library(image, board, refine)


AMPLE, SCANT = 600.0, 0.3


@pytest.mark.slow
def test_calls_return_or_are_given_up():
    with Limited(AMPLE) as limited:
        assert limited(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            limited(divmod, 7, 0)
        for _ in range(2):  # in a thread, then in a process
            limited.seconds = SCANT
            with pytest.raises(TookTooLongError, match=r"0\.3 s"):
                limited(busy, 3600.0)
            limited.seconds = AMPLE
            assert limited(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            limited(divmod, 7, 0)
        with pytest.raises(TookTooLongError, match="died"):
            limited(os._exit, 3)
        assert limited(divmod, 7, 2) == (3, 1)


def test_only_work_counts():
    """Waiting, as for processors that are busy, takes nothing of the limit, in a thread and in a process."""
    with Limited(SCANT) as limited:
        limited(time.sleep, 2 * SCANT)
        with pytest.raises(TookTooLongError):
            limited(busy, 3600.0)
        limited(time.sleep, 2 * SCANT)
    left = [thread for thread in threading.enumerate() if thread.name == UNSTOPPABLE]
    for thread in left:
        thread.join(PATIENCE)
    assert not any(thread.is_alive() for thread in left)


def test_no_limit_and_bad_limit():
    with Limited(None) as limited:
        assert limited(divmod, 7, 2) == (3, 1)
    with pytest.raises(InputError, match="positive"):
        Limited(0.0)


@pytest.mark.slow
def test_a_slow_image_is_a_failure_and_the_rest_goes_on(tmp_path, monkeypatch):
    class Unequal(Limited):
        """Only the image that takes for ever is given up soon: the others have time on the slowest machine."""

        def __call__(self, function, *arguments):
            self.seconds = given[0] if arguments[0][0, 0] == 7 else AMPLE
            return super().__call__(function, *arguments)

        def __enter__(self):
            given.append(self.seconds)
            return super().__enter__()

    given: list[float] = []
    monkeypatch.setattr(module, "Limited", Unequal)
    monkeypatch.setattr(module, "detect_board", slow_if_upright)
    for k in range(3):
        image = render(BOARD, (200, 240), homography(BOARD, (200, 240), 20, (0.05 * k, 0.05), 0.1), seed=k)[0]
        image[0, 0] = 7 if k == 1 else 8
        cv2.imwrite(f"{tmp_path}/{k}.png", image)
    seen = detect([tmp_path / f"{k}.png" for k in range(3)], BOARD, time_limit=SCANT)
    assert seen.names == ("0.png", "2.png")
    assert [failure.name for failure in seen.failures] == ["1.png"]
    assert "time limit of 0.3 s" in seen.failures[0].reason
