"""A tracker's whole state as JSON, to the last bit, and back: an interrupted stream goes on as if it was not."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal.errors import FileError
from kcal.pipeline.imm_filter import Beliefs
from kcal.pipeline.track_options import TrackRecord
from kcal.pipeline.tracks import Tracker

# Of the tensors: a journal of another one is of no use.
_LAYOUT = "tracks last, of any cameras"
_SHARED = ("information", "score", "values", "root")


def settings_of(tracker: Tracker) -> str:
    """Hex digits that change with the rig, its errors and all options."""
    localize, shared = tracker.solved, tracker.shared
    parts = [
        _LAYOUT,
        localize.rig.fingerprint,
        repr(tracker.options),
        repr(shared.scale.tolist()),
    ]
    known = (localize.errors, localize.bending_errors)
    parts += ["none" if value is None else _packed(value)["data"] for value in known]
    parts += [] if tracker.moments is None else ["watched"]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def snapshot(tracker: Tracker) -> dict[str, Any]:
    """Everything that the next call depends on; a recorded history is left out."""
    return {
        "settings": settings_of(tracker),
        "time": tracker.time if math.isfinite(tracker.time) else None,
        "next": [tracker.next_number, tracker.next_key],
        "start": tracker.shared.start,
        "records": [dataclasses.asdict(record) for record in tracker.records],
        "beliefs": [_packed(value) for value in tracker.beliefs],
        "frame": _packed(tracker.frame),
        "home": tracker.home.tolist(),
        "shared": {name: _packed(getattr(tracker.shared, name)) for name in _SHARED},
    }


def restore(tracker: Tracker, state: dict[str, Any]) -> None:
    """Bring a new tracker to the state of a snapshot.

    Raises:
        FileError: it is of another rig or other options, or damaged.
    """
    if state.get("settings") != settings_of(tracker):
        raise FileError("the journal is of another rig or other options; delete it to begin anew, or restore them")
    try:
        tracker.time = -math.inf if state["time"] is None else float(state["time"])
        tracker.next_number, tracker.next_key = state["next"]
        tracker.shared.start = state["start"]
        tracker.records = [TrackRecord(**record) for record in state["records"]]
        tracker.beliefs = Beliefs(*(_unpacked(value) for value in state["beliefs"]))
        tracker.frame = _unpacked(state["frame"])
        tracker.home = torch.tensor(state["home"], dtype=torch.long)
        for name in _SHARED:
            setattr(tracker.shared, name, _unpacked(state["shared"][name]))
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(f"the journal is damaged ({error}); delete it to begin anew") from error


def _packed(value: Tensor) -> dict[str, Any]:
    array = np.ascontiguousarray(value.detach().cpu().numpy().astype("<f8"))
    return {"shape": list(array.shape), "data": base64.b64encode(array.tobytes()).decode()}


def _unpacked(value: dict[str, Any]) -> Tensor:
    array = np.frombuffer(base64.b64decode(value["data"]), dtype="<f8").reshape(value["shape"])
    return torch.from_numpy(array.astype(np.float64))
