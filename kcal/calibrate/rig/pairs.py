"""Pair the views of two cameras that were taken at the same moment."""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from kcal.bag import pair_stamps, stamp_in
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import Views, poses_under, refine_poses
from kcal.calibrate.rig.sources import Boards, RigData
from kcal.calibrate.rig.unknowns import board_deviation
from kcal.corners.observations import Observations
from kcal.errors import FileError, InputError
from kcal.files import read_bytes
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose
from kcal.solve.lm import LMOptions
from kcal.strict_json import MOST_BYTES

Pair = tuple[str, str]
_SIDE = re.compile(r"(?<![a-z])(left|right|l|r|cam(?:era)?[ _-]?[0-9]+)(?![a-z])", re.IGNORECASE)


def pair_by_name(left: Sequence[str], right: Sequence[str]) -> list[Pair]:
    """Pair views whose names differ only in the camera's word, or whose last number is the same.

    Images of bags, which are named by their stamps, pair by these, at most 10 ms apart. Else three rules are tried, and
    the first that pairs anything without a doubt is used for all: equal names without
    folder and suffix; equal after removing `left`, `right`, `l`, `r`, `cam0`, `camera1` and the like; equal last
    number.

    Args:
        left: names of the left camera's views.
        right: names of the right camera's views.

    Returns:
        pairs in the order of `left`. Views without a partner are left out.

    Raises:
        InputError: no rule pairs the names, or one name has two possible partners.

    Example:
        >>> pair_by_name(["left01.jpg", "left02.jpg"], ["right02.jpg", "right03.jpg"])
        [('left02.jpg', 'right02.jpg')]
    """
    stamps = [{stamp: name for name in names if (stamp := stamp_in(name))} for names in (left, right)]
    if len(stamps[0]) == len(left) > 0 and len(stamps[1]) == len(right) > 0:
        return [(stamps[0][one], stamps[1][other]) for one, other in pair_stamps(*map(sorted, stamps))]
    doubt = None
    for key in (_stem, _without_side, _last_number):
        lefts, rights = _by_key(left, key), _by_key(right, key)
        common = [k for k in lefts if k and k in rights]
        if not common:
            continue
        twice = [k for k in common if len(lefts[k]) > 1 or len(rights[k]) > 1]
        if twice:
            doubt = doubt or (lefts[twice[0]] + rights[twice[0]])
            continue
        return [(lefts[k][0], rights[k][0]) for k in common]
    if doubt:
        raise InputError(f"views cannot be paired by name: {', '.join(doubt)} look alike; give a CSV of pairs")
    raise InputError(
        f"no view of the left camera ({left[0] if left else 'none'}, ...) has a partner by name among the right "
        f"camera's ({right[0] if right else 'none'}, ...); give a CSV of pairs"
    )


def image_pairs(left: Sequence[str | Path], right: Sequence[str | Path]) -> list[tuple[Path, Path]]:
    """Image files that belong together: two images, or those of folders, wildcards or bags, which `pair_by_name` pairs.

    Raises:
        FileError: nothing there.
        InputError: names that cannot be paired.
    """
    from kcal.corners.images import expand_images  # which loads OpenCV

    first, second = ({path.name: path for path in expand_images(given)} for given in (left, right))
    if len(first) == len(second) == 1:
        return [*zip(first.values(), second.values(), strict=True)]
    return [(first[one], second[other]) for one, other in pair_by_name([*first], [*second])]


def names_by_side(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Names by the camera's word in them, and by what else is in them; names without such a word are left out.

    Example:
        >>> names_by_side(["left01.jpg", "right01.jpg", "left02.jpg", "far.jpg"])
        {'left': {'01': 'left01.jpg', '02': 'left02.jpg'}, 'right': {'01': 'right01.jpg'}}
    """
    found: dict[str, dict[str, str]] = {}
    for name in names:
        if side := _SIDE.search(Path(name).stem):
            found.setdefault(side.group().lower(), {})[_without_side(name)] = name
    return found


def _by_key(names: Sequence[str], key: Callable[[str], str]) -> dict[str, list[str]]:
    table: dict[str, list[str]] = {}
    for name in names:
        table.setdefault(key(name), []).append(name)
    return table


def _stem(name: str) -> str:
    return Path(name).stem


def _without_side(name: str) -> str:
    return re.sub(r"[ _-]+", "_", _SIDE.sub("", Path(name).stem)).strip("_")


def _last_number(name: str) -> str:
    numbers = re.findall(r"\d+", Path(name).stem)
    return str(int(numbers[-1])) if numbers else ""


def read_pairs(path: str | Path, left: Sequence[str], right: Sequence[str]) -> list[Pair]:
    """Read pairs from a CSV with the columns `left` and `right`, which hold view names.

    Raises:
        FileError: the file cannot be read, has another header, or has no row.
        InputError: a name that is not among the views, or that is used twice; the line is named.
    """
    try:
        rows = list(csv.reader(io.StringIO(read_bytes(path, MOST_BYTES).decode("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path}: cannot read: {error}") from error
    if not rows or [cell.strip() for cell in rows[0]] != ["left", "right"]:
        header = ",".join(rows[0])[:200] if rows else "nothing"
        raise FileError(f"{path}: the header must be left,right; it is {header}")
    pairs: list[Pair] = []
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        cells = [cell.strip() for cell in row]
        if len(cells) != 2:
            raise FileError(f"{path}: line {number} has {len(cells)} fields, two are needed")
        for side, (cell, names) in enumerate(zip(cells, (left, right), strict=True)):
            word = ("left", "right")[side]
            if cell not in names:
                raise InputError(f"{path}: line {number}: no view of the {word} camera is named {cell!r}")
            if any(pair[side] == cell for pair in pairs):
                raise InputError(f"{path}: line {number}: {cell!r} is paired twice")
        pairs.append((cells[0], cells[1]))
    if not pairs:
        raise FileError(f"{path}: no pair below the header")
    return pairs


def paired_boards(
    cameras: tuple[Camera, Camera], observations: tuple[Observations, Observations], pairs: Sequence[Pair]
) -> Boards:
    """Boards seen by the left and the right camera at the same moments, each named after its two views.

    Raises:
        InputError: boards or image sizes that differ, a name that is not among the views, no pair.
    """
    if not pairs:
        raise InputError("no pair of views")
    moments = [(" ".join(dict.fromkeys(pair)), dict(enumerate(pair))) for pair in pairs]
    return _boards_at(cameras, ("left", "right"), dict(enumerate(observations)), moments)


def boards_of_several(
    cameras: Sequence[Camera], names: Sequence[str], observations: Mapping[int, Observations]
) -> Boards:
    """Boards seen by any two or more of several cameras at the same moments.

    Views belong together whose names are equal without the camera's name, the folder and the suffix.

    Args:
        cameras: C of them.
        names: of the cameras.
        observations: of some of the cameras, by number.

    Raises:
        InputError: boards or image sizes that differ, two views of one moment, no moment that two cameras saw.
    """
    moments: dict[str, dict[int, str]] = {}
    for number, seen in observations.items():
        for name in seen.names:
            key = re.sub(r"[ _-]+", "_", _stem(name).replace(names[number], "")).strip("_")
            if number in moments.setdefault(key, {}):
                raise InputError(f"{names[number]}: {moments[key][number]} and {name} are of one moment by their names")
            moments[key][number] = name
    shared = [(key, own) for key, own in moments.items() if len(own) > 1]
    if not shared:
        raise InputError("no moment at which two cameras saw the board: the names of views must be alike")
    return _boards_at(cameras, names, observations, [(key or str(i), own) for i, (key, own) in enumerate(shared)])


def _boards_at(
    cameras: Sequence[Camera],
    names: Sequence[str],
    observations: Mapping[int, Observations],
    moments: Sequence[tuple[str, Mapping[int, str]]],
) -> Boards:
    """Boards at some moments, with the covariances of their corners if all views have them.

    Args:
        cameras: of the rig.
        names: of the cameras.
        observations: of some of the cameras, by number.
        moments: what each is called, and the view of each camera that saw the board then.
    """
    board = next(iter(observations.values())).board
    pixels = torch.full((len(moments), len(cameras), board.corners, 2), math.nan, dtype=torch.float64)
    covariance, known = pixels[..., None].repeat(1, 1, 1, 1, 2), True
    for number, seen in observations.items():
        if seen.board != board:
            raise InputError(f"the cameras saw different boards: {board} and {seen.board}")
        if cameras[number].size != tuple(seen.image_size):
            width, height = cameras[number].size
            raise InputError(
                f"the {names[number]} camera has images of {width}x{height}, its observations of "
                f"{seen.image_size[0]}x{seen.image_size[1]}: are the files mixed up?"
            )
        rows = [i for i, (_, own) in enumerate(moments) if number in own]
        some = seen.subset([moments[i][1][number] for i in rows])
        pixels[rows, number], own = some.pixels(), some.covariances()
        known = known and own is not None
        if own is not None:
            covariance[rows, number] = own
    return Boards(
        board=board,
        pixels=pixels,
        names=tuple(name for name, _ in moments),
        deviation=board_deviation([cameras[number] for number in observations], board),
        views=tuple(tuple(own.get(c, "") for _, own in moments) for c in range(len(cameras))),
        covariance=covariance if known else None,
    )


# Find the relative pose that pairs of board views agree on, before anything is refined jointly.

# A camera that leaves its own boards this far off (pixels) is not the camera that took them; one that is calibrated
# leaves them less far off, though more than then if they move: by no more than these times, and hardly ever by less px.
_FOREIGN_RMS, _MISFIT_TIMES, _HARDLY = 5.0, 20.0, 2.0
# Cameras are swapped only if each fits the other's boards with less than this share of its own RMS.
_CLEARLY = 0.9
# Views, and steps of the solver, that tell whether another camera may fit them at all: of C cameras there are C² pairs.
_FEW, _ROUGH = 4, LMOptions(max_iterations=10, tolerance=1e-4)
# Pairs that propose a relative pose: half of them may be wrong.
_PROPOSALS = 16
# Share of the image's diagonal by which a typical pair's views differ only if they are not of one moment, and places by
# which views may be late. Share of the error that is left if they are put right, or if the cameras moved once.
_OTHER_MOMENT, _PLACES, _BETTER = 0.03, 3, 0.25
# Pairs before and after cameras moved, and pixels by which boards are then elsewhere.
_PART, _MOVED = 3, 1.0
# A turned order of corners is believed only if it leaves less than this share of the error.
_TURNED = 0.2


def pose_alone(board: Tensor, pixels: Tensor, camera: Camera, solver: LMOptions) -> tuple[Pose, Tensor]:
    """Board poses from one camera alone, and the RMS (V,) of each view, px; NaN where a view has no pose."""
    state, cost = poses_under(camera, Views(board_points=board, pixels=pixels), solver)
    return Pose(state.rotation, state.translation), _view_rms(pixels, cost)


def _view_rms(pixels: Tensor, cost: Tensor) -> Tensor:
    """(V,) px, of the costs of views."""
    return (2.0 * cost / torch.isfinite(pixels).all(-1).sum(-1)).sqrt()


def _median_rms(rms: Tensor) -> float:
    """The median; infinite where a view has no pose."""
    return float(rms.median().nan_to_num(math.inf)) if len(rms) else 0.0


def check_cameras(data: RigData, good: Tensor, alone: Sequence[tuple[Pose, Tensor]], solver: LMOptions) -> None:
    """Refuse cameras that do not fit their boards, or that fit each other's boards clearly better.

    Args:
        data: with boards.
        good: (V, C) which boards each camera sees well.
        alone: what each camera makes of these (`pose_alone`), NaN for others.
        solver: options of the solver.
    """
    boards = data.boards
    assert boards is not None
    rms = [_median_rms(own[good[:, c]]) for c, (_, own) in enumerate(alone)]
    for name, camera, own in zip(data.names, data.cameras, rms, strict=True):
        record = None if camera.calibration is None else camera.calibration.record
        limit = _FOREIGN_RMS if record is None else min(_FOREIGN_RMS, max(_HARDLY, _MISFIT_TIMES * record.rms))
        if not own <= limit:
            then = "" if record is None else f"; {record.rms:.2g} px when it was calibrated"
            raise InputError(
                f"the {name} observations do not fit the {name} camera (RMS {own:.1f} px{then}): are cameras or "
                "observations swapped, or were zoom or focus changed?"
            )
    for pair in itertools.combinations(range(len(data.cameras)), 2):
        one, other = pair
        if data.cameras[one].size != data.cameras[other].size or not bool(good[:, pair].any(0).all()):
            continue
        swapped = []
        # The second of the two is seldom needed, and all views hardly ever.
        for a, b in (pair, pair[::-1]):
            if not _may_fit(boards, a, good[:, a], *alone[a], data.cameras[b]):
                break
            swapped.append(
                _median_rms(pose_alone(boards.points, boards.pixels[good[:, a], a], data.cameras[b], solver)[1])
            )
            if swapped[-1] >= _CLEARLY * rms[a]:
                break
        else:
            first, second = data.names[one], data.names[other]
            raise InputError(
                f"the {first} observations fit the {second} camera better (RMS {swapped[0]:.2f} against "
                f"{rms[one]:.2f} px), and the {second} ones the {first} camera: the cameras are swapped"
            )


def _may_fit(boards: Boards, index: int, good: Tensor, poses: Pose, rms: Tensor, camera: Camera) -> bool:
    """Whether another camera fits a few of the boards that one sees better than this one does."""
    which = good.nonzero()[:, 0]
    which = which[evenly(len(which), _FEW)]
    pixels = boards.pixels[which, index]
    start = BoardState.flat(camera.params.detach(), *poses.some(which))
    _, cost = refine_poses(Views(board_points=boards.points, pixels=pixels), camera.model, start, _ROUGH)
    return _median_rms(_view_rms(pixels, cost)) < _median_rms(rms[which])


def evenly(count: int, most: int) -> Tensor:
    """Numbers below `count`, `most` at most, evenly taken."""
    return torch.linspace(0, count - 1, min(count, most)).round().long()


def half_turn(board: Tensor) -> Pose:
    """From a board (N, 3) to the same board read from its other end: half a turn about its middle."""
    return Pose(torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)), board.amin(0) + board.amax(0))


def consensus(
    board: Tensor, pixels: Tensor, cameras: tuple[Camera, Camera], left: Pose, right: Pose
) -> tuple[Pose, Tensor, Tensor]:
    """Find the relative pose that most pairs agree with, which pairs are turned under it, and each pair's error (px).

    Each of some pairs, evenly taken, proposes a relative pose, with the corners as read and with the second camera's
    order turned by 180°.
    """
    some = evenly(len(pixels), _PROPOSALS)
    ahead, back = right.some(some), left.some(some).inverse()
    proposals = Pose(*map(torch.cat, zip(ahead.after(back), ahead.after(half_turn(board)).after(back), strict=True)))
    points_left = board @ left.rotation.transpose(-1, -2) + left.translation[:, None]
    points_right = points_left @ proposals.rotation.mT[:, None] + proposals.translation[:, None, None]
    projected, valid = cameras[1].project(points_right)
    projected = torch.where(valid[..., None], projected, torch.inf)
    as_read, other_end = (_distance(projected, seen) for seen in (pixels[:, 1], pixels[:, 1].flip(-2)))
    turned = other_end < _TURNED * as_read
    error = torch.where(turned, other_end, as_read)
    # At least two pairs must agree, or every proposal would be right about its own pair.
    rank = min(len(pixels), max(2, (len(pixels) + 1) // 2))
    scores, best = error.sort(-1).values[:, rank - 1].tolist(), 0
    for number, score in enumerate(scores):
        # One pair, or boards that hardly moved, fit a turned proposal as well: then the order is as read.
        if score < (_TURNED if number >= len(some) else 1.0) * scores[best]:
            best = number
    return proposals.some(best), turned[best], error[best]


def _distance(projected: Tensor, observed: Tensor) -> Tensor:
    """Root mean square distance (..., P) over the corners that were seen."""
    return torch.sqrt(torch.nanmean(((projected - observed) ** 2).sum(-1), -1))


def refuse_wrong_pairs(
    boards: Boards, both: Tensor, cameras: tuple[Camera, Camera], names: Sequence[str], poses: tuple[Pose, Pose]
) -> tuple[Pose, Tensor, Tensor]:
    """`consensus` of two cameras; refuse views that are paired with those of other moments, and cameras that moved.

    Args:
        boards: all boards, (V, 2, N, 2) pixels of both cameras.
        both: numbers of those that both see, in the order in which they were taken.
        cameras: the two.
        names: of them.
        poses: of these boards before each camera.

    Raises:
        InputError: with what the pairs tell, and how many pixels they differ by.
    """
    points, pixels = boards.points, boards.pixels[both]
    found = relative, turned, error = consensus(points, pixels, cameras, *poses)
    typical, count = float(error.median()), len(both)
    if typical > _OTHER_MOMENT * math.hypot(*cameras[1].size):
        text = (
            f"the pairs contradict each other: a typical {names[1]} view shows its board {typical:.0f} px away from "
            f"where the {names[0]} view puts it"
        )
        for later in sorted(range(-_PLACES, _PLACES + 1), key=abs)[1:]:
            first, second = (slice(max(0, shift), min(count, count + shift)) for shift in (-later, later))
            if count - abs(later) < _PART:
                continue
            shifted = torch.stack([pixels[first, 0], pixels[second, 1]], 1)
            better = float(consensus(points, shifted, cameras, poses[0].some(first), poses[1].some(second))[2].median())
            if better < _BETTER * typical and better < _OTHER_MOMENT * math.hypot(*cameras[1].size):
                views = boards.views or (boards.names, boards.names)
                mates = [views[c][int(both[part.start])] for c, part in enumerate((first, second))]
                raise InputError(
                    f"{text}, and only {better:.1f} px if {mates[0]} belongs with {mates[1]}, and so on: views of "
                    "different moments are paired; give the right pairs with kcal rig --match PAIRS.csv"
                )
        raise InputError(
            f"{text}: were both views of each pair taken at the same moment, and of one board? Give the pairs that "
            "belong together with kcal rig --match PAIRS.csv"
        )
    placed = points @ poses[0].rotation.mT + poses[0].translation[:, None]
    seen = torch.where(turned[:, None, None], pixels[:, 1].flip(-2), pixels[:, 1])
    projected, _ = cameras[1].project(placed @ relative.rotation.T + relative.translation)
    off = torch.nanmean(seen - projected, 1)
    splits = [(_scatter(off[:k])[0] + _scatter(off[k:])[0], k) for k in range(_PART, count - _PART + 1)]
    if splits:
        within, k = min(splits)
        moved = float((_scatter(off[k:])[1] - _scatter(off[:k])[1]).norm())
        if within < _BETTER * _scatter(off)[0] and moved > _MOVED:
            raise InputError(
                f"{names[0]} and {names[1]} moved against each other between pair {boards.names[int(both[k - 1])]} and "
                f"pair {boards.names[int(both[k])]}: from there on, boards appear {moved:.1f} px elsewhere, and before "
                f"and after pairs agree within {within / count:.1f} px. Give the pairs of one part with "
                "kcal rig --match PAIRS.csv, or take all of them again"
            )
    return found


def _scatter(values: Tensor) -> tuple[float, Tensor]:
    """Sum of distances from the median, axis by axis, and the median."""
    middle = values.median(0).values
    return float((values - middle).abs().sum()), middle
