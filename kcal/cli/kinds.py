"""Kinds of values on the command line: metavar, unit and reader of each, declared once for all commands."""

from __future__ import annotations

import datetime
import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import kcal
from kcal import values
from kcal.cli import inputs, rooms
from kcal.cli.options import Kind
from kcal.errors import InputError
from kcal.files import check_picture
from kcal.values import WithSigma

# Numbers with their unit. `Positive...` and `Least...` refuse others as wrong usage.
Meters = Annotated[float, Kind(metavar="M")]
Sigma = Annotated[float, Kind(metavar="M", least=0)]
Degrees = Annotated[float, Kind(metavar="DEG")]
DegreesSigma = Annotated[float, Kind(metavar="DEG", least=0)]
Pixels = Annotated[float, Kind(metavar="PX")]
Seconds = Annotated[float, Kind(metavar="S", least=0)]
Celsius = Annotated[float, Kind(metavar="°C")]
Hectopascal = Annotated[float, Kind(metavar="HPA")]
Baseline = Annotated[float, Kind(metavar="M", least=1e-3, setting=True)]
Count = Annotated[int, Kind(metavar="N", least=1)]
PixelSigma = Annotated[
    float,
    Kind(
        metavar="PX",
        setting=True,
        about="Noise of marks along each axis; that in the rig's file, or 0.3, if not given.",
    ),
]

# Numbers with what is known of them, VALUE±SIGMA.
MeasuredBaseline = Annotated[WithSigma, Kind(metavar="M±SIGMA", read=values.with_sigma, usage=True, setting=True)]
MeasuredDegrees = Annotated[WithSigma, Kind(metavar="DEG±SIGMA", read=values.with_sigma, usage=True)]
MeasuredRefraction = Annotated[WithSigma, Kind(metavar="K±SIGMA", read=values.with_sigma, usage=True)]


def _read_height(text: str, name: str) -> tuple[float, float]:
    found = values.with_sigma(text, name)
    if not math.isfinite(found.value) or found.sigma == 0:
        raise InputError(f"{name} {text!r}: write meters above the ellipsoid, and their sigma, for example 12±3")
    return (found.value, 1.0 if found.sigma is None else found.sigma)


# By a reader of a room, which is loaded with it.
Aging = Annotated[float, Kind(metavar="9h:DEG,8K:DEG", read=lambda text, name: rooms.parse_aging(text, name))]
Height = Annotated[tuple[float, float], Kind(metavar="M±SIGMA", read=_read_height)]
Clock = Annotated[float, Kind(metavar="S")]

# Texts that stand for more than one number.
Distance = Annotated[float, Kind(metavar="DISTANCE", read=values.distance)]
Distances = Annotated[tuple[float, ...], Kind(metavar="M,M,...", read=values.number_list)]
Size = Annotated[tuple[int, int], Kind(metavar="WIDTHxHEIGHT", read=values.size)]


def _read_port(text: str, name: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= 65535):
        raise InputError(f"{name} {text}: a port is a number from 0 to 65535")
    return int(text)


Port = Annotated[
    int, Kind(metavar="PORT", read=_read_port, usage=True, about="Of the local address; 0 for any that is free.")
]


def _read_area(text: str, name: str) -> tuple[float, ...]:
    return values.number_list(text, name, 4, "SOUTH,WEST,NORTH,EAST in degrees, for example 44.8,5.8,45.2,6.3")


def _read_unit(text: str, name: str) -> float:
    if text not in ("mm", "cm", "m", "in"):
        raise InputError(f"{name} {text}: write mm, cm, m or in")
    return values.distance(f"1{text}", name)


Area = Annotated[tuple[float, ...], Kind(metavar="S,W,N,E", read=_read_area)]
Unit = Annotated[float, Kind(metavar="UNIT", read=_read_unit)]
Share = Annotated[float, Kind(metavar="0...1", read=values.share, usage=True)]
Name = Annotated[str, Kind(metavar="NAME")]


Times = Annotated[
    str,
    Kind(
        metavar="TIME",
        about="When (the middle of the exposure; of a video, its first frame), with its zone: 2026-11-24T20:47:26.5Z; "
        "name:Z or name:+02:00 reads it from each file's name.",
    ),
]
Time = Annotated[datetime.datetime, Kind(metavar="TIME", read=values.instant)]


class KnownPlace(NamedTuple):
    """Where a camera stands on the Earth.

    Args:
        origin: the place.
        sigma: of each axis, meters; None where that was not stated.
    """

    origin: kcal.Origin
    sigma: float | None = None


def read_place(text: str, name: str) -> KnownPlace:
    """`LAT,LON,HEIGHT`, or `LAT,LON,HEIGHT±SIGMA`."""
    lat, lon, height, sigma = values.place_on_earth(text, name)
    return KnownPlace(kcal.Origin(lat=lat, lon=lon, height=height), sigma)


Place = Annotated[KnownPlace, Kind(metavar="LAT,LON,HEIGHT[±M]", read=read_place)]


def _read_origin(text: str, name: str) -> kcal.Origin:
    known = read_place(text, name)
    if known.sigma is not None:
        raise InputError(f"{name} {text!r}: no ± is used here; write LAT,LON,HEIGHT")
    return known.origin


Site = Annotated["kcal.Origin", Kind(metavar="LAT,LON,HEIGHT", read=_read_origin)]


# Boards.


_PATTERNS = (
    "inner corners, columns by rows: 9x6 has 10x7 squares; charuco:9x6[:DICTIONARY][:MARKER]; circles:7x6; "
    "asymmetric:4x11; aprilgrid:6x6[:SPACING]; or a target file of Kalibr, april.yaml."
)
Board = Annotated[str, Kind(metavar="BOARD", setting=True, about=f"I{_PATTERNS[1:]}")]
BoardOrAuto = Annotated[str, Kind(metavar="BOARD", setting=True, about=f"auto: the images tell. Otherwise {_PATTERNS}")]
Square = Annotated[
    str,
    Kind(
        metavar="LENGTH",
        setting=True,
        about="Side of a square or tag, or distance of circles (of rows of asymmetric ones), with its unit: 25mm, "
        "2.5cm, 1in. Not with a target file.",
    ),
]
# The names of `kcal.corners.refine.Refinement`.
RefineMethod = Annotated[
    Literal["erf", "saddle", "opencv", "skimage", "none"],
    Kind(metavar="METHOD", about="erf (most accurate), saddle, opencv, skimage or none."),
]


Needs = Annotated[
    tuple[Any, ...],
    Kind(metavar="RANGE:ERROR", read=lambda text, _: kcal.report.Requirement.parse(text), setting=True),
]


_SETTING = "NAME=NUMBER, for example focus=3.2"


def _read_setting(text: str, name: str) -> tuple[str, WithSigma]:
    setting, value = values.named(text, name, _SETTING)
    return setting, values.with_sigma(value, f"{name} {setting}")


def _read_settings(text: str, name: str) -> tuple[str, tuple[float, ...]]:
    setting, value = values.named(text, name, _SETTING)
    return setting, values.number_list(value, f"{name} {setting}", form=_SETTING)


def _read_fixed(text: str, name: str) -> tuple[str, float | None]:
    key, equals, value = (part.strip() for part in text.partition("="))
    return key, values.number_list(value, f"{name} {key}", 1, "NAME or NAME=NUMBER")[0] if equals else None


def _read_prior(text: str, name: str) -> tuple[str, tuple[float, float]]:
    key, value = values.named(text, name, form := "NAME=VALUE±SIGMA, for example fx=1600±5")
    mean, sigma = values.with_sigma(value, f"{name} {key}")
    if sigma is None:
        raise InputError(f"{name} {text!r}: write {form}")
    return key, (mean, sigma)


Setting = Annotated[dict[str, WithSigma], Kind(metavar="NAME=NUMBER[±SIGMA]", read=_read_setting)]
Settings = Annotated[dict[str, tuple[float, ...]], Kind(metavar="NAME=NUMBER", read=_read_settings)]
Fixed = Annotated[dict[str, float | None], Kind(metavar="NAME[=VALUE]", read=_read_fixed)]
Prior = Annotated[dict[str, tuple[float, float]], Kind(metavar="NAME=VALUE±SIGMA", read=_read_prior)]


# Files that are read: what they must be.
RigFile = Annotated[Path, inputs.RIG]
AnyCamera = Annotated[str, inputs.ANY_CAMERA]
CameraFile = Annotated[Path, inputs.CAMERA]
CalibratedCamera = Annotated[Path, inputs.CALIBRATED]
Observed = Annotated[Path, Kind(metavar="OBS.json"), inputs.OBSERVATIONS]
Marks = Annotated[Path, Kind(metavar="CSV"), inputs.MARKS]
Survey = Annotated[Path, Kind(metavar="CSV"), inputs.SURVEY]
Table = Annotated[Path, Kind(metavar="CSV"), inputs.TABLE]
Sites = Annotated[Path, Kind(metavar="CSV"), inputs.SITES]
Images = Annotated[str, Kind(metavar="IMAGES"), inputs.IMAGES]
AnyFile = Annotated[str, inputs.CAMERA_OR_RIG]
ForeignFile = Annotated[str, inputs.FOREIGN]
History = Annotated[Path, Kind(metavar="CSV")]
Videos = Annotated[list[str], inputs.VIDEO]
Raster = Annotated[Path, Kind(metavar="RASTER")]

# Files that are written. A name that no picture can have is refused before anything is computed.


Output = Annotated[Path, Kind(flags=("-o", "--output"))]
NewFile = Annotated[Path, Kind(flags=("-o", "--output"), writes=True)]
Picture = Annotated[
    Path,
    Kind(
        metavar="FILE",
        read=lambda text, _: check_picture(text),
        early=True,
        writes=True,
        about="Picture to write (.png, .svg or .pdf): {}",
    ),
]
