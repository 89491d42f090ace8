"""Lines of JSON: detections or pairs of one moment, read strictly."""

from __future__ import annotations

import orjson
import pytest
from track_scenes import tracked_site

from kcal.errors import InputError
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.locate.stations import stations_of
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.grouping import Moment, read_moment

RIG = tracked_site().rig


def read(content: object) -> Moment:
    return read_moment(orjson.dumps(content), RIG, AssociationOptions(), 0.5)


def test_pairs() -> None:
    moment = read({"time": [3.0, 3.01], "left": [[1, 2], [3, 4]], "right": [[0, 2], [1, 4]], "sigma": 0.1,
                   "categories": ["ship", "bird"], "scores": [0.5, 1], "ambiguous": [True, False]})  # fmt: skip
    assert moment.time == 3.0
    assert moment.pairs.time.tolist() == [[3.0, 3.01]] * 2
    assert moment.pairs.category == ("ship", "bird")
    assert moment.pairs.ambiguous.tolist() == [True, False]
    assert moment.pairs.covariance[1].diagonal().tolist() == pytest.approx([0.01] * 4)


def test_what_is_left_out() -> None:
    moment = read({"time": 3, "left": [[1, 2]], "right": [[0, 2]]})
    assert moment.pairs.covariance[0, 0, 0] == 0.25
    assert moment.pairs.category == ("object",)
    assert len(read({"time": 3, "left": [], "right": []}).pairs) == 0


def test_detections() -> None:
    """A thing at infinity is one at 400 m with 40 px of disparity; each found in both images."""
    near, far = [100, 500, 120, 520], [900, 700, 930, 720]
    right = [[60, 500, 80, 520], [860, 700, 890, 720]]
    seen_right = {"time": 5.02, "boxes": right[::-1], "categories": ["bus", "car"], "scores": [0.5, 0.9]}
    moment = read({"left": {"time": 5.0, "boxes": [near, far], "categories": ["car", "bus"]}, "right": seen_right})
    assert moment.time == 5.0
    assert moment.pairs.category == ("car", "bus")
    assert moment.pairs.right.tolist() == [[69.5, 509.5], [874.5, 709.5]]
    assert moment.pairs.score.tolist() == [0.9, 0.5]
    assert moment.pairs.time.tolist() == [[5.0, 5.02]] * 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1], "left and right"),
        ({"left": [], "right": []}, "needs a time"),
        ({"time": 1, "left": [], "right": [], "more": 1}, "may have only"),
        ({"time": "1", "left": [], "right": []}, "time"),
        ({"time": 1, "left": [[1]], "right": [[1, 2]]}, "left: rows of 2"),
        ({"time": 1, "left": [[1, True]], "right": [[1, 2]]}, "left: rows of 2"),
        ({"time": 1, "left": [[1, 2]], "right": []}, "right"),
        ({"time": 1, "left": [[1, 2]], "right": [[1, 2]], "sigma": 0}, "positive number"),
        ({"time": 1, "left": [[1, 2]], "right": [[1, 2]], "categories": [1]}, "categories: a list of 1"),
        ({"time": 1, "left": [[1, 2]], "right": [[1, 2]], "ambiguous": [0, 1]}, "ambiguous: a list of 1"),
        ({"time": 1, "left": [[1, 2]], "right": [[1, 2]], "covariance": 3}, "covariance"),
        ({"time": 1, "left": [[1, 2]], "right": [[1, 2]], "scores": "high"}, "scores"),
        ({"left": {"boxes": []}, "right": {"boxes": []}}, "need a time"),
        ({"left": {"boxes": []}, "right": {"boxes": []}, "time": 1}, "left and right only"),
    ],
)
def test_malformed(content: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(content)
    with pytest.raises(InputError, match="not a line of JSON"):
        read_moment(b"{", RIG, AssociationOptions(), 0.5)


def test_cameras_by_their_names() -> None:
    """The time is that of the first camera that has an image; only names of the rig's cameras are possible."""
    localize = MultiViewLocalizer(stations_of(RIG))
    first, second = localize.rig.names
    options = AssociationOptions()

    def read_cameras(content: object) -> Moment:
        return read_moment(orjson.dumps(content), localize, options, 0.5)

    boxes = [[100, 500, 120, 520]]
    one = read_cameras({"cameras": {second: {"time": 4.5, "boxes": boxes}}})
    assert (one.time, one.pairs.seen.tolist()) == (4.5, [[False, True]])
    both = {first: {"time": 4.4, "boxes": [[140, 500, 160, 520]]}, second: {"time": 4.5, "boxes": boxes}}
    pair = read_cameras({"cameras": both})
    assert (pair.time, pair.pairs.seen.tolist()) == (4.4, [[True, True]])
    assert pair.pairs.pixels[0].tolist() == [[149.5, 509.5], [109.5, 509.5]]
    for wrong in (
        [],
        {"cameras": {}},
        {"cameras": []},
        {"cameras": both, "time": 3},
        {"cameras": {"mill": both[first]}},
    ):
        with pytest.raises(InputError, match=f"with names of {first}, {second}"):
            read_cameras(wrong)
    with pytest.raises(InputError, match="need a time"):
        read_cameras({"cameras": {first: {"boxes": boxes}}})


def test_covariances_of_pairs() -> None:
    line = {"time": 3, "left": [[1, 2]], "right": [[0, 2]]}
    own = [[0.04, 0, 0.01, 0], [0, 0.05, 0, 0], [0.01, 0, 0.06, 0], [0, 0, 0, 0.07]]
    assert read(line | {"covariance": [own]}).pairs.covariance[0].tolist() == own
    for wrong in ([], [own, own], 3):
        with pytest.raises(InputError, match="a list of 1 matrices"):
            read(line | {"covariance": wrong})
