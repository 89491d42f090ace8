import os
import time

import cv2
import pytest
from board_render import homography, render

from kcal.corners import detect as module
from kcal.corners.board import Board
from kcal.corners.detect import detect
from kcal.corners.time_limit import Limited, TookTooLongError
from kcal.errors import InputError

BOARD = Board(columns=6, rows=5, square=0.02)
found_by_the_library = module.detect_board


def slow_if_upright(image, board, refine):
    """A detector that loops for ever on one kind of image."""
    if image.shape[0] > image.shape[1] and image[0, 0] == 7:
        time.sleep(600)
    return found_by_the_library(image, board, refine)


def test_calls_return_or_are_given_up():
    with Limited(0.3) as limited:
        assert limited(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            limited(divmod, 7, 0)
        for _ in range(2):  # in a thread, then in a process
            start = time.monotonic()
            with pytest.raises(TookTooLongError, match=r"0\.3 s"):
                limited(time.sleep, 600)
            assert time.monotonic() - start < 300  # far from the 600 s, whatever else the machine does
            assert limited(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            limited(divmod, 7, 0)
        with pytest.raises(TookTooLongError, match="died"):
            limited(os._exit, 3)
        assert limited(divmod, 7, 2) == (3, 1)


def test_no_limit_and_bad_limit():
    with Limited(None) as limited:
        assert limited(divmod, 7, 2) == (3, 1)
    with pytest.raises(InputError, match="positive"):
        Limited(0.0)


@pytest.mark.slow
def test_a_slow_image_is_a_failure_and_the_rest_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "detect_board", slow_if_upright)
    for k in range(3):
        image = render(BOARD, (200, 240), homography(BOARD, (200, 240), 20, (0.05 * k, 0.05), 0.1), seed=k)[0]
        image[0, 0] = 7 if k == 1 else 8
        cv2.imwrite(f"{tmp_path}/{k}.png", image)
    seen = detect([tmp_path / f"{k}.png" for k in range(3)], BOARD, time_limit=3.0)
    assert seen.names == ("0.png", "2.png")
    assert [failure.name for failure in seen.failures] == ["1.png"]
    assert "time limit of 3 s" in seen.failures[0].reason
