"""Pictures are drawn into panels and figures of the caller, with the same content as alone."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import drawn_scenes
import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from kcal.report.calibration import board_figure, calibration_figure, coverage_figure
from kcal.report.positions import positions_figure, stations_figure
from kcal.report.rig import rig_figure, stars_figure

ONE: dict[str, Callable[..., Figure]] = {
    "board": lambda ax: board_figure(drawn_scenes.bent(), ax=ax),
    "coverage": lambda ax: coverage_figure(drawn_scenes.calibrated().observations, ax=ax),
    "stations": lambda ax: stations_figure(drawn_scenes.stations(), ax=ax),
    "stars": lambda ax: stars_figure(**drawn_scenes.night(), ax=ax),
}
MANY: dict[str, Callable[..., Figure]] = {
    "calibration": lambda figure: calibration_figure(drawn_scenes.calibrated(), figure=figure),
    "positions": lambda figure: positions_figure(*drawn_scenes.located(), figure=figure),
    "rig": lambda figure: rig_figure(drawn_scenes.landmarks_rig(), figure=figure),
}


def content(axes: Any) -> list[Any]:
    """What is drawn in axes, without their titles."""
    return [len(axes.lines), len(axes.collections), len(axes.patches), len(axes.images), axes.get_xlabel(),
            axes.get_xlim(), axes.get_ylim(), sorted(text.get_text() for text in axes.texts)]  # fmt: skip


@pytest.mark.parametrize("name", ONE)
def test_one_panel_goes_into_axes(name: str) -> None:
    alone = ONE[name](None)
    figure, (other, ax) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    other.set_title("$x^2$ of the caller")
    assert ONE[name](ax) is figure
    assert content(ax) == content(alone.axes[0])
    assert ax.get_title(loc="left")
    assert not other.lines + other.collections
    figure.canvas.draw()
    assert other.title.get_parse_math()
    plt.close(figure)


@pytest.mark.parametrize("name", MANY)
def test_several_panels_go_into_a_figure_or_a_part_of_one(name: str) -> None:
    alone = MANY[name](None)
    figure = plt.figure(figsize=(18, 8), layout="constrained")
    assert MANY[name](figure.subfigures(1, 2)[0]) is figure
    assert [content(axes) for axes in figure.axes] == [content(axes) for axes in alone.axes]
    figure.canvas.draw()
    plt.close(figure)


def test_names_are_no_mathematics_in_figures_of_the_caller() -> None:
    seen = drawn_scenes.stations()
    bad = dataclasses.replace(seen, columns=seen.columns._replace(names=["$\\frac$"] * len(seen.columns.names)))
    with mpl.rc_context({"text.parse_math": True}):
        figure, ax = plt.subplots()
        stations_figure(bad, ax=ax)
        figure.canvas.draw()  # invalid mathematics would stop it
        assert any("frac" in text.get_text() for text in ax.findobj(Text))
        plt.close(figure)


def test_a_figure_is_a_picture_in_a_notebook() -> None:
    assert board_figure(drawn_scenes.bent())._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]


def test_a_bearing_goes_from_its_tower_towards_what_it_saw() -> None:
    """The light, 800 m west and 2.5 km north of the mill, as far as it is drawn."""
    figure = stations_figure(drawn_scenes.stations())
    (bearing,) = (line for line in figure.axes[0].lines if line.get_linestyle() == "--")
    east, north = bearing.get_xydata().T  # type: ignore[union-attr]
    assert (east[0], north[0]) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert math.degrees(math.atan2(east[1], north[1])) == pytest.approx(math.degrees(math.atan2(-0.8, 2.5)), abs=0.01)
    plt.close(figure)
