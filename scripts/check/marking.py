"""Marks on rendered targets of known position: clicks that snap, matches in the other image, false proposals.

Every target is painted into both images of a rig, with noise of 1.5 gray levels and a blur of 0.5 to 1.1 px; before a
plain background, and before far hills whose gray levels vary by 2.8. Clicks are up to 3 px away from it in the left
image.
"""

from __future__ import annotations

import collections
import functools
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from kcal import InputError, Rig
from kcal.mark.guide import at_shape, propose
from kcal.mark.shapes import snap
from scripts.shared.marking_scene import KINDS, Floats, background, finished, inside_of, paint, seen, site_rig
from scripts.shared.page import Lines, section, table
from scripts.shared.page import rms as rms_of

CONTRASTS = (20.0, 40.0, 80.0)
BACKGROUNDS = {"plain": 0.0, "hills": 0.8}
NOISE = 1.5
FALSE = 1.0  # px from the truth: a proposal beyond is another thing
_ELLIPSE = 5.991  # χ² of two degrees of freedom that 95 % are below


class Mark(NamedTuple):
    """One mark: its error in px, its squared error in sigmas, and its stated sigma along an axis."""

    error: Floats
    chi2: float
    sigma: float


class Trial(NamedTuple):
    """One target: what became of the click, of the match alone and of the proposal; None where refused."""

    background: str
    kind: str
    contrast: float
    snapped: Mark | None
    how: str
    match: Mark | None
    proposal: Mark | None


def mark_of(u: float, v: float, cov: tuple[float, float, float], truth: Floats) -> Mark:
    error = np.array([u, v]) - truth
    matrix = np.array([[cov[0], cov[1]], [cov[1], cov[2]]])
    return Mark(error, float(error @ np.linalg.solve(matrix, error)), math.sqrt((cov[0] + cov[2]) / 2))


def scene(rig: Rig, hills: list[Floats], random: np.random.Generator) -> tuple[torch.Tensor, list[Floats]]:
    """A point somewhere in both images, and copies of both backgrounds."""
    width, height = rig.left.size
    while True:
        distance = 10 ** random.uniform(1.9, 3.4)
        pixel = torch.tensor([[random.uniform(60, width - 60), random.uniform(60, height - 60)]], dtype=torch.float64)
        ray, _ = rig.left.unproject(pixel)
        point = distance * ray[0]
        right, valid = rig.right.project(rig.right_from_left(point[None]))
        at = right[0].numpy()
        if bool(valid) and 50 < at[0] < width - 50 and 50 < at[1] < height - 50:
            return point, [image.copy() for image in hills]


def trial(rig: Rig, behind: str, hills: list[Floats], kind: str, contrast: float, random: np.random.Generator) -> Trial:
    point, images = scene(rig, hills, random)
    inside, sign, blur = inside_of(kind, random), random.choice([-1.0, 1.0]), random.uniform(0.5, 1.1)
    truth = []
    for side in (0, 1):
        at, matrix = seen(rig, point, side)
        paint(images[side], at, matrix, inside, sign * contrast, blur)
        truth.append(at)
    left, right = (finished(image, NOISE, random) for image in images)
    angle, far = random.uniform(0, 2 * math.pi), random.uniform(0, 3)
    click = truth[0] + far * np.array([math.cos(angle), math.sin(angle)])
    try:
        found = snap(left, *click)
    except InputError:
        return Trial(behind, kind, contrast, None, "refused", None, None)
    snapped = mark_of(found.u, found.v, found.cov, truth[0])
    # The match is judged from the true place, so that its error is its own.
    alone = propose(rig, (left, right), "left", *truth[0])
    match = None if alone.refusal else mark_of(alone.u, alone.v, alone.cov, truth[1])
    there = at_shape(propose(rig, (left, right), "left", found.u, found.v), right, found.how)
    if kind == "car":
        # It has no point of its own: what counts is that both marks are the same place on it.
        truth[1] = truth[1] + np.linalg.solve(matrix, np.array([found.u, found.v]) - truth[0])
    proposal = None if there.refusal else mark_of(there.u, there.v, there.cov, truth[1])
    return Trial(behind, kind, contrast, snapped, found.how, match, proposal)


def trap(rig: Rig, hills: list[Floats], kind: str, random: np.random.Generator) -> bool | None:
    """Whether a proposal is false where a right one is hard or impossible; None if there is no proposal.

    `hidden`: something else stands before the target in the right image. `absent`: the right image shows the hills
    alone. `row`: six equal posts along the epipolar line. `flat`: the sky alone.
    """
    point, images = scene(rig, hills, random)
    inside, blur, contrast = inside_of("quadrants", random), random.uniform(0.5, 1.1), random.uniform(30, 80)
    at, matrix = seen(rig, point, 0)
    there, other = seen(rig, point, 1)
    start = at
    if kind == "flat":
        images = [np.full_like(image, 120.0) for image in images]
    elif kind == "row":
        inside = inside_of("pole", random)
        for step in range(-3, 3):
            for side, (spot, turn) in enumerate(((at, matrix), (there, other))):
                shifted = spot + np.linalg.solve(turn, np.array([14.0 * step, 0.0]))
                if 40 < shifted[0] < images[side].shape[1] - 40:
                    paint(images[side], shifted, turn, inside, contrast, blur)
    else:
        paint(images[0], at, matrix, inside, contrast, blur)
        if kind == "hidden":
            paint(images[1], there, other, inside_of("car", random), contrast, blur)
    left, right = (finished(image, NOISE, random) for image in images)
    found = propose(rig, (left, right), "left", *start)
    if found.refusal:
        return None
    return kind in ("hidden", "absent", "flat") or math.hypot(found.u - there[0], found.v - there[1]) > FALSE


def rms(marks: list[Mark]) -> float:
    return rms_of([mark.error for mark in marks]) if marks else math.nan


def covered(marks: list[Mark]) -> str:
    return f"{sum(mark.chi2 < _ELLIPSE for mark in marks)} of {len(marks)}" if marks else "none"


def px(value: float) -> str:
    return f"{value:.3f}"


def near(marks: list[Mark | None]) -> list[Mark]:
    return [mark for mark in marks if mark is not None and float(np.hypot(*mark.error)) <= FALSE]


def snap_rows(trials: list[Trial]) -> Lines:
    for kind in KINDS[:-1]:
        for contrast in dict.fromkeys(t.contrast for t in trials):
            some = [t for t in trials if (t.kind, t.contrast) == (kind, contrast)]
            good = near([t.snapped for t in some])
            far = sum(t.snapped is not None for t in some) - len(good)
            shapes = ", ".join(f"{n} {how}" for how, n in collections.Counter(t.how for t in some).most_common())
            stated = math.sqrt(np.mean([mark.sigma**2 for mark in good])) if good else math.nan
            yield [kind, f"{contrast:g}", px(rms(good)), px(stated), covered(good), f"{far}", shapes]


def match_rows(trials: list[Trial]) -> Lines:
    for kind in KINDS:
        for contrast in dict.fromkeys(t.contrast for t in trials):
            some = [t for t in trials if (t.kind, t.contrast) == (kind, contrast) and t.snapped is not None]
            cells = [kind, f"{contrast:g}"]
            for marks in ([t.match for t in some], [t.proposal for t in some]):
                good = near(marks)
                given = sum(mark is not None for mark in marks)
                cells += [px(rms(good)), covered(good), f"{given - len(good)}", f"{len(marks) - given}"]
            yield cells


@functools.cache
def drawn(each: int, traps: int, contrasts: tuple[float, ...]) -> tuple[list[Trial], dict[str, list[bool | None]]]:
    """Targets of each kind, contrast and background, and traps of each kind."""
    rig, random = site_rig(800, 450), np.random.default_rng(0)
    behind = {
        name: [background(rig, side, np.random.default_rng(0), amplitude) for side in (0, 1)]
        for name, amplitude in BACKGROUNDS.items()
    }
    cases = itertools.product(behind.items(), KINDS, contrasts, range(each))
    trials = [trial(rig, name, images, kind, contrast, random) for (name, images), kind, contrast, _ in cases]
    kinds = ("hidden", "absent", "row", "flat")
    return trials, {kind: [trap(rig, behind["hills"], kind, random) for _ in range(traps)] for kind in kinds}


def by_background(heads: list[str], rows: Callable[[list[Trial]], Lines], trials: list[Trial]) -> Lines:
    for name in BACKGROUNDS:
        yield from [f"Background: {name}.", ""]
        yield from table(heads, rows([one for one in trials if one.background == name]))
        yield ""


@section("marking.md", "snap", each=1, traps=1, contrasts=(40.0,))
def snaps(each: int = 30, traps: int = 100, contrasts: tuple[float, ...] = CONTRASTS) -> Lines:
    heads = ["target", "contrast", "RMS px", "stated σ px", "in 95 % ellipse", "beyond 1 px", "shape found"]
    return by_background(heads, snap_rows, drawn(each, traps, contrasts)[0])


@section("marking.md", "match", each=1, traps=1, contrasts=(40.0,))
def matches(each: int = 30, traps: int = 100, contrasts: tuple[float, ...] = CONTRASTS) -> Lines:
    heads = ["target", "contrast", "match: RMS px", "in 95 %", "false", "refused"]
    heads += ["at its shape: RMS px", "in 95 %", "false", "refused"]
    return by_background(heads, match_rows, drawn(each, traps, contrasts)[0])


@section("marking.md", "false", each=1, traps=1, contrasts=(40.0,))
def false_proposals(each: int = 30, traps: int = 100, contrasts: tuple[float, ...] = CONTRASTS) -> Lines:
    trials, caught = drawn(each, traps, contrasts)
    rows = [
        (kind, len(found), sum(f is not None for f in found), sum(f is True for f in found))
        for kind, found in caught.items()
    ]
    yield from table(["trap", "tried", "proposals", "false"], rows)
    given = [t.proposal for t in trials if t.proposal is not None]
    wrong = len(given) - len(near(list(given))) + sum(row[3] for row in rows)
    total, asked = len(given) + sum(row[2] for row in rows), len(trials) + sum(row[1] for row in rows)
    summary = f"{wrong} of {total} proposals are false ({asked} were asked for)."
    for name in BACKGROUNDS:
        sharp = ("corner", "cross", "quadrants")
        corners = near([t.snapped for t in trials if t.kind in sharp and t.background == name])
        summary += f" Corners and crosses, {name}: RMS {rms(corners):.3f} px, {covered(corners)} in the 95 % ellipse."
    yield from ["", summary]
