"""`kcal place`: stations whose pose is known, from a drone's log or by a compass: no landmarks are needed."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import typer

import kcal
from kcal.cli import kinds
from kcal.cli.console import err, out, print_wrote
from kcal.cli.options import Several
from kcal.cli.rig_sources import load_cameras
from kcal.cli.stations import camera_names, print_stands
from kcal.errors import InputError
from kcal.values import WithSigma


@dataclasses.dataclass(frozen=True, kw_only=True)
class TypedStands:
    """How cameras stand, as it is typed.

    Args:
        site: Place of each camera; heights are above the WGS84 ellipsoid, ± along each axis, 1 m if not given.
        heading: Azimuth of each camera's axis from true north.
        pitch: Elevation of each camera's axis above the horizon.
        roll: Of each camera, clockwise as seen from behind it; level within the pitch's ± if not given.
    """

    site: Several[kinds.Place] | None = None
    heading: Several[kinds.MeasuredDegrees] | None = None
    pitch: Several[kinds.MeasuredDegrees] | None = None
    roll: Several[kinds.MeasuredDegrees] | None = None

    def mountings(self, count: int) -> list[kcal.rig.Mounting]:
        """Of so many cameras.

        Raises:
            InputError: another number of values, or an angle without ±.
        """
        site, heading, pitch, roll = self.site or [], self.heading or [], self.pitch or [], self.roll
        if roll is None:
            roll = [WithSigma(0.0, one.sigma) for one in pitch]
            err.print("roll: 0, known as well as the pitch; --roll states it")
        typed: dict[str, Sequence[kinds.KnownPlace | WithSigma]]
        typed = {"--site": site, "--heading": heading, "--pitch": pitch, "--roll": roll}
        for option, given in typed.items():
            if len(given) != count:
                raise InputError(f"{option}: one value for each of {count} cameras is needed, got {len(given)}")
            if vague := [one for one in given if one.sigma is None and option != "--site"]:
                raise InputError(f"{option} {vague[0]}: say how well it is known, for example {vague[0]}±1")
        return [
            kcal.rig.stated_mounting(
                place.origin,
                heading_deg=(turn.value, turn.sigma or 0.0),
                pitch_deg=(rise.value, rise.sigma or 0.0),
                roll_deg=(tip.value, tip.sigma or 0.0),
                sigma_m=(1.0 if place.sigma is None else place.sigma,) * 3,
            )
            for place, turn, rise, tip in zip(site, heading, pitch, roll, strict=True)
        ]


def place_command(
    cameras: list[kinds.CalibratedCamera],
    *,
    output: kinds.NewFile,
    stands: TypedStands,
    places: kinds.Table | None = None,
) -> None:
    """Make a station, or a rig of several, from positions and angles that are known: no landmarks are needed.

    North, up and the horizon are those at each camera. `kcal locate` then gives the position of what one camera sees at
    a known height (`--height`, `--terrain`), and of what several see. State how well you know each value: ±1 or more
    for the compass of a drone or a phone. Where there are landmarks, `kcal station` finds the pose far better.

    **Examples**

    `kcal place drone.camera.json --site 46.02,7.75,1720±3 --heading 212±2 --pitch -30±0.5 -o drone.rig.json`

    `kcal place west.camera.json east.camera.json --places places.csv -o towers.rig.json`

    Args:
        cameras: Camera file of each; of one file and a table, each line of the table is a place of that camera.
        output: Rig file to write.
        places: In place of these a table: name (of the camera), lat, lon, height, sigma, heading, heading_sigma, pitch,
            pitch_sigma, and if need be sigma_up, roll, roll_sigma.
    """
    needed = (stands.site, stands.heading, stands.pitch)
    if (places is None) == any(value is None for value in needed) or (places and (stands.roll or any(needed))):
        raise typer.BadParameter("give --site, --heading and --pitch of each camera, or all of them in --places")
    from kcal.locate.stations import read_stands

    names = camera_names(cameras)
    if places is None:
        poses = dict(zip(names, stands.mountings(len(names)), strict=True))
    else:
        poses = read_stands(places, None if len(names) == 1 else names)
    lenses = load_cameras(cameras * len(poses) if len(cameras) == 1 else cameras)
    rig = kcal.rig.station_rig(dict(zip(poses, lenses, strict=True)), [*poses.values()])
    kcal.save_rig(rig, output)
    print_stands(rig)
    print_wrote(output)
    out.print(
        f"next: kcal locate {output} marks.csv, with lines of name,camera,u,v; --height or --terrain where one camera "
        "alone sees a point"
    )
