"""What is counted, summed and compared of a rig's solution, against SciPy, dense matrices and values by hand.

Residuals of calibrations as tables of Arrow.
"""

import dataclasses
import math

import numpy as np
import pandas
import polars
import pytest
import torch
from drawn_scenes import calibrated, landmarks_rig
from rig_scenes import CAMERAS, CENTER, NAMES, ROTATION, boards, features, landmarks, normal, see, spread_points, tensor
from torch import Tensor

from kcal import Baseline, DegenerateError, Features, Landmarks, MeasuredPosition
from kcal.calibrate.rig.assess import _advice, _Targets
from kcal.calibrate.rig.contradictions import Part, _test
from kcal.calibrate.rig.explanations import least_redundancy, redundancy, refuse_exact
from kcal.calibrate.rig.motion import CameraRows, summed_products
from kcal.calibrate.rig.problem import RigProblem, RigSolution, _of_item, least
from kcal.calibrate.rig.source import (
    Block,
    Context,
    ItemSource,
    Measurement,
    RigState,
    Start,
    as_items,
    first_rays,
    typical_ratio,
)
from kcal.calibrate.rig.unknowns import _moving, held
from kcal.checks import chi2_quantile
from kcal.lens import vector_from_rotation
from kcal.rig import planned_rig
from kcal.watch.turned import drift_of_turns


def block_of(source: ItemSource, anchor: Tensor | None = None) -> Block:
    """The rows of all its items; sources do not look at the state."""
    cameras = CAMERAS[: source.pixels.shape[1]]
    given = Context(cameras, None, held(cameras), CENTER.mean(0) if anchor is None else anchor)  # type: ignore[arg-type]
    return source.block(torch.ones(len(source.names), dtype=torch.bool), given)


def problem_of(
    *blocks: Block, terms: tuple[Measurement, ...] = (), loose: tuple[bool, ...] = (True, True)
) -> RigProblem:
    cameras = CAMERAS[: len(loose)]
    return RigProblem(cameras, list(blocks), terms, held(cameras), list(loose), list(loose))


def landmark_block(*missing: tuple[int, int], count: int = 4) -> Block:
    marks = landmarks(count=count, cameras=2)
    for item, camera in missing:
        marks.pixels[item, camera] = torch.nan
    return block_of(marks)


def feature_block(*missing: tuple[int, int], known: bool = False, cameras: int = 2) -> Block:
    far = features(count=4, cameras=cameras)
    for item, camera in missing:
        far.pixels[item, camera] = torch.nan
    sigma = torch.full((4,), 1e-6 if known else math.inf).double()
    return block_of(dataclasses.replace(far, inverse_range_sigma=sigma))


class TestRedundancy:
    def test_landmarks(self) -> None:
        """Two numbers a mark, six of a pose: four landmarks leave two over, three none."""
        assert redundancy(problem_of(landmark_block())) == [2, 2]
        assert redundancy(problem_of(landmark_block((0, 1)))) == [2, 0]
        assert least_redundancy(problem_of(landmark_block((0, 1)))) == 0
        assert redundancy(problem_of(landmark_block(), loose=(False, True))) == [None, 2]

    def test_features(self) -> None:
        """One number where another camera sees it, two where its range is known; none that nobody else sees."""
        assert redundancy(problem_of(feature_block())) == [4 - 6, 4 - 6]
        assert redundancy(problem_of(feature_block((1, 0)))) == [3 - 6, 3 - 6]
        assert redundancy(problem_of(feature_block(known=True))) == [8 - 6, 8 - 6]
        # Of three cameras, each adds two numbers to what the other two have.
        assert redundancy(problem_of(feature_block(cameras=3), loose=(True, True, True))) == [8 - 6] * 3

    def test_boards_and_what_was_measured(self) -> None:
        shown = boards(count=2, cameras=2)
        shown.pixels[1, 1] = torch.nan
        assert redundancy(problem_of(block_of(shown))) == [2 * 42 - 6, 2 * 42 - 6]
        terms = (
            Baseline(first=0, second=1, length=10.0, sigma=0.01),
            MeasuredPosition(camera=1, point=CENTER[1], sigma=tensor(0.1, 0.1, 0.1)),
        )
        assert redundancy(problem_of(landmark_block(), terms=terms)) == [2 + 1, 2 + 1 + 3]

    def test_what_is_exact_is_refused(self) -> None:
        refuse_exact(problem_of(landmark_block()), NAMES[:2], 4)
        with pytest.raises(DegenerateError, match="where the cameras stand exactly: nothing"):
            refuse_exact(problem_of(landmark_block()), NAMES[:2], 0)


class TestStatistics:
    def test_what_is_typical(self) -> None:
        """Median of chi-squared over what it should be, of those with freedom and a number; one for fewer than four."""
        freedom = torch.tensor([2, 2, 2, 2, 0, 2])
        squares = chi2_quantile(torch.tensor([2.0]), 0.5) * tensor(1.0, 3.0, 9.0, 5.0, 99.0, math.inf)
        assert typical_ratio(squares, freedom) == pytest.approx(3.0)
        assert typical_ratio(squares[1:], freedom[1:]) == 1.0

    def test_least_squares_of_products(self) -> None:
        rows, right = normal((9, 3), 1), normal((9,), 2)
        both = torch.cat([rows, right[:, None]], 1)
        found = least(both.T @ both)
        best = np.linalg.lstsq(rows.numpy(), -right.numpy(), rcond=None)[0]
        np.testing.assert_allclose(found.step, best)
        assert found.chi2 == pytest.approx(float(((rows.numpy() @ best + right.numpy()) ** 2).sum()))
        assert found.rank == 3
        torch.testing.assert_close(found.root @ found.root.T, torch.linalg.inv(rows.T @ rows))
        rows[:, 2] = 2.0 * rows[:, 0]
        both = torch.cat([rows, right[:, None]], 1)
        assert least(both.T @ both).rank == 2

    def part(self, value: float, sigma: float, count: int = 1) -> Part:
        """One unknown, measured so many times."""
        row = tensor(1.0 / sigma, -value / sigma)
        return Part("", count * torch.outer(row, row), count, None)

    def test_one_source_against_another(self) -> None:
        """Two measurements five apart with a sigma of one each: 25 / 2, and the root of it in standard deviations."""
        nothing = Part("", torch.zeros(2, 2).double(), 0, None)
        parts = [self.part(0.0, 1.0), self.part(5.0, 1.0)]
        test = _test(parts, (1,), (0, 1), nothing)
        assert (test.freedom, test.chi2, test.sigmas) == (1, pytest.approx(12.5), pytest.approx(math.sqrt(12.5)))
        # What is known beforehand counts among the others.
        assert _test(parts, (1,), (0, 1), self.part(0.0, 0.5)).chi2 == pytest.approx(25.0 / (1.0 + 1.0 / 5.0))
        assert _test(parts, (1,), (1,), nothing) == (0.0, 0, 0.0)
        # Two unknowns at once, by Wilson and Hilferty.
        rows = [torch.cat([torch.eye(2), -torch.tensor([[a], [b]])], 1).double() for a, b in ((0.0, 0.0), (3.0, 4.0))]
        two = [Part("", r.T @ r, 2, None) for r in rows]
        pair = _test(two, (0,), (0, 1), Part("", torch.zeros(3, 3).double(), 0, None))
        assert (pair.freedom, pair.chi2) == (2, pytest.approx(12.5))
        # Chance exceeds 12.5 as seldom as 2.9 standard deviations of a normal variable: exp(-6.25) = .0019.
        assert pair.sigmas == pytest.approx(2.89, abs=0.05)

    def test_sigmas_that_are_too_small_throughout_count_by_what_residuals_are(self) -> None:
        """Twenty measurements of each source that scatter ten times as much as they say."""
        nothing = Part("", torch.zeros(2, 2).double(), 0, None)
        scatter = 10.0 * torch.linspace(-1.5, 1.5, 20).double()
        both = (torch.stack([torch.ones(20).double(), -(middle + scatter)], 1) for middle in (0.0, 4.0))
        parts = [Part("", rows.T @ rows, 20, None) for rows in both]
        test = _test(parts, (0,), (0, 1), nothing)
        variance = 2.0 * float(scatter.square().sum()) / 38.0
        assert test.chi2 == pytest.approx(16.0 / (2.0 / 20.0) / variance)


class TestRows:
    def test_products_are_those_of_all_rows(self) -> None:
        """Each camera has rows of its own, of which only some of five shared unknowns have columns."""
        parts, dense = [], []
        for camera, columns in ((0, [3, 0]), (1, [1, 3, 4]), (None, [])):
            rows = normal((4, 2 + len(columns) + 1, 7), 10 + len(columns))
            parts.append(CameraRows(camera, torch.tensor(columns, dtype=torch.long), rows))
            wide = torch.zeros(4, 2 + 5 + 1, 7).double()
            wide[:, [0, 1, *(2 + c for c in columns), -1]] = rows
            dense.append(wide)
        whole = torch.cat(dense, -1)
        found = summed_products(parts, 2, 5)
        torch.testing.assert_close(found.local, whole[:, :2] @ whole[:, :2].mT)
        torch.testing.assert_close(found.right, whole[:, :2] @ whole[:, 2:].mT)
        torch.testing.assert_close(found.total, (whole[:, 2:] @ whole[:, 2:].mT).sum(0))
        torch.testing.assert_close(found.score, (whole[:, 2:] @ whole[:, -1:].mT)[..., 0])
        # Each item by itself adds its own.
        each = [summed_products(_of_item(parts, k), 2, 5) for k in range(4)]
        torch.testing.assert_close(torch.stack([one.total for one in each]).sum(0), found.total)
        torch.testing.assert_close(torch.cat([one.local for one in each]), found.local)

    def test_directions_that_move_anything(self) -> None:
        """By a thousandth of a pixel somewhere; those of which nothing is known stay."""
        effects = torch.zeros(4, 6).double()
        effects[0, 2], effects[1, 3], effects[3, 0] = 2e-3, 9e-4, 1e-9
        kept = _moving(effects, torch.tensor([True, True, True, False]))
        assert kept.abs().tolist() == [[1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 1.0]]
        effects[2, 5] = 5.0
        assert _moving(effects, torch.tensor([True, True, True, False])).abs().T.tolist() == [
            [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
        ]  # fmt: skip

    def problem(self) -> tuple[RigProblem, RigState]:
        problem = problem_of(landmark_block())
        state = RigState(
            torch.cat([camera.params.detach() for camera in CAMERAS[:2]]), torch.zeros(0).double(), tensor(0.13)[0],
            ROTATION[:2], CENTER[:2], torch.zeros(0).double(), as_items(landmarks(count=4).points),
        )  # fmt: skip
        return problem, state

    def test_poses_follow_the_unknowns(self) -> None:
        """Relative pose, center and turn about the world's axes, by steps of each unknown."""
        problem, state = self.problem()
        solution = RigSolution(problem, state)
        relative, mounting = solution.relative_rows(0, 1), solution.mounting_rows(1)

        def after(step: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            moved = problem.retract(state, (step, torch.zeros(4, 6).double()))
            turn = moved.rotation[1] @ moved.rotation[0].T
            return turn, moved.rotation[1] @ (moved.center[0] - moved.center[1]), moved.rotation[1], moved.center[1]

        begin = after(torch.zeros(problem.shared_size).double())
        for k in range(problem.shared_size):
            step = 1e-6 * torch.eye(problem.shared_size).double()[k]
            turn, shift, own, center = after(step)
            torch.testing.assert_close(
                relative[:3, k], vector_from_rotation(turn @ begin[0].T) / 1e-6, rtol=0, atol=1e-5
            )
            torch.testing.assert_close(relative[3:, k], (shift - begin[1]) / 1e-6, rtol=0, atol=1e-4)
            torch.testing.assert_close(mounting[:3, k], (center - begin[3]) / 1e-6, rtol=0, atol=1e-6)
            # world_from_camera turns about the world's axes.
            about = vector_from_rotation(own.T @ begin[2]) / 1e-6
            torch.testing.assert_close(mounting[3:6, k], about, rtol=0, atol=1e-5)
        assert not bool(mounting[6].any())

    def test_first_rays_lead_to_the_things(self) -> None:
        """From the anchor, at their ranges; of the first camera that has a mark, and up without one."""
        far = features(count=3, cameras=2)
        start = Start(rotation=ROTATION[:2], center=CENTER[:2])
        pixels = far.pixels.clone()
        pixels[1, 0], pixels[2] = torch.nan, torch.nan
        anchor = CENTER[:2].mean(0)
        direction = first_rays(CAMERAS[:2], start, pixels, far.inverse_range, anchor)
        for k in (0, 1):
            place = anchor + direction[k] / far.inverse_range[k]
            camera = (0, 1)[k]
            seen, _ = CAMERAS[camera].project((place - CENTER[camera])[None] @ ROTATION[camera].T)
            assert seen[0].tolist() == pytest.approx(far.pixels[k, camera].tolist(), abs=0.02)
        assert direction[2].tolist() == [0.0, 0.0, 1.0]


class TestOpen:
    def test_what_matches_alone_leave_open_has_its_name(self) -> None:
        """Things of unknown range tell how two cameras stand but for the scale; without a frame, not where they are."""
        points = spread_points(8, 60.0, 900.0, 9)
        far = Features(
            names=tuple("abcdefgh"),
            pixels=torch.stack([see(points, c) for c in (0, 1)], 1),
            inverse_range=torch.zeros(8).double(),
            inverse_range_sigma=torch.full((8,), math.inf).double(),
        )
        anchor = CENTER.mean(0)
        block = block_of(far, anchor)
        towards = points - anchor
        length = towards.norm(dim=-1)
        state = TestRows().problem()[1]._replace(items=as_items(towards / length[:, None], 1.0 / length[:, None]))
        held_first = RigSolution(problem_of(block, loose=(False, True)), state, 4.0)
        scale = "the scale (how far apart the cameras stand)"
        assert held_first.open_directions(NAMES[:2], absolute=False) == (scale,)
        free = RigSolution(problem_of(block), state, 1.0).open_directions(NAMES[:2], absolute=True)
        assert free[:6] == (
            "where the rig stands (east)", "where the rig stands (north)", "where the rig stands (up)",
            "the heading (a turn about the vertical)", "a turn of the rig about its baseline", scale,
        )  # fmt: skip
        assert len(free) == 7
        # How the second camera is turned is known, where it stands is not: along the baseline alone.
        relative = held_first.relative_rows(0, 1)
        covariance, known = held_first.of(relative)
        assert known.tolist() == [True] * 3 + [False] * 3
        assert bool(torch.isinf(covariance.diagonal()[3:]).all())
        narrow = RigSolution(held_first.problem, state).of(relative)[0]
        torch.testing.assert_close(covariance[:3, :3], 4.0 * narrow[:3, :3])
        assert held_first.half_of(relative) is None
        variances = held_first.variances(relative)
        torch.testing.assert_close(variances[:3], covariance.diagonal()[:3])
        assert bool(torch.isinf(variances[3:]).all())


class TestWeak:
    def test_between_three_ranges_is_a_parabola(self) -> None:
        def half(q: float) -> Tensor:
            return tensor([1.0 + 2.0 * q - 3.0 * q * q, q])

        targets = _Targets(torch.zeros(1, 3), 0.4, torch.stack([half(0.0), half(0.2), half(0.4)]), torch.zeros(1))
        for q in (0.0, 0.1, 0.2, 0.33, 0.4):
            torch.testing.assert_close(targets.at(tensor(q)), half(q))

    @pytest.mark.parametrize(("extent", "words"), [
        ((30.0, 25.0, 20.0), "nearer and spread over the image"), ((300.0, 35.0, 30.0), "nearly in one line"),
        ((300.0, 50.0, 30.0), "nearer and spread"), ((300.0, 200.0, 15.0), "nearly in one plane"),
        ((300.0, 200.0, 25.0), "nearer and spread"), ((9.0, 8.0, 7.0), "close together"),
    ])  # fmt: skip
    def test_what_landmarks_have_in_common(self, extent: tuple[float, float, float], words: str) -> None:
        """100 m away; by their extents along three axes."""
        corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0]).double()] * 3) * tensor(*extent)
        middle = CENTER[0] + 100.0 * ROTATION[0, 2]
        pixels = torch.zeros(8, 2, 2).double()
        marks = block_of(Landmarks(names=tuple("abcdefgh"), points=corners, sigma=corners.abs(), pixels=pixels))
        state = TestRows().problem()[1]._replace(items=as_items(corners + middle))
        assert words in _advice(problem_of(marks), state)
        assert _advice(problem_of(feature_block()), TestRows().problem()[1]).startswith(
            "Add surveyed landmarks, or measure"
        )


class TestTurns:
    def test_what_a_turn_of_both_cameras_does(self) -> None:
        """Both alike: none beside each other, but for the baseline that is taken along."""
        rig = planned_rig()
        turns = 1e-4 * tensor(1.0, 2.0, 3.0, 1.0, 2.0, 3.0)
        spread = torch.diag(tensor(1.0, 4.0, 9.0, 1.0, 1.0, 1.0)) * 1e-10
        found = drift_of_turns(rig, turns, spread, torch.eye(3).double())
        torch.testing.assert_close(found.relative, torch.zeros(3).double(), rtol=0, atol=1e-12)
        torch.testing.assert_close(found.relative_covariance, torch.diag(tensor(2.0, 5.0, 10.0)) * 1e-10)
        assert not found.significant
        assert found.chi2 == pytest.approx(0.0, abs=1e-6)
        x, y, z = rig.right_from_left_translation.tolist()
        slope = tensor([0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0])
        torch.testing.assert_close(found.pose_covariance[3:, 3:], 1e-10 * slope @ slope.T)
        for size, significant in ((3.9, False), (4.2, True)):
            told = drift_of_turns(rig, tensor(0.0, 0.0, 0.0, 0.0, size * math.sqrt(5e-10), 0.0), spread)
            assert told.chi2 == pytest.approx(size**2, rel=1e-6)
            assert told.significant is significant
            assert told.cam_from_local is None


def test_items_of_a_rig_are_rows() -> None:
    result = landmarks_rig()
    ours, theirs = polars.DataFrame(result), pandas.DataFrame.from_arrow(result)
    assert ours["name"].to_list() == list(theirs["name"]) == [item.name for item in result.items]
    assert ours["used"].to_list() == [item.used for item in result.items]
    assert False in ours["used"].to_list()
    assert ours["sigmas"].to_list() == [item.sigmas for item in result.items]
    pixels = zip(ours["left_px"].to_list(), ours["right_px"].to_list(), strict=True)
    assert list(pixels) == [item.pixels for item in result.items]
    assert ours["reason"].to_list() == [item.reason for item in result.items]


def test_corners_of_a_camera_have_their_residuals() -> None:
    result = calibrated()
    ours = polars.DataFrame(result)
    seen = result.residuals.isfinite().all(-1)
    assert len(ours) == int(result.observations.pixels().isfinite().all(-1).sum())
    assert ours["residual_u"].drop_nulls().to_list() == result.residuals[seen][:, 0].tolist()
    assert pandas.DataFrame.from_arrow(result)["view"].nunique() == len(result.observations.views)
