"""Closed-form starts, parameters and their prior widths."""

import math
from typing import Any

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, Motions, camera, corner_pixels, motions, observe, pixels_of
from torch import Tensor

from kcal import Board, Camera, InputError
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.problem.parameters import CoefficientPrior, is_overparameterized
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import (
    Views,
    flipped_poses,
    homographies,
    poses_from_homographies,
    poses_under,
    refine_poses,
    spread_out,
    unflip,
    whitening,
)
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.camera_parameters import parameter_names
from kcal.lens.projection import project_components
from kcal.solve import LMOptions

# Closed-form starts are exact where the theory says so, without any iteration.


CENTERED = Camera.build(focal=(500, 505), center=(319.5, 239.5), size=SIZE, model="pinhole")

OFF_CENTER = Camera.build(focal=(500, 505), center=(341.5, 221.0), size=SIZE, model="pinhole")


def true_homographies(truth: Camera, poses: Motions) -> Tensor:
    rotation, translation = poses
    h = truth.matrix @ torch.cat([rotation[..., :2], translation[..., None]], -1)
    return h / h[:, 2:, 2:]


def state_of(truth: Camera, poses: Motions) -> BoardState:
    return BoardState.flat(truth.params.detach().clone(), *poses)


def test_homographies_are_exact_and_corners_that_were_not_seen_have_no_say() -> None:
    poses = motions(OFF_CENTER, 5, 1)
    expected, pixels = true_homographies(OFF_CENTER, poses), pixels_of(OFF_CENTER, poses)
    # Entries reach 1e3; the smallest eigenvector of a 9 x 9 system loses some digits.
    torch.testing.assert_close(homographies(BOARD.points, pixels), expected, rtol=1e-10, atol=1e-9)
    pixels[0, 12:] = torch.nan
    pixels[1, ::2] = torch.nan
    # Four corners of a quadrilateral are the fewest.
    pixels[2, [i for i in range(BOARD.corners) if i not in (0, 6, 35, 41)]] = torch.nan
    # Two rows of corners alone leave the last digits to rounding.
    torch.testing.assert_close(homographies(BOARD.points, pixels), expected, rtol=1e-7, atol=1e-6)


class TestSpreadOut:
    @pytest.mark.parametrize(
        ("seen", "enough"),
        [
            (range(42), True),
            (range(7), False),
            (range(8), False),
            (range(9), True),
            (range(0, 42, 7), False),
            (range(0, 41, 8), False),
            ([0, 6, 35, 41], True),
            ([0, 3, 6, 20], False),
            ([0, 6, 35], False),
            ([], False),
        ],
    )
    def test_lines(self, seen: list[int], enough: bool) -> None:
        pixels = pixels_of(CENTERED, motions(CENTERED, 2, 1))
        pixels[1, [i for i in range(42) if i not in seen]] = torch.nan
        assert spread_out(BOARD.points, pixels).tolist() == [True, enough]

    @pytest.mark.parametrize("square", [1e-6, 1e3])
    def test_size_of_the_board_does_not_matter(self, square: float) -> None:
        board = Board(columns=40, rows=3, square=square)
        pixels = torch.zeros(3, 120, 2, dtype=torch.float64)
        pixels[1, 41:] = torch.nan
        pixels[2, 42:] = torch.nan
        assert spread_out(board.points, pixels).tolist() == [True, False, True]


class TestPoses:
    @pytest.mark.parametrize("truth", [CENTERED, OFF_CENTER], ids=["centered", "off center"])
    def test_exact(self, truth: Camera) -> None:
        poses = motions(truth, 6, 2)
        # The board is in front, whatever the sign.
        for factor in (1.0, -3.0):
            homography = factor * true_homographies(truth, poses)
            rotation, translation = poses_from_homographies(homography, truth.params[:4])
            torch.testing.assert_close(rotation, poses[0], rtol=0, atol=1e-12)
            torch.testing.assert_close(translation, poses[1], rtol=0, atol=1e-12)


class TestFlippedPoses:
    def test_keeps_the_center_and_mirrors_the_tilt(self) -> None:
        rotation, translation = motions(CENTERED, 6, 5)
        twin = flipped_poses(BOARD.points, rotation, translation)
        for before, after in zip((rotation, translation), flipped_poses(BOARD.points, *twin), strict=True):
            torch.testing.assert_close(after, before, rtol=0, atol=1e-14)
        middle = BOARD.points.mean(0)
        center = rotation @ middle + translation
        torch.testing.assert_close(twin[0] @ middle + twin[1], center, rtol=0, atol=1e-14)
        identity = torch.eye(3).double().expand(6, 3, 3)
        torch.testing.assert_close(twin[0] @ twin[0].transpose(-1, -2), identity, rtol=0, atol=1e-14)
        torch.testing.assert_close(torch.linalg.det(twin[0]), torch.ones(6).double(), rtol=0, atol=1e-14)
        # The normals make the same angle with the line of sight, on opposite sides of it.
        d = center / torch.linalg.vector_norm(center, dim=-1, keepdim=True)
        before, after = rotation[..., 2], twin[0][..., 2]
        along = (before * d).sum(-1, keepdim=True)
        torch.testing.assert_close((after * d).sum(-1, keepdim=True), along, rtol=0, atol=1e-14)
        torch.testing.assert_close(after - along * d, -(before - along * d), rtol=0, atol=1e-14)

    def test_twins_look_alike_from_afar_and_ever_more_so(self) -> None:
        """Pixels of the twins differ by second order in (board / distance): a hundredth at ten times the distance."""
        board = Board(columns=7, rows=6, square=0.01)
        gaps = []
        for far in (3.0, 30.0):
            truth = Camera.build(focal=(500 * far, 505 * far), center=(319.5, 239.5), size=SIZE, model="pinhole")
            rotation = motions(CENTERED, 5, 5)[0]
            translation = torch.tensor([0.0, 0.0, far]).double() - rotation @ board.points.mean(0)
            pixels = pixels_of(truth, (rotation, translation), board=board)
            twin = flipped_poses(board.points, rotation, translation)
            gaps.append(float((pixels_of(truth, twin, board=board) - pixels).abs().max()))
        # The size of the image is the same, 30 px or so.
        assert gaps[0] < 0.5
        assert gaps[1] == pytest.approx(gaps[0] / 10, rel=0.1)


class TestUnflip:
    def test_repairs_planted_flips_and_leaves_good_poses_alone(self) -> None:
        truth = camera()
        poses = motions(truth, 12, 6, fill=0.12)
        views = Views(board_points=BOARD.points, pixels=pixels_of(truth, poses, noise=0.1))
        best, cost = refine_poses(views, truth.model, state_of(truth, poses), LMOptions())
        flipped = state_of(truth, flipped_poses(BOARD.points, best.rotation, best.translation))
        twin, worse = refine_poses(views, truth.model, flipped, LMOptions(max_iterations=1000))
        # Where the twin leads to a minimum of its own, every second of them.
        planted = worse > 1.2 * cost
        planted[planted.nonzero()[::2, 0]] = False
        assert int(planted.sum()) >= 3
        mixed = best._replace(
            rotation=torch.where(planted[:, None, None], twin.rotation, best.rotation),
            translation=torch.where(planted[:, None], twin.translation, best.translation),
        )
        repaired, changed = unflip(views, truth.model, mixed)
        assert changed == planted.nonzero()[:, 0].tolist()
        # The search stops early, within 1e-3 of the cost.
        final, _ = refine_poses(views, truth.model, repaired, LMOptions())
        torch.testing.assert_close(final.rotation, best.rotation, rtol=0, atol=1e-6)
        torch.testing.assert_close(final.translation, best.translation, rtol=0, atol=1e-6)
        _, changed = unflip(views, truth.model, repaired)
        assert changed == []

    def test_refining_poses_moves_nothing_else_and_returns_the_cost_of_each_view(self) -> None:
        truth = camera()
        poses = motions(truth, 4, 6)
        pixels = pixels_of(truth, poses)
        pixels[2] += 0.5
        state = state_of(truth, poses)
        views = Views(board_points=BOARD.points, pixels=pixels)
        refined, cost = refine_poses(views, truth.model, state, LMOptions())
        assert torch.equal(refined.parameters, state.parameters)
        assert torch.equal(refined.board, state.board)
        assert cost.shape == (4,)
        assert bool((cost[[0, 1, 3]] < 1e-18).all())
        assert float(cost[2]) > 1e-4


class TestPosesUnder:
    def test_poses_are_found_and_views_without_one_are_told(self) -> None:
        truth = camera()
        # Boards this small have twins: from closed forms alone, the first pose ends at the wrong tilt.
        poses = motions(truth, 6, 2, fill=0.04)
        pixels = pixels_of(truth, poses, noise=0.2)
        # One row of corners, and nothing at all.
        pixels[1, 7:] = torch.nan
        pixels[4] = torch.nan
        views = Views(board_points=BOARD.points, pixels=pixels)
        state, cost = poses_under(truth, views, LMOptions())
        assert cost.isnan().nonzero()[:, 0].tolist() == [1, 4]
        assert state.rotation.isnan().any(-1).any(-1).tolist() == cost.isnan().tolist()
        good = [0, 2, 3, 5]
        best, least = refine_poses(views.some(good), truth.model, state_of(truth, poses).views(good), LMOptions())
        torch.testing.assert_close(cost[good], least, rtol=1e-6, atol=0)
        torch.testing.assert_close(state.rotation[good], best.rotation, rtol=0, atol=1e-4)
        assert poses_under(truth, views.some([4]), LMOptions())[1].isnan().all()

    def test_boards_beside_a_wide_camera_have_their_poses(self) -> None:
        """At 70 to 110 degrees from the axis, where a plane in front of the camera has no place for them."""
        truth = Camera.build(focal=(150, 150), center=(320, 320), size=(640, 640), model="fisheye4")
        rotation, translation = motions(camera(), 5, 6, tilt=40.0)
        angle = torch.linspace(70.0, 110.0, 5, dtype=torch.float64).deg2rad()
        turn = rotation_from_vector(torch.stack([0 * angle, angle, 0 * angle], -1))
        middle = rotation @ BOARD.points.mean(0) + translation
        central = translation + middle.norm(dim=-1, keepdim=True) * torch.tensor([0.0, 0.0, 1.0]) - middle
        poses = turn @ rotation, (turn @ central[..., None])[..., 0]
        pixels, valid = truth.project(BOARD.points @ poses[0].transpose(1, 2) + poses[1][:, None])
        assert bool(valid.all())
        state, cost = poses_under(truth, Views(board_points=BOARD.points, pixels=pixels), LMOptions())
        assert float(cost.max()) < 1e-12
        torch.testing.assert_close(state.translation, poses[1], rtol=0, atol=1e-6)


# Parameters fixed, tied, freed and known beforehand, against a dense solution of the same problem.


VIEWS = 10

# What is said -> the unknowns as groups of names that move together; every other parameter stays.
LENS = [["k1"], ["k2"], ["p1"], ["p2"], ["k3"]]

CASES: list[tuple[dict[str, Any], list[list[str]]]] = [
    ({"fixed": {"cx": 325.0, "k3": None}}, [["fx"], ["fy"], ["cy"], *LENS[:4]]),
    ({"tied": (("fx", "fy"),)}, [["fx", "fy"], ["cx"], ["cy"], *LENS]),
    ({"free": ("skew",)}, [["fx"], ["fy"], ["cx"], ["cy"], ["skew"], *LENS]),
    ({"priors": {"fx": (502.0, 0.5), "p1": (0.0, 1e-4)}}, [["fx"], ["fy"], ["cx"], ["cy"], *LENS]),
    ({"tied": (("fx", "fy"), ("p1", "p2")), "priors": {"fy": (500.0, 1.0)}, "fixed": {"skew": 0.4}},
     [["fx", "fy"], ["cx"], ["cy"], ["k1"], ["k2"], ["p1", "p2"], ["k3"]]),
]  # fmt: skip


def scene(views: int = VIEWS) -> Tensor:
    return corner_pixels(views, 5, noise=0.1, seed=2)


def values(result: CameraCalibrationResult) -> dict[str, float]:
    return dict(zip(result.camera.names, result.camera.params.tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("options", "groups"), CASES)
def test_the_end_is_the_dense_optimum_and_sigma_its_inverse(options: dict[str, Any], groups: list[list[str]]) -> None:
    """A dense Gauss-Newton step from the result, by autograd and lstsq over the unknowns and all poses, is nothing."""
    pixels = scene()
    result = calibrate_camera(observe(pixels), CalibrationOptions(**{"model": "opencv5", **options}))
    names, model = result.camera.names, result.camera.model
    base, count = result.camera.params, len(groups)
    spread = torch.zeros(count, len(base), dtype=torch.float64)
    for k, group in enumerate(groups):
        spread[k, [names.index(name) for name in group]] = 1.0
    noise = result.rms / math.sqrt(2.0)
    priors = options.get("priors", {})

    def residuals(unknowns: Tensor) -> Tensor:
        parameters = base + unknowns[:count] @ spread
        turn, shift = unknowns[count:].reshape(VIEWS, 2, 3).unbind(1)
        rotation = rotation_from_vector(turn) @ result.cam_from_board_rotation
        points = rotation @ BOARD.points.T + (result.cam_from_board_translation + shift)[..., None]
        seen = project_components(points, parameters, model).pixels.transpose(-1, -2)
        known = [(parameters[names.index(n)] - mean) * noise / sigma for n, (mean, sigma) in priors.items()]
        return torch.cat([(seen - pixels).flatten(), *(value[None] for value in known)])

    zero = torch.zeros(count + 6 * VIEWS, dtype=torch.float64)
    r = residuals(zero)
    jacobian = torch.autograd.functional.jacobian(residuals, zero)
    scale = jacobian.norm(dim=0)
    step = torch.linalg.lstsq(jacobian / scale, -r[:, None]).solution[:, 0] / scale
    # Views that contradict each other under a wrong constraint count less; what the prior says does not.
    tempering = result.tempering or 0.0
    jacobian[len(r) - len(priors) :] *= math.sqrt(tempering)
    variance = torch.linalg.inv((jacobian / scale).T @ (jacobian / scale)).diagonal() / scale**2
    sigma = torch.sqrt(variance * (r @ r) * tempering / (len(r) - len(zero)))
    for k, group in enumerate(groups):
        assert abs(float(step[k])) < 1e-3 * float(sigma[k]), group
        for name in group:
            assert result.sigma[name] == pytest.approx(float(sigma[k]), rel=1e-4), name
    moving = {name for group in groups for name in group}
    assert {name for name, found in result.sigma.items() if found is not None} == moving
    for name, value in options.get("fixed", {}).items():
        assert values(result)[name] == (value or 0.0)
        assert name in result.fixed


def test_rules_hold_through_richer_models() -> None:
    """Over the ladder, on folded views (more than a thousand corners), with values of the last model's coefficients."""
    fixed = {"k6": 0.004, "s2": 0.0}
    options = CalibrationOptions(weak_prior=None, model="opencv12", fixed=fixed, tied=(("fx", "fy"), ("s1", "s3")))
    result = calibrate_camera(observe(scene(25)), options)
    found = values(result)
    assert (found["k6"], found["s2"]) == (0.004, 0.0)
    assert found["fx"] == pytest.approx(found["fy"], rel=1e-14)
    assert found["s1"] == pytest.approx(found["s3"], rel=1e-12)
    assert result.sigma["s1"] == result.sigma["s3"]
    assert (result.sigma["k6"], result.sigma["s2"]) == (None, None)
    whole = calibrate_camera(observe(scene(25)), CalibrationOptions(weak_prior=None, model="opencv12"))
    assert whole.rms < result.rms


@pytest.mark.parametrize("model", ["hybrid", "fisheye4"])
def test_a_wide_field_of_view_begins_equidistant(model: str) -> None:
    """A perspective image has none of 180 degrees; below 90 degrees it is as good a start."""
    for degrees in (90.0, 150.0, 180.0, 230.0):
        options = CalibrationOptions(model=model, field_of_view=degrees)
        assert options.start_focal(SIZE) == pytest.approx(SIZE[0] / math.radians(degrees))
    narrow = CalibrationOptions(model=model, field_of_view=60.0).start_focal(SIZE)
    assert narrow == pytest.approx(0.5 * SIZE[0] / math.tan(math.radians(30.0)))
    assert CalibrationOptions(model="opencv5", field_of_view=150.0).start_focal(SIZE) == pytest.approx(
        0.5 * SIZE[0] / math.tan(math.radians(75.0))
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fixed": {"f": 1.0}}, "unknown parameter 'f'"),
        ({"fixed": {"k4": 0.0}}, "opencv5 has no parameter 'k4'"),
        ({"fixed": {"cx": math.nan}}, "cannot be fixed at nan"),
        ({"fixed": {"fx": -3.0}}, "cannot be fixed at -3"),
        ({"fixed": {"cx": 3.0}, "tied": (("cx", "cy"),)}, "cx is fixed and tied"),
        ({"fixed": {"cx": 3.0}, "priors": {"cx": (3.0, 1.0)}}, "cx is fixed and given a prior"),
        ({"fixed": {"skew": 3.0}, "free": ("skew",)}, "skew is fixed and freed"),
        ({"priors": {"skew": (3.0, 1.0)}}, "skew is held at 0"),
        ({"priors": {"fx": (3.0, 0.0)}}, "positive standard deviation"),
        ({"priors": {"fx": 800}}, "prior of fx is 800; a pair"),
        ({"priors": {"fx": (800, 1, 2)}}, "a pair"),
        ({"tied": (("fx",),)}, "two parameters"),
        ({"tied": (("fx", "fy"), ("fy", "cx"))}, "fy is tied twice"),
        ({"field_of_view": 180.0}, "opencv5 has less than 180; use the hybrid lens"),
        ({"field_of_view": 360.0, "model": "hybrid"}, "field_of_view must be"),
        ({"field_of_view": 60.0, "focal": 500.0}, "give one"),
        ({"focal": -3.0}, "focal must be positive"),
    ],
)
def test_refusals(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        CalibrationOptions(**{"model": "opencv5", **options})


def test_a_focal_length_has_no_natural_value() -> None:
    with pytest.raises(InputError, match="fx has no natural value"):
        calibrate_camera(observe(scene()), CalibrationOptions(model="opencv5", fixed={"fx": None}))


@pytest.mark.parametrize("views", [1, 6])
def test_a_known_camera_leaves_only_the_poses(views: int) -> None:
    """Each pose is the dense optimum of its own view, and nothing of the camera moves."""
    truth = camera("opencv14")
    rotation, translation = motions(truth, views, 5)
    pixels = pixels_of(truth, (rotation, translation), noise=0.1, seed=2)
    result = calibrate_camera(observe(pixels), CalibrationOptions(camera=truth))
    assert torch.equal(result.camera.params, truth.params)
    assert set(result.sigma.values()) == {None}
    assert set(result.fixed) == set(truth.names)
    assert result.rms == pytest.approx(0.1 * math.sqrt(2.0), rel=0.2)
    for i in range(views):

        def residuals(pose: Tensor, i: int = i) -> Tensor:
            turned = rotation_from_vector(pose[:3]) @ result.cam_from_board_rotation[i] @ BOARD.points.T
            points = turned + (result.cam_from_board_translation[i] + pose[3:])[:, None]
            return (project_components(points, truth.params, truth.model).pixels.T - pixels[i]).flatten()

        zero = torch.zeros(6, dtype=torch.float64)
        jacobian = torch.autograd.functional.jacobian(residuals, zero)
        step = torch.linalg.lstsq(jacobian, -residuals(zero)[:, None]).solution[:, 0]
        sigma = 0.1 * torch.linalg.inv(jacobian.T @ jacobian).diagonal().sqrt()
        assert bool((step.abs() < 1e-3 * sigma).all())


def test_a_known_camera_with_a_bent_board_and_a_freed_focal_length() -> None:
    truth = camera()
    pixels = pixels_of(truth, motions(truth, 8, 5), noise=0.05, seed=2)
    result = calibrate_camera(observe(pixels), CalibrationOptions(camera=truth, free=("fx", "fy"), board_warp=True))
    sigma = result.sigma["fx"]
    assert sigma is not None
    assert 0 < abs(values(result)["fx"] - float(truth.focal[0])) < 4 * sigma
    assert values(result)["cx"] == float(truth.center[0])
    assert float(result.board_warp.abs().max()) < 1e-3


def test_a_known_camera_refuses_what_contradicts_it() -> None:
    truth = camera()
    for options in ({"fixed": {"cx": 3.0}}, {"focal": 500.0}, {"field_of_view": 60.0}):
        with pytest.raises(InputError, match="a known camera fixes all"):
            CalibrationOptions(camera=truth, **options)
    with pytest.raises(InputError, match="fx is fixed and tied"):
        CalibrationOptions(camera=truth, tied=(("fx", "fy"),))
    with pytest.raises(InputError, match="known camera is of"):
        calibrate_camera(observe(scene(), size=(641, 480)), CalibrationOptions(camera=truth))


# How wide priors of coefficients are, and how corners are weighted by their covariances.


@pytest.mark.parametrize("reach", [0.5, 0.8])
def test_each_coefficient_shifts_a_place_at_the_reach_by_the_width(reach: float) -> None:
    """Radial terms by r^(2 j + 1) of the radius, each by itself; assembly errors by a thirtieth of it."""
    model = LensModel.named("ext20")

    def sigmas(*without: str) -> dict[str, float]:
        prior = CoefficientPrior(0.3, reach).term(model, noise=0.2, without=without)
        assert prior.mean.abs().max() == 0.0
        names = [parameter_names(model)[i] for i in prior.index.tolist()]
        return dict(zip(names, (0.2 / prior.weight).tolist(), strict=True))

    sigma = sigmas()
    assert set(sigma) == set(model.names)
    for name, power in {"k1": 2, "k4": 2, "k2": 4, "k5": 4, "k3": 6, "k6": 6}.items():
        assert sigma[name] == pytest.approx(0.3 / reach**power), name
    least = {"p1": 0, "p2": 0, "tau_x": 0, "tau_y": 0, "s1": 0, "s2": 2, "s3": 0, "s4": 2, "s5": 4, "s6": 4}
    for name, power in least.items():
        assert sigma[name] == pytest.approx(0.01 / reach ** (power + 1)), name
    assert set(sigmas("k1", "p2")) == set(model.names) - {"k1", "p2"}


def test_models_with_terms_that_are_nearly_redundant() -> None:
    names = ("pinhole", "opencv4", "opencv5", "fisheye4", "opencv8", "opencv12", "opencv14")
    assert [is_overparameterized(LensModel.named(name)) for name in names] == [False] * 4 + [True] * 3


def test_corners_are_whitened_by_their_own_covariance_and_the_rest() -> None:
    """Where residuals are larger than corners say, all get the same noise more; the mean weight is one."""
    half = torch.randn(5, 4, 2, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    covariances = 0.01 * (half @ half.mT + 0.5 * torch.eye(2))
    covariances[1, 2] = torch.nan
    seen = torch.ones(5, 4, dtype=torch.bool)
    seen[1, 2] = False
    own = float(covariances[seen].diagonal(dim1=-2, dim2=-1).mean())
    for variance, more in ((own + 0.03, 0.03), (0.5 * own, 0.0)):
        found = whitening(covariances, variance)
        assert bool(found[1, 2].isnan().all())
        information = found[seen].mT @ found[seen]
        wanted = torch.linalg.inv(covariances[seen] + more * torch.eye(2))
        torch.testing.assert_close(information, wanted / wanted.diagonal(dim1=-2, dim2=-1).mean())
