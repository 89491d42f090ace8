"""The one-page summary: pictures inside, nothing from outside, text as text."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import numpy as np
import pytest

from kcal.errors import FileError, InputError
from kcal.io.images import write_png
from kcal.report.pages import Part, save_summary, summary_page


def test_pictures_are_inside_and_nothing_is_fetched(tmp_path: Path) -> None:
    picture = write_png(tmp_path / "a.png", np.full((4, 6), 128, np.uint8))
    part = Part(heading="P", pictures=((picture, "gray"),))
    page = save_summary(tmp_path / "s.html", "T", "Lead", [part]).read_text()
    (inside,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert base64.b64decode(inside) == picture.read_bytes()
    assert re.findall(r"(?:src|href)=\"(?!data:)", page) == []
    assert "http" not in page


def test_text_is_text() -> None:
    nasty = '<script>alert("1")</script> & more'
    part = Part(heading=nasty, text=(nasty,), table=((nasty, "m"), ("gate", nasty)), code=nasty)
    page = summary_page(nasty, nasty, [part])
    assert "<script" not in page
    assert page.count("&lt;script&gt;") == 8  # title twice, lead, heading, paragraph, two cells, command
    assert page.count("<tr>") == 2


def test_what_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    Path(tmp_path, "a.txt").write_text("no picture")
    with pytest.raises(InputError, match="neither a PNG nor a JPEG"):
        summary_page("t", "l", [Part(heading="h", pictures=((tmp_path / "a.txt", ""),))])
    with pytest.raises(FileError):
        summary_page("t", "l", [Part(heading="h", pictures=((tmp_path / "none.png", ""),))])
    with pytest.raises(InputError, match="different lengths"):
        summary_page("t", "l", [Part(heading="h", table=(("a", "b"), ("c",)))])
