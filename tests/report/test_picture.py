import math
from pathlib import Path

import numpy as np
import pytest
import torch
from drawn_scenes import PLACE, PLACES
from locate_rigs import located_pairs, pinhole_rig, tensor
from matplotlib.figure import Figure
from matplotlib.text import Text

from kcal import InputError
from kcal.locate import enu_from_cam
from kcal.locate.budget import RangeError
from kcal.locate.positions import Located
from kcal.report.figures import new_figure, save_picture
from kcal.report.positions import budget_figure, positions_figure

HEADING = 300.0


def along_a_line(count: int, names: list[str] | None = None) -> Located:
    """Points from 80 m to 6 km."""
    points = torch.linspace(80, 6000, count, dtype=torch.float64)[:, None] * tensor([0.1, 0.0, 1.0])
    left, right = pinhole_rig()(points)[0].unbind(-2)
    return located_pairs(pinhole_rig(), left, right, origin=PLACE, heading_deg=0.0, names=names)


def scene() -> tuple[Located, torch.Tensor]:
    rig = pinhole_rig()
    left, right = rig(PLACES)[0].unbind(-2)
    # One pair more, outside the image, of which the truth is not known.
    left, right = torch.cat([left, tensor([5000.0, 1.0])]), torch.cat([right, tensor([1.0, 1.0])])
    right = right + tensor([0.3, 0.0])
    names = ["gate", "mast", "ship", "cloud", "lost"]
    located = located_pairs(rig, left, right, origin=PLACE, heading_deg=HEADING, names=names)
    return located, torch.cat([PLACES @ enu_from_cam(HEADING).T, torch.full((1, 3), math.nan)])


def texts(figure: Figure) -> list[str]:
    found = [text.get_text() for axes in figure.axes for text in axes.texts]
    found += [label.get_text() for label in figure.axes[1].get_yticklabels()]
    return found + [text.get_text() for text in figure.texts]


def test_names_arcs_and_the_limits_of_the_interval_are_written() -> None:
    found = texts(positions_figure(*scene()))
    for name in ("gate", "mast", "ship", "cloud", "N", "250 m", "1 km", "5 km"):
        assert name in found
    assert "cloud  bearing only" in found
    assert any("calibration" in text and "not included" in text for text in found)
    assert any(text.endswith("lost: a mark lies outside its image") for text in found)
    assert any(text.startswith("3 of 5 points located") for text in found)


def test_arrows_lead_from_truth_to_estimate_only_where_they_differ() -> None:
    located, enu = scene()

    def arrows(figure: Figure) -> list[tuple[tuple[float, float], tuple[float, float]]]:
        return [
            (text.xyann, text.xy)
            for text in figure.axes[0].texts
            if getattr(text, "arrowprops", None) and text.arrowprops["arrowstyle"] == "->"
        ]

    assert arrows(positions_figure(located)) == []
    (arrow,) = arrows(positions_figure(located, enu))
    tail, head = (math.hypot(*end) for end in arrow)
    # 0.3 px less disparity puts the ship farther out than it is; nearer points move less than a marker.
    assert head > tail


@pytest.mark.parametrize(("count", "named"), [(40, True), (41, False)])
def test_no_more_than_forty_points_have_names(count: int, named: bool) -> None:
    names = [f"p{i}" for i in range(count)]
    figure = positions_figure(along_a_line(count, names))
    assert ("p7" in [text.get_text() for text in figure.axes[0].texts]) is named
    rows = [text.get_text().split()[0] for text in figure.axes[1].get_yticklabels()]
    assert rows == (names if named else [])


@pytest.mark.parametrize("count", [1, 60])
def test_one_point_and_many_points(tmp_path: Path, count: int) -> None:
    path = save_picture(tmp_path / "map.png", positions_figure(along_a_line(count)))
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_to_draw_is_drawn_all_the_same(tmp_path: Path) -> None:
    rig, marks = pinhole_rig(), tensor([5000.0, 1.0])
    located = located_pairs(rig, marks, marks, origin=PLACE, heading_deg=0.0)
    assert save_picture(tmp_path / "map.png", positions_figure(located)).stat().st_size > 10_000


def test_bad_arguments(tmp_path: Path) -> None:
    located, enu = scene()
    with pytest.raises(InputError, match=r"truth: shape \(5, 3\)"):
        positions_figure(located, enu[:2])
    with pytest.raises(InputError, match=r"must end with \.png"):
        save_picture(tmp_path / "map.jpg", positions_figure(located))


# Taken for mathematics the first two stop the drawing, and the third loses its signs.
HOSTILE = (
    r"$\frac{",
    "$a$ $^$",
    "5$ and 6$",
    "a\x1b[31m\u202e",
    "\U0001f600 山",
    "_" + "w" * 100_000,
    "two\nlines",
    "\\$",
)


def test_names_are_drawn_as_they_are(tmp_path: Path) -> None:
    located = along_a_line(len(HOSTILE), list(HOSTILE))
    save_picture(tmp_path / "map.png", positions_figure(located))
    figure = positions_figure(located)
    figure.canvas.draw()
    assert not any(text.get_parse_math() for text in figure.findobj(Text))
    before = [axes.xaxis.get_major_formatter() for axes in figure.axes]
    figure.canvas.draw()  # a window draws it thousands of times
    assert [axes.xaxis.get_major_formatter() for axes in figure.axes] == before
    found = texts(figure)
    assert HOSTILE[2] in found
    assert max(map(len, found)) <= 2000
    assert not any("\x1b" in text for text in found)
    assert r"a\x1b[31m\u202e" in found


def test_names_are_the_same_pixels_as_without_mathematics() -> None:
    def drawn(name: str, parse_math: bool) -> np.ndarray:
        figure = new_figure(3.0, 1.0)
        axes = figure.add_subplot()
        axes.set_yticks([0.5], [name], parse_math=parse_math)
        axes.set_title(name, parse_math=parse_math)
        figure.canvas.draw()
        return np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]

    assert np.array_equal(drawn("5$ and 6$", True), drawn("5$ and 6$", False))
    # Ticks of a logarithmic axis have no mathematics left to show.
    budget = budget_figure(
        tensor(100.0, 5000.0), {"yaw": RangeError(*tensor([1.0, 200.0], [1.0, 90.0], [1.0, 120.0]))}, {"yaw": "$^$"}
    )
    budget.canvas.draw()
    assert not any("mathdefault" in text.get_text() for text in budget.findobj(Text))
    assert {"100", "1000"} <= {text.get_text() for text in budget.axes[0].get_xticklabels()}
