"""Faults that no residual shows: nothing left over, several solutions or explanations, a source that contradicts."""

import dataclasses
import math
import re

import pytest
import torch
from rig_scenes import CAMERAS, CENTER, NAMES, ROTATION, boards, features, landmarks, normal, see, spread_points, tensor
from torch import Tensor

from kcal import (
    Baseline,
    DegenerateError,
    Features,
    InputError,
    Landmarks,
    MeasuredPosition,
    RigData,
    RigOptions,
    solve_rig,
)
from kcal.calibrate.rig import assess
from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.contradictions import contradicting_source
from kcal.calibrate.rig.initial_poses import first_poses
from kcal.calibrate.rig.problem import RigSolution
from kcal.calibrate.rig.unknowns import held
from kcal.report import rig_verdict
from kcal.solve import LMOptions

APART = float((CENTER[0] - CENTER[1]).norm())
STRAIGHT = RigOptions(refraction=0.0, refraction_sigma=0.0)
KEPT = dataclasses.replace(STRAIGHT, reject=False)


def data(**sources: object) -> RigData:
    return RigData(cameras=CAMERAS[:2], names=NAMES[:2], **sources)  # type: ignore[arg-type]


def marked(*, seed: int = 0, **options: int) -> Landmarks:
    return landmarks(noise=0.1, error=0.02, seed=seed, **options)


def baseline(length: float = APART, sigma: float = 0.005) -> tuple[Baseline, ...]:
    return (Baseline(first=0, second=1, length=length, sigma=sigma),)


def positions(off: Tensor | None = None, sigma: float = 0.02) -> tuple[MeasuredPosition, ...]:
    """Of both cameras with noise; `off` (2, 3) meters from where they are."""
    places = CENTER[:2] + sigma * normal((2, 3), 77) + (0.0 if off is None else off)
    spread = torch.full((3,), sigma, dtype=torch.float64)
    return tuple(MeasuredPosition(camera=c, point=places[c], sigma=spread) for c in (0, 1))


def adjusted(sources: RigData) -> tuple[Adjustment, Tensor]:
    """A plain solution of everything."""
    work = Adjustment(sources, first_poses(sources, LMOptions()).starts[0], held(sources.cameras), 0.1)
    masks = ~work.none()
    work.solve(masks, LMOptions(residual_floor=1e-8))
    return work, masks


class TestRedundancy:
    def test_three_landmarks_are_refused_and_what_is_missing_is_told(self) -> None:
        told = r"left and right stand exactly \(3 landmarks.*at least one more survey"
        with pytest.raises(DegenerateError, match=told):
            solve_rig(data(landmarks=marked(count=3)), STRAIGHT)
        marks = marked()
        marks.pixels[3:, 1] = math.nan
        with pytest.raises(DegenerateError, match=r"determine where right stands exactly \(3 landmarks;"):
            solve_rig(data(landmarks=marks), STRAIGHT)

    def test_boards_are_redundancy_enough(self, monkeypatch: pytest.MonkeyPatch) -> None:
        # No other places are tried where boards tie the cameras.
        monkeypatch.setattr(assess, "_other_places", None)
        found = solve_rig(data(landmarks=marked(count=3), boards=boards(noise=0.1)), STRAIGHT)
        assert found.left_out == ()
        assert float((found.center[1] - found.center[0]).norm()) == pytest.approx(APART, abs=0.05)


class TestSeveralSolutions:
    @pytest.mark.slow
    def test_three_landmarks_and_a_baseline_begin_everywhere(self) -> None:
        """Of up to four places of each camera, the baseline tells which ones belong together."""
        for seed in range(2):
            found = solve_rig(data(landmarks=marked(count=3, seed=seed), baselines=baseline()), STRAIGHT)
            assert float((found.center - CENTER[:2]).norm(dim=-1).max()) < 1.0

    def test_other_places_that_fit_alike_are_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Three landmarks in each camera fit in several places; that nothing checks them is taken out here."""
        monkeypatch.setattr("kcal.calibrate.rig.explanations.refuse_exact", lambda *_: None)
        monkeypatch.setattr("kcal.calibrate.rig.assess.check_places", lambda *_, **__: (1.0, []))
        # On a circle around the cameras' axis, so that the other places are real ones.
        around = tensor([30.0, 0, 0], [-14, 24, 2], [-16, -25, -3])
        marks = landmarks(count=3)
        points = CENTER[:2].mean(0) + (around + tensor(0.0, 0.0, 150.0)) @ ROTATION[0]
        pixels = torch.stack([see(points, c) for c in (0, 1)], 1)
        with pytest.raises(
            DegenerateError, match=r"do not tell where the cameras stand: right may be .* m or .* m from"
        ):
            solve_rig(data(landmarks=dataclasses.replace(marks, points=points, pixels=pixels)), STRAIGHT)


class TestExplanations:
    @pytest.mark.parametrize("wrong", [0, 3])
    def test_of_five_landmarks_the_wrong_one_alone_is_left_out(self, wrong: int) -> None:
        marks = marked(count=5)
        marks.points[wrong] += tensor(0.6, 0.8, 0.0)
        assert [item.name for item in solve_rig(data(landmarks=marks), STRAIGHT).left_out] == [f"post {wrong}"]

    def test_explanations_of_equal_worth_are_all_named(self) -> None:
        """The farthest of five: without another one the rest agrees as well."""
        marks = marked(count=5)
        marks.points[4] += tensor(0.6, 0.8, 0.0)
        told = r"the data do not tell what: all the rest agrees without landmark post 4 \(χ² .*\); or landmark post 0"
        with pytest.raises(InputError, match=told):
            solve_rig(data(landmarks=marks), STRAIGHT)

    def test_of_four_landmarks_none_is_left_out(self) -> None:
        """Three fit anything."""
        marks = marked(count=4)
        marks.points[3] += tensor(0.6, 0.8, 0.0)
        with pytest.raises(
            InputError, match=r"too few are left to check it with \(4 landmarks; worst: landmark post 3\)"
        ):
            solve_rig(data(landmarks=marks), STRAIGHT)

    def test_a_wrong_baseline_does_not_make_a_landmark_wrong(self) -> None:
        """Either it is named, or both explanations are."""
        for seed in range(3):
            sources = data(landmarks=marked(seed=seed), baselines=baseline(1.01 * APART, 0.001))
            with pytest.raises(InputError, match="the baseline left to right"):
                solve_rig(sources, STRAIGHT)


class TestContradictions:
    def test_a_baseline_is_named_with_numbers(self) -> None:
        sources = data(landmarks=marked(), boards=boards(noise=0.1), baselines=baseline(1.01 * APART, 0.001))
        told = (
            r"baseline left to right contradicts the boards and the landmarks: 10\.1\d* ± 0\.001 m was stated, and wit"
        )
        with pytest.raises(InputError, match=told):
            solve_rig(sources, STRAIGHT)

    def test_a_position_and_all_positions(self) -> None:
        marks = {"landmarks": marked(), "baselines": baseline()}
        with pytest.raises(InputError, match=r"the position of left contradicts .* the camera stands 0\.\d+ ± 0\.0"):
            solve_rig(data(**marks, positions=positions(tensor([0.15, 0.1, 0.05], [0.0, 0, 0]))), STRAIGHT)
        # So far off that good landmarks would have to go.
        with pytest.raises(InputError, match="the position of left contradicts the rest, which agrees otherwise"):
            solve_rig(data(**marks, positions=positions(tensor([0.3, 0.2, 0.1], [0.0, 0, 0]))), STRAIGHT)
        with pytest.raises(InputError, match="the measured positions contradict the landmarks and the baseline"):
            solve_rig(data(**marks, positions=positions(tensor([0.3, 0.2, 0.1], [0.3, 0.2, 0.1]))), STRAIGHT)

    def test_sources_that_support_themselves_are_both_doubted_and_the_verdict_is_no(self) -> None:
        """A board whose squares are one percent larger than stated makes the baseline shorter."""
        shown = boards(noise=0.05)
        small = dataclasses.replace(shown, board=shown.board.model_copy(update={"square": 0.396}))
        found = solve_rig(data(landmarks=marked(), boards=small), STRAIGHT)
        (text,) = found.contradictions
        assert "contradict" in text
        assert "it may as well be the" in text
        assert text in found.warnings
        rig = found.stereo()
        assert rig.calibration.contradictions == found.contradictions
        assert not rig_verdict(rig).usable
        assert text in {finding.text for finding in rig_verdict(rig).stops}

    def test_what_is_kept_is_told_all_the_same(self) -> None:
        found = solve_rig(data(landmarks=marked(), baselines=baseline(1.01 * APART, 0.001)), KEPT)
        assert any("the baseline left to right contradicts" in text for text in found.contradictions)

    @pytest.mark.parametrize("zoom", [1.0, 1.01])
    def test_a_lens_that_is_no_longer_as_calibrated_is_named(self, zoom: float) -> None:
        """Near features tell of lenses, and nothing of a baseline: it is not to blame alone."""
        truth = spread_points(100, 12.0, 60.0, 9)
        pixels = torch.stack([see(truth, c) for c in (0, 1)], 1)
        pixels = pixels[pixels.isfinite().all(-1).all(-1)]
        middle = CAMERAS[1].params[2:4].detach()
        pixels[:, 1] = middle + zoom * (pixels[:, 1] - middle)
        unknown = torch.zeros(len(pixels)).double(), torch.full((len(pixels),), math.inf).double()
        gables = Features(
            names=tuple(map(str, range(len(pixels)))),
            pixels=pixels + 0.1 * normal(pixels.shape, 4),
            inverse_range=unknown[0],
            inverse_range_sigma=unknown[1],
            pixel_sigma=0.1,
        )
        options = dataclasses.replace(STRAIGHT, lens_change=0.5)
        told = solve_rig(data(features=gables, baselines=baseline()), options).contradictions
        assert bool(told) == (zoom != 1.0)
        for text in told:
            assert "contradict the baseline left to right and what is known of the lenses" in text
            assert "are these the lenses" in text

    def test_a_distance_that_cannot_be_is_not_told(self) -> None:
        tape = baseline(2.0, 0.01)[0]
        assert "are 3 ± 0.01 m apart" in tape.against(tensor(100.0), tensor(1.0))
        assert "without it no distance suits the rest" in tape.against(tensor(-300.0), tensor(1.0))

    def test_good_sources_agree(self) -> None:
        for seed in range(2):
            sources = {
                "landmarks": marked(seed=seed),
                "boards": boards(noise=0.1, seed=seed),
                "features": features(noise=0.1, known=0.1, seed=seed),
            }
            found = solve_rig(data(**sources, baselines=baseline(), positions=positions()), STRAIGHT)
            assert found.contradictions == ()
            assert found.warnings == ()

    def test_the_difference_is_that_of_solving_without(self) -> None:
        """To first order: χ² with the baseline, without it, and how far off it then is."""
        sources = data(landmarks=marked(), baselines=baseline(1.01 * APART, 0.005))
        whole, without = adjusted(sources), adjusted(dataclasses.replace(sources, baselines=()))
        problem, state = (whole[0].problem(whole[1]), whole[0].part(whole[1]))
        (found,) = contradicting_source(whole[0], RigSolution(problem, state), refuse=False)
        chi2 = [2.0 * float(work.problem(masks).cost(work.part(masks))) for work, masks in (whole, without)]
        sigmas = float(re.findall(r"\(([0-9.]+) standard deviations\)", found.text)[0])
        assert sigmas == pytest.approx(math.sqrt(chi2[0] - chi2[1]), rel=0.02)
