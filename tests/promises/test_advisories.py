"""The check of pins against a stored list of advisories."""

from pathlib import Path
from typing import Any

from scripts.check.advisories import concerned, pinned


def test_a_pin_that_an_advisory_concerns_is_named(tmp_path: Path) -> None:
    (tmp_path / "pins.txt").write_text("# comment\nPillow==10.0.0  # read by all\nnumpy==2.1.0\n")
    pins = pinned(tmp_path / "pins.txt")
    assert pins == {"pillow": "10.0.0", "numpy": "2.1.0"}
    known: dict[str, Any] = {
        "$meta": {"timestamp": 0},
        "pillow": [
            {"id": "old", "advisory": "a", "specs": ["<9"]},
            {"id": "new", "advisory": "b", "specs": ["<9", ">=10,<10.0.1"]},
        ],
        "NumPy": [{"id": "odd", "advisory": "c", "specs": ["no versions"]}],
        "torch": [{"id": "other", "advisory": "d", "specs": [">0"]}],
    }
    assert concerned(pins, known) == ["pillow==10.0.0: new : b", "NumPy==2.1.0: odd : c"]


def test_the_pins_of_kcal_are_read() -> None:
    pins = pinned(Path(__file__).parents[2] / "constraints.txt")
    assert {"torch", "numpy", "opencv-contrib-python-headless"} <= pins.keys()
    assert len(pins) > 30
