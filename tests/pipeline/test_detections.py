from __future__ import annotations

import types

import kornia.geometry.boxes
import kornia.geometry.keypoints
import numpy as np
import pytest
import supervision
import torch

from kcal.errors import InputError
from kcal.lens.camera_conversions import ImageTransform
from kcal.pipeline.detections import Detections

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


def test_kornia() -> None:
    boxes = kornia.geometry.boxes.Boxes.from_tensor(torch.tensor(EDGES), mode="xyxy")
    assert torch.equal(Detections.read(boxes, size=SIZE).boxes, CENTERS)
    inclusive = kornia.geometry.boxes.Boxes.from_tensor(torch.tensor([[100.0, 50.0, 111.0, 61.0]]), mode="xyxy_plus")
    assert torch.equal(Detections.read(inclusive, size=SIZE).boxes, CENTERS[:1])
    points = kornia.geometry.keypoints.Keypoints(torch.tensor([[30.0, 40.25]]))
    found = Detections.read(points, size=SIZE)
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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Detections.read(torch.tensor(EDGES)), "the image's size is needed"),
        (lambda: Detections.read(torch.ones(2, 3), size=SIZE), r"shape \(N, 4\) to \(N, 6\)"),
        (lambda: Detections.read(torch.tensor([[3.0, 2, 1, 4]]), size=SIZE), "has no area"),
        (lambda: Detections.read(torch.full((1, 4), torch.nan), size=SIZE), "not finite"),
        (lambda: Detections.read(3.0, size=SIZE), "float is not known"),
        (lambda: Detections.read({"labels": []}, size=SIZE), "has no boxes, only labels"),
        (lambda: Detections.read("{", size=SIZE), "not a line of JSON"),
        (lambda: Detections.read('{"boxes": [], "boxs": 1}', size=SIZE), "else only"),
        (lambda: Detections.read('{"boxes": [["a", 1, 2, 3]]}', size=SIZE), "not numbers"),
        (lambda: Detections.read('{"boxes": [[1, 2, 3, 4]], "scores": [1, 2]}', size=SIZE), "score"),
        (lambda: Detections.read('{"boxes": [], "time": "now"}', size=SIZE), "time must be seconds"),
        (lambda: Detections.read('{"boxes": [], "size": [3]}', size=SIZE), "size must be"),
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
