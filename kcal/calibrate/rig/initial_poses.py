"""Where the cameras of a rig roughly stand: from boards, and from landmarks by resection."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.views import among
from kcal.calibrate.rig.pairs import check_cameras, half_turn, pose_alone, refuse_wrong_pairs
from kcal.calibrate.rig.resection import consensus_rotation, distinct_poses
from kcal.calibrate.rig.source import Start, as_items
from kcal.calibrate.rig.sources import Boards, RigData
from kcal.errors import DegenerateError
from kcal.lens.pose import Pose, rotation_between
from kcal.solve.lm import LMOptions

# Find roughly where the cameras and boards of a rig stand, before everything is adjusted together.

# A board that is farther from where the other boards put it than both (pixels, and times the median) does not belong.
_FOREIGN_PX, _FOREIGN_TIMES = 10.0, 10.0
# Weight of "cameras are held upright" where measured positions leave a turn open: enough to decide, without effect on
# what the positions tell.
_LEVEL = 1e-3
# Landmarks that place a camera in up to four ways.
_AMBIGUOUS = 3
# Cameras whose directions are tried in all combinations.
_AT_ONCE = 1


class TurnedBoard(NamedTuple):
    """A board that one camera had read from its other end, by the names of both."""

    board: str
    camera: str


# The cameras whose poses (cam_from_world) were found so far.
_Known = dict[int, Pose]


def first_poses(data: RigData, solver: LMOptions) -> InitialPoses:
    """Find a pose for every camera and board, from landmarks, then boards, then features and measured positions.

    Raises:
        DegenerateError: nothing connects a camera with the others; it is named.
    """
    places, known = {p.camera: p.point for p in reversed(data.positions)}, _Known()
    # Where several sources tell a pose, the first of them counts.
    for source in reversed(data.sources):
        known |= source.poses(data.cameras, places)
    views = InitialPoses(data, solver)
    placed = bool(known)
    starts = None if placed else _level_starts(data)
    if starts is None:
        if not placed:
            known[0] = Pose.still()
        tried: list[int] = []
        while waiting := [c for c in range(len(data.cameras)) if c not in known]:
            if views.link(known, waiting):
                continue
            if not any(_from_features(data, c, known, tried, placed=placed) for c in waiting):
                raise DegenerateError(
                    f"nothing tells where {', '.join(data.names[c] for c in waiting)} stands: it needs boards seen "
                    "together with another camera, four or better six landmarks, or features together with its "
                    "position or the baseline"
                )
        starts = _in_all_places(data, _starts(known, tried[:_AT_ONCE]))
        views.tried = tried
        if data.absolute and not placed:
            starts = [_into_frame(data, start) for start in starts]
    views.turn_all()
    views.starts = [views.with_boards(start) for start in starts]
    return views


def _stacked(known: _Known) -> tuple[Tensor, Tensor]:
    poses = [known[c] for c in sorted(known)]
    return torch.stack([pose.rotation for pose in poses]), torch.stack([pose.center for pose in poses])


def _level_starts(data: RigData) -> list[Start] | None:
    """Starts for cameras whose positions are all measured and that only features connect: level, in eight headings.

    Of two cameras the direction from one to the other is found instead, and then turned to the measured one.
    """
    places = {p.camera: p.point for p in reversed(data.positions)}
    if _far_pixels(data) is None or data.boards is not None or len(places) < max(len(data.cameras), 3):
        return None
    known = {0: Pose.still()}
    for _ in data.cameras:
        for camera in range(len(data.cameras)):
            if camera not in known:
                _from_features(data, camera, known, [], placed=False)
    if len(known) < len(data.cameras):
        return None
    center, starts = torch.stack([places[c] for c in sorted(places)]), []
    for eighth in range(8):
        sine, cosine = math.sin(math.pi * eighth / 4), math.cos(math.pi * eighth / 4)
        level = torch.tensor([[cosine, -sine, 0.0], [0.0, 0.0, -1.0], [sine, cosine, 0.0]], dtype=torch.float64)
        starts.append(Start(rotation=_stacked(known)[0] @ level, center=center))
    return starts


def _position(data: RigData, camera: int) -> Tensor | None:
    return next((p.point for p in data.positions if p.camera == camera), None)


def _from_features(data: RigData, camera: int, known: _Known, tried: list[int], *, placed: bool) -> bool:
    """Rotation from features shared with a known camera; the center from its position, or at a distance to be tried."""
    pixels = _far_pixels(data)
    if pixels is None:
        return False
    # Until landmarks have placed a camera, the frame is that of the first camera, not of measured positions.
    center = _position(data, camera) if placed else None
    for other in sorted(known):
        rays, valid = data.cameras[camera].unproject(pixels[:, camera])
        far, seen = data.cameras[other].unproject(pixels[:, other])
        use = torch.isfinite(pixels[:, [camera, other]]).all(-1).all(-1) & valid & seen
        if int(use.sum()) < 2:
            continue
        rotation, _ = consensus_rotation(rays[use], far[use] @ known[other].rotation)
        if center is None:
            length = _baseline(data, camera, other)
            if length is None:
                continue
            # In which direction the camera stands is tried later.
            center = known[other].center + length * known[other].rotation[0]
            tried.append(camera)
        known[camera] = Pose.at(rotation, center)
        return True
    return False


def _far_pixels(data: RigData) -> Tensor | None:
    """(N, C, 2) marks of points that tell how cameras are turned; None without any."""
    far = [source.pixels for source in data.seen if source.turns]
    return torch.cat(far) if far else None


def _baseline(data: RigData, one: int, other: int) -> float | None:
    for baseline in data.baselines:
        if {baseline.first, baseline.second} == {one, other}:
            return baseline.length
    places = _position(data, one), _position(data, other)
    if places[0] is None or places[1] is None:
        return None
    return float(torch.linalg.vector_norm(places[0] - places[1]))


def _starts(known: _Known, tried: list[int]) -> list[Start]:
    """The known poses, with each camera of `tried` in all six directions from another one."""
    starts = [Start(*_stacked(known))]
    for camera in tried:
        starts = [moved for start in starts for moved in around(start, camera)]
    return starts


def around(start: Start, camera: int) -> list[Start]:
    """A start with a camera in all six directions from another one."""
    other = 0 if camera != 0 else 1
    length = torch.linalg.vector_norm(start.center[camera] - start.center[other])
    places = start.center[other] + length * torch.cat([start.rotation[other], -start.rotation[other]])
    at = torch.tensor([camera])
    return [start._replace(center=start.center.index_copy(0, at, place[None])) for place in places]


def mirrored(start: Start) -> Start:
    """A start with all cameras on the other side of the first one.

    With far points the whole rig and its mirror image fit alike; only what is in front of the cameras tells.
    """
    return start._replace(center=2.0 * start.center[0] - start.center)


def _in_all_places(data: RigData, starts: list[Start]) -> list[Start]:
    """The starts, also with cameras that see three landmarks in all the places that these allow."""
    marks = data.landmarks
    for c, camera in enumerate(data.cameras if marks is not None else ()):
        assert marks is not None
        rays, valid = camera.unproject(marks.pixels[:, c])
        if int(valid.sum()) != _AMBIGUOUS or _position(data, c) is not None:
            continue
        for start in list(starts):
            for rotation, center in distinct_poses(rays[valid], marks.points[valid], start.center[c], _AMBIGUOUS):
                turned, moved = start.rotation.clone(), start.center.clone()
                turned[c], moved[c] = rotation, center
                starts.append(start._replace(rotation=turned, center=moved))
    return starts


def _into_frame(data: RigData, start: Start) -> Start:
    """A rig moved from its first camera's frame to where its cameras were measured."""
    index = [p.camera for p in data.positions]
    there = torch.stack([p.point for p in data.positions])
    here = start.center[index]
    level = -start.rotation.transpose(-1, -2)[..., 1].mean(0, keepdim=True)
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    moved = there - there.mean(0), here - here.mean(0)
    scale = max(float(torch.linalg.vector_norm(moved[1])), 1.0)
    turn = rotation_between(torch.cat([moved[1] / scale, _LEVEL * level]), torch.cat([moved[0] / scale, _LEVEL * up]))
    return Start(start.rotation @ turn.T, (start.center - here.mean(0)) @ turn.T + there.mean(0))


class InitialPoses:
    """What a solve begins with: board poses from each camera alone, and those of cameras that saw the same boards.

    Attributes:
        data: with boards turned where they had been read from the other end.
        starts: possible starts; the one with the best solution is used.
        tried: cameras that are then moved to all six directions from another one, one after another.
        flipped: boards that were turned.
        foreign: indices of boards that do not belong, with the reason.
    """

    def __init__(self, data: RigData, solver: LMOptions) -> None:
        self.data = data
        self.starts: list[Start] = []
        self.tried: list[int] = []
        self.flipped: list[TurnedBoard] = []
        self.foreign: dict[int, str] = {}
        self._alone: list[Pose] = []
        self._compared: set[tuple[int, int]] = set()
        alone = list[tuple[Pose, Tensor]]()
        self._good = torch.zeros(0, len(data.cameras), dtype=torch.bool)
        boards = data.boards
        if boards is None:
            return
        points, self._good = boards.points, boards.seen_well(data.cameras)
        for c, (camera, enough) in enumerate(zip(data.cameras, self._good.T, strict=True)):
            poses, rms = pose_alone(points, boards.pixels[enough, c], camera, solver)
            views, count = enough.nonzero()[:, 0].tolist(), len(enough)
            alone.append((Pose(*(among(part, views, count) for part in poses)), among(rms, views, count)))
        check_cameras(data, self._good, alone, solver)
        self._alone = [poses for poses, _ in alone]

    def link(self, known: _Known, waiting: list[int]) -> bool:
        """Place the waiting camera that shares the most boards with one that is placed."""
        shared = [(int((self._good[:, c] & self._good[:, o]).sum()), c, o) for c in waiting for o in known]
        number, camera, other = max(shared)
        if number > 0:
            known[camera] = self._relative(other, camera).after(known[other])
        return number > 0

    def turn_all(self) -> None:
        """Turn boards that were read from the other end also for cameras that landmarks have placed."""
        if self.data.boards is None:
            return
        for camera in range(1, len(self.data.cameras)):
            if (0, camera) not in self._compared and bool((self._good[:, 0] & self._good[:, camera]).any()):
                self._relative(0, camera)

    def _relative(self, first: int, second: int) -> Pose:
        boards = self.data.boards
        assert boards is not None
        self._compared.add((first, second))
        both = (self._good[:, first] & self._good[:, second]).nonzero()[:, 0]
        cameras = self.data.cameras[first], self.data.cameras[second]
        one, two = (self._alone[c].some(both) for c in (first, second))
        seen = dataclasses.replace(
            boards,
            pixels=boards.pixels[:, [first, second]],
            covariance=None,
            views=boards.views and (boards.views[first], boards.views[second]),
        )
        names = self.data.names[first], self.data.names[second]
        relative, turned, error = refuse_wrong_pairs(seen, both, cameras, names, (one, two))
        if bool(turned.any()):
            self._turn(boards, both[turned], second)
        limit = max(_FOREIGN_TIMES * float(error.median()), _FOREIGN_PX)
        for i in (error > limit).nonzero()[:, 0].tolist():
            reason = f"its board is {float(error[i]):.0f} px away from where the other boards put it"
            self.foreign[int(both[i])] = reason
        return relative

    def _turn(self, boards: Boards, views: Tensor, camera: int) -> None:
        pixels = boards.pixels.clone()
        pixels[views, camera] = pixels[views, camera].flip(-2)
        covariance = boards.covariance
        if covariance is not None:
            covariance = covariance.clone()
            covariance[views, camera] = covariance[views, camera].flip(-3)
        self.data = dataclasses.replace(
            self.data, boards=dataclasses.replace(boards, pixels=pixels, covariance=covariance)
        )
        alone = self._alone[camera]
        new = alone.some(views).after(half_turn(boards.points))
        alone.rotation[views], alone.translation[views] = new.rotation, new.translation
        self.flipped += [TurnedBoard(boards.names[i], self.data.names[camera]) for i in views.tolist()]

    def with_boards(self, start: Start) -> Start:
        """The start with boards where its cameras see them."""
        return start._replace(boards=as_items(*self.world(start)))

    def world(self, start: Start) -> tuple[Tensor, Tensor]:
        """world_from_board from the first camera that sees each board well; where none does, an arbitrary pose."""
        count = len(self._good)
        rotation = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
        translation = torch.zeros(count, 3, dtype=torch.float64)
        for c in reversed(range(len(self.data.cameras))):
            seen = self._good[:, c] if count else self._good.new_zeros(0)
            if bool(seen.any()):
                rotation[seen] = start.rotation[c].T @ self._alone[c].rotation[seen]
                translation[seen] = self._alone[c].translation[seen] @ start.rotation[c] + start.center[c]
        return rotation, translation
