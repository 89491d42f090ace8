"""What the page asks for, as plain values: state, shapes at clicks, matches, positions. Knows nothing of HTTP."""

from __future__ import annotations

import math
import threading
from typing import Any

import torch

from kcal.errors import InputError, KcalError
from kcal.lens.camera import Camera
from kcal.lens.rig import StereoRig
from kcal.locate.marks import Marks
from kcal.locate.positions import Located, Position
from kcal.locate.stereo import PositionStatus
from kcal.locate.survey import Survey, read_survey
from kcal.mark.guide import Proposal, RigBand, at_shape, propose
from kcal.mark.items import SIDES, Change, Item, Mark, MarkingState, Put, Side, Step, other_side
from kcal.mark.live import LiveRig, located, promised, solve_live
from kcal.mark.overview import map_content
from kcal.mark.pictures import Pictures, top_level
from kcal.mark.reference import Reference
from kcal.mark.session import Session, marks_of, pair_covariance
from kcal.mark.snap import snap

Json = dict[str, Any]


class Desk:
    """A session with its images and cameras; a thread solves the rig after every action.

    Args:
        pictures: the images.
        session: state and files.
        cameras: calibrated; None to mark without geometry.
        rig: relative pose as known so far; None until landmarks give one.
        reference: marks to be found again.

    Raises:
        InputError: images that do not have the cameras' sizes.
    """

    def __init__(
        self,
        pictures: Pictures,
        session: Session,
        cameras: tuple[Camera, Camera] | None = None,
        rig: StereoRig | None = None,
        reference: Reference | None = None,
    ) -> None:
        self.pictures, self.session, self.reference = pictures, session, reference
        self._cameras = (rig.left, rig.right) if cameras is None and rig is not None else cameras
        self._given = rig
        self._live = LiveRig(None, None, (), (), 0, session.hand_sigma, "")
        self._band: RigBand | None = None if rig is None else RigBand(rig)
        self._solved = -1
        self._history: list[Json] = []
        self._located: Located | None = None
        self._wake, self._end = threading.Event(), False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()
        self._wake.set()

    def check_sizes(self) -> None:
        """Raise `InputError` unless the first images have the cameras' sizes."""
        for side, camera in zip(SIDES, self._cameras or (), strict=False):
            height, width = self.pictures.image(side, 0).shape
            if (width, height) != camera.size:
                raise InputError(
                    f"the {side} image has {width}x{height} pixels, its camera {camera.size[0]}x{camera.size[1]}; is "
                    "it the right file?"
                )

    def close(self) -> None:
        """End the thread and release the files."""
        self._end = True
        self._wake.set()
        self._thread.join(timeout=5)
        self.session.close()

    @property
    def rig(self) -> StereoRig | None:
        """The rig in use: from landmarks if they give one, otherwise the given one."""
        return self._live.rig or self._given

    def act(self, action: Change | Step, key: str) -> Json:
        """Apply an action, and return the state; see `Session.do`.

        Raises:
            InputError: a mark outside the picture, besides.
        """
        if isinstance(action, Put):
            self._check_inside(action.side, action.mark)
        self.session.do(action, key)
        self._wake.set()
        return self.state()

    def _check_inside(self, side: Side, mark: Mark) -> None:
        height, width = self.pictures.image(side, self.pictures.number(mark.frame) or 0).shape
        if not (-0.5 <= mark.u <= width - 0.5 and -0.5 <= mark.v <= height - 0.5):
            raise InputError(
                f"{mark.u:.1f}, {mark.v:.1f} is outside the {side} picture, which has {width}x{height} pixels; nothing "
                "was marked"
            )

    def about(self) -> Json:
        """What does not change: frames, sizes, files."""
        pyramids = {side: self.pictures.pyramid(side, 0) for side in SIDES}
        files = self.session.files
        return {
            "frames": self.pictures.names,
            "images": {
                side: {"size": p.image.shape[::-1], "deep": p.image.dtype.itemsize > 1, "span": p.span,
                       "top": top_level(p.image.shape)}
                for side, p in pyramids.items()
            },
            "files": {name: str(getattr(files, name)) for name in ("marks", "points", "landmarks", "log")},
            "columns": self.session.columns,
            "cameras": self._cameras is not None,
            "hand_sigma": self.session.hand_sigma,
            "notes": self.session.notes,
            "reference": [] if self.reference is None else self.reference.marks.names,
        }  # fmt: skip

    def state(self) -> Json:
        """Things, marks, residuals, positions, and what the landmarks promise."""
        # The thread sets `_solved` last, so it is read first, and a change counts last, so its number is read last:
        # what is told not to be pending is solved with all marks that are told.
        solved = self._solved
        state, live = self.session.state, self._live
        version = self.session.version
        undo, redo = self.session.undoable
        residuals = {item.name: item for item in live.items}
        positions = {} if self._located is None else {p.name: p for p in self._located.positions}
        return {
            "version": version,
            "pending": solved < version,
            "trouble": self.session.trouble,
            "undo": undo,
            "redo": redo,
            "items": [
                {
                    "name": name,
                    "kind": item.kind,
                    "left": _mark(item.left),
                    "right": _mark(item.right),
                    "matched": item.cross,
                    "surveyed": name in state.survey,
                    "residual": None if name not in residuals else {
                        "pixels": residuals[name].pixels, "meters": residuals[name].meters,
                        "sigmas": _finite(residuals[name].sigmas), "used": residuals[name].used,
                        "reason": residuals[name].reason,
                    },
                    "position": None if name not in positions else position_text(positions[name], self._anchored),
                }
                for name, item in state.items.items()
            ],
            "survey": {name: place.model_dump() for name, place in state.survey.items()},
            "rig": {
                "text": live.text, "enough": live.enough, "solved": live.rig is not None, "known": self.rig is not None,
                "count": live.marked, "sigma": live.sigma, "warnings": live.warnings,
                "promises": [p._asdict() for p in live.promises], "history": self._history,
            },
        }  # fmt: skip

    @property
    def _anchored(self) -> bool:
        rig = self.rig
        local = self._live.rig is not None and self._live.origin is None
        return rig is not None and rig.mounting is not None and not local

    def snapped(self, side: Side, frame: int, u: float, v: float) -> Json:
        """The shape near a click, or why there is none."""
        try:
            found = snap(self.pictures.image(side, frame), u, v)
        except InputError as error:
            return {"refusal": str(error)}
        return {"refusal": "", "u": found.u, "v": found.v, "cov": found.cov, "how": found.how,
                "sigma": math.sqrt(max(found.cov[0], found.cov[2]))}  # fmt: skip

    def curve(self, side: Side, u: float, v: float) -> Json:
        """The epipolar curve of a pixel in the other image with its band of two sigmas, or why there is none."""
        if self._band is None:
            return {"refusal": "no relative pose yet: mark four landmarks, or give a rig"}
        try:
            found = self._band.curve(side, u, v)
        except InputError as error:
            return {"refusal": str(error)}
        return {"refusal": "", "pixels": found.pixels.tolist(), "band": (2 * found.sigma).tolist()}

    def proposal(self, side: Side, frame: int, u: float, v: float, how: str = "hand") -> Json:
        """The match of a pixel in the other image, at the shape that is there if the mark is at such a shape."""
        rig, band = self.rig, self._band
        if rig is None or band is None:
            return {"refusal": "no relative pose yet: mark four landmarks, or give a rig"}
        try:
            sigma = float(band.curve(side, u, v).sigma.max())
        except InputError as error:
            return {"refusal": str(error)}
        images = self.pictures.image("left", frame), self.pictures.image("right", frame)
        found = propose(rig, images, side, u, v, sigma)
        return _proposal(at_shape(found, images[SIDES.index(other_side(side))], how))

    def again(self, name: str, side: Side, frame: int, reach: int) -> Json:
        """Where a thing of the reference is now."""
        if self.reference is None:
            raise InputError("start with --reference and --reference-images to find points again")
        return _proposal(self.reference.find(name, side, self.pictures.image(side, frame), reach))

    def position(self, left: Mark, right: Mark, matched: Side | None) -> Json:
        """Where a pair of marks lies that is being dragged."""
        rig = self.rig
        if rig is None:
            return {"refusal": "no rig yet"}
        item = Item(kind="target", left=left, right=right, cross=matched)
        pixels = torch.tensor([[left.u, left.v], [right.u, right.v]], dtype=torch.float64)
        marks = Marks(("",), pixels[:1], pixels[1:], pair_covariance(item)[None])
        try:
            return position_text(located(rig, marks, self.session.hand_sigma).positions[0], self._anchored)
        except KcalError as error:
            return {"refusal": str(error)}

    def map(self) -> Json:
        """Cameras, landmarks and targets on the Earth, or in a frame of their own."""
        rig = self.rig
        if rig is None:
            return {"refusal": "no rig yet"}
        return map_content(rig, self._located, self._survey(), anchored=self._anchored)

    def _survey(self) -> Survey | None:
        return read_survey(self.session.files.landmarks) if self.session.state.survey else None

    def _work(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            if self._end:
                return
            version, state = self.session.version, self.session.state
            try:
                self._solve(state)
            except KcalError as error:
                self._live = self._live._replace(rig=None, text=f"no rig: {error}")
            self._solved = version

    def _solve(self, state: MarkingState) -> None:
        marks = marks_of(state, ("landmark",))
        if self._cameras is not None:
            live = solve_live(self._cameras, self._survey(), marks, self.session.hand_sigma)
            if live.rig is None and self._given is not None:
                live = live._replace(promises=promised(self._given, marks.typical_sigma(self.session.hand_sigma)))
            if live.rig is not None:
                entry = {"count": live.marked, "promises": [p._asdict() for p in live.promises]}
                self._history = [old for old in self._history if old["count"] < live.marked] + [entry]
            changed = live.rig is not self._live.rig
            self._live = live
            if changed:
                self._band = None if self.rig is None else RigBand(self.rig)
        targets = marks_of(state, ("target",), single=False)
        rig = self.rig
        self._located = located(rig, targets, self.session.hand_sigma) if rig is not None and targets.names else None


def position_text(position: Position, anchored: bool) -> Json:
    """A position with the range and its 95 % interval as text, and the numbers."""
    low, high, best = position.range_low_m, position.range_high_m, position.range_m
    if position.status == PositionStatus.OK and best is not None and low is not None and high is not None:
        text = f"{_range_words(best)} ({_range_words(low)} to {_range_words(high)})"
    elif low is not None:
        text = f"farther than {_range_words(low)}"
    else:
        text = position.reason or "no position"
    place = ""
    if anchored and position.lat is not None:
        place = f"{position.lat:.6f}°, {position.lon:.6f}°, {position.height:.1f} m"
    return {
        "refusal": "", "text": text, "place": place, "reason": position.reason, "range": best, "low": low,
        "high": None if high is None or math.isinf(high) else high, "reprojection": position.reprojection_px,
    }  # fmt: skip


def _range_words(value: float) -> str:
    if math.isinf(value):
        return "infinity"
    return f"{value:.1f} m" if value < 1000 else f"{value:.0f} m" if value < 10_000 else f"{value / 1000:.1f} km"


def _mark(mark: Mark | None) -> Json | None:
    return None if mark is None else {**mark.model_dump(), "sigma": mark.sigma}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _proposal(found: Proposal) -> Json:
    if found.refusal:
        return {"refusal": found.refusal, "score": _finite(found.score)}
    return {
        "refusal": "", "u": found.u, "v": found.v, "cov": found.cov, "how": found.how, "score": _finite(found.score),
        "off_line": _finite(found.off_line), "sigma": math.sqrt(max(found.cov[0], found.cov[2])),
    }  # fmt: skip
