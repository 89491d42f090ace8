"""Commands that follow cameras until they are stopped: `kcal live` (tracks) and `kcal watch` (the rig's attitude)."""

from __future__ import annotations

import importlib
import math
import os
import sys
import time as clocks
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

import kcal
from kcal.bag import bag_and_topic
from kcal.cli import kinds, rooms
from kcal.cli.console import err, followed, on_signals, out, print_wrote, steps, warn
from kcal.cli.inputs import pixel_sigma_of
from kcal.cli.locate import LocateOptions, pair_localizer
from kcal.cli.options import Kind, Only, Rare, taken
from kcal.cli.rig import DRIFTED, print_turns, replace_rig
from kcal.errors import InputError, with_extra
from kcal.files import check_writable
from kcal.texts import counted_text, measured_text

# `kcal live`: detections of two cameras or more to tracks on the map, as they come.


def live_command(
    rig: kinds.RigFile,
    videos: kinds.Videos | None = None,
    *,
    output: list[kinds.Output],
    detector: Annotated[str, Kind(metavar="MODULE:CALLABLE")] | None = None,
    detections: Annotated[str, Kind(metavar="JSONL")] | None = None,
    to: Annotated[list[str], Kind(metavar="ADDRESS")] | None = None,
    port: Annotated[int, Kind(metavar="PORT")] | None = None,
    journal: Rare[Path | None] = None,
    options: Annotated[LocateOptions, Only(("site", "heading", "pixel_sigma", "history"))],
    box_sigma: Rare[kinds.Pixels] = 2.0,
    match_sigma: Rare[Annotated[kinds.Pixels, Kind(of="videos")]] = 0.06,
    clock_offset: Rare[kinds.Clock] = 0.0,
    clock_sigma: kinds.Seconds = 0.0,
    compile: Rare[bool] = False,
    start: Rare[kinds.Time | None] = None,
) -> None:
    """Follow what cameras see: tracks with latitude, longitude, velocity and honest errors, written as they come.

    Of two videos, frames belong together by their own times, and the images inside the boxes are matched to a fraction
    of a pixel. The detector returns what `kcal.track.Detections.read` takes: an array of x1, y1, x2, y2, score, class,
    or results of supervision, torchvision, ultralytics or kornia.

    A line of `--detections` is one moment: `{"left": {"time": T, "boxes": [[x1,y1,x2,y2], ...]}, "right": {...}}`, or
    pairs that are matched already: `{"time": T, "left": [[u,v], ...], "right": [[u,v], ...], "sigma": PX}`.

    Of a rig of many cameras, a line names those that have an image: `{"cameras": {"mill": {"time": T, "boxes": [...]},
    "mast": {...}}}`. Two cameras begin a track, and any one of them continues it.

    Frames reduce the noise of the marks, never what calibration, mounting and clocks contribute. With `--clock-sigma`
    the offset between the cameras' clocks is estimated from targets that move.

    Stop it with Ctrl-C or SIGTERM. Started again with the same outputs, it continues where it was, after a crash too:
    nothing is lost or written twice. Receivers of `--to` may get the last moments twice. Only one process at a time may
    write an output.

    Times are seconds. A time that the moments before and after contradict is left out; a clock that was set is
    followed, with new tracks. Both are counted.

    **Examples**

    `kcal live rig.json left.mp4 right.mp4 --detector mydetector:find -o tracks.geojsonl`

    `detector | kcal live rig.json --detections - -o tracks.csv --to udp://239.2.3.1:6969`

    Args:
        rig: Rig file from `kcal rig`.
        videos: Video files, bags (run.mcap:/left/image_raw) or addresses (rtsp://...), with --detector: one for each
            camera, in the rig's order.
        output: File that grows: .geojsonl, .csv or .cot; may be repeated.
        detector: Called with each image, uint8 (H, W, 3) in the order red, green, blue; returns boxes in pixels.
        detections: In place of videos: lines of JSON, one for each moment; - for the standard input.
        to: Where positions go besides: udp://HOST:PORT or tcp://HOST:PORT for Cursor-on-Target, mqtt://HOST/TOPIC; may
            be repeated.
        port: Serve the live map to this machine's browser; 0: any free port.
        journal: Remembers what was written; the first output with .journal if not given.
        box_sigma: Noise of the middle of a box, each axis.
        match_sigma: Error of matched images that compression of the videos adds, each axis.
        clock_offset: Seconds by which the right images are later than their times; of two cameras.
        clock_sigma: Standard deviation of the offset between the cameras' clocks, also as a drift in an hour; above 0
            the offset is estimated.
        compile: Translate the filter to C++ first, which takes minutes; for many targets.
        start: Calendar time of second 0, if times are not Unix seconds; for events.
    """
    if (detections is None) == (not videos):
        raise typer.BadParameter("give videos and --detector, or --detections")
    known = kcal.load_rig(rig)
    names = known.names
    if videos and (len(videos) != len(names) or detector is None):
        raise typer.BadParameter(f"{len(names)} videos, of the cameras {', '.join(names)}, and --detector are needed")
    many = not known.is_pair or names != ("left", "right")
    if many and (clock_offset or {"site", "heading", "match_sigma"} & taken or options.heading is not None):
        raise typer.BadParameter("--site, --heading, --clock-offset and --match-sigma are of rigs of two cameras")
    if many and options.history is not None:
        raise typer.BadParameter("--history is for rigs of two cameras")
    lines = Path(detections) if detections not in (None, "-") else None
    for path in output:
        check_writable(path, rig, *([lines] if lines else []), *(videos or []))
    clock = kcal.track.ClockPrior(offset_s=clock_offset, offset_sigma_s=clock_sigma, drift_sigma=clock_sigma / 3600.0)
    joining = kcal.track.AssociationOptions(box_sigma=box_sigma)
    localize = _localizer(rig, known, options, many=many)
    solved = localize if many else localize.rig

    if compile:
        err.print("compiling: some three minutes the first time")
    follow = kcal.track.TrackOptions.for_video(match_sigma) if videos else None
    moments, moving = None, 0
    if options.history is not None:
        # The rig as it stands at each second, by a history that grows, and how many errors more that has.
        moments, moving = rooms.Followed(options.history, localize), rooms.MORE_ERRORS
    tracker = kcal.track.Tracker(localize, follow, clock=clock, compiled=compile, moments=moments, moving=moving)
    frames = None
    if videos and detector:
        # As `python -m` does: a detector beside which the command is run is found.
        sys.path.insert(0, os.getcwd())
        frames = rooms.Videos(
            videos, solved, rooms.load_detector(detector), joining,
            # Before the first moment the estimate is the prior.
            late=lambda one: tracker.clock_estimate(one).offset(max(tracker.time, tracker.shared.start or 0.0))[0],
            match_sigma=match_sigma, tell=err.print,
        )  # fmt: skip
    noise = float(localize.pixel_sigma)
    source = frames or rooms.lines_of(lines, lambda line: rooms.read_moment(line, solved, joining, noise))
    log = journal if journal is not None else output[0].with_name(output[0].name + ".journal")
    with steps("live", lines.stat().st_size if lines is not None and lines.is_file() else None) as advance:
        stream = rooms.Stream(
            tracker, rooms.PointLocator(localize).located(), output, log,
            senders=[rooms.sender_to(address) for address in to or []], start=start, shown=None,
        )  # fmt: skip
        page = None
        if port is not None:
            page = rooms.LiveMap(stream.run, port, start)
            err.print(f"live map: {page.address}")
        stream.shown = _progress(advance, stream, page)
        if stream.ledger.place.sequence:
            err.print(f"continuing after {counted_text(stream.ledger.place.sequence, 'moment')} of {log}")
        ending = "finished"

        def stop(*_: object) -> None:
            nonlocal ending
            ending = "stopped"
            stream.stop()

        live = frames is not None and frames.live
        try:
            with on_signals(stop):
                counts = stream.follow(source, waits=not live, resumes=not live and detections != "-")
        except BaseException:
            ending = "ended by an error: see the terminal"
            raise
        finally:
            if page is not None:
                page.close(ending)
    err.print(summary(counts))
    if counts.jumps:
        ahead = "ahead" if counts.last_jump_s > 0 else "back"
        err.print(
            f"times jumped ({counts.jumps:,} x) and stayed: followed, with new tracks; the last jump was "
            f"{abs(counts.last_jump_s):,.1f} s {ahead}"
        )
    if frames is not None:
        err.print(str(frames.counts))
    if counts.malformed:
        if not (counts.moments or counts.repeated or counts.waiting or stream.ledger.place.sequence):
            raise InputError(f"none of {counts.malformed:,} lines could be read; the last one: {counts.last_error}")
        err.print(f"last malformed line: {counts.last_error}")
    if clock_sigma:
        for camera, name in enumerate(names[1:], 1):
            offset, sigma = stream.tracker.clock_estimate(camera).offset(stream.tracker.time)
            late = measured_text(1e3 * offset, 1e3 * sigma, "ms")
            whose = f"{name}'s" if many else f"the {name} camera's"
            err.print(f"{whose} images are {late} later than their times say")


def summary(counts: rooms.StreamCounts) -> str:
    """What happened, in one line."""
    parts = [f"{counted_text(counts.moments, 'moment')}, {counted_text(counts.positions, 'position')}"]
    for count, what, more in (
        (counts.repeated, "moment", " not after the last one, skipped"),
        (counts.contradicted, "moment", " left out, whose times the ones before and after contradict"),
        (counts.waiting, "moment", " left for the next run, because no later one bears out how far their times jumped"),
        (counts.malformed, "malformed line", ""),
        (counts.dropped, "moment", " dropped for lack of time"),
        (counts.unsent, "moment", " that a receiver did not get"),
    ):
        parts += [counted_text(count, what) + more] if count else []
    return "; ".join(parts)


def _localizer(path: Path, rig: kcal.Rig, options: LocateOptions, *, many: bool) -> kcal.Localizer:
    """Of two cameras, or of many."""
    noise = pixel_sigma_of(options.pixel_sigma, rig)
    if not many:
        return pair_localizer(rig, options, noise)(rig)
    localize = kcal.Localizer(rig, weights="all", pixel_sigma=noise)
    if localize.rig.origin is None:
        raise InputError(
            f"{path}: this rig has no place on the Earth; solve it with landmarks or positions with latitudes"
        )
    return localize


def _progress(
    advance: Callable[..., None], stream: rooms.Stream, page: rooms.LiveMap | None
) -> Callable[[rooms.PositionColumns, rooms.Tracks], None]:
    """Show the tracks on the map, and how it goes, twice a second."""
    next_time, read = 0.0, 0

    def show(columns: rooms.PositionColumns, tracks: rooms.Tracks) -> None:
        nonlocal next_time, read
        if page is not None:
            page.show(columns, stream.counts.moments, tracks.time)
        if clocks.monotonic() >= next_time:
            next_time, before, read = clocks.monotonic() + 0.5, read, stream.ledger.place.offset
            advance(f"{counted_text(len(tracks.number), 'track')}; {summary(stream.counts)}", read - before)

    return show


# `kcal watch`: the attitude of a rig over time, from what its cameras see.

_EXIT = "exit"
# Points of a picture.
_DRAWN = 2000


def watch_command(
    rig: kinds.RigFile,
    images: list[str] | None = None,
    *,
    output: Annotated[kinds.NewFile, Kind(metavar="CSV")],
    every: Annotated[float, Kind(metavar="S", least=1.0, of="images")] = 60.0,
    reference_images: Annotated[tuple[Path, Path], Kind(metavar="LEFT RIGHT", of="images")] | None = None,
    temperatures: Annotated[kinds.History, Kind(of="images")] | None = None,
    limit: Annotated[float, Kind(metavar="DEG", least=1e-4)] = 0.005,
    alarm: Annotated[list[str], Kind(metavar="URL|exit", of="images")] | None = None,
    relock: Path | None = None,
    parquet: Annotated[Path, Kind(metavar="PARQUET", writes=True)] | None = None,
    picture: kinds.Picture | None = None,
) -> None:
    """Measure how the cameras of a rig turn over time, from what they see, and keep a history with sigmas.

    Fixed features of the first images are found again in each camera at every look, and matched between the cameras
    once an hour. What moves is learned out. How the rig turns (sun, wind, temperature) is learned by maximum
    likelihood, so that gaps and nights have honest sigmas. Few features, by fog or a dirty lens, make them larger, and
    are told.

    `kcal locate --history HISTORY` and `kcal live --history HISTORY` use the attitude and the sigma of each moment.

    Images of folders need a time in their names (20260501T120000Z.png, UTC) or in EXIF, and pair by their names.

    An alarm tells that the relative attitude is beyond `--limit` so surely that chance does so less than once a month.
    The exit code is 3 if there was one, else 0; 1 if an image is of another camera or lens. Stop it with Ctrl-C or
    SIGTERM; started again with the same history, it continues, after a crash too.

    **Examples**

    `kcal watch rig.json left/ right/ -o history.csv --picture attitude.png`

    `kcal watch rig.json rtsp://10.0.0.7/main rtsp://10.0.0.8/main -o history.csv --alarm https://example.org/rig`

    Args:
        rig: Rig file from `kcal rig`.
        images: Folders of images, videos, bags (run.mcap:/left/image_raw) or addresses (rtsp://...), LEFT RIGHT;
            without them the history is shown.
        output: CSV file that grows, the history: a row for each measurement.
        every: Seconds between measurements.
        reference_images: Images of when the rig was solved; else the first ones count.
        temperatures: Columns time,temperature (°C); it may grow meanwhile.
        limit: Relative turn beyond which there is an alarm.
        alarm: Where an alarm is sent as JSON (POST); exit: end then. May be repeated.
        relock: Rig file to write at the end, if the history proves the old one wrong; an old one of that name is kept.
        parquet: The history as a Parquet file, too: written whole once a day and at the end, for tools of tables.
        picture: The attitude over time and its 95 % intervals, at the end.
    """
    if images and len(images) != 2:
        raise typer.BadParameter("two folders, videos or addresses, of the left and the right camera, are needed")
    if output.suffix.lower() != ".csv":
        raise typer.BadParameter(f"--output {output}: a name that ends with .csv is needed")
    if parquet is not None:
        if parquet.suffix.lower() != ".parquet":
            raise typer.BadParameter(f"--parquet {parquet}: a name that ends with .parquet is needed")
        with with_extra("tables", "Parquet files need"):
            importlib.import_module("pyarrow")
    if relock is not None:
        check_writable(relock, output)
    hooks = [rooms.Webhook(address) for address in alarm or [] if address != _EXIT]
    known = rooms.load_pair(rig)
    raised = 0
    if images:
        air = None if temperatures is None else rooms.Temperatures(temperatures)
        watcher = rooms.Watcher(
            known, output, every_s=every, limit_deg=limit, temperatures=air, parquet=parquet,
            tell=err.print,
        )  # fmt: skip
        try:
            if reference_images is not None and watcher.looks == 0 and watcher.last_time == -math.inf:
                watcher.refer_to(*(rooms.read_gray(path) for path in reference_images))
            if watcher.offset:
                err.print(f"continuing after {watcher.last_time:.3f} s of {output}")
            _follow(watcher, known, (images[0], images[1]), hooks, ends=_EXIT in (alarm or []))
        finally:
            watcher.close()
        raised = watcher.alarms
        err.print(_summary(watcher, hooks))
        if not watcher.last_time > -math.inf:
            raise InputError("no pair of images was looked at")
    if parquet is not None:
        print_wrote(rooms.save_history(output, parquet))
    with steps("fitting how it turns", None):
        watched = kcal.rig.Watched.read(output, known)
    _tell_turns(watched)
    if picture is not None:
        _draw_turns(watched, picture, limit, output.name)
    if relock is not None:
        better = rooms.relock(watched)
        out.print(("re-locked: " if better.rig else "not re-locked: ") + better.reason)
        if better.rig is not None:
            replace_rig(relock, better.rig)
    if raised:
        raise typer.Exit(DRIFTED)


def _follow(
    watcher: rooms.Watcher, rig: kcal.Rig, sources: tuple[str, str], hooks: list[rooms.Webhook], *, ends: bool
) -> None:
    """Look until the sources end, it is stopped, or an alarm ends it."""
    frames, stopped = None, False
    if not Path(sources[0]).is_dir() or bag_and_topic(sources[0]) is not None:
        sizes = {"left": rig.left.size, "right": rig.right.size}
        frames = rooms.FramesTogether(sources, sizes, pairs=True, tell=err.print)

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True
        if frames is not None:
            frames.close()

    next_word = 0.0
    try:
        with on_signals(stop):
            for time, left, right in _folder_pairs(watcher, sources) if frames is None else _of_frames(watcher, frames):
                noticed = watcher.look(time, left, right)
                for hook in hooks:
                    hook.send(_message(noticed, watcher)) if noticed.begins else hook.again()
                if noticed.begins:
                    warn(f"{_turn_text(noticed)}: beyond the limit of {watcher.limit_deg:g}°")
                if clocks.monotonic() >= next_word:
                    next_word = clocks.monotonic() + 10.0
                    err.print(f"{time:.0f} s: {_turn_text(noticed)}")
                if stopped or (ends and noticed.begins):
                    break
    finally:
        if frames is not None:
            frames.close()


def _of_frames(watcher: rooms.Watcher, frames: rooms.FramesTogether) -> Iterator[tuple[float, rooms.Gray, rooms.Gray]]:
    with steps("watching", None) as advance:
        for _, (_, group) in frames(0 if frames.live else watcher.offset):
            one, other = group
            if one is not None and other is not None and watcher.due(one.time):
                advance(f"{one.time:.0f} s")
                yield one.time, one.gray().numpy(), other.gray().numpy()


def _folder_pairs(watcher: rooms.Watcher, folders: tuple[str, str]) -> Iterator[tuple[float, rooms.Gray, rooms.Gray]]:
    pairs = rooms.image_pairs(*([folder] for folder in folders))
    timed = sorted((rooms.image_time(left), left, right) for left, right in pairs)
    for time, left, right in followed("watching", timed, lambda pair: pair[1].name):
        if watcher.due(time):
            yield time, rooms.read_gray(left), rooms.read_gray(right)


def _turn_text(noticed: rooms.Noticed) -> str:
    angles = zip(("pitch", "yaw", "roll"), noticed.turn.tolist(), noticed.sigma.tolist(), strict=True)
    return ", ".join(
        f"{name} {measured_text(math.degrees(turn), math.degrees(sigma), '°', sign=True)}"
        for name, turn, sigma in angles
    )


def _message(noticed: rooms.Noticed, watcher: rooms.Watcher) -> dict[str, object]:
    degrees = [[math.degrees(value) for value in values.tolist()] for values in (noticed.turn, noticed.sigma)]
    return {
        "kcal": "watch alarm", "rig": watcher.rig.fingerprint, "time": noticed.row.time,
        "relative_pitch_yaw_roll_deg": degrees[0], "sigma_deg": degrees[1], "limit_deg": watcher.limit_deg,
    }  # fmt: skip


def _summary(watcher: rooms.Watcher, hooks: list[rooms.Webhook]) -> str:
    parts = [f"{watcher.looks:,} measurements, {watcher.alarms:,} alarms"]
    if watcher.skipped:
        parts.append(f"{watcher.skipped:,} images not after the last measurement, left out")
    if failed := sum(hook.failed for hook in hooks):
        parts.append(f"{failed:,} times a webhook did not answer")
    return "; ".join(parts)


def _tell_turns(watched: kcal.rig.Watched) -> None:
    """The attitude now, and how the rig turns."""
    drift = watched.drift_at(watched.times[-1])
    model, degrees = watched.model, math.degrees(1.0)
    print_turns(drift)
    # What the yaw of both cameras does in an hour without a look.
    hour = [float(model.swing[k]) ** 2 * (1.0 - math.exp(-7200.0 / float(model.return_s[k]))) for k in (1, 4)]
    swing = degrees * math.hypot(float(model.swing[1]), float(model.swing[4]))
    gust = degrees * math.hypot(float(model.gust[1]), float(model.gust[4]))
    out.print(
        f"relative yaw swings by {swing:.5f}° and moves by {gust:.5f}° in the wind; without images an hour costs "
        f"{degrees * math.sqrt(sum(hour)):.5f}°: `kcal locate --aged` needs that number where there is no history"
    )


def _draw_turns(watched: kcal.rig.Watched, picture: Path, limit: float, title: str) -> None:
    import numpy as np

    step = -(-len(watched.times) // _DRAWN)
    times = watched.times[::step]
    drifts = [watched.drift_at(time) for time in followed("drawing", times, lambda _: "")]
    angle = np.degrees(np.stack([drift.relative.numpy() for drift in drifts]))
    sigma = np.degrees(np.stack([drift.relative_covariance.diagonal().sqrt().numpy() for drift in drifts]))
    seen = np.array(watched.seen[::step], bool)
    figure = rooms.attitude_figure(np.array(times), angle, sigma, seen, limit, title)
    print_wrote(kcal.report.save_picture(picture, figure))
