"""Images of bags of ROS 1 and ROS 2: the same pixels, corners and times as those of a folder."""

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from bags import KINDS, START, Written, compressed, raw, write_bag
from board_render import homography, render
from command_line import Command

from kcal import Board, FileError, InputError, KcalWarning, Observations, detect
from kcal.bag import open_bag, pair_stamps
from kcal.calibrate.rig.pairs import image_pairs, pair_by_name
from kcal.corners.images import bag_images, decode_image, expand_images, image_bytes, image_time, read_gray
from kcal.corners.video import detect_video, detect_videos, read_frames
from kcal.file_kind import file_kind

BOARD, SIZE = Board(columns=6, rows=5, square=0.02), (240, 200)
STEP = 100_000_000
TOPIC = "/left/image_raw"


@functools.cache
def still(place: int, blur: float = 0.8) -> np.ndarray:
    return render(
        BOARD, SIZE, homography(BOARD, SIZE, 20, (0.1, 0.05), 0.1, (12 * place - 15, -8)), blur, supersample=2
    )[0]


def colors() -> np.ndarray:
    """(H, W, 3) red, green, blue, smooth."""
    noise = np.random.default_rng(5).integers(0, 256, (40, 50, 3)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 10, 240, cv2.NORM_MINMAX)  # type: ignore[call-overload]


def one(folder: Path, make, kind: str = "mcap") -> Path:  # type: ignore[no-untyped-def]
    """The only image of a bag."""
    (path,) = expand_images([write_bag(folder / f"one-{kind}.bag", kind, [(TOPIC, START, make)])])
    return path


@pytest.fixture(params=KINDS)
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Three images, recorded later than taken and out of order."""
    shots = [
        (TOPIC, START + 7_000_000 + k * STEP, lambda s, i=i: raw(s, START + i * 3 * STEP + 1, still(i), "mono8"))
        for k, i in enumerate((0, 2, 1))
    ]
    return write_bag(tmp_path / ("run.bag" if request.param == "ros1" else "run"), request.param, shots)


class TestFolderOfStamps:
    def test_names_times_and_pixels_are_those_of_a_folder(self, bag: Path, tmp_path: Path) -> None:
        assert file_kind(bag) == "bag"
        paths = expand_images([bag])
        stamps = [START + i * 3 * STEP + 1 for i in range(3)]
        assert [path.name for path in paths] == [f"{t // 10**9}.{t % 10**9:09d}.png" for t in stamps]
        assert list(open_bag(bag).stamps(TOPIC)) == stamps
        assert image_time(paths[0]) == float(f"{stamps[0]}e-9")
        assert all(np.array_equal(read_gray(path), still(i)) for i, path in enumerate(paths))

    @pytest.mark.slow
    def test_corners_are_those_of_a_folder(self, bag: Path, tmp_path: Path) -> None:
        folder = tmp_path / "folder"
        folder.mkdir()
        for i, path in enumerate(expand_images([bag])):
            cv2.imwrite(str(folder / path.name), still(i))
        seen, alone = detect(f"{bag}:{TOPIC}", BOARD), detect(folder, BOARD)
        assert seen.names == alone.names
        assert torch.equal(seen.pixels(), alone.pixels())
        # Frames that are .3 s apart are searched each.
        video = detect_video(bag, BOARD)
        assert video.names == alone.names
        assert torch.equal(video.pixels(), alone.pixels())
        assert np.array_equal(read_gray(str(video.views[2].image)), still(2))

    @pytest.mark.slow
    def test_a_topic_is_asked_for(self, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        both = [(f"/{side}/image_raw", START, lambda s: raw(s, START, still(0), "mono8")) for side in ("left", "right")]
        bag = write_bag(tmp_path / "two", "mcap", both)
        with pytest.raises(
            InputError, match=r"images of 2 topics; name one of .*two:/left/image_raw \(1\), .*two:/right"
        ):
            expand_images([bag])
        with pytest.raises(InputError, match="no images of the topic /middle"):
            expand_images([f"{bag}:/middle"])
        assert len(expand_images([f"{bag}:/left/image_raw"])) == 1
        said = command.refuses("detect", bag, "--board 6x5 --square 20mm -o", tmp_path / "o.obs.json")
        assert "two:/right/image_raw (1)" in said

    def test_a_frame_of_a_quarter_of_a_second(self, tmp_path: Path) -> None:
        shots = [
            (
                TOPIC,
                START + i * STEP // 2,
                lambda s, i=i: raw(s, START + i * STEP // 2, still(0, 0.8 if i == 3 else 3.0), "mono8"),
            )
            for i in range(6)
        ]
        found = detect_video(write_bag(tmp_path / "run.bag", "ros1", shots), BOARD)
        assert found.names == (f"{START // 10**9}.{START % 10**9 + 3 * STEP // 2:09d}.png",)

    def test_messages_of_another_order_of_bytes(self, tmp_path: Path) -> None:
        shots = [(TOPIC, START + 5, lambda s: raw(s, START, still(0), "mono8"))]
        (path,) = expand_images([write_bag(tmp_path / "run", "mcap", shots, little_endian=False)])
        assert path.name == "1700000000.123456789.png"
        assert np.array_equal(read_gray(path), still(0))

    def test_no_stamp(self, tmp_path: Path) -> None:
        shots = [(TOPIC, START + i, lambda s: raw(s, 0, still(0), "mono8")) for i in range(2)]
        bag = write_bag(tmp_path / "run", "sqlite3", shots)
        with pytest.warns(KcalWarning, match="2 images of /left/image_raw have no stamp; the times of recording"):
            paths = expand_images([bag])
        assert [path.name for path in paths] == ["1700000000.123456789.png", "1700000000.123456790.png"]
        assert np.array_equal(read_gray(paths[1]), still(0))

    def test_equal_stamps(self, tmp_path: Path) -> None:
        shots = [(TOPIC, START + i, lambda s, i=i: raw(s, START, still(i), "mono8")) for i in range(2)]
        with pytest.warns(KcalWarning, match="1 images of /left/image_raw have the stamp of an earlier one"):
            (path,) = expand_images([write_bag(tmp_path / "run", "mcap", shots)])
        assert np.array_equal(read_gray(path), still(0))


class TestPixels:
    """Each encoding gives the colors or gray levels that were stored."""

    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("big", [False, True])
    def test_gray_of_sixteen_bits(self, tmp_path: Path, kind: str, big: bool) -> None:
        image = (257 * still(0).astype(np.uint16)) ^ 0x21
        path = one(tmp_path, lambda s: raw(s, START, image, "mono16", padding=6, big=big), kind)
        assert np.array_equal(read_gray(path), image)

    @pytest.mark.parametrize(("encoding", "order"), [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("8UC3", [2, 1, 0])])
    def test_colors(self, tmp_path: Path, encoding: str, order: list[int]) -> None:
        path = one(tmp_path, lambda s: raw(s, START, colors()[..., order], encoding, padding=5))
        assert np.array_equal(decode_image(image_bytes(path), path), colors())
        assert np.array_equal(read_gray(path), cv2.cvtColor(colors(), cv2.COLOR_RGB2GRAY))

    @pytest.mark.parametrize(("encoding", "order"), [("rgba8", [0, 1, 2, 3]), ("bgra8", [2, 1, 0, 3])])
    def test_colors_with_alpha(self, tmp_path: Path, encoding: str, order: list[int]) -> None:
        stored = np.dstack([colors(), np.full((40, 50), 9, np.uint8)])[..., order]
        path = one(tmp_path, lambda s: raw(s, START, stored, encoding))
        assert np.array_equal(decode_image(image_bytes(path), path), colors())

    def test_colors_of_sixteen_bits(self, tmp_path: Path) -> None:
        image = 250 * colors().astype(np.uint16) + 3
        path = one(tmp_path, lambda s: raw(s, START, image[..., ::-1], "bgr16", big=True))
        assert np.array_equal(decode_image(image_bytes(path), path), image)

    @pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
    @pytest.mark.parametrize("way", ["raw", "compressed"])
    def test_mosaics(self, tmp_path: Path, pattern: str, way: str) -> None:
        """Smooth colors come back from what each pixel of the mosaic kept."""
        image, mosaic = colors(), np.zeros((40, 50), np.uint8)
        for place, color in enumerate(pattern):
            down, across = divmod(place, 2)
            mosaic[down::2, across::2] = image[down::2, across::2, "rgb".index(color)]
        if way == "raw":
            path = one(tmp_path, lambda s: raw(s, START, mosaic, f"bayer_{pattern}8", padding=2))
        else:
            words = f"bayer_{pattern}8; png compressed "
            path = one(tmp_path, lambda s: compressed(s, START, mosaic, ".png", words))
        error = decode_image(image_bytes(path), path)[2:-2, 2:-2].astype(int) - image[2:-2, 2:-2]
        # Between pixels of one color the others are interpolated; with another pattern the mean is above 20.
        assert np.abs(error).max() <= 16
        assert np.abs(error).mean() < 1.5

    @pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
    def test_yuv(self, tmp_path: Path, encoding: str) -> None:
        """Luma of 16 to 235, two pixels share a color; formulas of ITU-R BT.601."""
        luma = 40.0 + 180 * (colors()[..., 1] / 255)
        u, v = (100.0 + 50 * (colors()[:, ::2, i] / 255) for i in (0, 2))
        quads = np.rint(np.stack([luma[:, ::2], u, luma[:, 1::2], v], -1)).astype(np.uint8)
        places = (1, 0, 3, 2) if encoding in ("yuv422", "uyvy") else (0, 1, 2, 3)
        stored = quads[..., places].reshape(40, 50, 2)
        path = one(tmp_path, lambda s: raw(s, START, stored, encoding, padding=4))
        y = quads[..., ::2].reshape(40, 50) * 1.0 - 16
        u, v = (np.repeat(quads[..., i], 2, axis=1) * 1.0 - 128 for i in (1, 3))
        rgb = 1.164 * y[..., None] + np.stack([1.596 * v, -0.392 * u - 0.813 * v, 2.017 * u], -1)
        assert np.abs(decode_image(image_bytes(path), path) - rgb.clip(0, 255)).max() < 1.5

    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize(
        ("suffix", "words"),
        [(".jpg", "jpeg"), (".png", "rgb8; png compressed bgr8"), (".jpg", "bgr8; jpeg compressed bgr8")],
    )
    def test_compressed_ones_are_the_file_in_them(self, tmp_path: Path, kind: str, suffix: str, words: str) -> None:
        path = one(tmp_path, lambda s: compressed(s, START, colors()[..., ::-1], suffix, words), kind)
        assert image_bytes(path) == cv2.imencode(suffix, colors()[..., ::-1])[1].tobytes()

    def test_a_last_row_without_what_fills_it(self, tmp_path: Path) -> None:
        def make(store):  # type: ignore[no-untyped-def]
            message = raw(store, START, still(0), "mono8", padding=6)
            message.data = message.data[:-6]
            return message

        assert np.array_equal(read_gray(one(tmp_path, make)), still(0))

    def test_what_cannot_be_read_is_named(self, tmp_path: Path) -> None:
        path = one(tmp_path, lambda s: raw(s, START, still(0), "nv21"), "mcap")
        with pytest.raises(FileError, match=r"encoding 'nv21'; kcal reads mono8, .*bayer_rggb8.*uyvy"):
            read_gray(path)
        with pytest.raises(FileError, match="encoding 'nv21'"):
            list(read_frames(path.parents[2]))

        def short(store):  # type: ignore[no-untyped-def]
            message = raw(store, START, still(0), "mono8")
            message.data = message.data[:-1]
            return message

        with pytest.raises(FileError, match="240x200 px in rows of 240 bytes do not fit 47999 bytes"):
            read_gray(one(tmp_path, short, "ros1"))
        depth = one(tmp_path, lambda s: compressed(s, START, still(0), ".png", "16UC1; compressedDepth png"), "sqlite3")
        with pytest.raises(FileError, match="format '16UC1; compressedDepth png'; kcal reads jpeg and png"):
            read_gray(depth)


class TestPairs:
    def test_the_nearest_in_time(self) -> None:
        left, right = [0, 100, 200, 300], [8, 97, 304, 700]
        assert pair_stamps([10**6 * t for t in left], [10**6 * t for t in right]) == [
            (0, 8_000_000), (100_000_000, 97_000_000), (300_000_000, 304_000_000),
        ]  # fmt: skip
        with pytest.raises(InputError, match="within 10 ms of each other, the nearest are 40 ms apart"):
            pair_stamps([0], [40_000_000])

    def test_names_that_are_stamps_pair_by_time(self) -> None:
        left, right = ["17.000000001.png", "17.500000000.png"], ["17.499000000.png", "18.000000001.png"]
        assert pair_by_name(left, right) == [("17.500000000.png", "17.499000000.png")]

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Path:
        """The right images 2 ms after the left ones, in steps of .3 s; the board is at three places."""

        def shot(side: str, i: int) -> Written:
            stamp = START + i * 3 * STEP + (2_000_000 if side == "right" else 0)
            return f"/{side}/image_raw", stamp + 10_000, lambda store: raw(store, stamp, still(i), "mono8")

        shots = [shot(side, i) for i in range(3) for side in ("left", "right") if (i, side) != (1, "right")]
        return write_bag(tmp_path / "rig.bag", "ros1", shots)

    def test_two_topics_are_a_rig(self, rig: Path) -> None:
        left, right = detect_videos([f"{rig}:/left/image_raw", f"{rig}:/right/image_raw"], BOARD)
        assert len(left.views) == len(right.views) == 2
        assert torch.equal(left.pixels(), right.pixels())
        assert [*zip(left.names, right.names, strict=True)] == pair_by_name(left.names, right.names)
        pairs = image_pairs([f"{rig}:/left/image_raw"], [f"{rig}:/right/image_raw"])
        assert [(a.name, b.name) for a, b in pairs] == pair_by_name(left.names, right.names)

    @pytest.mark.slow
    def test_command(self, rig: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        topics = "--topic /left/image_raw --topic /right/image_raw"
        said = command("detect", rig, topics, "--square 20mm -o", tmp_path / "all.obs.json")
        assert "board found in 2 of 2 sharp moments" in said.out
        left, right = (Observations.load(tmp_path / f"all_{side}.obs.json") for side in ("left", "right"))
        assert torch.equal(left.pixels(), right.pixels())
        command("detect", rig, "--topic /left/image_raw --board 6x5 --square 20mm -o", tmp_path / "left.obs.json")
        assert len(Observations.load(tmp_path / "left.obs.json").views) == 3
        (tmp_path / "no bag").touch()
        said = command.refuses("detect", tmp_path / "no bag", "--topic /l --board 6x5 --square 20mm -o x.obs.json")
        assert "--topic is of one bag" in said


class TestDamage:
    def test_a_bag_that_was_not_closed(self, bag: Path, tmp_path: Path) -> None:
        whole = bag if bag.is_file() else next(one for one in bag.iterdir() if one.suffix != ".yaml")
        cut = tmp_path / f"cut{whole.suffix}"
        cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
        with pytest.raises(FileError, match=r"cannot be read as a bag .*ros2 bag reindex or mcap recover repair it"):
            expand_images([cut])

    def test_what_comes_before_the_damage_is_kept(self, tmp_path: Path) -> None:
        noise = np.random.default_rng(0).integers(0, 256, (1024, 1200), np.uint8)
        shots = [(TOPIC, START + i, lambda s, i=i: raw(s, START + i, noise, "mono8")) for i in range(3)]
        bag = write_bag(tmp_path / "run.bag", "ros1", shots)
        data = bytearray(bag.read_bytes())
        # A chunk for each image: the header of the message in the last one.
        last = data.rindex(b"op=\x02", 0, data.rindex(b"conn="))
        data[last : last + 4] = b"xx=\x02"
        bag.write_bytes(data)
        with pytest.warns(KcalWarning, match="cannot be read further .* the 2 images before that are used"):
            assert len(expand_images([bag])) == 2

    def test_without_rosbags(self, bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("rosbags.rosbag1", "rosbags.rosbag2"):
            monkeypatch.setitem(__import__("sys").modules, name, None)
        with pytest.raises(InputError, match=r"pip install 'kcal\[ros\]'"):
            expand_images([bag])

    def test_no_images(self, tmp_path: Path) -> None:
        def text(store):  # type: ignore[no-untyped-def]
            return store.types["std_msgs/msg/String"](data="hello")

        bag = write_bag(tmp_path / "talk", "mcap", [("/chatter", START, text)])
        with pytest.raises(InputError, match="no images in this bag; it has std_msgs/msg/String"):
            bag_images(bag)
