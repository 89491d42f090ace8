from __future__ import annotations

import dataclasses

import pytest
import torch

from kcal.errors import InputError
from kcal.pipeline.pairs import ObjectPairs


def pairs(**changes: object) -> ObjectPairs:
    given = {
        "left": torch.rand(3, 2),
        "right": torch.rand(3, 2),
        "covariance": torch.eye(4).expand(3, 4, 4),
        "time": torch.zeros(3, 2, dtype=torch.float64),
        "score": torch.ones(3),
        "category": ("ship", "buoy", "ship"),
        "track": (None, "7", None),
        "ambiguous": torch.zeros(3, dtype=torch.bool),
    }
    return ObjectPairs(**(given | changes))  # type: ignore[arg-type]


def test_everything_becomes_float64() -> None:
    found = pairs()
    numbers = [value for value in vars(found).values() if isinstance(value, torch.Tensor)]
    assert {value.dtype for value in numbers} == {torch.float64, torch.bool}


def test_no_objects() -> None:
    none = torch.zeros(0, 2, dtype=torch.float64)
    empty = ObjectPairs(
        left=none, right=none, covariance=none.new_zeros(0, 4, 4), time=none, score=none[:, 0], category=(), track=(),
        ambiguous=torch.zeros(0, dtype=torch.bool),
    )  # fmt: skip
    assert len(empty) == 0
    assert dataclasses.replace(empty).left.shape == (0, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"left": torch.rand(2, 2)}, r"left: shape \(3, 2\)"),
        ({"left": torch.ones(3, 2, dtype=torch.int64)}, "floating point is needed"),
        ({"right": torch.full((3, 2), torch.nan)}, "right: 6 of 6 values are not finite"),
        ({"time": torch.zeros(3, 2)}, "time: float64 is needed"),
        ({"score": torch.ones(2)}, "score"),
        ({"track": (None,)}, "track: 3 names"),
        ({"ambiguous": torch.zeros(3)}, "ambiguous: bool"),
        ({"covariance": -torch.eye(4).expand(3, 4, 4)}, "3 of 3 are not symmetric or have a negative"),
        ({"covariance": torch.eye(4).index_put((torch.tensor(0), torch.tensor(1)), torch.tensor(0.5)).expand(3, 4, 4)},
         "3 of 3 are not symmetric"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        pairs(**changes)
