"""Texts of other people's files are shown and do nothing else."""

import csv
import io
import json
import sys
import xml.etree.ElementTree as ET

import pytest

from kcal.texts import csv_line, one_line, page_data, page_policy, page_text, visible


def test_no_control_character_reaches_a_terminal() -> None:
    shown = visible("".join(map(chr, range(0x100))) + "\u202egnp.exe\u2028\udcff")
    assert [c for c in shown if (ord(c) < 0x20 or 0x7F <= ord(c) < 0xA0) and c not in "\n\t"] == []
    assert r"\x1b" in shown
    assert r"\x9b" in shown
    assert r"\u202egnp.exe\u2028\udcff" in shown
    assert visible("Ørsted 山 °±∞ – “é”") == "Ørsted 山 °±∞ – “é”"
    assert one_line("a\tb\nc\r") == r"a\tb\nc\r"


def test_every_character_can_stand_in_xml() -> None:
    everything = "".join(map(chr, range(sys.maxunicode + 1)))
    for text in (everything[: 1 << 16], everything[1 << 16 :]):
        element = ET.Element("name", label=visible(text))
        element.text = visible(text)
        assert ET.fromstring(ET.tostring(element, encoding="utf-8")).text == visible(text)


@pytest.mark.parametrize("name", ["=1+1", "+cmd", "-2+3", "@SUM(A1)", "\t=1", "\r=1", " =1", "\n=1", "=", "＝1"])
def test_no_cell_is_a_formula(name: str) -> None:
    (row,) = csv.reader(io.StringIO(csv_line([name, "x"])))
    assert row[0].strip()[0] in "'\\"
    assert row[1] == "x"


def test_cells_read_back() -> None:
    cells = ["gate", 'a "quoted", one', "two\nlines", "a;=1", "-5", "+5.25", "-", ""]
    text = csv_line(cells)
    (row,) = csv.reader(io.StringIO(text, newline=""))
    assert row == [*cells[:6], "'-", ""]
    assert '"a;=1"' in text
    (row,) = csv.reader(io.StringIO(csv_line([0.1 + 0.2, -1e-300, float("inf"), 7, True, None])))
    assert row == ["0.30000000000000004", "-1e-300", "inf", "7", "True", ""]


def test_page_texts_cannot_leave_their_place() -> None:
    name = "<!--<script></script>]]>&\u2028\"'"
    data = page_data({"name": name})
    assert not set("<>&") & set(data)
    assert json.loads(data) == {"name": name}
    assert not set("<>\"'") & set(page_text(name))


def test_policy_names_what_may_run() -> None:
    policy = page_policy(scripts=["alert(1)"], images="data:")
    # echo -n 'alert(1)' | openssl dgst -sha256 -binary | base64
    assert "script-src 'sha256-bhHHL3z2vDgxUt0W3dWQOrprscmda2Y5pLsLg4GF+pI='" in policy
    assert "style-src 'none'" in policy
    assert "unsafe" not in policy
