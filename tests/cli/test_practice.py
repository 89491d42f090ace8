"""`kcal demo --practice` and `--score`: a folder that is filled, continued, never written over; a stranger's walk."""

import json
import shlex
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from command_line import ran

import kcal.cli.demo_practice
import kcal.io.images
from kcal import FileError
from kcal.cli.demo_practice import STEPS, TRUTH, next_step, night_name, practice_score, practice_site
from kcal.mark.items import Add, Mark, Put, Side
from kcal.mark.session import Session
from kcal.report.practice_score import score_positions, score_tracks

# Marks of a practice site from its truth with noise, through the session that `kcal mark` keeps.

SIDES: tuple[Side, Side] = ("left", "right")


def mark_practice(folder: Path, sigma: float = 0.3, seed: int = 0) -> None:
    """Mark all landmarks and targets as somebody would by hand, with Gaussian noise of `sigma` pixels."""
    truth = json.loads((folder / ".truth" / "truth.json").read_text())
    random = np.random.default_rng(seed)
    session = Session(folder / "marks.csv", folder / "survey.csv", sigma)
    try:
        for name in truth["targets"]:
            session.do(Add(do="add", name=name, kind="target"), f"add {name}")
        for name, pixels in truth["marks"].items():
            seen = np.array(pixels).reshape(2, 2) + sigma * random.standard_normal((2, 2))
            for side, (u, v) in zip(SIDES, seen.tolist(), strict=True):
                mark = Mark(u=u, v=v, cov=(sigma**2, 0.0, sigma**2), frame="0", how="hand")
                session.do(Put(do="put", name=name, side=side, mark=mark), f"{name} {side}")
    finally:
        session.close()


pytest.importorskip("av", reason="the extra `video` is not installed")
FRAMES = 4


def make(folder: Path, seed: int = 1) -> None:
    practice_site(folder, seed, views=2, frames=FRAMES, scale=0.25)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("practice") / "site"
    make(folder)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "site"))


@pytest.mark.slow
def test_stars_say_how_the_camera_looks(made: Path) -> None:
    pytest.importorskip("erfa", reason="the extra `stars` is not installed")
    assert (made / "night" / night_name("left")).exists()
    assert night_name("left") in (made / "README.txt").read_text()


def test_other_folders_are_refused(folder: Path, tmp_path: Path) -> None:
    before = contents(folder)
    with pytest.raises(FileError, match=r"the site of seed 1; give --seed 1"):
        make(folder, 2)
    assert contents(folder) == before
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "thesis.tex").write_text("years")
    with pytest.raises(FileError, match="other files"):
        make(tmp_path / "work")
    assert [path.name for path in (tmp_path / "work").iterdir()] == ["thesis.tex"]
    with pytest.raises(FileError, match=r"no practice site.*kcal demo --practice"):
        practice_score(tmp_path / "work")


@pytest.mark.slow
def test_an_interrupted_run_is_continued(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is there is kept, what is missing is made, and nothing is left torn."""

    def interrupt(at: int) -> None:
        images = iter(range(at))

        def encode(*arguments: Any, whole: Any = kcal.io.images.encode_png) -> bytes:
            if next(images) == at - 1:
                raise KeyboardInterrupt
            return bytes(whole(*arguments))

        with monkeypatch.context() as patch:
            patch.setattr(kcal.io.images, "encode_png", encode)
            with pytest.raises(KeyboardInterrupt):
                make(site)

    site, first = tmp_path / "site", contents(made)
    interrupt(1)
    assert set(contents(site)) == {str(TRUTH), "README.txt", "survey.csv", "targets.csv", "find_ships.py"}
    # As if it had gone on for longer.
    shutil.copytree(made, site, dirs_exist_ok=True)
    for number in ("01", "02"):
        (site / "boards" / "right" / f"{number}.png").unlink()
    (site / "survey.csv").write_text("mine")
    interrupt(2)
    assert set(first) - set(contents(site)) == {"boards/right/02.png"}
    make(site)
    assert "wrote 1 files" in capsys.readouterr().out
    assert contents(site) == {**first, "survey.csv": b"mine"}


def test_what_comes_next_is_said_step_by_step(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    practice_score(folder)
    said = capsys.readouterr().out
    assert "kcal detect boards/left --board 9x6 --square 60mm -o left.obs.json" in said
    for step in STEPS:
        assert next_step(folder) == step
        for name in step.makes:
            (folder / name).touch()
    assert next_step(folder) is None
    # Marks may have other names; positions and tracks do not stand for each other.
    for name in ("marks.csv", "left.obs.json"):
        (folder / name).unlink()
    assert next_step(folder) is None
    (folder / "positions.geojson").unlink()
    assert next_step(folder) == STEPS[4]


@pytest.mark.slow
def test_without_the_extra_for_videos_the_rest_is_made(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "video" / "left.mp4").unlink()
    (folder / "survey.csv").unlink()
    monkeypatch.setattr("kcal.io.images.write_video", Mock(side_effect=ImportError(name="av")))
    make(folder)
    said = capsys.readouterr()
    assert "wrote 1 files" in said.out
    assert "video/left.mp4 needs av, which is not installed: pip install 'kcal[video]'" in said.err
    assert (folder / "survey.csv").exists()


def test_options_that_exclude_each_other(tmp_path: Path) -> None:
    assert ran("demo", "--practice", tmp_path / "a", "--score", tmp_path / "a").exit_code == 2
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
def test_the_walk_of_a_stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All commands of README.txt; marks are made from the truth with 0.3 px of noise, in the session of `kcal mark`."""
    folder = tmp_path / "site"
    practice_site(folder, 1, views=8, frames=24, scale=0.5)
    monkeypatch.chdir(folder)
    readme = Path("README.txt").read_text()
    for step in STEPS:
        if step.name == "mark":
            mark_practice(folder)
            continue
        for command in step.commands:
            assert command in readme
            done = ran(*shlex.split(command)[1:], catch_exceptions=False)
            assert done.exit_code == 0, done.output
    done = ran("demo", "--score", ".", catch_exceptions=False)
    assert "All steps are done." in done.output
    truth = json.loads(TRUTH.read_text())
    scores = score_positions(Path("positions.geojson"), truth).records
    assert len(scores) == 7
    # Of seven intervals of 95 %, five or more contain the truth in 99.6 % of cases.
    assert sum(score["contains"] for score in scores) >= 5
    assert abs(scores[0]["range_off_m"]) < 5.0
    ships, _ = score_tracks(Path("tracks.csv"), truth)
    assert max(ship["followed"] for ship in ships.records) > 0.5
