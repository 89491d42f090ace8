"""Where objects are refused, just within and just beyond each limit; what belongs to an object, and its steps."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from object_cases import Case, case
from torch import Tensor

from kcal.corners.match import MatchStatus
from kcal.errors import InputError
from kcal.pipeline.pairing import (
    DisparityOptions,
    ObjectDisparities,
    ObjectDisparity,
    _brightest,
    _flagged,
    _Objects,
)

GOOD = MatchStatus.GOOD


@pytest.fixture(scope="module")
def scene() -> Case:
    return case(3, noise=0.1, amplitude=0.0, size=24)


def found(scene: Case, **options: Any) -> ObjectDisparities:
    given = scene.left, scene.right, scene.boxes, scene.aims
    return ObjectDisparity(scene.rig, DisparityOptions(**options))(*given)


def status(result: ObjectDisparities) -> MatchStatus:
    return MatchStatus(int(result.status[0]))


def test_limits_of_what_was_found(scene: Case) -> None:
    usual = found(scene)
    assert status(usual) == GOOD
    score, off = float(usual.score[0]), float(usual.off_line[0])
    sigma = float(usual.covariance[0].diagonal().sum().sqrt())
    assert 0.6 < score < 1.0
    for name, value, refused in (
        ("min_score", score, MatchStatus.NO_MATCH), ("max_sigma", sigma, MatchStatus.FLAT),
        ("max_off_line", off, MatchStatus.OFF_LINE),
    ):  # fmt: skip
        step = 1e-3 if name == "min_score" else -1e-3 * value
        assert status(found(scene, **{name: value - step})) == GOOD, name
        assert status(found(scene, **{name: value + step})) == refused, name


def test_derivatives_by_the_anchor(scene: Case) -> None:
    """By moving the point of the left image that is wanted, the object staying what it is."""
    match, given = ObjectDisparity(scene.rig), (scene.left, scene.right, scene.boxes, scene.aims)
    middle = 0.5 * (scene.boxes[:, :2] + scene.boxes[:, 2:])
    slopes = []
    for step in 0.5 * torch.eye(2).double():
        up, down = (match(*given, anchors_left=middle + sign * step).pixels[0] for sign in (1, -1))
        slopes.append(up - down)
    by_anchor = match(*given).by_anchor[0]
    torch.testing.assert_close(by_anchor, torch.stack(slopes, -1), rtol=0, atol=1e-3)
    # The right camera is rolled beside the left one.
    assert abs(float(by_anchor[0, 1] - by_anchor[1, 0])) > 0.03


def test_what_is_refused_has_no_numbers(scene: Case) -> None:
    refused = found(scene, min_score=1.0)
    assert torch.equal(refused.pixels, scene.aims)
    assert torch.equal(refused.by_anchor[0], torch.eye(2).double())
    assert float(refused.off_line[0]) == 0.0
    assert 0.6 < float(refused.score[0]) < 1.0
    nowhere = scene._replace(aims=torch.full((1, 2), torch.nan).double())
    assert float(found(nowhere).score[0]) == 0.0


def objects(masks: Tensor | None = None) -> _Objects:
    boxes = torch.tensor([[10.0, 20.0, 30.0, 28.0]]).double()
    middle = torch.tensor([[20.0, 24.0]]).double()
    return _Objects(boxes, middle, middle, middle, masks, 5, 0)


def test_the_ellipse_in_a_box() -> None:
    """One up to .85 of its radii, zero from 1.15 of them, and half in the middle between."""
    at = torch.tensor([[20.0, 24.0], [28.4, 24.0], [30.0, 24.0], [20.0, 28.0], [20.0, 28.7], [31.5, 24.0]]).double()
    weight = objects().weight(at[None, None])[0, 0]
    assert weight.tolist() == pytest.approx([1.0, 1.0, 0.5, 0.5, 0.0, 0.0])
    slope = objects().weight(torch.tensor([[[[29.4, 24.0]]]]).double())
    assert float(slope) == pytest.approx((1.15 - 0.94) / 0.3)


def test_masks_are_those_of_the_nearest_pixels() -> None:
    masks = torch.zeros(1, 40, 50, dtype=torch.bool)
    masks[0, 24, 20] = masks[0, 39, 49] = masks[0, 0, 7] = True
    at = torch.tensor([[20.4, 23.6], [20.6, 24.0], [20.0, 24.6], [60.0, 45.0], [7.2, -9.0], [24.0, 20.0]]).double()
    assert objects(masks).weight(at[None, None])[0, 0].tolist() == [1.0, 0.0, 0.0, 1.0, 1.0, 0.0]


def test_patches_have_at_most_24_steps_to_each_side(scene: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 1.15 of half a box, in steps of powers of two; objects of one step size are matched together."""
    seen: list[tuple[int, int, list[float]]] = []

    def collected(self: ObjectDisparity, left: Tensor, right: Tensor, part: _Objects) -> ObjectDisparities:
        size = (part.boxes[:, 2:] - part.boxes[:, :2]).amax(-1)
        seen.append((part.level, part.half, size.tolist()))
        count = len(size)
        return ObjectDisparities(
            part.right, torch.eye(2).double().expand(count, 2, 2), torch.zeros(count).long(), size, size,
            torch.eye(2).double().expand(count, 2, 2),
        )  # fmt: skip

    monkeypatch.setattr(ObjectDisparity, "_match", collected)
    sides = [4.0, 20.0, 41.7, 41.8, 83.4, 83.6]
    boxes = torch.tensor([[30.0, 40.0, 30.0 + side, 40.0 + 0.5 * side] for side in sides], dtype=torch.float64)
    aims = torch.zeros(6, 2).double()
    aims[1] = torch.nan
    result = ObjectDisparity(scene.rig)(scene.left, scene.right, boxes, aims)
    levels = [(level, half, pytest.approx(size)) for level, half, size in seen]
    assert levels == [(0, 24, [4.0, 41.7]), (1, 24, [41.8, 83.4]), (2, 13, [83.6])]
    assert result.status.tolist() == [0, MatchStatus.NO_RAY, 0, 0, 0, 0]
    seen.clear()
    ObjectDisparity(scene.rig)(scene.left, scene.right, boxes[:1], aims[:1])
    assert seen == [(0, 3, [4.0])]


def test_what_is_named_last_counts() -> None:
    start = torch.zeros(3, dtype=torch.int64)
    yes, no = torch.tensor([True, True, False]), torch.tensor([False, True, False])
    flagged = _flagged(start, ((yes, MatchStatus.FLAT), (no, MatchStatus.NO_RAY)))
    assert flagged.tolist() == [MatchStatus.FLAT, MatchStatus.NO_RAY, 0]


def test_the_brightest_gray_level_is_that_of_the_type() -> None:
    usual = DisparityOptions()
    assert _brightest(torch.zeros(2, 2, dtype=torch.uint8), usual) == 255.0
    assert _brightest(torch.zeros(2, 2, dtype=torch.int16), usual) == 32767.0
    assert _brightest(torch.zeros(2, 2), usual) == math.inf
    assert _brightest(torch.zeros(2, 2), DisparityOptions(brightest=99.0)) == 99.0


def test_half_of_an_object_may_be_too_bright(scene: Case) -> None:
    """By its left part above one gray level: the share that may be is what `min_share` leaves."""
    left = scene.left.clone()
    box = scene.boxes[0]
    columns = torch.arange(left.shape[1]).double()
    for share, refused in ((0.3, False), (0.7, True)):
        bright = left.clone()
        bright[:, columns < float(box[0] + share * (box[2] - box[0]))] = 1000.0
        spoilt = found(scene._replace(left=bright), brightest=1000.0, min_share=0.5)
        assert (status(spoilt) == MatchStatus.SATURATED) is refused


@pytest.mark.parametrize(("good", "bad"), [
    ({"search": 1.0}, {"search": 0.9}), ({"search": 200.0}, {"search": 201.0}),
    ({"max_off_line": 1e-9}, {"max_off_line": 0.0}), ({"max_off_line": 20.0}, {"max_off_line": 20.1}),
    ({"max_sigma": 1e9}, {"max_sigma": math.inf}), ({"max_sigma": 1e-9}, {"max_sigma": 0.0}),
    ({"min_score": 1.0}, {"min_score": 1.1}), ({"max_rival": 1.0}, {"max_rival": 0.0}),
    ({"min_share": 1e-9}, {"min_share": 0.0}),
])  # fmt: skip
def test_options_at_their_limits(good: dict[str, float], bad: dict[str, float]) -> None:
    DisparityOptions(**good)
    with pytest.raises(InputError, match="disparity options"):
        DisparityOptions(**bad)
