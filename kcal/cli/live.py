"""`kcal live`: detections of two cameras or more to tracks on the map, as they come."""

from __future__ import annotations

import os
import sys
import time as clocks
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import err, on_signals, steps
from kcal.cli.inputs import pixel_sigma_of
from kcal.cli.locate import LocateOptions, pair_localizer
from kcal.cli.options import Kind, Only, Rare, taken
from kcal.errors import InputError
from kcal.files import check_writable
from kcal.texts import measured_text


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
    frames = _videos(videos, detector, solved, tracker, joining, match_sigma) if videos and detector else None
    source = frames or rooms.lines_of(
        lines, lambda line: rooms.read_moment(line, solved, joining, float(localize.pixel_sigma))
    )
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
            err.print(f"continuing after {stream.ledger.place.sequence:,} moments of {log}")
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
            f"times jumped {counts.jumps:,} times and stayed: followed, with new tracks; the last jump was "
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
    parts = [f"{counts.moments:,} moments, {counts.positions:,} positions"]
    for count, what in (
        (counts.repeated, "moments not after the last one, skipped"),
        (counts.contradicted, "moments left out, whose times the ones before and after contradict"),
        (counts.waiting, "moments left for the next run, because no later one bears out how far their times jumped"),
        (counts.malformed, "malformed lines"),
        (counts.dropped, "moments dropped for lack of time"),
        (counts.unsent, "moments that a receiver did not get"),
    ):
        parts += [f"{count:,} {what}"] if count else []
    return "; ".join(parts)


def _localizer(path: Path, rig: kcal.Rig, options: LocateOptions, *, many: bool) -> kcal.Localizer:
    """Of two cameras, or of many."""
    if not many:
        return pair_localizer(rig, options, pixel_sigma_of(options.pixel_sigma, rig))(rig)
    known = rooms.stations_of(rig)
    if known.origin is None:
        raise InputError(
            f"{path}: this rig has no place on the Earth; solve it with landmarks or positions with latitudes"
        )
    return kcal.Localizer(known, weights="all", pixel_sigma=pixel_sigma_of(options.pixel_sigma, known))


def _videos(
    videos: list[str],
    detector: str,
    rig: kcal.Rig | kcal.Localizer,
    tracker: kcal.track.Tracker,
    options: kcal.track.AssociationOptions,
    match_sigma: float,
) -> rooms.Videos:
    # As `python -m` does: a detector beside which the command is run is found.
    sys.path.insert(0, os.getcwd())

    def late(camera: int) -> float:
        # Before the first moment the estimate is the prior.
        return tracker.clock_estimate(camera).offset(max(tracker.time, tracker.shared.start or 0.0))[0]

    return rooms.Videos(
        videos, rig, rooms.load_detector(detector), options, late=late, match_sigma=match_sigma, tell=err.print
    )


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
            advance(f"{len(tracks.number)} tracks; {summary(stream.counts)}", read - before)

    return show
