"""What reaches the terminal is shown and does nothing else; errors are one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner
from waiting import PATIENCE

from kcal.cli.console import err, out, print_table, print_wrote, steps, warn
from kcal.cli.main import app, main, usage_errors_shown
from kcal.files import write_atomic

ESCAPE = "a\x1b]0;title\x07\x1b[2J\x9b31m\x85:bomb:"


def test_no_escape_sequence_reaches_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    print_table([["name"], [ESCAPE], ["two\nlines"]])
    out.print(ESCAPE, markup=False)
    out.print(f"[bold]{ESCAPE}[/]")
    print_wrote(Path(ESCAPE))
    warn(ESCAPE)
    with steps("searching", 1) as advance:
        advance(ESCAPE)
    shown = "".join(capsys.readouterr())
    assert not any(c in shown for c in "\x1b\x07\x9b\x85")
    assert shown.count(r"a\x1b]0;title\x07\x1b[2J\x9b31m\x85:bomb:") == 5
    assert r"two\nlines" in shown


def test_an_error_shows_the_name_of_a_file_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / ESCAPE
    path.write_text("{}")
    monkeypatch.setattr(sys, "argv", ["kcal", "bake", str(path), "-o", str(tmp_path / "x.npz")])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert exit_.value.code == 1
    shown = capsys.readouterr().err
    assert shown.startswith("error: ")
    assert "not a kcal file" in shown
    assert "\x1b" not in shown


@pytest.mark.parametrize(
    "arguments",
    [
        [ESCAPE],
        ["bake", f"--{ESCAPE}"],
        ["bake", "camera.json", ESCAPE],
    ],
)
def test_a_wrong_use_shows_what_was_typed(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["kcal", *arguments])
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as exit_:
        main()
    assert exit_.value.code == 2
    shown = "".join(capsys.readouterr())
    assert not any(c in shown for c in "\x1b\x07\x9b\x85")
    assert r"\x1b]0;title\x07" in shown


def test_a_message_about_wrong_use_is_cleaned_of_itself() -> None:
    """Older versions of Typer repeat what was typed as it is."""
    with pytest.raises(typer.BadParameter) as caught, usage_errors_shown():
        raise typer.BadParameter(ESCAPE)
    assert caught.value.format_message() == r"Invalid value: a\x1b]0;title\x07\x1b[2J\x9b31m\x85:bomb:"


def test_the_library_s_own_colors_stay() -> None:
    assert err.render_str("[red]x[/]").spans[0].style == "red"


@pytest.mark.parametrize(
    "arguments",
    [
        ["bake", "a" * 300],
        ["bake", "camera.json", "-o", "a" * 300 + ".npz"],
        ["detect", "a" * 300, "--board", "9x6", "--square", "25mm", "-o", "x.json"],
        ["detect", "x.png", "--board", "9x6", "--square", "25mm", "-o", "a" * 300],
        ["detect", "x.png", "--board", "9x6", "--square", "25mm", "-o", "x.json", "--keep", "a" * 300],
        ["batch", "a" * 300, "--board", "9x6", "--square", "25mm", "-o", "out"],
        ["batch", ".", "--board", "9x6", "--square", "25mm", "-o", "a" * 300],
        ["locate", "a" * 300, "b" * 300],
        ["locate", "rig.json", "marks.csv", "-o", "a" * 300 + ".csv"],
        ["calibrate", "a" * 300, "-o", "x.json"],
        ["rectify", "a" * 300, "x.png", "-o", "b" * 300],
        ["compare", "a" * 300, "b" * 300],
        ["board", "a" * 300 + ".pdf", "--board", "9x6", "--square", "25mm"],
        ["budget", "a" * 300],
        ["rig", "a" * 300, "b" * 300, "-o", "c" * 300],
        ["demo", "a" * 300],
    ],
    ids=lambda arguments: " ".join(arguments)[:40],
)
def test_long_names_are_errors_of_one_line(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["kcal", *arguments])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert exit_.value.code in (1, 2)
    assert len([line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]) <= 1


def test_a_pipe_is_an_error_at_once(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe.png")
    done = subprocess.run(
        [sys.executable, "-m", "kcal", "detect", str(tmp_path / "pipe.png"), "--board", "9x6", "--square", "25mm",
         "-o", str(tmp_path / "x.json")],
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "not a regular file" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "interrupted; nothing was written"), (2, "written and kept: 0.png, 1.png"), (5, "kept: 2 other files, 2.png")],
)
def test_an_interruption_says_what_was_kept(
    count: int, words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def detect(*_: object, **__: object) -> None:
        for number in range(count):
            write_atomic(f"{number}.png", b"")
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    Path("a.png").touch()
    monkeypatch.setattr("kcal.corners.images.expand_images", detect)
    found = CliRunner().invoke(app, ["detect", "a.png", "--board", "9x6", "--square", "25mm", "-o", "a.obs.json"])
    assert found.exit_code == 130
    assert words in found.stderr.replace("\n", "")


@pytest.mark.parametrize("command", ["show none.json", "calibrate none.obs.json -o a.camera.json", "report none.json"])
def test_a_missing_file_is_refused_before_torch_is_loaded(command: str, tmp_path: Path) -> None:
    code = "import sys; from kcal.cli.main import main\ntry: main()\nfinally: print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code, *command.split()], cwd=tmp_path, capture_output=True, text=True)
    assert found.returncode == 1
    assert "cannot read: No such file" in found.stderr
    assert found.stdout.strip() == "False"
