"""Parts of the tracker against closed forms and brute force."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from track_scenes import pairs_of, seen_by, tracked_site, yawed_rig

from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector
from kcal.pipeline.assignment import SeenFrom, looks_of, nearby
from kcal.pipeline.association import appearance, size_cost
from kcal.pipeline.imm_filter import (
    MOTIONS,
    Beliefs,
    Motion,
    Timing,
    Transition,
    by_rates,
    fit_of,
    innovations,
    moved,
    rates,
    step_numbers,
    transition,
    updated,
)
from kcal.pipeline.measurements import (
    Anchored,
    ClockEstimate,
    ClockPrior,
    SharedErrors,
    congruent,
    eliminate,
    outer,
    product,
    solved,
    squared,
)
from kcal.pipeline.stream import MomentOrder
from kcal.pipeline.tracks import Tracker, TrackOptions

# Parts of the tracker against closed forms: shared errors, mixtures, one update, looks of cameras, times, sizes.


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


class TestSharedErrors:
    def test_what_was_collected_is_the_posterior(self) -> None:
        """Against one linear least squares of calibration (one unit error) and the clock's three."""
        clocks = [ClockPrior(offset_s=0.5, offset_sigma_s=0.2, drift_sigma=1e-3, slope_sigma_s=0.01)]
        shared = SharedErrors(1, clocks)
        prior = torch.tensor([1.0, 0.2, 1e-3, 0.01], dtype=torch.float64)
        effect, innovation = draw(2, 4, 5) / prior[:, None], draw(2, 5, seed=1)
        half = draw(2, 2, 5, seed=2)
        covariance = (half[:, :, None] * half.transpose(0, 1)[None]).sum(1) + torch.eye(2)[..., None]
        shared.add(effect, innovation, covariance)
        normal, right = torch.diag(prior**-2), torch.zeros(4).double()
        for k in range(5):
            weight = torch.linalg.inv(covariance[..., k])
            normal = normal + effect[..., k].T @ weight @ effect[..., k]
            right = right + effect[..., k].T @ weight @ innovation[..., k]
        best, spread = torch.linalg.solve(normal, right), torch.linalg.inv(normal)
        torch.testing.assert_close(shared.settle(), best[1:])
        torch.testing.assert_close(shared.values, torch.tensor([0.5, 0.0, 0.0]).double() + best[1:])
        # The calibration keeps its prior; what the clock knows is correlated with it.
        known = shared.root @ shared.root.T
        torch.testing.assert_close(known[1:, 1:], spread[1:, 1:])
        torch.testing.assert_close(known[0, 1:], spread[0, 1:])
        assert float(known[0, 0]) == pytest.approx(1.0)
        # Nothing more was collected: the best estimate of what remains is zero.
        torch.testing.assert_close(shared.settle(), torch.zeros(3).double(), rtol=0, atol=1e-9)
        found = shared.clock_estimate()
        torch.testing.assert_close(found.values, shared.values)
        torch.testing.assert_close(found.covariance, spread[1:, 1:])
        assert shared.mixing is shared.root
        assert shared.corrected is shared.values

    def test_the_second_clock_is_the_second(self) -> None:
        clocks = [ClockPrior(offset_s=0.1, offset_sigma_s=0.3), ClockPrior(offset_s=0.7, drift_sigma=0.2)]
        shared = SharedErrors(2, clocks)
        shared.start = 50.0
        one, two = shared.clock_estimate(1), shared.clock_estimate(2)
        assert (one.values.tolist(), two.values.tolist()) == ([0.1, 0.0, 0.0], [0.7, 0.0, 0.0])
        torch.testing.assert_close(one.covariance.diagonal().sqrt(), torch.tensor([0.3, 0.0, 0.0]).double())
        torch.testing.assert_close(two.covariance.diagonal().sqrt(), torch.tensor([0.0, 0.2, 0.0]).double())
        # Ten seconds after the start a drift of 0.2 s/s is 2 s.
        assert two.offset(60.0) == pytest.approx((0.7, 2.0))
        assert (
            ClockEstimate(torch.tensor([1.0, 0.5, 9.0]).double(), torch.zeros(3, 3).double(), 2.0).offset(4.0)[0] == 2.0
        )

    def test_exact_clocks_are_not_estimated(self) -> None:
        shared = SharedErrors(2, [ClockPrior(offset_s=0.1)])
        assert not shared.estimated
        assert shared.mixing is None
        assert shared.settle().numel() == shared.corrected.numel() == 0
        assert shared.clock_estimate().covariance.any().item() is False
        assert shared.root.tolist() == [[1.0, 0.0], [0.0, 1.0]]


def mixture(models: int = 3, tracks: int = 2) -> Beliefs:
    half = draw(6, 6, models, tracks, seed=3)
    noise = (half[:, :, None] * half.transpose(0, 1)[None]).sum(1)
    weight = torch.softmax(draw(models, tracks, seed=4), 0)
    return Beliefs(draw(6, models, tracks, seed=5), torch.cat([noise, draw(6, 2, models, tracks, seed=6)], 1),
                   draw(6, 1, 3, models, tracks, seed=7), weight)  # fmt: skip


class TestMixtures:
    def test_one_model_with_the_same_mean_and_covariance(self) -> None:
        beliefs = mixture()
        merged = beliefs.merged()
        for t in range(2):
            weight, mean = beliefs.weight[:, t], beliefs.mean[..., t]
            middle = mean @ weight
            torch.testing.assert_close(merged.mean[:, 0, t], middle)
            second = sum(
                w * (beliefs.noise[:, :, j, t] + torch.outer(mean[:, j], mean[:, j])) for j, w in enumerate(weight)
            )
            torch.testing.assert_close(merged.noise[:, :, 0, t], second - torch.outer(middle, middle))
            torch.testing.assert_close(merged.shared[:, :, 0, t], beliefs.shared[..., t] @ weight)
        summary = beliefs.summary()
        torch.testing.assert_close(summary.mean[1], merged.mean[:, 0, 1])
        torch.testing.assert_close(summary.noise[1], merged.noise[:, :, 0, 1])
        by_clock = merged.shared.new_tensor((merged.late[:, :, :, 0, 1] * merged.mean[3:, 0, 1]).sum(-1).tolist())
        torch.testing.assert_close(summary.effect[1], torch.cat([merged.shared[:, :, 0, 1], by_clock], 1))

    def test_models_may_have_switched(self) -> None:
        """With 0.7 a model stays what it is, besides the chance to be drawn again."""
        beliefs = mixture()
        mixed = beliefs.mixed(torch.tensor(0.7, dtype=torch.float64))
        switch = torch.full((3, 3), 0.1).double() + 0.7 * torch.eye(3).double()
        for t in range(2):
            joint = switch * beliefs.weight[:, t]
            torch.testing.assert_close(mixed.weight[:, t], joint.sum(1))
            for to in range(3):
                share = joint[to] / joint[to].sum()
                middle = beliefs.mean[..., t] @ share
                torch.testing.assert_close(mixed.mean[:, to, t], middle)
                second = sum(
                    s * (beliefs.noise[:, :, j, t] + torch.outer(beliefs.mean[:, j, t], beliefs.mean[:, j, t]))
                    for j, s in enumerate(share)
                )
                torch.testing.assert_close(mixed.noise[:, :, to, t], second - torch.outer(middle, middle))
                torch.testing.assert_close(mixed.late[..., to, t], beliefs.late[..., t] @ share)
        # The mixture as a whole stays the same.
        torch.testing.assert_close(mixed.middle, beliefs.middle)
        single = beliefs.merged()
        assert single.mixed(torch.tensor(0.7)) is single


class TestUpdate:
    def seen(self, cameras: int = 2, tracks: int = 2) -> tuple[Anchored, Timing]:
        late = draw(cameras, 2 * cameras, 3, tracks, seed=8)
        late = torch.stack([late[c] * (torch.arange(2 * cameras) // 2 == c)[:, None, None] for c in range(cameras)])
        shared = draw(2 * cameras, 2, tracks, seed=9)
        seen = Anchored(
            draw(3, tracks, seed=10), draw(2 * cameras, tracks, seed=11), late, shared, torch.ones(tracks).bool()
        )
        timing = Timing(
            torch.tensor([[0.0] * tracks, [0.04] * tracks]).double(),
            draw(1, 1, tracks, seed=12),
            torch.zeros(1, tracks).double(),
        )
        return seen, timing

    def test_a_measurement_is_predicted_to_first_order(self) -> None:
        """Rows at the time of the marks: the second camera's is 0.04 s late."""
        beliefs = mixture(1)
        seen, timing = self.seen()
        found = innovations(beliefs, seen, timing)
        for t in range(2):

            def rows(state: Tensor, late: float = 0.04, t: int = t) -> Tensor:
                speed = rates(state)
                first, second = (seen.late[c, :, :, t] for c in (0, 1))
                return first @ (state[:3] - seen.place[:, t]) + second @ (state[:3] + late * speed - seen.place[:, t])

            state = beliefs.mean[:, 0, t]
            torch.testing.assert_close(found.value[:, 0, t], seen.value[:, t] - rows(state))
            slope = torch.func.jacfwd(rows)(state)
            torch.testing.assert_close(found.slope[:, :, 0, t], slope)
            noise = slope @ beliefs.noise[:, :, 0, t] @ slope.T + torch.eye(4).double()
            torch.testing.assert_close(found.noise[:, :, 0, t], noise)
            torch.testing.assert_close(found.crossed[:, :, 0, t], slope @ beliefs.noise[:, :, 0, t])
            # A unit of the clock's error moves the rows of its camera, besides what it did to the state before.
            delayed = torch.func.jacfwd(rows, argnums=1)(state, torch.tensor(0.04).double())
            before = (beliefs.late[:, 0, :, 0, t] * state[3:]).sum(-1)
            # Its derivative by the rate, with the velocity in the state: what closing adds is left to the filter.
            own = by_rates(seen.late[1, :, :, t], state)[:, 3:] @ state[3:] * timing.clock[0, 0, t]
            torch.testing.assert_close(own / timing.clock[0, 0, t], delayed)
            torch.testing.assert_close(found.effect[:, 2, 0, t], own + slope @ before)
            torch.testing.assert_close(
                found.effect[:, :2, 0, t], seen.shared[..., t] + slope @ beliefs.shared[:, :, 0, t]
            )

    def test_an_update_is_that_of_kalman(self) -> None:
        beliefs = mixture(1)
        seen, timing = self.seen()
        found = innovations(beliefs, seen, timing)
        fit = fit_of(found, None)
        after = updated(beliefs, found, None)
        for t in range(2):
            slope, noise = found.slope[:, :, 0, t], beliefs.noise[:, :, 0, t]
            gain = noise @ slope.T @ torch.linalg.inv(slope @ noise @ slope.T + torch.eye(4).double())
            torch.testing.assert_close(after.mean[:, 0, t], beliefs.mean[:, 0, t] + gain @ found.value[:, 0, t])
            torch.testing.assert_close(after.noise[:, :, 0, t], noise - gain @ slope @ noise, rtol=1e-8, atol=1e-9)
            torch.testing.assert_close(
                after.shared[:, :, 0, t],
                beliefs.shared[:, :, 0, t] - gain @ (slope @ beliefs.shared[:, :, 0, t] + seen.shared[..., t]),
            )
            covariance = found.noise[:, :, 0, t] + found.effect[:, :, 0, t] @ found.effect[:, :, 0, t].T
            value = found.value[:, 0, t]
            assert float(fit.squared[0, t]) == pytest.approx(float(value @ torch.linalg.solve(covariance, value)))
            density = -0.5 * (float(fit.squared[0, t]) + float(torch.logdet(covariance)))
            assert float(fit.log_density[0, t]) == pytest.approx(density)

    def test_models_gain_weight_by_how_well_they_fit(self) -> None:
        beliefs = mixture(3)
        seen, timing = self.seen()
        found = innovations(beliefs, seen, timing)
        fit = fit_of(found, None)
        after = updated(beliefs, found, None)
        posterior = beliefs.weight * fit.log_density.exp()
        torch.testing.assert_close(after.weight, (posterior / posterior.sum(0)).clamp_min(1e-12))


class TestLooks:
    def test_where_cameras_should_see_a_track(self) -> None:
        beliefs = mixture(1).merged()
        beliefs = beliefs._replace(
            mean=torch.cat([0.2 * beliefs.mean[:2], beliefs.mean[2:3].abs() * 0.1, beliefs.mean[3:]])
        )
        turn = torch.linalg.qr(draw(3, 3, seed=13))[0]
        frame, home = turn[..., None].expand(3, 3, 2), draw(3, 2, seed=14)
        centers = draw(2, 3, seed=15)
        looks = looks_of(beliefs, frame, home, SeenFrom(centers, None), None)
        for t in range(2):
            for v in range(2):

                def ray(state: Tensor, t: int = t, v: int = v) -> Tensor:
                    # Where the point is, from the camera: the direction does not depend on the unit of length.
                    point = turn.T @ torch.cat([state[:2], torch.ones(1).double()]) / state[2] + home[:, t] - centers[v]
                    return torch.nn.functional.normalize(point, dim=0)

                place = beliefs.mean[:3, 0, t]
                torch.testing.assert_close(looks.ray[:, v, t], ray(place))
                slope = torch.func.jacfwd(ray)(place)
                spread = torch.trace(slope @ beliefs.noise[:3, :3, 0, t] @ slope.T)
                moved = slope @ beliefs.effect[:3, :, 0, t]
                assert float(looks.spread[v, t]) == pytest.approx(float(spread + moved.square().sum()))

    def test_near_is_what_lies_within_the_gate(self) -> None:
        """Across by 1 and 2 mrad, of a belief that is known to 0.4 mrad in both components together."""

        ray = torch.tensor([[0.0], [0.0], [1.0]]).double()[:, None]
        found = (ray, torch.tensor([[1.6e-7]]).double(), torch.zeros(1, 1).double())
        angles = torch.tensor([1.0e-3, 2.0e-3, 1.0e-3]).double()
        direction = torch.stack([angles, 0 * angles, torch.ones(3).double()])
        late = torch.zeros(1, 2, 3, 3).double()
        late[0, 0, 0], late[0, 1, 1] = 1e5, 1e5  # 1e-5 rad of noise
        seen: Any = SimpleNamespace(direction=direction, anchor=torch.zeros(3).long(), late=late,
                                    usable=torch.tensor([True, True, False]))  # fmt: skip
        timing = Timing(torch.zeros(1, 3).double(), torch.zeros(0, 3, 3).double(), torch.zeros(0, 3).double())
        assert nearby(found, seen, timing, torch.tensor(9.0)).tolist() == [[True, False, False]]  # type: ignore[arg-type]
        assert nearby(found, seen, timing, torch.tensor(16.0)).tolist() == [[True, True, False]]  # type: ignore[arg-type]


class TestSizes:
    def test_sizes_of_boxes_by_how_much_cameras_magnify(self) -> None:
        def cost(*magnified: float, aside: float = 0.0) -> float:
            boxes = torch.tensor([[[0.0, 0.0, 40.0, 20.0], [5.0, 5.0, 25.0, 15.0]]]).double()
            return float(size_cost(torch.tensor([magnified]).double(), boxes, 2.0, torch.tensor([aside]).double()))

        # The left camera magnifies twice as much: its box is twice as large.
        assert cost(2.0, 1.0) == pytest.approx(0.0)
        for aside in (0.0, 0.5):
            spreads = ((4 / a) ** 2 + (4 / b) ** 2 + 0.15**2 + aside**2 for a, b in ((40.0, 20.0), (20.0, 10.0)))
            assert cost(1.0, 1.0, aside=aside) == pytest.approx(sum(math.log(2) ** 2 / spread for spread in spreads))

    def test_looks_are_found_over_shifts_of_a_quarter(self) -> None:
        noise = torch.nn.functional.interpolate(draw(1, 1, 12, 16, seed=16), scale_factor=8, mode="bicubic")[0, 0]
        box = torch.tensor([[40.0, 30.0, 72.0, 62.0]]).double()
        for shift, alike in ((0, True), (8, True), (-8, True), (30, False)):
            found = float(appearance(noise, box, noise.roll((shift, -shift), (0, 1)), box))
            assert (found > 0.95) is alike, (shift, found)
        assert float(appearance(noise, box, 3.0 - noise, box)) < 0.9
        assert float(appearance(noise, box, torch.full_like(noise, 3.0), box)) == 0.0


class TestMoments:
    def test_steps_that_wait_and_that_do_not(self) -> None:
        order = MomentOrder[str](time=10.0, step=0.5)
        # Ten times the last step.
        assert order.put("a", 15.0).moments == ["a"]
        assert order.step == 5.0
        assert order.put("b", 65.0).moments == ["b"]
        order = MomentOrder[str](time=10.0, step=0.01)
        assert order.put("a", 10.05).moments == ["a"]
        assert order.put("late", 11.06).moments == []
        assert order.waiting == 1

    def test_what_goes_back(self) -> None:
        order = MomentOrder[str](time=100.0, step=0.1)
        assert order.put("again", 100.0).repeated
        assert order.put("older", 85.0).repeated
        assert not order.put("much older", 84.9).repeated
        assert order.waiting == 1
        begun = MomentOrder[str](time=5.0, until=50.0)
        assert begun.time == 50.0
        assert begun.put("before", 20.0).repeated
        assert begun.put("on", 50.5).moments == ["on"]
        assert begun.until == -math.inf

    @pytest.mark.parametrize(("start", "jump"), [(500.0, 400.0), (115.0, 0.0), (20.0, -80.0)])
    def test_a_clock_that_was_set_is_told_by_how_much(self, start: float, jump: float) -> None:
        """A gap is none."""
        order = MomentOrder[str](time=100.0, step=0.1)
        assert order.put("a", start).moments == order.put("b", start + 0.1).moments == []
        done = order.put("c", start + 0.2)
        assert (done.moments, done.jump_s) == (["a", "b", "c"], jump)
        assert order.step == pytest.approx(0.1)

    def test_what_its_neighbors_contradict_is_counted(self) -> None:
        order = MomentOrder[str](time=100.0, step=0.1)
        order.put("wrong", 900.0)
        order.put("wrong too", 950.0)
        # The next of those that wait goes back: they do not bear each other out.
        assert order.put("other", 300.0).contradicted == 2
        done = order.put("right", 100.1)
        assert (done.moments, done.contradicted) == (["right"], 1)

    def test_at_the_end_a_short_gap_needs_no_proof(self) -> None:
        for time, taken in ((115.0, ["a"]), (115.1, []), (300.0, [])):
            order = MomentOrder[str](time=100.0, step=0.1)
            order.put("a", time)
            assert order.end().moments == taken
        assert MomentOrder[str](time=100.0).end().moments == []


# Motion of targets: exact straight lines and circles, exact derivatives, noise as integrated by brute force.


UP = torch.tensor([[0.0], [-1.0], [0.0]], dtype=torch.float64)


def after(motions: tuple[Motion, ...], seconds: float) -> Transition:
    return transition(torch.tensor(step_numbers(motions, seconds), dtype=torch.float64), UP)


def state_of(place: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    """(6, 1, 1) from vectors."""
    return (torch.cat([place[:2], torch.ones(1).double(), velocity]) / place[2])[:, None, None]


def test_a_turning_target_goes_in_a_circle_to_the_left() -> None:
    place, velocity = torch.tensor([0.0, 0.0, 300.0]).double(), torch.tensor([10.0, 0.0, 0.0]).double()
    state = state_of(place, velocity)
    rate = 2 * math.pi / 40
    for step in range(40):
        state = moved(state, after((Motion(acceleration=0.0, turn_rate=rate),), 1.0)).state
        if step == 9:
            # A quarter, seen from above, to the left of eastward is away from the camera.
            torch.testing.assert_close(state[3:, 0, 0] / state[2, 0, 0], torch.tensor([0.0, 0.0, 10.0]).double())
    torch.testing.assert_close(state, state_of(place, velocity), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("turned", [False, True])
def test_derivatives(turned: bool) -> None:
    state = torch.tensor([0.1, -0.05, 0.002, 0.03, -0.01, 0.02]).double()
    turn = rotation_from_vector(torch.tensor([0.1, -0.3, 0.2]).double())[..., None] if turned else None
    step = after(MOTIONS, 0.7)
    models = len(MOTIONS)
    found = moved(state[:, None, None].expand(6, models, 1), step, turn)
    slope = found.through(torch.eye(6).double()[..., None, None].expand(6, 6, models, 1))
    for model in range(models):
        by_autograd = torch.autograd.functional.jacobian(
            lambda s, model=model: moved(s[:, None, None].expand(6, models, 1), step, turn).state[:, model, 0], state
        )
        torch.testing.assert_close(slope[..., model, 0], by_autograd, rtol=1e-10, atol=1e-12)
    torch.linalg.cholesky(found.noise[..., 0].movedim(-1, 0))


@pytest.mark.parametrize("turned", [False, True])
def test_noise_reaches_the_state_by_its_derivatives(turned: bool) -> None:
    """Meters and meters per second are added to the place and velocity that the new state stands for."""
    state = torch.tensor([0.1, -0.05, 0.002, 0.03, -0.01, 0.02]).double()[:, None, None]
    turn = rotation_from_vector(torch.tensor([0.1, -0.3, 0.2]).double())[..., None] if turned else None
    step = after((MOTIONS[2],), 0.7)
    found = moved(state, step, turn)

    def pushed(push: torch.Tensor) -> torch.Tensor:
        """The new state, if its place (meters) and velocity are changed by this."""
        z = 1.0 / found.state[2, 0, 0]
        place = torch.cat([found.state[:2, 0, 0], torch.ones(1).double()]) * z + push[:3]
        return state_of(place, found.state[3:, 0, 0] * z + push[3:])[:, 0, 0]

    slope = torch.autograd.functional.jacobian(pushed, torch.zeros(6).double())
    place, both, velocity = step.noise[:, 0, 0].tolist()
    cartesian = torch.kron(torch.tensor([[place, both], [both, velocity]], dtype=torch.float64), torch.eye(3).double())
    torch.testing.assert_close(found.noise[..., 0, 0], slope @ cartesian @ slope.T, rtol=1e-10, atol=1e-18)


def test_rates_are_those_of_straight_motion() -> None:
    state = torch.tensor([0.1, -0.05, 0.002, 0.03, -0.01, 0.02], dtype=torch.float64)
    found, by_state = rates(state), by_rates(torch.eye(3, dtype=torch.float64), state)

    def later(seconds: float) -> torch.Tensor:
        return moved(state[:, None, None], after((Motion(acceleration=0.0),), seconds)).state[:3, 0, 0]

    # The second derivative is left out: 1e-6 s of half of 1e-3 a second.
    torch.testing.assert_close((later(1e-6) - later(0.0)) / 1e-6, found, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(by_state, torch.autograd.functional.jacobian(rates, state), rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("memory", [math.inf, 0.8, 5000.0])
def test_noise_is_that_of_many_small_steps(memory: float) -> None:
    motion = Motion(acceleration=2.0, memory_s=memory)
    covariance = torch.zeros(2, 2, dtype=torch.float64)
    small = after((motion,), 0.01)
    # Along one axis.
    push = torch.tensor([[1.0, float(small.reach[0, 0])], [0.0, float(small.keep[0, 0])]]).double()
    added = torch.tensor([[0.0, 0.0], [0.0, 0.01 * 4.0]]).double()
    for _ in range(100):
        covariance = push @ covariance @ push.T + added
    place, both, velocity = after((motion,), 1.0).noise[:, 0, 0]
    found = torch.stack([place, both, both, velocity]).reshape(2, 2)
    torch.testing.assert_close(found, covariance, rtol=0.025, atol=1e-3)


def test_a_hovering_target_forgets_its_velocity() -> None:
    step = after((Motion(acceleration=0.0, memory_s=2.0),), 4.0)
    torch.testing.assert_close(step.keep[..., 0, 0], math.exp(-2) * torch.eye(3).double())
    torch.testing.assert_close(step.reach[..., 0, 0], 2 * (1 - math.exp(-2)) * torch.eye(3).double())


@pytest.mark.parametrize("wrong", [{"acceleration": -1.0}, {"acceleration": 1.0, "memory_s": 0.0},
                                   {"acceleration": 1.0, "turn_rate": math.nan}])  # fmt: skip
def test_impossible_motions(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="motion"):
        Motion(**wrong)


def test_another_origin() -> None:
    """Counted from 30 m to the side and 100 m behind; derivatives are those of the map."""
    place, velocity = torch.tensor([30.0, -5.0, 400.0]).double(), torch.tensor([8.0, 1.0, -20.0]).double()
    shift = torch.tensor([-30.0, 4.0, 100.0]).double()
    turn = rotation_from_vector(torch.tensor([0.1, -0.3, 0.2]).double())
    step = after((Motion(acceleration=0.5),), 1.5)
    state = state_of(place, velocity)
    found = moved(state, step, turn[..., None], shift[:, None])
    true = state_of(turn @ (place + 1.5 * velocity) + shift, turn @ velocity)
    torch.testing.assert_close(found.state, true, rtol=1e-12, atol=1e-15)
    by_autograd = torch.autograd.functional.jacobian(
        lambda s: moved(s[:, None, None], step, turn[..., None], shift[:, None]).state[:, 0, 0], state[:, 0, 0]
    )
    slope = found.through(torch.eye(6).double()[..., None, None])
    torch.testing.assert_close(slope[:, :, 0, 0], by_autograd)


# Small matrices with their number as the last axis: the same as torch's, matrix by matrix.


def lanes(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, 3, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def stacked(value: torch.Tensor) -> torch.Tensor:
    """The same with the number of matrices first."""
    return value.movedim((-2, -1), (0, 1))


def test_products() -> None:
    first, second, square = lanes(4, 6), lanes(6, 2, seed=1), lanes(6, 6, seed=2)
    torch.testing.assert_close(stacked(product(first, second)), stacked(first) @ stacked(second))
    torch.testing.assert_close(stacked(squared(first)), stacked(first) @ stacked(first).mT)
    torch.testing.assert_close(stacked(congruent(first, square)), stacked(first) @ stacked(square) @ stacked(first).mT)
    rows, columns = lanes(4), lanes(6, seed=3)
    assert torch.equal(outer(rows, columns)[2, 5], rows[2] * columns[5])


@pytest.mark.parametrize("size", [1, 2, 4, 6])
def test_elimination_whatever_the_units(size: int) -> None:
    unit = torch.logspace(-9, 3, size, dtype=torch.float64)[:, None, None]
    matrix = squared(lanes(size, size + 2)) * unit[:, None] * unit
    columns = lanes(size, 3, seed=1) * unit[:, None]
    done = eliminate(matrix, columns)
    scale = unit[:, None]
    torch.testing.assert_close(solved(done) * scale, stacked_solution(matrix, columns, unit), rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(done.pivots.log().sum(0), torch.linalg.slogdet(stacked(matrix))[1], rtol=1e-9, atol=1e-9)
    white = (done.columns.square() / done.pivots[:, None]).sum(0)
    torch.testing.assert_close(white, (columns * solved(done)).sum(0), rtol=1e-9, atol=0.0)


def stacked_solution(matrix: torch.Tensor, columns: torch.Tensor, unit: torch.Tensor) -> torch.Tensor:
    """By torch, in units in which all rows are alike; times `unit`."""
    scaled = torch.linalg.solve(stacked(matrix / unit[:, None] / unit), stacked(columns / unit[:, None]))
    return scaled.movedim((0, 1), (-2, -1))


def test_what_is_not_positive_gives_numbers_all_the_same() -> None:
    done = eliminate(torch.zeros(2, 2, 1, dtype=torch.float64), torch.zeros(2, 1, 1, dtype=torch.float64))
    assert bool((done.pivots > 0).all())
    assert bool(torch.isfinite(solved(done)).all())


# Smoothing: consistent, better than the filter, and honest about what is shared.


def test_smoothed_states_are_consistent_and_sharper() -> None:
    localize, count, frames = tracked_site(0.003), 40, 16
    generator = torch.Generator().manual_seed(0)
    z = torch.linspace(300.0, 2500.0, count).double()
    across, up = torch.linspace(-0.4, 0.4, count).double(), 0.15 * torch.randn(count, generator=generator).double()
    start = torch.stack([across * z, up * z, z], -1)
    velocity = 8.0 * torch.randn(count, 3, generator=generator).double()
    yaws = math.radians(0.003) * torch.randn(count, generator=generator).double()
    rigs = [yawed_rig(localize.rig, float(yaw)) for yaw in yaws]
    tracker = Tracker(localize, TrackOptions(motions=(Motion(acceleration=0.01),), speed_mps=8.0), record=True)
    places = []
    for frame in range(frames):
        places.append(start + frame / 10.0 * velocity)
        marks = [seen_by(rig, places[-1][i : i + 1], 0.3, generator) for i, rig in enumerate(rigs)]
        left, right = (torch.cat(side) for side in zip(*marks, strict=True))
        tracks = tracker(pairs_of(left, right, frame / 10.0))
    found = tracker.smoothed()
    assert [track.number for track in found] == list(tracks.number) == list(range(1, count + 1))
    middle = torch.stack([track.state.inverse_range[8] for track in found])
    sigma = torch.stack([track.state.inverse_range_sigma[8] for track in found])
    ratio = (middle - 1.0 / torch.linalg.vector_norm(places[8], dim=-1)) / sigma
    assert 0.75 < float(ratio.square().mean().sqrt()) < 1.25
    velocities = torch.stack([track.state.velocity[8] for track in found])
    true = velocity @ localize.enu_from_rig.T
    covariance = torch.stack([track.state.velocity_covariance[8] for track in found])
    error = (velocities - true)[..., None]
    # 40 values of chi-squared with three degrees of freedom.
    assert 2.2 < float((error.mT @ torch.linalg.solve(covariance, error)).mean()) < 3.9
    # The last moment is the filter's, and the first is much better known than when it was seen.
    torch.testing.assert_close(torch.stack([track.state.enu[-1] for track in found]), tracks.state.enu)
    first = torch.stack([track.state.covariance[0, 1, 1] - track.state.systematic[0, 1, 1] for track in found])
    one = localize(*(torch.cat(side) for side in zip(*marks, strict=True)))
    assert bool((first < 0.5 * one.covariance[:, 1, 1]).all())


def test_a_clock_that_is_known_at_the_end_corrects_the_beginning() -> None:
    localize, late = tracked_site(), 0.05
    generator = torch.Generator().manual_seed(1)
    start = torch.tensor([[-30.0, 10.0, 300.0], [0.0, -20.0, 200.0], [10.0, 0.0, 250.0]]).double()
    velocity = torch.tensor([[9.0, 0.0, 0.0], [0.0, 6.0, 2.0], [-8.0, -5.0, 1.0]]).double()
    tracker = Tracker(
        localize, TrackOptions(motions=(Motion(acceleration=0.02),)), clock=ClockPrior(offset_sigma_s=0.1), record=True
    )
    for frame in range(40):
        time = frame / 10.0
        left, right = seen_by(localize.rig, start + time * velocity, 0.2, generator, start + (time + late) * velocity)
        tracker(pairs_of(left, right, time, 0.2))
    offset, sigma = tracker.clock_estimate().offset(4.0)
    assert abs(offset - late) < 3 * sigma < 0.006
    for track, place, pace in zip(tracker.smoothed(), start, velocity, strict=True):
        true = 1.0 / torch.linalg.vector_norm(place + track.time[:, None] * pace, dim=-1)
        error = (true - track.state.inverse_range) / track.state.inverse_range_sigma
        assert float(error.abs().max()) < 3.0
