"""Drones, ships and aircraft that tell where they are, for `kcal rig --tracks`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.errors import InputError
from kcal.quantities import measured_text

if TYPE_CHECKING:
    from kcal.calibrate.rig.result import RigResult
    from kcal.calibrate.rig.sources import MeasuredPosition
    from kcal.lens.camera import Camera
    from kcal.lens.mounting import Origin
    from kcal.locate.moving_match import MovingControl, MovingOptions


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
    from kcal.locate.moving import read_sightings, read_tracks
    from kcal.locate.moving_match import match_moving

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
    from kcal.locate.moving_match import CLOCK

    amount = result.effects().get(CLOCK)
    if amount is None:
        return []
    offset, sigma = control.clock + options.clock_sigma * amount[0], options.clock_sigma * amount[1]
    return [f"the tracks' clock is {measured_text(offset, sigma)} s ahead of the cameras'"]
