import hashlib
import os
import threading
import time

import cv2
import pytest
from board_render import homography, render

from kcal.corners import detect as module
from kcal.corners.board import Board
from kcal.corners.detect import detect
from kcal.corners.time_limit import Limited, TookTooLongError
from kcal.errors import InputError
from kcal.threads import UNSTOPPABLE

BOARD = Board(columns=6, rows=5, square=0.02)
found_by_the_library = module.detect_board


def busy(seconds):
    """Work for so much processor time, as a C++ library that never asks Python."""
    end = time.process_time() + seconds
    data = bytes(20_000_000)
    while time.process_time() < end:
        hashlib.sha256(data)


def slow_if_upright(image, board, refine):
    """A detector that loops for ever on one kind of image."""
    if image.shape[0] > image.shape[1] and image[0, 0] == 7:
        busy(3600.0)
    return found_by_the_library(image, board, refine)


AMPLE, SCANT = 600.0, 0.3


def test_calls_return_or_are_given_up():
    with Limited(AMPLE) as limited:
        assert limited(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            limited(divmod, 7, 0)
        for _ in range(2):  # in a thread, then in a process
            limited.seconds = SCANT
            with pytest.raises(TookTooLongError, match=r"0\.3 s"):
                limited(busy, 3600.0)
            limited.seconds = AMPLE
            assert limited(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            limited(divmod, 7, 0)
        with pytest.raises(TookTooLongError, match="died"):
            limited(os._exit, 3)
        assert limited(divmod, 7, 2) == (3, 1)


def test_only_work_counts():
    """Waiting, as for processors that are busy, takes nothing of the limit, in a thread and in a process."""
    with Limited(SCANT) as limited:
        limited(time.sleep, 2 * SCANT)
        with pytest.raises(TookTooLongError):
            limited(busy, 3600.0)
        limited(time.sleep, 2 * SCANT)
    left = [thread for thread in threading.enumerate() if thread.name == UNSTOPPABLE]
    for thread in left:
        thread.join(60.0)
    assert not any(thread.is_alive() for thread in left)


def test_no_limit_and_bad_limit():
    with Limited(None) as limited:
        assert limited(divmod, 7, 2) == (3, 1)
    with pytest.raises(InputError, match="positive"):
        Limited(0.0)


@pytest.mark.slow
def test_a_slow_image_is_a_failure_and_the_rest_goes_on(tmp_path, monkeypatch):
    class Unequal(Limited):
        """Only the image that takes for ever is given up soon: the others have time on the slowest machine."""

        def __call__(self, function, *arguments):
            self.seconds = given[0] if arguments[0][0, 0] == 7 else AMPLE
            return super().__call__(function, *arguments)

        def __enter__(self):
            given.append(self.seconds)
            return super().__enter__()

    given: list[float] = []
    monkeypatch.setattr(module, "Limited", Unequal)
    monkeypatch.setattr(module, "detect_board", slow_if_upright)
    for k in range(3):
        image = render(BOARD, (200, 240), homography(BOARD, (200, 240), 20, (0.05 * k, 0.05), 0.1), seed=k)[0]
        image[0, 0] = 7 if k == 1 else 8
        cv2.imwrite(f"{tmp_path}/{k}.png", image)
    seen = detect([tmp_path / f"{k}.png" for k in range(3)], BOARD, time_limit=SCANT)
    assert seen.names == ("0.png", "2.png")
    assert [failure.name for failure in seen.failures] == ["1.png"]
    assert "time limit of 0.3 s" in seen.failures[0].reason
