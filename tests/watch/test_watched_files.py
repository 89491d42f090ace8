"""Histories and the watcher that writes them: killed and continued, damaged, of other rigs."""

import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from kcal.corners.images import image_time
from kcal.errors import FileError, InputError
from kcal.locate.budget import planned_rig
from kcal.watch.history import HistoryRow, HistoryTail, Temperatures, history_head, history_line, read_history
from kcal.watch.watcher import Watched, Watcher, alarm_sigmas, exceeded, relock
from tests.helpers.scene_pairs import pair, small_rig
from tests.helpers.watched_looks import row_of, steady_model, yaw_turn

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
        assert torch.allclose(getattr(back[0].look, name).double(), getattr(look, name).double(), rtol=1e-12)
    assert back[0].note == "fog, perhaps"
    assert not back[1].look.seen.any()
    assert [float(row.look.kelvin) for row in back] == [0.0, 0.0, 1.5]
    assert [row.time for row in read_history(tmp_path / "h.csv", RIG.fingerprint, since=2.0, until=3.5)] == [3.0]


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
    assert exceeded(turn, sure, 0.005, 60.0).angles.tolist() == [False, True, False]
    assert not bool(exceeded(turn, sure * 1.02, 0.005, 60.0).any)
    assert bool(exceeded(-turn, sure, 0.005, 60.0).any)


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
    good = relock(day(0.0, 0.005))
    assert good.rig is None
    assert "does not differ" in good.reason
    drifted = relock(day(0.03, 0.004))
    assert drifted.rig is not None
    turn = drifted.rig.right_from_left_rotation @ RIG.right_from_left_rotation.T
    assert math.degrees(float(turn[0, 2])) == pytest.approx(0.03, abs=0.003)
    # Without the watch the swing is not known of a moment.
    assert drifted.rig.covariance is not None
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
