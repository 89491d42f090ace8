"""Detections and lines of JSON: what a detector returns, what it may be, and how a line is read."""

import json
import sys
import types
from typing import Any

import kornia.geometry.boxes
import kornia.geometry.keypoints
import numpy as np
import orjson
import pytest
import supervision
import torch
from track_scenes import tracked_site

from kcal import InputError, Localizer
from kcal.lens import ImageTransform
from kcal.pipeline.detections import Detections, detect_in, load_detector
from kcal.pipeline.grouping import Moment, read_moment
from kcal.track import AssociationOptions

EDGES = [[100.0, 50.0, 112.0, 62.0], [10.0, 20.0, 40.5, 60.0]]

CENTERS = torch.tensor(EDGES, dtype=torch.float64) - 0.5

SIZE = (200, 100)


def mask() -> np.ndarray:
    masks = np.zeros((2, 100, 200), bool)
    masks[0, 50:62, 100:112] = masks[1, 20:60, 10:40] = True
    return masks


def test_supervision() -> None:
    source = supervision.Detections(
        xyxy=np.array(EDGES),
        confidence=np.array([0.9, 0.5]),
        class_id=np.array([3, 8]),
        tracker_id=np.array([7, 12]),
        mask=mask(),
        data={"class_name": np.array(["car", "ship"])},
    )
    found = Detections.read(source)
    assert torch.equal(found.boxes, CENTERS)
    assert (found.category, found.track, found.size) == (("car", "ship"), ("7", "12"), SIZE)
    assert found.score.tolist() == [0.9, 0.5]
    assert found.masks is not None
    assert np.array_equal(found.masks.numpy(), mask())
    numbered = supervision.Detections(xyxy=np.array(EDGES), class_id=np.array([3, 8]))
    assert Detections.read(numbered, size=SIZE, names={3: "car"}).category == ("car", "8")
    assert len(Detections.read(supervision.Detections.empty(), size=SIZE)) == 0


def test_torchvision() -> None:
    source = {
        "boxes": torch.tensor(EDGES), "labels": torch.tensor([1, 2]), "scores": torch.tensor([0.9, 0.5]),
        "masks": torch.from_numpy(mask())[:, None].float() * 0.8, "keypoints": torch.full((2, 5, 3), 30.5),
    }  # fmt: skip
    found = Detections.read(source, size=SIZE, time=4.0)
    assert torch.equal(found.boxes, CENTERS)
    assert found.category == ("1", "2")
    assert found.time == 4.0
    assert found.anchors(4).tolist() == [[30.0, 30.0]] * 2
    assert found.masks is not None
    assert found.masks.sum((1, 2)).tolist() == [144, 1200]


def results(**more: object) -> types.SimpleNamespace:
    boxes = types.SimpleNamespace(
        xyxy=torch.tensor(EDGES), conf=torch.tensor([0.9, 0.5]), cls=torch.tensor([0.0, 8.0]), id=torch.tensor([4, 5])
    )  # fmt: skip
    return types.SimpleNamespace(boxes=boxes, orig_shape=(100, 200), names={0: "person", 8: "boat"}, **more)


def test_ultralytics() -> None:
    found = Detections.read(results(keypoints=types.SimpleNamespace(xy=torch.full((2, 17, 2), 8.0))))
    assert torch.equal(found.boxes, CENTERS)
    assert (found.category, found.track, found.size) == (("person", "boat"), ("4", "5"), SIZE)
    assert found.anchors(16).tolist() == [[7.5, 7.5]] * 2
    found = Detections.read(results(masks=types.SimpleNamespace(data=torch.from_numpy(mask()).float())))
    assert found.masks is not None
    # Masks of the network's input are not those of the image.
    assert Detections.read(results(masks=types.SimpleNamespace(data=torch.ones(2, 64, 64)))).masks is None


def test_keypoints_at_the_corner_were_not_found() -> None:
    """Ultralytics sets points below a confidence of 0.5 to (0, 0), as COCO has those without a label."""
    points = torch.full((2, 3, 3), 8.0)
    points[0, 1] = 0.0
    for source in (
        results(keypoints=types.SimpleNamespace(xy=points[..., :2])),
        {"boxes": EDGES, "keypoints": points},
        json.dumps({"boxes": torch.as_tensor(EDGES).tolist(), "keypoints": points.tolist()}),
    ):
        found = Detections.read(source, size=SIZE)
        assert found.anchors(1).isnan().all(-1).tolist() == [True, False]
        assert found.anchors(0).tolist() == [[7.5, 7.5]] * 2


def test_kornia() -> None:
    boxes = kornia.geometry.boxes.Boxes.from_tensor(torch.tensor(EDGES), mode="xyxy")
    assert torch.equal(Detections.read(boxes, size=SIZE).boxes, CENTERS)
    inclusive = kornia.geometry.boxes.Boxes.from_tensor(torch.tensor([[100.0, 50.0, 111.0, 61.0]]), mode="xyxy_plus")
    assert torch.equal(Detections.read(inclusive, size=SIZE).boxes, CENTERS[:1])
    found = Detections.read(kornia.geometry.keypoints.Keypoints(torch.tensor([[30.0, 40.25]])), size=SIZE)
    assert found.anchors(0).tolist() == found.anchors().tolist() == [[30.0, 40.25]]


def test_arrays_and_json() -> None:
    table = np.column_stack([EDGES, [0.9, 0.5], [1, 2]])
    found = Detections.read(table, size=SIZE, names={2: "ship"})
    assert torch.equal(found.boxes, CENTERS)
    assert (found.category, found.score.tolist()) == (("1", "ship"), [0.9, 0.5])
    assert torch.equal(Detections.read(table[:, :4].astype(np.int64), size=SIZE).boxes[0], CENTERS[0])
    assert torch.equal(Detections.read(torch.tensor(EDGES), size=SIZE, first_pixel=0.0).boxes, CENTERS + 0.5)
    line = b'{"size": [200, 100], "time": 3, "boxes": [[1, 2, 3, 4]], "tracks": [null], "keypoints": [[[1.5, 2.5]]]}'
    found = Detections.read(line)
    assert (found.track, found.time, found.category) == ((None,), 3, ("object",))
    assert found.anchors(0).tolist() == [[1.0, 2.0]]
    assert len(Detections.read('{"size": [200, 100], "boxes": []}')) == 0


def test_a_letterboxed_input_comes_back() -> None:
    transform = ImageTransform.letterbox((1001, 701), (416, 352))
    truth = torch.tensor([[300.25, 200.5, 340.0, 260.75]], dtype=torch.float64)
    seen = transform.to_input(truth.reshape(-1, 2)).reshape(1, 4)
    found = Detections.read(seen, size=(416, 352), first_pixel=0.0).to_full(transform)
    assert torch.allclose(found.boxes, truth, rtol=0, atol=1e-12)
    assert found.size == (1001, 701)
    assert torch.allclose(found.anchors("bottom"), torch.tensor([[320.125, 260.75]], dtype=torch.float64))


def test_masks_of_an_input_come_back() -> None:
    transform = ImageTransform.letterbox((400, 200), (100, 100))  # a quarter, 25 rows of padding
    seen = torch.zeros(1, 100, 100, dtype=torch.bool)
    seen[0, 35:45, 10:20] = True
    found = Detections(
        boxes=torch.tensor([[9.5, 34.5, 19.5, 44.5]]), score=torch.ones(1), category=("a",), track=(None,), masks=seen,
        size=(100, 100),
    ).to_full(transform)  # fmt: skip
    assert found.masks is not None
    rows, columns = found.masks[0].nonzero().unbind(-1)
    assert [int(v) for v in (columns.min(), rows.min(), columns.max(), rows.max())] == [40, 40, 79, 79]
    assert found.boxes.tolist() == [[39.5, 39.5, 79.5, 79.5]]


def test_selection() -> None:
    found = Detections.read(np.column_stack([EDGES, [0.9, 0.5], [1, 2]]), size=SIZE)
    assert found.select(found.score > 0.6).category == ("1",)
    assert torch.equal(found.select(torch.tensor([1, 0])).boxes, CENTERS.flip(0))
    assert found.select([1]).category == ("2",)
    assert len(found.select([])) == 0
    assert found.select(np.array([True, True])).category == ("1", "2")
    for wrong in (torch.ones(2, dtype=torch.uint8), torch.tensor([True]), torch.ones(2)):
        with pytest.raises(InputError, match="a mask of 2 bool or whole numbers"):
            found.select(wrong)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Detections.read(torch.tensor(EDGES)), "the image's size is needed"),
        (lambda: Detections.read(torch.ones(2, 3), size=SIZE), r"shape \(N, 4\) to \(N, 6\)"),
        (lambda: Detections.read(torch.tensor([[3.0, 2, 1, 4]]), size=SIZE), "has no area"),
        (lambda: Detections.read(torch.full((1, 4), torch.nan), size=SIZE), "not finite"),
        (lambda: Detections.read(torch.tensor([[0.3, 0.2, 0.4, 1.0]]), size=SIZE), "shares of the image"),
        (lambda: Detections.read(3.0, size=SIZE), "float is not known"),
        (lambda: Detections.read({"labels": []}, size=SIZE), "has no boxes, only labels"),
        (lambda: Detections.read("{", size=SIZE), "not a line of JSON"),
        (lambda: Detections.read('{"boxes": [], "boxs": 1}', size=SIZE), "else only"),
        (lambda: Detections.read('{"boxes": [["a", 1, 2, 3]]}', size=SIZE), "not numbers"),
        (lambda: Detections.read('{"boxes": [[1, 2, 3, 4]], "scores": [1, 2]}', size=SIZE), "score"),
        (lambda: Detections.read('{"boxes": [], "time": "now"}', size=SIZE), "time must be seconds"),
        (lambda: Detections.read('{"boxes": [], "size": [3]}', size=SIZE), "size must be"),
        (lambda: Detections.read('{"boxes": [], "size": [-64, 48]}'), "size must be"),
        (lambda: Detections.read('{"boxes": [], "size": [3, 4]}', size=SIZE), "the source says"),
        (lambda: Detections.read('{"boxes": [], "categories": 3}', size=SIZE), "categories must be"),
        (lambda: Detections.read('{"boxes": [], "tracks": 3}', size=SIZE), "tracks must be"),
        (lambda: Detections.read(torch.tensor(EDGES), size=SIZE).anchors(0), "no such keypoint"),
        (lambda: Detections.read(torch.tensor(EDGES), size=SIZE).anchors("top"), "'center', 'bottom'"),  # type: ignore[arg-type]
        (lambda: Detections.read(torch.tensor(EDGES), size=SIZE).to_full(ImageTransform.resize(SIZE, (9, 9))), "leads"),
        (lambda: Detections.read(torch.tensor(EDGES), size=SIZE, time=float("nan")), "seconds are needed"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(call: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()  # type: ignore[operator]


# A user's detector: what its name must be, what it may return, and what is said in one line when it fails.


IMAGE = np.zeros((30, 50, 3), np.uint8)

BOX = [[1.0, 2.0, 5.0, 6.0]]


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    made = types.ModuleType("my_detector")
    vars(made).update(plain=lambda image: BOX, inner=types.SimpleNamespace(call=lambda image: BOX), number=3)
    monkeypatch.setitem(sys.modules, "my_detector", made)
    return made


@pytest.mark.usefixtures("module")
def test_names_of_detectors() -> None:
    assert load_detector("my_detector:plain")(IMAGE) == BOX
    assert load_detector("my_detector:inner.call")(IMAGE) == BOX


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize(("name", "message"), [
    ("my_detector", "write package.module:callable"), (":plain", "write package"), ("my_detector:", "write package"),
    ("no_such_module_here:plain", "no module 'no_such_module_here'"), ("my_detector:other", "has no 'other'"),
    ("my_detector:inner.other", "has no 'other'"), ("my_detector:number", "of type int, cannot be called"),
])  # fmt: skip
def test_names_that_are_none(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_detector(name)


def test_a_module_that_fails(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "failing_detector.py").write_text("raise ValueError('two\\n lines')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="importing failing_detector fails: ValueError: two lines"):
        load_detector("failing_detector:plain")


@pytest.mark.parametrize("found", [
    BOX, [{"boxes": np.array(BOX)}], ({"boxes": np.array(BOX)},), {"boxes": np.array(BOX)},
    [types.SimpleNamespace(xyxy=np.array(BOX), confidence=None, class_id=None, tracker_id=None, mask=None, data={})],
])  # fmt: skip
def test_what_a_detector_may_return(found: Any) -> None:
    """One result, or a batch with one of them: in an image 50 px wide and 30 px high."""
    seen = detect_in(lambda image: found, IMAGE, 7.5, "left image")
    assert seen.boxes.tolist() == [[0.5, 1.5, 4.5, 5.5]]
    assert (seen.size, seen.time) == ((50, 30), 7.5)


def test_what_it_must_not_return() -> None:
    with pytest.raises(InputError, match=r"what the detector returned for the left image at 7\.500 s: .*not known"):
        detect_in(lambda image: 3.0, IMAGE, 7.5, "left image")
    two = [{"boxes": np.array(BOX)}] * 2
    with pytest.raises(InputError, match="what the detector returned"):
        detect_in(lambda image: two, IMAGE, 7.5, "left image")


@pytest.mark.parametrize(("error", "text"), [(KeyError(), "KeyError$"), (ValueError("a  b"), "ValueError: a b$")])
def test_a_detector_that_fails(error: Exception, text: str) -> None:
    def failing(image: Any) -> Any:
        raise error

    with pytest.raises(InputError, match=rf"the detector failed on the mast's image at 0\.250 s: {text}"):
        detect_in(failing, IMAGE, 0.25, "mast's image")


# Lines of JSON: detections or pairs of one moment, read strictly.


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
        ({"time": "1", "left": [], "right": []}, r"time .seconds"),
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
    localize = Localizer(RIG, weights="all")
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
