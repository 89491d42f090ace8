"""What pictures show is where it is: numbers of their lines and marks against the things that were drawn."""

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest
import torch
from drawn_scenes import calibrated, landmarks_rig, night, sites, watched
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver, QuiverKey

from kcal import Camera, Origin
from kcal.calibrate.camera.advice import board_tilts
from kcal.lens.difference import camera_difference
from kcal.locate.siting import Site, siting_map
from kcal.report import positions as siting_module
from kcal.report.calibration import camera_pictures, difference_figure
from kcal.report.figures import draw_arrows
from kcal.report.positions import _siting_marks, _siting_notes, budget_figure, range_picture, siting_figure
from kcal.report.rig import _above_sky, _edges, attitude_figure, rig_figure, stars_figure
from kcal.report.verdict import RangeAnswer, Requirement


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

    def test_no_more_than_thirty_names(self) -> None:
        scene = night() | {"pixels": np.random.default_rng(0).uniform(20, 300, (40, 2)), "names": ["x"] * 40,
                           "residual": np.zeros((40, 2))}  # fmt: skip
        assert len(stars_figure(**scene).axes[0].texts) == 30
        assert stars_figure(**night() | {"names": [""] * 6}).axes[0].get_title(loc="left") == ""


class TestAttitude:
    @pytest.mark.parametrize(("seconds", "last", "word"), [
        (86400.0 * 4, 4.0, "days"), (86400.0 * 3, 3.0, "days"), (86400.0 * 2, 48.0, "hours"),
        (7200.0, 2.0, "hours"), (7100.0, 7100 / 60, "minutes"), (300.0, 5.0, "minutes"),
    ])  # fmt: skip
    def test_time_in_a_unit_that_fits(self, seconds: float, last: float, word: str) -> None:
        axes = attitude_figure(**watched(seconds)).axes
        assert axes[2].get_xlabel() == word
        assert axes[0].lines[0].get_xdata()[[0, -1]] == pytest.approx([0.0, last])

    def test_nothing_was_seen_yet(self) -> None:
        empty = {"time": np.empty(0), "angle": np.empty((0, 3)), "sigma": np.empty((0, 3)), "seen": np.empty(0, bool)}
        assert attitude_figure(**empty, limit=0.1).axes[2].get_xlabel() == "minutes"  # type: ignore[arg-type]


class TestSites:
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
        np.testing.assert_array_equal(shown, np.where(found.seen_by.numpy() < 2, found.seen_by.numpy(), np.nan))

    def test_light_comes_from_the_northwest(self) -> None:
        area, towers, _ = sites()
        rows, columns = area.ground.shape
        down = torch.arange(rows, dtype=torch.float64)[:, None] * -30.0 + torch.zeros(columns)
        for ground, bright in ((down, True), (-down, False), (down.new_zeros(rows, columns), None)):
            east = torch.arange(columns, dtype=torch.float64) * (30.0 if bright else -30.0) + torch.zeros(rows, 1)
            axes = Figure().add_subplot()
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
    def test_the_ends_of_a_view(self) -> None:
        result = landmarks_rig()
        left, right = _edges(result, 0, result.cameras[0]) or (0.0, 0.0)
        half = math.atan(960 / 1600)
        assert (left, right) == (pytest.approx(-half, abs=2e-3), pytest.approx(half, abs=2e-3))

    def test_the_worst_of_many(self) -> None:
        result = landmarks_rig()
        good = next(item for item in result.items if item.used)
        many = [dataclasses.replace(good, name=f"p{k}", sigmas=0.01 * k) for k in range(60)]
        wrong = [dataclasses.replace(good, name="w", sigmas=0.1, used=False)]
        _, bars = rig_figure(dataclasses.replace(result, items=(*many, *wrong))).axes
        labels = [text.get_text().split()[-1] for text in bars.get_yticklabels()]
        assert labels == ["w", *(f"p{k}" for k in range(59, 15, -1))]
        assert bars.get_title() == "Residuals by item, the worst 45 of 61"


class TestOthers:
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


class TestVerdictPictures:
    @pytest.fixture(autouse=True)
    def _figures(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Figures in place of their PNG."""
        monkeypatch.setattr("kcal.report.figures.picture_bytes", lambda figure: figure)

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
        assert scale * longest == pytest.approx(1.5 * 2 * 640 / 33)
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
