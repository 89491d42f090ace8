import http.server
import struct
import threading

import cv2
import numpy as np
import pytest
import torch
from board_render import homography, render
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.corners.board import Board
from kcal.corners.images import exif_orientation, turned_images
from kcal.corners.observations import Observations
from kcal.corners.video import detect_video, read_frames
from kcal.errors import FileError, InputError
from kcal.report.calibration import coverage_figure, gallery_figure

BOARD = Board(columns=6, rows=5, square=0.02)
SIZE = (240, 200)


def still(shift, blur=0.8, seed=0):
    H = homography(BOARD, SIZE, 20, (0.1, 0.05), 0.1, shift)
    return render(BOARD, SIZE, H, blur, seed=seed, supersample=2)


@pytest.fixture
def video(tmp_path):
    """Seven frames each at four places, the last like the first; only the third of each seven is sharp."""
    path = tmp_path / "shots.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    assert writer.isOpened()
    places = [(-15, -10), (15, -10), (10, 12), (-15, -10)]
    for place in places:
        for i in range(7):
            image = still(place, 0.8 if i == 2 else 3.0, seed=i)[0]
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
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

    def test_command(self, video, tmp_path):
        output = tmp_path / "v.obs.json"
        result = CliRunner().invoke(
            app, ["detect", str(video[0]), "--board", "6x5", "--square", "20mm", "-o", str(output)]
        )
        assert result.exit_code == 0
        assert "board found in 3 of 4 sharp frames" in result.output
        assert len(Observations.load(output).views) == 3


@pytest.fixture
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
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
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
        result = CliRunner().invoke(app, ["detect", stream, "a.png", *base])
        assert result.exit_code == 1
        assert "searched alone" in str(result.exception) + result.output
        result = CliRunner().invoke(app, ["detect", stream, *base, "--keep", str(tmp_path / "none")])
        assert "no such folder" in str(result.exception) + result.output

    def test_command(self, stream, tmp_path):
        path = tmp_path / "o.json"
        words = ["detect", stream, "--board", "6x5", "--square", "2cm", "-o", str(path), "--duration", "30"]
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, result.output
        assert len(Observations.load(path).views) == 3
        assert "secret" not in path.read_text() + result.output


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

    def test_is_reported_and_ignored(self, tmp_path):
        jpeg = cv2.imencode(".jpg", cv2.cvtColor(still((0, 0))[0], cv2.COLOR_GRAY2BGR))[1].tobytes()
        (tmp_path / "a.jpg").write_bytes(with_orientation(jpeg, 6, ">"))
        (tmp_path / "b.jpg").write_bytes(jpeg)
        output = tmp_path / "x.obs.json"
        pictures = ["--gallery", str(tmp_path / "g.png"), "--coverage", str(tmp_path / "c.png")]
        result = CliRunner().invoke(
            app, ["detect", str(tmp_path), "--board", "6x5", "--square", "20mm", "-o", str(output), *pictures]
        )
        assert result.exit_code == 0
        assert "1 images have an EXIF rotation" in result.output
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
        assert "3 views, 87 corners" in axes.get_title(loc="left")
        assert "boards reached 17 % of the image, hatched: not" in axes.get_title(loc="left")
        hatched, corners = axes.collections
        assert hatched.hatches == ["///"]
        assert len(hatched.get_paths()[0].vertices) > 10  # the border, which no corner reached
        assert len(corners.get_offsets()) == 87
