"""What pictures show is where it is: numbers of their lines and marks against the things that were drawn."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest
import torch
from drawn_scenes import (
    FIGURES,
    PLACE,
    calibrated,
    checked,
    landmarks_rig,
    located,
    night,
    sites,
    stations,
    watched,
)
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver, QuiverKey

from kcal.calibrate.camera.advice import board_tilts
from kcal.lens.camera import Camera
from kcal.lens.difference import camera_difference
from kcal.lens.rig import Origin
from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.siting import Site, siting_map
from kcal.report import positions as siting_module
from kcal.report.calibration import difference_figure
from kcal.report.figures import WARN, draw_arrows
from kcal.report.positions import (
    _siting_marks,
    _siting_notes,
    budget_figure,
    positions_figure,
    siting_figure,
    stations_figure,
)
from kcal.report.rig import _above_sky, _edges, _places, attitude_figure, rig_figure, stars_figure
from kcal.report.verdict import RangeAnswer, Requirement
from kcal.report.verdict_pictures import camera_pictures, range_picture


def lines(axes: Axes, marker: str) -> np.ndarray[Any, Any]:
    """(N, 2) places of marks."""
    found = [line for line in axes.lines if line.get_marker() == marker and len(line.get_xdata())]
    return np.concatenate([np.stack([line.get_xdata(), line.get_ydata()], -1) for line in found])


def arrows(axes: Axes) -> Quiver:
    (found,) = [part for part in axes.collections if isinstance(part, Quiver)]
    return found


class TestStars:
    def test_the_sky_is_taken_away(self) -> None:
        above = _above_sky(night()["image"])
        inner = above[40:-40, 40:-40]
        # In units of the noise; what changes slowly is gone.
        assert np.median(np.abs(above)) * 1.4826 == pytest.approx(1.0)
        assert abs(np.median(inner[:, :80])) < 0.2
        assert abs(np.median(inner[:, -80:])) < 0.2
        assert abs(np.median(inner[-60:])) < 0.2
        assert above[160, 240] > 40
        # A plane sky is a plane between the middles of its blocks, to the last digit.
        rows, columns = np.mgrid[0:320, 0:480].astype(float)
        plain = _above_sky(100.0 + 3.0 * columns - 2.0 * rows + np.where((rows + columns) % 2, 1e-3, -1e-3))
        assert np.abs(plain[40:-40, 40:-40] * 1e-3).max() < 0.01

    def test_marks_names_and_residuals(self) -> None:
        scene = night()
        figure = stars_figure(**scene)
        axes = figure.axes[0]
        known = [0, 1, 3, 5]
        np.testing.assert_array_equal(lines(axes, "o"), scene["pixels"][known])
        np.testing.assert_array_equal(lines(axes, "x"), scene["pixels"][[2, 4]])
        assert [text.get_text() for text in axes.get_legend().get_texts()] == ["2 without a name", "4 named"]
        drawn = arrows(axes)
        # The longest, of 0.5 px, is drawn as 0.04 of 480 px.
        np.testing.assert_allclose(np.stack([drawn.U, drawn.V], -1), 38.4 * scene["residual"][known])
        np.testing.assert_array_equal(drawn.XY, scene["pixels"][known])
        assert figure.texts[0].get_text() == "night"
        # Deneb stands near the right edge.
        sides = {text.get_text(): text.get_ha() for text in axes.texts}
        assert sides == {"Vega": "left", "Deneb": "right", "Altair": "left", "Sadr": "left"}
        offsets = {text.get_text(): text.xyann for text in axes.texts}
        assert offsets["Vega"] == (7, -3)
        assert offsets["Deneb"] == (-7, -3)
        # Turned over: stars are dark.
        shown = axes.images[0].get_array()
        assert shown[160, 240] < -40
        shape = axes.get_window_extent()
        assert shape.width / shape.height == pytest.approx(480 / 320, rel=0.05)

    def test_no_more_than_thirty_names(self) -> None:
        scene = night() | {"pixels": np.random.default_rng(0).uniform(20, 300, (40, 2)), "names": ["x"] * 40,
                           "residual": np.zeros((40, 2))}  # fmt: skip
        assert len(stars_figure(**scene).axes[0].texts) == 30
        none = night() | {"names": [""] * 6}
        assert stars_figure(**none).axes[0].get_title(loc="left") == ""


class TestAttitude:
    @pytest.mark.parametrize(("seconds", "last", "word"), [
        (86400.0 * 4, 4.0, "days"), (86400.0 * 3, 3.0, "days"), (86400.0 * 2, 48.0, "hours"),
        (7200.0, 2.0, "hours"), (7100.0, 7100 / 60, "minutes"), (300.0, 5.0, "minutes"),
    ])  # fmt: skip
    def test_time_in_a_unit_that_fits(self, seconds: float, last: float, word: str) -> None:
        axes = attitude_figure(**watched(seconds)).axes
        assert axes[2].get_xlabel() == word
        assert axes[0].lines[0].get_xdata()[[0, -1]] == pytest.approx([0.0, last])

    def test_bands_limits_and_gaps(self) -> None:
        scene = watched(9000.0)
        figure = attitude_figure(**scene)
        assert [axes.get_ylabel() for axes in figure.axes] == ["pitch, degrees", "yaw, degrees", "roll, degrees"]
        for k, axes in enumerate(figure.axes):
            middle = scene["angle"][:, k]
            np.testing.assert_array_equal(axes.lines[0].get_ydata(), middle)
            corners = axes.collections[0].get_paths()[0].vertices[:, 1]
            assert corners.max() == pytest.approx(middle.max() + 1.96 * 0.002)
            assert corners.min() == pytest.approx(middle.min() - 1.96 * 0.002)
            assert [line.get_ydata()[0] for line in axes.lines[1:3]] == [-0.05, 0.05]
            gaps = lines(axes, "|")
            assert len(gaps) == 10
            np.testing.assert_allclose(gaps[:, 0], (scene["time"][40:50] - 1e9) / 3600.0)
            # At the lower rim, which stays where it was.
            assert set(gaps[:, 1]) == {axes.get_ylim()[0]}
            assert axes.get_ylim()[0] < -0.05
        assert figure.texts[0].get_text() == "mast"
        # From above to below, none on another, as high as each other.
        figure.canvas.draw()
        bottoms = [axes.get_position().y0 for axes in figure.axes]
        assert np.diff(bottoms) == pytest.approx([-0.3, -0.3], abs=0.02)
        labels = [text.get_text() for text in figure.legends[0].get_texts()]
        assert labels == ["95 %", "limit", "not seen"]
        none = attitude_figure(**(watched(9000.0) | {"seen": np.ones(90, bool)}))
        assert not [line for line in none.axes[0].lines if line.get_marker() == "|"]

    def test_nothing_was_seen_yet(self) -> None:
        empty = {"time": np.empty(0), "angle": np.empty((0, 3)), "sigma": np.empty((0, 3)), "seen": np.empty(0, bool)}
        assert attitude_figure(**empty, limit=0.1).axes[2].get_xlabel() == "minutes"  # type: ignore[arg-type]


class TestStations:
    def test_positions_regions_towers_and_bearings(self) -> None:
        found = stations()
        axes = stations_figure(found, torch.tensor([[1200.0, 4000.0, 10.0]] + [[math.nan] * 3] * 2)).axes[0]
        towers = np.array([camera.enu[:2] for camera in found.cameras]) / 1e3
        np.testing.assert_allclose(lines(axes, "^"), towers)
        places = np.array([position.enu[:2] for position in found.positions[:2] if position.enu]) / 1e3
        np.testing.assert_allclose(lines(axes, "."), places)
        np.testing.assert_allclose(lines(axes, "+"), [[1.2, 4.0]])
        names = [text.get_text() for text in axes.texts]
        assert names == ["mill", "mast", "roof", "fire", "smoke", "light"]
        at = {text.get_text(): text.xy for text in axes.texts}
        np.testing.assert_allclose(at["fire"], places[0])
        np.testing.assert_allclose(at["mast"], towers[1])
        # Rings of χ² of 5.99 about the positions.
        fields, rings = axes.patches[:3], axes.patches[3:]
        for ring, position in zip(rings, found.positions, strict=False):
            away = 1e3 * ring.get_xy()[:-1] - np.array(position.enu)[:2]  # type: ignore[arg-type]
            spread = np.array(position.covariance)[:2, :2]
            square = (away * np.linalg.solve(spread, away.T).T).sum(1)
            np.testing.assert_allclose(square, -2 * math.log(0.05), rtol=1e-4)
        # Fields of view begin at their towers and end at their azimuths, as far as bearings.
        reach = 0.9 * 4.9
        for field, camera, tower in zip(fields, found.cameras, towers, strict=True):
            corners = field.get_xy()
            np.testing.assert_allclose(corners[0], tower)
            rim = corners[1:-1] - tower
            np.testing.assert_allclose(np.hypot(*rim.T), reach, rtol=0.02)
            assert camera.azimuths_deg is not None
            ends = np.degrees(np.arctan2(*rim[[0, -1]].T)) % 360
            np.testing.assert_allclose(ends, np.array(camera.azimuths_deg) % 360, atol=1e-6)
        (bearing,) = [line for line in axes.lines if line.get_linestyle() == "--"]
        x, y = bearing.get_xdata(), bearing.get_ydata()
        np.testing.assert_allclose([x[0], y[0]], towers[0], atol=1e-9)
        assert math.degrees(math.atan2(x[1] - x[0], y[1] - y[0])) == pytest.approx(
            math.degrees(math.atan2(-800.0, 2500.0)), abs=0.01
        )
        assert math.hypot(x[1] - x[0], y[1] - y[0]) == pytest.approx(reach, rel=0.02)


class TestSites:
    def test_places_of_the_map_are_kilometers_from_its_middle(self) -> None:
        area, towers, ranked = sites()
        figure = siting_figure(area, towers, ranked)
        assert len(figure.axes) == 2
        today, later = figure.axes
        (bar,) = later.child_axes
        # A degree of latitude is 111.1 km, of longitude 78.6 km there.
        for site, x, y in (("mill", -0.05 * 78.58, -0.07 * 111.15), ("mast", 0.05 * 78.58, -0.07 * 111.15)):
            (text,) = [text for text in today.texts if text.get_text() == site]
            np.testing.assert_allclose(text.xy, (x, y), atol=0.03)
        east, north = siting_module._map_grid(area)
        lat = area.lat.numpy()
        np.testing.assert_allclose(north[:, 12] - north[0, 12], (lat - lat[0]) * 111.15, atol=0.02)
        at = geodetic_to_enu(torch.tensor([area.lat[3], area.lon[5], 0.0], dtype=torch.float64), area.origin)
        np.testing.assert_allclose((1e3 * east[3, 5], 1e3 * north[3, 5]), at[:2])
        assert east[0, 0] < 0 < east[0, -1]
        # Ranked candidates today with their ranks; the one that is built among the sites then.
        ranks = [text.get_text() for text in today.texts if text.get_text().isdigit()]
        assert ranks == ["1", "2"]
        best = ranked[0].site.name
        assert later.get_title(loc="left").startswith(f"With {best}\n")
        assert best in [text.get_text() for text in later.texts]
        assert len(lines(later, "^")) == 3
        assert to_hex(later.lines[-1].get_color()) == "#f8d568"
        found = siting_map(area, towers)
        assert f"{100 * found.covered:.0f} % of the area seen by two or more" in today.get_title(loc="left")
        assert bar.get_ylabel() == "standard deviation of a position on the map"

    def test_sigma_where_two_see(self) -> None:
        area, towers, _ = sites()
        found = siting_map(area, towers)
        sigma = siting_module._map_sigma(found)
        two = (found.seen_by > 1).numpy()
        assert two.any()
        assert not two.all()
        assert np.isfinite(sigma[two]).all()
        assert np.isnan(sigma[~two]).all()
        middle = siting_module._median_sigma(found)
        assert float(middle.split()[0]) == pytest.approx(float(np.median(sigma[two])), rel=0.05)
        levels = siting_module._sigma_levels([found])
        low, high = np.quantile(sigma[two], [0.02, 0.95])
        assert levels[0] <= low < levels[1]
        assert levels[-1] >= high
        assert len(levels) == 3 or levels[-2] < high
        assert all(f"{level:.0e}"[0] in "125" for level in levels)
        nowhere = found._replace(sees=torch.zeros_like(found.sees))
        assert siting_module._median_sigma(nowhere) == "nowhere known"
        assert siting_module._sigma_levels([nowhere]) == [1.0, 2.0, 5.0, 10.0]

    def test_blind_parts_and_those_of_one_site_have_colors_of_their_own(self) -> None:
        area, towers, _ = sites()
        figure = siting_figure(area, towers)
        assert len(figure.axes) == 1
        found = siting_map(area, towers)
        shown = np.ma.filled(figure.axes[0].collections[0].get_array(), np.nan)
        expected = np.where(found.seen_by.numpy() < 2, found.seen_by.numpy(), np.nan)
        np.testing.assert_array_equal(shown, expected)

    def test_light_comes_from_the_northwest(self) -> None:
        area, towers, _ = sites()
        rows, columns = area.ground.shape
        down = torch.arange(rows, dtype=torch.float64)[:, None] * -30.0 + torch.zeros(columns)
        for ground, bright in ((down, True), (-down, False), (down.new_zeros(rows, columns), None)):
            east = torch.arange(columns, dtype=torch.float64) * (30.0 if bright else -30.0) + torch.zeros(rows, 1)
            figure = Figure()
            axes = figure.add_subplot()
            heights = ground + (0.0 if bright is None else 1.0) * east
            bumpy = heights + (0.0 if bright is None else 1.0) * torch.randn(
                rows, columns, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
            )
            tilted = area._replace(ground=bumpy)
            siting_module._siting_area(axes, tilted, siting_map(area, towers), [1.0, 10.0, 100.0])
            gray = [part for part in axes.collections if part.get_cmap().name in ("gray", "grey")]
            if bright is None:
                assert gray == []
                continue
            (shade,) = gray
            values = np.ma.filled(shade.get_array(), np.nan)
            # Slopes that fall towards the north and rise towards the east face the northwest.
            assert np.isfinite(values).all()
            assert (values > 0).all() if bright else (values < 0).all()

    def test_a_wedge_where_a_site_looks(self) -> None:
        area, _, _ = sites()
        lens = Camera.build(focal=(960, 960), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        spots = {"field_deg": 90.0}, {"camera": lens}
        for more in spots:
            axes = Figure().add_subplot()
            axes.set(xlim=(-10, 10), ylim=(-10, 10))
            site = Site(name="a", origin=Origin(lat=45.07, lon=6.0, height=99.0), heading_deg=30.0, **more)  # type: ignore[arg-type]
            _siting_marks(axes, area, [site], [], [])
            (wedge,) = axes.patches
            corners = wedge.get_xy()[:-1] if np.allclose(*wedge.get_xy()[[0, -1]]) else wedge.get_xy()
            rim = corners[1:] - corners[0]
            azimuths = np.degrees(np.arctan2(*rim.T))
            # 1920 px at a focal length of 960 px are 90 degrees, too.
            np.testing.assert_allclose(azimuths[[0, -1]], [-15.0, 75.0], atol=0.05)
            np.testing.assert_allclose(np.hypot(*rim.T), 0.07 * 20)
        axes = Figure().add_subplot()
        round_about = Site(name="a", origin=Origin(lat=45.07, lon=6.0, height=99.0), heading_deg=30.0)
        _siting_marks(axes, area, [round_about], [], [])
        assert not axes.patches

    def test_the_footer_tells_of_what_is_built_in_its_order(self) -> None:
        area, towers, ranked = sites()
        today = siting_map(area, towers)
        (text,) = _siting_notes(today, ranked)
        assert re.search(r"in it: \d{4} m today, then \d\d\.\d m with (hill|tor)$", text), text
        assert _siting_notes(today, []) == []
        two = [ranked[0]._replace(order=2, after=30.0), ranked[1]._replace(order=1, after=70.0)]
        assert _siting_notes(today, two)[0].endswith(
            f"70.0 m with {ranked[1].site.name}, then 30.0 m with {ranked[0].site.name}"
        )


class TestRig:
    def test_a_plan_keeps_directions_and_the_order_of_ranges(self) -> None:
        result = landmarks_rig()
        plan, _ = rig_figure(result).axes
        middle = result.center.numpy().mean(0)[:2]
        points, names, used = _places(result)["landmarks"]
        assert "d" in names
        assert used[names.index("d")] is False
        drawn = {text.get_text(): text.xy for text in plan.texts if text.get_text() in names}
        for point, name in zip(points, names, strict=True):
            away = point - middle
            np.testing.assert_allclose(math.atan2(*drawn[name]), math.atan2(*away), atol=1e-6)
        true = np.hypot(*(points - middle).T)
        radius = np.array([math.hypot(*drawn[name]) for name in names])
        reach, unit = 1.15 * true.max(), max(true.min() / 2, 1.15 * true.max() / 1000)
        np.testing.assert_allclose(radius, np.log1p(true / unit) / math.log1p(reach / unit))
        assert len(lines(plan, "x")) == 1
        np.testing.assert_allclose(lines(plan, "x")[0], drawn["d"])
        # Rings at 1, 5, 10 ... m from a quarter of the nearest on.
        rings = [text.get_text() for text in plan.texts if re.fullmatch(r"[\d.]+ k?m", text.get_text())]
        assert rings == ["50 m", "100 m", "500 m"]
        for text in plan.texts:
            if text.get_text() in rings:
                meters = float(text.get_text().split()[0])
                assert text.xy[1] == pytest.approx(math.log1p(meters / unit) / math.log1p(reach / unit))
        # Cameras look north.
        assert "From above, north up, ranges on a logarithmic scale" in plan.get_title()

    def test_stations_around_what_they_see_are_to_scale(self) -> None:
        result = landmarks_rig(wide=True, wrong=False)
        plan, _ = rig_figure(result).axes
        assert plan.get_title().endswith("to scale")
        middle = result.center.numpy().mean(0)[:2]
        points, names, _ = _places(result)["landmarks"]
        true = np.hypot(*(points - middle).T)
        drawn = {text.get_text(): text.xy for text in plan.texts if text.get_text() in names}
        radius = np.array([math.hypot(*drawn[name]) for name in names])
        np.testing.assert_allclose(radius, true / (1.15 * max(true.max(), 30.0)))

    def test_the_ends_of_a_view(self) -> None:
        result = landmarks_rig()
        left, right = _edges(result, 0, result.cameras[0]) or (0.0, 0.0)
        half = math.atan(960 / 1600)
        assert (left, right) == (pytest.approx(-half, abs=2e-3), pytest.approx(half, abs=2e-3))

    def test_bars_are_residuals_and_what_is_left_out_has_another_color(self) -> None:
        result = landmarks_rig()
        _, bars = rig_figure(result).axes
        items = sorted(result.items, key=lambda item: (item.source, item.used, -item.sigmas))
        assert [text.get_text() for text in bars.get_yticklabels()] == [item.label for item in items]
        limit = max(3.5, max(min(item.sigmas, 8.0) for item in items)) * 1.05
        assert [bar.get_width() for bar in bars.patches] == pytest.approx([min(item.sigmas, limit) for item in items])
        assert [to_hex(bar.get_facecolor()) == WARN for bar in bars.patches] == [not item.used for item in items]
        assert bars.get_xlim() == pytest.approx((0.0, limit))
        assert sum(not item.used for item in items) == 1
        # The first one above.
        assert bars.get_ylim()[0] > bars.get_ylim()[1]
        assert bars.lines[0].get_xdata()[0] == 1.0
        far = [text.get_text() for text in bars.texts]
        assert far == [f"{item.sigmas:.0f} ▸" for item in items if item.sigmas > limit]
        head = rig_figure(result).texts
        told = "\n".join(text.get_text() for text in head)
        assert re.search(r"Rig of 2 cameras, baseline (10\.\d+|9\.9\d+) ± ", told)
        assert "landmarks: 9 used, 1 left out" in told

    def test_the_worst_of_many(self) -> None:
        result = landmarks_rig()
        good = next(item for item in result.items if item.used)
        many = [dataclasses.replace(good, name=f"p{k}", sigmas=0.01 * k) for k in range(60)]
        wrong = [dataclasses.replace(good, name="w", sigmas=0.1, used=False)]
        _, bars = rig_figure(dataclasses.replace(result, items=(*many, *wrong))).axes
        labels = [text.get_text().split()[-1] for text in bars.get_yticklabels()]
        assert labels == ["w", *(f"p{k}" for k in range(59, 15, -1))]
        assert bars.get_title() == "Residuals by item, the worst 45 of 61"


class TestPositions:
    def test_intervals_lie_along_the_line_of_sight(self) -> None:
        found, truth = located()
        plan = positions_figure(found, truth).axes[0]
        thick = [line for line in plan.lines if line.get_linewidth() == 2.6]
        dashed = [line for line in plan.lines if line.get_linewidth() == 1.4 and line.get_linestyle() == "--"]
        assert (len(thick), len(dashed)) == (3, 1)
        scale = {}
        estimates = lines(plan, "o")[-3:]
        for line, position, estimate in zip(thick, found.positions, estimates, strict=False):
            ends = np.stack([line.get_xdata(), line.get_ydata()], -1)
            assert position.azimuth_deg is not None
            for end in ends:
                assert math.degrees(math.atan2(*end)) % 360 == pytest.approx(position.azimuth_deg, abs=1e-6)
            inner, middle, outer = np.hypot(*ends[0]), np.hypot(*estimate), np.hypot(*ends[1])
            assert inner < middle < outer
            scale[position.range_m] = middle
        assert list(scale.values()) == sorted(scale.values())

    def test_arcs_carry_their_ranges(self) -> None:
        """Each label stands just beyond the end of its arc, turned as the arc is there."""
        found, truth = located(10.0)
        plan = positions_figure(found, truth).axes[0]
        arcs = [line for line in plan.lines if len(line.get_xdata()) == 200]
        texts = [text for text in plan.texts if re.fullmatch(r"[\d.]+ (k?m)", text.get_text())]
        assert len(arcs) == len(texts) >= 3
        for arc, text in zip(arcs, texts, strict=True):
            end, before = (np.array([arc.get_xdata()[k], arc.get_ydata()[k]]) for k in (-1, -2))
            place = np.array(text.get_position())
            assert np.hypot(*(place - end)) == pytest.approx(0.012)
            along = math.degrees(math.atan2(*(end - before)[::-1]))
            assert (along - text.get_rotation() + 90) % 180 - 90 == pytest.approx(0.0, abs=0.5)
            radii = np.hypot(arc.get_xdata(), arc.get_ydata())
            assert np.ptp(radii) < 1e-9
            assert text.get_ha() == ("left" if place[0] >= end[0] else "right")

    def test_relative_intervals(self) -> None:
        found, truth = located()
        figure = positions_figure(found, truth)
        ranges = figure.axes[1]
        bars = [line for line in ranges.lines if line.get_linewidth() == 5]
        limit = ranges.get_xlim()[1]
        for row, (bar, position) in enumerate(zip(bars, found.positions, strict=True)):
            base = position.range_m or position.range_low_m
            assert base is not None
            assert position.range_low_m is not None
            assert position.range_high_m is not None
            low, high = position.range_low_m / base - 1, position.range_high_m / base - 1
            assert bar.get_xdata() == pytest.approx((max(low, -limit), min(high, limit)))
            assert list(bar.get_ydata()) == [row, row]
        # The last one has no end.
        assert lines(ranges, ">")[0].tolist() == [limit, 3]
        names = [text.get_text() for text in ranges.get_yticklabels()]
        assert [name.split()[0] for name in names] == ["gate", "mast", "ship", "cloud"]
        # An interval four times as long has a bar four times as long, and its size is written beside it.
        assert ranges.get_xscale() == "linear"
        assert [text.get_text() for text in ranges.texts] == ["± 0.52 %", "± 5.3 %", "-22 % to +40 %", "beyond 20 km"]
        figure.canvas.draw()
        ticks = [text.get_text() for text in ranges.get_xticklabels()]
        assert ticks[1:-1] == ["-40 %", "-20 %", "0", "+20 %", "+40 %"]


class TestOthers:
    def test_shares_of_refits_and_their_titles(self) -> None:
        figure = FIGURES["intervals"]()
        check = checked()
        titles = [axes.get_title(loc="left") for axes in figure.axes[:2]]
        for title, at, (share, error) in zip(titles, ("10 m", "far away"), check.shares, strict=True):
            assert title == f"{at}: {100 * share:.1f} ± {100 * error:.1f} %"
        # Half of the image has 95 %, the other half far fewer.
        coverage = check.coverage[0]
        assert float(coverage[:, :12].mean()) == pytest.approx(0.95, abs=0.02)
        assert float(coverage[:, 13:].mean()) < 0.4
        assert "Share of 20 refits within the stated 95 % ellipse" in figure.texts[1].get_text()
        wide, tall = (figure.get_figwidth(), figure.get_figheight())
        for axes in figure.axes[:2]:
            box = axes.get_position()
            assert box.width * wide / (box.height * tall) == pytest.approx(640 / 480, rel=1e-6)

    def test_a_budget_leaves_the_picture_where_errors_have_no_end(self) -> None:
        from kcal.locate.budget import RangeError

        nearer = torch.tensor([-0.5, 15.0, 90.0]).double()
        errors = RangeError(
            nearer, torch.tensor([1.0, 20.0, math.inf]).double(), torch.tensor([1.0, 18.0, 120.0]).double()
        )
        axes = budget_figure(torch.tensor([100.0, 700.0, 5000.0]), {"yaw": errors}, {"yaw": "yaw"}).axes[0]
        outward, inward, first = (np.array(line.get_ydata()) for line in axes.lines[:3])
        np.testing.assert_array_equal(outward, [1.0, 20.0, math.nan])
        np.testing.assert_array_equal(inward, [0.5, 15.0, 90.0])
        np.testing.assert_array_equal(first, [1.0, 18.0, 120.0])
        assert axes.get_ylim() == pytest.approx((0.5, 10_000.0))
        assert axes.get_xlim() == pytest.approx((100.0, 5000.0))
        assert errors.farther[2] == math.inf

    def test_residuals_and_rms_of_a_calibration(self) -> None:
        result = calibrated()
        figure = FIGURES["calibration"]()
        (panel,) = [axes for axes in figure.axes if axes.get_ylabel() == "RMS, pixels"]
        assert [bar.get_height() for bar in panel.patches] == pytest.approx(result.per_view_rms.tolist())
        assert panel.lines[0].get_ydata()[0] == pytest.approx(float(np.median(result.per_view_rms)))
        (around,) = [axes for axes in figure.axes if axes.get_title(loc="left").startswith("Residuals")]
        error = -result.residuals.reshape(-1, 2).numpy()
        error = error[np.isfinite(error).all(1)]
        np.testing.assert_allclose(around.collections[0].get_offsets(), error)
        sigma = math.sqrt((error**2).mean())
        assert np.hypot(*around.lines[0].get_data()) == pytest.approx(2.448 * sigma)
        share = 100 * (np.hypot(*error.T) > 2.448 * sigma).mean()
        assert [text.get_text() for text in around.texts] == [f"{share:.1f} % outside the 95 % circle"]
        assert around.get_xlim() == pytest.approx((-5 * sigma, 5 * sigma))
        assert around.get_ylim() == pytest.approx((5 * sigma, -5 * sigma))


def test_origin_of_the_scenes() -> None:
    east, north, _ = geodetic_to_enu(PLACE.geodetic, PLACE).tolist()
    assert (east, north) == pytest.approx((0.0, 0.0), abs=1e-6)


class TestVerdictPictures:
    @pytest.fixture(autouse=True)
    def _figures(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Figures in place of their PNG."""
        monkeypatch.setattr("kcal.report.verdict_pictures.picture_bytes", lambda figure: figure)

    def test_bars_are_shares_of_the_variance(self) -> None:
        needs = (Requirement(distance=1000.0, meters=50.0), Requirement(distance=5000.0, meters=500.0))
        parts = ({"marks": 30.0, "lenses": 40.0}, {"marks": 0.0, "lenses": math.inf})
        answers = [RangeAnswer(requirement=one, parts=both) for one, both in zip(needs, parts, strict=True)]
        figure: Figure = range_picture(answers)  # type: ignore[assignment]
        (axes,) = figure.axes
        bars = [(bar.get_x(), bar.get_width(), bar.get_y() + 0.5 * bar.get_height()) for bar in axes.patches]
        # 50 m of 1 km are 5 %: 0.36 of them marks, 0.64 lenses; nothing is drawn where nothing is known.
        assert bars[:2] == [pytest.approx((0.0, 1.8, 0.0)), pytest.approx((1.8, 3.2, 0.0))]
        assert [bar[1] for bar in bars[2:]] == [0.0, 0.0]
        required = [line.get_xdata()[0] for line in axes.lines if len(line.get_xdata()) == 2]
        assert required == [5.0, 10.0]
        assert [list(line.get_ydata()) for line in axes.lines[:2]] == [[-0.4, 0.4], [0.6, 1.4]]
        assert [text.get_text() for text in axes.get_yticklabels()] == ["1 km", "5 km"]
        assert {text.get_text() for text in figure.legends[0].get_texts()} == {"marks", "lenses", "required"}
        assert axes.get_xlim()[0] == 0.0
        assert axes.get_ylim()[0] > axes.get_ylim()[1]

    def test_poses_and_differences(self) -> None:
        result = calibrated()
        drawn = camera_pictures(result)
        assert set(drawn) == {"coverage", "uncertainty", "residuals", "views", "poses"}
        axes = drawn["poses"].axes[0]  # type: ignore[attr-defined]
        rolls = arrows(axes)
        distance = result.cam_from_board_translation.norm(dim=-1)
        np.testing.assert_allclose(rolls.XY, torch.stack([distance, board_tilts(result.cam_from_board_rotation)], -1))
        np.testing.assert_allclose(np.hypot(rolls.U, rolls.V), 1.0)
        # A board that is rolled clockwise in the image points down.
        rotation = torch.eye(3).double().repeat(2, 1, 1)
        rotation[0, :2, :2] = torch.tensor([[0.8, -0.6], [0.6, 0.8]])
        turned = dataclasses.replace(
            result, cam_from_board_rotation=rotation, cam_from_board_translation=torch.ones(2, 3).double()
        )
        rolls = arrows(camera_pictures(turned)["poses"].axes[0])  # type: ignore[attr-defined]
        np.testing.assert_allclose([rolls.U[0], rolls.V[0]], [0.8, -0.6])
        other = result.camera.with_parameters(
            result.camera.params + torch.tensor([4.0, 4.0, 0, 0, 0] + [0.0] * 4).double()
        )
        found = camera_difference(result.camera, other)
        figure = difference_figure(found, "halves")
        axes = figure.axes[0]
        some = found.shift.numpy()[1::2, 1::2]
        longest = np.linalg.norm(some, axis=-1).max()
        scale = np.hypot(arrows(axes).U, arrows(axes).V).max() / longest
        room = 1.5 * 2 * 640 / 33
        assert scale * longest == pytest.approx(room)
        np.testing.assert_allclose(arrows(axes).U, scale * some[..., 0].ravel())
        assert figure.texts[0].get_text() == "halves"
        assert axes.get_xlim() == (-0.5, 639.5)


def test_a_camera_and_itself_differ_by_no_arrows() -> None:
    camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.05])
    found = camera_difference(camera, camera)
    assert not [part for part in difference_figure(found, "", []).axes[0].collections if isinstance(part, Quiver)]


@pytest.mark.parametrize("scale", [1e-9, 0.3, 41.0, 1e12])
def test_a_scale_bar_is_a_round_length_that_fits(scale: float) -> None:
    axes = Figure().add_subplot()
    axes.set(xlim=(0.0, 640.0), ylim=(480.0, 0.0))
    draw_arrows(axes, np.array([[9.0, 9.0]]), np.array([[1.0, 0.0]]) / scale, scale, "mm")
    (key,) = [part for part in axes.artists if isinstance(part, QuiverKey)]
    length, unit = key.label.split()
    assert unit == "mm"
    assert f"{float(length):.0e}"[0] in "125"
    assert float(key.U) == pytest.approx(scale * float(length))
    assert 0.4 * 0.12 * 640 < key.U <= 0.12 * 640


def test_arrows_of_a_difference_are_as_long_as_there_is_room() -> None:
    found = camera_difference(
        Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480)),
        Camera.build(focal=(810, 800), center=(321, 240), size=(640, 480)),
    )
    axes = difference_figure(found, "", []).axes[0]
    drawn = arrows(axes)
    # Every other place of 33, from the second on; one and a half of its steps at most.
    shift = np.nan_to_num(found.shift.numpy())[1::2, 1::2]
    room = 1.5 * 2 * 640 / 33
    scale = room / np.linalg.norm(shift, axis=-1).max()
    np.testing.assert_allclose(drawn.U, scale * shift[..., 0].ravel())
    np.testing.assert_array_equal(drawn.XY, found.pixels.numpy()[1::2, 1::2].reshape(-1, 2))
