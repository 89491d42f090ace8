"""Numbers and sentences of reports: scores against a truth, tables of a verdict, what a difference means."""

import math
from typing import Any

import pytest
import torch
from locate_rigs import located_pairs

from kcal import Camera, InputError, Origin, Rig
from kcal.lens import CameraCalibration, rotation_from_vector
from kcal.lens.difference import camera_difference, difference_text
from kcal.report.pages import _correlations, _percent, _sentence, range_rows
from kcal.report.positions import plotted_ranges
from kcal.report.practice_score import score_cameras, score_rig
from kcal.report.tables import chance_text
from kcal.report.verdict import RangeAnswer, Requirement, Verdict

CAMERA = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")


def rig(yaw: float = 0.0) -> Rig:
    turn = rotation_from_vector(torch.tensor([0.0, yaw, 0.0], dtype=torch.float64))
    return Rig.pair(CAMERA, CAMERA, turn, turn @ torch.tensor([-10.0, 0.0, 0.0], dtype=torch.float64))


class TestScores:
    def truth(self) -> dict[str, Any]:
        pixels = CAMERA.grid(33, 25).reshape(-1, 2)
        rays = CAMERA.unproject(pixels)[0].tolist()
        return {"baseline_m": 10.0, "cameras": {"left": {"size": [640, 480], "pixels": pixels.tolist(), "rays": rays}}}

    def test_a_turned_camera_is_the_same(self) -> None:
        truth = self.truth()
        turn = rotation_from_vector(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
        own = truth["cameras"]["left"]
        own["rays"] = (torch.tensor(own["rays"], dtype=torch.float64) @ turn.T).tolist()
        assert score_cameras({"left": CAMERA}, truth).records[0]["largest_px"] < 1e-8

    def test_a_longer_focal_length(self) -> None:
        """One percent: pixels off by that share of their distance from the center, after no turn at all."""
        longer = Camera.build(focal=(808, 808), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        truth = self.truth()
        (found,) = score_cameras({"left": longer}, truth).records
        pixels = CAMERA.grid(33, 25).reshape(-1, 2) - torch.tensor([319.5, 239.5])
        off = 0.01 * pixels.norm(dim=-1)
        inner = (pixels.abs() < torch.tensor([160.0, 120.0])).all(-1)
        assert found["rms_px"] == pytest.approx(float(off.square().mean().sqrt()), rel=1e-6)
        assert found["largest_px"] == pytest.approx(float(off.max()), rel=1e-6)
        assert found["middle_px"] == pytest.approx(float(off[inner].square().mean().sqrt()), rel=1e-6)
        # At 5 km; and by a second camera 10 m beside.
        assert found["sideways_m"] == pytest.approx(found["rms_px"] * 5000.0 / 808.0)
        assert found["range_m"] == pytest.approx(found["rms_px"] * 5000.0**2 / (808.0 * 10.0))
        truth["cameras"]["left"]["size"] = [320, 240]
        with pytest.raises(InputError, match="images of 640x480 px, those of the site have 320x240"):
            score_cameras({"left": longer}, truth)

    def test_ranges_of_a_rig_with_a_wrong_yaw(self) -> None:
        """At 1 km a yaw of 1e-5 rad is 1 m, of 10 m of baseline; farther or nearer by its sign."""
        points = torch.tensor([[x, 0.0, math.sqrt(1e6 - x * x)] for x in (-100.0, 0.0, 100.0)], dtype=torch.float64)
        left, right = rig()(points)[0].unbind(-2)
        truth = {"pairs": [{"range_m": 1000.0, "left": left.tolist(), "right": right.tolist()}]}
        (exact,) = score_rig(rig(), truth).records
        assert exact["mean_m"] == pytest.approx(0.0, abs=1e-5)
        assert exact["rms_m"] == pytest.approx(0.0, abs=1e-5)
        assert exact["stated_m"] is None
        (off,) = score_rig(rig(1e-5), truth).records
        assert abs(off["mean_m"]) == pytest.approx(1.0, rel=0.03)
        assert off["rms_m"] == pytest.approx(abs(off["mean_m"]), rel=0.01)


class TestSentences:
    @pytest.mark.parametrize(
        ("wrong", "share", "hardly"), [(0, "64 %", False), (1, "64 %", False), (3, "7.5 %", False), (5, "0.26 %", True)]
    )
    def test_misses_and_chance(self, wrong: int, share: str, hardly: bool) -> None:
        """By the binomial distribution of 20 intervals of 95 %."""
        points = torch.tensor([[0.0, 0.0, 500.0]] * 20, dtype=torch.float64)
        left, right = rig()(points)[0].unbind(-2)
        found = located_pairs(rig(), left, right, origin=Origin(lat=19.0, lon=72.0, height=0.0), heading_deg=0.0)
        true = points[:, [0, 2, 1]]
        true[:wrong] *= 2.0
        text = chance_text(found, true)
        assert text.startswith(f"The true range is inside {20 - wrong} of 20 intervals. Of 20 intervals of 95 %, ")
        assert f"or more miss in {share} of all runs." in text
        assert ("Chance hardly explains that" in text) is hardly
        assert chance_text(found, torch.full_like(true, math.nan)) == "The true range is inside 0 of 0 intervals."

    def test_a_difference_in_words(self) -> None:
        other = Camera.build(focal=(802, 802), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        lines = difference_text(camera_difference(CAMERA, other))
        assert lines[0].startswith("difference at infinity: RMS ")
        assert "and a shift by" not in lines[1]
        assert lines[-1].startswith("no error bars in either file")
        near = difference_text(camera_difference(CAMERA, other, at=2.0))
        assert near[0].startswith("difference at 2.00 m") or near[0].startswith("difference at 2 m")
        assert "and a shift by" in near[1]
        for sigma, verdict in (
            (4.0, "no difference beyond the error bars of the first camera alone, σ "),
            (0.1, "a difference beyond the error bars of the first camera alone, σ "),
        ):
            known = [Camera(one.params, size=one.size, model=one.model) for one in (CAMERA, other)]
            focal = torch.diag(torch.tensor([1.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64))
            known[0].calibration = CameraCalibration(covariance=sigma**2 * focal)
            lines = difference_text(camera_difference(known[0], known[1]))
            assert "error bars of the first camera alone" in lines[-1]
            assert lines[-1].startswith(verdict)
        known[1].calibration, known[0].calibration = known[0].calibration, None
        assert "error bars of the second camera alone" in difference_text(camera_difference(*known))[-1]
        known[0].calibration = known[1].calibration
        assert "error bars of both cameras" in difference_text(camera_difference(*known))[-1]

    def test_correlations(self) -> None:
        """The five strongest but those of parameters that are held equal."""
        covariance = torch.diag(torch.tensor([4.0, 4.0, 1.0, 9.0, 0.0])).double()
        covariance[0:2, 2] = covariance[2, 0:2] = -1.0
        covariance[2, 3] = covariance[3, 2] = 0.75
        for covariance[0, 1] in (4.0, -4.0):
            covariance[1, 0] = covariance[0, 1]
            rows = _correlations(CAMERA, covariance)
            assert rows[1:4] == [["fx, cx", "-0.500"], ["fy, cx", "-0.500"], ["cx, cy", "+0.250"]]
            assert len(rows) == 6
            assert not any("skew" in row[0] for row in rows)

    def test_what_is_required_and_what_was_found(self) -> None:
        need = Requirement(distance=1000.0, meters=50.0), Requirement(distance=5000.0, meters=10.0)
        parts = {"lenses": 30.0, "marks": 40.0}, {"lenses": math.inf, "marks": 40.0}
        answers = tuple(RangeAnswer(requirement=a, parts=b) for a, b in zip(need, parts, strict=True))
        assert range_rows(Verdict(subject="left", answers=answers)) == [
            ["range", "answer", "required σ", "σ", "lenses", "marks"],
            ["1 km", "yes", "50 m", "50 m", "30 m", "40 m"],
            ["5 km", "no", "10 m", "not known", "not known", "40 m"],
        ]
        smaller = RangeAnswer(requirement=need[0], parts={"lenses": 30.0, "marks": 0.0})
        assert range_rows(Verdict(subject="left", answers=(smaller,)))[1][2:4] == ["50 m", "30 m"]

    def test_texts(self) -> None:
        assert [_percent(value) for value in (0.123, 12.34, 99.6, 100.0, 1234.4)] == [
            "0.12 %", "12 %", "1e+02 %", "100 %", "1234 %",
        ]  # fmt: skip
        assert _sentence("a word.") == "A word."
        with pytest.raises(InputError, match="two"):
            plotted_ranges([100.0])
