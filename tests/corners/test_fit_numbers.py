"""What the fits of corners, ellipses and shifts compute, against dense matrices of NumPy and values by hand."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.special import erfc
from torch import Tensor

from kcal.corners.circles import Ellipses, _pixels, _system, _with_statuses, fit_ellipses
from kcal.corners.erf import _start, center_covariance, fit_crossings
from kcal.corners.erf_board import (
    CornerWindow,
    LineDistances,
    RampPrior,
    crossing,
    cut_windows,
    light_at,
    line_covariance,
)
from kcal.corners.grid import Neighbors
from kcal.corners.patches import (
    RIVAL_DISTANCE,
    ImageWindows,
    _biweight,
    _covariance,
    _Patches,
    _residual,
    _scale,
    gaussian_kernel,
    grid_of,
    highest_peak,
    is_textured,
    weighted_correlation,
)
from kcal.corners.saddle import CornerStatus

# What the fits of corners and ellipses compute, against dense matrices of NumPy and values by hand.


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def windows_about(offset: Tensor, radius: float, size: int = 13) -> CornerWindow:
    """Windows without gray levels yet, around offsets (M, 2)."""
    count = len(offset)
    places = torch.arange(size * size)
    return CornerWindow(torch.zeros(count, size**2).double(), offset, torch.full((count,), radius), places, size)


def with_levels(window: CornerWindow, levels: Tensor) -> CornerWindow:
    return CornerWindow(levels, window.offset, window.radius, window.places, window.size)


class TestCorners:
    @pytest.mark.parametrize("usable_share", [1.0, 0.7])
    def test_covariance_is_that_of_dense_matrices(self, usable_share: float) -> None:
        """G R Gᵀ with the correlation that odd parts of the residuals show beyond what fitting makes of white noise."""
        count, size = 600, 5
        residual = draw(1, count, size + 1, size)[:, :, :size] + 0.5 * draw(1, count, size + 1, size)[:, :, 1:]
        weight = 0.2 + 0.8 * draw(1, count, size, size, seed=1).abs().clamp_max(1.0)
        axis = torch.arange(size).double() - size // 2
        down, right = torch.meshgrid(axis, axis, indexing="ij")
        jacobian = (1.0 + 0.2 * draw(1, count, 4, 1, 1, seed=2)) * torch.stack([right, down, right**3, down**3])
        half = 0.05 * torch.eye(4) + 0.01 * draw(1, count, 4, 4, seed=3)
        inverse = half @ half.mT
        usable = torch.arange(count)[None] < usable_share * count
        found = center_covariance(residual, weight, jacobian, inverse, torch.zeros(1, count, 2), usable, 0.0)

        n = size * size
        J = jacobian[0].flatten(2).mT.numpy()
        G = inverse[0].numpy() @ (J * weight[0].flatten(1)[..., None].numpy()).transpose(0, 2, 1)
        e = residual[0].flatten(1).numpy()
        odd = (e - e[:, ::-1]) / math.sqrt(2.0)
        w = weight[0].flatten(1).numpy()
        pair = np.minimum(w, w[:, ::-1])
        eye = np.eye(n)
        made_of_white = (eye - J @ G) @ (eye - J @ G).transpose(0, 2, 1) - eye
        y, x = np.divmod(np.arange(n), size)
        good = usable[0].numpy()

        def sums(lag: NDArray[np.bool_]) -> tuple[NDArray[np.float64], ...]:
            both = pair[:, :, None] * pair[:, None] * lag
            parts = both * odd[:, :, None] * odd[:, None], 2.0 * both * made_of_white, both
            return tuple(part.sum((1, 2)) for part in parts)

        of_found, made, number = sums(eye > 0)
        freedom = number + made
        common = of_found[good].sum() / freedom[good].sum()
        # The image's mean counts as much as forty pixels.
        noise = (of_found + 40.0 * common) / (freedom + 40.0)
        correlated = eye.copy()
        for dy in range(3):
            for dx in range(-2, 3):
                if dy == 0 and dx <= 0:
                    continue
                lag = (y[None] - y[:, None] == dy) & (x[None] - x[:, None] == dx)
                of_found, made, number = sums(lag)
                share = (of_found / noise - made)[good].sum() / number[good].sum()
                correlated += share * (lag + lag.T)
        wanted = noise[:, None, None] * (G @ correlated @ G.transpose(0, 2, 1))[:, :2, :2]
        ratio = np.linalg.eigvals(
            np.linalg.solve((noise[:, None, None] * (G @ G.transpose(0, 2, 1)))[:, :2, :2], wanted)
        )
        assert 0.1 < ratio.real.min() < 0.95
        assert ratio.real.max() < 10.0
        np.testing.assert_allclose(found[0].numpy(), wanted, rtol=1e-6, atol=1e-9 * wanted.max())
        # What a corner that failed left behind is nothing to the others.
        residual[~usable] = jacobian[~usable] = math.nan
        again = center_covariance(residual, weight, jacobian, inverse, torch.zeros(1, count, 2), usable, 0.0)
        assert bool((again == found)[usable].all())

    def test_least_noise_and_few_pixels(self) -> None:
        """Below two thousand pixels noise is white; rounding of gray levels is the least."""
        jacobian = draw(1, 1, 4, 5, 5, seed=2)
        jacobian = jacobian - jacobian.flip(-1, -2)
        inverse = torch.eye(4).double()[None, None]
        ones, center, usable = torch.ones(1, 1, 5, 5).double(), torch.zeros(1, 1, 2), torch.ones(1, 1).bool()
        gain = jacobian[0, 0, :2].flatten(1)
        found = center_covariance(0 * ones, ones, jacobian, inverse, center, usable, 0.25)
        torch.testing.assert_close(found[0, 0], 0.25 * gain @ gain.mT)

    def test_light_is_that_of_the_typical_corner(self) -> None:
        """Black and white are shared, whichever squares are light; what is not usable tells nothing."""
        lights = torch.tensor([1.0, 0.8, 1.25, 3.0], dtype=torch.float64)
        turned = torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64)
        common = torch.tensor([0.2, -0.1, 0.1, 1.7, 0.2, 100.0, 60.0, 0.0, 0.0, 5.0], dtype=torch.float64).repeat(4, 1)
        common[:, 2] += 0.05 * torch.arange(4)
        own = common.clone()
        own[:, 5:7] *= lights[:, None]
        own[:, 9] *= lights
        own[:, 6] *= turned
        common[:, 6] *= turned
        own[:, 7:9] = 0.01
        own[3, 4:] = 9.0
        bend = torch.tensor([[0.01, -0.02]], dtype=torch.float64).expand(4, 2)
        window = windows_about(torch.zeros(4, 2).double(), 5.0)
        window = with_levels(window, lights[:, None] * crossing(common, window.where, bend)[0])
        usable = torch.tensor([[True, True, True, False]])
        own[:, 9] = common[:, 9]  # its median is what counts
        torch.testing.assert_close(light_at(own, window, bend, None, usable)[0], lights)

    def test_errors_of_the_next_lines_move_a_corner(self) -> None:
        """By the derivative of its gray levels by their distances; neighbors' errors are as large as its own."""
        parameters = torch.tensor([[0.1, -0.2, 0.2, 1.6, 0.5, 120.0, 70.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
        window = windows_about(torch.zeros(1, 2).double(), 5.0)
        bend = torch.zeros(1, 2).double()
        distance = torch.tensor([[[5.0, 6.0], [5.5, 7.0]]], dtype=torch.float64)
        turn = torch.tensor([[[1.0, 1.0], [0.5, 1.0]]], dtype=torch.float64)[..., None]
        gain = 1e-3 * draw(1, 2, len(window.places), seed=5)

        def levels(distance: Tensor) -> Tensor:
            wide = distance[..., None].expand(1, 2, 2, len(window.places))
            return crossing(parameters, window.where, bend, LineDistances(wide, turn))[0][0]

        steps = 1e-5 * torch.eye(4).double().reshape(2, 2, 1, 2, 2)
        slopes = [
            [(levels(distance + steps[e, s]) - levels(distance - steps[e, s])) / 2e-5 for s in (0, 1)] for e in (0, 1)
        ]
        moves = torch.stack([gain[0] @ slope for row in slopes for slope in row]).reshape(2, 2, 2)
        own = torch.tensor([[[4e-4, 1e-4], [1e-4, 9e-4]]], dtype=torch.float64)
        normals = torch.stack([-parameters[0, 2:4].sin(), parameters[0, 2:4].cos()], -1)
        added = torch.zeros(2, 2).double()
        for _ in range(2):
            variance = 2.0 * torch.einsum("ei,ij,ej->e", normals, own[0] + added, normals)
            added = torch.einsum("e,esi,esj->ij", variance, moves, moves)
        lines = LineDistances(distance[..., None].expand(1, 2, 2, len(window.places)), turn)
        found = line_covariance(parameters, window, bend, lines, gain, own)
        torch.testing.assert_close(found[0], added, rtol=1e-4, atol=0)
        assert float(added.diagonal().min()) > 0.0

    @pytest.mark.parametrize(("first", "second"), [(0.2, 1.5), (-0.6, 1.0), (1.0, 2.4)])
    def test_fits_begin_with_the_asymptotes_of_a_saddle(self, first: float, second: float) -> None:
        offset = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
        window = windows_about(offset, 5.0)
        x, y = (window.where - offset).unbind(-1)
        product = (math.cos(first) * y - math.sin(first) * x) * (math.cos(second) * y - math.sin(second) * x)
        levels = (100.0 + 2.0 * x + 3.0 * product)[None]
        parameters, crosses = _start(with_levels(window, levels))
        assert bool(crosses.all())
        found = sorted((angle % math.pi) for angle in parameters[0, 2:4].tolist())
        assert found == pytest.approx(sorted((first % math.pi, second % math.pi)))
        assert parameters[0, :2].tolist() == [0.3, -0.2]
        # A fifth of the radius, within 0.6 and 1.5 px.
        assert float(parameters[0, 4].exp()) == pytest.approx(1.0)
        # Mean and contrast by weighted least squares of the model.
        shape = parameters.clone()
        shape[:, 5], shape[:, 6] = 0.0, 1.0
        design = np.stack([np.ones(window.size**2), crossing(shape, window.where, torch.zeros(1, 2))[0][0].numpy()], -1)
        root = window.weight[0].sqrt().numpy()
        best = np.linalg.lstsq(design * root[:, None], levels[0].numpy() * root, rcond=None)[0]
        assert parameters[0, 5:7].tolist() == pytest.approx(best.tolist())
        assert not bool(_start(with_levels(window, (x * x + 0.5 * y * y)[None]))[1].any())
        for radius, blur in ((2.5, 0.6), (12.0, 1.5)):
            wide = windows_about(offset, radius)
            assert float(_start(with_levels(wide, levels))[0][0, 4].exp()) == pytest.approx(blur)

    @pytest.mark.parametrize(("side", "blur", "radius", "near"), [
        (4.0, 0.3, 2.5, False), (16.0, 0.8, 8.0, False), (30.0, 0.8, 12.0, False), (12.0, 2.2, 9.0, True),
    ])  # fmt: skip
    def test_windows_of_half_a_square_and_wider_where_lines_are_near(
        self, side: float, blur: float, radius: float, near: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        x = torch.arange(61.0, dtype=torch.float64)

        def stripes(at: Tensor) -> Tensor:
            lines = [torch.erf((at - k * side) / (blur * math.sqrt(2.0))) * (-1) ** k for k in range(-9, 10)]
            return torch.stack(lines).sum(0)

        image = 128.0 + 80.0 * torch.outer(stripes(x - 30.2), stripes(x - 29.7))
        step = side * torch.tensor([[[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]]], dtype=torch.float64)
        around = Neighbors(step, torch.zeros_like(step), torch.zeros(1, 4).bool())
        start = torch.tensor([[[30.0, 30.0]]], dtype=torch.float64)
        sides = torch.tensor([[side]], dtype=torch.float64)
        fit = fit_crossings(image[None], start, sides, None, around, 0.0)
        assert float(fit.window.radius) == pytest.approx(radius)
        assert fit.near.tolist() == [near]
        assert fit.center[0].tolist() == pytest.approx([-0.3, 0.2], abs=0.02)
        assert float(fit.blur) == pytest.approx(blur, rel=0.03)
        # How much the board's light counts for a corner follows from the noise of gray levels.
        noise: list[float] = []
        prior = RampPrior.of
        monkeypatch.setattr(RampPrior, "of", lambda p, m, e, v: (noise.append(float(v)), prior(p, m, e, v))[1])
        fit_crossings(image[None] + 3.0 * draw(1, 61, 61), start, sides, None, around, 0.0)
        assert noise[0] == 0.0
        assert len(noise) == 2 + near
        assert noise[1:] == pytest.approx([9.0] * (1 + near), rel=0.3)
        # A marker in the square leaves less than half of it.
        narrow = fit_crossings(image[None], start, 0.9 * sides, None, around, 0.0)
        assert float(narrow.window.radius) == pytest.approx(min(max(0.45 * side, 2.5), 12.0))

    def test_a_window_has_all_pixels_within_its_radius(self) -> None:
        image = torch.arange(900.0).reshape(1, 30, 30).double()
        base, offset = torch.tensor([[[14.0, 16.0]]]), torch.tensor([[0.5, -0.5]], dtype=torch.float64)
        window, levels = cut_windows(image, base, offset, torch.tensor([4.0]))
        y, x = np.mgrid[:30, :30]
        weight = np.clip(4.5 - np.hypot(x - 14.5, y - 15.5), 0.0, 1.0)
        assert float(window.weight.sum()) == pytest.approx(weight.sum())
        assert float((window.weight * levels).sum()) == pytest.approx((weight * image[0].numpy()).sum())


def model(p: NDArray[np.float64], where: NDArray[np.float64]) -> NDArray[np.float64]:
    """Light of a blurred ellipse and a ramp at places (K, 2)."""
    B = np.array([[p[2], p[3]], [p[3], p[4]]])
    w = (where - p[:2]) @ B
    rho = np.linalg.norm(w, axis=1)
    distance = (rho**2 - rho) / np.linalg.norm(w @ B, axis=1)
    light: NDArray[np.float64] = p[5] + p[6] * 0.5 * erfc(distance / p[7] / math.sqrt(2.0)) + where @ p[8:]
    return light


class TestEllipses:
    def test_normal_equations_are_those_of_differences(self) -> None:
        p = np.array([0.3, -0.2, 0.16, 0.03, 0.2, 200.0, -150.0, 0.9, 0.1, -0.2])
        where = np.array([(x, y) for x in range(-9, 10, 2) for y in range(-9, 10)], dtype=float)
        steps = 1e-6 * np.eye(10)
        slopes = np.stack([(model(p + step, where) - model(p - step, where)) / 2e-6 for step in steps], -1)
        levels = 100.0 + draw(len(where)).numpy()
        weight = draw(len(where), seed=1).abs().numpy()
        arguments = (torch.from_numpy(part)[None] for part in (p, where, levels, weight))
        cost, normal, gradient = _system(*arguments)
        residual = model(p, where) - levels
        assert float(cost) == pytest.approx((weight * residual**2).sum())
        np.testing.assert_allclose(gradient[0], slopes.T @ (weight * residual), rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(normal[0], (slopes.T * weight) @ slopes, rtol=1e-4, atol=1e-3)

    def test_covariance_and_misfit_are_those_of_least_squares(self) -> None:
        truth = np.array([0.3, -0.2, 0.16, 0.03, 0.2, 200.0, -150.0, 0.9, 0.1, -0.2])
        y, x = np.mgrid[:41, :41]
        image = model(truth, np.stack([x - 20.0, y - 20.0], -1).reshape(-1, 2)).reshape(41, 41)
        image = image + 2.0 * draw(41, 41).numpy()
        start, shape = torch.tensor([[20.4, 19.6]], dtype=torch.float64), torch.eye(2).double()[None] / 6.0
        reach = torch.tensor([1.7], dtype=torch.float64)
        found = fit_ellipses(image, start, shape, reach)
        assert found.converged.tolist() == [True]
        assert found.center[0].tolist() == pytest.approx([20.3, 19.8], abs=0.1)
        offset = (found.center - start)[0].tolist()
        b = found.shape[0]
        where, levels, weight = (part[0].numpy() for part in _pixels(image, start, shape, reach))
        inside = np.hypot(*(where.T)) <= 1.7 * 6.0
        assert int(weight.sum()) == int(inside.sum()) == int((np.hypot(x - 20.4, y - 19.6) <= 10.2).sum())
        base = np.array([*offset, float(b[0, 0]), float(b[0, 1]), float(b[1, 1])])
        used = weight > 0

        def light(edge: NDArray[np.float64], rest: NDArray[np.float64]) -> NDArray[np.float64]:
            return model(np.concatenate([edge, rest]), where[used])

        # The rest is linear but for the blur: the best for this edge is what the fit has.
        columns = np.stack(
            [np.ones(used.sum()), light(base, np.array([0, 1.0, float(found.blur), 0, 0])), *where[used].T], -1
        )
        best = np.linalg.lstsq(columns, levels[used], rcond=None)[0]
        assert float(found.contrast) == pytest.approx(best[1], rel=1e-4)
        p = np.array([*base, best[0], best[1], float(found.blur), *best[2:]])
        slopes = np.stack(
            [(model(p + step, where[used]) - model(p - step, where[used])) / 2e-6 for step in 1e-6 * np.eye(10)], -1
        )
        rest = levels[used] - model(p, where[used])
        noise = (rest**2).sum() / (used.sum() - 10)
        np.testing.assert_allclose(found.covariance[0], noise * np.linalg.inv(slopes.T @ slopes)[:2, :2], rtol=1e-3)
        assert float(found.misfit) == pytest.approx(math.sqrt(noise) / 150.0, rel=0.05)

    def test_large_ellipses_are_fitted_to_every_other_row_and_column(self) -> None:
        image = np.zeros((200, 200))
        for radius, stride in ((42.0, 1), (43.0, 2), (64.0, 2), (65.0, 3)):
            where, _, weight = _pixels(
                image,
                torch.tensor([[100.0, 100.0]], dtype=torch.float64),
                torch.eye(2).double()[None] / radius,
                torch.tensor([1.0]),
            )
            kept = where[0][weight[0] > 0]
            assert kept[:, 0].unique().diff().unique().tolist() == [stride]
            assert kept[:, 1].unique().diff().unique().tolist() == [stride]
        # The image ends.
        _, _, weight = _pixels(
            image,
            torch.tensor([[0.0, 199.0]], dtype=torch.float64),
            torch.eye(2).double()[None] / 3.0,
            torch.tensor([1.0]),
        )
        assert int(weight.sum()) == 4 + 3 + 3 + 1

    @pytest.mark.parametrize(("change", "status"), [
        ({}, CornerStatus.GOOD),
        ({"center": (6.4, 50.0)}, CornerStatus.OUTSIDE), ({"center": (6.6, 50.0)}, CornerStatus.GOOD),
        ({"center": (92.6, 50.0)}, CornerStatus.OUTSIDE), ({"center": (92.4, 50.0)}, CornerStatus.GOOD),
        ({"center": (50.0, 5.4)}, CornerStatus.OUTSIDE), ({"center": (50.0, 5.6)}, CornerStatus.GOOD),
        ({"center": (50.0, 73.6)}, CornerStatus.OUTSIDE), ({"center": (50.0, 73.4)}, CornerStatus.GOOD),
        ({"contrast": 20.0}, CornerStatus.NO_SADDLE),
        ({"misfit": 0.21}, CornerStatus.OCCLUDED), ({"misfit": 0.19}, CornerStatus.GOOD),
        ({"blur": 2.3}, CornerStatus.BLURRED), ({"blur": 2.2}, CornerStatus.GOOD),
        ({"moved": 2.3}, CornerStatus.MOVED), ({"moved": 2.2}, CornerStatus.GOOD),
        ({"converged": False}, CornerStatus.NOT_CONVERGED),
    ])  # fmt: skip
    def test_which_circles_are_good(self, change: dict[str, float], status: CornerStatus) -> None:
        """Of half axes 5 and 4 px, hence of the size of a circle of 4.47 px, in an image of 100 x 80."""
        values: dict[str, object] = {
            "center": (50.0, 40.0),
            "blur": 1.5,
            "contrast": -90.0,
            "misfit": 0.05,
            "moved": 0.1,
        }
        values |= {"converged": True, **change}

        def both(value: object, usual: object) -> Tensor:
            return torch.tensor([value, usual, usual])

        found = Ellipses(
            center=both(values["center"], (40.0, 40.0)).double(),
            shape=torch.diag(torch.tensor([1 / 5.0, 1 / 4.0])).double().expand(3, 2, 2),
            covariance=torch.eye(2).double().expand(3, 2, 2),
            blur=both(values["blur"], 1.0).double(),
            contrast=both(values["contrast"], -100.0).double(),
            misfit=both(values["misfit"], 0.05).double(),
            converged=both(values["converged"], True),
        )
        start = found.center + torch.tensor([[values["moved"], 0.0], [0.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
        refined = _with_statuses(np.zeros((80, 100), np.uint8), start, found)
        assert refined.status.tolist() == [int(status), 0, 0]
        good = status == CornerStatus.GOOD
        assert bool(torch.isfinite(refined.covariance[0]).all()) == good
        assert refined.blur[0].tolist() == (
            pytest.approx(values["blur"]) if good else pytest.approx(math.nan, nan_ok=True)
        )
        torch.testing.assert_close(refined.pixels[1:], found.center[1:])


# What the fit of shifts of patches computes, against dense matrices of NumPy and values by hand.


UNUSED = torch.zeros(0)


def ramps(count: int, height: int, width: int) -> ImageWindows:
    """Windows whose gray levels grow by 2 per column and 3 per row of the whole image."""
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    corner = torch.tensor([[10.0, 20.0]], dtype=torch.float64).expand(count, 2)
    values = 2.0 * (x + 10.0) + 3.0 * (y + 20.0)
    return ImageWindows(values.expand(count, -1, -1), torch.zeros(count, height, width), corner, (400, 300), 0)


class TestShifts:
    def test_residuals_of_ramps(self) -> None:
        """Of a sheared patch: right(moved + slopes shift) - gain template - offset - ramp, and its derivatives."""
        grid = grid_of((2, 1), torch.device("cpu"))  # three rows of five
        template = draw(1, 3, 5)
        moved = (grid + torch.tensor([25.0, 32.0]))[None]
        slopes = torch.tensor([[1.1, -0.2], [0.1, 0.9]], dtype=torch.float64)
        across, down = slopes[:, 0], slopes[:, 1]
        patches = _Patches(template, ramps(1, 30, 40), moved, slopes.expand(1, 3, 5, 2, 2), torch.ones(1, 3, 5), grid)
        theta = torch.tensor([[0.4, -0.3, 1.5, 7.0, 0.02, -0.05, 0.6, -0.9]], dtype=torch.float64)
        residual, slope, design = _residual(patches, theta)
        ahead = 0.4 + 0.02 * grid[..., 0] - 0.05 * grid[..., 1]
        at = moved[0] + ahead[..., None] * across - 0.3 * down
        wanted = 2.0 * at[..., 0] + 3.0 * at[..., 1] - 1.5 * template[0] - 7.0
        wanted = wanted - 0.6 * grid[..., 0] + 0.9 * grid[..., 1]
        torch.testing.assert_close(residual[0], wanted.flatten())
        # A step along the first axis is (1.1, 0.1) px, along the second (-0.2, 0.9).
        assert slope[0, 4].tolist() == pytest.approx([2.2 + 0.3, -0.4 + 2.7])
        columns = torch.stack(
            [torch.full((15,), 2.5).double(), torch.full((15,), 2.3).double(), -template.flatten(),
             -torch.ones(15).double(), 2.5 * grid[..., 0].flatten(), 2.5 * grid[..., 1].flatten(),
             -grid[..., 0].flatten(), -grid[..., 1].flatten()], -1)  # fmt: skip
        torch.testing.assert_close(design[0], columns)
        assert _residual(patches._replace(grid=None), theta[:, :4])[2].shape == (1, 15, 4)

    def test_scales_are_weighted_medians(self) -> None:
        residual = torch.tensor(
            [[1.0, -2.0, 3.0, -4.0], [1.0, -2.0, 3.0, -4.0], [5.0, 5.0, 0.0, 0.0]], dtype=torch.float64
        )
        weight = torch.tensor([[1.0, 1.0, 1.0, 1.0], [0.1, 0.1, 1.0, 0.1], [0.0, 0.0, 1.0, 1.0]], dtype=torch.float64)
        assert _scale(residual, weight).tolist() == pytest.approx([1.4826 * 2.0, 1.4826 * 3.0, 1e-9])

    def test_weights_by_the_residuals_nearby(self) -> None:
        """Zero from three standard deviations; a single one counts as much as the kernel says."""
        patches = _Patches(torch.zeros(2, 7, 9), ramps(2, 9, 9), UNUSED, UNUSED, UNUSED, None)
        flat = torch.tensor([[1.5], [6.5]], dtype=torch.float64).expand(2, 63)
        weight = _biweight(flat, torch.tensor([1.0, 2.0], dtype=torch.float64), patches)
        assert weight[0].tolist() == pytest.approx([(1.0 - 0.25) ** 2] * 63)
        assert weight[1].tolist() == [0.0] * 63
        single = torch.zeros(2, 7, 9).double()
        single[0, 3, 4] = 2.0
        weight = _biweight(single.flatten(1), torch.ones(2).double(), patches).reshape(2, 7, 9)
        kernel = gaussian_kernel(1.0, 2).numpy()
        wanted = np.ones((7, 9))
        wanted[1:6, 2:7] = (1.0 - 4.0 * np.outer(kernel, kernel) / 9.0) ** 2
        np.testing.assert_allclose(weight[0], wanted)

    @pytest.mark.parametrize("sheared", [False, True])
    @pytest.mark.parametrize("alike", [False, True])
    def test_covariance_is_that_of_dense_matrices(self, alike: bool, sheared: bool) -> None:
        """Also where residuals nearby are alike: then what they add up to counts."""
        height, width, n = 7, 9, 63
        grid = grid_of((4, 3), torch.device("cpu")) if sheared else None
        blur = gaussian_kernel(1.2, 4)
        smooth = torch.nn.functional.conv2d(20.0 * draw(1, 1, height + 8, width + 8), blur[None, None, None])
        template = torch.nn.functional.conv2d(smooth, blur[None, None, :, None])[0]
        # In turn above and below zero.
        residual = draw(1, n, seed=3).abs() * (1.0 - 2.0 * (torch.arange(n) % 2))
        if alike:
            rough = torch.nn.functional.conv2d(draw(1, 1, height + 8, width + 8, seed=3), blur[None, None, None])
            residual = 9.0 * torch.nn.functional.conv2d(rough, blur[None, None, :, None])[0].flatten(1)
        theta = torch.tensor([[0.1, 0.2, 1.3, 4.0, 0.01, 0.02, 0.3, -0.1][: 8 if sheared else 4]], dtype=torch.float64)
        robust = 0.3 + draw(1, n, seed=4).abs().clamp_max(1.0)
        padded = np.pad(template[0].numpy(), 1, mode="edge")
        along = 0.5 * (padded[1:-1, 2:] - padded[1:-1, :-2])
        across = 0.5 * (padded[2:, 1:-1] - padded[:-2, 1:-1])
        own = 1.3 * np.stack([along.ravel(), across.ravel()], -1)
        slope = own + 0.1 * draw(n, 2, seed=6).numpy()
        patches = _Patches(template, ramps(1, 9, 9), UNUSED, UNUSED, UNUSED, grid)
        found, sound = _covariance(patches, theta, residual, torch.from_numpy(slope)[None], robust)
        assert sound.tolist() == [True]

        w, r = robust[0].numpy(), residual[0].numpy()
        mixed = 0.5 * (own + slope)
        free = [template[0].flatten().numpy(), np.ones(n)]
        if grid is not None:
            free += [mixed[:, 0] * grid[..., k].flatten().numpy() for k in (0, 1)]
            free += [grid[..., k].flatten().numpy() for k in (0, 1)]
        design, root = np.stack(free, -1), np.sqrt(w)

        def beyond(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return values - design @ np.linalg.lstsq(design * root[:, None], values * root[:, None], rcond=None)[0]

        normal = (own.T * w) @ beyond(slope)
        inverse = np.linalg.inv(0.5 * (normal + normal.T))
        sigma = math.sqrt(0.8**2 + 1.0 / 6.0)
        y, x = np.divmod(np.arange(n), width)

        def spread_by(kernel: NDArray[np.float64]) -> NDArray[np.float64]:
            """(pixels anywhere, n): what each pixel becomes."""
            reach = len(kernel) // 2
            rows, columns = np.mgrid[-reach : height + reach, -reach : width + reach].reshape(2, -1)
            dy, dx = rows[:, None] - y, columns[:, None] - x
            near = (abs(dy) <= reach) & (abs(dx) <= reach)
            return np.where(
                near, kernel[np.clip(dy, -reach, reach) + reach] * kernel[np.clip(dx, -reach, reach) + reach], 0.0
            )

        kernel = np.exp(-0.5 * (np.arange(-4, 5) / sigma) ** 2)
        kernel /= kernel.sum()
        left = float((kernel**2).sum()) ** 2  # the variance that blur leaves of noise
        # Of a sheared fit, the part of the noise that lies in the space of its columns; else a degree for each unknown.
        columns = np.concatenate([design, mixed], 1)
        blurred = spread_by(kernel) @ (w[:, None] * columns)
        taken = np.trace(np.linalg.inv((columns.T * w) @ columns) @ blurred.T @ blurred) if sheared else 4.0
        freedom = max(1.0 - taken / (w.sum() * left), 0.2)
        noise = (w * r**2).sum() / w.sum() / (left * freedom)
        force = w[:, None] * beyond(mixed)
        blurred = spread_by(kernel) @ force
        middle = noise * blurred.T @ blurred
        pull = force * r[:, None]
        triangle = 1.0 - abs(np.arange(-4, 5)) / 5.0
        rows, columns = np.mgrid[-4 : height + 4, -4 : width + 4].reshape(2, -1)
        inner = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        wider = spread_by(triangle)[inner] @ pull
        excess = max(1.0, np.linalg.solve(middle, pull.T @ wider / freedom).diagonal().mean())
        assert bool(excess > 1.0) == alike
        np.testing.assert_allclose(found[0], excess * inverse @ middle @ inverse, rtol=1e-5)


# Correlation of patches against NumPy's, and what only the ratios of weights may decide.


DRAW = torch.Generator().manual_seed(6)


def random(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=DRAW).double()


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
def test_flat_where_it_counts(scale: float) -> None:
    """Contrast of one in a hundred thousand of the level is texture, of one in ten million is not."""
    template, weight = 100.0 + random(4, 5, 6), scale * random(4, 5, 6)
    template[1] = 100.0
    template[2] = 100.0 + 1e-3 * (template[2] - 100.0)
    template[3] = 100.0 + 1e-5 * (template[3] - 100.0)
    assert is_textured(template, weight).tolist() == [True, False, True, False]
    weight[0, 1:] = 0.0
    template[0, 0] = 100.0
    assert not bool(is_textured(template, weight)[0])
    assert not bool(is_textured(template, torch.zeros(4, 5, 6)).any())


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_correlation_is_that_of_numpy(scale: float) -> None:
    """Of weighted values at every whole shift; brightness and contrast do not matter; not over what is unusable."""
    template, wide, weight = random(2, 4, 5), 50.0 + 9.0 * random(2, 6, 8), random(2, 4, 5)
    usable = torch.ones(2, 6, 8, dtype=torch.bool)
    usable[1, 5, 7] = False
    found = weighted_correlation(template, scale * weight, wide, usable)
    assert found.shape == (2, 3, 4)
    for k in range(2):
        for i in range(3):
            for j in range(4):
                part = wide[k, i : i + 4, j : j + 5].flatten().numpy()
                cov = np.cov(template[k].flatten().numpy(), part, aweights=weight[k].flatten().numpy())
                wanted = cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1])
                assert float(found[k, i, j]) == pytest.approx(-1.0 if (k, i, j) == (1, 2, 3) else wanted)
    assert weighted_correlation(3.0 * template - 7.0, weight, 0.2 * wide + 30.0, usable) == pytest.approx(found)
    assert weighted_correlation(torch.ones(2, 4, 5).double(), weight, wide, usable).tolist() == [[[-1.0] * 4] * 3] * 2
    # One place each, and one template for all.
    some = random(3, 4, 5)
    one = weighted_correlation(template[:1], weight[:1], some, torch.ones(3, 4, 5, dtype=torch.bool))
    for k in range(3):
        own = weighted_correlation(template[:1], weight[:1], some[k : k + 1], usable[:1, :4, :5])
        assert float(one[k]) == pytest.approx(float(own))


def test_the_highest_and_its_rival() -> None:
    """The rival is another peak, farther than three steps, not at the first or last column."""
    assert RIVAL_DISTANCE == 3.0
    places = torch.stack(torch.meshgrid(torch.arange(9.0), torch.arange(5.0), indexing="xy"), -1)
    scores = torch.zeros(1, 5, 9)
    scores[0, 1, 2] = 0.9
    for (row, column), value, rival in (
        ((1, 5), 0.7, 0.0),
        ((1, 6), 0.7, 0.7),
        ((4, 2), 0.7, 0.0),
        ((4, 3), 0.7, 0.7),
        ((1, 8), 0.7, 0.0),
        ((4, 0), 0.7, 0.0),
        ((3, 7), -0.1, 0.0),
    ):
        some = scores.clone()
        some[0, row, column] = value
        peak = highest_peak(some, places)
        assert int(peak.number) == 11
        assert peak.place.tolist() == [[2.0, 1.0]]
        assert float(peak.score) == pytest.approx(0.9)
        assert float(peak.rival) == pytest.approx(rival)
        assert not bool(peak.edge)
    # A slope is no peak.
    slope = torch.linspace(1.0, 0.0, 9).expand(1, 5, 9).clone()
    slope[0, 2, 1] = 2.0
    assert float(highest_peak(slope, places).rival) == -1.0
    for column in (0, 8):
        edge = torch.zeros(1, 5, 9)
        edge[0, 3, column] = 1.0
        assert bool(highest_peak(edge, places).edge)
