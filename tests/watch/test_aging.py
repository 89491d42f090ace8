"""What a rig forgets by day."""

import math

import pytest

from kcal.errors import InputError
from kcal.watch.turned import forgotten_yaw, parse_aging


def test_time_is_a_random_walk_and_temperature_is_not() -> None:
    assert forgotten_yaw(hours=4, per_hour=0.001) == pytest.approx(0.002)
    assert forgotten_yaw(kelvin=4, per_kelvin=0.001) == pytest.approx(0.004)
    assert parse_aging("4h:0.001, 4K:0.001", "--aged") == pytest.approx(math.hypot(0.002, 0.004))


@pytest.mark.parametrize("text", ["4h", "4:0.001", "4h:", "4h:-0.001", "4h:1e999", "x", "9h:0.1,4h:0.2"])
def test_what_is_no_aging(text: str) -> None:
    with pytest.raises(InputError, match=r"write hours|from 0 on"):
        parse_aging(text, "--aged")
