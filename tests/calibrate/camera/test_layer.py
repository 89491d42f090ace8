"""Gradients through a calibration: against solving anew, against recorded steps, and where there are none.

Calibration, rig and position as one chain of gradients; and the layer on another device.
"""

import dataclasses
import functools

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, pixels_of
from elsewhere import DEVICE, Elsewhere
from torch import Tensor, nn

from kcal import CalibrationOptions, Camera, DegenerateError, InputError, Localizer, Origin, Rig
from kcal.calibrate.camera.checks import OutlierRejection
from kcal.calibrate.camera.layer import CalibratedViews, CalibrationLayer, calibrate_views
from kcal.lens import LensModel, rotation_from_vector
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
        return summary(calibrate_views(data[0], data[1], SIZE, options, prior_means=data[2], start=base))

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


TURN = rotation_from_vector(torch.tensor([0.01, -0.03, 0.02], dtype=torch.float64))
SHIFT = torch.tensor([-0.06, 0.01, 0.02], dtype=torch.float64)


def corners_of_both() -> tuple[Tensor, Tensor]:
    """Of the same boards in two cameras of a rig."""
    left = motions(camera(), 6, 3)
    rotation, translation = left
    right = TURN @ rotation, translation @ TURN.T + SHIFT
    return tuple(pixels_of(camera("opencv4"), poses, noise=0.1) for poses in (left, right))  # type: ignore[return-value]


def located(layer: CalibrationLayer, corners: tuple[Tensor, Tensor], start: list[CalibratedViews | None]) -> Tensor:
    """Inverse range and position of a pair of pixels, from the corners of calibration images alone."""
    found = [layer(one, BOARD.points, start=first) for one, first in zip(corners, start, strict=True)]
    start[:] = found
    left, right = found
    turn = right.cam_from_board_rotation[0] @ left.cam_from_board_rotation[0].mT
    shift = right.cam_from_board_translation[0] - turn @ left.cam_from_board_translation[0]
    rig = Rig.pair(left.camera(differentiable=True), right.camera(differentiable=True), turn, shift)
    localize = Localizer(rig.placed(origin=Origin(lat=45.0, lon=6.0, height=0.0), heading_deg=0.0))
    pixels = [torch.tensor([[330.0, 250.0]], dtype=torch.float64), torch.tensor([[300.0, 238.0]], dtype=torch.float64)]
    where = localize(*pixels)
    return torch.cat([where.enu[0], where.inverse_range])


@pytest.mark.slow
def test_a_position_is_differentiable_by_the_corners_of_calibration_images() -> None:
    layer, corners = CalibrationLayer(SIZE, CalibrationOptions()), corners_of_both()
    start: list[CalibratedViews | None] = [None, None]
    located(layer, corners, start)
    amount = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    g = torch.Generator().manual_seed(1)
    along = [torch.randn(one.shape, generator=g).double() for one in corners]

    def solve(amount: Tensor) -> Tensor:
        # From the same start each time: with the default lens, it also holds the amplitudes.
        moved = tuple(one + share * way for one, share, way in zip(corners, amount, along, strict=True))
        return located(layer, moved, list(start))

    assert torch.autograd.gradcheck(solve, (amount,), eps=1e-3, atol=1e-5, rtol=1e-3, fast_mode=True)


def test_a_differentiable_camera_is_a_camera() -> None:
    found = CalibrationLayer(SIZE, CalibrationOptions(model="opencv4"))(
        corners_of_both()[0].requires_grad_(True), BOARD.points
    )
    plain, attached = found.camera(), found.camera(differentiable=True)
    assert not list(attached.parameters())
    assert plain.fingerprint == attached.fingerprint
    points = torch.tensor([[0.3, 0.2, 1.0], [-0.4, 0.1, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(plain.project(points)[0], found.project(points)[0].detach(), rtol=0, atol=1e-9)
    again = Camera(plain.params + 1.0, size=plain.size, model=plain.model)
    again.load_state_dict(attached.state_dict())
    assert torch.equal(again.params, plain.params)
    pixels = torch.tensor([[100.0, 200.0]], dtype=torch.float64)
    rays = attached.unproject(pixels)[0]
    assert rays.requires_grad
    torch.testing.assert_close(rays, plain.unproject(pixels)[0], rtol=0, atol=3e-16, check_layout=False)
    assert torch.equal(attached.resized((320, 240)).params, plain.resized((320, 240)).params)


@pytest.mark.slow
def test_what_comes_of_another_device_returns_to_it() -> None:
    layer, corners = CalibrationLayer(SIZE, CalibrationOptions()), corners_of_both()[0].requires_grad_(True)
    points = torch.tensor([[0.1, 0.05, 1.0]], dtype=torch.float64)
    here = layer(corners, BOARD.points)
    layer(corners, BOARD.points, start=here).project(points)[0].sum().backward()
    with Elsewhere():
        moved = corners.detach().to(DEVICE).requires_grad_(True)
        mask = torch.ones(moved.shape[:2], dtype=torch.bool, device=DEVICE)
        found = layer(moved, BOARD.points.to(DEVICE), mask, start=here)
        pixels = found.project(points.to(DEVICE))[0]
        assert pixels.device == found.residuals.device == found.camera(differentiable=True).params.device == DEVICE
        pixels.sum().backward()
        assert moved.grad is not None
        assert corners.grad is not None
        torch.testing.assert_close(moved.grad.cpu(), corners.grad, rtol=1e-6, atol=1e-9)
