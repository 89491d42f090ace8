"""A user's detector: what its name must be, what it may return, and what is said in one line when it fails."""

from __future__ import annotations

import sys
import types
from typing import Any

import numpy as np
import pytest

from kcal.errors import InputError
from kcal.pipeline.detections import detect_in, load_detector

IMAGE = np.zeros((30, 50, 3), np.uint8)
BOX = [[1.0, 2.0, 5.0, 6.0]]


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    made = types.ModuleType("my_detector")
    inner = types.SimpleNamespace(call=lambda image: BOX)
    vars(made).update(plain=lambda image: BOX, inner=inner, number=3)
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
