"""Read the inputs of `kcal rig` and `kcal station` and express them in one coordinate frame."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from kcal.cli.console import err, steps, warn
from kcal.cli.inputs import typed_with
from kcal.cli.stars import NightOptions, read_stars
from kcal.errors import InputError
from kcal.files import check_picture
from kcal.texts import measured_text

if TYPE_CHECKING:
    from kcal.calibrate.rig.boards import Boards
    from kcal.calibrate.rig.features import Features
    from kcal.calibrate.rig.landmarks import Landmarks
    from kcal.calibrate.rig.measured import Baseline, MeasuredPosition
    from kcal.calibrate.rig.result import RigResult
    from kcal.calibrate.rig.skyline import SkylineSource
    from kcal.calibrate.rig.sources import RigData
    from kcal.corners.observations import Observations
    from kcal.lens.calibration import CalibrationRecord
    from kcal.lens.camera import Camera
    from kcal.lens.rig import Origin
    from kcal.locate.moving import MovingControl, MovingOptions
    from kcal.skyline.attitude import SkylineAttitude, SkylineImage
    from kcal.skyline.horizon import RasterError


# Drones, ships and aircraft that tell where they are, for `kcal rig --tracks`.


def read_moving(
    cameras: Sequence[Camera],
    names: Sequence[str],
    files: tuple[Path, Path],
    origin: Origin | None,
    positions: Sequence[MeasuredPosition],
    options: MovingOptions,
    *,
    placed: bool,
) -> tuple[MovingControl, Origin | None, list[str]]:
    """Landmarks from the tracks and sightings, the origin of the frame, and lines that say what was what.

    Args:
        cameras: of the rig.
        names: of these.
        files: tables of tracks and of sightings.
        origin: of the frame, as far as it is known.
        positions: of the cameras, as far as they were measured.
        options: what is known of clocks and marks.
        placed: whether landmarks or positions are there already, so that the frame is theirs.

    Raises:
        InputError: tables in another kind of frame; nothing to match.
    """
    from kcal.locate.moving import match_moving, read_sightings, read_tracks

    tracks, frame = read_tracks(files[0], origin)
    if placed and frame != origin:
        raise InputError(f"{files[0]}: it has latitudes, the landmarks or positions local meters; give an --origin")
    found = match_moving(tracks, read_sightings(files[1], names), cameras, names, positions, options)
    wrong = [one for one in found.identities if one.track != one.label]
    unknown = [one for one in wrong if one.track is None]
    lines = [
        f"tracks: {len(found.landmarks.names)} fixes of {len({one.track for one in found.identities} - {None})} things "
        f"in {len(found.identities) - len(unknown)} of {len(found.identities)} sightings"
    ]
    known = {track.name for track in tracks}
    lines += [
        f"{names[one.camera]}: {one.label} is {one.track}" + (", not what it is called" if one.label in known else "")
        for one in wrong
        if one.track is not None
    ]
    if unknown:
        listed = ", ".join(f"{one.label} ({names[one.camera]})" for one in unknown)
        lines.append(f"follow no track, or it is not clear which: {listed}")
    return found, frame, lines


def clock_line(result: RigResult, control: MovingControl, options: MovingOptions) -> list[str]:
    """How late the cameras' clocks turned out to be."""
    from kcal.locate.moving import CLOCK

    amount = result.effects().get(CLOCK)
    if amount is None:
        return []
    offset, sigma = control.clock + options.clock_sigma * amount[0], options.clock_sigma * amount[1]
    return [f"the tracks' clock is {measured_text(offset, sigma)} s ahead of the cameras'"]


# Pairs of images of the scene itself, for `kcal rig --scene`.


def read_scene(cameras: tuple[Camera, Camera], given: tuple[str, str], *, scaled: bool) -> tuple[Features, list[str]]:
    """Matches of all pairs of images, and lines that say what was matched and left out.

    Args:
        cameras: left and right.
        given: images of each: a file, a folder or a wildcard.
        scaled: whether anything else tells a length.

    Raises:
        InputError: nothing tells a length, or images without partners or with too little in common.
    """
    from kcal.calibrate.rig.pairs import pair_by_name
    from kcal.corners.images import expand_images, read_gray
    from kcal.scene.match import ImagePair, match_scene, scene_of

    if not scaled:
        raise InputError(
            "--scene alone leaves the scale open: with twice the baseline everything would be twice as far away, and "
            "the images the same. Add --baseline, --landmarks, --positions or boards (--pairs)"
        )
    files = [{path.name: path for path in expand_images([one])} for one in given]
    named = [list(own) for own in files]
    chosen = [(named[0][0], named[1][0])] if len(named[0]) == len(named[1]) == 1 else pair_by_name(*named)
    if not chosen:
        raise InputError(f"--scene: no image of {given[0]} belongs to one of {given[1]}; name pairs alike")
    pairs, found, refused = [], [], list[str]()
    with steps("matching the scene", len(chosen)) as advance:
        for left, right in chosen:
            pair = ImagePair(left, read_gray(files[0][left]), read_gray(files[1][right]))
            try:
                found.append(match_scene(cameras, pair))
                pairs.append(pair)
            except InputError as error:
                refused.append(str(error))
            advance(left)
    if not pairs:
        raise InputError(f"--scene: {refused[0]}")
    for text in refused:
        warn(f"{text}; left out")
    features, counts = scene_of(cameras, pairs, found)
    rows: list[tuple[str, ...]] = [("scene", "matched", "no texture", "off the line", "moved", "thinned", "used")]
    rows += [
        (one.name, *map(str, (one.matched, one.untextured, one.off_line, one.moved, one.thinned, one.used)))
        for one in counts
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
    alone = len(named[0]) + len(named[1]) - 2 * len(chosen)
    if alone:
        lines.append(f"{alone} images of the scene without partner")
    if len(pairs) == 1:
        lines.append("one pair: what moves cannot be told from what stands still; give pairs of several times")
    return features, lines


# A terrain raster and images of the skyline, for `kcal rig --skyline` and `kcal station --skyline`.

SKYLINE_HELP = (
    "Raster of terrain heights (GeoTIFF or .asc), with --skyline-images and --positions: the skyline tells how the "
    "cameras look on the Earth, heading included."
)
IMAGES_HELP = "Images of the skyline by a camera: file, folder or quoted wildcard; once for each camera."
SIGMA_HELP = "Of a height of the --skyline raster; 2 is a 30 m raster from satellites, 0.3 one from lidar."
PICTURE_HELP = "A .png or .svg file: the raster's skyline over each image, and what is left."


@dataclasses.dataclass(frozen=True, kw_only=True)
class SkylineOptions:
    """What the user gave of skylines, as on the command line.

    Args:
        raster: file of heights.
        images: of each camera, by its name; "" for the only one.
        geoid: meters added to the raster's heights.
        error: of these, and of refraction.
        picture: file to draw the fit to.
    """

    raster: Path
    images: Mapping[str, str]
    geoid: float
    error: RasterError
    picture: Path | None = None


def skyline_options(
    raster: Path | None, images: Sequence[str], scene: tuple[str, str] | None, geoid: float | None,
    sigma: float | None, refraction: tuple[float, float], picture: Path | None,
) -> SkylineOptions | None:  # fmt: skip
    """Check the options; without images of their own, those of `--scene` are taken.

    Raises:
        InputError: images without a raster or the other way round, or a camera twice.
    """
    from kcal.skyline.horizon import RasterError

    if raster is None:
        if images or picture is not None:
            raise InputError("--skyline-images and --skyline-picture need the raster of the terrain: --skyline DEM.tif")
        return None
    found: dict[str, str] = {}
    for text in images:
        name, equals, given = text.partition("=")
        if not equals:
            name, given = "", text
        if name in found:
            raise InputError(f"--skyline-images {text!r}: give NAME=IMAGES once for each camera")
        found[name] = given
    if not found and scene is not None:
        found = dict(zip(("left", "right"), scene, strict=True))
    if not found:
        raise InputError("--skyline needs images: --skyline-images IMAGES, or NAME=IMAGES once for each camera")
    if picture is not None:
        check_picture(picture)
    known = {} if sigma is None else {"sigma": sigma, "offset": 0.5 * sigma}
    error = RasterError(refraction=refraction[0], refraction_sigma=refraction[1], **known)
    return SkylineOptions(raster=raster, images=found, geoid=geoid or 0.0, error=error, picture=picture)


def read_skyline(
    cameras: Mapping[str, Camera], given: SkylineOptions, origin: Origin | None, positions: Sequence[MeasuredPosition]
) -> tuple[SkylineSource, list[str]]:
    """What the skylines tell, and lines that say what was found.

    Args:
        cameras: by their names, in order.
        given: what the user gave.
        origin: of the rig's frame.
        positions: measured ones, of all cameras with images.

    Raises:
        InputError: a camera without a place, and what `skyline_source` refuses.
    """
    import torch

    from kcal.locate.raster import terrain
    from kcal.skyline.attitude import skyline_source

    names = list(cameras)
    images = _read_images(names, given.images)
    places = {position.camera: position for position in positions}
    without = sorted({names[image.camera] for image in images if image.camera not in places})
    if origin is None or without:
        raise InputError(
            f"--skyline needs the place of {' and '.join(without) or 'each camera'} on the Earth: measure it (GNSS) "
            f"and give --position{'s' * (len(names) > 1)} with latitudes and longitudes (or with local meters and "
            "--origin)"
        )
    centers, sigma = torch.zeros(len(names), 3).double(), torch.ones(len(names), 3).double()
    for number, position in places.items():
        centers[number], sigma[number] = position.point, position.sigma
    with steps("comparing skylines with the terrain", None):
        raster = terrain(given.raster, given.geoid)
        source, found = skyline_source(
            images, list(cameras.values()), raster, origin, centers, sigma, error=given.error
        )
    if given.picture is not None:
        from kcal.report.figures import save_picture
        from kcal.report.rig import skyline_figure

        save_picture(given.picture, skyline_figure([(image.name, image.image) for image in images], found))
    lines = [line for image, one in zip(images, found, strict=True) for line in _lines(image, names, one)]
    for image, one in zip(images, found, strict=True):
        for text in one.warnings:
            warn(f"skyline {image.name}: {text}")
    return source, lines


def _read_images(names: Sequence[str], given: Mapping[str, str]) -> list[SkylineImage]:
    from kcal.corners.images import expand_images, read_gray
    from kcal.skyline.attitude import SkylineImage

    if "" in given and len(names) == 1:
        given = {names[0]: given[""]}
    unknown = [name for name in given if name not in names]
    if unknown:
        raise InputError(
            f"--skyline-images {unknown[0] or given[unknown[0]]}: write NAME=IMAGES; the cameras are {', '.join(names)}"
        )
    return [
        SkylineImage(name=f"{name} {path.name}", camera=names.index(name), image=read_gray(path))
        for name, text in given.items()
        for path in expand_images([text])
    ]


def _lines(image: SkylineImage, names: Sequence[str], found: SkylineAttitude) -> list[str]:
    heading, pitch, roll = found.sigma_deg.tolist()
    shares = ", ".join(f"{name} {100 * share[0]:.0f} %" for name, share in found.shares.items() if share[0] > 0.005)
    second = "" if math.isnan(found.second_deg) else (
        f"; next best heading {found.second_deg:.1f}° (χ² larger by {found.second_worse:.0f})"
    )  # fmt: skip
    return [
        f"skyline {image.name}: heading {found.heading_deg:.4f} ± {heading:.4f}°, pitch {found.pitch_deg:.4f} ± "
        f"{pitch:.4f}°, roll {found.roll_deg:.4f} ± {roll:.4f}° by this image alone; {int(found.used.sum())} of "
        f"{len(found.used)} columns{second}",
        f"  variance of its heading: {shares}",
    ]


# Refuse cameras and views that are in each other's place, or not of one another: by names and sizes in the files.

_Given = TypeVar("_Given")
_SIDE = re.compile(r"(?<![a-z])(left|right)(?![a-z])", re.IGNORECASE)


def check_sides(cameras: Sequence[Camera], paths: Sequence[Path]) -> None:
    """Refuse a left camera that is named right, and a right one that is named left.

    Raises:
        InputError: with the command in which they are exchanged.
    """
    names = [camera.calibration.name if camera.calibration else "" for camera in cameras]
    sides = [set(map(str.lower, _SIDE.findall(name))) for name in names]
    if sides == [{"right"}, {"left"}]:
        raise InputError(
            f"{paths[0]}: this camera is named {names[0]!r}, and {paths[1]} {names[1]!r}: left and right are "
            f"exchanged. Perhaps: {_exchanged(paths)}"
        )


def check_views_of(cameras: Sequence[Camera], seen: Sequence[Observations], paths: Sequence[Path]) -> None:
    """Refuse views of another size than their camera's, and those that the other camera was calibrated from.

    Raises:
        InputError: with the file, the camera and, where the files are exchanged, the right command.
    """
    for camera, views, path in zip(cameras, seen, paths, strict=True):
        if camera.size != views.image_size and len(cameras) == 1:
            raise InputError(_other_size(camera, views, path))
    if len(cameras) != 2:
        return
    sizes = [camera.size for camera in cameras]
    views_sizes = [views.image_size for views in seen]
    exchanged = sizes != views_sizes and sizes == views_sizes[::-1]
    if exchanged or _are_exchanged(cameras, paths, _by_file) or _are_exchanged(cameras, seen, _by_images):
        raise InputError(
            f"{paths[0]}: these are views of the right camera, and {paths[1]} has those of the left one: they are "
            f"exchanged. Perhaps: {_exchanged(paths)}"
        )
    for camera, views, path in zip(cameras, seen, paths, strict=True):
        if camera.size != views.image_size:
            raise InputError(_other_size(camera, views, path))


def _other_size(camera: Camera, views: Observations, path: Path) -> str:
    name = camera.calibration.name if camera.calibration else ""
    return (
        f"{path}: images of {views.image_size[0]}x{views.image_size[1]} px, but the camera {name or 'given'} has "
        f"{camera.size[0]}x{camera.size[1]} px: these are not its views. To calibrate from them: "
        f"kcal calibrate {path} -o {path.name.split('.')[0]}.camera.json"
    )


def _are_exchanged(
    cameras: Sequence[Camera], given: Sequence[_Given], of: Callable[[CalibrationRecord, _Given], bool]
) -> bool:
    """Whether each camera was calibrated from what the other was given, and neither from its own."""
    known = [camera.calibration.record if camera.calibration else None for camera in cameras]
    first, second = ([record is not None and of(record, one) for one in given] for record in known)
    return [first, second] == [[False, True], [True, False]]


def _by_file(record: CalibrationRecord, path: Path) -> bool:
    return record.observations == path.name


def _by_images(record: CalibrationRecord, views: Observations) -> bool:
    return set(record.per_view_rms) <= set(views.names)


def _exchanged(paths: Sequence[Path]) -> str:
    first, second = map(str, paths)
    return typed_with({first: second, second: first})


# Read the inputs of `kcal rig` and `kcal station` and express them in one coordinate frame.

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
    from kcal.calibrate.rig.measured import Baseline

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
    from kcal.lens.rig import Origin
    from kcal.locate.marks import read_marks
    from kcal.locate.survey import camera_positions, import_survey, match_landmarks, read_features

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
        marks = read_marks(sources.marks, sources.names, single=True, others=len(cameras) == 1)
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
        stars, positions, notes = read_stars(
            dict(zip(names, cameras, strict=True)), sources.stars, origin, positions, placed=landmarks is not None
        )
    skyline = None
    if sources.skyline is not None:
        skyline, more = read_skyline(dict(zip(names, cameras, strict=True)), sources.skyline, origin, positions)
        notes = [*notes, *more]
    features = None
    if sources.features is not None:
        features = read_features(sources.features, sources.mark_sigma, sources.names)
    if sources.scene is not None:
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
    from kcal.locate.moving import MovingOptions

    assert sources.tracks is not None
    names = CAMERAS if len(cameras) == 2 else sources.names
    options = MovingOptions(
        clock_sigma=sources.tracks_clock, between_sigma=sources.clock_sigma, pixel_sigma=sources.mark_sigma
    )
    placed = landmarks is not None or bool(positions)
    moving, origin, lines = read_moving(cameras, names, sources.tracks, origin, positions, options, placed=placed)
    both = moving.landmarks if landmarks is None else landmarks + moving.landmarks
    return both, origin, lines, lambda result: clock_line(result, moving, options)
