"""Joint rigs, simulated: derivatives, recovery, covariances, wrong items named, what is not determined named."""

import dataclasses
import math
from unittest.mock import Mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lenses import HYBRID, hybrid_camera, strong
from rig_scenes import (
    BOARD,
    CAMERAS,
    CENTER,
    NAMES,
    ROTATION,
    boards,
    features,
    landmarks,
    normal,
    spread_points,
    tensor,
)
from torch import Tensor

from kcal import Baseline, Camera, DegenerateError, InputError, MeasuredPosition, RigData, RigOptions, solve_rig
from kcal.calibrate.rig import initial_poses, solve
from kcal.calibrate.rig import sources as board_limits
from kcal.calibrate.rig.marks import Features, inverse_range_beyond
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.source import Context, PosedCamera, RigState, Start, as_items
from kcal.calibrate.rig.unknowns import SharedUnknowns, held, joint_unknowns
from kcal.io.rig_file import RigFile, rig_to_file
from kcal.lens import CameraCalibration, rotation_from_vector, vector_from_rotation
from kcal.lens.information import CameraInformation
from kcal.solve.lm import SolverStatus

APART = float((CENTER[0] - CENTER[1]).norm())
BASELINE = (Baseline(first=0, second=1, length=APART, sigma=0.005),)


# Simulated light goes straight.
STRAIGHT = RigOptions(refraction=0.0, refraction_sigma=0.0)


def data(count: int = 2, **sources: object) -> RigData:
    return RigData(cameras=CAMERAS[:count], names=NAMES[:count], **sources)  # type: ignore[arg-type]


def positions(count: int, sigma: float = 0.02) -> tuple[MeasuredPosition, ...]:
    return tuple(
        MeasuredPosition(camera=c, point=CENTER[c], sigma=torch.full((3,), sigma).double()) for c in range(count)
    )


def off(found: RigResult) -> float:
    """Largest error: radians of any camera, meters of any center; relative ones where nothing is absolute."""
    rotation, center = ROTATION[: len(found.names)], CENTER[: len(found.names)]
    if not found.absolute:
        rotation, center = rotation @ ROTATION[0].T, (center - CENTER[0]) @ ROTATION[0].T
    turn = vector_from_rotation(found.rotation @ rotation.transpose(-1, -2))
    return max(float(turn.abs().max()), float((found.center - center).abs().max()))


def pose_error(found: RigResult) -> Tensor:
    """(6,) of the relative pose, as `kcal.lens.pose.apply_twist` counts it."""
    rotation = ROTATION[1] @ ROTATION[0].T
    rig = found.stereo()
    shift = rig.right_from_left_translation - ROTATION[1] @ (CENTER[0] - CENTER[1])
    return torch.cat([vector_from_rotation(rig.right_from_left_rotation @ rotation.T), shift])


def mixed_problem() -> tuple[RigProblem, RigState]:
    """Every kind of residual, away from the solution; cameras partly free, one corner unseen."""
    marks = landmarks(count=4, cameras=3, noise=0.3)
    far = features(count=4, cameras=3, noise=0.3, known=0.2)
    shown = boards(count=2, cameras=3, noise=0.2)
    shown.pixels[1, 1, 3] = torch.nan
    skewed = torch.linalg.inv(torch.eye(2, dtype=torch.float64) / 0.3 + tensor([0.0, 0.7], [0.2, 0.0]))
    far, shown = (
        dataclasses.replace(one, covariance=(skewed @ skewed.T).expand(*one.pixels.shape, 2)) for one in (far, shown)
    )
    far.inverse_range_sigma[1] = math.inf
    anchor = CENTER.mean(0)
    # Unknowns that move two cameras at once, and all of them the board.
    maps = [1e-2 * normal((len(camera.names), 5), 11 + c) for c, camera in enumerate(CAMERAS)]
    maps[0][:4] *= 100.0
    maps[2][:] = 0.0
    maps[1][[1, 3, 5]] = 0.0
    unknowns = SharedUnknowns(
        cameras=tuple(maps),
        shapes=0.01 * normal((3, 3, len(BOARD.points)), 21),
        board=normal((3, 5), 22),
        begin=torch.zeros(5, dtype=torch.float64),
        known=torch.tensor([True, True, False, True, False]),
        labels=("",) * 5,
        by_refraction=tensor(0.0, 0.1, 0.0, 0.2, 0.3),
    )
    # Sources do not look at the state.
    given = Context(CAMERAS, None, unknowns, anchor)  # type: ignore[arg-type]
    blocks = [one.block(torch.ones(len(one.names), dtype=torch.bool), given) for one in (shown, marks, far)]
    terms = [
        Baseline(first=0, second=1, length=10.0, sigma=0.01),
        MeasuredPosition(camera=1, point=CENTER[1] + 0.1, sigma=tensor(0.1, 0.2, 0.3)),
    ]
    problem = RigProblem(CAMERAS, blocks, terms, unknowns, [True, True, False], [False, True, True])
    towards = spread_points(4, 8000.0, 40_000.0, 9) - anchor
    length = towards.norm(dim=-1)
    state = RigState(
        torch.cat([camera.params for camera in CAMERAS]),
        tensor(0.3, -0.2, 0.1, 0.5, 0.0),
        # Far beyond what there is, so that each derivative shows.
        tensor(300.0),
        ROTATION,
        CENTER,
        tensor(0.02, -0.01, 0.03),
        torch.cat(
            [
                as_items(
                    ROTATION[0].T @ rotation_from_vector(tensor([0.3, 0.1, 0.0], [0.1, -0.3, 0.1])),
                    CENTER[0] + tensor([3.0, 1.0, 20.0], [5.0, -1.0, 25.0]) @ ROTATION[0],
                ),
                as_items(marks.points + 0.01),
                as_items(towards / length[:, None], 1.0 / length[:, None]),
            ]
        ),
    )
    return problem, state


def residuals(problem: RigProblem, state: RigState, shared: Tensor, local: Tensor) -> Tensor:
    """All residuals after a step."""
    moved = problem.retract(state, (shared, local))
    found = [block.residuals(problem.posed(moved), own).flatten() for block, own in problem.parts(moved)]
    return torch.cat([*found, problem.term_rows(moved)[-1]])


class TestDerivatives:
    def test_analytic_equal_autograd_and_numeric(self) -> None:
        problem, state = mixed_problem()
        shared = torch.zeros(problem.shared_size, dtype=torch.float64)
        local = torch.zeros(sum(map(len, problem.blocks)), 6, dtype=torch.float64)
        by_shared, by_local = torch.func.jacfwd(lambda s, v: residuals(problem, state, s, v), (0, 1))(shared, local)
        rows, item, start = [], 0, 0
        for block, state_of_block in problem.parts(state):
            found = block.rows(problem.posed(state), state_of_block, problem.shared_size)
            rows.append(found[:, block.size : -1].movedim(1, -1).flatten(0, -2))
            for own in found[:, : block.size]:
                stop = start + own.shape[-1]
                torch.testing.assert_close(own.T, by_local[start:stop, item, 6 - block.size :], rtol=1e-9, atol=1e-7)
                start, item = stop, item + 1
        analytic = torch.cat([*rows, problem.term_rows(state)[:-1].T])
        torch.testing.assert_close(analytic, by_shared, rtol=1e-9, atol=1e-7)
        for k in range(problem.shared_size):
            step = 1e-6 * torch.eye(problem.shared_size, dtype=torch.float64)[k]
            ends = [residuals(problem, state, sign * step, local) for sign in (1.0, -1.0)]
            numeric = (ends[0] - ends[1]) / 2e-6
            scale = float(numeric.abs().max()) + 1.0
            torch.testing.assert_close(analytic[:, k], numeric, rtol=1e-5, atol=1e-5 * scale)

    def test_unseen_things_count_nothing(self) -> None:
        problem, state = mixed_problem()
        assert problem.blocks[0].counts.tolist() == [252, 250]
        assert problem.blocks[2].counts.tolist() == [7, 6, 7, 7]
        rows = problem.blocks[0].rows(problem.posed(state), problem.parts(state)[0][1], problem.shared_size)
        assert bool((rows[1, :, 84 + 3] == 0).all())
        assert bool((rows[1, :, 84 + 42 + 3] == 0).all())


SOURCES = {
    "landmarks": lambda n: {"landmarks": landmarks(cameras=n)},
    "boards": lambda n: {"boards": boards(cameras=n)},
    "features and positions": lambda n: {"features": features(cameras=n, known=0.01), "positions": positions(n)},
    # With a stated sigma: beside corners that seem exact to 0.001 px a position of 2 cm is rounding.
    "boards and positions": lambda n: {
        "boards": dataclasses.replace(boards(cameras=n), sigma=0.1),
        "positions": positions(n),
    },
    "all": lambda n: {
        "landmarks": landmarks(cameras=n), "features": features(cameras=n), "boards": boards(cameras=n),
        "baselines": BASELINE, "positions": positions(n)[:1],
    },
}  # fmt: skip


@pytest.mark.parametrize("distance", [0.7, 30.0, 5e3, math.inf])
def test_features_of_hybrid_cameras_are_seen_where_they_are(distance: float) -> None:
    """Their entrance pupil moves by meters, not by meters per meter of distance; slopes agree with autograd."""
    head = torch.tensor([520.0, 520.0, 325.0, 235.0, 0.0], dtype=torch.float64)
    hybrid = Camera(torch.cat([head, 0.2 * strong(HYBRID)]), size=(640, 480), model=HYBRID)
    assert float(hybrid.coefficients[1].abs()) > 1e-4
    direction = torch.nn.functional.normalize(tensor([0.3, -0.2, 1.0], [-0.5, 0.1, 1.0]), dim=-1)
    rays = direction * (1.0 if math.isinf(distance) else distance)
    pixels, valid = hybrid.project_rays(rays) if math.isinf(distance) else hybrid.project(rays)
    assert bool(valid.all())
    inverse = torch.full((2,), 1.0 / distance, dtype=torch.float64)
    origin = torch.zeros(3, dtype=torch.float64)
    sigma = torch.full((2,), 1e-3).double()
    far = Features(names=("a", "b"), pixels=pixels[:, None], inverse_range=inverse, inverse_range_sigma=sigma)
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    state = RigState(
        hybrid.params.detach(), origin[:0], tensor(0.0), torch.eye(3).double()[None], origin[None], origin[:0],
        as_items(direction, inverse[:, None]),
    )  # fmt: skip
    block = far.block(torch.ones(2, dtype=torch.bool), Context([hybrid], state, held([hybrid]), origin))
    posed = [PosedCamera(hybrid, hybrid.params.detach(), torch.eye(3).double(), origin, nothing.T[:0], None, None)]
    assert float(block.errors(posed, state).abs().max()) < 1e-9
    rows = block.rows(posed, state, 0)
    by_step = torch.func.jacfwd(
        lambda step: block.residuals(posed, state._replace(items=block.moved(state.items, step)))
    )(torch.zeros(2, 3).double())
    for i in range(2):
        torch.testing.assert_close(rows[i, :3].T, by_step[i, :, i], rtol=1e-9, atol=1e-7)


class TestRecovery:
    @pytest.mark.slow
    @pytest.mark.parametrize("count", [2, 3])
    @pytest.mark.parametrize("kind", list(SOURCES))
    def test_exact_data_give_the_truth(self, kind: str, count: int) -> None:
        found = solve_rig(data(count, **SOURCES[kind](count)), STRAIGHT)
        assert found.status in (SolverStatus.EXACT, SolverStatus.CONVERGED)
        assert found.left_out == ()
        if kind == "all":
            used = {source.name: source.used for source in found.sources}
            assert used == {"boards": 6, "landmarks": 12, "features": 20, "baselines": 1, "positions": 1}
        if kind in ("features and positions", "boards and positions") and count == 2:
            # Two measured positions leave a turn about their line open; what the cameras are to each other is known.
            assert found.undetermined == ("a turn of the rig about its baseline",)
            assert float(pose_error(found).abs().max()) < 1e-6
            assert math.isinf(float(found.mounting_covariance().diagonal().max()))
        else:
            assert found.undetermined == ()
            # Positions of three cameras in a row hold the tilt weakly: 1e-6 there, else rounding.
            assert off(found) < (1e-9 if "positions" not in kind else 1e-5)
        assert bool(torch.isfinite(found.relative_covariance()).all())

    def test_noise_shows_as_it_is(self) -> None:
        sources = {"landmarks": landmarks(noise=0.1, error=0.02), "boards": boards(noise=0.08)}
        found = solve_rig(data(**sources, features=features(noise=0.1, known=0.1)))
        assert found.sigma_corner == pytest.approx(0.08, rel=0.1)
        assert [source.sigmas for source in found.sources] == pytest.approx([1.0, 1.0, 1.0], abs=0.25)
        assert found.variance == 1.0
        assert found.warnings == ()

    def test_a_baseline_sets_the_scale_of_far_features(self) -> None:
        found = solve_rig(data(features=features(count=40, noise=0.1, known=0.1), baselines=BASELINE))
        error, sigma = pose_error(found), found.relative_covariance().diagonal().sqrt()
        assert bool((error.abs() < 4.5 * sigma).all())
        # Yaw is locked to a thousandth of a degree, while where the baseline points is hardly seen from afar.
        assert math.degrees(float(sigma[1])) < 0.002
        assert float(sigma[4:].max()) > 0.1


class TestFrame:
    @pytest.mark.slow
    @settings(max_examples=6)
    @given(turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3), shift=st.tuples(*[st.floats(-5e4, 5e4)] * 3))
    def test_the_solution_moves_with_the_frame(self, turn: tuple, shift: tuple) -> None:
        """Landmarks turned and shifted as a whole, up to 50 km: cameras follow, relative pose and sigmas stay."""
        marks = landmarks(noise=0.1, error=0.02)
        rotation, offset = rotation_from_vector(tensor(*turn)), tensor(*shift)
        moved = dataclasses.replace(marks, points=marks.points @ rotation.T + offset)
        here, there = (solve_rig(data(landmarks=each), STRAIGHT) for each in (marks, moved))
        sigma = here.relative_covariance().diagonal().sqrt()
        assert bool(((pose_error(there) - pose_error(here)).abs() < 1e-4 * sigma).all())
        torch.testing.assert_close(there.relative_covariance().diagonal().sqrt(), sigma, rtol=1e-5, atol=0)
        spread = float(here.mounting_covariance().diagonal()[:3].sqrt().min())
        assert float((there.center - (here.center @ rotation.T + offset)).abs().max()) < 1e-4 * spread + 1e-9

    def test_a_free_lens_that_landmarks_cannot_tell_is_refused_by_name(self) -> None:
        with pytest.raises(DegenerateError, match=r"how right stands from left: a mixture of .* and more could"):
            solve_rig(data(landmarks=landmarks(count=4, noise=0.1)), RigOptions(intrinsics="free"))

    def test_cameras_in_measured_places_are_held_upright_alike_at_any_scale(self) -> None:
        """Where measured positions do not quite fit, the level counts as much, however large a rig is."""
        turns = []
        for scale in (1.0, 1000.0):
            known = scale * torch.tensor([[0.0, 0, 0], [9, 0, 1], [4, 3, 0]], dtype=torch.float64)
            places = tuple(
                MeasuredPosition(
                    camera=c, point=known[c] @ ROTATION[0] + scale * normal((3,), c), sigma=torch.ones(3).double()
                )
                for c in range(3)
            )
            start = Start(rotation=rotation_from_vector(0.3 * normal((3, 3), 7)), center=known)
            initial_poses._into_frame(data(3, positions=places), start)
            turns.append(start.rotation)
        torch.testing.assert_close(turns[0], turns[1], rtol=0, atol=1e-12)


class TestHybrid:
    def test_fields_and_pupils_of_the_lenses_are_in_it(self) -> None:
        """Fields of half a pixel and wandering pupils: the rig is the true one."""
        cameras = tuple(hybrid_camera("webcam", seed) for seed in (70, 71))
        camera = cameras[0].with_parameters(
            cameras[0].params.detach().index_fill(0, torch.arange(8, len(cameras[0].names)), 0.0)
        )
        marks = landmarks(count=30)
        sides = [cameras[c].project((marks.points - CENTER[c]) @ ROTATION[c].T) for c in (0, 1)]
        plain = camera.project((marks.points - CENTER[0]) @ ROTATION[0].T)[0]
        assert float((sides[0][0] - plain).abs().max()) > 0.2
        assert bool((sides[0][1] & sides[1][1]).all())
        sources = RigData(
            cameras=cameras,
            names=NAMES[:2],
            landmarks=dataclasses.replace(marks, pixels=torch.stack([side[0] for side in sides], 1)),
        )
        found = solve_rig(sources, STRAIGHT)
        assert off(found) < 1e-9
        assert found.left_out == ()


class TestIntrinsics:
    @pytest.mark.slow
    def test_priors_and_free_parameters(self) -> None:
        # What 30 close views would leave: a few tenths of a pixel of fx, fy, cx, cy.
        spread = torch.zeros(10, dtype=torch.float64)
        spread[:4] = tensor(0.5, 0.5, 0.3, 0.3)
        rough = [camera.params + spread * normal((10,), 40 + c) for c, camera in enumerate(CAMERAS[:2])]
        cameras = tuple(
            type(camera)(values, size=camera.size, model=camera.model)
            for camera, values in zip(CAMERAS, rough, strict=False)
        )
        sources = data(landmarks=landmarks(count=30, noise=0.1, error=0.02), boards=boards(noise=0.1))
        for camera in cameras:
            camera.calibration = CameraCalibration(covariance=torch.diag(spread**2))
        sources = dataclasses.replace(sources, cameras=cameras)
        held = solve_rig(sources, RigOptions(intrinsics="fixed"))
        prior = solve_rig(sources, RigOptions(intrinsics="prior"))
        free = solve_rig(sources, RigOptions(intrinsics="free"))
        assert held.cameras == cameras
        assert prior.chi2 < held.chi2
        for c in (0, 1):
            joint = prior.joint_covariance()[10 * c : 10 * c + 10, 10 * c : 10 * c + 10].diagonal().sqrt()
            assert bool(((prior.cameras[c].params - CAMERAS[c].params)[:4].abs() < 4.5 * joint[:4]).all())
            assert bool((joint[:4] < spread[:4]).all())
            assert bool((joint[4:] == 0).all())
        # Uncertain lenses are an uncertain yaw.
        yaw = [float(found.relative_covariance()[1, 1]) for found in (held, prior, free)]
        assert yaw[0] / held.variance < yaw[1] / prior.variance < yaw[2] / free.variance

    def test_lenses_are_prepared_once_for_the_same_calibrations(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Whoever marks landmarks solves one rig again and again."""
        prepared = Mock(wraps=joint_unknowns)
        monkeypatch.setattr(solve, "joint_unknowns", prepared)
        spread = torch.diag(torch.cat([torch.full((4,), 0.3), torch.zeros(6)]).double() ** 2)
        cameras = [camera.with_parameters(camera.params) for camera in CAMERAS[:2]]
        for camera in cameras:
            camera.calibration = CameraCalibration(information=CameraInformation.from_covariance(camera.params, spread))
        sources = dataclasses.replace(data(landmarks=landmarks(count=20, noise=0.1)), cameras=tuple(cameras))
        first = solve_rig(sources)
        again = solve_rig(sources)
        assert prepared.call_count == 1
        assert again.chi2 == first.chi2
        torch.testing.assert_close(again.joint_covariance(), first.joint_covariance(), rtol=0, atol=0)
        # Another calibration of the same camera is another rig.
        doubled = CameraInformation.from_covariance(cameras[0].params, 4.0 * spread)
        cameras[0].calibration = CameraCalibration(information=doubled)
        wider = solve_rig(sources)
        assert prepared.call_count == 2
        assert float(wider.joint_covariance()[0, 0]) > 1.1 * float(first.joint_covariance()[0, 0])

    def test_marks_with_sigmas_of_their_own(self) -> None:
        """A bad mark that says so does no harm, and equal sigmas are one number."""
        known = landmarks(count=12, noise=0.1)
        one = solve_rig(data(landmarks=dataclasses.replace(known, pixel_sigma=0.1)))
        each = torch.full(known.pixels.shape[:2], 0.1, dtype=torch.float64)
        same = solve_rig(data(landmarks=dataclasses.replace(known, pixel_sigma=each)))
        torch.testing.assert_close(same.relative_covariance(), one.relative_covariance(), rtol=1e-9, atol=0)
        pixels = known.pixels.clone()
        pixels[3, 1] += 3.0
        each[3, 1] = 3.0
        found = solve_rig(data(landmarks=dataclasses.replace(known, pixels=pixels, pixel_sigma=each)))
        assert found.left_out == ()
        assert off(found) < 4
        with pytest.raises(InputError, match="one for each mark"):
            dataclasses.replace(known, pixel_sigma=each[:3])
        each[2, 0] = 0.0
        with pytest.raises(InputError, match="wherever there is a mark"):
            dataclasses.replace(known, pixel_sigma=each)

    def test_a_camera_of_which_nothing_is_known_is_held_and_named(self) -> None:
        found = solve_rig(data(landmarks=landmarks()))
        assert found.cameras == CAMERAS[:2]
        assert found.exact == NAMES[:2]


class TestCovariance:
    @pytest.mark.slow
    def test_is_the_spread(self) -> None:
        """20 rigs: the sum of squared errors in sigmas is χ² with 120 degrees of freedom, ± 4 of its deviations."""
        total = [0.0, 0.0]
        for seed in range(0, 20_000, 1000):
            marks = landmarks(noise=0.1, error=0.02, seed=seed)
            found = solve_rig(data(landmarks=marks, baselines=BASELINE), STRAIGHT)
            assert found.left_out == ()
            turn = vector_from_rotation(found.rotation[0].T @ ROTATION[0])
            errors = pose_error(found), torch.cat([found.center[0] - CENTER[0], turn])
            covariances = found.relative_covariance(), found.mounting_covariance()[:6, :6]
            for k, (error, covariance) in enumerate(zip(errors, covariances, strict=True)):
                total[k] += float(error @ torch.linalg.solve(covariance, error))
        # Of the baseline's length the truth is given here, not a draw: at most one degree of freedom in six is smaller.
        assert 100 - 4 * (2 * 100) ** 0.5 < total[0] < 120 + 4 * (2 * 120) ** 0.5
        assert 120 - 4 * (2 * 120) ** 0.5 < total[1] < 120 + 4 * (2 * 120) ** 0.5

    def test_sigmas_that_are_too_small_widen_the_covariance(self) -> None:
        marks = landmarks(count=16, noise=0.1, error=0.02)
        honest = solve_rig(data(landmarks=marks))
        boast = solve_rig(data(landmarks=dataclasses.replace(marks, pixel_sigma=0.02, sigma=marks.sigma / 5)))
        assert next(one.sigmas for one in boast.sources if one.name == "landmarks") > 3
        assert any("the landmarks differ from each other by" in text for text in boast.warnings)
        ratio = boast.relative_covariance().diagonal() / honest.relative_covariance().diagonal()
        assert bool(((ratio > 0.3) & (ratio < 3)).all())


class TestWrong:
    def test_a_wrong_landmark_is_named_and_left_out(self) -> None:
        marks = landmarks(noise=0.1, error=0.02)
        fewer = dataclasses.replace(marks, pixels=_without(marks.pixels, 4))
        good = solve_rig(data(landmarks=fewer, baselines=BASELINE))
        marks.points[4] += tensor(0.0, 0.0, 2.0)
        found = solve_rig(data(landmarks=marks, baselines=BASELINE))
        # The baseline is not blamed for it.
        assert found.contradictions == ()
        (wrong,) = found.left_out
        assert (wrong.source, wrong.name) == ("landmarks", "post 4")
        assert "off the surveyed place by" in wrong.reason
        assert all(value is not None and value > 1 for value in wrong.pixels)
        sigma = good.relative_covariance().diagonal().sqrt()
        assert bool(((pose_error(found) - pose_error(good)).abs() < 1e-4 * sigma).all())

    def test_two_wrong_marks_and_a_wrong_match(self) -> None:
        marks, far = landmarks(noise=0.1, error=0.02), features(noise=0.1, known=0.1)
        marks.pixels[7, 1] += tensor(3.0, 2.0)
        marks.pixels[2] = marks.pixels[9]
        far.pixels[3, 1, 1] += 4.0
        found = solve_rig(data(landmarks=marks, features=far))
        assert {item.name for item in found.left_out} == {"post 7", "post 2", "peak 3"}
        seven = next(item for item in found.left_out if item.name == "post 7")
        # The record tells in which image the mark is wrong.
        assert seven.pixels[0] < 1.0 < 3.0 < seven.pixels[1]  # type: ignore[operator]
        assert bool((pose_error(found).abs() < 4.5 * found.relative_covariance().diagonal().sqrt()).all())

    def test_a_wrong_one_that_bends_the_solution_is_found(self) -> None:
        """The nearest landmark by far decides where the cameras stand: its own residual stays small."""
        marks = landmarks(noise=0.1, error=0.02)
        near = int((marks.points - CENTER[0]).norm(dim=-1).argmin())
        marks.pixels[near, 1] += tensor(1.5, -1.0)
        kept = solve_rig(data(landmarks=marks), RigOptions(reject=False))
        masked = next(item for item in kept.items if item.name == marks.names[near])
        assert masked.sigmas < 4
        assert [item.name for item in solve_rig(data(landmarks=marks)).left_out] == [marks.names[near]]

    def test_deletions_are_what_leaving_out_does(self) -> None:
        marks = landmarks(noise=0.1, error=0.02)
        whole = solve_rig(data(landmarks=marks, baselines=BASELINE), RigOptions(reject=False))
        falls = whole._solution.problem.deletions(whole._solution.state)[0]
        for i in (0, 5, 11):
            rest = data(landmarks=dataclasses.replace(marks, pixels=_without(marks.pixels, i)), baselines=BASELINE)
            without = solve_rig(rest, RigOptions(reject=False))
            assert float(falls[i]) == pytest.approx(whole.chi2 - without.chi2, rel=2e-2)

    @pytest.mark.slow
    def test_lenses_that_are_not_quite_their_models_make_no_board_wrong(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """They bend some boards more than others, by much more than corners that are this good would ever be off."""
        shown = boards(count=8, noise=0.01)
        u, v = shown.pixels.unbind(-1)
        shown.pixels[..., 1] += 0.3 * ((u - 1000.0) / 900.0).clamp_min(0.0) ** 2 * torch.sin(v / 60.0)
        assert solve_rig(data(boards=shown)).left_out == ()
        with monkeypatch.context() as without:
            for name in ("_LENS", "_BETWEEN"):
                without.setattr(board_limits, name, 0.0)
            assert len(solve_rig(data(boards=shown)).left_out) > 0
        # One that moved is found all the same.
        shown.pixels[5, 1] += tensor(1.0, 0.0)
        assert [item.name for item in solve_rig(data(boards=shown)).left_out] == ["pair 5"]

    def test_names_mixed_up_are_refused_as_a_whole(self) -> None:
        marks = landmarks(noise=0.1, error=0.02)
        with pytest.raises(InputError, match="landmarks contradict"):
            solve_rig(data(landmarks=dataclasses.replace(marks, points=marks.points.roll(5, 0)), boards=boards()))

    def test_what_was_not_rejected_widens_the_covariance(self) -> None:
        marks = landmarks(noise=0.1, error=0.02)
        marks.points[4] += tensor(0.0, 0.0, 2.0)
        found = solve_rig(data(landmarks=marks), RigOptions(reject=False))
        assert found.left_out == ()
        good = solve_rig(data(landmarks=landmarks(noise=0.1, error=0.02)))
        ratio = found.relative_covariance().diagonal() / good.relative_covariance().diagonal()
        assert bool((ratio > 5).all())


class TestNotDetermined:
    @pytest.mark.parametrize(
        ("sources", "message"),
        [
            ({"features": features(known=0.1)}, "nothing tells where right stands"),
            (
                {"features": features(noise=0.1, known=0.1), "positions": positions(1)},
                "nothing tells where right stands",
            ),
            ({"landmarks": landmarks(count=2)}, "nothing tells where right stands"),
            ({"boards": None}, "nothing to solve it from"),
        ],
    )
    def test_too_little(self, sources: dict, message: str) -> None:
        with pytest.raises((DegenerateError, InputError), match=message):
            solve_rig(data(**sources))

    def test_features_of_unknown_range_leave_huge_errors_not_silence(self) -> None:
        """Epipolar geometry alone: the relative yaw hangs on what little the epipolar lines turn."""
        known = solve_rig(data(features=features(noise=0.1, known=0.1), baselines=BASELINE))
        free = solve_rig(data(features=features(noise=0.1), baselines=BASELINE))
        yaw = [math.degrees(float(found.relative_covariance()[1, 1].sqrt())) for found in (known, free)]
        assert yaw[1] > 10 * yaw[0]

    def test_the_heading_is_named(self) -> None:
        found = solve_rig(data(boards=boards(), positions=positions(1)))
        assert found.undetermined[0] == "the heading (a turn about the vertical)"
        assert len(found.undetermined) == 3
        assert any("the heading" in text for text in found.warnings)
        assert float(pose_error(found).abs().max()) < 1e-8


class TestInput:
    def test_shapes_and_values(self) -> None:
        marks = landmarks()
        with pytest.raises(InputError, match="every sigma must be a positive number"):
            dataclasses.replace(marks, sigma=torch.zeros_like(marks.sigma))
        with pytest.raises(InputError, match="'post 0' is there twice"):
            dataclasses.replace(marks, names=("post 0",) * 12)
        with pytest.raises(InputError, match="pixels of 2 cameras, the rig has 3"):
            data(3, landmarks=marks)
        with pytest.raises(InputError, match="two different cameras"):
            Baseline(first=1, second=1, length=1.0, sigma=0.1)
        with pytest.raises(InputError, match="fixed, prior or free"):
            RigOptions(intrinsics="none")  # type: ignore[arg-type]

    def test_farther_than(self) -> None:
        mean, sigma = inverse_range_beyond(2000.0)
        draws = torch.rand(200_000, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) / 2000.0
        assert mean == pytest.approx(float(draws.mean()), rel=0.01)
        assert sigma == pytest.approx(float(draws.std()), rel=0.01)

    def test_marks_beyond_the_lens_are_warned_of(self) -> None:
        marks = landmarks(noise=0.1, error=0.02)
        pixels = marks.pixels.clone()
        pixels[3, 0] = tensor(9000.0, 9000.0)
        found = solve_rig(data(landmarks=dataclasses.replace(marks, pixels=pixels)))
        lost = [text for text in found.warnings if "no ray" in text] or [item.name for item in found.left_out]
        assert lost
        assert bool((pose_error(found).abs() < 4.5 * found.relative_covariance().diagonal().sqrt()).all())
        with pytest.raises(InputError, match=r"\d+ of 12 pixels lie outside the image of .*images of another size"):
            solve_rig(data(landmarks=dataclasses.replace(marks, pixels=2.0 * marks.pixels)))


def test_a_lens_that_changed_since_its_calibration() -> None:
    """Of stated size, it is found from the rig's own data, with a sigma; else an exact lens is believed."""
    off_by, sources = [], {"landmarks": landmarks(noise=0.05, survey=0.01), "features": features(noise=0.05)}
    changed = tuple(Camera(c.params * c.params.new_tensor([1.0 + 5e-4] * 2 + [1.0] * (len(c.params) - 2)),
                           size=c.size, model=c.model) for c in CAMERAS[:2])  # fmt: skip
    for size in (0.0, 0.5):
        given = dataclasses.replace(data(**sources), cameras=changed)
        found = solve_rig(given, dataclasses.replace(STRAIGHT, lens_change=size, reject=False)).stereo()
        content = rig_to_file(found).dump()
        again = RigFile.parse(content, "rig.json").calibration
        assert again is not None
        assert (again.lens_change, "lens_change" in content["calibration"]) == (size, size > 0.0)
        off_by.append(abs(float(found.left.focal[0] / CAMERAS[0].focal[0]) - 1.0))
    assert off_by[0] == pytest.approx(5e-4)
    assert off_by[1] < 2e-4
    for wrong in (-0.1, math.nan):
        with pytest.raises(InputError, match=r"lens_change .*: pixels, not negative, are needed$"):
            RigOptions(lens_change=wrong)
    with pytest.raises(InputError, match=r"lens_change 0\.1: intrinsics 'prior' are needed, got 'fixed'"):
        RigOptions(lens_change=0.1, intrinsics="fixed")


def _without(pixels: Tensor, index: int) -> Tensor:
    pixels = pixels.clone()
    pixels[index] = torch.nan
    return pixels
