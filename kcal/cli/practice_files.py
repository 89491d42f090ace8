"""The texts of a practice site: what is where, the surveyor's list, and what is to be located."""

from __future__ import annotations

import datetime
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from kcal.sim.scene import DemoScene


class Exercise(NamedTuple):
    """A step of the exercise.

    Attributes:
        name: of the step.
        makes: files of which one must be there when it is done.
        commands: what to paste, in the folder of the site.
        leads_on: whether its files serve the next step alone, so that they may have other names.
    """

    name: str
    makes: tuple[str, ...]
    commands: tuple[str, ...]
    leads_on: bool = False


STEPS = (
    Exercise("find the board", ("left.obs.json", "right.obs.json"), tuple(
        f"kcal detect boards/{side} --board 9x6 --square 60mm -o {side}.obs.json" for side in ("left", "right")), True),
    Exercise("calibrate", ("left.camera.json", "right.camera.json"), tuple(
        f"kcal calibrate {side}.obs.json -o {side}.camera.json" for side in ("left", "right"))),
    Exercise("mark", ("marks.csv",), (
        "kcal mark site/left.png site/right.png --cameras left.camera.json right.camera.json --landmarks survey.csv "
        "-o marks.csv",), True),
    Exercise("solve the rig", ("rig.json",), (
        "kcal rig left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv -o rig.json",)),
    Exercise("locate", ("positions.geojson",), (
        "kcal locate rig.json marks.points.csv -o positions.geojson --map map.html",)),
    Exercise("follow", ("tracks.csv",), (
        "kcal live rig.json video/left.mp4 video/right.mp4 --detector find_ships:find_ships -o tracks.csv",)),
)  # fmt: skip


# When the night's pictures were taken.
NIGHT = datetime.datetime(2026, 11, 24, 20, 47, 26, tzinfo=datetime.UTC)


def night_name(side: str) -> str:
    """Name of a night's picture, which says when it was taken, in UTC."""
    return f"{side}-{NIGHT:%Y-%m-%dT%H%M%S}.png"


def readme_text(scene: DemoScene) -> str:
    """What is in the folder, and the commands."""
    commands = "\n".join(
        f"{number}. {step.name}\n" + "\n".join(f"   {command}" for command in step.commands)
        for number, step in enumerate(STEPS, 1)
    )
    place = f"--lat {scene.lat:g} --lon {scene.lon:g} --height {scene.height:g}"
    return f"""A site to practise on
=====================

Two cameras stand 10 m apart on masts above a harbor. Everything is rendered, so the truth is known.

boards/left, boards/right   photographs of a printed board: 9x6 inner corners, squares of 60 mm
site/left.png, right.png    the site as both cameras see it, to be marked
site/sketch.png             the surveyor's sketch: which landmark is which, and the targets
night/                      the stars over both cameras; times in the names are UTC
survey.csv                  surveyed places of the landmarks, with their sigma
targets.csv                 what to locate, and which point of it is meant; use these names
video/left.mp4, right.mp4   two minutes with ships that move
video/detections.jsonl      the same ships as a detector would report them, if you cannot read videos
find_ships.py               a detector for the videos

Run the commands in this folder:

{commands}

   Without the extra `video`:
   kcal live rig.json --detections video/detections.jsonl -o tracks.csv

   How do the cameras look, by the stars?
   kcal stars night/{night_name("left")} --camera left.camera.json --time name:Z {place}

How well did you do? This may be asked after each step:
   kcal demo --score .
The truth is in the hidden folder .truth; look there afterwards.
"""


def survey_text(scene: DemoScene) -> str:
    """The landmarks as a surveyor hands them over: latitude, longitude, ellipsoidal height, sigma in meters."""
    from kcal.lens.mounting import Origin
    from kcal.locate.geodesy import enu_to_geodetic

    origin = Origin(lat=scene.lat, lon=scene.lon, height=scene.height)
    surveyed = scene.surveyed(scene.landmarks)
    lines = ["name,lat,lon,height,sigma"]
    for name, (lat, lon, height) in zip(surveyed.names, enu_to_geodetic(surveyed.enu, origin).tolist(), strict=True):
        lines.append(f"{name},{lat:.9f},{lon:.9f},{height:.3f},{scene.survey_sigma:g}")
    return "\n".join(lines) + "\n"


def targets_text() -> str:
    """Names of what is to be located, and which point is meant."""
    from kcal.sim.practice import TARGETS

    return "".join(["name,mark\n", *(f"{thing.name},{thing.where}\n" for thing in TARGETS)])
