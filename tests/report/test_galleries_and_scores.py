"""Galleries, coverage and sketches show what they were given; scores of positions and tracks against a truth."""

import csv
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drawn_scenes import calibrated, located
from locate_rigs import located_pairs, pinhole_rig, tensor
from matplotlib.colors import to_hex

from kcal import FileError, Origin
from kcal.corners.observations import Failure, Observations, View
from kcal.io.images import write_png
from kcal.locate import enu_to_geodetic
from kcal.report import positions
from kcal.report.calibration import FailedImage, _predicted_sigma, _thumbnail, coverage_figure, gallery_figure
from kcal.report.figures import ACCENT, WARN, round_levels
from kcal.report.practice_score import _place_at, located_rows, score_positions, score_tracks
from kcal.report.tables import range_sigma, truth_rows

ORIGIN = {"lat": 45.0, "lon": 6.0, "height": 300.0}


class TestGallery:
    def seen(self, count: int, **more: Any) -> Observations:
        base = calibrated().observations
        views = [base.views[k % 8].model_copy(update={"name": f"{k:02}.png"}) for k in range(count)]
        return base.model_copy(update={"views": tuple(views), **more})

    def test_failed_images_come_first_with_their_reasons(self, tmp_path: Path) -> None:
        failed = [
            FailedImage(f"bad{k}.png", tmp_path / f"bad{k}.png", "no board", torch.tensor([[10.0, 20.0]]))
            for k in range(9)
        ]
        failures = tuple(Failure(name=f"bad{k}.png", reason="no board") for k in range(20))
        figure = gallery_figure(self.seen(26, failures=failures), failed)
        titles = [axes.get_title(loc="left") for axes in figure.axes]
        assert len(titles) == 8 + 24
        assert all(title.startswith("failed: bad") for title in titles[:8])
        assert titles[8].startswith("00.png")
        np.testing.assert_array_equal(figure.axes[0].collections[0].get_offsets(), [[10.0, 20.0]])
        told = [text.get_text() for text in figure.texts]
        assert told[0] == "26 views (24 are shown); without a board: 20"
        # Of those that are not drawn, ten.
        assert told[1].splitlines() == [f"bad{k}.png: no board" for k in range(8, 18)]
        heights = [text.get_position()[1] for text in figure.texts]
        assert heights == sorted(heights, reverse=True)

    def test_a_view_has_its_first_row_and_corner(self) -> None:
        seen = self.seen(1)
        axes = gallery_figure(seen).axes[0]
        pixels = np.array(seen.views[0].pixels)
        np.testing.assert_array_equal(np.stack(axes.lines[0].get_data(), -1), pixels[: seen.board.columns])
        np.testing.assert_array_equal(axes.collections[0].get_offsets(), pixels)
        np.testing.assert_array_equal(axes.collections[1].get_offsets(), pixels[:1])
        assert axes.get_xlim() == (-0.5, 639.5)
        view = View(
            name="v" * 50, pixels=(None, *seen.views[0].pixels[1:]), covariance=((0.04, 0.0, 0.16),) * len(pixels)
        )
        title = gallery_figure(seen.model_copy(update={"views": (view,)})).axes[0].get_title(loc="left")
        assert title == "…" + "v" * 33 + "  σ 0.316 px  1 left out"
        assert _predicted_sigma(view) == pytest.approx(math.sqrt(0.1))
        assert _predicted_sigma(seen.views[0]) is None

    def test_thumbnails(self, tmp_path: Path) -> None:
        image = np.arange(1000, dtype=np.uint32).reshape(1, -1) + np.zeros((20, 1), np.uint32)
        image = (image % 251).astype(np.uint8)
        path = write_png(tmp_path / "a.png", image)
        # Every second pixel of each second row, from the second on.
        np.testing.assert_array_equal(_thumbnail(path, (1000, 20)), image[1::2, 1::2])
        for where, size in ((None, (1000, 20)), (path, (20, 1000)), (tmp_path / "none.png", (1000, 20))):
            assert np.unique(_thumbnail(where, size)).tolist() == [200]

    def test_coverage_counts_views_in_each_cell(self) -> None:
        seen = self.seen(8)
        figure = coverage_figure(seen)
        axes = figure.axes[0]
        cells = axes.images[0].get_array()
        assert cells is not None
        assert cells.shape == (6, 8)
        pixels = seen.pixels().numpy()
        expected = np.zeros((6, 8))
        for view in pixels:
            at = {(int((v + 0.5) // 80), int((u + 0.5) // 80)) for u, v in view}
            for place in at:
                expected[place] += 1
        np.testing.assert_array_equal(cells, expected)
        np.testing.assert_array_equal(axes.collections[-1].get_offsets(), pixels.reshape(-1, 2))
        # Colors tell near boards from far ones: the median distance of neighbors within a row.
        rows = pixels.reshape(8, -1, seen.board.columns, 2)
        apart = np.median(np.linalg.norm(np.diff(rows, axis=2), axis=-1).reshape(8, -1), axis=1)
        np.testing.assert_allclose(axes.collections[-1].get_array(), np.repeat(apart, pixels.shape[1]))
        assert axes.images[0].get_extent() == [-0.5, 639.5, 479.5, -0.5]
        assert figure.texts[0].get_text().startswith("8 views, 336 corners; boards reached ")

    def test_levels_are_round(self) -> None:
        assert round_levels(0.03, 0.4) == [0.02, 0.05, 0.1, 0.2, 0.5]
        assert round_levels(0.05, 0.05) == [0.05, 0.1]
        assert round_levels(1.0, 2.0) == [1.0, 2.0]


def test_a_sketch_names_what_to_mark(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    kept: list[Any] = []
    monkeypatch.setattr("kcal.report.figures.save_picture", lambda path, figure: kept.append(figure) or path)
    image = np.zeros((320, 640, 3), np.uint8)
    marks = ["post", "roof"], np.array([[100.0, 50.0], [300.0, 80.0]])
    positions.save_site_sketch(tmp_path / "a.png", image, marks, (["ship"], np.array([[500.0, 200.0]])))
    (figure,) = kept
    assert tuple(figure.get_size_inches()) == (4.0, 2.0)
    axes = figure.axes[0]
    places = [(float(line.get_xdata()[0]), float(line.get_ydata()[0])) for line in axes.lines]
    assert places == [(100.0, 50.0), (300.0, 80.0), (500.0, 200.0)]
    assert [to_hex(line.get_markeredgecolor()) for line in axes.lines] == [ACCENT, ACCENT, WARN]
    named = {text.get_text(): text.xy for text in axes.texts[:3]}
    assert named == {"post": (100.0, 50.0), "roof": (300.0, 80.0), "ship": (500.0, 200.0)}
    assert axes.texts[3].get_position() == (6.4, 0.97 * 320)
    assert axes.get_position().bounds == (0.0, 0.0, 1.0, 1.0)


class TestScores:
    def file(self, path: Path, rows: list[tuple[str, tuple[float, float, float], float, float, float | None]],
             times: list[float] | None = None) -> Path:  # fmt: skip
        """Rows of name, east, north, up, range and its interval as kcal writes them."""
        features = []
        for k, (name, enu, far, low, high) in enumerate(rows):
            lat, lon, height = enu_to_geodetic(torch.tensor(enu, dtype=torch.float64), Origin(**ORIGIN)).tolist()
            row: dict[str, Any] = {"name": name, "status": "ok", "lat": lat, "lon": lon, "height_ellipsoidal_m": height,
                                   "range_m": far, "range_low_m": low, "range_high_m": high}  # fmt: skip
            if times is not None:
                row["time_s"] = times[k]
            features.append({"properties": row})
        features.append({"properties": {"name": "lost", "status": "bearing only"}})
        path.write_text(json.dumps({"features": features}))
        return path

    def test_positions(self, tmp_path: Path) -> None:
        truth = {"origin": ORIGIN, "targets": {"Gate": [0.0, 500.0, 0.0], "Mast": [300.0, 0.0, 0.0]}}
        rows = [("gate ", (3.0, 496.0, 9.0), 495.0, 480.0, 499.0), ("MAST", (300.0, 1.0, 0.0), 310.0, 280.0, None),
                ("else", (0.0, 0.0, 0.0), 1.0, 0.0, 2.0)]  # fmt: skip
        path = self.file(tmp_path / "a.geojson", rows)
        table = score_positions(path, truth)
        close = {"level_m": pytest.approx(1.0, abs=1e-3), "range_off_m": pytest.approx(10.0)}
        mast, gate = table.records
        assert mast == {"target": "MAST", "range_m": 300.0, "contains": True, **close}
        assert (gate["range_m"], gate["contains"]) == (500.0, False)
        assert gate["level_m"] == pytest.approx(5.0, abs=1e-3)
        assert gate["range_off_m"] == pytest.approx(-5.0)
        assert table.cells[1:] == [["MAST", "300", "1", "+10", "yes"], ["gate ", "500", "5", "-5", "no"]]
        assert len(located_rows(path, truth)) == 3
        table_file, known = tmp_path / "a.csv", [one["properties"] for one in json.loads(path.read_text())["features"]]
        with table_file.open("w", newline="") as out:
            writer = csv.DictWriter(out, known[0])
            writer.writeheader()
            writer.writerows(known)
        assert score_positions(table_file, truth).records == table.records
        lines = tmp_path / "a.geojsonl"
        lines.write_text("\n".join(json.dumps(one) for one in json.loads(path.read_text())["features"]))
        assert located_rows(lines, truth)[1].range_high_m == math.inf
        for text in ("{", '{"features": [3]}', '{"properties": {"status": "ok", "name": "a"}}'):
            path.write_text(text)
            with pytest.raises(FileError, match="kcal"):
                located_rows(path, truth)

    def test_tracks(self, tmp_path: Path) -> None:
        """Two ships; one has two tracks, a third track is near none."""
        times = [0.0, 1.0, 2.0, 3.0]
        truth = {
            "origin": ORIGIN,
            "ships": {"times": times, "places": {
                "far": [[0.0, 2000.0 + 10 * k, 0.0] for k in range(4)],
                "near": [[10.0 * k, 400.0, 0.0] for k in range(4)],
            }},
        }  # fmt: skip
        rows, at = [], []
        for k, time in enumerate((0.0, 0.5, 1.0)):
            true = 2000.0 + 10 * time
            rows.append(("a", (2.0, true, 0.0), true + 4.0, true - 1.0, true + (5.0 if k else -0.5)))
            at.append(time)
        for name, time in (("b", 0.0), ("b", 1.0), ("c", 3.0)):
            east = 10.0 * time
            rows.append((name, (east, 401.0, 0.0), 400.0, 390.0, 420.0))
            at.append(time)
        rows.append(("d", (900.0, 900.0, 0.0), 1272.0, 1200.0, 1300.0))
        at.append(1.0)
        table, strays = score_tracks(self.file(tmp_path / "t.geojson", rows, at), truth)
        near, far = table.records
        assert strays == 1
        assert [near[key] for key in ("ship", "tracks", "followed", "contained")] == ["near", 2, 0.75, 1.0]
        assert near["level_m"] == pytest.approx(1.0, abs=1e-3)
        assert near["range_m"] == pytest.approx(np.mean([math.hypot(10 * k, 400) for k in range(4)]))
        assert [far[key] for key in ("ship", "tracks", "followed")] == ["far", 1, 0.75]
        assert far["contained"] == pytest.approx(2 / 3)
        assert far["level_m"] == pytest.approx(2.0, abs=1e-3)
        assert far["range_off_m"] == pytest.approx(4.0)
        assert _place_at(np.array([[0.0, 1.0], [10.0, 5.0]]), np.array([1.0, 3.0]), 1.5).tolist() == [2.5, 2.0]


class TestTables:
    def test_sigma_of_an_interval(self) -> None:
        found, _ = located()
        gate, cloud = found.positions[0], found.positions[3]
        assert gate.range_low_m is not None
        assert gate.range_high_m is not None
        assert range_sigma(gate) == pytest.approx((gate.range_high_m - gate.range_low_m) / (2 * 1.959964), rel=1e-5)
        assert range_sigma(cloud) is None
        open_end = dataclasses.replace(gate, range_high_m=math.inf)
        assert gate.range_m is not None
        assert range_sigma(open_end) == pytest.approx((gate.range_m - gate.range_low_m) / 1.959964, rel=1e-5)

    def test_a_target_that_has_no_range(self) -> None:
        true = tensor([0.0, 60_000.0, 0.0])
        left, right = pinhole_rig()(tensor([0.0, 0.0, 60_000.0]))[0].unbind(-2)
        origin = Origin(lat=10.0, lon=20.0, height=0.0)
        far = located_pairs(pinhole_rig(), left, right, origin=origin, heading_deg=0.0, names=["cloud"])
        heads, row = truth_rows(far, far, true)
        assert len(row) == len(heads)
        assert row[0] == "cloud"
        assert row[2:8] == ["-"] * 6
