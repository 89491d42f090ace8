"""Parts of fits to stars against hand calculations: turns, refraction, clocks, joint posteriors, rough lenses."""

import dataclasses
import datetime
import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from kcal import Camera, InputError
from kcal.calibrate.problem.parameters import FreeParameters, GaussianPrior, GaussianTerm
from kcal.calibrate.problem.state import BoardState
from kcal.gaussian import Gaussian, triangular
from kcal.lens.information import CameraInformation
from kcal.lens.pose import enu_from_cam, rotation_from_vector, seen_turned
from kcal.lens.projection import FAR
from kcal.solve.lm import LMOptions, minimize
from kcal.stars.detect import DetectedStars, NightPlan, _signal
from kcal.stars.lens import (
    Agreement,
    _agreement_with,
    _ahead,
    _by_camera,
    _directions,
    _near_middle,
    _plain_cameras,
    _plain_of,
    _search,
    _star_noise,
    _with_star_rows,
)
from kcal.stars.lens_fit import StarField, StarViews, lens_rows, star_state
from kcal.stars.night import (
    Attitude,
    NamedStars,
    SkyView,
    _by_air,
    _by_clock,
    _part,
    _reach,
    clock_doubts,
    fit_attitude,
    refraction_doubt,
)
from kcal.stars.sky import (
    EARTH_RATE,
    StarCatalog,
    _triangles,
    celestial_directions,
    observed_directions,
    pair_table,
    pole_in_enu,
    unit_vectors,
)
from scripts.check.stars import PLACE, TIME, night_camera, star_pixels

CATALOG = StarCatalog.bundled()
CAMERA = night_camera()
LOOK = (130.0, 35.0, 2.0)
TURN = enu_from_cam(*LOOK).T


def tensor(*rows: Any) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def scattered(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions in the world and pixels of stars all over the image of a camera that looks along `TURN`."""
    pixels = torch.from_numpy(np.random.default_rng(seed).uniform((20, 20), (940, 580), (count, 2)))
    rays, _ = CAMERA.unproject(pixels)
    return torch.nn.functional.normalize(rays, dim=-1) @ TURN, pixels


class TestTurns:
    def test_derivatives_by_a_turn(self) -> None:
        directions, pixels = scattered(7)
        seen, rows = seen_turned(CAMERA, FAR * directions, TURN)
        torch.testing.assert_close(seen, pixels.T, rtol=0, atol=1e-9)
        for axis in range(3):
            step = torch.zeros(3).double()
            step[axis] = 1e-6
            ends = [seen_turned(CAMERA, FAR * directions, rotation_from_vector(s * step) @ TURN)[0]
                    for s in (1, -1)]  # fmt: skip
            torch.testing.assert_close(rows[axis], (ends[0] - ends[1]) / 2e-6, rtol=1e-6, atol=1e-4)

    def fitted(self, off: float = 0.0, seed: int = 1) -> tuple[Attitude, torch.Tensor, np.ndarray]:
        directions, pixels = scattered(40)
        sigma = np.full(40, 0.1)
        noise = off * np.random.default_rng(seed).normal(size=(40, 2))
        start = rotation_from_vector(tensor(1e-3, -5e-4, 8e-4)) @ TURN
        found = fit_attitude(pixels.numpy() + noise, sigma, directions.numpy(), np.full(40, 3.0), CAMERA, start.numpy())
        assert found is not None
        return found, directions, noise

    def test_an_attitude_has_the_covariance_of_its_turn_in_the_world(self) -> None:
        found, directions, noise = self.fitted(0.3)
        named = found.star >= 0
        assert found.count == int(named.sum()) > 30
        # χ² of residuals in their sigmas over the degrees of freedom.
        off = found.residual[named]
        there, _ = seen_turned(CAMERA, FAR * directions[found.star[named]], found.rotation)
        marked = seen_turned(CAMERA, FAR * directions[named], TURN)[0].T.numpy() + noise[named]
        np.testing.assert_allclose(off, there.T.numpy() - marked, atol=1e-6)
        widened = math.sqrt(((off / 0.1) ** 2).sum() / (2 * len(off) - 3))
        assert found.widened == pytest.approx(widened)
        assert found.widened == pytest.approx(3.0, rel=0.2)
        assert found.rms_px == pytest.approx(math.sqrt((off**2).mean()))
        # By differences of a turn of the world, which comes before the rotation.
        rows = []
        for axis in range(3):
            step = torch.zeros(3).double()
            step[axis] = 1e-6
            ends = [
                seen_turned(
                    CAMERA, FAR * directions[found.star[named]], found.rotation @ rotation_from_vector(s * step)
                )[0]
                for s in (1, -1)
            ]
            rows.append(((ends[0] - ends[1]) / 2e-6 / 0.1).flatten())
        by_hand = torch.linalg.inv(torch.stack(rows) @ torch.stack(rows).T) * widened**2
        torch.testing.assert_close(found.covariance, by_hand, rtol=1e-5, atol=0)
        exact, _, _ = self.fitted(0.0)
        assert exact.widened == 1.0
        torch.testing.assert_close(exact.rotation, TURN, rtol=0, atol=1e-9)

    def test_one_star_that_is_off_is_left_out(self) -> None:
        directions, pixels = scattered(40)
        moved = pixels.numpy().copy()
        moved[5] += [1.5, -1.0]
        found = fit_attitude(moved, np.full(40, 0.1), directions.numpy(), np.full(40, 3.0), CAMERA, TURN.numpy())
        assert found.star[5] == -1
        assert np.isnan(found.residual[5]).all()
        assert found.count == 39
        few = fit_attitude(moved[:2], np.full(2, 0.1), directions.numpy(), np.full(40, 3.0), CAMERA, TURN.numpy())
        assert few is None


class TestRefraction:
    def directions(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Straight and refracted: straight up they are not bent; lower stars are lifted."""
        straight, _ = scattered(40)
        lifted = straight + 2e-3 * torch.stack([0 * straight[:, 0], 0 * straight[:, 0], 1 - straight[:, 2] ** 2], -1)
        return straight, torch.nn.functional.normalize(lifted, dim=-1)

    def doubt(self, share: float, sigma: float = 0.1) -> str | None:
        """Stars that are refracted by a share of what they should be."""
        straight, refracted = self.directions()
        true = torch.nn.functional.normalize(straight + share * (refracted - straight), dim=-1)
        at, seen = (seen_turned(CAMERA, FAR * one, TURN)[0].T.numpy() for one in (refracted, true))
        star = np.arange(40)
        star[3] = -1
        residual = np.where(star[:, None] >= 0, at - seen, np.nan)
        looked = Attitude(rotation=TURN, covariance=torch.eye(3), star=star, residual=residual, rms_px=0.1, widened=1.0)
        used = star >= 0
        return refraction_doubt(looked, np.full(39, sigma), refracted[used], straight[used], CAMERA)

    def test_it_is_told_by_how_much(self) -> None:
        assert self.doubt(1.0) is None
        for share, side in ((0.4, "higher"), (1.7, "lower")):
            text = self.doubt(share, 0.01)
            # A little of it looks like a turn, which is not in the residuals here.
            assert float(text.split()[2]) == pytest.approx(share, abs=0.01)
            assert f"the stars stand {side} than" in text
        assert self.doubt(0.4, 10.0) is None

    def test_what_a_good_lens_errs_is_no_doubt(self) -> None:
        """However sure: only where the pattern that no turn explains differs by more than .04 px, root mean square."""
        straight, refracted = self.directions()
        used = torch.arange(40) != 3
        (at, rows), (without, _) = (seen_turned(CAMERA, FAR * one[used], TURN) for one in (refracted, straight))
        pattern, turns = (at - without).flatten().numpy(), rows[:3].flatten(1).T.numpy()
        own = pattern - turns @ np.linalg.lstsq(turns, pattern, rcond=None)[0]
        size = float(np.sqrt((own**2).mean()))
        for excess, told in ((0.036, False), (-0.036, False), (0.044, True), (-0.044, True)):
            assert (self.doubt(1.0 - excess / size, 1e-4) is not None) is told

    def test_without_air_there_is_nothing_to_tell(self) -> None:
        straight, _ = scattered(9)
        looked = Attitude(rotation=TURN, covariance=torch.eye(3), star=np.arange(9), residual=np.ones((9, 2)),
                          rms_px=0.1, widened=1.0)  # fmt: skip
        assert refraction_doubt(looked, np.ones(9), straight, straight, CAMERA) is None


def image_of(rotation: torch.Tensor, on_earth: bool = True, spread: float = 1e-6) -> NamedStars:
    looked = Attitude(rotation=rotation, covariance=spread**2 * torch.eye(3).double(), star=np.arange(3),
                      residual=np.zeros((3, 2)), rms_px=0.1, widened=1.0)  # fmt: skip
    return NamedStars(
        detected=DetectedStars(np.zeros((3, 2)), np.ones(3), np.ones(3), 0.1, {}),
        view=SkyView(time=TIME, origin=PLACE), attitude=looked, directions=np.eye(3), on_earth=on_earth,
        covariance=looked.covariance, warnings=(),
    )  # fmt: skip


class TestClocks:
    def turned(self, seconds: float, aside: float = 0.0, **more: Any) -> list[tuple[int, str]]:
        """The second image turned about the pole as by a wrong time, and aside by some degrees."""
        pole = torch.from_numpy(pole_in_enu(PLACE.lat))
        turn = rotation_from_vector(EARTH_RATE * seconds * pole + math.radians(aside) * tensor(1.0, 0.0, 0.0))
        return clock_doubts([image_of(TURN), image_of(TURN @ turn, **more)])

    def test_a_wrong_time_is_told_with_its_sign(self) -> None:
        ((number, text),) = self.turned(3600.0)
        assert number == 1
        assert "by +15.041° since" in text
        assert "wrong by 3600 s (1.00 h)" in text
        assert "by -15.041°" in self.turned(-3600.0)[0][1]

    def test_what_a_mast_does_is_no_doubt(self) -> None:
        # 0.02 degrees are 4.8 s.
        assert self.turned(4.0) == []
        assert len(self.turned(6.0)) == 1
        assert self.turned(3600.0, 0.1) == []
        assert len(self.turned(3600.0, 0.015)) == 1
        # Where attitudes are not better known, five sigmas of both more: 1e-4 rad are 1.9 s.
        assert self.turned(11.0, spread=1e-4) == []
        assert len(self.turned(13.0, spread=1e-4)) == 1

    def test_images_that_are_not_on_the_earth_are_no_witness(self) -> None:
        assert self.turned(3600.0, on_earth=False) == []
        turn = rotation_from_vector(EARTH_RATE * 600.0 * torch.from_numpy(pole_in_enu(PLACE.lat)))
        images = [
            image_of(torch.eye(3).double(), on_earth=False),
            image_of(TURN),
            image_of(TURN),
            image_of(TURN @ turn),
        ]
        assert [number for number, _ in clock_doubts(images)] == [3]


class TestPosterior:
    def lens(self) -> CameraInformation:
        """Two unknowns of a lens and one of a board, which boards and others tell, and a prior of all."""
        draw = torch.Generator().manual_seed(1)
        rows = torch.randn(7, 3, dtype=torch.float64, generator=draw)
        others = torch.randn(2, 2, dtype=torch.float64, generator=draw)
        known = CameraInformation(
            slots=(0, 1, -1), estimate=tensor(1.0, 2.0, 3.0), rows=rows,
            residuals=torch.zeros(7).double(), mean=tensor(0.5, 2.5, 3.2), sigma=tensor(0.7, 0.9, 0.4),
            others=others,
        )  # fmt: skip
        # At its minimum.
        step = -torch.linalg.lstsq(known.whole.rows[:, :-1], known.whole.rows[:, -1:]).solution[:, 0]
        return CameraInformation(
            slots=known.slots, estimate=known.estimate + step, rows=rows, residuals=rows @ step, mean=known.mean,
            sigma=known.sigma, others=torch.cat([others[:, :1], others[:, 1:] + others[:, :1] * step[2]], 1),
        )  # fmt: skip

    def test_rows_of_stars_move_the_board_along(self) -> None:
        """Against one least squares of everything at once."""
        known = self.lens()
        assert float((known.whole.rows[:, :-1].T @ known.whole.rows[:, -1]).abs().max()) < 1e-12
        stars = torch.randn(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
        wide = torch.cat([stars[:, :2], torch.zeros(4, 1).double(), stars[:, 2:]], 1)
        every = torch.cat([known.whole.rows, wide])
        step = -torch.linalg.lstsq(every[:, :-1], every[:, -1:]).solution[:, 0]
        moved = torch.cat([stars[:, :2], (stars[:, 2] + stars[:, :2] @ step[:2])[:, None]], 1)
        found = _with_star_rows(known, moved, step[:2])
        torch.testing.assert_close(found.estimate, known.estimate + step)
        rows = found.whole.rows
        assert float((rows[:, :-1].T @ rows[:, -1]).abs().max()) < 1e-10
        half = found.half()
        torch.testing.assert_close(half.T @ half, torch.linalg.inv(every[:, :-1].T @ every[:, :-1]))

    @pytest.mark.parametrize("alone", [False, True])
    def test_agreement_is_that_of_two_measurements(self, alone: bool) -> None:
        """One unknown known to .5 by boards, which stars tell to .1 (or to 2): the difference over its sigma."""
        boards, told, far = 0.5, 2.0 if alone else 0.1, 1.2
        known = CameraInformation(
            slots=(0,), estimate=torch.zeros(1).double(), rows=tensor([1 / boards]), residuals=torch.zeros(1).double(),
            mean=torch.zeros(1).double(), sigma=tensor(math.inf),
        )  # fmt: skip
        # Stars say `far`; the best of both is between.
        best = far / told**2 / (1 / told**2 + 1 / boards**2)
        change = torch.tensor([best], dtype=torch.float64)
        found = _agreement_with(tensor([1 / told, (best - far) / told]), change, known, 50, 0.3)
        assert found.moved_px == pytest.approx(0.3 * best / told / math.sqrt(50))
        assert found.stated_px == pytest.approx(0.3 * boards / told / math.sqrt(50))
        if alone:
            # Of which stars say less than boards: nothing is compared.
            assert (found.freedom, found.chi2, found.by_chance) == (0, 0.0, 1.0)
        else:
            chi2 = far**2 / (boards**2 + told**2)
            assert found.freedom == 1
            assert found.chi2 == pytest.approx(chi2)
            assert found.by_chance == pytest.approx(min(2 * stats.chi2.sf(chi2, 1), 1.0))

    def test_one_direction_that_differs_is_not_hidden_by_many_that_agree(self) -> None:
        count, told = 30, 0.1
        eye, zero = torch.eye(count).double(), torch.zeros(count).double()
        known = CameraInformation(slots=tuple(range(count)), estimate=zero, rows=eye, residuals=zero, mean=zero,
                                  sigma=torch.full((count,), math.inf).double())  # fmt: skip
        far = zero.clone()
        far[4] = 6.0
        best = far / told**2 / (1 / told**2 + 1.0)
        found = _agreement_with(torch.cat([eye / told, ((best - far) / told)[:, None]], 1), best, known, 50, 0.3)
        chi2 = 36.0 / (1 + told**2)
        assert found.freedom == count
        assert found.by_chance == pytest.approx(2 * count * stats.chi2.sf(chi2, 1))
        assert found.contradiction is not None
        assert f"χ² {chi2:.0f} in 30 directions" in found.contradiction
        assert "move the lens by 2.52 px" in found.contradiction
        assert Agreement(9.0, 9, 1.1e-4, 0.1, 0.1).contradiction is None

    def test_noise_of_stars_is_that_of_those_used(self) -> None:
        stars = StarViews.of([StarField(torch.zeros(3, 3), torch.zeros(3, 2), tensor(0.1, 0.1, 7.0))])
        stars = stars._replace(weights=stars.weights * tensor(1.0, 1.0, 0.0), variance=4.0)
        count, sigma = _star_noise(stars)
        assert count == 4
        assert sigma == pytest.approx(0.2)
        assert _star_noise(stars._replace(variance=0.25))[1] == pytest.approx(0.1)


class TestProblem:
    def problem(self) -> tuple[StarViews, BoardState, Camera]:
        first, pixels = scattered(12)
        field = StarField(first, pixels, torch.full((12,), 0.2).double())
        other = StarField(first[:8] @ TURN.T, pixels[:8] + 0.5, torch.full((8,), 0.1).double())
        state = star_state(CAMERA.params.detach(), [TURN, torch.eye(3).double()])
        return StarViews.of([field, other]), state, CAMERA

    def test_cost_is_the_sum_of_squares_in_sigmas(self) -> None:
        stars, state, camera = self.problem()
        # Half a pixel along both axes of eight stars.
        cost = 2.0 * float(stars.problem(camera.model).cost(state))
        assert cost == pytest.approx(8 * 2 * (0.5 / 0.1) ** 2, rel=1e-6)
        stars.weights[1][:3] = 0.0
        assert 2.0 * float(stars.problem(camera.model).cost(state)) == pytest.approx(250.0, rel=1e-6)
        stars, state, camera = self.problem()
        errors = stars.errors(camera.model, state)
        torch.testing.assert_close(errors[1, :8], torch.full((8, 2), -0.5).double(), rtol=0, atol=1e-6)
        assert not bool(torch.isfinite(errors[1, 8:]).any())

    def test_what_is_far_off_is_left_out_by_what_is_typical(self) -> None:
        stars, state, camera = self.problem()
        stars.pixels[0, 2] += 40.0
        stars.pixels[0, :, 0] += 0.3
        found = stars.near(camera.model, state, 5.0)
        assert (0.2 * found.weights[0]).tolist() == pytest.approx([1.0, 1.0, 0.0] + 9 * [1.0])
        # Lengths of errors in sigmas: eleven of 1.5, one far off, eight of 7.07: the tenth of twenty.
        assert found.variance == pytest.approx((1.5 / 1.18) ** 2, rel=1e-3)

    def test_a_wrong_focal_length_is_found_and_a_prior_holds_it(self) -> None:
        # The principal point's height is no unknown: it is held where it was.
        unknowns = FreeParameters((0, 1, 2), (0, 0, 1))
        truth = CAMERA.params.detach()
        index = torch.tensor(unknowns.leading)
        for sigma in (1e6, 1e-4):
            stars, state, camera = self.problem()
            stars.pixels[1] -= 0.5
            begin = truth.clone()
            begin[:2] += 5.0
            spread = tensor(sigma, 1e3)
            prior = GaussianPrior(index, begin[index], 1.0 / spread)
            for term in (prior, GaussianTerm(index, Gaussian.independent(("f", "x"), begin[index], spread), 1.0)):
                problem = stars.problem(camera.model, unknowns, [term])
                result = minimize(problem, state._replace(parameters=begin), LMOptions(max_iterations=20))
                found = result.state.parameters
                assert float(found[3]) == float(begin[3])
                # Images at infinity turn and do not move.
                assert not bool(result.state.translation.any())
                if sigma > 1.0:
                    torch.testing.assert_close(found[:4], truth[:4], rtol=0, atol=1e-4)
                else:
                    assert float(found[0]) == pytest.approx(float(begin[0]), abs=1e-3)

    def test_rows_without_rotations_are_a_projection(self) -> None:
        """`lens_rows` has the products of all rows less what the rotations explain, in typical sigmas."""
        stars, state, camera = self.problem()
        problem = stars.problem(camera.model, FreeParameters((0, 1, 2, 3), (0, 0, 1, 2)))
        rows = lens_rows(problem, state, 3.0)
        out, whole = problem.off_poses(state), problem.rows(state)
        triangle = triangular(out.transpose(0, 1).flatten(1).T)[:-1]
        torch.testing.assert_close(rows.T @ rows, triangle.T @ triangle / 9.0)
        turns, flat = whole[0, :3], whole[0, 3:]
        left = flat - flat @ turns.T @ torch.linalg.inv(turns @ turns.T) @ turns
        torch.testing.assert_close(out[0], left, rtol=1e-9, atol=1e-9)
        # Half of a pixel over its sigma is in the last row, and nothing where there is no star.
        last = whole[1, -1].unflatten(0, (2, 12))
        torch.testing.assert_close(last[:, :8], torch.full((2, 8), -5.0).double(), rtol=0, atol=1e-5)
        assert not bool(whole[1].unflatten(1, (2, 12))[..., 8:].any())


class TestRoughLens:
    SIZE = (960, 600)
    HOW = (12, CATALOG, str, "search")

    def seen(self, focal: float = 900.0) -> tuple[DetectedStars, np.ndarray]:
        pixels, index = star_pixels(night_camera(focal), LOOK)
        celestial = pixels, np.full(len(pixels), 0.1), 10 ** (-0.4 * CATALOG.magnitude[index])
        return DetectedStars(*celestial, 0.02, {}), index

    @pytest.mark.parametrize(("degrees", "model"), [(60.0, "pinhole"), (180.0, "fisheye4")])
    def test_a_lens_of_a_stated_field(self, degrees: float, model: str) -> None:
        made = _plain_of(degrees, self.SIZE)
        assert str(made.model) == model
        # Of the outer corners of the image, from which centers of pixels are half a pixel away.
        pixels = torch.tensor([[0.0, 0.0], [959.0, 599.0]], dtype=torch.float64)
        rays = torch.nn.functional.normalize(made.unproject(pixels)[0], dim=-1)
        share = math.hypot(959, 599) / math.hypot(*self.SIZE)
        half = math.radians(degrees) / 2
        inner = share * half if degrees > 150 else math.atan(share * math.tan(half))
        assert float(torch.acos(rays[0] @ rays[1])) == pytest.approx(2 * inner, abs=1e-4)

    def test_names_and_scale_from_the_middle(self) -> None:
        """Of a focal length that is stated 2 % too short."""
        seen, index = self.seen()
        found = _search(seen, _plain_cameras(self.SIZE, 900.0 / 1.02), *self.HOW)
        assert found is not None
        named, lens = found
        assert float(lens.focal[0]) == pytest.approx(900.0, rel=2e-3)
        known = np.flatnonzero(named.star >= 0)
        assert len(known) >= 5
        assert named.star[known].tolist() == index[known].tolist()
        assert np.linalg.norm(seen.pixels[known] - [479.5, 299.5], axis=1).max() < 0.25 * math.hypot(*self.SIZE)
        assert _search(seen._replace(pixels=seen.pixels[:4]), _plain_cameras(self.SIZE, 900.0), *self.HOW) is None

    def test_names_by_a_camera(self) -> None:
        seen, index = self.seen()
        found = _by_camera(seen, CAMERA, CATALOG)
        known = found.star >= 0
        assert known.sum() > 20
        assert found.star[known].tolist() == index[: len(known)][known].tolist()

    def test_stars_near_the_middle(self) -> None:
        half = 0.5 * math.hypot(*self.SIZE)
        pixels = np.array([[479.5, 299.5], [479.5 + 0.59 * half, 299.5], [479.5, 299.5 - 0.61 * half]])
        found = DetectedStars(pixels, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), 0.1, {})
        near = _near_middle(found, self.SIZE, 0.6)
        assert near.sigma.tolist() == [1.0, 2.0]
        assert near.flux.tolist() == [4.0, 5.0]
        np.testing.assert_array_equal(near.pixels, pixels[:2])

    def test_directions_of_a_place_are_in_the_catalogue_s_axes(self) -> None:
        view = SkyView(time=TIME, origin=PLACE, dut1=0.0)
        found, celestial = _directions(view, CATALOG), celestial_directions(CATALOG, TIME)
        there = observed_directions(CATALOG, TIME, PLACE)
        up = there[:, 2] > math.sin(math.radians(3.0))
        # Below the horizon as the catalog has it, above it bent by refraction: some minutes of arc, upwards.
        np.testing.assert_array_equal(found[~up], celestial[~up])
        moved = np.degrees(np.linalg.norm(found - celestial, axis=1)[up]) * 60
        assert 0.0 < moved.max() < 20.0
        angles = np.arccos(np.clip(found[up][:50] @ found[up][:50].T, -1, 1))
        np.testing.assert_allclose(angles, np.arccos(np.clip(there[up][:50] @ there[up][:50].T, -1, 1)), atol=1e-7)
        np.testing.assert_array_equal(_directions(SkyView(time=TIME), CATALOG), celestial)

    def test_a_rotation_follows_directions_at_another_time(self) -> None:
        turn = rotation_from_vector(tensor(1e-3, 2e-3, -1e-3)).numpy()
        rotation = TURN.numpy()
        found = _ahead(rotation, CATALOG.directions() @ turn.T, CATALOG, SkyView())
        np.testing.assert_allclose(found, rotation @ turn.T, atol=1e-9)


def test_triangles_have_the_sides_and_the_sense() -> None:
    table = pair_table(CATALOG, 0.9)
    corners = table.directions[[3, 11, 20]]
    sides = np.linalg.norm(corners[[0, 0, 1]] - corners[[1, 2, 2]], axis=1)
    if sides.max() > 0.8:
        bright = table.directions[:60]
        near = np.argsort(-(bright @ bright[3]))[:3]
        corners, chosen = bright[near], near
    else:
        chosen = np.array([3, 11, 20])
    found = _triangles(corners, table, 500, 1e-4, 0.0, 0.0)
    assert chosen.tolist() in found.tolist()
    for stars in found:
        np.testing.assert_allclose(
            np.linalg.norm(table.directions[stars][[0, 0, 1]] - table.directions[stars][[1, 2, 2]], axis=1),
            np.linalg.norm(corners[[0, 0, 1]] - corners[[1, 2, 2]], axis=1), atol=3e-4,
        )  # fmt: skip
    # Mirrored, it is another triangle; with a star that does not take part, none.
    assert chosen.tolist() not in _triangles(corners * [-1.0, 1.0, 1.0], table, 500, 1e-4, 0.0, 0.0).tolist()
    assert chosen.tolist() not in _triangles(corners, table, int(chosen.max()), 1e-4, 0.0, 0.0).tolist()
    assert chosen.tolist() in _triangles(corners, table, int(chosen.max()) + 1, 1e-4, 0.0, 0.0).tolist()
    turned = rotation_from_vector(tensor(0.2, -0.4, 0.1)).numpy()
    assert chosen.tolist() in _triangles(corners @ turned.T, table, 500, 1e-4, 0.0, 0.0).tolist()


def test_signal_and_center_of_a_star_by_hand() -> None:
    """Electrons of star and sky under a spot of 4π px², and what the air moves."""
    plan = NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=20.0, seconds=2.0, sky_magnitude=20.0)
    signal, sigma = _signal(plan, np.array([4.0]), 2.0, 100.0, 0.0)
    area = math.pi / 4 * 2.0**2
    star = 1e6 * area * 2.0 * 10 ** (-0.4 * (4.0 + 0.25 * 2.0))
    sky = 1e6 * area * 2.0 * 10 ** (-0.4 * 20.0) * 100.0**2
    by_hand = star / math.sqrt(star + 4 * math.pi * (sky + 1.0 * 2.0 + 4.0))
    assert float(signal[0]) == pytest.approx(by_hand)
    seeing = 2.0 * 2.0**0.6 / math.sqrt(1 + 2.0 / 0.1) / 100.0
    assert float(sigma[0]) == pytest.approx(math.sqrt(0.05**2 + (1.2 / by_hand) ** 2 + seeing**2))
    # A trail is as wide as a uniform distribution of its length.
    _, wide = _signal(plan, np.array([4.0]), 2.0, 100.0, math.sqrt(12.0) * math.sqrt(3.0))
    assert float(wide[0]) > float(sigma[0])
    long, _ = _signal(plan, np.array([4.0]), 2.0, 100.0, math.sqrt(36.0))
    assert float(long[0]) == pytest.approx(star / math.sqrt(star + 8 * math.pi * (sky + 2.0 + 4.0)))


def test_a_view_needs_a_time_for_its_place() -> None:
    assert SkyView(time=TIME, origin=PLACE).on_earth
    assert not SkyView(time=TIME).on_earth
    with pytest.raises(InputError, match="a place without a time"):
        SkyView(origin=PLACE)
    assert SkyView(time=TIME, origin=PLACE, time_sigma=0.3, dut1=0.1).clock_sigma == pytest.approx(0.3)
    assert SkyView(time_sigma=0.4).clock_sigma == pytest.approx(math.hypot(0.4, 0.9 / math.sqrt(3.0)))
    later = SkyView(time=TIME + datetime.timedelta(seconds=1), origin=PLACE, dut1=-1.0)
    # A second later with UT1 a second behind, the sky stands as it did.
    np.testing.assert_allclose(
        later.directions(CATALOG), SkyView(time=TIME, origin=PLACE, dut1=0.0).directions(CATALOG), atol=1e-8
    )


class TestAttitudeOnEarth:
    def test_clock_and_air_widen_the_attitude(self) -> None:
        """By the outer products of the turns that a sigma of each makes."""
        view = SkyView(time=TIME, origin=PLACE, dut1=0.0, time_sigma=0.5)
        turn = torch.from_numpy(pole_in_enu(PLACE.lat)) * EARTH_RATE * 0.5
        torch.testing.assert_close(_by_clock(view), torch.outer(turn, turn))
        there = observed_directions(CATALOG, TIME, PLACE)
        index = np.flatnonzero((there[:, 2] > 0.3) & (there[:, 2] < 0.6))[:40]
        known, by_hand = there[index], torch.zeros(3, 3).double()
        shifts = view.by_air(CATALOG, index)
        assert [name for name, _ in shifts] == ["the air's temperature", "the air's pressure"]
        for _, shift in shifts:
            # The turn w of smallest |shift - w x known|.
            rows = np.concatenate([-np.cross(known, axis) for axis in np.eye(3)]).reshape(3, -1).T
            small = torch.from_numpy(np.linalg.lstsq(rows, shift.ravel(), rcond=None)[0])
            by_hand = by_hand + torch.outer(small, small)
        found = _by_air(view, CATALOG, index)
        assert float(found.trace()) > 1e-12
        torch.testing.assert_close(found, by_hand, rtol=1e-3, atol=0.0)
        # Warmer air bends less, denser air more.
        (_, warm), (_, dense) = shifts
        assert (warm[:, 2] < 0).all()
        assert (dense[:, 2] > 0).all()

    def test_how_it_is_told(self) -> None:
        image = image_of(TURN)
        found = dataclasses.replace(image, covariance=torch.diag(torch.tensor([1e-6, 4e-6, 9e-6])).double())
        assert found.sigma_deg == pytest.approx([math.degrees(1e-3 * k) for k in (1, 2, 3)])
        assert found.heading_pitch_roll == pytest.approx(LOOK)
        assert found.right_ascension_declination is None
        # A camera that looks towards 6h 45m, -16.7°.
        ahead = unit_vectors(np.array([math.radians(101.3)]), np.array([math.radians(-16.7)]))[0]
        side = np.cross(ahead, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(ahead, [0.0, 0.0, 1.0]))
        sky = image_of(torch.from_numpy(np.stack([side, np.cross(ahead, side), ahead])), on_earth=False)
        assert sky.right_ascension_declination == pytest.approx((101.3, -16.7))
        assert sky.heading_pitch_roll is None

    def test_a_reach_of_pixels(self) -> None:
        assert _reach(CAMERA) == pytest.approx(2.5 / 900.0, rel=1e-4)
        part = _part(CATALOG, np.array([5, 3]))
        assert part.number.tolist() == CATALOG.number[[5, 3]].tolist()
        assert part.magnitude.tolist() == CATALOG.magnitude[[5, 3]].tolist()
