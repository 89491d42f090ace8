"""Read the inputs of `kcal rig` and `kcal station` and express them in one coordinate frame."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import (
    aligned,
    draw_picture,
    ending_with,
    followed,
    look_at_views,
    mark_again,
    steps,
    warn,
    with_command,
)
from kcal.cli.inputs import pixel_sigma_and_source, typed_with
from kcal.cli.options import Kind, Rare, Several
from kcal.cli.stars import Night
from kcal.errors import ContradictionError, DegenerateError, InputError, KcalError
from kcal.texts import counted_text, measured_text
from kcal.values import WithSigma, named, with_sigma

# What `kcal rig` and `kcal station` solve from, as options.

_REFRACTION_SIGMA = 0.1
_REFRACTION = WithSigma(0.13, _REFRACTION_SIGMA)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sources:
    """What a rig is solved from.

    Args:
        pairs: Observations of boards seen by both, LEFT RIGHT; of three cameras and more one file for each camera,
            named as it is.
        match: Which views belong together: columns left,right. By name if not given.
        landmarks: Surveyed places: CSV (name,lat,lon,height,sigma or name,east,north,up,sigma), GeoJSON, GPX.
        marks: Where they are in the images: name,left_u,left_v,right_u,right_v, or one line for each camera:
            name,camera,u,v.
        features: Distant points matched between the images: left_u,left_v,right_u,right_v and range,range_sigma or
            beyond (meters), if known.
        positions: Measured camera positions (GNSS): as --landmarks, names left and right, or of files.
        baseline: Measured distance between the cameras, e.g. 10.02±0.005; of three and more mill:mast=812.4±0.1,...
        site: Origin of the local frame, where the first camera stands; the first surveyed place if not given.
        survey_sigma: How well places of GeoJSON and GPX files are known, where these do not say.
        geoid: Height of the geoid above the WGS84 ellipsoid, added to elevations of GPX and to heights of --terrain.
        stars: Night images of each camera, LEFT RIGHT (folder or quoted wildcard), paired by their times: they
            determine how the cameras are turned, yaw included; with --site and --time also on the Earth. Of three
            cameras and more NAME=IMAGES of some.
        scene: Images of the scene by each camera at the same moments, LEFT RIGHT (file, folder or quoted wildcard):
            features seen by both determine how the cameras are turned; a length must come from elsewhere (--baseline).
        skyline: Images of the skyline by each camera, in their order or as NAME=IMAGES; with --terrain and --positions
            they tell how the cameras look on the Earth, heading included. Those of --scene if not given.
        terrain: Raster of terrain heights for --skyline (GeoTIFF or .asc).
        terrain_sigma: Standard deviation of its heights; 2 is a 30 m raster from satellites, 0.3 one from lidar.
        skyline_picture: the raster's skyline over each image, and the residuals.
        tracks: Where drones, ships or aircraft were (name,time,lat,lon,height,sigma), and what the cameras followed
            (name,camera,time,u,v): landmarks that move.
        tracks_clock: Of the cameras' clocks against that of --tracks; found within three of it.
        clock_sigma: Standard deviation of the offset between the cameras' clocks: 1 s is 2.3 % of a range of 5 km.
        clock_drift: Of the rate at which it changes, seconds an hour; 0 where GPS or a network keeps the clocks.
        temperature: Of the air at night, for stars.
        pressure: There, for stars.
        dut1: UT1 - UTC at night, if known.
        refraction: Refraction of light from landmarks and terrain, and its standard deviation, beforehand; 0±0 for
            straight lines.
    """

    pairs: Several[kinds.Observed] | None = None
    match: Rare[Annotated[kinds.Table, Kind(of="pairs")] | None] = None
    landmarks: kinds.Survey | None = None
    marks: kinds.Marks | None = None
    features: Rare[kinds.Marks | None] = None
    positions: kinds.Survey | None = None
    baseline: Annotated[str, Kind(metavar="M±SIGMA")] | None = None
    site: Rare[kinds.Place | None] = None
    survey_sigma: Rare[kinds.Meters | None] = None
    geoid: Rare[kinds.Meters | None] = None
    stars: Annotated[Several[str], Kind(metavar="LEFT RIGHT")] | None = None
    scene: Annotated[Several[str], Kind(metavar="LEFT RIGHT")] | None = None
    skyline: Rare[Annotated[Several[str], Kind(metavar="IMAGES")] | None] = None
    terrain: Rare[kinds.Raster | None] = None
    terrain_sigma: Rare[Annotated[kinds.Sigma, Kind(of="terrain")] | None] = None
    skyline_picture: Rare[kinds.Picture | None] = None
    tracks: Rare[Annotated[tuple[kinds.Table, kinds.Table], Kind(metavar="TRACKS.csv SIGHTINGS.csv")] | None] = None
    tracks_clock: Rare[Annotated[kinds.Seconds, Kind(of="tracks")]] = 2.0
    time: Rare[Annotated[kinds.Times, Kind(of="stars")] | None] = None
    clock_sigma: Rare[kinds.Seconds] = 0.1
    clock_drift: Rare[Annotated[kinds.Seconds, Kind(of="stars")]] = 0.05
    temperature: Rare[Annotated[kinds.Celsius, Kind(of="stars")] | None] = None
    pressure: Rare[Annotated[kinds.Hectopascal, Kind(of="stars")] | None] = None
    dut1: Rare[Annotated[kinds.Clock, Kind(of="stars")] | None] = None
    refraction: Rare[kinds.MeasuredRefraction] = _REFRACTION
    pixel_sigma: kinds.PixelSigma | None = None

    @property
    def marks_sigma(self) -> float:
        """Noise of marks, px: as given, or assumed."""
        return pixel_sigma_and_source(self.pixel_sigma)[0]

    @property
    def refraction_sigma(self) -> float:
        """Of the refraction, as given, or as it is by day over land."""
        return _REFRACTION_SIGMA if self.refraction.sigma is None else self.refraction.sigma

    @property
    def given(self) -> bool:
        """Whether there is anything to solve a rig from."""
        return any(getattr(self, name) for name in ("marks", *READERS))


# Drones, ships and aircraft that tell where they are, for `kcal rig --tracks`.


def _add_tracks(read: RigReading, files: tuple[Path, Path]) -> None:
    """Landmarks from tables of tracks and of sightings; once the rig is solved, how late the cameras' clocks are.

    Raises:
        InputError: tables in another kind of frame; nothing to match.
    """
    given, names = read.given, list(read.cameras)
    tracks, frame = kcal.rig.read_tracks(files[0], read.origin)
    if (read.positions or read.placed) and frame != read.origin:
        raise InputError(f"{files[0]}: it has latitudes, the landmarks or positions local meters; give a --site")
    options = kcal.rig.MovingOptions(
        clock_sigma=given.tracks_clock, between_sigma=given.clock_sigma, pixel_sigma=given.marks_sigma
    )
    sightings = kcal.rig.read_sightings(files[1], names)
    found = kcal.rig.match_moving(tracks, sightings, list(read.cameras.values()), names, read.positions, options)
    wrong = [one for one in found.identities if one.track != one.label]
    unknown = [one for one in wrong if one.track is None]
    read.notes.append(
        f"tracks: {len(found.landmarks.names)} fixes of {len({one.track for one in found.identities} - {None})} "
        f"targets in {len(found.identities) - len(unknown)} of {len(found.identities)} sightings"
    )
    known = {track.name for track in tracks}
    read.notes += [
        f"{names[one.camera]}: {one.label} is {one.track}" + (", not what it is called" if one.label in known else "")
        for one in wrong
        if one.track is not None
    ]
    if unknown:
        listed = ", ".join(f"{one.label} ({names[one.camera]})" for one in unknown)
        read.notes.append(f"follow no track, or it is not clear which: {listed}")

    def clock(result: rooms.RigResult) -> list[str]:
        if rooms.CLOCK not in (amounts := result.effects()):
            return []
        offset, sigma = (options.clock_sigma * value for value in amounts[rooms.CLOCK])
        return [f"the tracks' clock is {measured_text(found.clock + offset, sigma)} s ahead of the cameras'"]

    read.origin = frame
    read.add("landmarks", found.landmarks)
    read.tellers.append(clock)


# Pairs of images of the scene itself, for `kcal rig --scene`.


def _add_scene(read: RigReading, words: Sequence[str]) -> None:
    """Matches of all pairs of images, and what was matched and left out.

    Raises:
        InputError: nothing tells a length, or images without partners or with too little in common.
    """
    first, second = read.cameras.values()
    # One position alone tells no length; GNSS of both does.
    if not any((*map(read.sources.get, ("boards", "landmarks")), read.given.baseline, len(read.positions) > 1)):
        raise InputError(
            "--scene alone leaves the scale open: with twice the baseline everything would be twice as far away, and "
            "the images the same. Add --baseline, --landmarks, --positions or boards (--pairs)"
        )
    given = [*images_by_camera("--scene", words, list(read.cameras)).values()]
    chosen = rooms.image_pairs(*given)
    pairs, found, refused = [], [], list[str]()
    for left, right in followed("matching the scene", chosen, lambda pair: pair[0].name):
        pair = kcal.rig.ImagePair(left.name, rooms.read_gray(left), rooms.read_gray(right))
        try:
            found.append(rooms.match_scene((first, second), pair))
            pairs.append(pair)
        except InputError as error:
            refused.append(str(error))
    if not pairs:
        raise InputError(f"--scene: {refused[0]}")
    warn(*(f"{text}; left out" for text in refused))
    features, counts = rooms.scene_of((first, second), pairs, found)
    rows: list[tuple[str, ...]] = [("scene", "matched", "no texture", "off the line", "moved", "thinned", "used")]
    rows += [tuple(map(str, dataclasses.astuple(one))) for one in counts]
    read.notes += aligned(rows)
    if alone := sum(len(rooms.expand_images(one)) for one in given) - 2 * len(chosen):
        read.notes.append(f"{counted_text(alone, 'image')} of the scene without partner")
    if len(pairs) == 1:
        read.notes.append("one pair: what moves cannot be told from what stands still; give pairs of several times")
    read.add("features", features)


# Night images of the cameras of a rig, for `kcal rig --stars`.

# m: how well the place of `--site` is known to be that of the first camera, along each axis, if not stated.
_PLACE_SIGMA = 3.0


def _add_stars(read: RigReading, words: Sequence[str]) -> None:
    """The stars of all images, the position of the first camera, and lines that say what was found.

    Raises:
        InputError: no images of one moment.
    """
    night, cameras, positions = read.given, read.cameras, read.positions
    given = images_by_camera("--stars", words, tuple(cameras))
    images = [_named_images(name, given[name], read) if name in given else [] for name in cameras]
    moments, alone = rooms.moments_of(images)
    on_earth = all(image.on_earth for own in images for image in own)
    if not any(len(moment) > 1 for moment in moments) and not (on_earth and len(cameras) > 2):
        first, *_, last = cameras
        raise InputError(
            f"--stars: no image of the {first} camera was taken at the time of one of the {last}; "
            "pairs are of one moment"
        )
    if on_earth and not read.placed and not positions:
        there = rooms.torch.zeros(3, dtype=rooms.torch.float64)
        known = night.site.sigma if night.site and night.site.sigma is not None else _PLACE_SIGMA
        positions = (kcal.MeasuredPosition(camera=0, point=there, sigma=rooms.torch.full_like(there, known)),)
    frame = read.origin if read.placed or positions else None
    source = kcal.stars.star_source(
        moments, list(cameras.values()), clock_sigma=night.clock_sigma, drift_sigma=night.clock_drift, origin=frame
    )
    named = int(source.named.sum())
    read.sources |= {"stars": source, "positions": positions}
    read.notes += [
        f"stars: {counted_text(len(moments), 'moment')}, {len(source.names)} stars, {named} with a known direction"
        + (f"; {counted_text(alone, 'image')} without partner" if alone else ""),
        f"clocks of the cameras against each other: ± {night.clock_sigma:g} s, which no residual shows: up to "
        f"{math.degrees(7.292e-5 * night.clock_sigma):.5f}° of relative attitude, and part of every σ below",
    ]
    if any(effect.factor is not None for effect in source.effects):
        read.notes.append(
            f"their drift: ± {night.clock_drift:g} s an hour since the night's first images (--clock-drift 0 where GPS "
            "or a network keeps them)"
        )
    if on_earth and night.dut1 is None:
        read.notes.append("UT1 - UTC is not known (--dut1): 8″ of heading, part of its σ")


def images_by_camera(option: str, words: Sequence[str], names: Sequence[str]) -> dict[str, list[str]]:
    """Which images are whose: one place for each camera, in their order; NAME=IMAGES; or files in a folder of each.

    Args:
        option: what the images were given with.
        words: files, folders and wildcards, or such with a name before them.
        names: of the cameras.

    Raises:
        InputError: another number of places than of cameras, or a name that no camera has.

    Example:
        >>> images_by_camera("--stars", ["l/1.png", "l/2.png", "r/1.png"], ("left", "right"))
        {'left': ['l/1.png', 'l/2.png'], 'right': ['r/1.png']}
    """
    found: dict[str, list[str]] = {}
    if words and all("=" in word and not Path(word).exists() for word in words):
        for word in words:
            name, images = named(word, option, "NAME=IMAGES for each camera")
            if name not in names:
                raise InputError(f"{option} {word}: write NAME=IMAGES; the cameras are {', '.join(names)}")
            found.setdefault(name, []).append(images)
        return found
    folders = list(dict.fromkeys(Path(word).parent for word in words))
    if len(names) == 1:
        return {names[0]: list(words)}
    if len(words) == len(names):
        return {name: [word] for name, word in zip(names, words, strict=True)}
    if len(folders) == len(names):
        return {name: [word for word in words if Path(word).parent == own]
                for name, own in zip(names, folders, strict=True)}  # fmt: skip
    places = " ".join(name.upper() for name in names)
    raise InputError(f"{option}: give a folder or a quoted wildcard for each camera, {places}; or NAME=IMAGES for each")


def _named_images(side: str, given: list[str], read: RigReading) -> list[rooms.NamedStars]:
    files, night = rooms.expand_nights(given), read.given
    found: list[rooms.NamedStars] = []
    taken = Night(
        time=night.time, dut1=night.dut1, temperature=night.temperature, pressure=night.pressure,
        # A place without a time tells nothing.
        site=None if night.time is None else read.origin,
    )  # fmt: skip
    for path in followed(f"naming stars of {side}", files, lambda path: path.name):
        view = taken.view(path)
        try:
            image = kcal.stars.name_stars(rooms.read_night(path), read.cameras[side], view)
        except KcalError as error:
            warn(f"{side} {path.name}: {error}; left out")
        else:
            warn(*(f"{side} {path.name}: {text}" for text in image.warnings))
            found.append(image)
    warn(*(f"{side}, image {number + 1} with names: {text}" for number, text in rooms.clock_doubts(found)))
    if not found:
        raise InputError(f"--stars: in none of the {len(files)} images of {side} stars have names")
    return found


# A terrain raster and images of the skyline, for `kcal rig --skyline` and `kcal station --skyline`.


def _add_skyline(read: RigReading, raster: Path) -> None:
    """What the skylines tell, and what was found in each image; without images of their own, those of the scene.

    Raises:
        InputError: no images, a camera without a place, and what `skyline_source` refuses.
    """
    given, names = read.given, list(read.cameras)
    words = given.skyline or given.scene
    if not words:
        raise InputError("--terrain needs images of the skyline: --skyline IMAGES, or NAME=IMAGES for each camera")
    images = [
        kcal.rig.SkylineImage(name=f"{name} {path.name}", camera=names.index(name), image=rooms.read_gray(path))
        for name, own in images_by_camera("--skyline", words, names).items()
        for path in rooms.expand_images(own)
    ]
    places = {position.camera: position for position in read.positions}
    without = sorted({names[image.camera] for image in images if image.camera not in places})
    if read.origin is None or without:
        raise InputError(
            f"--skyline needs the place of {' and '.join(without) or 'each camera'} on the Earth: measure it (GNSS) "
            "and give --positions with latitudes and longitudes (or with local meters and --site)"
        )
    centers, sigma = rooms.torch.zeros(len(names), 3).double(), rooms.torch.ones(len(names), 3).double()
    for number, position in places.items():
        centers[number], sigma[number] = position.point, position.sigma
    with steps("comparing skylines with the terrain", None):
        error = kcal.rig.RasterError(refraction=given.refraction.value, refraction_sigma=given.refraction_sigma)
        if given.terrain_sigma is not None:
            error = dataclasses.replace(error, sigma=given.terrain_sigma, offset=0.5 * given.terrain_sigma)
        ground = kcal.locate.terrain(raster, given.geoid)
        cameras = list(read.cameras.values())
        source, found = kcal.rig.skyline_source(images, cameras, ground, read.origin, centers, sigma, error=error)
    shown = [(image.name, image.image) for image in images]
    draw_picture(given.skyline_picture, lambda: rooms.skyline_figure(shown, found))
    read.notes += [line for image, one in zip(images, found, strict=True) for line in _lines(image, one)]
    warn(*(f"skyline {image.name}: {text}" for image, one in zip(images, found, strict=True) for text in one.warnings))
    read.add("skyline", source)


def _lines(image: kcal.rig.SkylineImage, found: rooms.SkylineAttitude) -> list[str]:
    heading, pitch, roll = found.sigma_deg.tolist()
    shares = ", ".join(f"{name} {100 * share[0]:.0f} %" for name, share in found.shares.items() if share[0] > 0.005)
    next_best = f"; next best heading {found.second_deg:.1f}° (χ² larger by {found.second_worse:.0f})"
    second = "" if math.isnan(found.second_deg) else next_best
    return [
        f"skyline {image.name}: heading {found.heading_deg:.4f} ± {heading:.4f}°, pitch {found.pitch_deg:.4f} ± "
        f"{pitch:.4f}°, roll {found.roll_deg:.4f} ± {roll:.4f}° by this image alone; {int(found.used.sum())} of "
        f"{len(found.used)} columns{second}",
        f"  variance of its heading: {shares}",
    ]


# Refuse cameras and views that are in each other's place, or not of one another: by names and sizes in the files.

_SIDE = re.compile(r"(?<![a-z])(left|right)(?![a-z])", re.IGNORECASE)


def check_sides(cameras: Sequence[kcal.Camera], paths: Sequence[Path], pairs: Sequence[Path]) -> None:
    """Refuse a left camera that is named right, and a right one that is named left.

    Not where each is given its own views: then the names were wrong, and the solution tells who stands where.

    Raises:
        InputError: with the command in which they are exchanged.
    """
    records = [camera.calibration.record if camera.calibration else None for camera in cameras]
    if pairs and [record and record.observations for record in records] == [path.name for path in pairs]:
        return
    names = [camera.calibration.name if camera.calibration else "" for camera in cameras]
    sides = [set(map(str.lower, _SIDE.findall(name))) for name in names]
    if sides == [{"right"}, {"left"}]:
        raise InputError(
            f"{paths[0]}: this camera is named {names[0]!r}, and {paths[1]} {names[1]!r}: left and right are "
            f"exchanged. Perhaps: {_exchanged(paths)}"
        )


def check_views_of(cameras: Sequence[kcal.Camera], seen: Sequence[kcal.Observations], paths: Sequence[Path]) -> None:
    """Refuse views of another size than their camera's, and those that the other camera was calibrated from.

    Raises:
        InputError: with the file, the camera and, where the files are exchanged, the right command.
    """
    if len(cameras) > 2:
        return
    sizes, views_sizes = [camera.size for camera in cameras], [views.image_size for views in seen]
    records = [camera.calibration.record if camera.calibration else None for camera in cameras]

    def crossed(fits: Callable[[rooms.CalibrationRecord, int], bool]) -> bool:
        """Whether each camera was calibrated from what the other was given, and neither from its own."""
        known = [[record is not None and fits(record, i) for i in range(len(paths))] for record in records]
        return known == [[False, True], [True, False]]

    if (
        (sizes != views_sizes and sizes == views_sizes[::-1])
        or crossed(lambda record, i: record.observations == paths[i].name)
        or crossed(lambda record, i: set(record.per_view_rms) <= set(seen[i].names))
    ):
        raise InputError(
            f"{paths[0]}: these are views of the right camera, and {paths[1]} has those of the left one: they are "
            f"exchanged. Perhaps: {_exchanged(paths)}"
        )
    for camera, views, path in zip(cameras, seen, paths, strict=True):
        if camera.size != views.image_size:
            name = camera.calibration.name if camera.calibration else ""
            raise InputError(
                f"{path}: images of {views.image_size[0]}x{views.image_size[1]} px, but the camera {name or 'given'} "
                f"has {camera.size[0]}x{camera.size[1]} px: these are not its views. To calibrate from them: "
                f"kcal calibrate {path} -o {path.name.split('.')[0]}.camera.json"
            )


def _exchanged(paths: Sequence[Path]) -> str:
    first, second = map(str, paths)
    return typed_with({first: second, second: first})


# Read the inputs of `kcal rig` and `kcal station` and express them in one coordinate frame.

CAMERAS = ("left", "right")


@dataclasses.dataclass(kw_only=True)
class RigReading:
    """What has been read so far. Each reader adds a source, notes of what was read, and what tells of it later.

    Args:
        cameras: of the rig, by their names.
        names: of the files of the cameras, by which tables and observations name them.
        given: what the user gave.
        origin: of the frame; None where no latitude is known.
        sources: fields of `RigData`.
        notes: what there is to say of the sources.
        tellers: what there is to say of them once the rig is solved.
        unpaired: how many views of the boards have no partner.
        pixel_sigma: px, the typical noise of marks along an axis, where the file of the marks states it.
    """

    cameras: dict[str, kcal.Camera]
    names: tuple[str, ...]
    given: Sources
    origin: kcal.Origin | None
    sources: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)
    tellers: list[Callable[[rooms.RigResult], list[str]]] = dataclasses.field(default_factory=list)
    unpaired: int = 0
    pixel_sigma: float | None = None

    @property
    def positions(self) -> tuple[kcal.MeasuredPosition, ...]:
        """Measured positions of the cameras."""
        return self.sources.get("positions", ())

    @property
    def placed(self) -> bool:
        """Whether landmarks place the cameras."""
        return "landmarks" in self.sources

    def add(self, field: str, source: Any) -> None:
        """Add to a field of `RigData`, to what is there already."""
        before = self.sources.get(field)
        self.sources[field] = source if before is None else before + source

    @property
    def one_camera(self) -> list[str]:
        """What to say of a camera that was given at several places."""
        lenses = self.data.lenses
        return [
            f"{' and '.join(same)} are one camera that stood at {len(same)} places: its lens is the same unknown"
            for lens in dict.fromkeys(lenses)
            if len(same := [name for name, own in zip(self.cameras, lenses, strict=True) if own == lens]) > 1
        ]

    @functools.cached_property
    def data(self) -> kcal.RigData:
        """Everything in one frame."""
        return kcal.RigData(cameras=tuple(self.cameras.values()), names=tuple(self.cameras), **self.sources)

    def told(self, result: rooms.RigResult) -> list[str]:
        """What there is to say once the rig is solved."""
        return [*self.one_camera, *self.notes, *(line for tell in self.tellers for line in tell(result))]


def parse_baselines(text: str, names: Sequence[str] = CAMERAS) -> tuple[kcal.Baseline, ...]:
    """`"10.02±0.005"`, meters, of two cameras; of more `"mill:mast=812.40±0.02"`, several with commas.

    Raises:
        InputError: something else, or a camera that is not there.
    """
    found = []
    for part in text.split(","):
        pair, equals, measured = part.strip().rpartition("=")
        try:
            length, sigma = with_sigma(measured, "baseline")
        except InputError:
            sigma = None
        if sigma is None:
            example = "10.02±0.005" if len(names) == 2 else f"{names[0]}:{names[1]}=10.02±0.005"
            raise InputError(f"baseline {part!r}: write LENGTH±SIGMA in meters, for example {example}")
        ends = pair.strip().split(":") if equals else list(names)
        if len(ends) != 2 or not set(ends) <= set(names):
            raise InputError(
                f"baseline {part!r}: of {len(names)} cameras write FIRST:SECOND=LENGTH±SIGMA, the names being "
                f"{', '.join(names)}"
            )
        found.append(kcal.Baseline(first=names.index(ends[0]), second=names.index(ends[1]), length=length, sigma=sigma))
    return tuple(found)


def _places_in(read: RigReading, path: Path) -> kcal.rig.Survey:
    geoid = None if read.given.terrain and path.suffix.lower() != ".gpx" else read.given.geoid
    return kcal.rig.import_survey(path, read.origin, sigma=read.given.survey_sigma, geoid=geoid)


def _add_positions(read: RigReading, path: Path) -> None:
    """Places of the cameras."""
    placed = _places_in(read, path)
    read.origin = placed.origin
    # Two cameras are left and right, or named as their files.
    own = tuple(read.cameras)
    read.add("positions", rooms.camera_positions(placed, own if {*placed.names} <= {*own} else read.names))


def _add_landmarks(read: RigReading, path: Path) -> None:
    """Surveyed places with their marks."""
    given = read.given
    assert given.marks is not None
    survey = _places_in(read, path)
    if given.positions is not None and survey.origin != read.origin:
        raise InputError("landmarks and positions: one has latitudes, the other local meters; give a --site")
    read.origin = survey.origin
    marks = kcal.locate.read_marks(given.marks, read.names, single=True, others=len(read.cameras) == 1)
    found = kcal.rig.match_landmarks(survey, marks, marks.sigmas(given.marks_sigma))
    if marks.covariance is not None:
        read.pixel_sigma = marks.typical_sigma(given.marks_sigma)
    read.add("landmarks", found.landmarks)
    strays = {"surveyed, but not marked": found.unmarked, "marked, not surveyed": found.unsurveyed}
    warn(*(f"{text}: {', '.join(some)}" for text, some in strays.items() if some))


def _add_pairs(read: RigReading, files: Sequence[Path]) -> None:
    """Boards that two cameras saw, or any of more."""
    if len(read.cameras) != 2:
        own = dict(zip(cameras_of_files(files, read.names), map(kcal.Observations.load, files), strict=True))
        read.add("boards", rooms.boards_of_several(list(read.cameras.values()), read.names, own))
        return
    if len(files) != 2:
        raise InputError("--pairs: two files are needed, of the left and of the right camera")
    match = read.given.match
    first, second = read.cameras.values()
    seen = kcal.Observations.load(files[0]), kcal.Observations.load(files[1])
    check_views_of((first, second), seen, files)
    views = seen[0].names, seen[1].names
    matched = kcal.rig.pair_by_name(*views) if match is None else rooms.read_pairs(match, *views)
    read.add("boards", kcal.rig.paired_boards((first, second), seen, matched))
    read.unpaired = len(views[0]) + len(views[1]) - 2 * len(matched)


def _cure_of(option: str, sources: Sources, paths: Sequence[Path], _: object = None) -> str:
    """The command after a refusal of a source; none where the refusal says what to write."""
    if option == "stars" and sources.stars:
        words = ["kcal", "stars", sources.stars[0].rpartition("=")[2], "--camera", *map(str, paths[:1])]
        return f"To see what each image shows: {shlex.join(words)}"
    if len(paths) == 2 and option == "pairs" and sources.pairs:
        return look_at_views(kcal.Observations.load(sources.pairs[0]), sources.pairs[0])
    if len(paths) == 2 and option in ("landmarks", "marks", "features"):
        marks = sources.marks or sources.features
        return mark_again("--cameras", *paths, "--landmarks", sources.landmarks or "survey.csv", marks=marks)
    return ""


def cure_of_all(error: KcalError, sources: Sources, paths: Sequence[Path]) -> str:
    """The command after a refusal of all sources together: another look at the wrong one, or more marks."""
    if isinstance(error, ContradictionError):
        return _cure_of("pairs" if error.kind == "boards" else error.kind, sources, paths)
    if sources.pairs and sources.landmarks is None and isinstance(error, InputError):
        return _cure_of("pairs", sources, paths)
    marked = sources.marks or sources.features or isinstance(error, DegenerateError)
    return _cure_of("marks", sources, paths) if marked else ""


# What reads each option of `Sources`, in this order: later ones need the frame of the first.
READERS: dict[str, Callable[[RigReading, Any], None]] = {
    "positions": _add_positions,
    "landmarks": _add_landmarks,
    "pairs": _add_pairs,
    "stars": _add_stars,
    "terrain": _add_skyline,
    "features": lambda read, path: read.add(
        "features", kcal.rig.read_features(path, read.given.marks_sigma, read.names)
    ),
    "scene": _add_scene,
    "tracks": _add_tracks,
    "baseline": lambda read, text: read.add("baselines", parse_baselines(text, tuple(read.cameras))),
}


def read_sources(
    cameras: Sequence[kcal.Camera], sources: Sources, names: Sequence[str] = CAMERAS, paths: Sequence[Path] = ()
) -> RigReading:
    """Read everything; warnings about it are printed. Two cameras are left and right, one or more have their names."""
    if (sources.landmarks is None) != (sources.marks is None):
        text = "--landmarks and --marks belong together: places by name, and where they are in the images"
        raise InputError(with_command(text, _cure_of("marks", sources, paths)))
    if sources.terrain is None and (sources.skyline or sources.skyline_picture is not None):
        raise InputError("--skyline and --skyline-picture need the raster of the terrain: --terrain DEM.tif")
    known = CAMERAS if len(cameras) == 2 else names
    read = RigReading(
        cameras=dict(zip(known, cameras, strict=True)), names=tuple(names), given=sources,
        origin=None if sources.site is None else sources.site.origin,
    )  # fmt: skip
    for option, reader in READERS.items():
        if value := getattr(sources, option):
            with ending_with(functools.partial(_cure_of, option, sources, paths)):
                reader(read, value)
    return read


def load_cameras(paths: Sequence[Path]) -> tuple[kcal.Camera, ...]:
    """Cameras from files; a file given at several places is one `Camera`, whose lens is the same at all of them."""
    found = {path: kcal.load_camera(path) for path in dict.fromkeys(paths)}
    return tuple(found[path] for path in paths)


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
