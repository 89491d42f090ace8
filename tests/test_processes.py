"""No process with threads forks, none of ours leaves threads to one that does, and no test waits for ever."""

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from multiprocessing import forkserver
from pathlib import Path

import numpy as np
import pytest

from scripts.shared.children import children

ROOT = Path(__file__).parents[1]
_SUSPECT = re.compile("fork|multiprocessing|ProcessPool")
WAITING = """
import subprocess, sys, threading, time

def test_lock():
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()

def test_child():
    subprocess.run([sys.executable, "-c", "import time; time.sleep(600)"])

def test_work():
    end = time.process_time() + 1.2
    while time.process_time() < end:
        pass

def test_work_of_a_child():
    subprocess.run([sys.executable, "-c", "import time\\nwhile time.process_time() < 1.2: pass"], check=True)
"""
# A user's program: videos are open, threads have worked, and the workers of torch are forked.
LOADER = """
import gc, sys, threading, torch, cv2, numpy as np, scipy.linalg
from kcal.threads import Handover
from kcal.pipeline.video_source import file_frames
from kcal.threads import one_thread
from pathlib import Path

size = (320, 240)
frames = file_frames(Path(sys.argv[1]), size)
next(frames).colors()
running = Handover(file_frames(Path(sys.argv[1]), size), 1, waits=True)
next(iter(running)).gray()
cv2.GaussianBlur(np.zeros((2000, 2000), np.uint8), (9, 9), 2.0)
torch.ones(900, 900) @ torch.ones(900, 900)
scipy.linalg.lstsq(np.eye(900), np.ones(900))

class Data(torch.utils.data.Dataset):
    def __len__(self):
        return 4

    def __getitem__(self, k):
        global frames, running
        frames = running = None
        gc.collect()
        with one_thread():
            scipy.linalg.lstsq(np.eye(900), np.ones(900))
            torch.ones(900, 900) @ torch.ones(900, 900)
        return k

loader = torch.utils.data.DataLoader(Data(), num_workers=2, multiprocessing_context="fork")
print(sorted(int(k) for batch in loader for k in batch))
running.close()
"""


def forks(tree: ast.Module) -> Iterator[str]:
    """What in a module forks this process."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute | ast.Name):
            name = node.attr if isinstance(node, ast.Attribute) else node.id
            if name in ("fork", "forkpty"):
                yield f"{node.lineno}: {name}"
        if isinstance(node, ast.Call):
            where = node.func.value if isinstance(node.func, ast.Attribute) else None
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            values = [value.value for value in ast.walk(node) if isinstance(value, ast.Constant)]
            if name in ("get_context", "set_start_method") and (not node.args or "fork" in values):
                yield f"{node.lineno}: {name}"
            module = where is not None and ast.unparse(where) in ("multiprocessing", "mp")
            if name == "ProcessPoolExecutor" and not any(key.arg == "mp_context" for key in node.keywords):
                yield f"{node.lineno}: {name} with the default start method"
            if name in ("Process", "Pool", "Manager") and module:
                yield f"{node.lineno}: {name} with the default start method"
        if isinstance(node, ast.ImportFrom) and node.module in ("multiprocessing", "multiprocessing.pool"):
            for name in {alias.name for alias in node.names} & {"Process", "Pool", "Manager"}:
                yield f"{node.lineno}: {name} with the default start method"


def test_nothing_forks() -> None:
    found = []
    for path in (path for folder in ("kcal", "scripts", "tests") for path in sorted((ROOT / folder).rglob("*.py"))):
        text = path.read_text(encoding="utf-8")
        found += [
            f"{path.relative_to(ROOT)}:{what}" for what in forks(ast.parse(text if _SUSPECT.search(text) else ""))
        ]
    assert found == []


@pytest.mark.parametrize(
    "code",
    [
        "os.fork()", "from os import fork\nfork()", "pty.fork()", "multiprocessing.get_context('fork')",
        "from multiprocessing import Pool",
        "multiprocessing.set_start_method('fork')", "multiprocessing.Process(target=f)", "get_context().Pool()",
        "concurrent.futures.ProcessPoolExecutor(2)",
    ],
)  # fmt: skip
def test_what_forks_is_seen(code: str) -> None:
    assert list(forks(ast.parse(code)))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="work is read from /proc")
def test_a_test_that_waits_is_ended_and_one_that_works_is_not(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text((ROOT / "tests/conftest.py").read_text())
    (tmp_path / "test_waiting.py").write_text(WAITING)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), str(tmp_path)],
        env=os.environ | {"KCAL_WAIT": "1.0", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )
    for name in ("test_lock", "test_child"):
        assert f"Waiting: test_waiting.py::{name}: nothing has worked for 1 s" in done.stdout, done.stdout
    assert "2 failed, 2 passed" in done.stdout, done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
def test_children_come_of_a_server_without_threads() -> None:
    child = children().Process(target=os.getcwd)
    child.start()
    child.join()
    assert child.exitcode == 0
    assert len(os.listdir(f"/proc/{forkserver._forkserver._forkserver_pid}/task")) == 1


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("av", reason="the extra `video` is not installed")
    from video_scenes import SIZE, write_video

    images = [np.full(SIZE[::-1], k, np.uint8) for k in range(30)]
    return write_video(tmp_path_factory.mktemp("video") / "a.mp4", images, [k / 25 for k in range(30)])


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
def test_an_open_video_has_no_threads(video: Path) -> None:
    from kcal.pipeline.video_source import file_frames

    before = len(os.listdir("/proc/self/task"))
    frame = next(file_frames(video, (320, 240)))
    colors, gray = frame.colors(), frame.gray()
    assert colors.shape[:2] == gray.shape == (240, 320)
    assert len(os.listdir("/proc/self/task")) == before


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="workers of torch are forked")
def test_a_user_s_process_may_fork(video: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", LOADER, str(video)],
        env=environment | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )
    assert done.stdout == "[0, 1, 2, 3]\n", done.stderr
