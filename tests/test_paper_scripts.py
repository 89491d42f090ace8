"""The scripts that make docs/measured/paper.md run, at sizes at which their figures mean nothing."""

import json
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from calibrate_scenes import camera, motions, observe, pixels_of

from kcal import CalibrationOptions
from scripts.measure import make
from scripts.paper import chain, locate, reproduce, train_eq12, train_net_lens
from scripts.paper import page as paper_page
from scripts.paper.page import TABLE_3
from scripts.shared import page
from scripts.shared.page import SECTIONS, Kept


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A page that scripts may write to."""
    monkeypatch.setattr(page, "DOCS", tmp_path)
    monkeypatch.setattr(paper_page, "DOCS", tmp_path)
    path = tmp_path / "paper.md"
    path.write_text("# Page\n", encoding="utf-8")
    return path


def ran(name: str, **given: object) -> None:
    (each,) = (each for each in SECTIONS if (each.page, each.name) == ("paper.md", name))
    make(each, given, quick=False, write=True)


@pytest.mark.slow
def test_joint_training(monkeypatch: pytest.MonkeyPatch, written: Path) -> None:
    monkeypatch.setattr(train_eq12, "MODEL", "opencv5")
    monkeypatch.setattr(train_eq12, "RATES", [1e-4, 1e-3])
    ran("eq 12", steps=5, views=6)
    rows = [line.split(" | ") for line in page.read_section("paper.md", "eq 12").splitlines()[2:-2]]
    assert [len(row) for row in rows] == 5 * [len(train_eq12.HEADS)]
    assert float(rows[2][1]) < float(rows[1][1])  # least squares ends lower than Adam
    assert float(rows[0][3]) < 0.5  # the noise is 0.28 px


@pytest.mark.slow
def test_the_network_alone(monkeypatch: pytest.MonkeyPatch, written: Path, tmp_path: Path) -> None:
    monkeypatch.setattr(train_net_lens, "RATES", [1.0, 10.0])
    ran("net lens", steps=3, lm_steps=5, seeds=1, views=4, picture=tmp_path / "steps.png")
    assert len(page.read_section("paper.md", "net lens").splitlines()) == 2 + 7 + 2
    assert (tmp_path / "steps.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_chain(monkeypatch: pytest.MonkeyPatch, written: Path, tmp_path: Path) -> None:
    truth = camera("opencv5", 1500.0, size := (1920, 1080))  # as the site's images
    seen = observe(pixels_of(truth, motions(truth, 10, 5), noise=0.1, seed=2), size=size)
    monkeypatch.setattr(chain, "observed", lambda *_: seen)
    monkeypatch.setattr(
        chain, "LENSES", dict.fromkeys(["default", chain.RESIDUAL], CalibrationOptions(model="opencv4"))
    )
    monkeypatch.setattr(chain, "by_least_squares", lambda result: train_eq12.by_least_squares(result, 3))
    file = tmp_path / "chain.jsonl"
    ran("chain", kept=Kept((file,)), captures=("a", "site glass"), lenses=("default", chain.RESIDUAL), work=tmp_path)
    records = {tuple(r["key"]): r for r in map(json.loads, file.read_text().splitlines())}
    plain, residual = records["a", "default"], records["a", chain.RESIDUAL]
    assert plain["still"] == pytest.approx(0.1 * 2**0.5, rel=0.2)
    assert (plain["lost"], residual["ratio"]) == (0, None)
    assert 0.2 < plain["ratio"] < 3.0
    assert "infinity" in records["site glass", "default"]
    text = page.read_section("paper.md", "chain")
    assert "| default | 1 of 1 | 1.00 (1.00 to 1.00) | 0 | 1 of 1 |" in text
    assert text.count("none stated") == 3  # of both captures, and in the summary


def test_halves_are_blocks_of_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neighbors are alike: a half must not judge views among those that it has seen."""
    truth = camera()
    seen = observe(pixels_of(truth, motions(truth, 8, 5), noise=0.1, seed=2))
    monkeypatch.setattr(chain, "observed", lambda *_: seen)
    fitted = Mock(return_value=(truth, 0.1))
    monkeypatch.setattr(chain, "fitted", fitted)
    chain.measured("a", "ext20", Path())
    assert [call.args[0].names for call in fitted.call_args_list] == [seen.names, seen.names[:4], seen.names[4:]]


@pytest.mark.slow
def test_the_experiment(monkeypatch: pytest.MonkeyPatch, written: Path, tmp_path: Path) -> None:
    """Every stage once; models that are left out take the results of the first one."""
    monkeypatch.setattr(reproduce, "ALL", {"14": "opencv5"})
    monkeypatch.setattr(locate, "DRAWS", 1)
    monkeypatch.setattr(locate, "MARKINGS", 1)
    real = reproduce.run_seed

    def run_seed(folder: Path, *arguments: object) -> dict:
        result = real(folder, *arguments)  # type: ignore[arg-type]
        for part in ("cameras", "located", "held_out"):
            result[part] |= {label: result[part]["14"] for label in (*TABLE_3, "hybrid")}
        return result

    monkeypatch.setattr(reproduce, "run_seed", run_seed)
    # The lens whose images are made quickest; five views, each of which is held out once.
    for name in ("split", "table 1", "table 2", "table 3", "models", "marks", "distance", "choice", "edges"):
        ran(name, work=tmp_path / "work", seeds=1, views=5, kinds=("vision",))
    kept = json.loads((tmp_path / "work" / "vision-0-5" / "result.json").read_text())
    assert kept["cameras"]["14"]["left"]["rms"] < 1.0
    assert np.isfinite(kept["located"]["OpenCV"]["range_error"]).all()
    for name in ("split", "table 3", "edges"):
        assert page.read_section("paper.md", name), name
    assert len(list(tmp_path.glob("paper-*.png"))) == 4
