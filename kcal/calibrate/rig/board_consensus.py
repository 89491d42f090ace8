"""Find the relative pose that pairs of board views agree on, before anything is refined jointly."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.poses import poses_under, refine_poses
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import Views
from kcal.calibrate.rig.sources import Boards, RigData
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.solve.lm import LMOptions

MINIMUM_CORNERS = 6
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


@dataclasses.dataclass(frozen=True)
class Poses:
    """Rigid motions: rotation (..., 3, 3) and translation (..., 3) meters."""

    rotation: Tensor
    translation: Tensor

    @classmethod
    def at(cls, rotation: Tensor, center: Tensor) -> Poses:
        """World to camera, of a camera whose center is in the world."""
        return cls(rotation, -(rotation @ center))

    @property
    def center(self) -> Tensor:
        """The point that is moved to the origin."""
        return self.inverse().translation

    def after(self, other: Poses) -> Poses:
        """This motion applied after another."""
        return Poses(
            self.rotation @ other.rotation,
            (self.rotation @ other.translation[..., None])[..., 0] + self.translation,
        )

    def inverse(self) -> Poses:
        """The motion back."""
        back = self.rotation.transpose(-1, -2)
        return Poses(back, -(back @ self.translation[..., None])[..., 0])

    def __getitem__(self, index: int | slice) -> Poses:
        return Poses(self.rotation[index], self.translation[index])


def pose_alone(board: Tensor, pixels: Tensor, camera: Camera, solver: LMOptions) -> tuple[Poses, Tensor]:
    """Board poses from one camera alone, and the RMS (V,) of each view, px; NaN where a view has no pose."""
    state, cost = poses_under(camera, Views(board_points=board, pixels=pixels), solver)
    return Poses(state.rotation, state.translation), _view_rms(pixels, cost)


def _view_rms(pixels: Tensor, cost: Tensor) -> Tensor:
    """(V,) px, of the costs of views."""
    return (2.0 * cost / torch.isfinite(pixels).all(-1).sum(-1)).sqrt()


def _median_rms(rms: Tensor) -> float:
    """The median; infinite where a view has no pose."""
    return float(rms.median().nan_to_num(math.inf)) if len(rms) else 0.0


class SeenAlone(NamedTuple):
    """What one camera alone makes of the boards that it sees well.

    Attributes:
        poses: (V,) of all boards, NaN for others.
        rms: (V,) px, likewise.
    """

    poses: Poses
    rms: Tensor


def check_cameras(data: RigData, good: Tensor, alone: Sequence[SeenAlone], solver: LMOptions) -> None:
    """Refuse cameras that do not fit their boards, or that fit each other's boards clearly better.

    Args:
        data: with boards.
        good: (V, C) which boards each camera sees well.
        alone: what each camera makes of these.
        solver: options of the solver.
    """
    boards = data.boards
    assert boards is not None
    rms = [_median_rms(one.rms[good[:, c]]) for c, one in enumerate(alone)]
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
            if not _may_fit(boards, a, good[:, a], alone[a], data.cameras[b]):
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


def _may_fit(boards: Boards, index: int, good: Tensor, alone: SeenAlone, camera: Camera) -> bool:
    """Whether another camera fits a few of the boards that one sees better than this one does."""
    which = good.nonzero()[:, 0]
    which = which[evenly(len(which), _FEW)]
    pixels = boards.pixels[which, index]
    start = BoardState.flat(camera.params.detach(), alone.poses.rotation[which], alone.poses.translation[which])
    _, cost = refine_poses(Views(board_points=boards.points, pixels=pixels), camera.model, start, _ROUGH)
    return _median_rms(_view_rms(pixels, cost)) < _median_rms(alone.rms[which])


def evenly(count: int, most: int) -> Tensor:
    """Numbers below `count`, `most` at most, evenly taken."""
    return torch.linspace(0, count - 1, min(count, most)).round().long()


def half_turn(board: Tensor) -> Poses:
    """From a board (N, 3) to the same board read from its other end: half a turn about its middle."""
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    return Poses(turn, board.amin(0) + board.amax(0))


def consensus(
    board: Tensor, pixels: Tensor, cameras: tuple[Camera, Camera], left: Poses, right: Poses
) -> tuple[Poses, Tensor, Tensor]:
    """Find the relative pose that most pairs agree with, which pairs are turned under it, and each pair's error (px).

    Each of some pairs, evenly taken, proposes a relative pose, with the corners as read and with the second camera's
    order turned by 180°.
    """
    some = evenly(len(pixels), _PROPOSALS).tolist()
    proposals = [right[i].after(left[i].inverse()) for i in some]
    proposals += [right[i].after(half_turn(board)).after(left[i].inverse()) for i in some]
    as_read, other_end = pixels[:, 1], pixels[:, 1].flip(-2)
    points_left = board @ left.rotation.transpose(-1, -2) + left.translation[:, None]
    best: tuple[float, Poses, Tensor, Tensor] | None = None
    for number, proposal in enumerate(proposals):
        projected, valid = cameras[1].project(points_left @ proposal.rotation.T + proposal.translation)
        projected = torch.where(valid[..., None], projected, torch.inf)
        errors = torch.stack([_distance(projected, as_read), _distance(projected, other_end)])
        turned = errors[1] < _TURNED * errors[0]
        error = torch.where(turned, errors[1], errors[0])
        # At least two pairs must agree, or every proposal would be right about its own pair.
        rank = min(len(error), max(2, (len(error) + 1) // 2))
        score = float(error.sort().values[rank - 1])
        # One pair, or boards that hardly moved, fit a turned proposal as well: then the order is as read.
        if best is None or score < (_TURNED if number >= len(some) else 1.0) * best[0]:
            best = (score, proposal, turned, error)
    assert best is not None
    return best[1:]


def _distance(projected: Tensor, observed: Tensor) -> Tensor:
    """Root mean square distance (P,) over the corners that were seen."""
    return torch.sqrt(torch.nanmean(((projected - observed) ** 2).sum(-1), -1))


def refuse_wrong_pairs(
    boards: Boards, both: Tensor, cameras: tuple[Camera, Camera], names: Sequence[str], poses: tuple[Poses, Poses]
) -> tuple[Poses, Tensor, Tensor]:
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
            better = float(consensus(points, shifted, cameras, poses[0][first], poses[1][second])[2].median())
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
