"""What other operating systems and other packages of OpenCV do, where it is decided in kcal."""

import faulthandler
import importlib
import io
import os
import signal
import sys
import types
from pathlib import Path

import pytest

from kcal import FileError, KcalError, files, threads
from kcal import __main__ as program


class WindowsLocks(types.ModuleType):
    """As Windows' `msvcrt`: a byte of a file that is locked through another handle cannot be locked."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        super().__init__("msvcrt")
        self.held: dict[tuple[int, int], int] = {}

    def locking(self, handle: int, mode: int, count: int) -> None:
        assert (mode, count) == (self.LK_NBLCK, 1)
        assert os.lseek(handle, 0, os.SEEK_CUR) > 200  # where nobody reads who holds it
        if self.held.setdefault((os.fstat(handle).st_dev, os.fstat(handle).st_ino), handle) != handle:
            raise PermissionError(13, "Permission denied")


@pytest.fixture
def windows_locks(monkeypatch: pytest.MonkeyPatch) -> WindowsLocks:
    locks = WindowsLocks()
    monkeypatch.setattr(files, "_fcntl", None)
    monkeypatch.setattr(files, "_msvcrt", locks)
    monkeypatch.setattr(files, "PARTS_ARE_LOCKED", False)
    return locks


class TestWindows:
    def test_a_locked_file_says_who_has_it(self, tmp_path: Path, windows_locks: WindowsLocks) -> None:
        first = files.FileLock([tmp_path / "a.csv"], "kcal live")
        with pytest.raises(FileError, match=rf"kcal live, process {os.getpid()}, since .* writes it"):
            files.FileLock([tmp_path / "a.csv"], "kcal watch")
        first.release()
        assert list(tmp_path.iterdir()) == []
        windows_locks.held.clear()  # Windows does so when the handle is closed
        files.FileLock([tmp_path / "a.csv"], "kcal watch").release()

    @pytest.mark.usefixtures("windows_locks")
    def test_a_file_is_replaced_as_a_whole(self, tmp_path: Path) -> None:
        path = files.write_atomic(tmp_path / "a.txt", "1")
        with pytest.raises(ZeroDivisionError), files.open_atomic(path) as file:
            file.write(b"2" * (1 // 0))
        assert path.read_text(encoding="utf-8") == "1"
        assert [one.name for one in tmp_path.iterdir()] == ["a.txt"]

    def test_too_much_work_is_ended_by_the_clock(self, monkeypatch: pytest.MonkeyPatch) -> None:
        calls: list[object] = []
        monkeypatch.delattr(signal, "setitimer", raising=False)
        monkeypatch.setattr(faulthandler, "dump_traceback_later", lambda seconds, **how: calls.append((seconds, how)))
        monkeypatch.setattr(faulthandler, "cancel_dump_traceback_later", lambda: calls.append("canceled"))
        with threads.work_limit(3.0):
            [(seconds, how)] = calls
        assert (seconds, how["exit"], calls[1]) == (3.0, True, "canceled")  # type: ignore[index]

    def test_children_start_where_no_signal_can_be_blocked(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delattr(signal, "pthread_sigmask", raising=False)
        with threads.deaf_to_interrupts():
            pass


@pytest.mark.parametrize(("screen", "shown"), [(False, "± σ é"), (True, "± ? é")])
def test_a_pipe_gets_utf_8_and_a_screen_what_it_can_show(
    monkeypatch: pytest.MonkeyPatch, screen: bool, shown: str
) -> None:
    """Python's encoding on Windows, cp1252, has no σ."""
    data = io.BytesIO()
    out = io.TextIOWrapper(data, encoding="cp1252")
    monkeypatch.setattr(data, "isatty", lambda: screen, raising=False)
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr("kcal.cli.main.main", lambda: print("± σ é", flush=True))
    monkeypatch.setattr(program.gc, "freeze", lambda: None)
    handler = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit):
            program.main()
    finally:
        signal.signal(signal.SIGINT, handler)
    assert data.getvalue().decode("cp1252" if screen else "utf-8").strip() == shown


class TestOpenCV:
    @pytest.mark.parametrize(
        ("module", "said"),
        [
            (None, r"OpenCV cannot be used \(.*cv2.*\)"),
            (types.ModuleType("cv2"), r"OpenCV cannot be used \(cv2 has no FileStorage\)"),
        ],
    )
    def test_what_is_wrong_and_what_to_remove(
        self, monkeypatch: pytest.MonkeyPatch, module: types.ModuleType | None, said: str
    ) -> None:
        installed = {"opencv-python", "opencv-contrib-python-headless"}
        monkeypatch.setattr(importlib.metadata, "distributions", lambda name: [name] if name in installed else [])
        monkeypatch.setitem(sys.modules, "cv2", module)
        monkeypatch.delitem(sys.modules, "kcal.opencv", raising=False)
        with pytest.raises(KcalError, match=said) as raised:
            importlib.import_module("kcal.opencv")
        assert str(raised.value).endswith(
            "opencv-contrib-python-headless and opencv-python are installed into the same folder; "
            "pip uninstall -y opencv-contrib-python-headless opencv-python && "
            "pip install 'opencv-contrib-python-headless>=5,<6' mends it"
        )
