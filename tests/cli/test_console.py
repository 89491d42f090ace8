"""The command line itself: what it prints, settings, refusals, and its start."""

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import typer
from board_render import homography, render
from calibrate_scenes import BOARD, camera, corner_pixels, observe, pixels_of
from command_line import Command, invoked, ran
from locate_rigs import pinhole_rig
from rich.console import Console
from typer.main import get_command

from kcal import Board, Camera, FileError, Observations, View, load_rig, save_camera, save_rig
from kcal.cli.console import err, out, print_styled, print_table, print_wrote, steps, warn
from kcal.cli.main import app, main, usage_errors_shown
from kcal.cli.options import SETTINGS, defaults_of, read_settings, toml_text
from kcal.files import read_bytes, replaced, write_atomic, written_files
from kcal.texts import visible
from scripts.bench.hybrid_time import helps, measure, on_terminal

# What reaches the terminal is shown and does nothing else; errors are one line.


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


def test_an_error_shows_the_name_of_a_file_as_it_is(tmp_path: Path, command: Command) -> None:
    path = tmp_path / ESCAPE
    path.write_text("{}")
    shown = command("bake", path, "-o", tmp_path / "x.npz", code=1).err
    assert shown.startswith("error: ")
    assert "not a kcal file" in shown
    assert "\x1b" not in shown
    # A program reads it on the standard output.
    told, again = command("bake", path, "-o", tmp_path / "x.npz", "--json", code=1)
    assert json.loads(told)["exit_code"] == 1
    assert again == shown == f"error: {visible(json.loads(told)['error'])}\n"


@pytest.mark.parametrize("arguments", [[ESCAPE], ["bake", f"--{ESCAPE}"], ["bake", "camera.json", ESCAPE]])
def test_a_wrong_use_shows_what_was_typed(
    arguments: list[str], command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    shown = "".join(command(*map(Path, arguments), code=2))  # a path is one word
    assert not any(c in shown for c in "\x1b\x07\x9b\x85")
    assert r"\x1b]0;title\x07" in shown


def test_a_message_about_wrong_use_is_cleaned_of_itself() -> None:
    """Older versions of Typer repeat what was typed as it is."""
    with pytest.raises(typer.BadParameter) as caught, usage_errors_shown():
        raise typer.BadParameter(ESCAPE)
    assert caught.value.format_message() == r"Invalid value: a\x1b]0;title\x07\x1b[2J\x9b31m\x85:bomb:"


def test_kcal_s_own_styles_stay_and_brackets_are_none() -> None:
    assert err.render_str("[red]x[/]").plain == "[red]x[/]"
    screen = Console(file=io.StringIO(), force_terminal=True, color_system="standard", markup=False)
    print_styled("error: [red]x[/]\x1b", "^error:", "red", to=screen)
    assert screen.file.getvalue() == "\x1b[31merror:\x1b[0m [red]x[/]\\x1b\n"


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


def test_a_pipe_is_an_error_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.png")
    assert "not a regular file" in command.refuses("detect pipe.png --board 9x6 --square 25mm -o x.json")


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "interrupted; nothing was written"), (2, "written and kept: 0.png, 1.png"), (5, "kept: 2 other files, 2.png")],
)
def test_an_interruption_says_what_was_kept(
    count: int, words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Command
) -> None:
    def detect(*_: object, **__: object) -> None:
        for number in range(count):
            write_atomic(f"{number}.png", b"")
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    Path("a.png").touch()
    monkeypatch.setattr("kcal.corners.images.expand_images", detect)
    assert words in command("detect a.png --board 9x6 --square 25mm -o a.obs.json", code=130).err.replace("\n", "")


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("export plain.json -o out.yaml", "out.yaml"),
        ("import plain.json -o out.json", "out.json"),
        ("diff left.json left.json --picture out.png", "out.png"),
        ("board --board 9x6 --square 25mm -o out.svg", "out.svg"),
        ("budget --picture out.png", "out.png"),
    ],
)
def test_a_file_is_replaced_with_a_word(line: str, name: str, start_folder: Path, command: Command) -> None:
    with contextlib.chdir(start_folder):
        Path(name).unlink(missing_ok=True)
        found = command(line)
        assert "replaced" not in found.out + found.err
        found = command(line)
        assert (found.out + found.err).count("replaced") == 1
        assert name in next(row for row in (found.out + found.err).splitlines() if "replaced" in row)


def test_what_goes_on_from_a_file_replaces_nothing(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_atomic(tmp_path / name, name)
    with written_files() as written:
        read_bytes(tmp_path / "a")
        for name in ("a", "b", "b", "d", "d"):
            write_atomic(tmp_path / name, "new")
        assert [replaced(tmp_path / name) for name in "abcd"] == [False, True, False, False]
    assert {path.name: anew for path, anew in written.items()} == {"a": False, "b": True, "d": False}
    # What one command has read, the next one may replace.
    with written_files() as written:
        write_atomic(tmp_path / "a", "new")
    assert list(written.values()) == [True]


@pytest.mark.parametrize("command", ["show none.json", "calibrate none.obs.json -o a.camera.json", "report none.json"])
def test_a_missing_file_is_refused_before_torch_is_loaded(command: str, tmp_path: Path) -> None:
    code = "import sys; from kcal.cli.main import main\ntry: main()\nfinally: print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code, *command.split()], cwd=tmp_path, capture_output=True, text=True)
    assert found.returncode == 1
    assert "cannot read: No such file" in found.stderr
    assert found.stdout.strip() == "False"


# `kcal.toml`, the noise of marks by one name, options by their old names, and short help.


ASSETS = Path(__file__).parents[2] / "assets"

EXAMPLE = {"board": "9x6", "square": "25mm", "source": "camera:0", "site": "1,2,3", "heading": 4.0,
           "pixel_sigma": 0.2, "require": "5km:10%", "baseline": 12.5}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(ASSETS / "sample-rig.json", "rig.json")
    shutil.copyfile(ASSETS / "sample-points.csv", "points.csv")
    return tmp_path


def test_what_is_written_is_read(folder: Path) -> None:
    assert set(EXAMPLE) == set(SETTINGS)
    words = [word for key, value in EXAMPLE.items() for word in (f"--{key.replace('_', '-')}", str(value))]
    invoked("init", *words)
    assert read_settings(folder) == EXAMPLE
    with pytest.raises(FileError, match="kcal init --force"):
        raise ran("init").exception or AssertionError
    invoked("init", "--force")
    assert read_settings(folder) == {}


def test_odd_texts_survive(folder: Path) -> None:
    odd = {"source": 'C:\\"a"\n\t\x07é'}
    Path("kcal.toml").write_text(toml_text(odd), encoding="utf-8")
    assert read_settings(folder) == odd


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bord = '9x6'", "unknown key 'bord'; did you mean board"),
        ("board = 9", 'board must be a text in quotation marks, for example board = "9x6"'),
        ("pixel_sigma = '0.1'", "pixel_sigma must be a number"),
        ("pixel_sigma = nan", "pixel_sigma must be a number"),
        ("baseline = true", "baseline must be a number"),
        ("board = ", "not TOML"),
        ("a = " + 5000 * "[", "not TOML"),
    ],
)
def test_what_is_not_understood_is_refused(text: str, message: str, folder: Path) -> None:
    Path("kcal.toml").write_text(text)
    with pytest.raises(FileError, match=r"kcal\.toml: ") as refused:
        raise ran("budget").exception or AssertionError
    assert message in str(refused.value)


def test_which_commands_take_a_setting() -> None:
    def takers(defaults: dict[str, Any], key: str) -> set[str]:
        nested = [one for one in defaults.items() if isinstance(one[1], dict)]
        return {f"{name} {more}".strip() for name, own in nested for more in takers(own, key)} | (
            {""} if not isinstance(defaults.get(key, {}), dict) else set()
        )

    found = defaults_of(EXAMPLE, get_command(app))
    boards, judging = {"detect", "capture", "board print", "batch"}, {"calibrate", "report", "rig solve"}
    assert {key: takers(found, key) for key in EXAMPLE} == {
        "board": boards, "square": boards, "source": {"capture"}, "require": judging,
        "site": {"locate", "live", "view"}, "heading": {"locate", "live", "view"},
        "baseline": {"calibrate", "report", "budget"},
        "pixel_sigma": {*judging, "check", "rig check", "mark", "locate", "live", "budget", "station", "sites", "view"},
    }  # fmt: skip


def test_commands_take_what_is_not_typed_and_say_so(folder: Path) -> None:
    Path("kcal.toml").write_text(toml_text({"board": "9x6", "square": "25mm", "pixel_sigma": 0.25}))
    printed = ran("board", "-o", "board.svg")
    assert "board.svg: 9x6 inner corners, 25 mm squares" in printed.stdout
    assert "from kcal.toml: board 9x6, square 25mm" in printed.stderr
    printed = ran("board", "-o", "board.svg", "--board", "7x4")
    assert "board.svg: 7x4 inner corners, 25 mm squares" in printed.stdout
    assert "from kcal.toml: square 25mm\n" in printed.stderr
    assert "0.354 px" in ran("budget").stdout


def test_the_file_of_a_folder_above_is_used_and_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("kcal.toml").write_text(toml_text({"board": "9x6", "square": "25mm", "source": "frames"}))
    Path("shots", "left").mkdir(parents=True)
    monkeypatch.chdir("shots/left")
    printed = ran("board", "-o", "board.svg")
    assert "board.svg: 9x6 inner corners, 25 mm squares" in printed.stdout
    assert "from ../../kcal.toml: board 9x6, square 25mm\n" in printed.stderr
    # Folders are named from where the file is.
    assert read_settings()["source"] == "../../frames"
    assert read_settings(folder)["source"] == "frames"
    # The nearest file alone counts.
    Path("../kcal.toml").write_text("bord = 1")
    with pytest.raises(FileError, match=r"^\.\./kcal\.toml: unknown key"):
        read_settings()
    Path("../kcal.toml").write_text("bord")
    with pytest.raises(FileError, match=r"kcal init \.\. --force"):
        read_settings()
    # What lies beyond the root of a file system belongs to others.
    monkeypatch.setattr("os.path.ismount", lambda path: path == folder / "shots" / "left")
    assert read_settings() == {}


def test_the_position_of_a_rig_goes_before_that_of_the_folder(folder: Path) -> None:
    plain = ran("locate", "rig.json", "points.csv").stdout
    Path("kcal.toml").write_text(toml_text({"site": "1,2,3", "heading": 4.0}))
    printed = ran("locate", "rig.json", "points.csv")
    assert printed.stdout == plain
    assert "that in its file, not that in kcal.toml" in printed.stderr
    assert ran("locate", "rig.json", "points.csv", "--site", "1,2,3", "--heading", "4").stdout != plain


def test_the_noise_of_marks_is_that_of_the_rig(folder: Path) -> None:
    assert load_rig("rig.json").calibration.pixel_sigma == 0.1
    stated = ran("locate", "rig.json", "points.csv")
    assert "noise of marks: 0.1 px, from the rig's file" in stated.stderr
    assert stated.stdout == ran("locate", "rig.json", "points.csv", "--pixel-sigma", "0.1").stdout
    assert stated.stdout != ran("locate", "rig.json", "points.csv", "--pixel-sigma", "0.3").stdout
    assert "noise of marks: 0.3 px, assumed; --pixel-sigma states it" in ran("budget").stderr
    assert "noise of marks: 0.1 px, from the rig's file" in ran("budget", "rig.json").stderr
    assert "noise of marks 0.1 px along each axis" in ran("show", "rig.json").stdout


@pytest.mark.parametrize("words", [["calibrate"], ["rig", "solve"], ["locate"], ["live"]])
def test_help_is_short_and_help_all_is_whole(words: list[str]) -> None:
    command = get_command(app)
    for word in words:
        command = command.commands[word]
    names = {param.opts[0]: param.hidden for param in command.params if param.opts[0].startswith("-")}
    short, whole = ran(*words, "--help").stdout, ran(*words, "--help-all").stdout
    assert sum(not hidden for hidden in names.values()) <= 12
    assert "--help-all shows" in short
    for name, hidden in names.items():
        row = rf"│ +(\* +)?(--\w+ +)?{name[:18]}"
        assert bool(re.search(row, short)) != hidden, name
        assert re.search(row, whole), name
    assert ran(*words, "--help").stdout == short


def test_help_all_of_a_short_command_is_its_help() -> None:
    assert ran("show", "--help-all").stdout == ran("show", "--help").stdout


# Which large libraries a command loads: `--help` and `show` none, others only what they compute with.


SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"

PIXELS = tuple((100.0 + 50.0 * column, 100.0 + 50.0 * row) for row in range(3) for column in range(4))


@pytest.fixture(scope="module")
def start_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    start_folder = tmp_path_factory.mktemp("startup")
    save_camera(load_rig(SAMPLE).left, start_folder / "left.json")
    plain = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.01, 0, 0])
    save_camera(plain, start_folder / "plain.json", name="plain")
    views = (View(name="a.png", pixels=PIXELS),)
    Observations(board=Board(columns=4, rows=3, square=0.1), image_size=(640, 480), views=views).save(
        start_folder / "seen.json"
    )
    return start_folder


@pytest.mark.slow
def test_help_loads_no_large_library(tmp_path: Path) -> None:
    assert len(helps()) > 20
    code = """import contextlib, io
from kcal.cli.main import app
for words in {}:
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        app(words)"""
    _, _, loaded = measure([], tmp_path, code.format(helps()))
    assert loaded == []


def test_show_loads_no_large_library(start_folder: Path) -> None:
    code = """from kcal.cli.main import app
for name in {}:
    try:
        app(['show', name])
    except SystemExit as ended:
        assert not ended.code, name"""
    names = ["left.json", "plain.json", "seen.json", str(SAMPLE)]
    _, failed, loaded = measure([], start_folder, code.format(names))
    assert (failed, loaded) == (0, [])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "libraries"),
    [
        ("board --board charuco:9x6 --square 25mm -o board.svg", "cv2"),
        ("diff left.json left.json", "torch"),
        ("export plain.json -o plain.yaml", "cv2 torch"),
        (f"report {SAMPLE}", "torch"),
        (f"locate {SAMPLE} {SAMPLE.with_name('sample-points.csv')}", "pyproj torch"),
        ("budget", "torch"),
    ],
)
def test_a_command_loads_what_it_computes_with_and_no_more(line: str, libraries: str, start_folder: Path) -> None:
    _, code, loaded = measure(line.split(), start_folder)
    assert code in (0, 3)
    assert loaded == libraries.split()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_terminal_shows_that_a_command_works_and_then_no_more_of_it(start_folder: Path) -> None:
    shown = on_terminal(["diff", "left.json", "left.json"], start_folder)
    assert shown.code == 0
    # Long before what it computes with is loaded, and the command line itself.
    assert shown.text.startswith("kcal ...\r")
    assert shown.first < 0.2 * shown.seconds
    before, _, after = shown.text.partition("difference at infinity")
    assert "kcal diff" in before
    assert "kcal diff" not in after.rpartition("\x1b[2K")[2]
    # JSON is not written beside it, nor help below it.
    shown = on_terminal(["budget", "--json"], start_folder)
    assert json.loads(shown.text.rpartition("\x1b[2K")[2])["exit_code"] == 0
    help_text = on_terminal(["budget", "--help"], start_folder).text
    assert "kcal budget  0:" not in help_text
    assert "kcal ..." not in help_text
    # Nor is any of it in what others capture.
    command = [sys.executable, "-m", "kcal", "diff", "left.json", "left.json"]
    done = subprocess.run(command, cwd=start_folder, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\x1b" not in done.stdout


@pytest.mark.parametrize(
    ("modules", "without"),
    [
        ("kcal.mark.server, kcal.mark.marking_service", {"kornia", "matplotlib", "scipy.stats", "skimage"}),
        ("kcal.capture.session, kcal.calibrate.camera.calibrate", {"matplotlib", "scipy", "pyproj", "skimage"}),
        ("kcal.corners.detect", {"kornia", "matplotlib", "scipy", "pyproj", "skimage"}),
    ],
)
@pytest.mark.slow
def test_long_commands_do_not_wait_for_what_they_may_never_use(modules: str, without: set[str], tmp_path: Path) -> None:
    _, code, loaded = measure([], tmp_path, f"import {modules}")
    assert code == 0
    assert "torch" in loaded
    assert not without & set(loaded)


def test_what_is_stored_is_what_is_computed(start_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("left.json", "plain.json", str(SAMPLE)):
        stored = ran("show", start_folder / name).output
        with monkeypatch.context() as patch:
            patch.setattr("kcal.cli.show._as_written", lambda content: None)
            assert ran("show", start_folder / name).output == stored


def test_a_file_that_was_changed_is_computed_anew(start_folder: Path) -> None:
    content = json.loads((start_folder / "plain.json").read_text())
    assert "focal length 800.000 px" in ran("show", start_folder / "plain.json").output
    content["intrinsics"] |= {"fx": 900.0, "fy": 900.0}
    (start_folder / "changed.json").write_text(json.dumps(content))
    assert "focal length 900.000 px" in ran("show", start_folder / "changed.json").output


# Data that are refused: each refusal names what is wrong, and ends with a command that can be pasted.


COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]

PLACES = ["a,0,100,0,0.02", "b,30,120,5,0.02", "c,-30,140,-5,0.02", "d,10,200,3,0.02"]

RIG = "rig left.camera.json right.camera.json -o rig.json --site 19,72,0"

FEW = "kcal capture camera:0 --board 7x6 --square 50mm -o"

SEEN = "kcal detect images/ --board 7x6 --square 50mm -o"

MARK = "kcal mark left.png right.png"

TWICE = "rig left.camera.json left.camera.json -o rig.json --pairs"

CIRCLES = "--board circles:8x6 --square 25mm"

PAIRS = "rig left.camera.json right.camera.json -o rig.json --pairs"


@pytest.fixture(scope="module")
def refusal_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    here = tmp_path_factory.mktemp("refused")
    pixels = corner_pixels(12, 1, noise=0.05)
    observe(pixels[:2]).save(here / "few.obs.json")
    wild = pixels.clone()
    wild[::2] = wild[::2][:, torch.randperm(42, generator=torch.Generator().manual_seed(0))]
    observe(wild).save(here / "wild.obs.json")
    places = torch.tensor([[-0.15 + 0.02 * i, -0.12, 0.6] for i in range(6)]).double()
    flat = pixels_of(camera("pinhole"), (torch.eye(3).double().expand(6, 3, 3), places))
    observe(flat).save(here / "flat.obs.json")
    for name in ("a", "b"):
        (here / name).mkdir()
        observe(pixels).save(here / name / "left.obs.json")
    observe(pixels[:, :30], board=Board(columns=6, rows=5, square=0.05)).save(here / "other.obs.json")
    observe(pixels, names=[f"x{chr(97 + i)}" for i in range(12)]).save(here / "named.obs.json")
    save_rig(pinhole_rig(), here / "placeless.json")
    for side, focal in (("left", 500.0), ("right", 510.0)):
        save_camera(camera("opencv5", focal), here / f"{side}.camera.json", name=side)
    (here / "survey.csv").write_text("\n".join(["name,east,north,up,sigma", *PLACES]))
    (here / "marks.csv").write_text("name,left_u,left_v,right_u,right_v\na,1,2,3,4\nb,5,6,7,8\nc,9,9,9,9")
    (here / "far.csv").write_text("name,left_u,left_v,right_u,right_v\na,100,200,900,200")
    image, _ = render(
        Board(columns=7, rows=6, square=0.02), (640, 480), homography(BOARD, (640, 480), 40), supersample=2
    )
    cv2.imwrite(str(here / "board.png"), image)
    cv2.imwrite(str(here / "blank.png"), np.full((480, 640), 128, np.uint8))
    page = np.full((480, 640), 240, np.uint8)
    for number in range(42):
        cv2.circle(page, (120 + 65 * (number % 7), 80 + 65 * (number // 7)), 18, 20, -1, cv2.LINE_AA)
    cv2.imwrite(str(here / "circles.png"), page)
    return here


@pytest.mark.parametrize(
    ("line", "named", "cure"),
    [
        ("calibrate few.obs.json -o x.json", "2 views", f"{FEW} few.obs.json"),
        ("calibrate flat.obs.json -o x.json", "tilted", f"{FEW} flat.obs.json"),
        ("calibrate wild.obs.json -o x.json --model opencv5", "v0", f"{SEEN} wild.obs.json"),
        ("calibrate a/left.obs.json b/left.obs.json -o x", "both named left", "mv b/left.obs.json b/b-left.obs.json"),
        (f"{RIG} --landmarks survey.csv", "belong together", f"{MARK} --cameras left.camera.json"),
        (f"{RIG} --landmarks survey.csv --marks marks.csv", "left", f"{MARK} --cameras left.camera.json"),
        (f"{RIG} --baseline 10.02", "baseline", "10.02±0.005"),
        (f"{RIG} --positions survey.csv", "positions", "left, right"),
        (f"{RIG} --stars blank.png board.png", "--stars", "kcal stars blank.png --camera left.camera.json"),
        (f"{PAIRS} a/left.obs.json other.obs.json", "different boards", f"{SEEN} a/left.obs.json"),
        (f"{PAIRS} a/left.obs.json named.obs.json", "v00", f"{SEEN} a/left.obs.json"),
        (f"{TWICE} a/left.obs.json b/left.obs.json", "the same camera", f"{SEEN} a/left.obs.json"),
        ("locate placeless.json far.csv --site 0,0,0 --heading 0", "far.csv", f"{MARK} --rig placeless.json"),
        ("detect board.png --board 9x6 --square 25mm -o x.json", "7x6", "kcal detect board.png --board 7x6 --square"),
        (f"detect circles.png {CIRCLES} -o x.json", "42 circles", "kcal detect circles.png --board circles:7x6"),
        ("detect blank.png --board 9x6 --square 25mm -o x.json", "blank.png", "kcal board --board 9x6 --square 25mm"),
    ],
)
def test_it_ends_with_a_command(
    line: str, named: str, cure: str, refusal_folder: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.chdir(refusal_folder)
    said = command(line, code=1).err.splitlines()[-1]
    assert said.startswith("error: ")
    assert named in said
    assert cure in said
    assert not list(refusal_folder.glob("x.*"))
    assert ("kcal " in said) == cure.startswith("kcal ")
    if cure.startswith("kcal "):
        # Its options and arguments are those of the command.
        name, *words = shlex.split(said[said.rindex("kcal ") :])[1:]
        words = ["print", *words] if name == "board" else words
        COMMANDS[name].make_context(name, words, resilient_parsing=False)
