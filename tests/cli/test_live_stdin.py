"""`kcal live --detections -` ends by a signal while its input stays open."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import PATIENCE, wait_for

from kcal import Origin, save_rig
from kcal.rig import Mounting, planned_rig


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_it_waits_for_a_line(sent: signal.Signals, tmp_path: Path) -> None:
    rig = planned_rig()
    rig.mounting = Mounting(origin=Origin(lat=10.0, lon=20.0, height=3.0), heading_deg=30.0)
    save_rig(rig, tmp_path / "rig.json")
    command = [sys.executable, "-m", "kcal", "live", "rig.json", "--detections", "-", "-o", "tracks.csv"]
    pipe = subprocess.PIPE
    live = subprocess.Popen(command, cwd=tmp_path, stdin=pipe, stdout=pipe, stderr=pipe)
    try:
        live.stdin.write(b'{"time": 1.0, "left": [[960, 540]], "right": [[944, 540]]}\n')
        live.stdin.flush()
        written = tmp_path / "tracks.csv"
        wait_for(lambda: written.exists() and written.stat().st_size > 0)
        live.send_signal(sent)
        # Its input stays open until it has ended.
        live.wait(PATIENCE)
        said = live.stderr.read().decode()
    finally:
        live.kill()
        live.communicate()
    assert "Fatal" not in said
    assert "Traceback" not in said
    assert live.returncode == 0
