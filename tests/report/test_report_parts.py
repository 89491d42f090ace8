"""Limits of findings, ranges of rigs by hand, popups of the map, tables of a page."""

import base64
import dataclasses
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drawn_scenes import FIGURES, calibrated, landmarks_rig, located, stations
from locate_rigs import pinhole_rig
from PIL import Image, TiffImagePlugin

from kcal import Board, CalibrationOptions, Camera, InputError, Observations, Origin, View
from kcal.calibrate.camera.trust import Examination, HalvesDifference, PlainLens, ResidualStructure
from kcal.finding import FAULTS, Finding
from kcal.lens import CameraCalibration, camera_difference, rotation_from_vector
from kcal.locate import geodetic_to_enu
from kcal.locate.budget import range_sigmas
from kcal.locate.positions import map_places, region_rings
from kcal.report.judge_camera import (
    _blur_finding,
    _blurred_share,
    _camera_answers,
    _coverage_finding,
    _image_rms,
    _pose_findings,
    _prediction_finding,
    _sides_finding,
    model_findings,
)
from kcal.report.judge_rig import (
    Synchrony,
    _pairs_compared,
    _synchrony_finding,
    _worst_of_pair,
    named_cameras,
    rig_verdict,
)
from kcal.report.map_page import _box, _content, _placing, _tile, _warp, arcs_within, local_image
from kcal.report.pages import _caption, camera_tables
from kcal.report.positions import _PART_COLORS
from kcal.report.verdict import RangeAnswer, Requirement, weighed_findings
from kcal.rig import RigCovariance

CAMERA = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")


def turns(*angles: tuple[float, float, float]) -> torch.Tensor:
    return rotation_from_vector(torch.deg2rad(torch.tensor(angles, dtype=torch.float64)))


class TestPoses:
    def found(
        self, tilts: list[float], rolls: list[float], distances: list[float], focal_error: float = 20.0
    ) -> dict[str, str]:
        rotation = torch.stack([
            turns((tilt, 0.0, 0.0))[0] @ turns((0.0, 0.0, roll))[0] for tilt, roll in zip(tilts, rolls, strict=True)
        ])  # fmt: skip
        shift = torch.tensor([[0.0, 0.0, far] for far in distances], dtype=torch.float64)
        camera = Camera(CAMERA.params, size=CAMERA.size, model=CAMERA.model)
        camera.calibration = CameraCalibration(sigma={"fx": focal_error})
        return {finding.name: finding.text for finding in _pose_findings(camera, rotation, shift)}

    def test_three_tilted_views_are_needed_where_the_focal_length_is_open(self) -> None:
        rolls, far = [0.0, 40.0, 80.0, 20.0], [1.0, 2.0, 1.5, 1.2]
        assert set(self.found([26.0, 30.0, -27.0, 3.0], rolls, far)) == {"poses"}
        few = [26.0, 30.0, 24.0, 3.0]
        assert self.found(few, rolls, far)["tilt"] == (
            "the board is tilted by more than 25° in 2 of 4 views, by 30° at most: the focal length is known only to "
            "±2.5 %"
        )
        assert set(self.found(few, rolls, far, 15.9)) == {"poses"}

    def test_rolls_and_distances(self) -> None:
        tilts = [30.0, -30.0, 25.0, 40.0]
        good = self.found(tilts, [0.0, 61.0, 30.0, 10.0], [1.0, 1.31, 1.1, 1.2])
        assert set(good) == {"poses"}
        assert good["poses"].startswith("tilts up to 40°, rolls within 61°, distances 1 to 1.3 m")
        assert set(self.found(tilts, [0.0, 58.0, 30.0, 10.0], [1.0, 1.31, 1.1, 1.2])) == {"roll"}
        assert "(1 to 1.3 m)" in self.found(tilts, [0.0, 61.0, 30.0, 10.0], [1.0, 1.29, 1.1, 1.2])["depth"]


class TestViews:
    def test_blur_by_noise_and_by_share(self) -> None:
        def severity(noise: float, share: float) -> str | None:
            found = _blur_finding(noise, share)
            return None if found is None else found.severity

        assert severity(0.35, 0.25) is None
        assert severity(0.36, 0.0) == "doubt"
        assert severity(0.1, 0.26) == "doubt"
        blurred, scattered = _blur_finding(0.1, 0.5), _blur_finding(0.8, 0.1)
        assert blurred.text.startswith("50 % of the views are blurred")
        assert scattered.text.startswith("corners scatter by 0.8 px")

    def test_share_of_blurred_views(self) -> None:
        board = Board(columns=3, rows=2, square=0.1)
        pixels = tuple((float(i), 0.0) for i in range(6))
        # Along both axes on average: 0.5 (sx² + sy²) = 0.72² for the first.
        wide, thin = (0.9, 0.0, 2 * 0.72**2 - 0.9), (0.9, 0.0, 2 * 0.68**2 - 0.9)
        views = [
            View(name=str(i), pixels=pixels, covariance=(one,) * 6) for i, one in enumerate((wide, thin, thin, thin))
        ]
        seen = Observations(board=board, image_size=(640, 480), views=tuple(views))
        assert _blurred_share(seen) == pytest.approx(0.25)
        assert _blurred_share(seen.model_copy(update={"views": tuple([View(name="a", pixels=pixels)])})) == 0.0

    def test_names_of_two_cameras(self) -> None:
        pairs = [f"{side}{i:02}.png" for side in ("left", "right") for i in range(3)]
        others = [f"x{i}.png" for i in range(6)]
        assert _sides_finding([*pairs, *others], "stop") is None  # a half of them
        found = _sides_finding([*pairs, *others[:5]], "stop")
        assert found.severity == "stop"
        assert found.text.startswith("6 of 11 views are named like pairs of two cameras, left00.png and right00.png")

    def coverage(self, low: float, high: float) -> tuple[str, str]:
        """Of a board whose corners span these shares of both sides of the image."""
        corners = tuple((low * 640 + (high - low) * 640 * x, low * 480 + (high - low) * 480 * y)
                        for y in (0.0, 1.0) for x in (0.0, 1.0))  # fmt: skip
        seen = Observations(board=Board(columns=2, rows=2, square=0.1), image_size=(640, 480),
                            views=(View(name="a", pixels=corners),))  # fmt: skip
        found = _coverage_finding(seen)
        return found.severity, found.text

    def test_coverage_of_the_image_and_of_its_border(self) -> None:
        assert self.coverage(0.0, 1.0)[0] == "fine"
        severity, text = self.coverage(0.04, 0.96)
        # 0.92² of the image; the border ring is 6 of 64 rows and 9 of 96 columns on each side.
        ring = 1.0 - (78 / 96) * (52 / 64)
        inside = (0.92**2 - (78 / 96) * (52 / 64)) / ring
        assert severity == ("doubt" if 1 - inside > 0.5 else "fine")
        numbers = [float(word) for word in text.replace("%", " ").split() if word.replace(".", "").isdigit()]
        assert numbers[0] == pytest.approx(100 * (1 - 0.92**2), abs=2)
        assert numbers[1] == pytest.approx(100 * (1 - inside), abs=4)
        assert self.coverage(0.1, 0.9)[0] == "doubt"


class TestModel:
    def half(self, **more: Any) -> HalvesDifference:
        same = camera_difference(CAMERA, CAMERA.with_parameters(CAMERA.params + 0.1))
        same = dataclasses.replace(same, ratio=more.pop("ratio", 3.0), probability=more.pop("probability", 0.5))
        given = {"label": "first and second half", "alike": False, "held_out": 0.1, "own": calibrated().rms} | more
        return HalvesDifference(difference=same, **given)

    def told(self, *halves: HalvesDifference, failures: tuple[str, ...] = (), neighbors: float = 0.0,
             image: float = 1.0) -> tuple[list[Finding], float]:  # fmt: skip
        structure = ResidualStructure(image=image, board=1.0, neighbors=neighbors, neighbors_sigma=0.01)
        given = Examination(halves=halves, reference=None, model=None, structure=structure, failures=failures)
        return model_findings(calibrated(), CalibrationOptions(model="opencv4"), given)

    def findings(self, *halves: HalvesDifference, **more: Any) -> tuple[dict[str, str], float]:
        found, beyond = self.told(*halves, **more)
        return {finding.name: finding.severity for finding in found}, beyond

    def test_patterns_without_harm_are_a_note(self) -> None:
        """Real corners are never quite independent; error bars allow for it, and halves show whether by enough."""
        agree, less, apart = (self.half(alike=True, held_out=0.05, probability=p) for p in (0.5, 0.005, 1e-4))
        assert self.findings(agree, neighbors=0.12, image=2.5)[0] == {"prediction": "fine", "halves": "fine"}
        for more in ({"neighbors": 0.13}, {"image": 2.6}):
            assert self.findings(agree, **more) == ({"patterns": "note", "prediction": "fine", "halves": "fine"}, 0.0)
            assert self.findings(less, **more)[0] == {"patterns": "doubt", "prediction": "fine", "halves": "doubt"}
            # Two proofs of one fault, of which each alone may be chance.
            found, beyond = self.findings(apart, **more)
            assert found == {"halves": "doubt", "prediction": "fine"}
            assert beyond > 0.0
        assert self.findings(apart)[1] == 0.0
        assert self.findings(failures=("few",), image=2.6)[0] == {"patterns": "doubt", "halves": "doubt"}

    def test_halves_that_differ_by_more_than_chance(self) -> None:
        one, two = (self.half(alike=True, held_out=0.05, probability=p) for p in (1e-7, 1e-5))
        (found, _), beyond = self.told(one)
        assert (found.name, found.severity, found.part) == ("halves", "doubt", FAULTS)
        assert "3.0 times what their error bars predict (p 1e-07): lens model or board do not fit" in found.text
        assert beyond == pytest.approx(one.difference.rms * math.sqrt(1 - 1 / 9))
        assert self.findings(two) == ({"prediction": "fine", "halves": "doubt"}, 0.0)
        # Nobody said how well it must be known: wrong error bars are a no; a requirement that bears them is a yes.
        assert [one.severity for one in weighed_findings([found], (), wrong=True)] == ["stop"]
        need = RangeAnswer(requirement=Requirement(distance=100.0, meters=50.0), parts={FAULTS: 1.0})
        assert [one.severity for one in weighed_findings([found], [need], wrong=True)] == ["doubt"]

    def test_what_could_not_be_checked(self) -> None:
        assert self.findings(failures=("too few views",))[0]["halves"] == "doubt"
        assert self.findings(self.half(alike=True), failures=("one fit failed",))[0]["halves"] == "doubt"

    def test_two_cameras_are_named_where_each_half_fits_better_alone(self) -> None:
        together, alike = calibrated().rms, self.half(alike=True, label="every other view", held_out=0.05)
        (two, *_), _ = self.told(alike, self.half(own=0.79 * together, probability=1e-7))
        assert (two.name, two.severity) == ("changed", "stop")
        (one, *_), _ = self.told(alike, self.half(own=0.81 * together, probability=1e-7))
        assert one.name == "halves"
        assert "it is one camera, and the board's shape, or how it was held, changed" in one.text
        # Without halves that agree, the model may be wrong as well.
        (model, *_), _ = self.told(self.half(own=0.81 * together, probability=1e-7))
        assert "lens model or board do not fit" in model.text
        # They predict each other twice as badly as halves that are alike: then less is proof enough.
        far = self.half(own=together, held_out=0.1, probability=1e-4)
        assert self.told(alike, far)[0][0].part == FAULTS
        assert self.told(alike, dataclasses.replace(far, held_out=0.07))[1] == 0.0

    def test_prediction(self) -> None:
        assert _prediction_finding(self.half(held_out=0.125, own=0.1), None).severity == "fine"
        poor = self.half(held_out=0.126, own=0.1)
        doubt = _prediction_finding(poor, None)
        assert doubt.severity == "doubt"
        assert "to 0.13 px RMS, 1.26 times" in doubt.text
        # A half of few views predicts badly; a fault is that a plain lens does better.
        assert _prediction_finding(poor, PlainLens("opencv5", 0.2, 0.21)).severity == "note"
        harm = _prediction_finding(poor, PlainLens("opencv5", 0.2, 0.23))
        assert (harm.severity, harm.part) == ("stop", FAULTS)
        assert "a plain lens (opencv5) predicts them better: 0.2 px, this lens 0.23 px" in harm.text


class TestAnswers:
    def test_a_range_by_two_cameras(self) -> None:
        """√2 Z² / (f B) for each pixel of either camera."""
        parts = _camera_answers(CAMERA, [Requirement(distance=1000.0, meters=50.0)], 0.2, 0.5, 8.0, 0.3)[0].parts
        slope = math.sqrt(2) * 1e6 / (800 * 8)
        assert parts == pytest.approx({"marks": 0.3 * slope, "lenses": 0.2 * slope, FAULTS: 0.5 * slope})

    def test_rms_of_error_bars_over_the_image(self) -> None:
        camera = Camera(CAMERA.params, size=CAMERA.size, model=CAMERA.model)
        assert _image_rms(camera) == math.inf
        covariance = torch.zeros(5, 5).double()
        covariance[2, 2] = covariance[3, 3] = 0.04
        camera.calibration = CameraCalibration(covariance=covariance)
        # A shift of the principal point looks like a turn, but for how the image is stretched: less than its sigma.
        assert 0.0 < _image_rms(camera) < 0.2 * math.sqrt(2)
        focal = torch.zeros(5, 5).double()
        focal[0, 0] = focal[1, 1] = focal[0, 1] = focal[1, 0] = 16.0
        camera.calibration = CameraCalibration(covariance=focal)
        pixels = CAMERA.grid(65, 49).reshape(-1, 2) - CAMERA.params[2:4]
        by_hand = float((4.0 / 800 * pixels).square().sum(-1).mean().sqrt())
        assert _image_rms(camera) == pytest.approx(by_hand, rel=0.75)

    def test_the_worst_place_of_a_pair(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Of the middle, and of three tenths of the width to both sides; what is not known is worse than anything."""
        rig = pinhole_rig()
        rig.covariance = RigCovariance.of(rig, pose=torch.diag(torch.tensor([0, 1e-8, 0, 0, 0, 0]).double()))
        real = range_sigmas(rig, [1000.0], pixel_sigma=0.3)
        asked: list[Any] = []
        totals: dict[float, float] = {}

        def given(*_: Any, pixel: Any, **__: Any) -> Any:
            asked.append(pixel)
            if pixel is not None and pixel[0] not in totals:
                raise InputError("the right camera does not see it")
            return real._replace(total=torch.tensor([1.0 if pixel is None else totals[pixel[0]]]))

        monkeypatch.setattr("kcal.report.judge_rig.range_sigmas", given)
        places = [pytest.approx(0.2 * 1920), pytest.approx(0.8 * 1920)]
        for left, right, worst in ((3.0, 2.0, 3.0), (0.5, 0.4, 1.0), (0.5, 2.0, 2.0), (math.nan, 2.0, math.nan)):
            asked.clear()
            totals.update({0.5 * 1920 - 0.3 * 1920: left, 0.5 * 1920 + 0.3 * 1920: right})
            assert float(_worst_of_pair(rig, 1000.0, pixel_sigma=0.3).total) == pytest.approx(worst, nan_ok=True)
            assert [None if place is None else place[0] for place in asked] == [None, *places]
            assert asked[1][1] == 540
        totals.clear()
        assert float(_worst_of_pair(rig, 1000.0, pixel_sigma=0.3).total) == 1.0

    def test_stations_have_names(self) -> None:
        result = landmarks_rig()
        assert [name for name, _ in named_cameras(result.stations())] == ["left", "right"]
        assert [name for name, _ in named_cameras(result.stereo())] == ["left", "right"]
        assert _pairs_compared(result.stereo(), result, None) is None

    def synchrony(self, ratio: float, delay: float | None = None, sigma: float | None = 0.01) -> Any:
        return _synchrony_finding(Synchrony(pairs=9, ratio=ratio, shift=0.0123, delay=delay, delay_sigma=sigma))

    def test_cameras_that_were_not_triggered_together(self) -> None:
        assert self.synchrony(2.5).severity == "fine"
        assert "in 9 pairs (2.4 times" in self.synchrony(2.4).text
        found = self.synchrony(2.6)
        assert found.severity == "stop"
        assert "12 mm elsewhere" in found.text
        assert "steps" not in found.text
        late = self.synchrony(1.0, 0.06)
        assert late.severity == "doubt"
        assert "0.06 ± 0.01 steps after" in late.text
        assert "steps before" in self.synchrony(1.0, -0.06).text
        # Five sigmas, and a fiftieth of a step at least.
        assert self.synchrony(1.0, 0.049).severity == "fine"
        assert self.synchrony(1.0, 0.019, 0.001).severity == "fine"
        assert self.synchrony(1.0, 0.021, 0.001).severity == "doubt"
        assert self.synchrony(1.0, 0.5, None).severity == "fine"

    def test_what_contradicts_is_a_stop_and_a_fifth_may_be_left_out(self) -> None:
        rig = landmarks_rig().stereo()
        names = {one.name for one in rig_verdict(rig).findings}
        assert "left-out" not in names
        (source,) = rig.calibration.sources
        for out, severity in ((2, None), (3, "stop")):
            changed = dataclasses.replace(source, used=10 - out, left_out=out, sigmas=3.0)
            rig.calibration = dataclasses.replace(
                rig.calibration, sources=(changed,), contradictions=("a contradicts b",)
            )
            found = {one.name: one for one in rig_verdict(rig).findings}
            assert (found["left-out"].severity if "left-out" in found else None) == severity
            assert "misfit" not in found
            assert found["contradiction"].severity == "stop"
        assert found["left-out"].text.startswith("30 % of what was seen")
        changed = dataclasses.replace(source, sigmas=3.1)
        rig.calibration = dataclasses.replace(rig.calibration, sources=(changed,))
        assert {one.name: one for one in rig_verdict(rig).findings}["misfit"].severity == "stop"
        # A solution that has just been found is judged as its file is; a source without freedom says nothing.
        found = landmarks_rig()
        (own,) = found.sources
        open_one = dataclasses.replace(own, name="features", sigmas=None)
        wide = dataclasses.replace(own, sigmas=3.1)
        for sources in ((wide, open_one), (open_one, wide)):
            solved = dataclasses.replace(found, sources=sources)
            named = {one.name: one for one in rig_verdict(found.stereo(), result=solved).findings}
            assert named["misfit"].severity == "stop"


class TestMap:
    def test_bearings_reach_beyond_the_farthest(self) -> None:
        found, truth = located()
        content = _content(found, truth)
        far = max(p.range_m or p.range_low_m or 0.0 for p in found.positions)
        (line,) = content["bearings"]
        ends = geodetic_to_enu(torch.tensor([[*place, 0.0] for place in line], dtype=torch.float64), found.origin)
        lost = found.positions[3]
        assert float(ends[0, :2].norm()) == pytest.approx(lost.range_low_m, rel=1e-4)
        assert float(ends[1, :2].norm()) == pytest.approx(1.15 * far, rel=1e-4)
        for end in ends:
            assert math.degrees(math.atan2(float(end[0]), float(end[1]))) % 360 == pytest.approx(
                lost.azimuth_deg, abs=0.01
            )
        # An arrow leads from the true place to the estimate.
        for arrow, position, true in zip(content["arrows"], found.positions, truth, strict=False):
            assert arrow["line"][1] == (position.lat, position.lon)
            miss = np.array(position.enu) - true.numpy()
            assert arrow["azimuth"] == pytest.approx(math.degrees(math.atan2(miss[0], miss[1])))
            assert arrow["line"][0] == map_places(true[None], found.origin)[0]
        first = content["cameras"][0]
        rim = geodetic_to_enu(
            torch.tensor([[*place, 0.0] for place in first["field"]], dtype=torch.float64), found.origin
        )
        assert float(rim[30, :2].norm()) == pytest.approx(1.15 * far, rel=1e-3)

    def test_places_and_regions_stay_together_across_the_antimeridian(self) -> None:
        """The map of a camera at 179 degrees west has what it sees there beside it, not around the globe."""
        found, truth = located()
        for lon, turns in ((20.0, 0.0), (-179.0, -360.0)):
            here = dataclasses.replace(found, origin=Origin(lat=10.0, lon=lon, height=0.0))
            content = _content(here, truth)
            seen = [(p.lat, p.lon + turns) for p in found.positions if p.lat is not None]
            assert [point["place"] for point in content["points"]] == seen
            assert len(content["regions"]) == len(region_rings(here)) > 0
            for ring, there in zip(content["regions"], region_rings(here), strict=True):
                assert [lat for lat, _ in ring] == [lat for lat, _ in there]
                assert [lon % 360 for _, lon in ring] == pytest.approx([lon % 360 for _, lon in there], abs=1e-9)
                assert max(abs(east - lon) for _, east in ring) < 1.0
                assert len({east for _, east in ring}) > 2

    def test_arcs_sweep_what_the_cameras_see(self) -> None:
        found, _ = located()
        for arc in _content(found, None)["arcs"]:
            ends = geodetic_to_enu(
                torch.tensor([[*arc["line"][k], 0.0] for k in (0, -1)], dtype=torch.float64), found.origin
            )
            azimuths = [math.degrees(math.atan2(float(x), float(y))) % 360 for x, y, _ in ends]
            # Half of 1920 px at a focal length of 1600 px on each side of a heading of 300 degrees.
            half = math.degrees(math.atan(960 / 1600))
            assert azimuths == pytest.approx([300 - half, 300 + half], abs=0.1)
        assert _content(stations(), None)["arcs"] == []

    def test_popups(self) -> None:
        found, _ = located()
        first = found.positions[0]
        rows = dict(_content(found, None)["points"][0]["rows"])
        # Six digits are 0.1 m, and its place is known to some centimeters only.
        assert first.cep50_m is not None
        assert first.cep50_m > 0.05
        assert rows["latitude"] == f"{first.lat:.6f}°"
        assert first.range_m is not None
        # In the unit of the farthest.
        assert rows["range"] == f"{first.range_m / 1e3:.5f} km"
        assert rows["95 % interval"].endswith(" km")
        assert first.cep50_m is not None
        assert first.cep95_m is not None
        assert first.meters_per_degree is not None
        half, most = (float(text.split()[0]) * (1e-3 if text.endswith("mm") else 1.0)
                      for text in rows["CEP50, CEP95"].split(", "))  # fmt: skip
        assert (half, most) == (pytest.approx(first.cep50_m, rel=0.05), pytest.approx(first.cep95_m, rel=0.05))
        number, unit = rows["0.01° of yaw is"].split()
        assert float(number) * (1e-3 if unit == "mm" else 1.0) == pytest.approx(
            0.01 * first.meters_per_degree, rel=0.05
        )
        height = float(rows["ellipsoidal height"].split()[0])
        if first.geoid_height is not None:
            assert float(rows["above the geoid"].split()[0]) == pytest.approx(height - first.geoid_height, abs=0.1)

    def test_the_view_holds_everything(self) -> None:
        content = {"truth": [(1.0, 2.0)], "points": [{"place": (3.0, -1.0)}], "cameras": [{"place": (0.5, 0.0)}],
                   "regions": [[(9.0, 4.0), (8.0, 7.0)]], "bearings": [[(-2.0, 0.0)]]}  # fmt: skip
        assert _box(content) == (-2.0, -1.0, 9.0, 7.0)

    def test_arcs_of_a_bench(self) -> None:
        # A twelfth of the reach is too near.
        assert arcs_within(1.21) == [0.25, 0.5, 1.0]
        assert arcs_within(1.19) == [0.1, 0.25, 0.5, 1.0]
        assert arcs_within(250.0) == [25.0, 50.0, 100.0]
        assert arcs_within(251.0) == [250.0]


class TestBackdrop:
    def test_numbers_of_tiles(self) -> None:
        """OpenStreetMap, Slippy map tilenames: the example there, and both ends of the map."""
        assert _tile(0.0, 0.0, 1) == (1, 1)
        assert _tile(19.07, 72.87, 13) == (5754, 3653)
        assert _tile(51.5, -0.1, 10) == (511, 340)
        assert _tile(89.0, -180.0, 4) == _tile(85.0, -180.0, 4) == (0, 0)
        assert _tile(-89.0, 179.9, 4) == (15, 15)

    def tags(self, **more: Any) -> dict[int, Any]:
        keys = more.pop("keys", (1, 1, 0, 1, 3072, 0, 1, 32643))
        return {34735: keys, **more.pop("tags", {33550: (2.0, 3.0, 0.0), 33922: (4.0, 5.0, 0.0, 100.0, 200.0, 0.0)})}

    def test_places_of_pixels(self) -> None:
        matrix, system = _placing(Path("a.tif"), self.tags())
        # The tie point of pixel (4, 5) lies at (100, 200); rows run to the south.
        np.testing.assert_allclose(matrix @ [4.0, 5.0, 1.0], [100.0, 200.0])
        np.testing.assert_allclose(matrix @ [6.0, 9.0, 1.0], [104.0, 188.0])
        assert system.to_epsg() == 32643
        points, _ = _placing(Path("a.tif"), self.tags(keys=(1, 1, 0, 2, 3072, 0, 1, 32643, 1025, 0, 1, 2)))
        np.testing.assert_allclose(points @ [4.5, 5.5, 1.0], [100.0, 200.0])
        whole = {34264: (2, 0.5, 0, 7, 0.25, -3, 0, 9, 0, 0, 0, 0, 0, 0, 0, 1)}
        full, degrees = _placing(Path("a.tif"), self.tags(tags=whole, keys=(1, 1, 0, 1, 2048, 0, 1, 4326)))
        np.testing.assert_allclose(full, [[2, 0.5, 7], [0.25, -3, 9]])
        assert degrees.to_epsg() == 4326
        with pytest.raises(InputError, match="no GeoTIFF with an EPSG"):
            _placing(Path("a.tif"), self.tags(keys=(1, 1, 0, 1, 3072, 0, 1, 32767)))
        with pytest.raises(InputError, match="does not know EPSG:9999"):
            _placing(Path("a.tif"), self.tags(keys=(1, 1, 0, 1, 3072, 0, 1, 9999)))

    def test_warped_pixels(self) -> None:
        class Same:
            def transform(self, x: Any, y: Any, direction: str = "") -> Any:
                return x, y

        pixels = np.arange(24, dtype=np.uint8).reshape(4, 6, 1) + 1
        matrix = np.array([[1.0, 0.0, 10.0], [0.0, -1.0, 20.0]])
        same = _warp(pixels, matrix, Same(), (10.0, 16.0, 16.0, 20.0))  # type: ignore[arg-type]
        np.testing.assert_array_equal(same, pixels)
        # A unit farther to the west and to the south: what is not in the image is empty.
        moved = _warp(pixels, matrix, Same(), (9.0, 15.0, 15.0, 19.0))  # type: ignore[arg-type]
        np.testing.assert_array_equal(moved[:3, 1:], pixels[1:, :5])
        assert not moved[3].any()
        assert not moved[:, 0].any()

    def test_a_picture_of_a_square_of_degrees(self, tmp_path: Path) -> None:
        """Bounds in degrees of an image in degrees: its own."""
        tags = TiffImagePlugin.ImageFileDirectory_v2()
        tags[33550], tags[33922] = (0.01, 0.01, 0.0), (0.0, 0.0, 0.0, 10.0, 50.0, 0.0)
        tags[34735] = (1, 1, 0, 1, 2048, 0, 1, 4326)
        tags.tagtype[33550] = tags.tagtype[33922] = 12
        tags.tagtype[34735] = 3
        Image.fromarray(np.full((20, 30, 3), 90, np.uint8)).save(tmp_path / "a.tif", tiffinfo=tags)
        found = local_image(tmp_path / "a.tif")
        np.testing.assert_allclose(found["bounds"], [[49.8, 10.0], [50.0, 10.3]], atol=1e-9)
        assert found["name"] == "a.tif"
        picture = Image.open(io.BytesIO(base64.b64decode(found["uri"].split(",")[1])))
        # A degree of latitude is longer on this map by 1 / cos 49.9°.
        assert picture.size == (29, 30)
        assert picture.size[0] / 30 == pytest.approx(30 * math.cos(math.radians(49.9)) / 20, rel=0.02)


class TestPage:
    def test_tables_of_a_camera(self) -> None:
        result = calibrated()
        facts, rows, correlations = camera_tables(result.camera, result, "left")
        told = dict(facts)  # type: ignore[arg-type]
        assert facts[0] == ["left", ""]
        assert told["image"] == "640 x 480 px"
        assert told["views, corners"] == "8, 336; 0 left out"
        assert told["RMS"] == f"{result.rms:.4f} px"
        assert told["solver"] == result.status.message
        by_name = {row[0]: row for row in rows[1:]}
        assert float(by_name["fx"][1]) == pytest.approx(float(result.camera.params[0]), abs=0.01)
        assert float(by_name["fx"][2]) == pytest.approx(result.sigma["fx"], rel=0.05)
        assert len(correlations) == 6
        assert camera_tables(CAMERA)[0][0] == ["camera", ""]
        assert len(camera_tables(CAMERA)) == 2

    def test_captions(self) -> None:
        assert _caption("left-views").startswith("Left camera. RMS of each view.")
        assert _caption("views").startswith("RMS of each view.")


def test_cells_of_a_gallery_have_the_image_s_shape() -> None:
    figure = FIGURES["gallery"]()
    figure.canvas.draw()
    for axes in figure.axes:
        given, used = axes.get_position(original=True), axes.get_position()
        assert used.width * used.height > 0.9 * given.width * given.height
    places = [(round(axes.get_position().y0, 2), round(axes.get_position().x0, 2)) for axes in figure.axes]
    # Two rows of four, the first above.
    assert len({y for y, _ in places}) == 2
    assert places == sorted(places, key=lambda place: (-place[0], place[1]))
    assert set(_PART_COLORS) == {"marks", "lenses", "relative pose", FAULTS}
