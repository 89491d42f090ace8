"""Find a board in one image, or in all images of a camera."""

from __future__ import annotations

import glob
import hashlib
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.charuco import MIN_CORNERS
from kcal.corners.detect_targets import detect_charuco, detect_target
from kcal.corners.detection import Detection, too_few
from kcal.corners.grid import MIN_SHARPNESS, local_side, sharpness
from kcal.corners.grid_check import without_false_sides
from kcal.corners.images import VIDEO_SUFFIXES, Gray, decode_gray, expand_images, to_8bit, unique_names
from kcal.corners.observations import Failure, Observations, View
from kcal.corners.refine import Refinement, refine_corners
from kcal.corners.saddle import CornerStatus
from kcal.corners.search import SEARCH_SIDES, find_board, largest_grid, reduced, refine_through_sizes
from kcal.corners.seen_instead import seen_instead
from kcal.corners.sizes import common_size, rescaled, resized_alike
from kcal.corners.time_limit import Limited, TookTooLongError
from kcal.errors import FileError, InputError
from kcal.files import is_stream, read_bytes, source_name

_THOROUGH = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
MIN_GOOD = 0.5  # share of the corners that must be refined successfully


def detect_board(image: Gray | Tensor, board: Board, refine: Refinement = "erf") -> Detection:
    """Find the inner corners of a checkerboard, the visible ones of a ChArUco board or an AprilGrid, or circles.

    OpenCV's `findChessboardCorners` searches first; where it fails, `findChessboardCornersSB` (A. Duda and U. Frese,
    BMVC 2018). Images above 1200 px are searched at a reduced size and refined in steps of two. The grid found must
    look like the whole board (`kcal.corners.grid_check.grid_trouble`). It is put into the board's order
    (`kcal.corners.order.canonical_order`) and refined at the image's full size and depth.

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
    if board.pattern != "checkerboard" or board.dictionary is not None:
        return detect_target(image, board, refine)
    search = find_board(to_8bit(image), board)
    pixels = search.pixels
    if pixels is None:
        return Detection(None, search.reason, rejected=search.rejected)
    if refine != "none":
        pixels = refine_through_sizes(image, pixels, board, search.factor)
    if sharpness(image, pixels, board.columns, board.rows) < MIN_SHARPNESS:
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
    to the size that most images have (`kcal.corners.sizes`).

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
        InputError: no images, images that were cropped or rotated, or no board in any image.
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
    sizes: list[tuple[int, int] | None] = []
    numberings: dict[bool | None, list[str]] = {}
    with Limited(time_limit) as limited:
        for name, file in zip(names, files, strict=True):
            try:
                image, digest = _image_and_hash(file)
            except FileError as error:
                failures.append(Failure(name=name, reason=str(error).removeprefix(f"{file}: ")))
                sizes.append(None)
            else:
                sizes.append(_size(image))
                first_size = next(size for size in sizes if size)
                if _size(image) != first_size and not resized_alike(_size(image), first_size):
                    # Named at once, not after the search of all images.
                    common_size(names, [_size_of(file) for file in files])
                try:
                    found = limited(detect_board, image, board, refine)
                except TookTooLongError as error:
                    found = Detection(None, str(error))
                if found.pixels is None:
                    failures.append(Failure(name=name, reason=found.reason))
                    if on_failure is not None and isinstance(file, Path):
                        on_failure(name, file, found)
                else:
                    numberings.setdefault(found.legacy, []).append(name)
                    views.append(view_of(found, name, image=str(file) if digest else None, sha256=digest))
            if progress is not None:
                progress(name)
    if not views:
        first = f"{failures[0].name}: {failures[0].reason}"
        raise InputError(f"no board in any of {len(files)} images ({first}){_hint(files, board)}")
    if True in numberings:
        views = _renumbered(views, sources, numberings, board, refine)
    common = common_size(names, sizes)
    if common.note:
        note(common.note)
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
        if is_stream(paths) or Path(paths).suffix.lower() in VIDEO_SUFFIXES:
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
        elif os.path.isdir(one) or (glob.has_magic(str(one)) and not os.path.exists(one)):
            found += expand_images([one])
        else:
            found.append(Path(one))
    if not found:
        raise InputError("no images given")
    return found


def _image_and_hash(source: Any) -> tuple[Any, str | None]:
    """An image, and the hash of its file's bytes if it comes from one."""
    if not isinstance(source, Path):
        return as_image(source), None
    data = read_bytes(source)
    return decode_gray(data, source), hashlib.sha256(data).hexdigest()


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
            found = detect_charuco(_image_and_hash(sources[view.name])[0], board, refine, legacy=True)
            if found.pixels is not None:
                out.append(view_of(found, view.name, image=view.image, sha256=view.sha256))
            continue
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
    pixels = tuple(None if u != u else (u, v) for u, v in found.pixels.tolist())
    spread = None
    if found.covariance is not None:
        packed = found.covariance.reshape(-1, 4)[:, [0, 1, 3]].tolist()
        spread = tuple(None if uu != uu else (uu, uv, vv) for uu, uv, vv in packed)
    return View(name=name, pixels=pixels, covariance=spread, image=image, sha256=sha256)


def _size(image: Any) -> tuple[int, int]:
    return image.shape[-1], image.shape[-2]


def _size_of(file: Any) -> tuple[int, int] | None:
    try:
        return _size(_image_and_hash(file)[0])
    except FileError:
        return None


def _hint(files: list[Any], board: Board) -> str:
    """Which board the first images show, if they show another one."""
    for file in files[:3]:
        try:
            image = to_8bit(_image_and_hash(file)[0])
        except FileError:
            continue
        small = to_8bit(reduced(image, max(1.0, max(image.shape) / SEARCH_SIDES[0]), _size(image))[0])
        if other := seen_instead(small, board, seen_size):
            return f"; {other}"
    return ""


def seen_size(image: Gray) -> tuple[int, int] | None:
    """Inner corners, the larger number first, of the largest checkerboard grid in an image; None if there is none.

    Example:
        >>> y, x = np.mgrid[:240, :320]
        >>> on = (x >= 40) & (x < 280) & (y >= 40) & (y < 200)
        >>> seen_size(np.where(on & ((x // 40 + y // 40) % 2 == 0), 40, 220).astype(np.uint8))
        (5, 3)
    """
    grid = largest_grid(image, _THOROUGH)
    if grid is not None:
        grid = without_false_sides(image, grid)
    return None if grid is None else (max(grid.shape[:2]), min(grid.shape[:2]))
