import contextlib
import errno
import itertools
import multiprocessing
import os
import random
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
import torch

from kcal.errors import FileError, InputError
from kcal.locate.marks import Marks, read_marks, write_marks
from kcal.locate.survey import match_landmarks, read_survey
from kcal.mark.items import Add, Drop, Mark, Place, Put, Rename, Side, Step, SurveyPlace, Take
from kcal.mark.session import Session, pair_covariance
from scripts.shared.children import children

SURVEY = "name,lat,lon,height,sigma\npost,40.1,-113.9,1282,0.02\nroof,40.2,-113.8,1290,0.02\n"


def mark(u: float, v: float, sigma: float = 0.1, frame: str = "1") -> Mark:
    return Mark(u=u, v=v, cov=(sigma**2, 0.0, sigma**2), frame=frame)


def put(name: str, side: Side, at: Mark, matched: bool = False) -> Put:
    return Put(do="put", name=name, side=side, mark=at, matched=matched)


def work(session: Session) -> None:
    """Two landmarks, one target with a matched mark."""
    session.do(put("post", "left", mark(10.1, 20.2)), "key-0001")
    session.do(put("post", "right", mark(9.1, 20.3)), "key-0002")
    session.do(put("roof", "left", mark(110.1, 20.2)), "key-0003")
    session.do(Add(do="add", name="truck", kind="target"), "key-0004")
    session.do(put("truck", "left", mark(50.25, 60.5, 0.3)), "key-0005")
    session.do(put("truck", "right", mark(45.125, 60.75, 0.05), matched=True), "key-0006")


def kept(session: Session, survey: Path | None = None) -> Session:
    """The session that begins where this one, which ends, has ended: with the same state."""
    state = session.state
    session.close()
    again = Session(session.files.marks, survey)
    assert again.state == state
    return again


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    path = tmp_path / "survey.csv"
    path.write_text(SURVEY)
    return path


@pytest.fixture
def session(tmp_path: Path, survey: Path) -> Session:
    """With two landmarks and one target with a matched mark."""
    session = Session(tmp_path / "marks.csv", survey)
    work(session)
    return session


def test_the_files_are_those_that_rig_and_locate_read(session: Session) -> None:
    found = match_landmarks(read_survey(session.files.landmarks), read_marks(session.files.marks, single=True), 0.1)
    assert found.landmarks.names == ("post", "roof")
    assert found.landmarks.pixels[0].tolist() == [[10.1, 20.2], [9.1, 20.3]]
    assert found.landmarks.pixels[1, 1].isnan().all()
    points = read_marks(session.files.points)
    assert points.names == ("truck",)
    # The right mark was matched to the left one: it has its error too, and their difference has only the match's.
    expected = torch.block_diag(*[torch.eye(2) * 0.09] * 2).double()
    expected[:2, 2:] = expected[2:, :2] = torch.eye(2).double() * 0.09
    expected[2:, 2:] += torch.eye(2).double() * 0.0025
    torch.testing.assert_close(points.covariance[0], expected)


def test_a_killed_session_continues(tmp_path: Path, survey: Path) -> None:
    first = Session(tmp_path / "marks.csv", survey)
    work(first)
    state, texts = first.state, [path.read_text() for path in (first.files.marks, first.files.points)]
    first.close()
    # Killed between the log and the files, and while the next line was written.
    first.files.points.write_text("name,left_u,left_v,right_u,right_v\n")
    with first.files.log.open("ab") as log:
        log.write(b'{"key": "half')
    second = Session(tmp_path / "marks.csv", survey)
    assert second.state == state
    assert [path.read_text() for path in (first.files.marks, first.files.points)] == texts
    second.do(Step(do="undo"), "key-0007")
    assert second.state.items["truck"].right is None
    second.do(Step(do="redo"), "key-0008")
    assert second.state == state
    second.close()
    # What was cut off is gone: the next line did not grow onto it.
    third = Session(tmp_path / "marks.csv", survey)
    assert third.state == state
    third.close()


def test_an_action_that_is_sent_twice_is_done_once(tmp_path: Path) -> None:
    session = Session(tmp_path / "marks.csv")
    session.do(Add(do="add", name="a", kind="target"), "key-0001")
    session.do(Add(do="add", name="a", kind="target"), "key-0001")
    session.close()
    again = Session(tmp_path / "marks.csv")
    again.do(Add(do="add", name="a", kind="target"), "key-0001")
    assert list(again.state.items) == ["a"]
    with pytest.raises(InputError, match="'a' is used already"):
        again.do(Add(do="add", name="a", kind="target"), "key-0002")


def test_a_place_that_no_survey_has_is_refused(tmp_path: Path, survey: Path) -> None:
    session = Session(tmp_path / "marks.csv", survey)
    for at, complaint in (((400.0, 2.0, 3.0), "latitude"), ((1.0, 2.0, -1e308), "height")):
        with pytest.raises(InputError, match=complaint):
            session.do(SurveyPlace(do="survey", name="post", place=Place(at=at, sigma=1.0)), "key-0001")
    # Exchanged latitude and longitude: kcal rig refuses the file. The session begins again, so that they can be mended.
    for name, at in {"post": (20.0, 50.0, 1.0), "roof": (20.1, 50.0, 1.0), "hill": (50.0, 20.0, 1.0)}.items():
        session.do(SurveyPlace(do="survey", name=name, place=Place(at=at, sigma=1.0)), f"key-of-{name}")
    with pytest.raises(FileError, match="exchanged"):
        read_survey(session.files.landmarks)
    kept(session).close()


def test_undo_to_the_beginning(session: Session) -> None:
    for step in range(6):
        session.do(Step(do="undo"), f"undo-{step:04d}")
    assert all(item.left is None and item.right is None for item in session.state.items.values())
    assert set(session.state.survey) == {"post", "roof"}
    with pytest.raises(InputError, match="nothing to undo"):
        session.do(Step(do="undo"), "undo-0006")


def test_two_sessions_cannot_write_the_same_marks(tmp_path: Path) -> None:
    first = Session(tmp_path / "marks.csv")
    with pytest.raises(FileError, match="another `kcal mark`"):
        Session(tmp_path / "marks.csv")
    first.close()
    Session(tmp_path / "marks.csv").close()


def test_marks_that_were_changed_outside_are_taken_over(session: Session, tmp_path: Path, survey: Path) -> None:
    session.close()
    marks = read_marks(session.files.marks, single=True)
    write_marks(session.files.marks, Marks.of_pair(marks.names, marks.left + 1.0, marks.right, marks.covariance))
    again = Session(tmp_path / "marks.csv", survey)
    left = again.state.items["post"].left
    assert left.u == pytest.approx(11.1)
    assert again.state.items["truck"].right is not None
    again.do(Step(do="undo"), "key-0009")
    left = again.state.items["post"].left
    assert left.u == 10.1


@pytest.mark.parametrize(
    "damaged", [b"nonsense", b"\0" * 40, b"[1, 2]", b"[" * 100_000, b'{"key": "k", "action": ' + b"9" * 5000 + b"}"]
)
def test_a_damaged_line_loses_itself_alone(session: Session, tmp_path: Path, survey: Path, damaged: bytes) -> None:
    """Whatever stands in its place: noise, zeros, JSON of another kind, a nest, a number of 5,000 digits."""
    state = session.state
    session.close()
    lines = session.files.log.read_bytes().splitlines(keepends=True)
    added = next(i for i, line in enumerate(lines) if b'"truck"' in line)
    # Even where a thing was added: its marks bring it back.
    session.files.log.write_bytes(b"".join([*lines[:added], damaged + b"\n", *lines[added + 1 :]]))
    again = Session(tmp_path / "marks.csv", survey)
    assert again.state == state
    assert f"line {added + 1} is damaged and was left out" in again.notes[0]
    again.do(put("post", "left", mark(99.0, 1.0)), "key-later")
    again.close()
    kept = Session(tmp_path / "marks.csv", survey)
    assert kept.state.items["post"].left == mark(99.0, 1.0)
    kept.close()


def test_the_only_line_may_be_the_damaged_one(tmp_path: Path) -> None:
    session = Session(tmp_path / "marks.csv")
    session.close()
    with session.files.log.open("ab") as log:
        log.write(b"nonsense\n")
    again = Session(tmp_path / "marks.csv")
    again.do(Add(do="add", name="a", kind="target"), "key-0001")
    again.close()
    # A head that was damaged loses nothing either.
    lines = session.files.log.read_bytes().splitlines(keepends=True)
    session.files.log.write_bytes(b"".join([b"nonsense\n", *lines[1:]]))
    assert list(Session(tmp_path / "marks.csv").state.items) == ["a"]


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "marks.log").write_text("something else\nand more\n")
    with pytest.raises(FileError, match="give another -o"):
        Session(tmp_path / "marks.csv")
    assert (tmp_path / "marks.log").read_text() == "something else\nand more\n"


class FullDisk:
    """Takes so many more bytes of the log, and then none: `os.write` writes a part first, as it may."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, left: int) -> None:
        self.left, self._write = left, os.write
        monkeypatch.setattr("kcal.mark.session.os.write", self.write)

    def write(self, file: int, data: bytes) -> int:
        if not self.left:
            self.refuse()
        written = self._write(file, data[: self.left])
        self.left -= written
        return written

    def refuse(self, *_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("left", [0, 1, 50, 10**9])
def test_a_full_disk_loses_nothing_that_was_acknowledged(
    session: Session, survey: Path, monkeypatch: pytest.MonkeyPatch, left: int
) -> None:
    before, log, version = session.state, session.files.log.read_bytes(), session.version
    with monkeypatch.context() as patched:
        disk = FullDisk(patched, left)
        if left == 10**9:
            patched.setattr("kcal.mark.session.os.fsync", disk.refuse)
        for number in range(3):
            with pytest.raises(FileError, match="the disk is full; this was not done"):
                session.do(put("post", "left", mark(77.0, 1.0)), f"key-full{number}")
    assert (session.state, session.files.log.read_bytes(), session.version) == (before, log, version)
    # Ten marks afterwards, of which the first is one that was refused.
    for number in range(10):
        session.do(put("post", "left", mark(float(number), 1.0)), f"key-full{number}")
    assert kept(session, survey).notes == []


def test_nothing_is_left_where_even_cutting_off_fails(
    session: Session, survey: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    def failing(*_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    whole = os.ftruncate
    with monkeypatch.context() as patched:
        FullDisk(patched, 30)
        calls: list[int] = []

        def once(file: int, length: int) -> None:
            calls.append(length)
            (whole if len(calls) == 1 else failing)(file, length)

        patched.setattr("kcal.mark.session.os.ftruncate", once)
        for number in range(2):
            with pytest.raises(FileError, match="cannot write"):
                session.do(put("post", "left", mark(77.0, 1.0)), f"key-full{number}")
    session.do(put("post", "left", mark(88.0, 1.0)), "key-good")
    assert kept(session, survey).notes == []


def test_tables_that_a_full_disk_did_not_take_are_written_later(
    session: Session, tmp_path: Path, survey: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = session.files.marks.read_text()

    def full(path: Path, text: str) -> None:
        error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        raise FileError(f"{path}: cannot write: {error.strerror}") from error

    with monkeypatch.context() as patched:
        patched.setattr("kcal.mark.session.write_atomic", full)
        for number in range(3):
            session.do(put("post", "left", mark(float(number), 1.0)), f"key-later{number}")
        assert "the disk is full" in session.trouble
        assert str(session.files.log) in session.trouble
        after = session.state
        session.close()
    assert session.files.marks.read_text() == old
    # Tables that are three actions behind are no work of somebody else.
    again = Session(tmp_path / "marks.csv", survey)
    assert again.state == after
    assert again.trouble == ""
    assert "was behind" in again.notes[0]
    assert read_marks(session.files.marks, single=True).left[0].tolist() == [2.0, 1.0]


@pytest.mark.skipif(sys.platform == "win32", reason="the limit is one of POSIX")
def test_a_limit_of_the_system_is_a_full_disk(session: Session, survey: Path) -> None:
    """As with `ulimit -f`: the kernel writes a part of a line and refuses the rest."""
    import resource

    before = session.state
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (session.files.log.stat().st_size + 20, limits[1]))
    try:
        for number in range(20):
            with pytest.raises(FileError, match="the disk is full"):
                session.do(put("post", "left", mark(5.0, 1.0)), f"key-full{number}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert session.state == before
    session.do(put("post", "left", mark(5.0, 1.0)), "key-full0")
    kept(session, survey)


def test_marks_of_a_target_are_of_one_moment(tmp_path: Path, survey: Path) -> None:
    session = Session(tmp_path / "marks.csv", survey)
    session.do(Add(do="add", name="truck", kind="target"), "key-0001")
    session.do(put("truck", "left", mark(1, 2, frame="1")), "key-0002")
    with pytest.raises(InputError, match="of one moment"):
        session.do(put("truck", "right", mark(1, 2, frame="2")), "key-0003")
    session.do(put("post", "left", mark(1, 2, frame="1")), "key-0004")
    session.do(put("post", "right", mark(1, 2, frame="2")), "key-0005")


def test_a_match_that_ends_keeps_its_whole_error(session: Session) -> None:
    session.do(put("truck", "left", mark(50.0, 60.0, 0.02)), "key-0007")
    assert session.state.items["truck"].right.cov[0] == pytest.approx(0.3**2 + 0.05**2)
    assert float(pair_covariance(session.state.items["truck"])[0, 2]) == 0.0


def test_names_places_and_removals(session: Session) -> None:
    session.do(Rename(do="rename", name="post", to="hill, west", kind="landmark"), "key-0007")
    session.do(SurveyPlace(do="survey", name="well", place=Place(at=(40.15, -113.85, 1280.0), sigma=0.05)), "key-0008")
    session.do(Take(do="take", name="roof", side="left"), "key-0009")
    assert read_marks(session.files.marks, single=True).names == ("hill, west",)
    assert read_survey(session.files.landmarks).names == ("hill, west", "roof", "well")
    session.do(Drop(do="drop", name="truck"), "key-0010")
    assert session.files.points.read_text().count("\n") == 1
    with pytest.raises(InputError, match="nothing is named 'truck'"):
        session.do(Drop(do="drop", name="truck"), "key-0011")


def mark_for_ever(path: Path, turn: int, answered: Connection) -> None:
    session = Session(path)
    for number in itertools.count():
        name = f"{turn}-{number}"
        session.do(Add(do="add", name=name, kind="target"), f"add-{name}")
        session.do(put(name, "left", mark(number, 1.0)), f"left-{name}")
        session.do(put(name, "right", mark(number, 2.0)), f"right-{name}")
        answered.send_bytes(name.encode())


@pytest.mark.skipif(sys.platform == "win32", reason="children are of POSIX")
def test_what_was_answered_survives_a_kill_at_any_moment(tmp_path: Path) -> None:
    """A child marks as fast as it can and tells what was answered; it is killed ten times, also within a write."""
    moments, answered = random.Random(0), []
    for turn in range(10):
        reading, writing = multiprocessing.Pipe(duplex=False)
        child = children().Process(target=mark_for_ever, args=(tmp_path / "marks.csv", turn, writing))
        child.start()
        writing.close()
        answered.append(reading.recv_bytes().decode())
        time.sleep(moments.uniform(0.0, 0.1))
        child.kill()
        child.join()
        with contextlib.suppress(EOFError):
            while True:
                answered.append(reading.recv_bytes().decode())
        reading.close()
        session = Session(tmp_path / "marks.csv")
        points = read_marks(session.files.points)
        session.close()
        found = dict(zip(points.names, points.pixels.tolist(), strict=True))
        assert {name: found.get(name) for name in answered} == {
            name: [[float(name.partition("-")[2]), 1.0], [float(name.partition("-")[2]), 2.0]] for name in answered
        }
    assert len(answered) >= 10


@pytest.mark.parametrize(
    ("how", "zoom", "sigma"),
    [
        ("hand", None, 0.3),
        ("hand", 6.0, 0.3),
        ("hand", 0.24, 1 / 0.24),
        # Closer than half of what a click reaches, a shape is the one that was meant.
        ("corner", 1.0, 0.3),
        ("corner", 0.24, 1 / 0.24),
    ],
)
def test_a_click_is_known_to_one_pixel_of_the_screen(
    tmp_path: Path, how: str, zoom: float | None, sigma: float
) -> None:
    session = Session(tmp_path / "marks.csv")
    session.do(Add(do="add", name="a", kind="feature"), "key-0001")
    clicked = mark(10.0, 20.0, 0.3).model_copy(update={"how": how})
    session.do(Put(do="put", name="a", side="left", mark=clicked, zoom=zoom), "key-0002")
    session.do(put("a", "right", mark(9.0, 20.0)), "key-0003")
    left = session.state.items["a"].left
    assert left is not None
    assert left.sigma == pytest.approx(sigma)
    assert (left.u, left.v, left.how) == (10.0, 20.0, how)
    assert float(read_marks(session.files.marks).sigmas(0.3)[0, 0]) == pytest.approx(sigma)
    kept(session).close()


def test_names_of_targets_fill_the_list(tmp_path: Path, survey: Path) -> None:
    targets = tmp_path / "targets.csv"
    targets.write_text("name,mark\nbuoy,the top\ngate,left post\npost,a landmark already\n")
    session = Session(tmp_path / "marks.csv", survey, targets=targets)
    kinds = {name: item.kind for name, item in session.state.items.items()}
    assert kinds == {"post": "landmark", "roof": "landmark", "buoy": "target", "gate": "target"}
    assert session.undoable == (False, False)
    session.do(put("buoy", "left", mark(1.0, 2.0)), "key-0001")
    state = session.state
    session.close()
    # What is marked stays; only new names are added, and undoing does not take them back.
    targets.write_text("name\nbuoy\nyawl\n")
    again = Session(tmp_path / "marks.csv", survey, targets=targets)
    assert list(again.state.items) == [*state.items, "yawl"]
    assert again.state.items["buoy"] == state.items["buoy"]
    again.do(Step(do="undo"), "key-0002")
    assert list(again.state.items) == [*state.items, "yawl"]
    assert again.state.items["buoy"].left is None
    again.close()
    # A name is a name, not a header.
    targets.write_text("buoy\nyawl\n")
    with pytest.raises(FileError, match=r"targets\.csv.*name"):
        Session(tmp_path / "other.csv", targets=targets)
