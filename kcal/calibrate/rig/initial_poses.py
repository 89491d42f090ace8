"""Where the cameras of a rig roughly stand: from boards, and from landmarks by resection."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.poses import spread_out
from kcal.calibrate.rig.pairs import (
    MINIMUM_CORNERS,
    Poses,
    SeenAlone,
    check_cameras,
    half_turn,
    pose_alone,
    refuse_wrong_pairs,
)
from kcal.calibrate.rig.sources import Boards, RigData
from kcal.errors import DegenerateError
from kcal.lens.turning import rotation_between
from kcal.solve.lm import LMOptions

# Find a camera's pose from rays and known points alone, as a start for an adjustment.
#
# Every pose from three points (or, where the position is known, from two directions) is tried, and the one that the
# other points agree with best is taken, so that wrong points do no harm while they are the minority.

# Most subsets that are tried.
_SAMPLES = 400
# Radians: all rays that are farther off than this count alike.
_GROSS = 5e-3
# Centers that are farther apart, in distances of the points, are other places.
_ELSEWHERE = 0.01


def poses_from_three(rays: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (..., 4, 3, 3) and centers (..., 4, 3) of a camera that sees three points (..., 3, 3) along unit rays.

    NaN where a solution is not real. Source: Grunert (1841), as written down by Haralick, Lee, Ottenberg and Nölle
    (1994), Int. J. Computer Vision 13 (3), Eq. 9 and 8.
    """

    def squared(i: int, j: int) -> Tensor:
        return (points[..., i, :] - points[..., j, :]).square().sum(-1)

    def cosine(i: int, j: int) -> Tensor:
        return (rays[..., i, :] * rays[..., j, :]).sum(-1)

    aa, bb, cc = squared(1, 2), squared(0, 2), squared(0, 1)
    alpha, beta, gamma = cosine(1, 2), cosine(0, 2), cosine(0, 1)
    p, q, s, c = (aa - cc) / bb, (aa + cc) / bb, aa / bb, cc / bb
    quartic = torch.stack(
        [
            (p - 1) ** 2 - 4 * c * alpha**2,
            4 * (p * (1 - p) * beta - (1 - q) * alpha * gamma + 2 * c * alpha**2 * beta),
            2
            * (
                p**2
                - 1
                + 2 * p**2 * beta**2
                + 2 * (1 - c) * alpha**2
                - 4 * q * alpha * beta * gamma
                + 2 * (1 - s) * gamma**2
            ),
            4 * (-p * (1 + p) * beta + 2 * s * gamma**2 * beta - (1 - q) * alpha * gamma),
            (1 + p) ** 2 - 4 * s * gamma**2,
        ],
        -1,
    )
    v = _real_roots(quartic)
    p, alpha, beta, gamma = (value[..., None] for value in (p, alpha, beta, gamma))
    u = ((p - 1) * v**2 - 2 * p * beta * v + 1 + p) / (2 * (gamma - v * alpha))
    first = torch.sqrt(bb[..., None] / (1 + v**2 - 2 * v * beta))
    lengths = first[..., None] * torch.stack([torch.ones_like(u), u, v], -1)
    good = torch.isfinite(lengths).all(-1) & (lengths > 0).all(-1)
    safe = torch.where(good[..., None], lengths, 1.0)
    in_camera = safe[..., None] * rays[..., None, :, :]
    middle, known = in_camera.mean(-2, keepdim=True), points.mean(-2, keepdim=True)
    rotation = rotation_between((points - known)[..., None, :, :], in_camera - middle)
    center = known - (rotation.transpose(-1, -2) @ middle.transpose(-1, -2))[..., 0]
    return torch.where(good[..., None, None], rotation, torch.nan), torch.where(good[..., None], center, torch.nan)


def _real_roots(coefficients: Tensor) -> Tensor:
    """Real roots (..., 4) of quartics with coefficients (..., 5), highest first; NaN where not real."""
    companion = torch.zeros(*coefficients.shape[:-1], 4, 4, dtype=coefficients.dtype)
    lead = torch.where(coefficients[..., :1] == 0, 1e-300, coefficients[..., :1])
    companion[..., 0, :] = (-coefficients[..., 1:] / lead).nan_to_num(0.0, 0.0, 0.0)
    companion[..., 1:, :3] = torch.eye(3, dtype=coefficients.dtype)
    roots = torch.linalg.eigvals(companion)
    # Noise parts a double root into two that are nearly real: their common real part is a start.
    near = roots.imag.abs() <= 0.05 * roots.abs()
    return torch.where(near, roots.real, torch.nan)


def _samples(count: int, size: int) -> Tensor:
    """(K, size) indices: all subsets, or some hundreds drawn with a fixed seed."""
    if math.comb(count, size) <= _SAMPLES:
        return torch.tensor(list(itertools.combinations(range(count), size)))
    generator = torch.Generator().manual_seed(count)
    return torch.stack([torch.randperm(count, generator=generator)[:size] for _ in range(_SAMPLES)])


def _score(rays: Tensor, rotation: Tensor, directions: Tensor) -> Tensor:
    """(...) sum of squared angles between rays (M, 3) and R directions (..., M, 3), each cut at the gross one."""
    unit = directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)
    squared = (unit @ rotation.transpose(-1, -2) - rays).square().sum(-1)
    return squared.clamp_max(_GROSS**2).sum(-1).nan_to_num(math.inf)


def consensus_rotation(rays: Tensor, directions: Tensor) -> tuple[Tensor, float]:
    """The rotation that most of the rays (M, 3) and directions (M, 3), M at least 2, agree on, and its score."""
    chosen = _samples(len(rays), 2)
    rotation = rotation_between(directions[chosen], rays[chosen])
    score = _score(rays, rotation, directions.expand(len(chosen), -1, -1))
    best = int(score.argmin())
    return rotation[best], float(score[best])


def consensus_pose(rays: Tensor, points: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor, float] | None:
    """The pose that most of the rays (M, 3) to known points (M, 3) agree on.

    Args:
        rays: unit, in the camera's frame.
        points: meters.
        near: (3,) the camera's center, if it was measured; then two points do, otherwise three or better four.

    Returns:
        rotation (3, 3), center (3,) and the score, smaller being better; None if the points do not suffice.
    """
    found: list[tuple[Tensor, Tensor, float]] = []
    if near is not None and len(rays) >= 2:
        towards = points - near
        towards = towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
        rotation, score = consensus_rotation(rays, towards)
        found.append((rotation, near, score))
    if len(rays) >= 3:
        chosen = _samples(len(rays), 3)
        rotations, centers = (value.flatten(0, 1) for value in poses_from_three(rays[chosen], points[chosen]))
        scores = _score(rays, rotations, points - centers[:, None])
        best = int(scores.argmin())
        if math.isfinite(float(scores[best])):
            found.append((rotations[best], centers[best], float(scores[best])))
    return min(found, key=lambda pose: pose[2]) if found else None


def distinct_poses(
    rays: Tensor, points: Tensor, known: Tensor, most: int, awry: float = math.inf
) -> list[tuple[Tensor, Tensor]]:
    """Poses, other than at a known center (3,), that three of the rays (M, 3) to points (M, 3) allow; the best first.

    Args:
        rays: unit, in the camera's frame.
        points: meters.
        known: (3,) center of the pose that is not wanted.
        most: how many at most.
        awry: radians that the others may be off at most, all together.
    """
    chosen = _samples(len(rays), 3)
    rotations, centers = (value.flatten(0, 1) for value in poses_from_three(rays[chosen], points[chosen]))
    scores = _score(rays, rotations, points - centers[:, None])
    distance = float((points.mean(0) - known).norm())
    found: list[tuple[Tensor, Tensor]] = []
    for i in scores.argsort().tolist():
        others = torch.stack([known, *(center for _, center in found)])
        if not float(scores[i]) < awry**2 or math.isinf(float(scores[i])):
            break
        if float((others - centers[i]).norm(dim=-1).min()) > _ELSEWHERE * distance:
            found.append((rotations[i], centers[i]))
        if len(found) == most:
            break
    return found


# Find roughly where the cameras and boards of a rig stand, before everything is adjusted together.

# A board that is farther from where the other boards put it than both (pixels, and times the median) does not belong.
_FOREIGN_PX, _FOREIGN_TIMES = 10.0, 10.0
# Weight of "cameras are held upright" where measured positions leave a turn open: enough to decide, without effect on
# what the positions tell.
_LEVEL = 1e-3
# Landmarks that place a camera in up to four ways.
_AMBIGUOUS = 3


@dataclasses.dataclass(kw_only=True, eq=False)
class Start:
    """Poses to begin with.

    Args:
        rotation: (C, 3, 3) cam_from_world.
        center: (C, 3) meters.
        board_rotation: (V, 3, 3) world_from_board.
        board_translation: (V, 3) meters.
    """

    rotation: Tensor
    center: Tensor
    board_rotation: Tensor = dataclasses.field(default_factory=lambda: torch.empty(0, 3, 3, dtype=torch.float64))
    board_translation: Tensor = dataclasses.field(default_factory=lambda: torch.empty(0, 3, dtype=torch.float64))


class TurnedBoard(NamedTuple):
    """A board that one camera had read from its other end, by the names of both."""

    board: str
    camera: str


@dataclasses.dataclass(kw_only=True, eq=False)
class InitialPoses:
    """What a solve begins with.

    Args:
        data: with boards turned where they had been read from the other end.
        starts: possible starts; the one with the best solution is used.
        flipped: boards that were turned.
        foreign: indices of boards that do not belong, with the reason.
        usable: (V,) boards that at least two cameras see well.
    """

    data: RigData
    starts: list[Start]
    flipped: list[TurnedBoard]
    foreign: dict[int, str]
    usable: Tensor


# The cameras whose poses (cam_from_world) were found so far.
_Known = dict[int, Poses]


def first_poses(data: RigData, solver: LMOptions) -> InitialPoses:
    """Find a pose for every camera and board, from landmarks, then boards, then features and measured positions.

    Raises:
        DegenerateError: nothing connects a camera with the others; it is named.
    """
    known = {**_from_skyline(data), **(_from_landmarks(data) or _from_named_stars(data))}
    views = _BoardViews(data, solver)
    placed = bool(known)
    starts = None if placed else _level_starts(data)
    if starts is None:
        if not placed:
            known[0] = _at_origin()
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
        starts = _in_all_places(data, _starts(known, tried))
        if data.absolute and not placed:
            for start in starts:
                _into_frame(data, start)
    views.turn_all()
    for start in starts:
        start.board_rotation, start.board_translation = views.world(start)
    return InitialPoses(
        data=views.data, starts=starts, flipped=views.flipped, foreign=views.foreign, usable=views.usable
    )


def _at_origin() -> Poses:
    return Poses(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


def _stacked(known: _Known) -> tuple[Tensor, Tensor]:
    poses = [known[c] for c in sorted(known)]
    return torch.stack([pose.rotation for pose in poses]), torch.stack([pose.center for pose in poses])


def _level_starts(data: RigData) -> list[Start] | None:
    """Starts for cameras whose positions are all measured and that only features connect: level, in eight headings."""
    places = {p.camera: p.point for p in reversed(data.positions)}
    if _far_pixels(data) is None or data.boards is not None or len(places) < len(data.cameras):
        return None
    known = {0: _at_origin()}
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


def _from_landmarks(data: RigData) -> _Known:
    known: _Known = {}
    for c, camera in enumerate(data.cameras if data.landmarks else ()):
        assert data.landmarks is not None
        rays, valid = camera.unproject(data.landmarks.pixels[:, c])
        found = consensus_pose(rays[valid], data.landmarks.points[valid], _position(data, c))
        if found is not None:
            known[c] = Poses.at(found[0], found[1])
    return known


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
        known[camera] = Poses.at(rotation, center)
        return True
    return False


def _far_pixels(data: RigData) -> Tensor | None:
    """(N, C, 2) marks of features and stars, which tell how cameras are turned; None without any."""
    far = [source.pixels for source in (data.features, data.stars) if source is not None]
    return torch.cat(far) if far else None


def _from_named_stars(data: RigData) -> _Known:
    """Poses of the cameras that see stars with names and whose positions are measured."""
    known: _Known = {}
    for c, camera in enumerate(data.cameras if data.stars else ()):
        assert data.stars is not None
        rays, valid = camera.unproject(data.stars.pixels[:, c])
        use, place = valid & data.stars.named, _position(data, c)
        if place is not None and int(use.sum()) >= 2:
            known[c] = Poses.at(consensus_rotation(rays[use], data.stars.direction[use])[0], place)
    return known


def _from_skyline(data: RigData) -> _Known:
    """Poses of the cameras whose skylines are known, where these were measured to be."""
    source = data.skyline
    return {} if source is None else {c: Poses.at(source.rotation[c], source.center[c]) for c in source.cameras}


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
    rotation, center = _stacked(known)
    starts = [Start(rotation=rotation, center=center)]
    for camera in tried:
        other = 0 if camera != 0 else 1
        length = float(torch.linalg.vector_norm(center[camera] - center[other]))
        axes = torch.cat([rotation[other], -rotation[other]])
        starts = [
            dataclasses.replace(start, center=start.center.index_copy(0, torch.tensor([camera]), place[None]))
            for start in starts
            for place in start.center[other] + length * axes
        ]
    return starts


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
                starts.append(dataclasses.replace(start, rotation=turned, center=moved))
    return starts


def _into_frame(data: RigData, start: Start) -> None:
    """Move a rig from its first camera's frame to where its cameras were measured."""
    index = [p.camera for p in data.positions]
    there = torch.stack([p.point for p in data.positions])
    here = start.center[index]
    level = -start.rotation.transpose(-1, -2)[..., 1].mean(0, keepdim=True)
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    moved = there - there.mean(0), here - here.mean(0)
    scale = max(float(torch.linalg.vector_norm(moved[1])), 1.0)
    turn = rotation_between(torch.cat([moved[1] / scale, _LEVEL * level]), torch.cat([moved[0] / scale, _LEVEL * up]))
    start.center = (start.center - here.mean(0)) @ turn.T + there.mean(0)
    start.rotation = start.rotation @ turn.T


class _BoardViews:
    """Board poses from each camera alone, and the relative poses of cameras that saw the same boards."""

    def __init__(self, data: RigData, solver: LMOptions) -> None:
        self.data = data
        self.flipped: list[TurnedBoard] = []
        self.foreign: dict[int, str] = {}
        self._alone: list[Poses] = []
        self._compared: set[tuple[int, int]] = set()
        alone = list[SeenAlone]()
        self._good = torch.zeros(0, len(data.cameras), dtype=torch.bool)
        boards = data.boards
        if boards is None:
            return
        points, good = boards.points, []
        for c, camera in enumerate(data.cameras):
            _, valid = camera.normalize(boards.pixels[:, c])
            with_ray = torch.where(valid[..., None], boards.pixels[:, c], math.nan)
            enough = (valid.sum(-1) >= MINIMUM_CORNERS) & spread_out(points, with_ray)
            rotation = torch.full((len(enough), 3, 3), math.nan, dtype=torch.float64)
            translation = torch.full((len(enough), 3), math.nan, dtype=torch.float64)
            rms = torch.full((len(enough),), math.nan, dtype=torch.float64)
            if bool(enough.any()):
                found, rms[enough] = pose_alone(points, boards.pixels[enough, c], camera, solver)
                rotation[enough], translation[enough] = found.rotation, found.translation
            alone.append(SeenAlone(Poses(rotation, translation), rms))
            good.append(enough)
        self._good = torch.stack(good, -1)
        check_cameras(data, self._good, alone, solver)
        self._alone = [one.poses for one in alone]

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

    def _relative(self, first: int, second: int) -> Poses:
        boards = self.data.boards
        assert boards is not None
        self._compared.add((first, second))
        both = (self._good[:, first] & self._good[:, second]).nonzero()[:, 0]
        cameras = self.data.cameras[first], self.data.cameras[second]
        one, two = (Poses(self._alone[c].rotation[both], self._alone[c].translation[both]) for c in (first, second))
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
        new = Poses(alone.rotation[views], alone.translation[views]).after(half_turn(boards.points))
        alone.rotation[views], alone.translation[views] = new.rotation, new.translation
        self.flipped += [TurnedBoard(boards.names[i], self.data.names[camera]) for i in views.tolist()]

    def world(self, start: Start) -> tuple[Tensor, Tensor]:
        """world_from_board from the first camera that sees each board well; where none does, an arbitrary pose."""
        count = len(self._good)
        rotation = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
        translation = torch.zeros(count, 3, dtype=torch.float64)
        for c in reversed(range(len(self.data.cameras))):
            seen = self._good[:, c] if count else self._good.new_zeros(0)
            if bool(seen.any()):
                back = start.rotation[c].T
                rotation[seen] = back @ self._alone[c].rotation[seen]
                translation[seen] = self._alone[c].translation[seen] @ start.rotation[c] + start.center[c]
        return rotation, translation

    @property
    def usable(self) -> Tensor:
        """(V,) whether at least two cameras see a board well."""
        return self._good.sum(-1) >= 2
