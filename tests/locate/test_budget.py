"""The paper's Table 2, and what is exact beside it."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

import pytest
from locate_rigs import real_rig

from kcal.cli.main import main
from kcal.errors import InputError
from kcal.io.rig_file import save_rig
from kcal.locate.budget import BudgetErrors, planned_rig, range_errors

SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"
# Disparity in px, ΔZ at 1 km and 5 km as printed in the paper.
TABLE_2 = [(2.0, 125.0, 3125.0), (1.0, 62.5, 1562.5), (0.5, 31.25, 781.25), (0.1, 6.25, 156.25)]


@pytest.mark.parametrize(("disparity", "at_1_km", "at_5_km"), TABLE_2)
def test_table_2_and_the_exact_values_beside_it(disparity: float, at_1_km: float, at_5_km: float) -> None:
    found = range_errors(planned_rig(), [1000.0, 5000.0], BudgetErrors(disparity_px=disparity))["disparity"]
    assert found.first_order.tolist() == pytest.approx([at_1_km, at_5_km], rel=1e-5)
    # f B = 16 000 px m: Z = 16 000 / d, by hand.
    for i, (z, d) in enumerate(((1000.0, 16.0), (5000.0, 3.2))):
        assert found.nearer[i].item() == pytest.approx(16_000 / (d + disparity) - z, rel=1e-6)
        assert found.farther[i].item() == pytest.approx(16_000 / (d - disparity) - z, rel=1e-6)
        assert found.nearer[i].abs() < found.first_order[i] < found.farther[i]


def test_two_pixels_at_5_km_are_eight_kilometers_and_four_are_beyond_infinity() -> None:
    found = range_errors(planned_rig(), [5000.0], BudgetErrors(disparity_px=2.0))["disparity"]
    assert (found.nearer.item(), found.farther.item()) == pytest.approx((-1923.1, 8333.3), abs=0.1)
    found = range_errors(planned_rig(), [5000.0], BudgetErrors(disparity_px=4.0))["disparity"]
    assert found.farther.item() == math.inf


def test_the_other_sources_by_hand() -> None:
    found = range_errors(planned_rig(), [1000.0, 5000.0])
    turn = math.radians(0.01)
    # The parallax is atan(B / Z); a turn adds to it.
    for i, z in enumerate((1000.0, 5000.0)):
        angle = math.atan(10 / z)
        assert found["yaw"].farther[i].item() == pytest.approx(10 / math.tan(angle - turn) - z, rel=1e-6)
        assert found["yaw"].nearer[i].item() == pytest.approx(10 / math.tan(angle + turn) - z, rel=1e-6)
    assert found["yaw"].first_order[1].item() == pytest.approx(436.3, abs=0.1)
    assert found["baseline"].farther.tolist() == pytest.approx([0.1, 0.5], rel=1e-6)
    # 0.2 m of motion during 10 ms in 10 m of baseline: 2 %.
    assert found["timing"].first_order.tolist() == pytest.approx([20.0, 100.0], rel=1e-4)
    assert found["timing"].farther.tolist() == pytest.approx([1000 / 0.98 - 1000, 5000 / 0.98 - 5000], rel=1e-4)


def test_a_calibrated_rig_with_lenses() -> None:
    rig = real_rig()
    found = range_errors(rig, [500.0, 4000.0])
    # About its f B, some 16 000 px m.
    assert found["disparity"].first_order[1].item() == pytest.approx(4000**2 / 16_000 * 0.1, rel=0.05)
    aside = range_errors(rig, [4000.0], pixel=(300.0, 500.0))["disparity"].first_order.item()
    assert aside != pytest.approx(found["disparity"].first_order[1].item(), rel=0.02)


def test_bad_arguments() -> None:
    for distances in ([], [0.0], [math.nan]):
        with pytest.raises(InputError, match="distances"):
            range_errors(planned_rig(), distances)
    with pytest.raises(InputError, match="does not see"):
        range_errors(planned_rig(), [1.0])
    with pytest.raises(InputError, match="not in the image"):
        range_errors(planned_rig(), [100.0], pixel=(-50.0, 0.0))
    with pytest.raises(InputError, match="yaw_deg"):
        BudgetErrors(yaw_deg=-1.0)
    with pytest.raises(InputError, match="larger than the baseline"):
        range_errors(planned_rig(), [100.0], BudgetErrors(baseline_m=20.0))


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["kcal", "budget", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    return int(stopped.value.code or 0)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "--pixel-sigma", "1.414213562373095", "--picture", "budget.png") == 0
    printed = capsys.readouterr().out
    assert "f B 16000 px m" in printed
    line = next(line for line in printed.splitlines() if line.split()[:2] == ["5", "km"])
    assert line.split()[-6:] == ["-1920", "m", "+8330", "m", "+3120", "m"]
    assert Path("budget.png").read_bytes().startswith(b"\x89PNG")
    save_rig(real_rig(), "rig.json")
    assert run(monkeypatch, "rig.json", "--distances", "500") == 0
    assert "rig.json: baseline 10.0" in capsys.readouterr().out
    assert run(monkeypatch, str(SAMPLE), "--distances", "1000,5000") == 0
    table = capsys.readouterr().out.split("What the rig file knows, and 0.1 px of noise in each mark:")[1].splitlines()
    assert table[3].startswith("5 km ")
    total, marks, lenses, pose, sideways = map(float, re.findall(r"(\S+) m", table[3].removeprefix("5 km")))
    assert marks == pytest.approx(math.sqrt(2) * 0.1 * 5000**2 / 16_000, rel=0.1)
    assert total == pytest.approx(math.hypot(marks, lenses, pose), rel=0.03)
    assert min(pose, sideways) > 0
    assert run(monkeypatch, str(SAMPLE), "--pixel-sigma", "0") == 1
    assert "a positive number of pixels" in capsys.readouterr().err
    assert run(monkeypatch, "--baseline", "0.08") == 0
    ranges = [line.strip().split("  ")[0] for line in capsys.readouterr().out.splitlines() if "disparity" in line]
    assert [float(text.removesuffix(" m")) for text in ranges] == [1, 2.5, 5, 10, 25, 50]
    assert run(monkeypatch, "--distances", "near") == 1
    assert "distances 'near'" in capsys.readouterr().err
