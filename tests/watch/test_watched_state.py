"""The filter of attitudes: as wrong as it says, through gaps, gusts, wrong looks and jumps."""

import math

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.rig import Mounting, Origin
from kcal.locate.budget import planned_rig
from kcal.watch.history import AngleSeries, between_rows, first_state, learned, passed, taken, turns_of
from kcal.watch.watcher import MORE_ERRORS, Watched
from tests.helpers.watched_looks import SHARE, SIGMA, row_of, simulated, steady_model, yaw_turn

RIG = planned_rig()
ROWS = between_rows(RIG)
MODEL = steady_model()
EVERY = 300.0


def test_errors_are_as_large_as_stated_at_every_moment() -> None:
    rigs = 150
    true, looks = simulated(MODEL, 60, EVERY, rigs, 1)
    state, squares = first_state(MODEL, (rigs,)), []
    for k, look in enumerate(looks):
        if k:
            state, _ = passed(state, torch.full((rigs,), EVERY).double(), MODEL)
        state = taken(state, look, MODEL, ROWS)
        told = turns_of(state, MODEL, gusts=False)
        off = (told.mean - true[k])[..., None]
        squares.append((off.mT @ torch.linalg.solve(told.covariance, off))[:, 0, 0])
    mean = float(torch.stack(squares[20:]).mean())
    assert mean == pytest.approx(6.0, rel=0.06)
    # Better than one look, and never as good as white noise alone would make it.
    sigma = float(told.covariance[:, 4, 4].mean().sqrt())
    assert math.sqrt(SHARE) * SIGMA * 0.7 < sigma < math.hypot(SIGMA, float(MODEL.gust[4]))


def test_a_moment_between_looks_contains_the_wind() -> None:
    watched = Watched(RIG, [row_of(60.0 * k, yaw_turn(0.001)) for k in range(30)], MODEL)
    steady, whole = (watched.turns_at(900.0, gusts=gusts).covariance[4, 4] for gusts in (False, True))
    assert float(whole - steady) == pytest.approx(float(MODEL.gust[4]) ** 2)


def test_a_gap_makes_it_unsure_and_nothing_else() -> None:
    rows = [row_of(60.0 * k, yaw_turn(0.003)) for k in range(60)]
    rows += [row_of(3600.0 + 60.0 * k, None, note="dark") for k in range(600)]
    watched = Watched(RIG, rows, MODEL)
    before, after = watched.turns_at(3500.0), watched.turns_at(39_000.0)
    assert float(after.covariance[4, 4]) > 20 * float(before.covariance[4, 4])
    assert float(after.covariance[4, 4]) <= float(MODEL.swing[4] ** 2 + MODEL.gust[4] ** 2) * 1.001
    # Looks after the gap tell of the gap, too.
    both = Watched(RIG, [*rows, *(row_of(39_660.0 + 60.0 * k, yaw_turn(0.003)) for k in range(30))], MODEL)
    within = both.turns_at(39_000.0)
    assert float(within.covariance[4, 4]) < 0.5 * float(after.covariance[4, 4])
    assert math.degrees(float(within.mean[4])) == pytest.approx(0.003, abs=0.0008)


def test_one_wrong_look_is_doubted_and_three_are_believed() -> None:
    good = [row_of(60.0 * k, yaw_turn(0.0)) for k in range(30)]
    wrong = [row_of(1800.0 + 60.0 * k, yaw_turn(0.05)) for k in range(3)]
    once = Watched(RIG, [*good, wrong[0]], MODEL)
    told = once.turns_at(1800.0)
    assert abs(float(told.mean[4])) < 1e-5
    # Nobody knows yet: the interval contains both.
    assert float(told.covariance[4, 4].sqrt()) > math.radians(0.045)
    again = Watched(RIG, [*good, wrong[0], row_of(1860.0, yaw_turn(0.0))], MODEL)
    assert float(again.turns_at(1860.0).covariance[4, 4].sqrt()) < math.radians(0.001)
    jumped = Watched(RIG, [*good, *wrong], MODEL).turns_at(1920.0)
    assert math.degrees(float(jumped.mean[4])) == pytest.approx(0.05, abs=0.0015)
    assert float(jumped.covariance[4, 4].sqrt()) < math.radians(0.001)


def test_what_came_after_a_jump_is_not_told_of_before() -> None:
    rows = [row_of(60.0 * k, yaw_turn(0.0 if k < 30 else 0.05)) for k in range(60)]
    told = Watched(RIG, rows, MODEL).turns_at(60.0 * 20)
    assert abs(math.degrees(float(told.mean[4]))) < 0.001


def test_swing_and_wind_are_learned() -> None:
    model = steady_model(0.004, 6.0, 0.0008)
    _, looks = simulated(model, 700, 60.0, 1, 3)
    angle = torch.stack([look.turn[0] for look in looks]).numpy()
    flat = torch.full(angle.shape, SIGMA**2).double()
    time = 60.0 * torch.arange(700).double()
    found = learned(AngleSeries(time.numpy(), angle, ((1 - SHARE) * flat).numpy(), (SHARE * flat).numpy(),
                                (0.0 * flat).numpy()))  # fmt: skip
    assert float((found.gust / model.gust).log().abs().max()) < 0.1
    # Half a day tells how fast it moves, and how far it has gone; not slower and not nearer than it was.
    rates = [one.swing / one.return_s.sqrt() for one in (found, model)]
    assert float((rates[0] / rates[1]).min()) > 0.7
    assert float((rates[0] / rates[1]).max()) < 3.0


def test_temperatures_tell_the_swing_of_the_night() -> None:
    rows = []
    for k in range(288):
        kelvin = 6.0 * math.sin(2 * math.pi * k / 288.0)
        noise = 4e-6 * torch.randn(6, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
        rows.append(row_of(300.0 * k, None if k >= 150 else yaw_turn(0.0005 * kelvin) + noise, kelvin))
    warm, truth = Watched(RIG, rows).turns_at(300.0 * 215), 0.0005 * float(rows[215].look.kelvin)
    cold = Watched(RIG, [row._replace(look=row.look._replace(kelvin=torch.zeros(()).double())) for row in rows])
    assert math.degrees(float(warm.mean[4])) == pytest.approx(truth, abs=0.0005)
    assert math.degrees(float(cold.turns_at(300.0 * 215).mean[4])) - truth > 0.0015


def test_the_rig_of_a_moment() -> None:
    rig = planned_rig()
    rig.mounting = Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0)
    turn = torch.tensor([0.0, 1e-4, 0.0, 0.0, 3e-4, 0.0], dtype=torch.float64)
    watched = Watched(rig, [row_of(60.0 * k, turn) for k in range(60)], MODEL)
    there = watched.rig_at(3000.0)
    expected = watched.drift_at(3000.0)
    assert torch.allclose(there.right_from_left_rotation, expected.rig.right_from_left_rotation)
    assert float(expected.relative[1]) == pytest.approx(2e-4, abs=3e-6)
    # The left camera looks elsewhere, too: a yaw to the left is a smaller heading.
    assert there.mounting is not None
    assert abs(there.mounting.heading_deg - 35.0) == pytest.approx(math.degrees(1e-4), rel=0.05)
    assert there.mounting.covariance is not None
    assert float(there.mounting.covariance[5, 5]) == pytest.approx(
        float(watched.turns_at(3000.0).covariance[1, 1]), rel=1e-6
    )
    assert rig.mounting.covariance is None
    assert there.covariance is not None
    assert float(there.covariance.matrix[-5, -5]) == pytest.approx(float(expected.relative_covariance[1, 1]), rel=1e-6)
    later = watched.rig_at(9000.0)
    assert later.covariance is not None
    assert later.covariance.half.shape == there.covariance.half.shape
    assert len(there.covariance.half) == MORE_ERRORS
    with pytest.raises(InputError, match="begins at 0"):
        watched.rig_at(-1.0)


def test_looks_go_forward_in_time() -> None:
    watched = Watched(RIG, [row_of(60.0, None)], MODEL)
    with pytest.raises(InputError, match="not after"):
        watched.take(row_of(60.0, None))


def test_memory_is_bounded() -> None:
    watched = Watched(RIG, [], MODEL)
    for k in range(100):
        watched.take(row_of(60.0 * k, None), 40)
    assert len(watched.times) == len(watched.states) == len(watched.seen) <= 40
    assert watched.times[-1] == 60.0 * 99
