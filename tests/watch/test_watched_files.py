"""Files and state of a watched rig."""

import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pandas
import polars
import pyarrow.parquet
import pytest
import torch

from kcal import FileError, InputError, Origin
from kcal.corners.images import image_time
from kcal.rig import Mounting, planned_rig
from kcal.watch.history import (
    COLUMNS,
    AngleSeries,
    HistoryRow,
    HistoryTail,
    Temperatures,
    between_rows,
    first_state,
    history_head,
    history_line,
    learned,
    passed,
    read_history,
    save_history,
    taken,
    turns_of,
)
from kcal.watch.watcher import MORE_ERRORS, Watched, Watcher, alarm_sigmas, exceeded, relock
from tests.helpers.scene_pairs import pair, small_rig
from tests.helpers.watched_looks import SHARE, SIGMA, row_of, simulated, steady_model, yaw_turn

# Histories and the watcher that writes them: killed and continued, damaged, of other rigs.


TOLD = torch.zeros(3).double(), torch.ones(3).double()

RIG = planned_rig()


def write_history(path: Path, rows: list[HistoryRow], fingerprint: str = RIG.fingerprint) -> Path:
    path.write_text(history_head() + "".join(history_line(row, fingerprint, TOLD) for row in rows))
    return path


def test_a_history_keeps_what_was_measured(tmp_path: Path) -> None:
    row = row_of(1.5, yaw_turn(0.01), note="fog, perhaps")
    look = row.look._replace(
        between=torch.arange(5.0).double() * 1e-5, between_covariance=1e-10 * torch.eye(5).double(),
        matched=torch.tensor(True),
    )  # fmt: skip
    rows = [row._replace(look=look, temperature=21.5), row_of(3.0, None), row_of(4.0, None)._replace(temperature=23.0)]
    back = read_history(write_history(tmp_path / "h.csv", rows), RIG.fingerprint)
    for name in ("turn", "covariance", "between", "between_covariance", "seen", "matched", "lasting"):
        assert torch.allclose(getattr(back[0].look, name).double(), getattr(look, name).double(), 1e-12, 0)
    assert back[0].note == "fog, perhaps"
    assert not back[1].look.seen.any()
    assert [float(row.look.kelvin) for row in back] == [0.0, 0.0, 1.5]
    assert [row.time for row in read_history(tmp_path / "h.csv", RIG.fingerprint, since=2.0, until=3.5)] == [3.0]


def test_a_history_as_parquet_is_the_same(tmp_path: Path) -> None:
    rows = [row_of(1.5, yaw_turn(0.01), note='fog, "perhaps"'), row_of(3.0, None), row_of(4.0, None, note="=1+1")]
    path = write_history(tmp_path / "h.csv", [rows[0], rows[1]._replace(temperature=21.5), rows[2]])
    with path.open("a") as file:
        file.write("5.0,half a li")  # what a power cut leaves
    made = save_history(path, tmp_path / "h.parquet")
    table = pyarrow.parquet.read_table(made)
    assert table.num_rows == 3
    assert tuple(table.column_names) == COLUMNS
    for name, column in zip(COLUMNS, pandas.read_parquet(made).items(), strict=True):
        assert column[1].isna().tolist() == polars.read_parquet(made)[name].is_null().to_list()
    assert polars.read_parquet(made)["temperature_c"].to_list() == [None, 21.5, None]
    assert table["left_features"].type == pyarrow.int64()
    for one, other in zip(read_history(path.with_suffix(".parquet"), RIG.fingerprint),
                          read_history(write_history(path, rows), RIG.fingerprint), strict=True):  # fmt: skip
        assert torch.equal(one.look.turn, other.look.turn)
        assert torch.equal(one.look.covariance, other.look.covariance)
        assert (one.time, one.note, one.features) == (other.time, other.note, other.features)
    assert Watched.read(made, RIG).times == [1.5, 3.0, 4.0]
    tail = HistoryTail(made, RIG.fingerprint)
    assert [len(tail.rows()), len(tail.rows())] == [3, 0]


def test_what_is_no_history_becomes_no_parquet(tmp_path: Path) -> None:
    made = tmp_path / "h.parquet"
    for text, message in (("a,b\n1,2\n", "not a history"), ("time,rig\n1\n", "damaged"), ("", "no history")):
        (tmp_path / "h.csv").write_text(text)
        with pytest.raises(FileError, match=message):
            save_history(tmp_path / "h.csv", made)
        assert not made.exists()
    with pytest.raises(FileError, match="of another rig"):
        Watched.read(save_history(write_history(tmp_path / "h.csv", [row_of(1.0, None)], "x"), made), RIG)
    pyarrow.parquet.write_table(pyarrow.table({"a": [1]}), made)
    with pytest.raises(FileError, match="not a history"):
        Watched.read(made, RIG)
    made.write_bytes(b"nothing")
    with pytest.raises(FileError, match="cannot read"):
        Watched.read(made, RIG)


def test_a_history_is_followed_as_it_grows(tmp_path: Path) -> None:
    path = write_history(tmp_path / "h.csv", [row_of(1.0, None)])
    tail = HistoryTail(path, RIG.fingerprint)
    assert len(tail.rows()) == 1
    line = history_line(row_of(2.0, yaw_turn(0.1)), RIG.fingerprint, TOLD)
    with path.open("a") as file:
        file.write(line[:40])
    assert tail.rows() == []
    with path.open("a") as file:
        file.write(line[40:])
    assert [row.time for row in tail.rows()] == [2.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no rows yet"),
        ("a,b\n1,2\n", "not a history"),
        (history_head() + "1,2\n", "line 2: 2 cells"),
        (history_head() + history_line(row_of(1.0, None), "0123456789ab", TOLD), "of another rig"),
        (history_head() + history_line(row_of(1.0, yaw_turn(0.1)), RIG.fingerprint, TOLD).replace("1.0,", "one,", 1),
         "a number is damaged"),
        (history_head() + history_line(row_of(1.0, yaw_turn(0.1)), RIG.fingerprint, TOLD).replace("e-08", "e-08x"),
         "a number is damaged"),
    ],
)  # fmt: skip
def test_damaged_histories_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "h.csv"
    path.write_text(text)
    with pytest.raises(FileError, match=message):
        read_history(path, RIG.fingerprint)


_KILLED = """
import os, sys
sys.path[:0] = sys.argv[2:]
from pathlib import Path
from kcal.watch.watcher import Watcher
from tests.helpers.scene_pairs import pair, small_rig
watcher = Watcher(small_rig(), Path(sys.argv[1]))
watcher._matched = 1e9
for k in range(2):
    one = pair(k + 1)
    watcher.look(60.0 * k, one.left, one.right)
with open(sys.argv[1], "a") as file:
    file.write("180.0,half a li")
os.kill(os.getpid(), 9)
"""


@pytest.mark.slow
def test_a_killed_watch_continues(tmp_path: Path) -> None:
    history = tmp_path / "h.csv"
    killed = subprocess.run([sys.executable, "-c", _KILLED, str(history), os.getcwd()], check=False)
    assert killed.returncode == -signal.SIGKILL
    said: list[str] = []
    watcher = Watcher(small_rig(), history, tell=said.append)
    assert watcher.last_time == 60.0
    assert not watcher.due(60.0)
    assert not watcher.due(100.0)
    assert watcher.due(120.0)
    watcher._matched = 1e9
    one = pair(3)
    watcher.look(120.0, one.left, one.right)
    watcher.close()
    assert [row.time for row in read_history(history, small_rig().fingerprint)] == [0.0, 60.0, 120.0]
    assert said == []
    assert watcher.skipped == 1
    # The turn counts from the first image of the first run.
    assert math.degrees(float(Watched.read(history, small_rig()).drift_at(120.0).relative.norm())) < 0.003
    (tmp_path / "h.reference.npz").unlink()
    with pytest.raises(FileError, match="the reference of the history is missing"):
        Watcher(small_rig(), history)
    with pytest.raises(FileError, match="another rig"):
        Watcher(RIG, history)
    (tmp_path / "h.csv.journal").unlink()
    with pytest.raises(FileError, match="no journal beside it"):
        Watcher(small_rig(), history)


def test_alarms_need_a_limit_surely_passed() -> None:
    sigmas = alarm_sigmas(60.0)
    turn = torch.tensor([0.0, math.radians(0.01), 0.0]).double()
    sure = torch.full((3,), math.radians(0.005) / sigmas * 0.99).double()
    assert exceeded(turn, sure, 0.005, 60.0).tolist() == [False, True, False]
    assert not bool(exceeded(turn, sure * 1.02, 0.005, 60.0).any())
    assert bool(exceeded(-turn, sure, 0.005, 60.0).any())
    # Measured once a year, a limit can still be passed.
    assert bool(exceeded(turn, 0.1 * sure, 0.005, 3e7).any())


def test_temperatures_of_a_growing_table(tmp_path: Path) -> None:
    path = tmp_path / "air.csv"
    path.write_text("time,temperature\n0,10\n1970-01-01T00:10:00Z,20\n1200,")
    air = Temperatures(path)
    assert air.at(300.0) == 15.0
    assert math.isnan(air.at(9000.0))
    with path.open("a") as file:
        file.write("30\n")
    assert air.at(900.0) == 25.0
    with path.open("a") as file:
        file.write("1300,295\n")
    with pytest.raises(FileError, match="line 5"):
        air.at(900.0)
    # Whose hour a time without a zone is would be a guess.
    path.write_text("time,temperature\n1970-01-01T00:10:00,20\n")
    with pytest.raises(FileError, match=r"line 2: .*with its zone"):
        Temperatures(path)
    path.write_text("when,what\n")
    with pytest.raises(FileError, match="columns time and temperature"):
        Temperatures(path)


def day(yaw: float, swing: float, hours: int = 30) -> Watched:
    random = torch.Generator().manual_seed(5)
    rows = []
    for k in range(hours * 6):
        noise = 4e-6 * torch.randn(6, generator=random, dtype=torch.float64)
        rows.append(row_of(600.0 * k, yaw_turn(yaw + swing * math.sin(math.pi * k / 72.0)) + noise))
    return Watched(RIG, rows, steady_model(0.003, 3.0, 0.0003))


def test_relock_never_makes_a_good_rig_worse() -> None:
    assert "a day of history" in relock(day(0.02, 0.0, 20)).reason
    rare = Watched(RIG, [row_of(7200.0 * k, yaw_turn(0.02)) for k in range(20)], steady_model(0.003, 3.0, 0.0003))
    assert "more than 20 measurements" in relock(rare).reason
    good = relock(day(0.0, 0.005))
    assert good.rig is None
    assert "does not differ" in good.reason
    drifted = relock(day(0.03, 0.004))
    turn = drifted.rig.right_from_left_rotation @ RIG.right_from_left_rotation.T
    assert math.degrees(float(turn[0, 2])) == pytest.approx(0.03, abs=0.003)
    # Without the watch the swing is not known of a moment.
    assert math.degrees(float(drifted.rig.covariance.matrix[-5, -5].sqrt())) > 0.002


def test_relock_needs_the_last_looks() -> None:
    watched = day(0.03, 0.0)
    for _ in range(22):
        watched.take(row_of(watched.times[-1] + 600.0, yaw_turn(0.0)))
    assert relock(watched).rig is None


def test_times_of_images(tmp_path: Path) -> None:
    assert image_time(Path("cam_2026-01-01T00-00-00.250.png")) == 1767225600.25
    (tmp_path / "left.png").write_bytes(b"no image")
    with pytest.raises(FileError, match="no time of capture"):
        image_time(tmp_path / "left.png")


def test_few_features_make_no_reference(tmp_path: Path) -> None:
    watcher = Watcher(small_rig(), tmp_path / "h.csv")
    one = pair(1)
    with pytest.raises(InputError, match="left: 0 features"):
        watcher.look(0.0, one.left * 0, one.right)
    watcher.close()


# The filter of attitudes: as wrong as it says, through gaps, gusts, wrong looks and jumps.


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
    told = Watched(RIG, [*good, wrong[0]], MODEL).turns_at(1800.0)
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
    assert abs(math.degrees(float(Watched(RIG, rows, MODEL).turns_at(60.0 * 20).mean[4]))) < 0.001


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
    assert abs(there.mounting.heading_deg - 35.0) == pytest.approx(math.degrees(1e-4), rel=0.05)
    assert float(there.mounting.covariance[5, 5]) == pytest.approx(
        float(watched.turns_at(3000.0).covariance[1, 1]), rel=1e-6
    )
    assert not rig.mounting.covariance[:6].any()
    assert float(there.covariance.matrix[-5, -5]) == pytest.approx(float(expected.relative_covariance[1, 1]), rel=1e-6)
    assert len(watched.rig_at(9000.0).root) == len(there.root) == len(rig.root) + MORE_ERRORS
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
