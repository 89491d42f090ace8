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
    """Put each camera to the board, among those of its kind, that it shares with most evidence, or to a new one.

    Whether one board is better than two is asked of messages alone. Nothing is fitted again, and the evidence of each
    camera and of each group is found once.
    """
    out, groups = list(cameras), list[_SharedBoard]()
    # Those that know most begin: they have most to lose from another's board.
    known = [float(camera.message.rows[:, :-1].square().sum()) for camera in cameras]
    # Boards as printers make them look alike from all ends: turned messages have the same evidence.
    alone = [_evidence([camera.message], camera) for camera in cameras]
    for i in sorted(range(len(out)), key=lambda i: -known[i]):
        best: tuple[float, CameraFit, _SharedBoard | None, float] = (0.0, out[i], None, alone[i])
        for group in groups:
            if kinds[group.members[0]] == kinds[i]:
                for turn in quarter_turns(kinds[i]):
                    camera = _turned(cameras[i], turn)
                    together = _evidence([camera.message, group.said], camera)
                    # Read from another end only where that is clear.
                    gain = together - alone[i] - group.evidence - (CLEAR if turn else 0.0)
                    best = max(best, (gain, camera, group, together), key=lambda found: found[0])
        _, out[i], home, together = best
        if home is None:
            groups.append(_SharedBoard([i], out[i].message, together))
        else:
            home.members.append(i)
            home.said, home.evidence = _merged([home.said, out[i].message]), together
    # Boards are numbered by their first cameras.
    for k, group in enumerate(sorted(groups, key=lambda group: min(group.members))):
        but_one = _but_one([out[i].message for i in group.members])
        for i, others in zip(group.members, but_one, strict=True):
            if others is not None:
                gains = [group.evidence - alone[i] - _evidence([others], out[i])]
            else:
                rivals = [g for g in groups if g is not group and kinds[g.members[0]] == kinds[i]]
                gains = [_evidence([out[i].message, g.said], out[i]) - alone[i] - g.evidence for g in rivals]
            out[i] = dataclasses.replace(out[i], board=k, nats=max(gains, default=math.nan))
    return out


@dataclasses.dataclass
class _SharedBoard:
    """Cameras that saw one board, what they say of it, and the log evidence of that."""

    members: list[int]
    said: Gaussian
    evidence: float


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


def _turned(camera: CameraFit, turn: int) -> CameraFit:
    """With all views read from another end."""
    return dataclasses.replace(camera, turns=(camera.turns + turn) % 4, message=turned(camera.message, turn))
