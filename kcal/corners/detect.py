"""Find a board in one image, or in all images of a camera, and say which other board is seen instead."""

from __future__ import annotations

import glob
import hashlib
import itertools
import os
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from kcal.bag import bag_and_topic
from kcal.corners.board import Board
from kcal.corners.circles import find_circles, refine_circles, wrong_size
from kcal.corners.grid import MIN_SHARPNESS, local_side, sharpness
from kcal.corners.images import (
    Gray,
    decode_gray,
    expand_images,
    image_bytes,
    image_header,
    is_video,
    to_8bit,
    unique_names,
)
from kcal.corners.marker_boards import MIN_CORNERS, enough, find_aprilgrid, find_charuco, free_side
from kcal.corners.observations import Failure, Observations, View, common_size, rescaled
from kcal.corners.recognize import (
    Recognized,
    SeenBoard,
    board_of_most,
    seen_board,
    seen_circles,
    seen_instead,
    size_advice,
    spread_order,
)
from kcal.corners.refine import Refinement, refine_corners
from kcal.corners.saddle import CornerStatus, Refined
from kcal.corners.search import NotFoundError, find_board, refine_through_sizes, search_sizes
from kcal.corners.time_limit import Limited, TookTooLongError
from kcal.errors import FileError, InputError
from kcal.files import read_head, source_name
from kcal.opencv import cv2
from kcal.texts import briefly

# What the search for a board in one image gives.

# What is wrong with a corner, and what to do.
_STATUS_TEXTS = {
    CornerStatus.OUTSIDE: ("too near the image's edge", "keep the whole board in the image"),
    CornerStatus.NO_SADDLE: ("not a corner", "hold still and focus"),
    CornerStatus.MOVED: ("moved too far", "hold still and focus"),
    CornerStatus.NOT_CONVERGED: ("did not converge", "hold still, focus, and switch off the camera's sharpening"),
    CornerStatus.SATURATED: ("over- or underexposed", "expose less"),
    CornerStatus.OCCLUDED: ("covered or glaring", "light more evenly, and keep hands off the squares"),
    CornerStatus.BLURRED: ("too blurred", "focus, hold still or move closer"),
}


@briefly
class Detection(NamedTuple):
    """Result of `detect_board`.

    Args:
        pixels: (corners, 2) float64 in the board's order, NaN where not seen; None if no board was found.
        reason: why none was found.
        covariance: (corners, 2, 2) px², if the refinement estimates it.
        legacy: of a ChArUco board, whether its numbering is that of OpenCV before 4.6; None where it makes no
            difference.
        rejected: (N, 2) corners that were found where no board was, if any; NaN for those that were not.
    """

    pixels: Tensor | None
    reason: str = ""
    covariance: Tensor | None = None
    legacy: bool | None = None
    rejected: Tensor | None = None


def too_few(refined: Refined, found: int) -> str:
    """Why too few of the points found could be refined, and what to do."""
    good = int((refined.status == CornerStatus.GOOD).sum())
    counts = Counter(refined.status.tolist())
    why = ", ".join(f"{counts[code]} {text}" for code, (text, _) in _STATUS_TEXTS.items() if counts[code])
    worst = max(_STATUS_TEXTS, key=lambda code: counts[code])
    cure = f"; {_STATUS_TEXTS[worst][1]}" if counts[worst] else ""
    return f"only {good} of {found} corners could be refined ({why}){cure}"


# Detect boards other than plain checkerboards: ChArUco boards, AprilGrids and circles.

MIN_CIRCLES = 0.5  # share of the circles that must be fitted successfully


def detect_marked(image: Gray, board: Board, refine: Refinement, legacy: bool | None = None) -> Detection:
    """Find the visible corners of a ChArUco board or an AprilGrid.

    Args:
        image: (H, W).
        board: with markers.
        refine: see `kcal.corners.refine.refine_corners`.
        legacy: the numbering of a ChArUco board where the image does not tell it.

    Raises:
        NotFoundError: too few are seen, or could be refined.
    """
    tags, grid, told = board.pattern == "aprilgrid", None, None
    if tags:
        pixels, side = find_aprilgrid(to_8bit(image), board)
    else:
        pixels, told = find_charuco(to_8bit(image), board, legacy)
        side, grid = free_side(pixels, board), (board.columns, board.rows)
    seen = int(torch.isfinite(pixels).all(-1).sum())
    refined = refine_corners(image, pixels, side, refine, grid)
    if not enough(refined.pixels, board):
        none = (CornerStatus.NO_SADDLE, CornerStatus.MOVED, CornerStatus.NOT_CONVERGED, CornerStatus.OCCLUDED)
        lacking = tags and sum(int((refined.status == status).sum()) for status in none) > 0.5 * seen
        more = "; the small squares between the tags are needed, as Kalibr draws them" if lacking else ""
        raise NotFoundError(too_few(refined, seen) + more)
    return Detection(refined.pixels, covariance=refined.covariance, legacy=told)


def _detect_circles(image: Gray, board: Board, refine: Refinement) -> Detection:
    if refine not in ("erf", "none"):
        raise InputError(
            f"refine {refine!r}: circles are fitted at their edges (erf), or left as OpenCV finds them (none)"
        )
    pixels, radius = find_circles(to_8bit(image), board)
    if refine == "none":
        return Detection(pixels)
    refined, radius = refine_circles(image, pixels, board, radius)
    good = int((refined.status == CornerStatus.GOOD).sum())
    if (reason := wrong_size(board, radius)) or good < MIN_CIRCLES * board.corners:
        raise NotFoundError(reason or too_few(refined, board.corners))
    return Detection(refined.pixels, covariance=refined.covariance)


# Refuse images that show another board than the one that was asked for.

# What a detection says that has found all corners of another board, or more than this one has.
_OTHER = re.compile(r"a (?:board|grid) of (\d+)x(\d+) inner corners was found")
_LOOKS = 3  # images without the board in which another one is sought
_STOPS = 3, 8  # images without the board, and none with it, after which the search may end
_HEAD = 1 << 17  # bytes of an image that mostly tell its size
_CHECKED = 6  # images without the board, where less than half have it, in which another one is sought
_LOOKED_AT = 24  # images that tell which board they show
_FEW = 0.2  # views, as a share of the images that show one other board: the board was named wrongly


class OtherBoardError(InputError):
    """Images show another board than the one that was asked for.

    Args:
        text: the message.
        images: those without that board, far apart from each other first.
    """

    def __init__(self, text: str, images: Sequence[Any] = ()) -> None:
        super().__init__(text)
        self.images = images


def seen_by_most(failed: Sequence[tuple[Any, str]], board: Board) -> tuple[str, int]:
    """What most of the images show that show another board, and how many do; empty if none does.

    Args:
        failed: images without the board, and why.
        board: that was asked for.
    """
    votes: dict[str, list[str]] = {}
    for number, (file, reason) in enumerate(failed):
        said = _OTHER.search(reason)
        text = size_advice((int(said[1]), int(said[2])), board) if said else ""
        if number < _LOOKS:
            with suppress(FileError):
                _, small, _ = next(search_sizes(to_8bit(image_and_hash(file)[0])))
                # Corners may also be seen between circles.
                text = (seen_circles(small, board, clear=True) or text) if said else seen_instead(small, board)
        if text:
            votes.setdefault(text.rpartition(": ")[2], []).append(text)
    most = max(votes.values(), key=len, default=[""])
    return most[0], len(most) if votes else 0


def refuse_other_board(views: int, failed: Sequence[tuple[Any, str]], count: int, board: Board, least: int = 0) -> None:
    """Refuse images of which none shows the board, or hardly any while most show one other board.

    Args:
        views: in which the board was found.
        failed: images without it, and why.
        count: of all images; fewer than that may have been searched.
        board: that was asked for.
        least: images that must show one other board where none shows this one.

    Raises:
        InputError: so it is; an `OtherBoardError` with what most images show.
    """
    where = f"any of {count} images" if len(failed) == count else f"the first {len(failed)} of {count} images"
    images = [failed[number][0] for number in spread_order(len(failed))]
    if not views:
        text, shown = seen_by_most(failed, board)
        if shown < least:
            return
        if not text:
            raise InputError(f"no board in {where} ({failed[0][1]})")
        raise OtherBoardError(f"no board in {where} ({shown} of them: {text})", images)
    if views <= _FEW * sum(bool(_OTHER.search(reason)) for _, reason in failed):
        text, shown = seen_by_most(failed, board)
        if views <= _FEW * shown:
            raise OtherBoardError(f"the board is in {views} of {count} images only; in {shown} of them {text}", images)
    if 2 * views < count:
        found = recognize_images(images, _CHECKED)
        others = found.votes * len(failed) / max(found.looked, 1)
        # A part of the board does not end in one image and have the same size in others.
        sure = found.sure and found.votes > 1 and others > views
        if sure and found.seen is not None and found.seen.other_than(board):
            raise OtherBoardError(
                f"the board is in {views} of {count} images only; in {found.votes} of {found.looked} others that were "
                f"looked at another one is seen: give --board {found.seen.text}",
                images,
            )


def recognize_images(images: Iterable[Any], most: int, time_limit: float | None = None) -> Recognized:
    """Which board images show, by those that are looked at, the first ones.

    Args:
        images: images, or files; those that cannot be read are passed over.
        most: images to look at.
        time_limit: seconds of CPU time for each.
    """
    seen: list[SeenBoard | None] = []
    found = board_of_most(seen)
    with Limited(time_limit) as limited:
        for image in itertools.islice(images, most):
            with suppress(FileError, TookTooLongError):
                seen.append(limited(seen_board, to_8bit(image_and_hash(image)[0]), found.without_markers))
            found = board_of_most(seen)
            if found.agreed:
                break
    return found


def recognize_board(
    paths: str | Path | Sequence[str | Path | Gray | Tensor] | Gray | Tensor | Iterator[Gray],
    square: str | None = None,
    *,
    time_limit: float | None = None,
    note: Callable[[Recognized], object] | None = None,
) -> Board:
    """Recognize which board images show: checkerboard, ChArUco board, AprilGrid or circles, and its columns and rows.

    Up to 24 images are looked at, far apart from each other, until they agree.

    Args:
        paths: as in `detect`; or an iterator of images, which are looked at in turn.
        square: side of its squares or tags with the unit, such as `25mm`: images do not tell it. Markers and gaps are
            measured in terms of it.
        time_limit: seconds of CPU time for each image; no limit by default.
        note: called with what was recognized, and in how many images.

    Raises:
        InputError: the images show no board, or not one board; or its square is missing.

    Example:
        >>> y, x = np.mgrid[:120, :160]
        >>> on = (x >= 20) & (x < 140) & (y >= 20) & (y < 100)
        >>> image = np.where(on & ((x // 20 + y // 20) % 2 == 0), 40, 220).astype(np.uint8)
        >>> str(recognize_board(image, "25mm"))
        '5x3 inner corners, 25 mm squares'
    """
    if not isinstance(paths, Iterator):
        files = _files_and_images(paths)
        paths = (files[number] for number in spread_order(len(files)))
    found = recognize_images(paths, _LOOKED_AT, time_limit)
    if note is not None and found.seen is not None:
        note(found)
    return found.board(square)


# Find a board in one image, or in all images of a camera.

_SMALLEST = 16  # pixels on a side; smaller images hold no board, and OpenCV's detectors fail on them
MIN_GOOD = 0.5  # share of the corners that must be refined successfully


def detect_board(image: Gray | Tensor, board: Board, refine: Refinement = "erf") -> Detection:
    """Find the inner corners of a checkerboard, the visible ones of a ChArUco board or an AprilGrid, or circles.

    OpenCV's `findChessboardCorners` searches first; where it fails, `findChessboardCornersSB` (A. Duda and U. Frese,
    BMVC 2018). Images above 1200 px are searched at a reduced size and refined in steps of two. The grid found must
    look like the whole board (`kcal.corners.grid.grid_trouble`). It is put into the board's order
    (`kcal.corners.search.canonical_order`) and refined at the image's full size and depth.

    Args:
        image: (H, W) uint8 or uint16, as an array or a tensor; or a tensor (1, H, W) or (3, H, W), also in floating
            point from 0 to 1. The search runs on the CPU; corners are on the tensor's device. They carry no gradient:
            `RefineCorners` has those.
        board: at least 3 points each way, all of them in the image unless it has markers.
        refine: see `kcal.corners.refine.refine_corners`; `erf` of circles is `kcal.corners.circles.refine_circles`.

    Returns:
        The corners, or None with a reason that a person can act on.

    Raises:
        InputError: an image of another shape, dtype or range, a board with 2 inner corners in a row, an unknown method.

    Example:
        >>> y, x = np.mgrid[:120, :160]
        >>> on = (x >= 20) & (x < 140) & (y >= 20) & (y < 100)
        >>> image = np.where(on & ((x // 20 + y // 20) % 2 == 0), 40, 220).astype(np.uint8)
        >>> found = detect_board(image, Board(columns=5, rows=3, square=0.02))
        >>> [round(value, 3) for value in found.pixels[0].tolist()]
        [39.5, 39.5]
        >>> detect_board(image, Board(columns=6, rows=5, square=0.02)).reason
        'a board of 5x3 inner corners was found, not 6x5: give --board 5x3'
    """
    if isinstance(image, Tensor):
        found = detect_board(as_image(image), board, refine)
        moved: dict[str, Any] = {
            name: part.to(image.device) for name, part in found._asdict().items() if isinstance(part, Tensor)
        }
        return found._replace(**moved)
    image = as_image(image)
    if min(board.columns, board.rows) < 3 and board.pattern != "aprilgrid":
        what = "inner corners" if board.pattern == "checkerboard" else "circles"
        raise InputError(
            f"board {board.columns}x{board.rows}: at least 3 {what} in each direction are needed for detection"
        )
    if refine not in get_args(Refinement):
        raise InputError(f"refine {refine!r}: choose one of {', '.join(get_args(Refinement))}")
    if tiny := _too_small(image):
        return Detection(None, tiny)
    try:
        if board.markers:
            return detect_marked(image, board, refine)
        if board.pattern != "checkerboard":
            return _detect_circles(image, board, refine)
    except NotFoundError as error:
        return Detection(None, str(error))
    search = find_board(to_8bit(image), board)
    pixels = search.pixels
    if pixels is None:
        return Detection(None, search.reason, rejected=search.rejected)
    if refine != "none":
        pixels = refine_through_sizes(image, pixels, board, search.factor)
    if sharpness(image, pixels.reshape(board.rows, board.columns, 2)) < MIN_SHARPNESS:
        blurred = "too blurred: edges are nearly as wide as the squares; focus, hold still or move closer"
        return Detection(None, blurred, rejected=pixels)
    side = local_side(pixels, board.columns, board.rows)
    refined = refine_corners(image, pixels, side, refine, (board.columns, board.rows))
    seen = int(torch.isfinite(pixels).all(-1).sum())
    good = int((refined.status == CornerStatus.GOOD).sum())
    if good < max(MIN_GOOD * seen, min(MIN_CORNERS, board.corners)):
        return Detection(None, too_few(refined, seen), rejected=pixels)
    return Detection(refined.pixels, covariance=refined.covariance)


def as_image(image: Gray | Tensor) -> Gray:
    """Gray levels (H, W) as uint8 or uint16 of an array, or of a tensor (H, W), (1, H, W) or (3, H, W) of any device.

    Red, green and blue become gray by OpenCV's weights. Floating point lies in 0 to 1: if all levels are whole shares
    of 255, as after `ToTensor`, the result is the uint8 image, and otherwise uint16.

    Raises:
        InputError: another shape or dtype, levels that are not finite, or a range other than 0 to 1.

    Example:
        >>> as_image(torch.tensor([[[0.0, 0.2, 1.0]]])).tolist()
        [[0, 51, 255]]
    """
    found: Any = image
    if isinstance(image, Tensor):
        found = (image.detach().float() if image.is_floating_point() else image.detach()).cpu().numpy()
    shaped = found.ndim == 2 or (found.ndim == 3 and found.shape[0] in (1, 3))
    if not shaped or not (found.dtype.kind == "f" or found.dtype in (np.uint8, np.uint16)):
        raise InputError(
            f"image: (H, W), (1, H, W) or (3, H, W) of uint8 or uint16, or of floating point from 0 to 1, is needed; "
            f"got {found.shape} {found.dtype}"
        )
    if found.dtype.kind == "f":
        low, high = (float(found.min()), float(found.max())) if found.size else (0.0, 0.0)
        if not (low >= 0.0 and high <= 1.0):
            raise InputError(
                f"image: floating gray levels lie in 0 to 1, got {low:g} to {high:g}; divide by the brightest possible "
                "level, undo a normalization by mean and deviation, or give uint8"
            )
        eight = np.rint(255.0 * found)
        whole = np.abs(255.0 * found - eight).max(initial=0.0) < 1e-3
        found = eight.astype(np.uint8) if whole else np.rint(65535.0 * found).astype(np.uint16)
    if found.ndim == 3:
        rows = np.ascontiguousarray(found.transpose(1, 2, 0))
        found = found[0] if len(found) == 1 else cv2.cvtColor(rows, cv2.COLOR_RGB2GRAY)
    result: Gray = np.ascontiguousarray(found)
    return result


def detect(
    paths: str | Path | Sequence[str | Path | Gray | Tensor] | Gray | Tensor,
    board: Board,
    refine: Refinement = "erf",
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
    note: Callable[[str], object] = warnings.warn,
    on_failure: Callable[[str, Path, Detection], None] | None = None,
) -> Observations:
    """Find the board in the images of one camera.

    An image that cannot be read or shows no board becomes a `Failure` with its reason. The others become views, named
    by their file names (with folders where two files share one). Corners in images that were resized alike are scaled
    to the size that most images have, and images of other sizes left out (`kcal.corners.observations.common_size`).

    Args:
        paths: a folder, a wildcard or an image file, or several of them; or images themselves, as `detect_board`
            takes them: one (H, W), a list, or a batch with four dimensions. They are called `image 0` and so on.
        board: the board.
        refine: see `kcal.corners.refine.refine_corners`.
        progress: called with each image's name when it is done.
        time_limit: seconds after which an image becomes a failure; no limit by default. See
            `kcal.corners.time_limit.Limited`.
        note: called with what was done about images of several sizes; a Python warning by default.
        on_failure: called with the name, path and detection of each readable file that shows no board, for example to
            draw why (`kcal.report.calibration.FailedImage`).

    Raises:
        InputError: no images, no size that more than half of them have, or no board in any image.
        FileError: a folder without images, a wildcard without a match, or a single path that does not exist.

    Example:
        >>> import tempfile
        >>> y, x = np.mgrid[:120, :160]
        >>> on = (x >= 20) & (x < 140) & (y >= 20) & (y < 100)
        >>> image = np.where(on & ((x // 20 + y // 20) % 2 == 0), 40, 220).astype(np.uint8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = cv2.imwrite(f"{folder}/a.png", image), Path(folder, "b.png").write_bytes(b"")
        ...     seen = detect([f"{folder}/a.png", f"{folder}/b.png"], Board(columns=5, rows=3, square=0.02))
        >>> seen.names, seen.image_size, seen.failures[0].reason
        (('a.png',), (160, 120), 'the file is empty; copy it again')
    """
    files = _files_and_images(paths)
    short = iter(unique_names([file for file in files if isinstance(file, Path)]))
    names = [next(short) if isinstance(file, Path) else f"image {i}" for i, file in enumerate(files)]
    sources = dict(zip(names, files, strict=True))
    views: list[View] = []
    failures: list[Failure] = []
    failed: list[tuple[Any, str]] = []
    numberings: dict[bool | None, list[str]] = {}
    common = common_size(names, [size_of(file) for file in files])
    for text in common.notes:
        note(text)
    with Limited(time_limit) as limited:
        for i, (name, file) in enumerate(zip(names, files, strict=True)):
            try:
                if i in common.left_out:
                    raise FileError(common.left_out[i])
                image, digest = image_and_hash(file)
            except FileError as error:
                failures.append(Failure(name=name, reason=str(error).removeprefix(f"{file}: ")))
                if i not in common.left_out:
                    failed.append((file, f"{name}: {failures[-1].reason}"))
            else:
                try:
                    found = limited(detect_board, image, board, refine)
                except TookTooLongError as error:
                    found = Detection(None, str(error))
                if found.pixels is None:
                    failures.append(Failure(name=name, reason=found.reason))
                    failed.append((file, f"{name}: {found.reason}"))
                    if not views and len(failed) in _STOPS:
                        refuse_other_board(0, failed, len(files), board, least=(len(failed) + 1) // 2 + 1)
                    if on_failure is not None and isinstance(file, Path):
                        on_failure(name, file, found)
                else:
                    numberings.setdefault(found.legacy, []).append(name)
                    views.append(view_of(found, name, image=str(file) if digest else None, sha256=digest))
            if progress is not None:
                progress(name)
    refuse_other_board(len(views), failed, len(files) - len(common.left_out), board)
    if True in numberings:
        views = _renumbered(views, sources, numberings, board, refine)
    scales = {names[i]: scale for i, scale in common.scales.items()}
    views = [rescaled(view, scales[view.name]) if view.name in scales else view for view in views]
    return Observations(
        board=board, image_size=common.size, refinement=refine, views=tuple(views), failures=tuple(failures)
    )


def _files_and_images(paths: Any) -> list[Any]:
    """Files as paths, in place of folders and wildcards, and images as they are; see `detect`."""
    if hasattr(paths, "shape"):
        if len(paths.shape) not in (2, 4):
            raise InputError(f"images: one (H, W), a batch (B, 1, H, W) or a list is needed, got {tuple(paths.shape)}")
        return [paths] if len(paths.shape) == 2 else list(paths)
    if isinstance(paths, str | Path):
        if is_video(paths):
            raise InputError(f"{source_name(paths)}: a video; kcal.corners.detect_video searches its frames")
        return list(expand_images([paths]))
    found: list[Any] = []
    for one in paths:
        if hasattr(one, "shape"):
            if len(one.shape) == 3 and one.shape[-1] in (3, 4):
                raise InputError(
                    f"image {len(found)}: a color image {tuple(one.shape)}; give its gray levels, for "
                    "example cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)"
                )
            found.append(one)
        elif os.path.isdir(one) or bag_and_topic(one) or (glob.has_magic(str(one)) and not os.path.exists(one)):
            found += expand_images([one])
        else:
            found.append(Path(one))
    if not found:
        raise InputError("no images given")
    return found


def image_and_hash(source: Any) -> tuple[Any, str | None]:
    """An image, and the hash of its file's bytes if it comes from one.

    Raises:
        FileError: the file cannot be read, or the image is too small to be searched.
    """
    data = image_bytes(source) if isinstance(source, Path) else None
    image = as_image(source) if data is None else decode_gray(data, source)
    if tiny := _too_small(image):
        raise FileError(tiny)
    return image, None if data is None else hashlib.sha256(data).hexdigest()


def _too_small(image: Gray) -> str:
    return f"the image has only {image.shape[1]}x{image.shape[0]} pixels" if min(image.shape) < _SMALLEST else ""


def _renumbered(
    views: Sequence[View],
    sources: dict[str, Any],
    numberings: dict[bool | None, list[str]],
    board: Board,
    refine: Refinement,
) -> list[View]:
    """Views of a ChArUco board of the old numbering: images that do not tell it are read anew, as the others tell.

    Raises:
        InputError: some images tell the numbering of today.
    """
    if False in numberings:
        raise InputError(
            f"two ChArUco boards: {numberings[True][0]} shows the numbering of OpenCV before 4.6, "
            f"{numberings[False][0]} that of today; detect the images of each board apart"
        )
    unclear, out = set(numberings.get(None, ())), []
    for view in views:
        if view.name in unclear:
            with suppress(NotFoundError):
                found = detect_marked(image_and_hash(sources[view.name])[0], board, refine, legacy=True)
                out.append(view_of(found, view.name, image=view.image, sha256=view.sha256))
        else:
            out.append(view)
    return out


def limit_threads(count: int) -> None:
    """Limit the threads of OpenCV and of torch in this process, for work that is already spread over processes."""
    cv2.setNumThreads(count)
    torch.set_num_threads(count)


def view_of(found: Detection, name: str, image: str | None = None, sha256: str | None = None) -> View:
    """Convert a detection to a view of an observations file.

    Raises:
        InputError: nothing was detected.
    """
    if found.pixels is None:
        raise InputError(f"{name}: {found.reason}")
    spread = None if found.covariance is None else found.covariance.reshape(-1, 4)[:, [0, 1, 3]]
    corners: dict[str, Any] = {"pixels": found.pixels, "covariance": spread}
    return View(name=name, image=image, sha256=sha256, **corners)


def _size(image: Any) -> tuple[int, int]:
    return image.shape[-1], image.shape[-2]


def size_of(file: Any) -> tuple[int, int] | None:
    """(width, height), without decoding the image where its header tells it."""
    if not isinstance(file, Path):
        return _size(file)
    try:
        try:
            width, height = image_header(read_head(file, _HEAD), file)
        except FileError:
            width, height = image_header(image_bytes(file), file)
        return (width, height) if width else _size(image_and_hash(file)[0])
    except FileError:
        return None
