"""Summaries and the reason of a verdict."""

import base64
import math
import re
from pathlib import Path

import numpy as np
import pytest

import kcal
from kcal.errors import FileError, InputError
from kcal.finding import FAULTS, KINDS, Finding
from kcal.io.images import write_png
from kcal.report.pages import save_summary, verdict_page
from kcal.report.verdict import RangeAnswer, Requirement, Verdict, weighed_findings

# The one reason of a verdict, and the next step: those of the largest contribution to what misses a requirement.


MARKS = "mark targets more accurately"

STRUCTURE = Finding(
    name="model", severity="stop", text="residuals are not noise", action="check the board", part=FAULTS
)

SLIGHT = Finding(name="model", severity="doubt", text="it bends", action="measure the board", part=FAULTS)

TILT = Finding(name="tilt", severity="stop", text="no tilted views", action="tilt the board", part="lenses")

MIRRORED = Finding(name="mirrored", severity="stop", text="all views are mirrored", action="switch it off")


def answer(meters: float, **parts: float) -> RangeAnswer:
    named = {name.replace("_", " "): part for name, part in parts.items()}
    return RangeAnswer(requirement=Requirement(distance=5000.0, meters=meters), parts=named)


def verdict(given: RangeAnswer, *findings: Finding, advice: tuple[str, ...] = ()) -> Verdict:
    return Verdict(subject="left", answers=(given,), findings=weighed_findings(findings, [given]), advice=advice)


def faults(meters: float, marks: float, lenses: float, beyond: float) -> RangeAnswer:
    parts = {"marks": marks, "lenses": lenses, FAULTS: beyond}
    return RangeAnswer(requirement=Requirement(distance=5000.0, meters=meters), parts=parts)


def test_marks_are_the_reason_where_they_are_most_of_the_error() -> None:
    found = verdict(faults(500.0, 1983.0, 40.0, 0.0), STRUCTURE, advice=("show the board in the corners",))
    assert not found.usable
    assert found.reason.endswith("most of it is from marks")
    assert found.next_step.startswith(MARKS)
    # The fault is still told, and forbids the use by itself.
    assert found.stops == (STRUCTURE,)
    assert verdict(faults(500.0, 100.0, 40.0, 0.0), STRUCTURE).reason == STRUCTURE.text


def test_a_fault_is_a_reason_only_where_it_breaks_the_requirement() -> None:
    # Without it the range would be missed all the same.
    small = verdict(faults(500.0, 1900.0, 40.0, 30.0), SLIGHT)
    assert [finding.severity for finding in small.findings] == ["doubt"]
    assert small.next_step.startswith(MARKS)
    # It is most of the error.
    large = verdict(faults(500.0, 600.0, 40.0, 900.0), SLIGHT)
    assert (large.reason, large.next_step) == (SLIGHT.text, SLIGHT.action)
    # It is not most of it, but without it the requirement would be met.
    assert [finding.severity for finding in verdict(faults(500.0, 400.0, 40.0, 350.0), SLIGHT).findings] == ["stop"]
    assert verdict(faults(1000.0, 400.0, 40.0, 350.0), SLIGHT).usable


def test_the_next_picture_belongs_to_the_reason() -> None:
    lenses = answer(100.0, marks=30.0, lenses=400.0)
    assert verdict(lenses, advice=("show the board at the top",)).next_step == "show the board at the top"
    assert verdict(lenses, TILT, advice=("show the board at the top",)).next_step == TILT.action
    assert verdict(lenses, TILT).reason.endswith(f"most of it is from lenses: {TILT.text}")
    pose = verdict(answer(100.0, marks=30.0, relative_pose=400.0), TILT, advice=("show the board at the top",))
    assert "most of it is from relative pose" in pose.reason
    assert pose.next_step.startswith("mark more far features")


def test_error_bars_that_nobody_can_believe_come_first() -> None:
    found = verdict(faults(500.0, 1983.0, 40.0, 0.0), TILT, MIRRORED)
    assert (found.reason, found.next_step) == (MIRRORED.text, MIRRORED.action)


def test_a_yes_tells_of_doubts() -> None:
    assert "nothing was found that forbids its use; no" in Verdict(subject="left").reason
    assert Verdict(subject="left", findings=(SLIGHT,)).but == "with 1 doubt"
    doubted = Verdict(subject="left", findings=(SLIGHT, SLIGHT))
    assert (doubted.but, doubted.to_dict()["doubts"]) == ("with 2 doubts", 2)
    # Beside the answer, above all else; a no says what stands against it.
    assert 'YES<a href="#findings">with 2 doubts</a></p>' in verdict_page(doubted)
    assert Verdict(subject="left", findings=(SLIGHT, TILT)).but == ""


def test_lines_for_the_screen_and_for_notebooks() -> None:
    nasty = Finding(name="depth", severity="note", text="at 2 m <b>\x1b[2J", cameras=("left",))
    needs = answer(100.0, marks=30.0, lenses=400.0), answer(500.0, marks=30.0, lenses=40.0)
    found = Verdict(subject="rig", answers=needs, findings=(SLIGHT, TILT, nasty), basis="by simulation")
    assert found.lines([SLIGHT]) == [
        "found:", f"  {TILT.title}: {TILT.sentence}", "left:", f"  distances: {nasty.text}", "ranges by simulation:",
        f"  missed: {needs[0].text}",
        f"  met: {needs[1].text}", f"NO: {found.reason}", f"next: {found.next_step}",
    ]  # fmt: skip
    assert "found:\n  lens model: it bends; measure the board\n" in found._repr_html_()
    assert "at 2 m &lt;b&gt;\\x1b[2J" in found._repr_html_()
    (answered,) = (fine := Verdict(subject="left", answers=needs[1:])).answers
    assert fine.lines()[1:] == [f"YES: {answered.text}"]


def test_what_is_not_known_is_no_yes() -> None:
    given = answer(500.0, marks=10.0, lenses=math.inf)
    assert not given.ranged
    assert not given.ok
    assert given.text == "at 5 km no range can be told; 10 % are required"


def test_what_would_improve_a_yes_is_against_most_of_its_error() -> None:
    advice = ("show the board at the top",)
    assert verdict(answer(500.0, marks=100.0, lenses=20.0), advice=advice).improvement.startswith(MARKS)
    assert verdict(answer(500.0, marks=10.0, lenses=20.0), advice=advice).improvement == advice[0]
    assert Verdict(subject="left", advice=advice).improvement == advice[0]


def test_findings_are_called_by_words() -> None:
    """Names are for programs: people read what a finding is about, on the screen and on the page."""
    names = {
        name
        for module in Path(kcal.__file__).parent.rglob("*.py")
        for name in re.findall(r'(?:Finding|doubt)\(\s*"([\w-]+)"', module.read_text(encoding="utf-8"))
    }
    assert {"halves", "tilt", "patterns", "coverage", "roll", "bending", "place", "swapped", "stars"} <= names
    assert names <= set(KINDS)
    titles = {name: Finding(name=name, severity="fine", text="").title for name in names}
    assert not any("-" in title for title in titles.values())
    assert titles["halves"] == "check by halves of the views"
    assert titles["coverage"] == "coverage"
    # Each about another thing, but two ways to find out that there are two cameras.
    assert len(set(titles.values())) == len(titles) - 1
    assert titles["names"] == titles["changed"] == "two cameras"
    page = verdict_page(Verdict(subject="left", findings=(Finding(name="halves", severity="doubt", text="t"),)))
    assert "<b>check by halves of the views</b>" in page


# The one-page summary: pictures inside, nothing from outside, text as text.


def summary(folder: Path, *, pictures: bool = True, **values: object) -> str:
    """The page of a demonstration on pairs, with a gray picture at each place."""
    for name in ("map", "left", "right") if pictures else ():
        write_png(folder / f"{name}.png", np.full((4, 6), 128, np.uint8))
    given = {"table": [["a"], ["b"]], "command": "kcal", "residuals": "RMS", "pairs": 3, "baseline": "1 m"} | values
    return save_summary(folder / "s.html", "demo_pairs_page", folder=folder, **given).read_text()


def test_pictures_are_inside_and_nothing_is_fetched(tmp_path: Path) -> None:
    page = summary(tmp_path)
    inside = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert [base64.b64decode(one) for one in inside] == [(tmp_path / "map.png").read_bytes()] * 3
    assert re.findall(r"(?:src|href)=\"(?!data:)", page) == []
    assert "http" not in page


def test_text_is_text(tmp_path: Path) -> None:
    nasty = '<script>alert("1")</script> & more'
    page = summary(tmp_path, table=[[nasty, "m"], ["gate", nasty]], command=nasty, residuals=nasty, baseline=nasty)
    assert "<script" not in page
    assert page.count("&lt;script&gt;") == 5
    assert page.count("<tr>") == 2


def test_what_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError):
        summary(tmp_path, pictures=False)
    (tmp_path / "map.png").write_text("no picture")
    with pytest.raises(InputError, match="neither a PNG nor a JPEG"):
        summary(tmp_path, pictures=False)
