"""Recognize which board images show, whichever it is: checkerboard, ChArUco board, AprilGrid or circles."""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from kcal.corners.board import DICTIONARIES, TAGS, Board, square_of
from kcal.corners.circles import round_blobs
from kcal.corners.grid import goes_on, sound_grid
from kcal.corners.marker_boards import BORDERS, nearer
from kcal.corners.markers import opencv_dictionary
from kcal.corners.search import MIN_FILLED, board_ends, grown_grid, search_sizes, seeds
from kcal.errors import InputError
from kcal.opencv import cv2

# Markers: which dictionary, and how they lie.

# Larger dictionaries contain the smaller ones of their family, and take seconds to search.
_FAMILIES = (
    TAGS, "4x4_250", "5x5_250", "6x6_250", "7x7_250", "aruco_original", "aruco_mip_36h12", "apriltag_25h9",
    "apriltag_16h5",
)  # fmt: skip
_ENOUGH = 8  # markers of one dictionary, after which no other is searched
_MIN_MARKERS = 4  # fewer are found in pictures without any: markers of 16 cells have few errors to correct
_MIN_PLACED = 5  # markers that must lie as on one board
_MOST_ACROSS = 40  # squares or tags in a row
_TOLERANCE = 0.35  # of a square: distance of a marker's center from where the others put it
_SAME_SHARE = 0.03  # of a marker's side, or of a tag's: sizes nearer than this to an ordinary one are that
_PLACED = 0.6  # of the markers seen: share that must lie as on one board
_AMISS = 0.3  # of a marker's side: how far its edges may differ from those of a square along the board's axes
_DRAWS = 100  # of four markers: with so many, all draws contain a wrong one once in a million times
_CELL = 4  # pixels of a marker's cell, where it is compared with a dictionary
_CORRECTED = 0.6  # of the cells that a dictionary could correct: OpenCV's share
Corners = dict[int, npt.NDArray[np.float64]]  # (4, 2) of each marker


class SeenMarkers(NamedTuple):
    """The dictionary of which most markers are seen, their border in cells, and their corners by number."""

    dictionary: str
    border: int
    corners: Corners


def most_markers(image: npt.NDArray[np.uint8]) -> SeenMarkers:
    """The markers of that dictionary of which most are seen; none where fewer than four are."""
    best = SeenMarkers("", 1, {})
    # With a small dictionary, what is read and what is rejected are all quadrilaterals that may be markers.
    read, _, rejected = cv2.aruco.ArucoDetector(opencv_dictionary("apriltag_16h5")).detectMarkers(image)
    quads = [np.asarray(quad, np.float32).reshape(4, 2) for quad in (*read, *rejected)]
    for family in _FAMILIES:
        for border in BORDERS if family == TAGS else (1,):
            if _like_markers(image, quads, family, border) < _MIN_MARKERS:
                continue
            found = read_all(image, family, border)
            if len(found) >= max(_MIN_MARKERS, len(best.corners) + 1):
                best = SeenMarkers(smallest(family, max(found)), border, found)
            if len(found) >= _ENOUGH:
                return best
    return best


def _like_markers(
    image: npt.NDArray[np.uint8], quads: Sequence[npt.NDArray[np.float32]], name: str, border: int
) -> int:
    """How many quadrilaterals almost have the cells of a marker: OpenCV's own comparison takes ten times as long."""
    if len(quads) < _MIN_MARKERS:
        return 0
    dictionary = opencv_dictionary(name)
    size = dictionary.markerSize
    most = int(_CORRECTED * dictionary.maxCorrectionBits) + size**2 // 16
    whole = size + 2 * border
    side = _CELL * whole
    corners = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
    straight = [cv2.warpPerspective(image, cv2.getPerspectiveTransform(quad, corners), (side, side)) for quad in quads]
    light = np.stack([cv2.threshold(one, 0, 1, cv2.THRESH_OTSU)[1] for one in straight])
    cells = light.reshape(-1, whole, _CELL, whole, _CELL).mean((2, 4))[:, border:-border, border:-border] > 0.5
    turned = np.stack([np.rot90(cells, turn, (1, 2)) for turn in range(4)])
    amiss = (turned[:, :, None] != _codes(name)).sum((-2, -1))  # cells, by turn, quadrilateral, marker
    return int((amiss.min((0, 2)) <= most).sum())


@functools.cache
def _codes(name: str) -> npt.NDArray[np.uint8]:
    """(M, S, S) the inner cells of all markers of a dictionary; 1 is light."""
    dictionary = opencv_dictionary(name)
    read, size = cv2.aruco.Dictionary.getBitsFromByteList, dictionary.markerSize
    return np.stack([read(one[None], size) for one in dictionary.bytesList])


def read_all(image: npt.NDArray[np.uint8], name: str, border: int = 1) -> Corners:
    """All markers of a dictionary by number, in ascending order."""
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = border
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    found, numbers, _ = cv2.aruco.ArucoDetector(opencv_dictionary(name), options).detectMarkers(image)
    names = [] if numbers is None else numbers.reshape(-1).tolist()
    return {int(names[i]): np.asarray(found[i], np.float64).reshape(4, 2) for i in np.argsort(names)}


def smallest(family: str, highest: int) -> str:
    """The smallest dictionary of a family that contains a number."""
    stem = family.removesuffix("_250")
    sizes = [name for name in DICTIONARIES if name.startswith(f"{stem}_") and name[3:4] == "_"]
    return min((name for name in sizes if DICTIONARIES[name] > highest), key=DICTIONARIES.__getitem__, default=family)


class SeenBoard(NamedTuple):
    """What one image shows of a board.

    Args:
        kind: as `--board` has it; empty for a checkerboard.
        columns: inner corners, circles or tags in a row.
        rows: the first row that is seen and the one after the last; of a board with markers the image may show a part.
        dictionary: of a ChArUco board.
        share: side of a marker as a share of its square, or the gap between tags as a share of a tag.
        sure: of a checkerboard, whether all four ends are seen; otherwise it may be larger.
    """

    kind: str
    columns: int
    rows: tuple[int, int]
    dictionary: str = ""
    share: float = 0.0
    sure: bool = True

    @property
    def text(self) -> str:
        """As `--board` has it, without the size of markers."""
        low, high = self.rows
        parts = [*([self.kind] if self.kind else []), f"{self.columns}x{high - low}"]
        parts += [self.dictionary] if self.dictionary else []
        if low:
            first = self.columns * low if self.kind == "aprilgrid" else ((self.columns + 1) * low + 1) // 2
            parts.append(f"id{first}")
        return ":".join(parts)

    def board(self, square: str) -> Board:
        """The board with squares of a side such as `25mm`; markers and gaps have the size that was measured."""
        if not self.share:
            return Board.parse(self.text, square)
        kind, size, *more = self.text.split(":")
        if kind == "aprilgrid":
            # Kalibr's own share, where it cannot be told from what was measured.
            share = 0.3 if abs(self.share - 0.3) < _SAME_SHARE else round(self.share, 2)
            return Board.parse(":".join([kind, size, f"{share:g}", *more]), square)
        millimeters = 1e3 * self.share * Board.parse("3x3", square).square
        whole = round(2.0 * millimeters) / 2.0
        marker = whole if whole and abs(whole - millimeters) < _SAME_SHARE * millimeters else millimeters
        return Board.parse(f"{self.text}:{marker:.3g}mm", square)

    def other_than(self, board: Board) -> bool:
        """Whether it is certainly another board: markers may show a part of it."""
        kind = "charuco" if board.dictionary else "" if board.pattern == "checkerboard" else board.pattern
        if kind != self.kind:
            return True
        if kind in ("charuco", "aprilgrid"):
            return self.columns != board.columns // (2 if kind == "aprilgrid" else 1)
        return {self.columns, self.rows[1]} != {board.columns, board.rows}

    @property
    def vote(self) -> tuple[str, int, int, str]:
        """What images of the same board agree on."""
        marked = self.kind in ("charuco", "aprilgrid")
        return self.kind, self.columns, 0 if marked else self.rows[1], self.dictionary.partition("_")[0]


def marker_board(picture: npt.NDArray[np.uint8], seen: SeenMarkers) -> SeenBoard | None:
    """The board on which markers of a picture lie as they are seen; None if they lie as on none."""
    if len(seen.corners) < _MIN_PLACED:
        return None
    numbers = np.array(list(seen.corners))
    image = np.stack(list(seen.corners.values()))
    best, most = None, max(_MIN_PLACED, _PLACED * len(numbers)) - 1
    kinds = ["charuco", "aprilgrid"] if seen.dictionary == TAGS else ["charuco"]
    for kind in ["aprilgrid"] if seen.border > 1 else kinds:
        for across, odd in itertools.product(range(2, _MOST_ACROSS + 1), (0, 1) if kind == "charuco" else (0,)):
            squares = _light_squares(across, odd, int(numbers.max())) if kind == "charuco" else None
            # Columns to the right and rows downward; those of tags count upward.
            places = np.stack([numbers % across, -(numbers // across)], 1) if squares is None else squares[numbers]
            if min(np.ptp(places, axis=0)) < 1:
                continue
            found, mask = cv2.findHomography(
                image.mean(1), places.astype(np.float64), cv2.RANSAC, _TOLERANCE, maxIters=_DRAWS
            )
            good = np.zeros(len(numbers), bool) if found is None else mask.reshape(-1) > 0
            if good.sum() <= most or min(np.ptp(places[good], axis=0)) < 1:
                continue
            tags = np.stack([_at_squares(picture, one) for one in image[good]]) if kind == "aprilgrid" else image[good]
            # Most markers of ArUco's grid boards fit as well, but sheared, stretched or too large.
            if not 0 < (side := _sides(np.asarray(found, np.float64), tags)) < 1:
                continue
            rows = np.abs(places[good][:, 1])
            low, high = int(rows.min()), int(rows.max()) + 1
            most = int(good.sum())
            if kind == "charuco":
                best = SeenBoard(kind, across - 1, (low, high - 1), seen.dictionary, side)
            else:
                best = SeenBoard(kind, across, (low, high), share=1.0 / side - 1.0)
    return best


def _light_squares(across: int, odd: int, highest: int) -> npt.NDArray[np.int64]:
    """Column and row of the square of each marker: those whose sum is odd, or of the old numbering even."""
    down = 2 * (highest + 1) // across + 3
    rows, columns = np.mgrid[:down, :across]
    light = (rows + columns) % 2 != odd
    return np.stack([columns[light], rows[light]], 1)


def _at_squares(picture: npt.NDArray[np.uint8], tag: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Corners of a tag where the small squares touch them: OpenCV finds tags too small."""
    moved = nearer(picture, tag, float(np.linalg.norm(tag - np.roll(tag, 1, 0), axis=1).min()))
    return np.where(np.isfinite(moved), moved, tag)


def _sides(board_from_image: npt.NDArray[np.float64], image: npt.NDArray[np.float64]) -> float:
    """The median side of markers (M, 4, 2), in units of the board; 0 where most are no squares along its axes."""
    there = cv2.perspectiveTransform(image.reshape(1, -1, 2), board_from_image).reshape(-1, 4, 2)
    edges = there - np.roll(there, 1, 1)
    side = float(np.median(np.linalg.norm(edges, axis=-1)))
    amiss = np.abs(np.sort(np.abs(edges)) - (0.0, side)).max((1, 2))
    return side if np.median(amiss) < _AMISS * side else 0.0


# Circles: how many there are each way.

ROUND = 0.83  # 4 pi area / perimeter²: squares have 0.79, circles seen from 45 degrees 0.94
_ROUNDER = 0.88  # 58 % and more of the spots in blurred checkerboards are less round
_SIZES = (0.6, 1.6)  # of the median: sizes of circles of one grid, seen from aside
MIN_CIRCLES = 12
_ASIDE = 0.4  # sine of the angle from which on a circle lies to a side of another
_NEAR = 0.3  # of a step: how near a circle is to where its neighbors put it


def like_sized(image: npt.NDArray[np.uint8], least: float = ROUND) -> list[tuple[float, float]]:
    """Round spots of like size, dark or light; none on a checkerboard, which has as many of both."""
    found = []
    for picture in (image, 255 - image):
        blobs = round_blobs(picture, least)
        middle = float(np.median([blob.size for blob in blobs])) if blobs else 0.0
        found.append([blob.pt for blob in blobs if _SIZES[0] * middle < blob.size < _SIZES[1] * middle])
    few, many = sorted(found, key=len)
    return [(float(x), float(y)) for x, y in many] if len(few) < len(many) / 3 else []


def clear_spots(image: npt.NDArray[np.uint8]) -> list[tuple[float, float]]:
    """The same, where blurred squares do not pass for circles: most of the spots are rounder."""
    spots = like_sized(image)
    return spots if len(like_sized(image, _ROUNDER)) > 0.6 * len(spots) else []


def circle_board(spots: Sequence[tuple[float, float]]) -> SeenBoard | None:
    """The grid that spots form, each of its places filled; None if they form none."""
    if len(spots) < MIN_CIRCLES:
        return None
    places = np.asarray(spots, np.float64)
    for index in _lattices(places):
        if len(index) < max(MIN_CIRCLES, 0.8 * len(places)):
            continue
        # Which steps are the shortest in the image depends on the view: those of the board fill a rectangle.
        for a, b, c, d in itertools.product((-1, 0, 1), repeat=4):
            if abs(a * d - b * c) != 1:
                continue
            straight = index @ np.array([[a, b], [c, d]])
            straight -= straight.min(0)
            wide, high = (straight.max(0) + 1).tolist()
            if min(wide, high) >= 3 and len(index) == wide * high:
                return SeenBoard("circles", max(wide, high), (0, min(wide, high)))
            turned = straight @ np.array([[1, 1], [1, -1]])
            for grid in (turned, turned[:, ::-1]):
                if (asymmetric := _asymmetric(grid - grid.min(0))) is not None:
                    return asymmetric
    return None


def _asymmetric(grid: npt.NDArray[np.int64]) -> SeenBoard | None:
    """The board of which these are all places (N, 2): columns at even ones in one row, at odd ones in the next."""
    wide, rows = (grid.max(0) + 1).tolist()
    if wide % 2 or wide < 4 or rows < wide or len(grid) != wide // 2 * rows:
        return None
    return SeenBoard("asymmetric", wide // 2, (0, rows)) if len(set(map(tuple, grid.tolist()))) == len(grid) else None


def _lattices(places: npt.NDArray[np.float64]) -> Iterator[npt.NDArray[np.int64]]:
    """Whole-numbered places (N, 2) of spots on the lattice that they form, from a few spots near the middle on."""
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    for start in np.argsort(np.linalg.norm(places - np.median(places, 0), axis=-1))[:3]:
        near = np.argsort(apart[start])[1:9]
        first = places[near[0]] - places[start]
        # The nearest one that lies to a side.
        ways = places[near] - places[start]
        turned = first[0] * ways[:, 1] - first[1] * ways[:, 0]
        across = near[np.abs(turned) > _ASIDE * np.hypot(*first) * apart[start, near]]
        if not len(across):
            continue
        second = places[across[0]] - places[start]
        steps = {(1, 0): first, (0, 1): second}
        index = {int(start): (0, 0)}
        local = {int(start): steps}
        queue = [int(start)]
        while queue:
            own = queue.pop(0)
            for (i, j), step in local[own].items():
                for sign in (1, -1):
                    other = int(np.argmin(np.linalg.norm(places - places[own] - sign * step, axis=-1)))
                    moved = sign * (places[other] - places[own])
                    if other in index or np.linalg.norm(moved - step) > _NEAR * np.linalg.norm(step):
                        continue
                    index[other] = (index[own][0] + sign * i, index[own][1] + sign * j)
                    # Steps change slowly over a board that is seen from aside.
                    local[other] = {**local[own], (i, j): moved}
                    queue.append(other)
        if len(set(index.values())) == len(index):
            yield np.array(list(index.values()))


# Checkerboards: the largest grid of corners, and whether all four ends are seen.


_SEEDS = 2  # grids to look at, where one of them is part of a board


def checkerboard(image: npt.NDArray[np.uint8]) -> SeenBoard | None:
    """The checkerboard that an image shows, or the part of it that could be found; None if it shows none."""
    best: SeenBoard | None = None
    for number, grid in enumerate(seeds(image)):
        if number >= _SEEDS and best is not None:
            break
        whole = sound_grid(image, grid)
        if whole is None:
            continue
        grown = grown_grid(image, whole, _MOST_ACROSS)
        known = torch.isfinite(grown).all(-1)
        few, many = sorted(grown.shape[:2])
        if few < 3 or float(known.double().mean()) < MIN_FILLED or goes_on(image, grown):
            continue
        seen = SeenBoard("", many, (0, few), sure=all(board_ends(image, grown)))
        if seen.sure:
            return seen
        if best is None or few * many > best.columns * best.rows[1]:
            best = seen
    return best


# Images: each has a vote, and the board is that of most.

_LEAD = 6  # votes for one board, and three times as many as for all others, end the search
_SURE = 2  # votes of an image in which all ends of a board are seen, or its markers
_WITHOUT_MARKERS = 2  # images that show another board without any marker, after which none is sought


class Recognized(NamedTuple):
    """Which board images show.

    Args:
        seen: the board; None if the images show none, or do not agree on one.
        votes: images that show it.
        sure: those of them in which all of its ends are seen, or its markers.
        looked: images looked at.
        shown: images that show any board, by its text.
        agreed: whether no other image need be looked at.
        without_markers: whether so many images show a board without markers that none need be sought.
    """

    seen: SeenBoard | None
    votes: int
    sure: int
    looked: int
    shown: Counter[str]
    agreed: bool
    without_markers: bool

    def board(self, square: str | None) -> Board:
        """The board, with squares of a side such as `25mm`.

        Raises:
            InputError: there is none, or the square is missing.
        """
        if self.seen is None:
            several = ", ".join(f"{text} in {count}" for text, count in self.shown.most_common())
            raise InputError(
                f"which board it is cannot be told from {self.looked} images that were looked at"
                f"{f': {several}' if several else ': they show none'}; give --board COLUMNSxROWS (inner corners)"
            )
        if square is None:
            raise InputError(
                f"the board is {self.seen.text}, seen in {self.votes} of {self.looked} images that were looked at. "
                f"Images do not tell its size: measure {square_of(self.seen.text)}, "
                "and give it, for example --square 25mm"
            )
        return self.seen.board(square)


def board_of_most(images: Sequence[SeenBoard | None]) -> Recognized:
    """Which board images show, of what each of them shows."""
    groups: dict[tuple[str, int, int, str], list[SeenBoard]] = {}
    for one in images:
        if one is not None:
            groups.setdefault(one.vote, []).append(one)

    def weight(group: Sequence[SeenBoard]) -> int:
        return sum(_SURE if one.sure else 1 for one in group)

    most: list[SeenBoard] = max(groups.values(), key=weight, default=[])
    # A part of the board is not against it.
    against = [one for group in groups.values() if group is not most for one in group if not _is_part(one, most[0])]
    own, others = weight(most), weight(against)
    wholes = {vote: _together(group) for vote, group in groups.items()}
    # One image of many may be wrong.
    clear = own > 2 * others and (len(most) > 1 or len(images) <= 2)
    plain = [len(group) for (kind, *_), group in groups.items() if kind not in ("charuco", "aprilgrid")]
    return Recognized(
        seen=wholes[most[0].vote] if most and clear else None,
        votes=len(most),
        sure=sum(one.sure for one in most),
        looked=len(images),
        shown=Counter({whole.text: len(groups[vote]) for vote, whole in wholes.items()}),
        agreed=own >= _LEAD and own >= 3 * others,
        without_markers=sum(plain) >= _WITHOUT_MARKERS,
    )


def _together(group: Sequence[SeenBoard]) -> SeenBoard:
    """What images show together: all rows that any of them shows."""
    rows = min(one.rows[0] for one in group), max(one.rows[1] for one in group)
    dictionary = max((one.dictionary for one in group), key=lambda name: DICTIONARIES.get(name, 0))
    share = float(np.median([one.share for one in group]))
    return group[0]._replace(rows=rows, dictionary=dictionary, share=share, sure=any(one.sure for one in group))


def _is_part(one: SeenBoard, whole: SeenBoard) -> bool:
    return not (one.sure or one.kind or whole.kind) and one.columns <= whole.columns and one.rows[1] <= whole.rows[1]


def seen_board(image: npt.NDArray[np.uint8], without_markers: bool = False) -> SeenBoard | None:
    """The board that one image shows; None if it shows none, or too little of it.

    Example:
        >>> y, x = np.mgrid[:240, :320]
        >>> on = (x >= 40) & (x < 280) & (y >= 40) & (y < 200)
        >>> seen = seen_board(np.where(on & ((x // 40 + y // 40) % 2 == 0), 40, 220).astype(np.uint8))
        >>> seen.columns, seen.rows
        (5, (0, 3))
    """
    _, image, _ = next(search_sizes(image))
    if not without_markers:
        marked = most_markers(image)
        if not marked.corners:
            marked = most_markers(255 - image)
        if marked.corners:
            return marker_board(image, marked)
    return checkerboard(image) or circle_board(clear_spots(image))


def spread_order(count: int) -> list[int]:
    """All of so many numbers, so that the first few of them lie far apart.

    Example:
        >>> spread_order(8)
        [0, 4, 2, 6, 1, 5, 3, 7]
    """
    bits = max(1, (count - 1).bit_length())
    numbers = (int(f"{i:0{bits}b}"[::-1], 2) for i in range(2**bits))
    return [number for number in numbers if number < count]


# Say which other board an image shows, where the one that was asked for is not found.


def seen_instead(image: npt.NDArray[np.uint8], board: Board) -> str:
    """Which board an image shows that is not the one asked for; empty if it shows none.

    Args:
        image: (H, W).
        board: that was asked for.
    """
    if markers := seen_markers(image, board):
        return markers
    if has_own_markers(image, board):
        return ""
    plain = board.pattern == "checkerboard" and board.dictionary is None
    found = seen_size(image) if plain else None
    if (circles := seen_circles(image, board, clear=found is not None)) is not None:
        return circles
    found = found if plain else seen_size(image)
    own = (max(board.columns, board.rows), min(board.columns, board.rows))
    return "" if found is None or (found == own and plain) else size_advice(found, board)


def size_advice(found: tuple[int, int], board: Board) -> str:
    """What to do where a checkerboard of another size was found."""
    own = (max(board.columns, board.rows), min(board.columns, board.rows))
    squares = found == (own[0] - 1, own[1] - 1) and board.pattern == "checkerboard"
    advice = "count inner corners, not squares" if squares else f"give --board {found[0]}x{found[1]}"
    return f"a board of {found[0]}x{found[1]} was found: {advice}"


def seen_markers(image: npt.NDArray[np.uint8], board: Board) -> str:
    """Which markers an image shows that are not the board's; empty if it shows none.

    Example:
        >>> page = np.full((200, 200), 255, np.uint8)
        >>> for k in range(4):
        ...     x, y = 20 + 90 * (k % 2), 20 + 90 * (k // 2)
        ...     page[y : y + 70, x : x + 70] = opencv_dictionary("5x5_50").generateImageMarker(k, 70)
        >>> seen_markers(page, Board(columns=9, rows=6, square=0.025))
        'markers 0 to 3 of dictionary 5x5_50 were found: give --board charuco:COLUMNSxROWS:5x5_50'
    """
    name, border, corners = most_markers(image)
    numbers = list(corners)
    if numbers:
        own = (name == board.dictionary and border == 1) or (name == TAGS and board.pattern == "aprilgrid")
        if own and any(board.first <= number < board.first + board.markers for number in numbers):
            return ""  # it may be this board, and the image's own reason says what is wrong
        found = f"markers {numbers[0]} to {numbers[-1]} of dictionary {name} were found"
        if name == TAGS and border == BORDERS[0]:
            return f"{found}: give --board aprilgrid:COLUMNSxROWS"
        return f"{found}: give --board charuco:COLUMNSxROWS:{name}"
    return ""


def seen_circles(image: npt.NDArray[np.uint8], board: Board, *, clear: bool = False) -> str | None:
    """What to say of a grid of circles in an image; None if there is none, empty if it may be the board's own.

    Args:
        image: (H, W).
        board: that was asked for.
        clear: most of the spots must be so round that blurred squares do not pass for circles.
    """
    count = len(clear_spots(image) if clear else like_sized(image))
    if count < MIN_CIRCLES:
        return None
    if board.pattern not in ("circles", "asymmetric"):
        return f"some {count} circles were found: give --board circles:COLUMNSxROWS or asymmetric:COLUMNSxROWS"
    if count == board.corners:
        return ""
    return (
        f"some {count} circles were found, the board has {board.corners}: check its columns and rows, and whether they "
        "are asymmetric"
    )


def has_own_markers(image: npt.NDArray[np.uint8], board: Board) -> bool:
    """Whether an image shows any marker of a ChArUco board or tag of an AprilGrid."""
    name = TAGS if board.pattern == "aprilgrid" else board.dictionary
    own = {*range(board.first, board.first + board.markers)}
    borders = BORDERS if board.pattern == "aprilgrid" else (1,)
    return name is not None and any(own & read_all(image, name, border).keys() for border in borders)


def seen_size(image: npt.NDArray[np.uint8]) -> tuple[int, int] | None:
    """Inner corners, the larger number first, of the largest checkerboard grid in an image; None if there is none.

    Example:
        >>> y, x = np.mgrid[:240, :320]
        >>> on = (x >= 40) & (x < 280) & (y >= 40) & (y < 200)
        >>> seen_size(np.where(on & ((x // 40 + y // 40) % 2 == 0), 40, 220).astype(np.uint8))
        (5, 3)
    """
    found = checkerboard(image)
    return None if found is None else (found.columns, found.rows[1])
