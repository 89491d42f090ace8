"""`kcal watch`: the attitude of a rig over time, from what its cameras see."""

from __future__ import annotations

import importlib
import math
import time as clocks
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

import kcal
from kcal.bag import bag_and_topic
from kcal.cli import kinds, rooms
from kcal.cli.console import err, on_signals, out, print_wrote, steps, warn
from kcal.cli.options import Kind
from kcal.cli.rig import DRIFTED, print_turns, replace_rig
from kcal.errors import InputError, with_extra
from kcal.files import check_writable
from kcal.texts import measured_text

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
            tell=lambda text: err.print(text),
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
    _tell_turns(watched, limit)
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
        frames = rooms.FramesTogether(sources, sizes, pairs=True, tell=lambda text: err.print(text))

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
    timed = sorted(
        (rooms.image_time(left), left, right) for left, right in rooms.image_pairs(*([folder] for folder in folders))
    )
    with steps("watching", len(timed)) as advance:
        for time, left, right in timed:
            if watcher.due(time):
                yield time, rooms.read_gray(left), rooms.read_gray(right)
            advance(left.name)


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
    failed = sum(hook.failed for hook in hooks)
    if failed:
        parts.append(f"{failed:,} times a webhook did not answer")
    return "; ".join(parts)


def _tell_turns(watched: kcal.rig.Watched, limit: float) -> None:
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
    drifts = []
    with steps("drawing", len(times)) as advance:
        for time in times:
            drifts.append(watched.drift_at(time))
            advance("")
    angle = np.degrees(np.stack([drift.relative.numpy() for drift in drifts]))
    sigma = np.degrees(np.stack([drift.relative_covariance.diagonal().sqrt().numpy() for drift in drifts]))
    seen = np.array(watched.seen[::step], bool)
    print_wrote(
        kcal.report.save_picture(picture, rooms.attitude_figure(np.array(times), angle, sigma, seen, limit, title))
    )
