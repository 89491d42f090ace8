"""Rigs with errors that no model of theirs contains, repeated by simulation: found, and coverage before and after.

Errors are planted that neighbors share: a smooth field of the lens, a bias of matches by place, boards that bend. Each
rig is judged without and with the widening of `kcal.calibrate.rig.contradictions`. Seeds are fixed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from unittest import mock

import torch
from torch import Tensor

from kcal import Board, Camera, Rig, RigData, solve_rig
from kcal.calibrate.rig import assess
from kcal.calibrate.rig.contradictions import widen_for_fields
from kcal.calibrate.rig.pairs import paired_boards
from kcal.calibrate.rig.problem import RigSolution
from kcal.finding import Finding
from kcal.lens import rotation_from_vector, vector_from_rotation
from scripts.check.rig import MARK, NAMES, STRAIGHT, TRUTH, generator, landmarks, normal, seen, spread, tape
from scripts.shared.long_range import matches_of
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.traced import as_observations

FIELD = 0.1
CLOSE = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
NEAR = Rig.pair(CLOSE, CLOSE, torch.eye(3), torch.tensor([-0.2, 0.0, 0.0]))


def field(draw: torch.Generator, size: tuple[int, int]) -> Callable[[Tensor], Tensor]:
    """A smooth displacement (N, 2) of pixels (N, 2) with an RMS of `FIELD` px along each axis."""
    waves = (torch.rand(6, 2, generator=draw, dtype=torch.float64) - 0.5) * 4.0 * math.pi
    phase = 2.0 * math.pi * torch.rand(6, 2, generator=draw, dtype=torch.float64)
    extent = torch.tensor(size, dtype=torch.float64)
    return lambda pixels: FIELD * math.sqrt(2.0 / 6.0) * ((pixels / extent @ waves.T)[..., None] + phase).sin().sum(-2)


def radial(draw: torch.Generator, size: tuple[int, int]) -> Callable[[Tensor], Tensor]:
    """The same, as r³ changes it, in or out."""
    middle = torch.tensor(size, dtype=torch.float64) / 2.0
    sign = 1.0 - 2.0 * float(torch.rand((), generator=draw) < 0.5)
    sides = [torch.linspace(-float(side), float(side), 25, dtype=torch.float64) for side in middle]
    cubic = torch.cartesian_prod(*sides)
    scale = sign * FIELD / float((cubic * cubic.square().sum(-1, keepdim=True)).square().mean().sqrt())
    return lambda pixels: scale * (pixels - middle) * (pixels - middle).square().sum(-1, keepdim=True)


def surveyed(kind: str, seed: int) -> RigData:
    """Landmarks, 200 matches of unknown range and a tape."""
    draw = generator(seed)
    marked = landmarks(draw, 30 if "30" in kind else 12)
    points = spread(200, 300.0, 8000.0, draw)
    pixels = seen(points) + MARK * normal((200, 2, 2), draw)
    lenses = [(radial if "radial" in kind else field)(draw, TRUTH.left.size) for _ in NAMES]
    if "lens" in kind:
        pixels, marks = (torch.stack([x[:, c] + lens(x[:, c]) for c, lens in enumerate(lenses)], 1)
                         for x in (pixels, marked.pixels))  # fmt: skip
        marked = dataclasses.replace(marked, pixels=marks)
    if "bias" in kind:
        side = pixels[:, :1, 0] < TRUTH.left.size[0] / 2
        pixels[:, 1] += FIELD * side if "half" in kind else lenses[1](pixels[:, 1])
    matches = matches_of(pixels, pixel_sigma=MARK)
    return RigData(cameras=(TRUTH.left, TRUTH.right), names=NAMES, landmarks=marked,
                   features=None if "30" in kind else matches, baselines=(tape(draw),))  # fmt: skip


def boards(kind: str, seed: int) -> RigData:
    """Fifteen boards that two cameras 0.2 m apart saw."""
    draw, board = generator(seed), Board(columns=9, rows=6, square=0.03)
    middle = board.points.mean(0)
    across = (board.points - middle)[:, :2] / (board.points - middle)[:, :2].abs().max()
    shapes = torch.stack([across[:, 0] ** 2, across[:, 1] ** 2, across.prod(-1)], -1)
    lenses = [field(draw, NEAR.left.size) for _ in NAMES]
    sides: tuple[list[Tensor], list[Tensor]] = ([], [])
    for _ in range(15):
        points = board.points - middle
        points[:, 2] += (0.002 if "flex" in kind else 0.0) * shapes @ normal((3,), draw)
        turn = rotation_from_vector(0.35 * normal((3,), draw))
        place = torch.tensor([0.0, -0.1, 1.0]) + 0.2 * torch.rand(3, generator=draw, dtype=torch.float64)
        pixels = NEAR(points @ turn.T + place)[0]
        for c, views in enumerate(sides):
            own = pixels[:, c] + (lenses[c](pixels[:, c]) if "lens" in kind else 0.0) + MARK * normal((54, 2), draw)
            views.append(own)
    left, right = (as_observations(torch.stack(views), NEAR.left.size, board) for views in sides)
    pairs = paired_boards((NEAR.left, NEAR.right), (left, right), list(zip(left.names, right.names, strict=True)))
    return RigData(cameras=(NEAR.left, NEAR.right), names=NAMES, boards=pairs)


@torch.no_grad()
def judged(kind: str, draws: int) -> list[str]:
    """One row."""
    make, truth = (boards, NEAR) if "boards" in kind else (surveyed, TRUTH)
    before, errors, told, wider = list[Tensor](), list[Tensor](), 0, 0.0

    def kept(solution: RigSolution, names: Sequence[str]) -> list[Finding]:
        before.append(solution.root)
        return widen_for_fields(solution, names)

    for seed in range(draws):
        given = make(kind, 90_000 + seed)
        with mock.patch.object(assess, "widen_for_fields", kept):
            found = solve_rig(given, dataclasses.replace(STRAIGHT, reject=False))
        told += any("disagrees with the rest" in text for text in found.warnings)
        relative = found.rotation[1] @ found.rotation[0].T @ truth.right_from_left_rotation.T
        rows = found._solution.relative_rows(0, 1)[:3]
        ways = torch.stack([(rows @ root).norm(dim=1) for root in (before[-1], found._solution.root)])
        errors.append(vector_from_rotation(relative).abs() / ways)
        wider += float((ways[1, 1] / ways[0, 1]) ** 2) / draws
    each = torch.stack(errors)
    inside, rms = (each < 1.96).double().mean(0), each.square().mean(0).sqrt()
    cells = [kind, str(draws), f"{100 * told / draws:.0f} %", f"{math.sqrt(wider):.2f}"]
    cells += [f"{100 * float(inside[way, axis]):.0f} %" for axis in (1, 0, 2) for way in (0, 1)]
    return [*cells, *(f"{float(one):.2f}" for one in rms[:, 1])]


KINDS = (
    "12 landmarks and 200 matches", "30 landmarks", "15 boards", "12 landmarks and 200 matches, lens",
    "12 landmarks and 200 matches, radial lens", "12 landmarks and 200 matches, bias of matches",
    "12 landmarks and 200 matches, bias of half the matches", "30 landmarks, lens",
    "15 boards, lens", "15 boards, flex",
)  # fmt: skip


@section("rig.md", "contradictions", draws=1, kinds=KINDS[1:2])
def contradictions(draws: int = 50, kinds: tuple[str, ...] = KINDS) -> Iterator[str]:
    """The table: found, and coverage without and with what is widened."""
    heads = [
        "rig, and what is planted", "rigs", "told", "σ of yaw, times", "yaw inside 95 %", "widened",
        "pitch inside 95 %", "widened", "roll inside 95 %", "widened", "error of yaw / σ", "widened",
    ]  # fmt: skip
    yield from table(heads, (judged(kind, draws) for kind in kinds))
