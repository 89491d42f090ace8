"""Gradients through a calibration: against solving anew, against recorded steps, and where there are none."""

import dataclasses
import functools

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, pixels_of
from torch import Tensor, nn

from kcal import CalibrationOptions, DegenerateError, InputError
from kcal.calibrate.camera.checks import OutlierRejection
from kcal.calibrate.camera.layer import CalibratedViews, CalibrationLayer, calibrate_views
from kcal.lens import LensModel
from kcal.solve import RobustLoss

# Of the rays (0.3, 0.2), (-0.4, 0.1), (0.1, -0.3).
POINTS = torch.tensor([[0.3, 0.2, 1.0], [-0.4, 0.1, 1.0], [0.1, -0.3, 1.0]], dtype=torch.float64)
POSES = motions(camera(), 5, 3)
# Noise that leaves residuals of half a pixel: their curvature is part of the derivative.
CORNERS = pixels_of(camera("opencv4"), POSES, noise=0.4)
PRIORS = {"fx": (498.0, 1.5), "cy": (236.0, 0.7)}


def summary(found: CalibratedViews) -> Tensor:
    """A function of all that is found, in pixels and of about equal size."""
    seen = found.project(POINTS)[0].flatten()
    return torch.cat([seen, 500.0 * found.cam_from_board_translation[0], 1e3 * found.board_warp, found.residuals[2, 3]])


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        CalibrationOptions(model="opencv4"),
        CalibrationOptions(model="opencv4", board_warp=True, tied=(("fx", "fy"),), fixed={"p1": 0.0}, priors=PRIORS),
        CalibrationOptions(model="opencv4", loss=RobustLoss(kind="cauchy", scale=0.5), priors=PRIORS),
        CalibrationOptions(model="opencv14", weak_prior=0.3),
    ],
    ids=["plain", "warp, tie, fixed, priors", "robust, priors", "14 coefficients, weak prior"],
)
def test_derivatives_are_those_of_solving_anew(options: CalibrationOptions) -> None:
    """Along random directions, by corners, board points (off their plane too) and prior means."""
    corners = CORNERS.clone()
    corners[1, :4] = torch.nan
    means = torch.tensor([mean for mean, _ in options.priors.values()], dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)

    def draw(*shape: int) -> Tensor:
        return torch.randn(3, *shape, generator=generator, dtype=torch.float64)

    directions = (draw(*corners.shape), 1e-3 * draw(*BOARD.points.shape), draw(len(means)))
    if options.board_warp:
        # The width of the warp's parabolas is that of the outermost corners, a minimum with a kink where several tie.
        x, y = BOARD.points[:, :2].T
        outside = (x == x.min()) | (x == x.max()) | (y == y.min()) | (y == y.max())
        directions[1][:, outside, :2] = 0.0
    base = calibrate_views(corners, BOARD.points, SIZE, options, backward="none")

    def solve(amount: Tensor) -> Tensor:
        data = [
            value + torch.tensordot(amount, along, 1)
            for value, along in zip((corners, BOARD.points, means), directions, strict=True)
        ]
        found = calibrate_views(data[0], data[1], SIZE, options, prior_means=data[2], start=base)
        return summary(found)

    # Central differences over 1e-4 px of solutions that are exact to some 1e-11 px.
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(solve, (zero,), eps=1e-4, atol=5e-6, rtol=5e-6, fast_mode=True)


# What Gauss and Newton leave out of the Hessian is a percent of it, and more of that of a robust loss, where the
# weights' own change is left out too.
@pytest.mark.parametrize(("loss", "left"), [(None, 1e-9), (RobustLoss(kind="huber", scale=0.8), 1e-4)])
def test_recorded_steps_have_the_same_derivatives_and_second_ones(loss: RobustLoss | None, left: float) -> None:
    options = CalibrationOptions(model="opencv4", loss=loss, priors=PRIORS)
    base = calibrate_views(CORNERS, BOARD.points, SIZE, options, backward="none")
    gradients = []
    for backward in ("implicit", "unroll"):
        corners = CORNERS.clone().requires_grad_(True)
        found = calibrate_views(corners, BOARD.points, SIZE, options, start=base, backward=backward)
        gradients.append(torch.autograd.grad(summary(found).sum(), corners, create_graph=backward == "unroll")[0])
    torch.testing.assert_close(gradients[1].detach(), gradients[0], rtol=0, atol=left * float(gradients[0].abs().max()))
    assert bool(torch.autograd.grad(gradients[1].square().sum(), corners)[0].isfinite().all())


def test_values_do_not_depend_on_backward_and_none_carries_nothing() -> None:
    corners = CORNERS.clone().requires_grad_(True)
    found = [
        CalibrationLayer(SIZE, CalibrationOptions(model="opencv4"), backward=how)(corners, BOARD.points)
        for how in ("implicit", "unroll", "none")
    ]
    for other in found[1:]:
        torch.testing.assert_close(summary(other), summary(found[0]), rtol=0, atol=1e-6)
    assert [one.parameters.requires_grad for one in found] == [True, True, False]


@functools.cache
def default_lens() -> CalibratedViews:
    return calibrate_views(CORNERS, BOARD.points, SIZE, backward="none")


class TestDefaultLens:
    """The hybrid lens, with printed boards and motion: gradients at amplitudes that are held."""

    @pytest.mark.slow
    def test_it_is_the_default(self) -> None:
        from calibrate_scenes import observe

        from kcal.calibrate.camera.calibrate import calibrate_camera

        found, result = default_lens(), calibrate_camera(observe(CORNERS))
        assert found.model.hybrid
        for name, ours, theirs in zip(
            result.camera.names, found.parameters.tolist(), result.camera.params.tolist(), strict=True
        ):
            # The fit stops where steps lower chi² by less than a hundredth: a tenth of a standard deviation. Modes that
            # move no pixel are left out of it, and are zero here to rounding.
            assert abs(ours - theirs) <= 0.1 * (result.sigma.get(name) or 0.0) + 1e-12
        assert torch.equal(found.camera().params, found.parameters)

    @pytest.mark.slow
    def test_derivatives_are_those_of_solving_anew(self) -> None:
        base = default_lens()
        generator = torch.Generator().manual_seed(2)
        along = torch.randn(2, *CORNERS.shape, generator=generator, dtype=torch.float64)
        board = 1e-3 * torch.randn(2, *BOARD.points.shape, generator=generator, dtype=torch.float64)

        def solve(amount: Tensor) -> Tensor:
            corners = CORNERS + torch.tensordot(amount, along, 1)
            points = BOARD.points + torch.tensordot(amount, board, 1)
            return summary(calibrate_views(corners, points, SIZE, start=base))

        zero = torch.zeros(2, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(solve, (zero,), eps=1e-4, atol=2e-5, rtol=2e-5, fast_mode=True)

    @pytest.mark.slow
    def test_recorded_steps_have_the_same_derivatives(self) -> None:
        base, gradients = default_lens(), []
        for backward in ("implicit", "unroll"):
            corners = CORNERS.clone().requires_grad_(True)
            found = CalibrationLayer(SIZE, backward=backward)(corners, BOARD.points, start=base)
            gradients.append(torch.autograd.grad(summary(found).sum(), corners)[0])
        # Eight steps, each of which leaves a few percent.
        scale = float(gradients[0].abs().max())
        torch.testing.assert_close(gradients[1], gradients[0], rtol=0, atol=1e-6 * scale)

    @pytest.mark.slow
    def test_a_start_keeps_the_amplitudes(self) -> None:
        base = default_lens()
        again = calibrate_views(CORNERS + 1e-3, BOARD.points, SIZE, start=base, backward="none")
        assert base.fit is not None
        assert again.fit is base.fit
        # All corners one thousandth of a pixel to the right and down: the principal point follows nearly, since the
        # middle of the field stays where it is.
        moved = (again.parameters - base.parameters)[2:4]
        torch.testing.assert_close(moved, torch.full((2,), 1e-3).double(), rtol=0.1, atol=0)

    def test_refusals(self) -> None:
        base = default_lens()
        with pytest.raises(InputError, match="measures the noise"):
            calibrate_views(CORNERS, BOARD.points, SIZE, corner_sigma=0.1)
        with pytest.raises(InputError, match="another lens model"):
            calibrate_views(CORNERS, BOARD.points, SIZE, CalibrationOptions(model="opencv4"), start=base)
        with pytest.raises(InputError, match="another number of views"):
            calibrate_views(CORNERS[1:], BOARD.points, SIZE, start=base)


def test_it_is_calibrate_cameras_solution() -> None:
    from calibrate_scenes import observe

    from kcal.calibrate.camera.calibrate import calibrate_camera

    options = CalibrationOptions(model="opencv5")
    found = calibrate_views(CORNERS, BOARD.points, SIZE, options)
    result = calibrate_camera(observe(CORNERS), options)
    for name, ours, theirs in zip(
        result.camera.names, found.parameters.tolist(), result.camera.params.tolist(), strict=True
    ):
        assert abs(ours - theirs) <= 1e-4 * (result.sigma.get(name) or 0.0)
    assert float(found.residuals.square().sum(-1).mean().sqrt()) == pytest.approx(result.rms, rel=1e-9)
    assert torch.equal(found.camera().params, found.parameters)
    with pytest.raises(InputError, match="the start is of another lens model"):
        calibrate_views(CORNERS, BOARD.points, SIZE, CalibrationOptions(model="opencv4"), start=found)


def test_a_known_camera_leaves_poses() -> None:
    corners = CORNERS[:1].clone().requires_grad_(True)
    found = calibrate_views(corners, BOARD.points, SIZE, CalibrationOptions(camera=camera("opencv4")))
    (gradient,) = torch.autograd.grad(found.cam_from_board_translation[0, 2], corners)
    # Corners that move apart by a share bring the board nearer by that share.
    nearer = float((gradient * (corners.detach() - corners.detach().mean((0, 1)))).sum())
    assert nearer == pytest.approx(-float(POSES[1][0, 2]), rel=0.2)


def test_unseen_corners_have_no_influence() -> None:
    mask = torch.ones(CORNERS.shape[:-1], dtype=torch.bool)
    mask[2, 5:9] = False
    for fill in (torch.nan, 1e4):
        corners = torch.where(mask[..., None], CORNERS, fill).requires_grad_(True)
        found = CalibrationLayer(SIZE, CalibrationOptions(model="opencv4"))(corners, BOARD.points, mask)
        (gradient,) = torch.autograd.grad(summary(found).sum(), corners)
        assert bool(gradient.isfinite().all())
        assert bool((gradient[~mask] == 0).all())
        assert bool((gradient[mask] != 0).all())


@pytest.mark.slow
def test_training_through_calibrations_finds_the_corners_bias() -> None:
    """A detector is off by an unknown matrix times a feature of each corner; cameras calibrated from it tell which.

    The reference is a calibration from clean corners with the same noise. The loss sees only where the cameras image
    three rays: six numbers for four unknowns.
    """
    features = torch.randn(*CORNERS.shape, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    features = features + 0.01 * (CORNERS - CORNERS.mean((0, 1)))  # a bias that grows outward bends the lens
    bias = torch.tensor([[0.6, -0.3], [0.2, 0.5]], dtype=torch.float64)
    options = CalibrationOptions(model="opencv4")
    reference = calibrate_views(CORNERS, BOARD.points, SIZE, options, backward="none")
    wanted = reference.project(POINTS)[0]
    measured = CORNERS + features @ bias

    net = nn.Linear(2, 2, bias=False, dtype=torch.float64)
    nn.init.zeros_(net.weight)
    layer = CalibrationLayer(SIZE, options)
    optimizer = torch.optim.LBFGS(net.parameters(), max_iter=20, line_search_fn="strong_wolfe", tolerance_grad=1e-12)

    def closure() -> Tensor:
        optimizer.zero_grad()
        found = layer(measured - net(features), BOARD.points, start=reference)
        loss = (found.project(POINTS)[0] - wanted).square().sum()
        loss.backward()
        return loss.detach()

    before = float(closure())
    optimizer.step(closure)
    assert float(closure()) < 1e-4 * before
    torch.testing.assert_close(net.weight.detach().T, bias, rtol=0, atol=0.01)


class TestRefusals:
    def test_a_known_camera_that_requires_gradients(self) -> None:
        corners = pixels_of(camera("pinhole"), POSES)
        options = CalibrationOptions(camera=camera("pinhole").free("fx"))
        with pytest.raises(InputError, match="requires_grad_"):
            calibrate_views(corners, BOARD.points, SIZE, options)
        assert not calibrate_views(corners, BOARD.points, SIZE, options, backward="none").parameters.requires_grad

    def test_what_the_views_do_not_determine(self) -> None:
        """Boards parallel to the image leave the focal length open."""
        flat = torch.eye(3).double().expand(4, 3, 3)
        shift = torch.tensor([[-0.15, -0.1, 1.0], [-0.3, -0.1, 1.0], [-0.1, -0.2, 1.0], [0.0, 0.0, 1.0]]).double()
        corners = pixels_of(camera("pinhole"), (flat, shift), noise=0.1)
        options = CalibrationOptions(model="pinhole")
        with pytest.raises(DegenerateError, match="focal length"):
            calibrate_views(corners, BOARD.points, SIZE, options)
        tied = CalibrationOptions(model="pinhole", fixed={"fx": 500.0, "fy": 505.0, "cx": 320.0, "cy": 240.0})
        assert calibrate_views(corners, BOARD.points, SIZE, tied).parameters[0] == 500.0

    def test_a_valley(self) -> None:
        """Without distortion any numerator does that its denominator cancels."""
        corners = pixels_of(camera("pinhole"), POSES)
        start = calibrate_views(corners, BOARD.points, SIZE, CalibrationOptions(model="opencv5"), backward="none")
        rich = LensModel.named("opencv8")
        # k4, k5, k6 come last.
        parameters = torch.cat([start.parameters, torch.zeros(3, dtype=torch.float64)])
        begin = dataclasses.replace(start, model=rich, parameters=parameters)
        with pytest.raises(DegenerateError, match="no derivatives"):
            calibrate_views(corners, BOARD.points, SIZE, CalibrationOptions(weak_prior=None, model=rich), start=begin)

    def test_exact_corners_are_no_flat_valley(self) -> None:
        corners = pixels_of(camera("opencv4"), POSES).requires_grad_(True)
        found = calibrate_views(corners, BOARD.points, SIZE, CalibrationOptions(model="opencv4"))
        torch.testing.assert_close(found.parameters.detach(), camera("opencv4").params.detach(), rtol=1e-8, atol=1e-8)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"pixels": CORNERS[0]}, "V, N, 2"),
            ({"pixels": CORNERS.int()}, "floating point"),
            ({"board_points": BOARD.points[:5]}, "V, N, 2"),
            ({"mask": torch.ones(2, 2, dtype=torch.bool)}, "mask"),
            ({"prior_means": torch.ones(1)}, "prior means"),
            ({"corner_sigma": 0.0}, "corner_sigma"),
            ({"backward": "explicit"}, "implicit, unroll or none"),
            ({"options": CalibrationOptions(model="opencv5", reject=OutlierRejection())}, "continuous"),
        ],
    )
    def test_input(self, change: dict[str, object], message: str) -> None:
        arguments: dict[str, object] = {"pixels": CORNERS, "board_points": BOARD.points, "size": SIZE, **change}
        with pytest.raises(InputError, match=message):
            calibrate_views(**arguments)  # type: ignore[arg-type]


def test_arrays_and_lists_are_taken() -> None:
    options = CalibrationOptions(model="opencv4", priors=PRIORS)
    seen, means = torch.ones(CORNERS.shape[:2], dtype=torch.bool), torch.tensor([498.0, 236.0])
    found = calibrate_views(CORNERS, BOARD.points, SIZE, options, mask=seen, prior_means=means).parameters
    again = CalibrationLayer(SIZE, options)(CORNERS.tolist(), BOARD.points.numpy(), seen.numpy(), means.tolist())
    assert torch.equal(again.parameters, found)


def test_float32_corners_are_promoted() -> None:
    corners = CORNERS.float().requires_grad_(True)
    found = CalibrationLayer(SIZE, CalibrationOptions(model="opencv4")).half()(corners, BOARD.points.float())
    assert found.parameters.dtype == torch.float64
    found.parameters[0].backward()
    assert corners.grad.dtype == torch.float32
