"""Surveyed places as they stand in their file, so that they can be shown, added to and written again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from kcal.errors import FileError
from kcal.locate.survey import EARTH, LOCAL, PLACE_COLUMNS, places_csv, read_survey
from kcal.locate.tables import read_rows
from kcal.mark.items import Place


class SurveyedPlaces(NamedTuple):
    """Places by name, and which three columns their coordinates stand in."""

    columns: tuple[str, str, str]
    places: Mapping[str, Place]


NO_PLACES = SurveyedPlaces(EARTH, {})


def read_places(path: Path) -> SurveyedPlaces:
    """Read a survey as `kcal.locate.survey.read_survey` does, without changing its numbers.

    Raises:
        FileError: see `read_survey`; local meters in an earlier session and latitudes now.
    """
    read_survey(path)  # its checks name the line
    rows = read_rows(path, "name,lat,lon,height,sigma", PLACE_COLUMNS, ("sigma",))
    columns = EARTH if EARTH[0] in rows[0].cells else LOCAL
    if any(not row.name.isprintable() or len(row.name) > 60 for row in rows):
        raise FileError(f"{path}: a name has more than 60 characters; give it a shorter one")
    places = {}
    for row in rows:
        first, second, third = (row.number(column) for column in columns)
        places[row.name] = Place(
            at=(first, second, third), sigma=row.number("sigma"), sigma_up=row.positive("sigma_up")
        )
    return SurveyedPlaces(columns, places)


def places_text(survey: SurveyedPlaces) -> str:
    """The places as CSV that `read_survey` reads."""
    return places_csv(
        survey.columns, ([name, *place.at, place.sigma, place.sigma_up] for name, place in survey.places.items())
    )
