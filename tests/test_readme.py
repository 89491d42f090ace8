"""The README's Python gives the position that it says, and its figures and names are those of the rest."""

import math
import re
from pathlib import Path

import pytest
import torch

import kcal
from kcal import PositionStatus

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_python_block() -> None:
    (source,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    scope: dict = {}
    exec(compile(source, "README.md", "exec"), scope)
    # Without noise the target comes back, 2004 m away in the direction that the README gave it.
    found, distance = scope["found"], float(torch.linalg.vector_norm(scope["target"]))
    assert found.status.tolist() == [PositionStatus.OK]
    assert float(1 / found.inverse_range) == pytest.approx(distance, rel=1e-8)
    east, north, up = found.enu[0].tolist()
    heading = math.radians(35.0)
    # Right and forward, turned to a heading of 35 degrees; up is lower by refraction only.
    assert (east, north) == pytest.approx(
        (120 * math.cos(heading) + 2000 * math.sin(heading), -120 * math.sin(heading) + 2000 * math.cos(heading)),
        rel=1e-6,
    )
    assert up == pytest.approx(30.0, abs=0.1)
    assert found.range_low < distance < found.range_high
    assert len([line for line in source.splitlines() if line]) <= 10


def test_the_error_of_its_picture_is_one_figure() -> None:
    (shown,) = re.findall(r"median errors at 5 km of \d+ m, and of (\d+ m)\]", README)
    guide = (ROOT / "docs" / "tutorial" / "guide.md").read_text(encoding="utf-8")
    assert f"The README's ± {shown} is calibration alone" in " ".join(guide.split())
    assert "median error of the range by calibration alone" in README


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.findall(r"`make (\w+)`", README)
    assert sorted(targets) == ["demo", "docs", "test"]
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)


def test_the_names_on_its_first_screen_are_at_the_top() -> None:
    bullet = README.split("**Names on one screen.**")[1].split("* ")[0].split("## ")[0]
    at_top, others = bullet.split("are in `kcal`, the rest in")
    names = re.findall(r"`(\w+)`", at_top)
    assert len(names) > 5
    assert set(names) <= set(kcal.__all__)
    assert set(re.findall(r"`kcal\.(\w+)`", others)) < set(kcal.__all__)
