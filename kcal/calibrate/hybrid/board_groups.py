"""Which cameras saw one board: their messages about it agree better than those about two boards would."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from kcal.calibrate.hybrid.board_orders import CLEAR, quarter_turns, turned
from kcal.calibrate.hybrid.board_prior import evidence, printed_board
from kcal.calibrate.hybrid.turned_fit import CameraFit
from kcal.corners.board import Board
from kcal.gaussian import Gaussian, stacked


def grouped(cameras: Sequence[CameraFit], kinds: Sequence[Board]) -> list[CameraFit]:
    """Put each camera to the board, among those of its kind, that it shares with most evidence, or to a new one."""
    out, groups, said = list(cameras), list[list[int]](), list[Gaussian]()
    # Those that know most begin: they have most to lose from another's board.
    known = [float(camera.message.rows[:, :-1].square().sum()) for camera in cameras]
    for i in sorted(range(len(out)), key=lambda i: -known[i]):
        best: tuple[float, CameraFit, int] = (0.0, out[i], len(groups))
        for k, group in enumerate(groups):
            if kinds[group[0]] == kinds[i]:
                for turn in quarter_turns(kinds[i]):
                    camera = _turned(cameras[i], turn)
                    # Read from another end only where that is clear.
                    gain = _gain(camera, said[k]) - (CLEAR if turn else 0.0)
                    best = max(best, (gain, camera, k), key=lambda found: found[0])
        _, out[i], k = best
        if k == len(groups):
            groups.append([i])
            said.append(out[i].message)
        else:
            groups[k].append(i)
            said[k] = _merged([said[k], out[i].message])
    # Boards are numbered by their first cameras.
    for k, group in enumerate(sorted(groups, key=min)):
        but_one = _but_one([out[i].message for i in group])
        for i, others in zip(group, but_one, strict=True):
            rivals = [said[g] for g, other in enumerate(groups) if other is not group and kinds[other[0]] == kinds[i]]
            gains = [_gain(out[i], rival) for rival in ([others] if others is not None else rivals)]
            out[i] = dataclasses.replace(out[i], board=k, nats=max(gains, default=math.nan))
    return out


def compared(camera: CameraFit, known: Gaussian, kind: Board) -> CameraFit:
    """With the evidence that the board is the measured one, and all views turned if it was read from another end."""

    def nats(camera: CameraFit) -> float:
        return evidence(known, [camera.message]) - _evidence([camera.message], camera)

    best = camera
    for turn in quarter_turns(kind)[1:]:
        best = max(best, _turned(camera, turn), key=lambda found: nats(found) + CLEAR * (found is camera))
    return dataclasses.replace(best, board=0, nats=nats(best))


def others_of(cameras: Sequence[CameraFit], board: int) -> dict[int, Gaussian | None]:
    """For each camera that saw a board: what all others say of it."""
    members = [i for i, camera in enumerate(cameras) if camera.board == board]
    said = _but_one([cameras[i].message for i in members])
    return dict(zip(members, said, strict=True))


def _but_one(messages: Sequence[Gaussian]) -> list[Gaussian | None]:
    """For each message, all others merged; None where there is no other. As many merges as there are messages."""

    def running(messages: Sequence[Gaussian]) -> list[Gaussian | None]:
        out: list[Gaussian | None] = [None]
        for message in messages[:-1]:
            out.append(_merged([m for m in (out[-1], message) if m is not None]))
        return out

    before, after = running(messages), running(messages[::-1])[::-1]
    both = [[m for m in pair if m is not None] for pair in zip(before, after, strict=True)]
    return [_merged(some) if some else None for some in both]


def _merged(messages: Sequence[Gaussian]) -> Gaussian:
    """All that they say, in few rows."""
    return stacked(messages).compressed()


def _evidence(messages: Sequence[Gaussian], like: CameraFit) -> float:
    """Log evidence of messages about one printed board."""
    return printed_board(like.fit.board_shapes, messages)[1]


def _gain(camera: CameraFit, others: Gaussian) -> float:
    """Nats by which one board for all is better than one for the camera and one for the others."""
    alone = _evidence([camera.message], camera) + _evidence([others], camera)
    return _evidence([camera.message, others], camera) - alone


def _turned(camera: CameraFit, turn: int) -> CameraFit:
    """With all views read from another end."""
    return dataclasses.replace(camera, turns=(camera.turns + turn) % 4, message=turned(camera.message, turn))
