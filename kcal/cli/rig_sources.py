"""Read the inputs of `kcal rig` and `kcal station` and express them in one coordinate frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from kcal.errors import InputError

if TYPE_CHECKING:
    from kcal.calibrate.rig.result import RigResult
    from kcal.calibrate.rig.sources import Baseline, Boards, Landmarks, MeasuredPosition, RigData
    from kcal.cli.rig_skyline import SkylineOptions
    from kcal.cli.rig_stars import NightOptions
    from kcal.lens.camera import Camera
    from kcal.lens.mounting import Origin

CAMERAS = ("left", "right")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sources:
    """What the user gave, as on the command line."""

    pairs: tuple[Path, Path] | None = None
    match: Path | None = None
    landmarks: Path | None = None
    marks: Path | None = None
    features: Path | None = None
    positions: Path | None = None
    baseline: str | None = None
    origin: str | None = None
    mark_sigma: float = 0.3
    survey_sigma: float | None = None
    geoid: float | None = None
    stars: NightOptions | None = None
    scene: tuple[str, str] | None = None
    skyline: SkylineOptions | None = None
    observations: tuple[Path, ...] = ()
    tracks: tuple[Path, Path] | None = None
    tracks_clock: float = 2.0
    clock_sigma: float = 0.1
    names: tuple[str, ...] = CAMERAS

    @property
    def files(self) -> list[Path]:
        """All files that are read."""
        raster = None if self.skyline is None else self.skyline.raster
        single = (self.match, self.landmarks, self.marks, self.features, self.positions, raster)
        more = (*(self.pairs or ()), *(self.tracks or ()), *self.observations)
        return [*more, *(path for path in single if path is not None)]


def _nothing(_: RigResult) -> list[str]:
    return []


class RigInput(NamedTuple):
    """What was read.

    Attributes:
        data: everything in one frame.
        origin: of the frame; None where no latitude is known.
        unpaired: how many views of the boards have no partner.
        notes: what else there is to say of the sources.
        pixel_sigma: px, the typical noise of marks along an axis, where the file of the marks states it.
        told: what there is to say of the sources once the rig is solved.
    """

    data: RigData
    origin: Origin | None
    unpaired: int
    notes: tuple[str, ...] = ()
    pixel_sigma: float | None = None
    told: Callable[[RigResult], list[str]] = _nothing


def parse_baselines(text: str, names: Sequence[str] = CAMERAS) -> tuple[Baseline, ...]:
    """`"10.02±0.005"`, meters, of two cameras; of more `"mill:mast=812.40±0.02"`, several with commas.

    Raises:
        InputError: something else, or a camera that is not there.
    """
    from kcal.calibrate.rig.sources import Baseline

    found = []
    for part in text.split(","):
        pair, equals, measured = part.strip().rpartition("=")
        lengths = measured.replace("+-", "±").split("±")
        try:
            length, sigma = (float(value) for value in lengths)
        except ValueError:
            example = "10.02±0.005" if len(names) == 2 else f"{names[0]}:{names[1]}=10.02±0.005"
            raise InputError(f"baseline {part!r}: write LENGTH±SIGMA in meters, for example {example}") from None
        ends = pair.strip().split(":") if equals else list(names)
        if len(ends) != 2 or not set(ends) <= set(names):
            raise InputError(
                f"baseline {part!r}: of {len(names)} cameras write FIRST:SECOND=LENGTH±SIGMA, the names being "
                f"{', '.join(names)}"
            )
        found.append(Baseline(first=names.index(ends[0]), second=names.index(ends[1]), length=length, sigma=sigma))
    return tuple(found)


def read_sources(cameras: Sequence[Camera], sources: Sources) -> RigInput:
    """Read everything; warnings about it are printed. Two cameras are left and right, one or more have their names."""
    from kcal.calibrate.rig.sources import RigData
    from kcal.cli.console import err
    from kcal.lens.mounting import Origin
    from kcal.locate.marks import read_marks
    from kcal.locate.survey import camera_positions, match_landmarks, read_features
    from kcal.locate.survey_files import import_survey
    from kcal.locate.view_marks import is_long, match_views, read_feature_views, read_views

    if (sources.landmarks is None) != (sources.marks is None):
        raise InputError("--landmarks and --marks belong together: places by name, and where they are in the images")
    pair = len(cameras) == 2
    if pair and cameras[0].fingerprint == cameras[1].fingerprint:
        raise InputError(
            "both files contain one camera: this is the same camera twice; give two. To calibrate both: "
            "kcal calibrate left.obs.json right.obs.json -o cameras"
        )
    names = CAMERAS if pair else sources.names
    origin = None if sources.origin is None else Origin.parse(sources.origin)
    landmarks, pixel_sigma = None, None
    positions: tuple[MeasuredPosition, ...] = ()
    if sources.positions is not None:
        placed = import_survey(sources.positions, origin, sigma=sources.survey_sigma, geoid=sources.geoid)
        origin, positions = placed.origin, camera_positions(placed, names)
    if sources.landmarks is not None and sources.marks is not None:
        survey = import_survey(sources.landmarks, origin, sigma=sources.survey_sigma, geoid=sources.geoid)
        if sources.positions is not None and survey.origin != origin:
            raise InputError("landmarks and positions: one has latitudes, the other local meters; give an --origin")
        origin = survey.origin
        if not pair or is_long(sources.marks):
            views = read_views(sources.marks, sources.names, others=len(cameras) == 1)
            found = match_views(survey, views, sources.mark_sigma)
        else:
            marks = read_marks(sources.marks, single=True)
            found = match_landmarks(survey, marks, marks.sigmas(sources.mark_sigma))
            if marks.covariance is not None:
                pixel_sigma = marks.typical_sigma(sources.mark_sigma)
        landmarks = found.landmarks
        for some, text in ((found.unmarked, "surveyed, but not marked"), (found.unsurveyed, "marked, not surveyed")):
            if some:
                err.print(f"[yellow]warning:[/] {text}:", ", ".join(some), markup=True)
    boards, unpaired = _read_boards(cameras, sources)
    stars, notes = None, list[str]()
    if sources.stars is not None:
        from kcal.cli.rig_stars import read_stars

        stars, positions, notes = read_stars(
            dict(zip(names, cameras, strict=True)), sources.stars, origin, positions, placed=landmarks is not None
        )
    skyline = None
    if sources.skyline is not None:
        from kcal.cli.rig_skyline import read_skyline

        skyline, more = read_skyline(dict(zip(names, cameras, strict=True)), sources.skyline, origin, positions)
        notes = [*notes, *more]
    features = None
    if sources.features is not None and (not pair or is_long(sources.features)):
        features = read_feature_views(sources.features, sources.names, sources.mark_sigma)
    elif sources.features is not None:
        features = read_features(sources.features, sources.mark_sigma)
    if sources.scene is not None:
        from kcal.cli.rig_scene import read_scene

        # One position alone tells no length; GNSS of both does.
        scaled = any((boards, landmarks, sources.baseline, len(positions) > 1))
        seen_by_both, more = read_scene((cameras[0], cameras[1]), sources.scene, scaled=scaled)
        features = seen_by_both if features is None else features + seen_by_both
        notes = [*notes, *more]
    told: Callable[[RigResult], list[str]] = _nothing
    if sources.tracks is not None:
        landmarks, origin, more, told = _with_tracks(cameras, sources, origin, positions, landmarks)
        notes = [*notes, *more]
    data = RigData(
        cameras=tuple(cameras),
        names=names,
        boards=boards,
        landmarks=landmarks,
        features=features,
        baselines=() if sources.baseline is None else parse_baselines(sources.baseline, names),
        positions=positions,
        stars=stars,
        skyline=skyline,
    )
    return RigInput(data, origin, unpaired, tuple(notes), pixel_sigma, told)


def _read_boards(cameras: Sequence[Camera], sources: Sources) -> tuple[Boards | None, int]:
    """Boards seen by two cameras or more, and how many views of a pair of cameras have no partner."""
    from kcal.calibrate.rig.pairs import boards_of_several, pair_by_name, paired_boards, read_pairs
    from kcal.cli.sides import check_views_of
    from kcal.corners.observations import Observations

    if sources.pairs is not None:
        first, second = cameras
        seen = Observations.load(sources.pairs[0]), Observations.load(sources.pairs[1])
        check_views_of((first, second), seen, sources.pairs)
        views = seen[0].names, seen[1].names
        matched = pair_by_name(*views) if sources.match is None else read_pairs(sources.match, *views)
        boards = paired_boards((first, second), seen, matched)
        return boards, len(views[0]) + len(views[1]) - 2 * len(matched)
    if not sources.observations:
        return None, 0
    own = dict(zip(cameras_of_files(sources.observations, sources.names), sources.observations, strict=True))
    return boards_of_several(cameras, sources.names, {number: Observations.load(own[number]) for number in own}), 0


def cameras_of_files(paths: Sequence[Path], names: Sequence[str]) -> list[int]:
    """Numbers of the cameras that files are named after, up to the first dot.

    Raises:
        InputError: a file of no camera, or two of one.
    """
    found: list[int] = []
    for path in paths:
        name = path.name.split(".")[0]
        if name not in names:
            raise InputError(f"{path}: no camera is named {name!r}; they are {', '.join(names)}")
        if names.index(name) in found:
            raise InputError(f"{path}: a second file of camera {name!r}; give one for each")
        found.append(names.index(name))
    return found


def _with_tracks(
    cameras: Sequence[Camera],
    sources: Sources,
    origin: Origin | None,
    positions: tuple[MeasuredPosition, ...],
    landmarks: Landmarks | None,
) -> tuple[Landmarks, Origin | None, list[str], Callable[[RigResult], list[str]]]:
    """Landmarks with those that move, the origin, what to say of them, and what to say once the rig is solved."""
    from kcal.cli.rig_moving import clock_line, read_moving
    from kcal.locate.moving_match import MovingOptions

    assert sources.tracks is not None
    names = CAMERAS if len(cameras) == 2 else sources.names
    options = MovingOptions(
        clock_sigma=sources.tracks_clock, between_sigma=sources.clock_sigma, pixel_sigma=sources.mark_sigma
    )
    placed = landmarks is not None or bool(positions)
    moving, origin, lines = read_moving(cameras, names, sources.tracks, origin, positions, options, placed=placed)
    both = moving.landmarks if landmarks is None else landmarks + moving.landmarks
    return both, origin, lines, lambda result: clock_line(result, moving, options)
