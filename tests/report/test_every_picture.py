"""Every picture: nothing is cut, nothing covers another thing, nothing is lost in a corner."""

from __future__ import annotations

import functools
import itertools

import pytest
from drawn_scenes import FIGURES, boxes
from matplotlib.figure import Figure

# Points of data stand where they are: their names may meet.
_DATA = {"positions", "rig", "wide rig", "stations", "sites", "stars"}


@functools.cache
def drawn(name: str) -> Figure:
    return FIGURES[name]()


@pytest.mark.parametrize("name", FIGURES)
def test_no_text_is_cut(name: str) -> None:
    figure = drawn(name)
    wide, tall = figure.canvas.get_width_height()
    cut = [text for text, box in boxes(figure)[0]
           if box.x0 < -2 or box.y0 < -2 or box.x1 > wide + 2 or box.y1 > tall + 2]  # fmt: skip
    assert cut == []


@pytest.mark.parametrize("name", FIGURES)
def test_no_axes_cover_each_other(name: str) -> None:
    figure = drawn(name)
    wide, tall = figure.canvas.get_width_height()
    _, axes = boxes(figure)
    for box in axes:
        assert -1 <= box.x0 < box.x1 <= wide + 1
        assert -1 <= box.y0 < box.y1 <= tall + 1
    for one, other in itertools.combinations(axes, 2):
        across = min(one.x1, other.x1) - max(one.x0, other.x0)
        down = min(one.y1, other.y1) - max(one.y0, other.y0)
        assert min(across, down) < 1
    # Most of the page is used.
    assert sum(box.width * box.height for box in axes) > 0.3 * wide * tall


@pytest.mark.parametrize("name", FIGURES)
def test_no_text_covers_another(name: str) -> None:
    texts, _ = boxes(drawn(name))
    covered = []
    for (first, one), (second, other) in itertools.combinations(texts, 2):
        across = min(one.x1, other.x1) - max(one.x0, other.x0)
        down = min(one.y1, other.y1) - max(one.y0, other.y0)
        small = min(one.height, other.height)
        if across > 2 and down > 0.35 * small and first != second:
            covered.append((first[:40], second[:40]))
    assert len(covered) <= (3 if name in _DATA else 0), covered
