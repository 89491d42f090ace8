"""What the page asks for, as plain values: state, shapes at clicks, matches, positions. Knows nothing of HTTP."""

from __future__ import annotations

import math
import threading
from typing import Annotated, Any, NamedTuple

import pydantic
import torch
from torch import Tensor

from kcal.calibrate.rig.solve import RigOptions
from kcal.calibrate.rig.sources import RigData
from kcal.errors import InputError, KcalError
from kcal.lens.calibration import ItemResidual
from kcal.lens.camera import Camera
from kcal.lens.pose import enu_from_cam
from kcal.lens.rig import Origin, Rig
from kcal.locate.budget import range_sigmas
from kcal.locate.geodesy import enu_to_geodetic
from kcal.locate.localizer import Localizer
from kcal.locate.marks import Marks
from kcal.locate.mounting import placed_rig
from kcal.locate.points import locate_points
from kcal.locate.positions import Located, Position, near, region_rings
from kcal.locate.stereo import PositionStatus
from kcal.locate.survey import Survey, match_landmarks, read_survey, solve_surveyed
from kcal.mark.guide import Pictures, Proposal, Reference, RigBand, at_shape, propose, top_level
from kcal.mark.items import SIDES, Change, Coordinate, Item, Mark, MarkingState, Number, Put, Side, Step, other_side
from kcal.mark.session import Session, marks_of, pair_covariance
from kcal.mark.shapes import snap
from kcal.texts import range_text

# The rig from the landmarks marked so far, what ranges it promises, and which landmark contradicts the others.

LEAST_LANDMARKS = 4
NOWHERE = Origin(lat=0.0, lon=0.0, height=0.0)


class Promise(NamedTuple):
    """What a rig promises at a distance, meters.

    Attributes:
        distance: from the left camera.
        marks: sigma of the range from noise in the marks of one target.
        rig: sigma of the range from errors of lenses and relative pose; None if nothing is known of them.
        total: both.
    """

    distance: float
    marks: float
    rig: float | None
    total: float


class LiveRig(NamedTuple):
    """What the landmarks of one moment give.

    Attributes:
        rig: the rig; None without a solution.
        origin: of the survey's frame; None if that is local.
        items: how well each landmark agrees with the others.
        promises: at the usual ranges; of a baseline of 10 m, 250 m, 1 km and 5 km.
        marked: landmarks marked in both images.
        sigma: px, typical of marks that are made from near.
        text: what the operator should know, in one sentence.
        enough: whether more landmarks would still matter: errors of the rig are below those of marks at the farthest.
        warnings: of the solution.
    """

    rig: Rig | None
    origin: Origin | None
    items: tuple[ItemResidual, ...]
    promises: tuple[Promise, ...]
    marked: int
    sigma: float
    text: str
    enough: bool = False
    warnings: tuple[str, ...] = ()


def solve_live(cameras: tuple[Camera, Camera], survey: Survey | None, marks: Marks, hand_sigma: float) -> LiveRig:
    """Solve the rig from surveyed landmarks and their marks, as `kcal rig --landmarks --marks` does.

    Args:
        cameras: calibrated.
        survey: the surveyed places; None if there are none.
        marks: all marks of landmarks.
        hand_sigma: px, of marks without covariance.
    """
    both = torch.isfinite(marks.pixels).all(-1).all(-1)
    names = {name for name, seen in zip(marks.names, both.tolist(), strict=True) if seen}
    count = len(names & set(survey.names)) if survey is not None else 0
    sigmas = marks.sigmas(hand_sigma)
    sigma = near_sigma(marks, hand_sigma)
    nothing = LiveRig(None, None if survey is None else survey.origin, (), (), count, sigma, "")
    if survey is None or count < LEAST_LANDMARKS:
        missing = LEAST_LANDMARKS - count
        return nothing._replace(text=f"{missing} more landmark{'s' if missing > 1 else ''} in both images for a rig")
    try:
        landmarks = match_landmarks(survey, marks, sigmas).landmarks
        data = RigData(cameras=cameras, names=("left", "right"), landmarks=landmarks)
        result = solve_surveyed(data, survey.origin, RigOptions())
        rig = placed_rig(result, survey.origin or NOWHERE)
    except KcalError as error:
        return nothing._replace(text=f"no rig from these landmarks: {error}")
    items = tuple(item for item in result.items if item.source == "landmarks")
    promises = promised(rig, sigma)
    text, enough = verdict(promises, count)
    coarse = int((sigmas > 2 * hand_sigma).sum())
    if coarse and not enough:
        text += f"; {coarse} marks have a σ above {2 * hand_sigma:g} px: zoom in at each and press S"
    if result.exact:
        text += "; errors of the lenses are not in it"
    wrong = [item.name for item in items if not item.used]
    if wrong:
        enough = False
        text = f"{', '.join(wrong)} contradict{'s' if len(wrong) == 1 else ''} the other landmarks; {text}"
    return LiveRig(rig, survey.origin, items, promises, count, sigma, text, enough, result.warnings)


def near_sigma(marks: Marks, hand_sigma: float) -> float:
    """The typical sigma of marks that are made from near, px: none of them is worse than one by hand."""
    near = marks._replace(covariance=None, sigma=marks.sigmas(hand_sigma).clamp_max(hand_sigma))
    return near.typical_sigma(hand_sigma)


def promised(rig: Rig, sigma: float) -> tuple[Promise, ...]:
    """Predicted standard deviations of ranges; empty where the rig cannot see that way."""
    try:
        found = range_sigmas(rig, pixel_sigma=sigma)
    except KcalError:
        return ()
    parts = torch.hypot(found.lenses, found.pose).tolist()
    known = rig.covariance is not None
    rows = zip(found.distance.tolist(), found.marks.tolist(), parts, found.total.tolist(), strict=True)
    return tuple(Promise(distance, marks, part if known else None, total) for distance, marks, part, total in rows)


def verdict(promises: tuple[Promise, ...], count: int) -> tuple[str, bool]:
    """Whether landmarks suffice, in words, and about how many are missing.

    They do where errors of the rig are below those of the marks of a single target at the farthest range: better
    landmarks would then hardly change a range. The variance of the rig falls as one over the number of landmarks.

    Example:
        >>> verdict((Promise(5000.0, 150.0, 300.0, 335.0),), 8)
        ('not enough: at 5 km the rig errs by 300 m, marks by 150 m; about 24 more landmarks like these', False)
    """
    if not promises:
        return "the rig's ranges cannot be predicted: its cameras do not look the same way", False
    far = promises[-1]
    if far.rig is None:
        return "these landmarks do not determine the rig well enough to predict its ranges", False
    rig, marks = (f"{error:.0f} m" if error >= 10 else f"{error:.2g} m" for error in (far.rig, far.marks))
    share = f"at {range_text(far.distance)} the rig errs by {rig}, marks by {marks}"
    if far.rig <= far.marks:
        return f"enough: {share}", True
    more = math.ceil(count * ((far.rig / far.marks) ** 2 - 1))
    advice = f"about {more} more landmarks like these" if more <= 40 else "landmarks farther away or a better survey"
    return f"not enough: {share}; {advice}", False


def located(rig: Rig, marks: Marks, hand_sigma: float) -> Located:
    """Positions of targets; without a mounting, in a frame whose heading and place mean nothing."""
    rig = rig.placed(origin=NOWHERE, heading_deg=0.0) if rig.mounting is None else rig
    return locate_points(Localizer(rig, pixel_sigma=hand_sigma), marks)


# The map of a marking session: cameras, landmarks and targets with their 95 % regions, as latitudes and longitudes.


def map_content(rig: Rig, located: Located | None, survey: Survey | None, *, anchored: bool) -> dict[str, Any]:
    """What the page draws with Leaflet.

    Args:
        rig: in use; without a mounting it stands at latitude and longitude 0 and looks north.
        located: positions of the targets.
        survey: the landmarks.
        anchored: whether latitudes mean anything; otherwise the page shows meters only.
    """
    origin, turn = NOWHERE, enu_from_cam(0.0)
    if rig.mounting is not None:
        origin, turn = rig.mounting.origin, rig.mounting.enu_from_cam

    def places(enu: Tensor, around: Origin) -> list[tuple[float, float]]:
        return [(lat, near(lon, origin.lon)) for lat, lon, _ in enu_to_geodetic(enu, around).tolist()]

    right = -rig.right_from_left_rotation.T @ rig.right_from_left_translation
    centers = torch.stack([torch.zeros_like(right), right]) @ turn.T
    frame = NOWHERE if survey is None or survey.origin is None else survey.origin
    rings = iter([] if located is None else region_rings(located))
    targets = []
    for position in () if located is None else located.positions:
        if position.azimuth_deg is None:
            continue
        angle = math.radians(position.azimuth_deg)
        ends = [value or 0.0 for value in (position.range_low_m, position.range_high_m)]
        far = min(ends[1], 3 * (position.range_m or ends[0])) if math.isfinite(ends[1]) else 3 * max(ends[0], 100.0)
        line = torch.tensor([[math.sin(angle), math.cos(angle), 0.0]]).double() * torch.tensor([[ends[0]], [far]])
        spot = None if position.lat is None or position.lon is None else (position.lat, near(position.lon, origin.lon))
        targets.append({"name": position.name, "place": spot, "line": places(line, origin),
                        "ring": None if position.lat is None else next(rings)})  # fmt: skip
    # Landmarks in a frame of their own cannot be drawn with a rig that stands nowhere.
    drawn = survey is not None and rig.mounting is not None
    return {
        "refusal": "",
        "anchored": anchored,
        "cameras": [{"name": n, "place": p} for n, p in zip(("left", "right"), places(centers, origin), strict=True)],
        "landmarks": [
            {"name": name, "place": place}
            for name, place in zip(survey.names, places(survey.points, frame), strict=True)
        ] if survey is not None and drawn else [],
        "targets": targets,
    }  # fmt: skip


# What the page asks for, as plain values: state, shapes at clicks, matches, positions. Knows nothing of HTTP.

Json = dict[str, Any]
How = Annotated[str, pydantic.Field(max_length=20)]
Reach = Annotated[int, pydantic.Field(ge=5, le=200)]


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
        rig: Rig | None = None,
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
    def rig(self) -> Rig | None:
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
        return {
            "frames": self.pictures.names,
            "images": {
                side: {"size": p.image.shape[::-1], "deep": p.image.dtype.itemsize > 1, "span": p.span,
                       "top": top_level(p.image.shape)}
                for side, p in pyramids.items()
            },
            "files": {name: str(path) for name, path in self.session.files._asdict().items()},
            "columns": self.session.columns,
            "cameras": self._cameras is not None,
            "hand_sigma": self.session.hand_sigma,
            "notes": self.session.notes,
            "reference": [] if self.reference is None else self.reference.marks.names,
        }  # fmt: skip

    def state(self) -> Json:
        """Items, marks, residuals, positions, and what the landmarks promise."""
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

    def snapped(self, side: Side, frame: Number, u: Coordinate, v: Coordinate) -> Json:
        """The shape near a click, or why there is none."""
        try:
            found = snap(self.pictures.image(side, frame), u, v)
        except InputError as error:
            return {"refusal": str(error)}
        return _proposal(Proposal("", *found[:3], how=found.how))

    def curve(self, side: Side, u: float, v: float) -> Json:
        """The epipolar curve of a pixel in the other image with its band of two sigmas, or why there is none."""
        if self._band is None:
            return {"refusal": self._no_rig(), "solved": False}
        try:
            found = self._band.curve(side, u, v)
        except InputError as error:
            return {"refusal": str(error)}
        return {"refusal": "", "pixels": found.pixels.tolist(), "band": (2 * found.sigma).tolist()}

    def proposal(self, side: Side, frame: Number, u: Coordinate, v: Coordinate, how: How = "hand") -> Json:
        """The match of a pixel in the other image, at the shape that is there if the mark is at such a shape."""
        rig, band = self.rig, self._band
        if rig is None or band is None:
            return {"refusal": self._no_rig(), "solved": False}
        try:
            sigma = float(band.curve(side, u, v).sigma.max())
        except InputError as error:
            return {"refusal": str(error)}
        images = self.pictures.image("left", frame), self.pictures.image("right", frame)
        found = propose(rig, images, side, u, v, sigma)
        return _proposal(at_shape(found, images[SIDES.index(other_side(side))], how))

    def _no_rig(self) -> str:
        if self._cameras is None:
            return "no cameras were given, so nothing tells where this is in the other image; start with --cameras"
        solving = self._solved < self.session.version
        return "no relative pose yet: " + ("the rig is being solved" if solving else self._live.text)

    def again(self, name: str, side: Side, frame: Number, reach: Reach = 40) -> Json:
        """Where an item of the reference is now."""
        if self.reference is None:
            raise InputError("start with --reference and --reference-images to find points again")
        return _proposal(self.reference.find(name, side, self.pictures.image(side, frame), reach))

    def position(self, left: Mark, right: Mark, matched: Side | None = None) -> Json:
        """Where a pair of marks lies that is being dragged."""
        rig = self.rig
        if rig is None:
            return {"refusal": "no rig yet"}
        item = Item(kind="target", left=left, right=right, cross=matched)
        pixels = torch.tensor([[left.u, left.v], [right.u, right.v]], dtype=torch.float64)
        marks = Marks(("",), pixels[None], pair_covariance(item)[None])
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
                live = live._replace(promises=promised(self._given, near_sigma(marks, self.session.hand_sigma)))
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
