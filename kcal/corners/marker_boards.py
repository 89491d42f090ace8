"""Find boards with markers, of which a visible part is enough: ChArUco boards, and the AprilGrids of Kalibr."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import TAGS, Board
from kcal.corners.erf import SHARE
from kcal.corners.grid import as_grid, local_side
from kcal.corners.markers import opencv_dictionary
from kcal.corners.saddle import CornerStatus, inside_image, saddle
from kcal.corners.search import NotFoundError, filled_grid
from kcal.errors import InputError
from kcal.opencv import cv2

# Whether markers lie in an image as they lie on a board.

_NEIGHBORS = 4  # markers that tell where one should be: few, because lenses bend the board
_TRIES = 60  # pairs; nearly all of a board's markers agree, or hardly any


def inliers(
    placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating], tolerance: float
) -> npt.NDArray[np.bool_]:
    """Which markers (M,) lie within `tolerance` of where one homography puts them.

    The homography is that of the two markers, near each other or not, with which most of the others agree; a wide lens
    bends the board, so that not all of it follows one.

    Args:
        placed: (M, 4, 2) corners on the board.
        seen: (M, 4, 2) in the image.
        tolerance: mean distance of a marker's corners, in the board's units.

    Example:
        >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> placed = np.stack([square, square + [2, 0], square + [0, 2], square + [2, 2]])
        >>> inliers(placed, 10 * placed + 5, 0.1).sum(), inliers(placed[[0, 1, 3, 2]], 10 * placed + 5, 0.1).sum()
        (np.int64(4), np.int64(2))
    """
    if len(placed) < 2:
        return np.ones(len(placed), bool)
    pairs = np.stack(np.triu_indices(len(placed), 1), 1)
    pairs = pairs[:: max(1, len(pairs) // _TRIES)]
    # All pairs at once, by linear least squares in units of the markers' spread.
    middle, size = seen.mean((0, 1)), seen.std() + 1e-9
    seen = (seen - middle) / size
    a, b = seen[pairs].reshape(-1, 8, 2), (placed[pairs] / tolerance).reshape(-1, 8, 2)
    plain = np.concatenate([a, np.ones_like(a[..., :1])], -1)
    rows = [np.concatenate([plain * (k == 0), plain * (k == 1), -b[..., k, None] * a], -1) for k in (0, 1)]
    design = np.concatenate(rows, 1)
    right = np.concatenate([b[..., 0], b[..., 1]], 1)[..., None]
    h = np.concatenate([np.linalg.pinv(design) @ right, np.ones((len(pairs), 1, 1))], 1).reshape(-1, 1, 3, 3)
    there = np.concatenate([seen, np.ones_like(seen[..., :1])], -1) @ h.transpose(0, 1, 3, 2)
    miss = np.linalg.norm(there[..., :2] / there[..., 2:] - placed / tolerance, axis=-1).mean(-1)
    good: npt.NDArray[np.bool_] = miss < 1.0
    return good[good.sum(1).argmax()]


def in_place(
    placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating], tolerance: float
) -> npt.NDArray[np.bool_]:
    """Which markers lie where those near them put them, (M,).

    It begins with those of one homography (`inliers`) and goes on from neighbor to neighbor, as far as a lens bends the
    board.
    """
    good = inliers(placed, seen, tolerance)
    tried = good.copy()
    while good.sum() >= 2 and not tried.all():
        away = np.linalg.norm(seen.mean(1)[:, None] - seen[good].mean(1)[None], axis=-1)
        away[tried] = np.inf
        other = int(np.argmin(away.min(1)))
        near = np.flatnonzero(good)[np.argsort(away[other])[:_NEIGHBORS]]
        found = board_homography(placed[near], seen[near])
        good[other] = found is not None and _misses(found, placed[[other]], seen[[other]])[0] < tolerance
        tried[other] = True
    return good


def board_homography(
    placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64] | None:
    """(3, 3) board from image by least squares of points (..., 2); None where they determine none."""
    image, board = (points.reshape(-1, 2).astype(np.float64) for points in (seen, placed))
    found, _ = cv2.findHomography(image, board)
    if found is None or not np.isfinite(found).all():
        return None
    return np.asarray(found, np.float64)


def _misses(
    board_from_image: npt.NDArray[np.float64], placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64]:
    there = cv2.perspectiveTransform(seen.reshape(1, -1, 2).astype(np.float64), board_from_image).reshape(seen.shape)
    return np.asarray(np.linalg.norm(there - placed, axis=-1).mean(-1), np.float64)


# Find ChArUco boards: checkerboards with markers in their light squares, so that a visible part is enough.
#
# Parts seen at the image's border determine the lens there. OpenCV's `aruco.ArucoDetector` reads the markers and its
# `aruco.CharucoDetector` finds the corners beside them; kcal adds the corners of markers that were not read, which
# follow from those beside them, and refines all within what the markers leave free.
#
# OpenCV before 4.6 drew boards with an even number of rows of squares with a light square, and marker 0, at the left
# upper end; since then it is a dark one. Which of the two an image shows follows from its markers.

MIN_CORNERS = 6
_FREE_SHARE = 0.85  # of the distance from a corner to what else is printed; the rest is left for blur
# Of a square: distance of a marker's corner from the homography of all of them. Wide lenses stay below in the middle
# of the image, markers of the other numbering are a square off.
_TOLERANCE = 0.35
_MOST = 0.7  # of the markers: if so many lie as on one board or the other, the image shows both
# Of those that were read for certain; a board of another number of columns shows up to half of its markers in place.
_MIN_FITTING = 0.75
_MIN_MARKERS = 3  # that agree on one numbering; two of them fit any
_MIN_UNSURE = 5  # the same where wrong bits had to be corrected
FEW = 0.6  # of the markers: if fewer are read, more effort is made
MOST_ENLARGED = 3_000_000  # pixels: larger images are not searched twice
Markers = dict[int, npt.NDArray[np.float64]]  # the corners (4, 2) of each


def find_charuco(image: npt.NDArray[np.uint8], board: Board, legacy: bool | None = None) -> tuple[Tensor, bool | None]:
    """The corners of a ChArUco board: (corners, 2) in the board's order, NaN where not seen.

    Second, whether its numbering is that of OpenCV before 4.6; None where both are the same or too little is seen to
    tell. At least 6 corners are needed, two each on two rows and on two columns, so that they determine a pose.

    Args:
        image: (H, W).
        board: with markers.
        legacy: the numbering to assume where the image does not tell; None is that of today.

    Raises:
        InputError: the board has no markers.
        NotFoundError: too few corners are seen.
    """
    if board.dictionary is None:
        raise InputError(f"{board}: not a ChArUco board")
    found = read_markers(image, board, board.dictionary)
    if len(found) < _MIN_MARKERS:  # a board that is printed white on black
        inverted = read_markers(255 - image, board, board.dictionary)
        if len(inverted) > len(found):
            image, found = 255 - image, inverted
    own = _single(found)
    twice = sorted(found.keys() - own)
    if twice:
        raise NotFoundError(
            f"marker {twice[0]} is seen twice: two boards need different numbers (:idFIRST), or hide one of them"
        )
    seen = own
    if len(own) < FEW * board.markers:
        # Markers with wrong bits as well, and small ones. Those that are read wrongly do not lie where they should.
        more = read_markers(image, board, board.dictionary, correction=1.0)
        seen = read_enlarged(image, board, board.dictionary) | _single(more) | own
    today, before = ({} if len(seen) < _MIN_MARKERS else _fitting_markers(seen, board, old) for old in (False, True))
    told: bool | None = None
    if board.rows % 2 and len(seen) >= _MIN_MARKERS:
        several = min(len(today.keys() - before), len(before.keys() - today)) >= _MIN_MARKERS
        if several and len(today | before) >= _MOST * len(seen):
            raise NotFoundError(
                f"{len(today.keys() - before)} markers lie as on boards of today only, "
                f"{len(before.keys() - today)} as on those of OpenCV before 4.6 only: two boards; hide one"
            )
        # Markers in the middle of some boards lie alike in both but for a shift.
        told = None if len(today) == len(before) else len(before) > len(today)
    old = bool(legacy if told is None else told)
    markers = before if old else today
    sure = len(markers.keys() & own)
    if sure >= _MIN_FITTING * len(own) and (sure >= _MIN_MARKERS or len(markers) >= _MIN_UNSURE):
        pixels = _between(image, markers, board, old)
        if enough(pixels, board):
            return pixels, told
    reason = f"fewer than {MIN_CORNERS} corners of the ChArUco board found, or all on one line"
    fitting = max(len(placed.keys() & own) for placed in (today, before))
    if len(own) >= _MIN_MARKERS and fitting < _MIN_FITTING * len(own):
        reason = "the markers do not lie as on this board: check its columns, rows, dictionary and first number"
    elif not own and (others := read_markers(image, board, board.dictionary, others=True)):
        reason += f"; markers {min(others)} to {max(others)} of {board.dictionary} are another board's"
    raise NotFoundError(reason)


def read_markers(
    image: npt.NDArray[np.uint8],
    board: Board,
    dictionary: str,
    border: int = 1,
    correction: float = 0.6,
    *,
    others: bool = False,
) -> dict[int, list[npt.NDArray[np.float64]]]:
    """The board's markers by number.

    Args:
        image: (H, W).
        board: with markers or tags.
        dictionary: their name.
        border: cells.
        correction: share of the wrong bits that the dictionary allows to correct.
        others: those of the dictionary instead that are not the board's. In large dictionaries that takes long.
    """
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits, options.errorCorrectionRate = border, correction
    options.perspectiveRemovePixelPerCell = 8
    whole, own = opencv_dictionary(dictionary), range(board.first, board.first + board.markers)
    # OpenCV compares what it takes for a marker with all that it may be, one after the other.
    known = whole.bytesList if others else whole.bytesList[own.start : own.stop]
    reader = cv2.aruco.ArucoDetector(cv2.aruco.Dictionary(known, whole.markerSize, whole.maxCorrectionBits), options)
    found, places, _ = reader.detectMarkers(image)
    markers: dict[int, list[npt.NDArray[np.float64]]] = {}
    for corners, place in zip(found, [] if places is None else map(int, places.reshape(-1)), strict=True):
        number = place if others else place + own.start
        if (number in own) != others:
            markers.setdefault(number, []).append(np.asarray(corners, np.float64).reshape(4, 2))
    return markers


def read_enlarged(
    image: npt.NDArray[np.uint8], board: Board, dictionary: str, border: int = 1, sharpen: float = 0.0
) -> Markers:
    """The same in an image twice as large, where OpenCV reads markers of 20 px and less.

    More wrong bits are corrected: a marker that is read wrongly does not lie where it should. `sharpen` adds a share of
    what a blur of 1.5 px takes away.
    """
    if image.size > MOST_ENLARGED:
        return {}
    double = np.asarray(cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), np.uint8)
    if sharpen:
        soft = cv2.GaussianBlur(double, (0, 0), 3.0)
        double = np.asarray(cv2.addWeighted(double, 1.0 + sharpen, soft, -sharpen, 0.0), np.uint8)
    found = read_markers(double, board, dictionary, border, correction=1.0)
    return {number: (corners + 0.5) / 2 - 0.5 for number, corners in _single(found).items()}


def _single(found: dict[int, list[npt.NDArray[np.float64]]]) -> Markers:
    """Those that were seen once."""
    return {number: corners[0] for number, corners in found.items() if len(corners) == 1}


def _between(image: npt.NDArray[np.uint8], markers: Markers, board: Board, legacy: bool) -> Tensor:
    """The corners beside markers, and those that can be grown from them; NaN for others."""
    pixels = torch.full((board.corners, 2), torch.nan, dtype=torch.float64)
    options = cv2.aruco.CharucoParameters()
    options.minMarkers = 1
    options.checkMarkers = False  # `in_place` has done so; OpenCV's own check refuses boards seen from 65 degrees on
    corners = [corners.astype(np.float32)[None] for corners in markers.values()]
    numbers = np.array(list(markers), np.int32)[:, None]
    detector = cv2.aruco.CharucoDetector(_opencv_board(board, legacy), options)
    places, ids, _, _ = detector.detectBoard(image, markerCorners=corners, markerIds=numbers)
    if ids is None or not len(ids):
        return pixels
    order = torch.from_numpy(np.asarray(ids, np.int64).reshape(-1))
    pixels[order] = torch.from_numpy(np.asarray(places, np.float64).reshape(-1, 2))
    grid = as_grid(pixels, board.columns, board.rows)
    return filled_grid(image, grid, _FREE_SHARE * _white_border(board)).reshape(-1, 2)


def _fitting_markers(seen: Markers, board: Board, legacy: bool) -> Markers:
    """The markers that lie as one of the two numberings has them."""
    corners = _opencv_board(board, legacy).getObjPoints()
    placed = np.stack([np.asarray(corners[number - board.first])[:, :2] for number in seen])
    good = in_place(placed, np.stack(list(seen.values())), _TOLERANCE * board.square)
    return {number: seen[number] for number, fits in zip(seen, good.tolist(), strict=True) if fits}


def _white_border(board: Board) -> float:
    """The white between a marker and its square's edge, as a share of the square."""
    assert board.marker is not None
    return 0.5 * (board.square - board.marker) / board.square


def enough(pixels: Tensor, board: Board) -> bool:
    """Whether the seen corners determine a pose."""
    seen = torch.isfinite(as_grid(pixels, board.columns, board.rows)).all(-1)
    spread = min(int((seen.sum(side) >= 2).sum()) for side in (0, 1))
    return int(seen.sum()) >= MIN_CORNERS and spread >= 2


def free_side(pixels: Tensor, board: Board) -> Tensor:
    """The side of the squares (corners,) to pass to refinement, so that its window contains no marker.

    Raises:
        InputError: the board has no markers.
    """
    if board.marker is None:
        raise InputError(f"{board}: not a ChArUco board")
    side = local_side(pixels, board.columns, board.rows)
    # A corner without a neighbor gets the median side of the others.
    known = torch.isfinite(side)
    side = torch.where(known, side, side[known].median() if bool(known.any()) else 1.0)
    return side * min(1.0, _FREE_SHARE * math.sqrt(2.0) * _white_border(board) / SHARE)


def _opencv_board(board: Board, legacy: bool = False) -> cv2.aruco.CharucoBoard:
    if board.dictionary is None or board.marker is None:
        raise InputError(f"{board}: not a ChArUco board")
    numbers = np.arange(board.first, board.first + board.markers, dtype=np.int32)
    made = cv2.aruco.CharucoBoard(
        (board.columns + 1, board.rows + 1), board.square, board.marker, opencv_dictionary(board.dictionary), numbers
    )
    made.setLegacyPattern(legacy)
    return made


# Find AprilGrids, the boards of Kalibr: tags of family 36h11, with small black squares that touch their corners.
#
# A visible part is enough. OpenCV's `aruco.ArucoDetector` finds the tags. Where a tag and a small square touch, four
# quadrants meet as on a checkerboard, so that kcal's own refinement finds the corner; a board without the small squares
# has no such points and is refused.
#
# Geometry after https://github.com/ethz-asl/kalibr, its wiki page "Calibration targets" and its class
# `GridCalibrationTargetAprilgrid`.

BORDERS = (2, 1)  # cells: Kalibr's own tags, and those of other makers
_CELLS = 6  # of a tag of this family, without its border
_TAG_TOLERANCE = 0.3  # of a tag: distance from where its neighbors put it; a wrong tag is 1.3 off
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.05)
_SHARPEN = 1.5  # small and blurred tags are read where what blur takes away is added so many times
_MIN_SEEN = 3, 2  # corners that must be where its neighbors put them: of a tag inside the image, and of one cut by it
# Quarter turns of the tags against OpenCV's dictionary: those of the AprilTag library are turned by half a turn.
_TURNS = (2, 0, 1, 3)


def find_aprilgrid(image: npt.NDArray[np.uint8], board: Board) -> tuple[Tensor, Tensor]:
    """The corners of an AprilGrid's tags, (corners, 2) to about a pixel in the board's order, NaN where not seen.

    Second, the side (corners,) of squares to pass to refinement, so that its window contains nothing else; 1 where not
    seen.

    Raises:
        NotFoundError: fewer than two tags are seen, or not those of the board.

    Example:
        >>> find_aprilgrid(np.full((100, 100), 200, np.uint8), Board.parse("aprilgrid:6x6", "25mm"))
        Traceback (most recent call last):
        kcal.corners.search.NotFoundError: fewer than 2 tags of the AprilGrid found
    """
    assert board.gap is not None
    border, tags = _most_tags(image, board)
    if not tags and (others := [n for size in BORDERS for n in read_markers(image, board, TAGS, size, others=True)]):
        raise NotFoundError(
            f"tags {min(others)} to {max(others)} are seen, the board has {board.first} to "
            f"{board.first + board.markers - 1}: another board, or give its first number (:idFIRST)"
        )
    twice = [number for number, found in tags.items() if len(found) > 1]
    if twice:
        raise NotFoundError(f"tag {twice[0]} is seen twice: two boards need different numbers (:idFIRST), or hide one")
    if len(tags) < 2:
        raise NotFoundError("fewer than 2 tags of the AprilGrid found")
    seen = {number: found[0] for number, found in tags.items()}
    found, tolerance = np.stack(list(seen.values())), _TAG_TOLERANCE * board.square
    places = {turn: _tag_corners(board, turn) for turn in _TURNS}
    counts = {
        turn: int(inliers(np.stack([own[number] for number in seen]), found, tolerance).sum())
        for turn, own in places.items()
    }
    turn = max(_TURNS, key=lambda turn: counts[turn])
    placed = _in_place(seen, places[turn], tolerance)
    # Two tags agree with any place of them that only shifts and scales; a third must as well.
    if counts[turn] < min(3, len(seen)) or 2 * len(placed) < len(seen):
        raise NotFoundError(
            f"the {len(seen)} tags found do not lie as on this board: check how many it has in a row; numbers must "
            "grow to the right and upward from the lower left"
        )
    pixels = torch.full((board.corners, 2), float("nan"), dtype=torch.float64)
    side = torch.ones(board.corners, dtype=torch.float64)
    share = _FREE_SHARE / SHARE * min(math.sqrt(2.0) * border / (_CELLS + 2 * border), board.gap / board.square)
    for number, corners in _with_unread(image, placed, board, places[turn], share).items():
        rows = _tag_places(number, board, turn)
        edge = float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).min())
        moved = torch.from_numpy(nearer(image, corners, edge))
        # Corners whose window leaves the image would spoil what the others tell of the light.
        inside = inside_image(moved, torch.full((4,), SHARE * share * edge), image.shape[1], image.shape[0])
        pixels[rows] = torch.where(inside[:, None], moved, torch.nan)
        side[rows] = share * edge
    if not enough(pixels, board):
        raise NotFoundError(f"fewer than {MIN_CORNERS} corners of the AprilGrid's tags found")
    return pixels, torch.where(torch.isfinite(pixels).all(-1), side, 1.0)


def _most_tags(image: npt.NDArray[np.uint8], board: Board) -> tuple[int, dict[int, list[npt.NDArray[np.float64]]]]:
    """The border with which most tags are read, and the board's tags by number."""
    read = {border: read_markers(image, board, TAGS, border) for border in BORDERS}
    border = max(BORDERS, key=lambda border: len(read[border]))
    tags = read[border]
    for sharpen, enough_tags in ((0.0, 1.0), (_SHARPEN, FEW)):
        if len(tags) >= enough_tags * board.markers:
            break
        large = read_enlarged(image, board, TAGS, border, sharpen)
        tags |= {number: [corners] for number, corners in large.items() if number not in tags}
    return border, tags


def nearer(image: npt.NDArray[np.uint8], corners: npt.NDArray[np.float64], edge: float) -> npt.NDArray[np.float64]:
    """Corners moved near enough for kcal's refinement, in windows that reach no cell inside the tag; NaN outside."""
    limit = np.array(image.shape[::-1]) - 1.0
    inside = ((corners >= 0) & (corners <= limit)).all(1, keepdims=True)
    half = int(np.clip(0.12 * edge, 2, 5))
    start = np.ascontiguousarray(corners.clip(0, limit), np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), _STOP).reshape(-1, 2).astype(np.float64)
    near = np.linalg.norm(moved - corners, axis=1, keepdims=True) < half
    return np.where(inside, np.where(near, moved, corners), np.nan)


def _tag_places(number: int, board: Board, turn: int) -> list[int]:
    """Where on the board the four corners of a tag are, as OpenCV gives them: clockwise from the tag's left upper."""
    row, column = divmod(number - board.first, board.columns // 2)
    first = 2 * row * board.columns + 2 * column  # the lower left
    around = [first + board.columns, first + board.columns + 1, first + 1, first]
    return around[turn:] + around[:turn]


def _tag_corners(board: Board, turn: int) -> Markers:
    """The corners of all tags on the board."""
    points, numbers = board.points[:, :2].numpy(), range(board.first, board.first + board.markers)
    return {number: points[_tag_places(number, board, turn)] for number in numbers}


def _in_place(seen: Markers, places: Markers, tolerance: float) -> Markers:
    """Those tags that lie where the tags next to them put them."""
    kept = {}
    for number, corners in seen.items():
        middle = corners.mean(0)
        away = {other: float(np.linalg.norm(at.mean(0) - middle)) for other, at in seen.items() if other != number}
        near = sorted(away, key=away.__getitem__)[:_NEIGHBORS]
        own, placed = places[number], np.stack([places[other] for other in near])
        around = np.stack([seen[other] for other in near])
        board_from_image = board_homography(placed, around)
        if board_from_image is None:
            continue
        if _misses(board_from_image, own[None], corners[None])[0] > tolerance:
            continue
        # OpenCV finds tags too small by up to 4 px at each corner; their neighbors correct that.
        both = board_homography(np.concatenate([placed, own[None]]), np.concatenate([around, corners[None]]))
        kept[number] = corners if both is None else cv2.perspectiveTransform(own[None], np.linalg.inv(both))[0]
    return kept


def _with_unread(image: npt.NDArray[np.uint8], placed: Markers, board: Board, places: Markers, share: float) -> Markers:
    """Tags, and those that were not read but have corners where the tags beside them put them.

    Args:
        image: (H, W).
        placed: tags by number.
        board: an AprilGrid.
        places: corners of all tags on the board.
        share: of a tag's edge, the side to pass to refinement.
    """
    light = torch.from_numpy(image)
    cells = {board.first + n: np.array(divmod(n, board.columns // 2)) for n in range(board.markers)}
    tags = dict(placed)
    while True:
        guessed = {}
        for number in cells.keys() - tags:
            away = {other: float(np.abs(cells[other] - cells[number]).max()) for other in tags}
            near = sorted(tags, key=lambda other: away[other])[:_NEIGHBORS]
            if away[near[0]] > 1:
                continue
            board_from_image = board_homography(
                np.concatenate([places[other] for other in near]), np.concatenate([tags[other] for other in near])
            )
            if board_from_image is not None:
                guessed[number] = cv2.perspectiveTransform(places[number][None], np.linalg.inv(board_from_image))[0]
        if not guessed:
            return tags
        starts = torch.from_numpy(np.stack(list(guessed.values())))
        edges = torch.linalg.vector_norm(starts - starts.roll(1, 1), dim=-1).amin(1).clamp_min(1.0)
        found = saddle(light, starts.reshape(-1, 2), (share * edges).repeat_interleave(4))
        good = (found.status == CornerStatus.GOOD).reshape(-1, 4)
        corners = torch.where(good[..., None], found.pixels.reshape(-1, 4, 2), starts)
        whole = inside_image(starts, torch.zeros(starts.shape[:2]), image.shape[1], image.shape[0]).all(-1)
        enough_seen = good.sum(-1) >= torch.where(whole, *_MIN_SEEN)
        new = {n: c.numpy() for n, c, is_there in zip(guessed, corners, enough_seen.tolist(), strict=True) if is_there}
        if not new:
            return tags
        tags |= new
