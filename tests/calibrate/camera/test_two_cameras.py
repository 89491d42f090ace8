"""Views of another camera, zoom or crop are named; a lens that moves by view widens error bars; good ones stay."""

import math
import re
from collections.abc import Callable, Collection
from pathlib import Path

import pytest
import torch
from calibrate_scenes import observe
from torch import Tensor

from kcal import Board, CalibrationOptions, Camera, InputError, Observations, calibrate_camera
from kcal.calibrate.camera import each_view
from kcal.calibrate.camera import one_camera as module
from kcal.lens import camera_difference, rotation_from_vector
from kcal.sim.captures import PrintedBoard, sample_board_poses, true_corners

BOARD, VIEWS, SIZE = Board(columns=9, rows=6, square=0.03), 12, (1280, 960)
LENS = Camera.build(focal=(1100, 1100), center=(652, 470), size=SIZE, coefficients=[-0.2, 0.05, 2e-4, -3e-4])
OTHER = Camera.build(focal=(1085, 1085), center=(628, 489), size=SIZE, coefficients=[-0.22, 0.07, -2e-4, 1e-4])
DECENTERED = Camera.build(focal=(1100, 1100), center=(690, 438), size=SIZE, coefficients=[-0.2, 0.05, 2e-4, -3e-4])
SECOND = frozenset(range(1, VIEWS, 2))


def shown(camera: Camera, seed: int) -> Tensor:
    """(V, N, 2) corners with noise."""
    draw = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(LENS, BOARD, VIEWS, draw, fill=(0.3, 0.8))
    rotation, translation = (torch.stack(parts) for parts in zip(*poses, strict=True))
    corners = true_corners(PrintedBoard(BOARD.columns, BOARD.rows, BOARD.square, seed))
    pixels = camera.project(corners @ rotation.transpose(-1, -2) + translation[:, None])[0]
    return pixels + 0.05 * torch.randn(pixels.shape, dtype=torch.float64, generator=draw)


def capture(
    change: Callable[[Tensor], Tensor] | None = None,
    *,
    seed: int = 1,
    lens: Camera = LENS,
    other: Camera = LENS,
    second: Collection[int] = SECOND,
) -> Observations:
    """A capture some of whose views another camera took, or were changed."""
    pixels, own = shown(lens, seed), sorted(second)
    pixels[own] = shown(other, seed)[own] if change is None else change(pixels[own])
    return observe(pixels, board=BOARD, size=SIZE, names=[f"{i:02d}" for i in range(VIEWS)])


MIDDLE = 0.5 * (torch.tensor(SIZE, dtype=torch.float64) - 1.0)


def zoomed(times: float) -> Callable[[Tensor], Tensor]:
    return lambda pixels: (pixels - MIDDLE) * times + MIDDLE


def cropped(pixels: Tensor) -> Tensor:
    return pixels - torch.tensor([40.0, 0.0], dtype=torch.float64)


def turned(pixels: Tensor) -> Tensor:
    return 2.0 * MIDDLE - pixels


def named(text: str, before: str, after: str) -> set[int]:
    """The views that a message lists between two words; none where it has no such list."""
    listed = text.partition(before)[2].partition(after)[0]
    return {int(name) for name in listed.split(", ")} if listed else set()


def moved(seed: int, scale: float, center: float) -> tuple[Observations, Tensor]:
    """A capture each of whose views has its own scale and principal point, and these (V, 3)."""
    draw = torch.randn(VIEWS, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    theta = draw * torch.tensor([scale, center, center], dtype=torch.float64)
    each = theta[:, None]
    seen = capture(lambda pixels: (pixels - MIDDLE) * each[..., :1].exp() + MIDDLE + each[..., 1:], second=range(VIEWS))
    return seen, theta


class TestGroups:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("changed", "told"),
        [
            pytest.param({"change": cropped}, r"the principal point is (3|4)\d px to the", id="cropped"),
            pytest.param({"change": zoomed(1.05)}, r"everything is (4\.\d|5\.\d) % (larger|smaller)", id="zoomed"),
            pytest.param({"other": OTHER}, "the views are not of one camera", id="other"),
            pytest.param({"change": turned, "lens": DECENTERED}, "turned by 180°.*back if they were", id="turned"),
        ],
    )
    def test_many_are_refused_and_named(self, changed: dict, told: str, request: pytest.FixtureRequest) -> None:
        with pytest.raises(InputError, match=told) as error:
            calibrate_camera(capture(**changed))
        text = str(error.value)
        accused, unclear = named(text, "(", ")"), named(text, "not clear for ", ")")
        groups = SECOND, set(range(VIEWS)) - SECOND
        off, right = min((len((accused ^ group) - unclear), number) for number, group in enumerate(groups))
        # A view that tells little about the principal point may be in either group.
        assert off <= 1
        assert len(unclear) <= 2
        if "zoomed" in request.node.name:
            assert ("larger", "smaller")[right] in text
        if "cropped" in request.node.name:
            assert ("left", "right")[right] in text

    @pytest.mark.slow
    def test_a_few_are_left_out_and_named(self) -> None:
        """The two zoomed ones, not the ten others."""
        result = calibrate_camera(capture(zoomed(1.08), second=(3, 8)))
        assert [view.view for view in result.rejected_views] == ["03", "08"]
        assert all(" % larger" in view.reason for view in result.rejected_views)
        good = calibrate_camera(capture(second=()))
        assert float(result.camera.focal[0]) == pytest.approx(float(good.camera.focal[0]), rel=2e-3)

    def test_one_wrong_corner_makes_no_other_camera(self) -> None:
        seen = capture(second=())
        pixels = seen.pixels()
        pixels[4, 7, 0] += 9.0
        result = calibrate_camera(observe(pixels, board=BOARD, size=SIZE, names=seen.names))
        assert result.rejected_views == ()
        assert any("corner 7 of view 04 by" in text for text in result.warnings)

    @pytest.mark.slow
    def test_parametric_lenses_too(self) -> None:
        with pytest.raises(InputError, match="the views are not of one camera"):
            calibrate_camera(capture(zoomed(1.05)), CalibrationOptions(model="opencv5"))


class TestMoves:
    """A lens that moves from view to view has a camera, whose error bars contain the movement."""

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("scale", "center", "told"),
        [
            (0.0, 12.0, r"principal point by some 1\d px \(image stabilizer"),
            (0.02, 0.0, r"focal length by some (1\.\d|2\.\d) % \(autofocus"),
        ],
    )
    def test_it_is_told_and_allowed_for(self, scale: float, center: float, told: str) -> None:
        seen, theta = moved(3, scale, center)
        result = calibrate_camera(seen)
        assert any(re.search(told, text) for text in result.warnings)
        assert result.by_view is not None
        middle = theta.mean(0)
        off = (result.by_view - theta + middle).abs().mean(0)
        assert float(off[0]) <= 0.3 * scale + 1e-9
        assert float(off[1:].max()) <= 0.4 * center + 1e-9
        sigma = result.covariance.diagonal().sqrt()
        params, true = result.camera.params.detach(), LENS.params.detach()
        assert float(sigma[2]) > 0.7 * center
        assert float(sigma[0]) > 0.7 * scale * float(params[0])
        torch.testing.assert_close(result.information.covariance(), result.covariance, rtol=1e-3, atol=1e-9)
        expected = torch.cat([true[:2] * math.exp(float(middle[0])), true[2:4] + middle[1:]])
        assert float(((params[:4] - expected).abs() / sigma[:4]).max()) < 2.5

    @pytest.mark.slow
    def test_what_is_not_proven_widens_error_bars_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(module, "_SURE", math.inf)
        result = calibrate_camera(moved(3, 0.0, 12.0)[0])
        assert result.by_view is None
        assert not any("lens moves" in text for text in result.warnings)
        assert float(result.covariance[2, 2].sqrt()) > 0.7 * 12.0
        torch.testing.assert_close(result.information.covariance(), result.covariance, rtol=1e-3, atol=1e-9)

    def test_a_parametric_lens_cannot(self) -> None:
        with pytest.raises(InputError, match="leave the model out, or lock focus"):
            calibrate_camera(moved(3, 0.0, 12.0)[0], CalibrationOptions(model="opencv5"))


class TestNotAccused:
    @pytest.mark.parametrize("seed", [2, 3])
    def test_good_captures_are_not_even_fitted_again(self, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(module, "fit_by_options", None)
        result = calibrate_camera(capture(seed=seed))
        assert result.rms < 0.1
        assert result.by_view is None

    def test_less_than_a_pixel_of_the_principal_point(self) -> None:
        assert calibrate_camera(capture(lambda pixels: pixels + 0.7)).rms < 0.1

    @pytest.mark.slow
    def test_one_camera_whose_residuals_repeat_by_chance(self) -> None:
        """Tempering that another fit does without is no evidence for two cameras: 93 nats of it came from there."""
        draw = torch.Generator().manual_seed(5)
        size, board = (1920, 1080), Board(columns=9, rows=6, square=0.1)
        lens = Camera.build(
            focal=(1470, 1472), center=(962, 542), size=size, coefficients=[-0.186, 0.06, 5e-4, -3e-4, -0.01]
        )

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=draw, dtype=torch.float64)

        turn = rotation_from_vector(0.35 * normal(24, 3)).transpose(-1, -2)
        place = torch.tensor([0.0, 0.0, 4.0]) + normal(24, 3) * torch.tensor([0.35, 0.2, 0.4])
        pixels = lens.project((board.points - board.points.mean(0)) @ turn + place[:, None])[0]
        pixels = pixels + 0.1 * normal(*pixels.shape)
        result = calibrate_camera(observe(pixels, board=board, size=size))
        assert result.hybrid.tempering > 1.02  # or nothing is tested
        assert result.by_view is None

    def test_too_few_views_to_tell(self) -> None:
        assert math.isfinite(calibrate_camera(capture(cropped).subset(["00", "02", "04", "06", "01"])).rms)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["st1_l", "sq1280"])
    def test_real_captures(self, name: str, kcal_data: Path) -> None:
        result = calibrate_camera(Observations.load(kcal_data / "captures" / f"{name}.obs.json"))
        assert result.by_view is None
        assert not result.rejected_views


@pytest.mark.slow
def test_a_phone_with_a_stabilizer(kcal_data: Path) -> None:
    """Its halves agree within their error bars: the ratio was 1.43 while lens and board hid a part of the movement."""
    seen = Observations.load(kcal_data / "captures" / "luisa39.obs.json")
    halves = [calibrate_camera(seen.subset(seen.names[part::2])) for part in (0, 1)]
    assert all(any("image stabilizer" in text for text in half.warnings) for half in halves)
    assert camera_difference(halves[0].camera, halves[1].camera).ratio < 1.2


def test_amplitudes_from_quadratic_forms() -> None:
    """Those of largest evidence are those with which views were drawn, beside unknowns of all; what is none is zero."""
    draw = torch.Generator().manual_seed(5)
    count, true = 200, torch.tensor([0.0, 20.0, 20.0], dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=draw)

    root, theta, noise = normal(count, 6, 3) * torch.tensor([1e3, 0.1, 0.1]), true * normal(count, 3), normal(count, 6)
    shared, y = normal(count, 6, 2) + root[..., 1:] / 0.1, torch.tensor([3.0, -2.0], dtype=torch.float64)
    C, H = root.mT @ shared, torch.eye(2, dtype=torch.float64) + (shared.mT @ shared).sum(0)
    begin = torch.tensor([0.1, 30.0, 30.0], dtype=torch.float64)

    def views_of(theta: Tensor) -> each_view.ByView:
        left = (noise - shared @ y)[..., None] - root @ theta[..., None]
        g, b = (root.mT @ left)[..., 0], (shared.mT @ left)[..., 0]
        return each_view.ByView(root.mT @ root, g, *each_view.unit_weight(H, C, b), (), begin)

    views, still = views_of(theta), views_of(torch.zeros_like(theta))
    center, scale = (views.spread(tied) for tied in module._LENS[:2])
    assert center.nats > scale.nats
    torch.testing.assert_close(center.sigma, true, rtol=0.06, atol=0.0)
    assert max(still.spread(tied).nats for tied in module._LENS) < 0.0
    assert views.score([1, 2]) > 10.0 * abs(still.score([1, 2]))
    # Twelve views leave room for the error of their deviation, as Student's t does; two hundred still ones for nothing.
    none, each = views.b[:12, :0], 0.06 * (theta[:12] - theta[:12].mean(0)) + 0.25 * normal(12, 3)
    few = each_view.ByView(
        0.06 * torch.eye(3).double().expand(12, 3, 3), -each, none[:, None].expand(12, 3, 0), none, (), begin
    )
    found = few.spread(module._LENS[0])
    likely, all_nats = found.sigma, []
    for ratio in torch.linspace(0.5, 2.0, 61, dtype=torch.float64).tolist():
        # The evidence of normal movements, in closed form, beside that of none.
        one, variance = torch.eye(2, dtype=torch.float64), (ratio * float(likely[1])) ** 2
        data = one + variance * few.N[:, 1:, 1:]
        gained = variance * few.g[:, None, 1:] @ torch.linalg.solve(data, few.g[:, 1:, None])
        all_nats.append(0.5 * float(gained.sum() - torch.logdet(data).sum()))
    assert found.nats == pytest.approx(max(all_nats) - 0.5 * math.log(12), abs=2.0 * each_view._SETTLED)
    assert all_nats[20] == pytest.approx(max(all_nats), abs=2.0 * each_view._SETTLED)
    assert 1.02 < float(few.later(8.0 * likely)[1] / likely[1]) < 1.1
    assert not bool(still.later(torch.tensor([0.0, 30.0, 30.0], dtype=torch.float64)).any())
    theta = theta - theta.mean(0)
    at, before = views.b.sum(0) + (views.C.mT @ theta[..., None])[..., 0].sum(0), views.b.sum(0)
    fixed = (theta * (2.0 * views.g + (views.N @ theta[..., None])[..., 0])).sum()
    torch.testing.assert_close(views.total(theta), fixed - at @ at + before @ before)
    # As with all entries of the matrix of χ² off the mean of θ.
    flat, mean = views.C.flatten(0, 1), torch.eye(3, dtype=torch.float64).repeat(count, count) / count
    K, g = torch.block_diag(*views.N) - flat @ flat.T, (views.g - views.C @ before).flatten()
    K, g, own = K - mean @ K - K @ mean + mean @ K @ mean, g - mean @ g, torch.arange(3 * count) % 3 > 0
    expected = (g[own].square().sum() - K.diagonal()[own].sum()) / (math.sqrt(2.0) * K[own][:, own].norm())
    assert views.score([1, 2]) == pytest.approx(float(expected), rel=1e-9)
    torch.testing.assert_close(views.joint.slope(theta).flatten(), g + K @ theta.flatten())
    most, nats = torch.tensor([0.0, 6.0, 6.0], dtype=torch.float64), []
    for k in range(13):
        wide = 2.0**-k * most.repeat(count)
        inner = torch.eye(3 * count, dtype=torch.float64) + wide[:, None] * K * wide
        nats.append(0.5 * float(wide * g @ torch.linalg.solve(inner, wide * g) - torch.logdet(inner)))
    share = torch.tensor([math.log(4.0 * 13), *nats], dtype=torch.float64).softmax(0)[1:]
    wanted = most * (share @ 4.0 ** -torch.arange(13.0, dtype=torch.float64)).sqrt()
    torch.testing.assert_close(views.later(most), wanted, rtol=1e-3, atol=0.0)
    second = torch.arange(count) < 15
    parted = views_of(torch.where(second[:, None], 40.0 * theta.new_tensor([0.0, 1.0, -1.0]), 0.0))
    first, other = parted.best(second)[0]
    torch.testing.assert_close(first, -other)  # what is common is the camera's
    torch.testing.assert_close((other - first)[1:], theta.new_tensor([40.0, -40.0]), rtol=0.1, atol=0.0)
    assert int(((parted.by_group(second) < 0.0) != second).sum()) < 0.1 * count


def test_what_many_views_show_is_gathered_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    result, none = calibrate_camera(capture()), torch.zeros(VIEWS, 3, dtype=torch.float64)
    assert result.hybrid is not None
    pixels = torch.where(result.residuals.isfinite(), result.observations.pixels(), torch.nan)
    whole = module._of_fit(result.hybrid, pixels, none)
    monkeypatch.setattr(each_view, "_TOGETHER", 5)
    parts = module._of_fit(result.hybrid, pixels, none)
    for name in ("N", "g", "C", "b"):
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name))
