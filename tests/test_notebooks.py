"""The notebooks run anywhere, show what is stored in them, and become pages."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from scripts.docs_site import notebook_page
from scripts.make_notebooks import FOLDER, executed

NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
IDS = [path.stem for path in NOTEBOOKS]


def shown(notebook: Any) -> list[list[str]]:
    """What each cell shows, without digits and the blanks after them: another processor's last digits differ."""
    found = []
    for cell in notebook["cells"]:
        texts = []
        for output in cell.get("outputs", ()):
            data = output.get("data", {"text": output.get("text")})
            texts += sorted(data)
            texts += [re.sub(r"[\d.]+ *", "#", "".join(data.get(kind, ""))) for kind in ("text", "text/plain")]
        found.append(texts)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=IDS)
def test_a_notebook_runs_and_shows_what_is_stored(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KCAL_DATA", raising=False)
    assert shown(executed(path)) == shown(json.loads(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=IDS)
def test_a_notebook_is_small_and_names_no_machine(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text) < 1_500_000
    outputs = [output for cell in json.loads(text)["cells"] for output in cell.get("outputs", ())]
    assert all(output["output_type"] != "error" for output in outputs)
    assert re.findall(r"(?<![\w./<])/(?:home|tmp|work|root|usr|Users)\b[^\s\"]*", json.dumps(outputs)) == []
    assert "stderr" not in {output.get("name") for output in outputs}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=IDS)
def test_a_notebook_becomes_a_page(path: Path) -> None:
    page, pictures = notebook_page(path)
    assert page.startswith("# ")
    assert len(pictures) >= 1
    assert all(data.startswith(b"\x89PNG") for data in pictures.values())
    assert sorted(set(re.findall(rf"{path.stem}-\d+\.png", page))) == sorted(pictures)
    assert "base64" not in page
    assert page.count("```") % 2 == 0


def test_notebooks_are_there() -> None:
    assert IDS == ["one-camera", "rig-to-map", "training"]
