"""Read image files as gray pixels or as stored, and list the files that folders and wildcards stand for.

Pixels are always in the order in which the sensor wrote them. An EXIF orientation tag is ignored: a phone that was
turned between two shots would otherwise swap width and height, and the lens does not turn with the tag.

Raw images are developed here, by LibRaw, so that no pixel moves: all pixels of the sensor that are exposed (a few more
than the camera's own JPEG has, with another principal point), linear in the light, black subtracted, white as the
camera balanced it. Colors are interpolated linearly between neighbors of the same color on both sides: methods that
follow edges shift them. No lens is corrected.
"""

from __future__ import annotations

import datetime
import glob
import importlib.util
import io
import os
import re
import tempfile
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import ExifTags, Image, UnidentifiedImageError
from PIL.JpegImagePlugin import JpegImageFile

from kcal.bag import bag_and_topic, name_of, open_bag, stamp_in
from kcal.errors import FileError, InputError
from kcal.file_kind import check_image_header, check_pixel_count, is_heif
from kcal.files import is_stream, read_bytes, read_head
from kcal.opencv import cv2

Gray = npt.NDArray[np.uint8 | np.uint16]

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".pnm", ".jp2"})
# Those that need Pillow's plug-in, and those that must be developed first.
HEIF_SUFFIXES = frozenset({".heic", ".heif", ".avif"})
RAW_SUFFIXES = frozenset(
    {".cr2", ".cr3", ".nef", ".nrw", ".arw", ".dng", ".orf", ".rw2", ".raf", ".pef", ".srw", ".3fr", ".iiq", ".x3f"}
)
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg"})
MIN_IMAGE_SIDE = 16

_decoding = threading.Lock()
# libjpeg fills what it could not decode with gray and only prints a warning. Spare bytes before the end mark (0xd9) are
# harmless and usual in frames of web cameras.
_BROKEN_JPEG = re.compile(
    rb"(Corrupt JPEG data: (?!\d+ extraneous bytes before marker 0xd9)[^\r\n]*|Premature end of JPEG[^\r\n]*)"
)


def decode_gray(data: bytes, source: str | Path) -> Gray:
    """Decode an image file's bytes to gray levels, (H, W) uint8 or uint16 as stored; `source` names it in errors.

    Colors become gray by OpenCV's weights (ITU-R BT.601). The EXIF orientation is ignored.

    Raises:
        FileError: empty, not an image, more than 500 megapixels, truncated or corrupt (also where the decoder would
            fill the rest with gray), pixels other than 8 or 16 bit unsigned, smaller than 16 pixels, or of one gray
            level.
    """
    image = _decoded(data, source, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    height, width = image.shape
    if min(height, width) < MIN_IMAGE_SIDE:
        raise FileError(f"{source}: {width}x{height} pixels are too few; {MIN_IMAGE_SIDE} in each direction are needed")
    if image.min() == image.max():
        raise FileError(f"{source}: every pixel has the same gray level; the image shows nothing")
    return image


def decode_image(data: bytes, source: str | Path) -> Gray:
    """Decode an image file's bytes as stored: gray (H, W), RGB (H, W, 3) or RGBA (H, W, 4), uint8 or uint16.

    The EXIF orientation is ignored: row 0 is the row the sensor read first, because the lens does not turn with it.

    Raises:
        FileError: empty, not an image, more than 500 megapixels, truncated or corrupt, or pixels other than 8 or 16
            bits unsigned; `source` names it.
    """
    image = _decoded(data, source, cv2.IMREAD_UNCHANGED)
    if image.ndim == 2:
        return image
    colors: npt.NDArray[Any] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)
    return colors


def read_gray(path: str | Path) -> Gray:
    """Read an image file to gray levels, (H, W) uint8 or uint16 as stored.

    Raises:
        FileError: missing, empty, or refused by `decode_gray`.

    Example:
        >>> import cv2, numpy as np, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = cv2.imwrite(f"{folder}/ramp.png", np.arange(65536, dtype=np.uint16).reshape(256, 256))
        ...     image = read_gray(f"{folder}/ramp.png")
        >>> image.dtype, image.shape
        (dtype('uint16'), (256, 256))
    """
    return decode_gray(image_bytes(path), path)


def image_bytes(path: str | Path) -> bytes:
    """The bytes of an image file, or of an image in a bag as such a file.

    Raises:
        FileError: missing or damaged, or pixels of a kind that kcal does not read.
    """
    bag = bag_and_topic(Path(path).parent) if (stamp := stamp_in(path)) is not None else None
    if bag is None or stamp is None:
        return read_bytes(path)
    return _as_file(open_bag(bag[0]).image(bag[1], stamp), path)


def bag_images(source: str | Path) -> list[Path] | None:
    """The images of a bag's topic in the order of their stamps, by which they are named; None if it is no bag.

    Raises:
        FileError: it cannot be read.
        InputError: no such topic, or several and none is named.
    """
    if (found := bag_and_topic(source)) is None:
        return None
    bag = open_bag(found[0])
    topic = bag.image_topic(found[1])
    return [Path(f"{found[0]}:{topic}", name_of(stamp)) for stamp in bag.stamps(topic)]


# Pixels of `sensor_msgs/Image` by their encoding: bytes of a sample, samples, and how OpenCV makes colors of them.
_PIXELS: dict[str, tuple[int, int, int | None]] = {
    f"{name}{8 * size}": (size, samples, convert)
    for size in (1, 2)
    for name, samples, convert in (
        ("mono", 1, None), ("rgb", 3, None), ("bgr", 3, cv2.COLOR_BGR2RGB),
        ("rgba", 4, cv2.COLOR_RGBA2RGB), ("bgra", 4, cv2.COLOR_BGRA2RGB),
        ("bayer_rggb", 1, cv2.COLOR_BayerRGGB2RGB), ("bayer_bggr", 1, cv2.COLOR_BayerBGGR2RGB),
        ("bayer_gbrg", 1, cv2.COLOR_BayerGBRG2RGB), ("bayer_grbg", 1, cv2.COLOR_BayerGRBG2RGB),
    )
}  # fmt: skip
_PIXELS |= {
    "8UC1": _PIXELS["mono8"], "8UC3": _PIXELS["bgr8"], "8UC4": _PIXELS["bgra8"], "16UC1": _PIXELS["mono16"],
    **dict.fromkeys(("yuv422", "uyvy"), (1, 2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (1, 2, cv2.COLOR_YUV2RGB_YUY2)),
}  # fmt: skip


def _as_file(message: Any, source: str | Path) -> bytes:
    """The file of an image message: the one in it, or PGM or PPM of its pixels."""
    data = np.ascontiguousarray(message.data, np.uint8)
    compressed = getattr(message, "format", None)
    encoding = message.encoding if compressed is None else compressed.partition(";")[0].strip()
    if compressed is not None:
        if "compresseddepth" in compressed.lower() or not re.search("jpe?g|png", compressed.lower()):
            raise FileError(f"{source}: an image in the format {compressed!r}; kcal reads jpeg and png")
        # image_transport compresses a mosaic of colors as if it were gray.
        if not encoding.startswith("bayer_"):
            return data.tobytes()
    if encoding not in _PIXELS:
        raise FileError(f"{source}: pixels in the encoding {encoding!r}; kcal reads {', '.join(_PIXELS)}")
    size, samples, convert = _PIXELS[encoding]
    if compressed is not None:
        pixels = _decoded(data.tobytes(), source, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    else:
        height, width, step, row = message.height, message.width, message.step, message.width * size * samples
        # Some drivers leave out what fills the last row.
        if not (0 < row <= step and height > 0 and (height - 1) * step + row <= data.size):
            raise FileError(f"{source}: {width}x{height} px in rows of {step} bytes do not fit {data.size} bytes")
        rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1))
        stored = np.ascontiguousarray(rows).view(f"{'>' if message.is_bigendian else '<'}u{size}")
        pixels = stored.astype(f"u{size}").reshape(height, width, samples)
    shown = pixels if convert is None else cv2.cvtColor(pixels, convert)
    height, width, colors = (*shown.shape, 1)[:3]
    head = f"P{6 if colors == 3 else 5} {width} {height} {255 if shown.dtype == np.uint8 else 65535}\n"
    return head.encode() + shown.astype(shown.dtype.newbyteorder(">")).tobytes()


def to_8bit(image: Gray) -> npt.NDArray[np.uint8]:
    """Convert an image to 8 bits per pixel for detectors; refinement should use the full depth.

    uint8 is returned unchanged. uint16 is stretched linearly so that its 0.1 % darkest pixels become 0 and its 0.1 %
    brightest 255, because cameras store 10, 12 or 14 bits in 16, and a few hot pixels must not make the board black.

    Example:
        >>> to_8bit(np.array([[0, 2048, 4095]], dtype=np.uint16))
        array([[  0, 128, 255]], dtype=uint8)
    """
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    low, high = (float(level) for level in np.percentile(image, (0.1, 99.9)))
    if not high > low:
        low, high = float(image.min()), float(image.max())
    stretched = (image.astype(np.float32) - low) * (255.0 / max(high - low, 1.0))
    return np.clip(np.rint(stretched), 0, 255).astype(np.uint8)


def is_video(source: str | Path) -> bool:
    """Whether a source is a live stream, or a file that is a video by its suffix."""
    return is_stream(source) or Path(source).suffix.lower() in VIDEO_SUFFIXES


def expand_images(inputs: str | Path | Sequence[str | Path]) -> list[Path]:
    """List the image files that files, folders and wildcards stand for, each file once.

    A folder stands for the images directly inside it (by suffix), a wildcard for the files it matches; both in natural
    order (`2.jpg` before `10.jpg`). HEIC and raw images of cameras are among them unless the folder has the same image
    in another format: what cannot be read is told with what to do. A bag, or `run.mcap:/left/image_raw`, stands for the
    images of its topic.

    Raises:
        InputError: no input at all.
        FileError: a file or folder that does not exist, a folder without images, a wildcard without a match.

    Example:
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("10.jpg", "2.jpg", "notes.txt"):
        ...         _ = Path(folder, name).write_bytes(b"x")
        ...     [path.name for path in expand_images([folder])]
        ['2.jpg', '10.jpg']
    """
    inputs = [inputs] if isinstance(inputs, str | Path) else inputs
    if not inputs:
        raise InputError("no images given; name image files, folders or wildcards")
    found: dict[Path, Path] = {}
    for given in inputs:
        for path in _expand_one(Path(given)):
            found.setdefault(path.resolve(), path)
    return list(found.values())


def unique_names(paths: Sequence[Path]) -> list[str]:
    """A short unique name for each file: its file name, preceded by as many folders as needed.

    Example:
        >>> unique_names([Path("a/1/x.jpg"), Path("b/1/x.jpg"), Path("y.jpg")])
        ['a/1/x.jpg', 'b/1/x.jpg', 'y.jpg']
    """
    parts = [path.parts for path in paths]
    deepest = max((len(part) for part in parts), default=1)
    names = [path.name for path in paths]
    for depth in range(2, deepest + 1):
        twice = {name for name, count in Counter(names).items() if count > 1}
        if not twice:
            break
        names = ["/".join(part[-depth:]) if name in twice else name for name, part in zip(names, parts, strict=True)]
    return names


def _expand_one(path: Path) -> list[Path]:
    if (images := bag_images(path)) is not None:
        return images
    # Unlike Path's, these say no where a name is too long.
    if os.path.isdir(path):
        inside = [file for file in path.iterdir() if not file.name.startswith(".") and file.is_file()]
        usual = [file for file in inside if file.suffix.lower() in IMAGE_SUFFIXES]
        twins = {file.stem for file in usual}
        others = [file for file in inside if file.suffix.lower() in HEIF_SUFFIXES | RAW_SUFFIXES]
        images = _natural([*usual, *(file for file in others if file.stem not in twins)])
        if not images:
            raise FileError(f"{path}: no image in this folder (looked for {', '.join(sorted(IMAGE_SUFFIXES))})")
        return images
    if os.path.exists(path):
        return [path]
    if glob.has_magic(str(path)):
        matches = _natural(Path(match) for match in glob.glob(str(path), recursive=True) if not os.path.isdir(match))
        if not matches:
            raise FileError(f"{path}: no file matches")
        return matches
    raise FileError(f"{path}: no such file or folder")


def _natural(paths: Iterable[Path]) -> list[Path]:
    def key(path: Path) -> list[tuple[int, int, str]]:
        pieces = re.split(r"(\d+)", str(path))
        return [(0, int(piece), "") if piece.isdecimal() else (1, 0, piece.casefold()) for piece in pieces]

    return sorted(paths, key=lambda path: (key(path), str(path)))


def _decoded(data: bytes, source: str | Path, flags: int) -> npt.NDArray[Any]:
    if Path(source).suffix.lower() in RAW_SUFFIXES:
        colors = _developed(data, source)
        way = cv2.COLOR_RGB2BGR if flags == cv2.IMREAD_UNCHANGED else cv2.COLOR_RGB2GRAY
        return np.asarray(cv2.cvtColor(colors, way))
    if is_heif(data):
        picture = _opened_heif(data, source)
        stored = picture.transpose(_UNDONE[turns]) if (turns := _heif_turns(data)) else picture
        if flags != cv2.IMREAD_UNCHANGED:
            return np.asarray(stored.convert("L"))
        return np.ascontiguousarray(np.asarray(stored.convert("RGB"))[..., ::-1])
    image_header(data, source)
    image, complaints = _imdecode(data, flags)
    broken = _BROKEN_JPEG.search(complaints)
    if image is None:
        raise FileError(f"{source}: the image is truncated or corrupt; copy it again or leave it out")
    if broken:
        raise FileError(f"{source}: {broken.group().decode(errors='replace').strip()}; copy it again or leave it out")
    if image.dtype not in (np.uint8, np.uint16):
        raise FileError(f"{source}: pixels are {image.dtype}; store the image with 8 or 16 bits unsigned")
    return image


def image_header(data: bytes, source: str | Path) -> tuple[int, int]:
    """(width, height) as stored, or (0, 0) where only the decoder tells; see `check_image_header`.

    Raises:
        FileError: no image that can be read, with what to do.
    """
    if Path(source).suffix.lower() in RAW_SUFFIXES:
        with _opened_raw(data, source) as (_, raw):
            return int(raw.sizes.width), int(raw.sizes.height)
    if not is_heif(data):
        return check_image_header(data, source)
    width, height = _opened_heif(data, source).size
    return (height, width) if _heif_turns(data) % 2 else (width, height)


@contextmanager
def _opened_raw(data: bytes, source: str | Path) -> Iterator[tuple[Any, Any]]:
    """rawpy, and a raw image in it."""
    try:
        rawpy = importlib.import_module("rawpy")
    except ImportError:
        raise FileError(
            f"{source}: a raw image, which needs one more package: pip install 'kcal[images]'; or take the JPEG that "
            "the camera stored with it, of all images alike"
        ) from None
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            check_pixel_count((raw.sizes.width, raw.sizes.height))
            yield rawpy, raw
    except (rawpy.LibRawError, rawpy.NotSupportedError, ValueError) as error:
        text = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        raise FileError(
            f"{source}: a raw image that LibRaw cannot read ({text}); save it as TIFF without corrections of the lens"
        ) from error


def _developed(data: bytes, source: str | Path) -> npt.NDArray[np.uint16]:
    """RGB (H, W, 3) of a raw image, as the head of this module says."""
    with _opened_raw(data, source) as (rawpy, raw):
        colors = raw.postprocess(
            demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR, output_color=rawpy.ColorSpace.raw, use_camera_wb=True,
            gamma=(1, 1), no_auto_bright=True, adjust_maximum_thr=0.0, output_bps=16, user_flip=0,
        )  # fmt: skip
        if colors.shape[:2] != (raw.sizes.height, raw.sizes.width):
            raise ValueError("its pixels are not square, or lie obliquely, and would have to be resampled")
    return np.ascontiguousarray(np.broadcast_to(colors, (*colors.shape[:2], 3)))


# Quarter turns to the left that a decoder of HEIC carries out, as the file's box `irot` says, and how to undo them.
_IROT = re.compile(rb"\0\0\0\x09irot(.)", re.DOTALL)
_UNDONE = {1: Image.Transpose.ROTATE_270, 2: Image.Transpose.ROTATE_180, 3: Image.Transpose.ROTATE_90}


def _opened_heif(data: bytes, source: str | Path) -> Image.Image:
    """A HEIC, HEIF or AVIF image, by Pillow or its plug-in."""
    with suppress(ImportError):
        importlib.import_module("pillow_heif").register_heif_opener()
    try:
        picture = Image.open(io.BytesIO(data))
    except UnidentifiedImageError:
        if importlib.util.find_spec("pillow_heif"):
            raise FileError(f"{source}: the image is truncated or corrupt; copy it again or leave it out") from None
        raise FileError(
            f"{source}: a HEIC image, which needs one more package: pip install 'kcal[images]'; or convert it to PNG"
        ) from None
    check_pixel_count(picture.size)
    return picture


def _heif_turns(data: bytes) -> int:
    # Decoders of AVIF leave pixels as they are stored.
    found = None if data[8:12] in (b"avif", b"avis") else _IROT.search(data, 0, _EXIF_HEAD)
    return found[1][0] & 3 if found else 0


def _imdecode(data: bytes, flags: int) -> tuple[npt.NDArray[Any] | None, bytes]:
    """`cv2.imdecode`, and what the decoders print to the error stream: the C libraries report damage nowhere else."""
    with _decoding, tempfile.TemporaryFile() as caught:
        try:
            saved = os.dup(2)
        except OSError:  # no error stream at all (a service): nothing to catch
            return _decode(data, flags), b""
        try:
            os.dup2(caught.fileno(), 2)
            image = _decode(data, flags)
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        caught.seek(0)
        return image, caught.read()


def _decode(data: bytes, flags: int) -> npt.NDArray[Any] | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None


# What a camera wrote into an image besides its pixels: when it was taken, and how it was held.

# When an image was taken: from its name, or from what the camera wrote into it.

# 20260501T120000, 2026-05-01_12-00-00 and the like, perhaps with a fraction of a second (of a telephone, 120000123) and
# a zone; or Unix seconds.
_DATE_IN_NAME = re.compile(
    r"(\d{4})-?(\d{2})-?(\d{2})[T_ -](\d{2})[-_:]?(\d{2})[-_:]?(\d{2})(?:[.,](\d{1,9})(?!\d)|(\d{3})(?!\d))?"
    r"(Z(?![A-Za-z])|\+[01]\d:?[0-5]\d(?!\d)|-[01]\d:[0-5]\d(?!\d))?"
)
_UNIX = re.compile(r"(?<![\d.])(1\d{9}(?:\.\d+)?)(?![\d])")
_HEAD = 1 << 18


def time_in_name(name: str) -> datetime.datetime | None:
    """The time that the name of a file tells, with its zone if it has one; None: none.

    Example:
        >>> time_in_name("left_2026-05-01_12-00-00.250.png").isoformat()
        '2026-05-01T12:00:00.250000'
        >>> time_in_name("20260501T120000+0200.png").isoformat()
        '2026-05-01T12:00:00+02:00'
    """
    found = _DATE_IN_NAME.search(name)
    if found is None:
        return None
    fraction, zone = found[7] or found[8] or "0", found[9]
    try:
        time = datetime.datetime(*map(int, found.groups()[:6]))  # type: ignore[arg-type]
    except ValueError:
        return None
    time += datetime.timedelta(seconds=float(f"0.{fraction}"))
    return time.replace(tzinfo=datetime.datetime.strptime(zone, "%z").tzinfo if zone else None)


def image_time(path: Path) -> float:
    """Unix seconds at which an image was taken: from a date or Unix seconds in its name, or from EXIF.

    Without a zone, a time in a name is UTC.

    The time of the file is not taken: a copy has another one.

    Raises:
        FileError: it has no time.

    Example:
        >>> image_time(Path("left_20260101T000000Z.png")), image_time(Path("right_1767225600.5.png"))
        (1767225600.0, 1767225600.5)
    """
    if moment := time_in_name(path.name):
        return moment.replace(tzinfo=moment.tzinfo or datetime.UTC).timestamp()
    if unix := _UNIX.search(path.name):
        return float(unix.group(1))
    try:
        tags = Image.open(io.BytesIO(read_head(path, _HEAD))).getexif().get_ifd(ExifTags.IFD.Exif)
        text, zone = (
            str(tags.get(ExifTags.Base.DateTimeOriginal, "")),
            str(tags.get(ExifTags.Base.OffsetTimeOriginal, "")),
        )
        moment = datetime.datetime.strptime(f"{text} {zone or '+00:00'}", "%Y:%m:%d %H:%M:%S %z")
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        raise FileError(
            f"{path}: no time of capture, neither in its name nor in it; name it like 20260501T120000Z.png (UTC)"
        ) from None
    return moment.timestamp()


# Read the EXIF orientation of JPEG files. kcal ignores it, and says so.

_EXIF_HEAD = 1 << 17  # bytes: the EXIF block is among the first 64 KiB, another block may precede it


def exif_orientation(data: bytes) -> int:
    """The orientation (1 to 8) that a JPEG's EXIF block, or a HEIC file, asks viewers for; 1 where there is none.

    3 is turned by 180°, 6 and 8 by 90°; 2, 4, 5 and 7 are mirrored as well. Pixels in kcal are always as stored.
    Source: JEITA CP-3451 (Exif 2.3), tag 0x0112.

    Args:
        data: the file's bytes, or the first of them.

    Example:
        >>> exif_orientation(b"no JPEG")
        1
    """
    if is_heif(data):
        return (1, 8, 3, 6)[_heif_turns(data)]
    try:
        orientation = JpegImageFile(io.BytesIO(data)).getexif().get(ExifTags.Base.Orientation, 1)
    except (SyntaxError, OSError, ValueError):  # no JPEG, or a damaged one: `decode_gray` reports it
        return 1
    return int(orientation) if orientation in range(1, 9) else 1


def turned_images(paths: Sequence[str | Path]) -> list[Path]:
    """Those of the files whose EXIF block asks viewers to turn or mirror them.

    Raises:
        FileError: a file that cannot be read.
    """
    return [path for path in map(Path, paths) if exif_orientation(read_head(path, _EXIF_HEAD)) != 1]
