"""`FramePairs`: frames of two videos that belong together, as they come, in bounded memory."""

from __future__ import annotations

import dataclasses
import functools
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from kcal.errors import FileError, InputError
from kcal.pipeline.frame_pairs import paired_by_time
from kcal.pipeline.handover import Handover
from kcal.pipeline.live_frames import live_frames
from kcal.pipeline.video_frames import TimedFrame, file_frames
from kcal.sources import is_stream, source_name

# Decoded frames that wait for their partners: a third of a second of video.
_FRAMES = 8
# Frames of one live stream after which a lack of partners is told: some seconds.
_ALONE = 100


@dataclasses.dataclass(kw_only=True)
class VideoCounts:
    """What became of frames so far.

    Attributes:
        left: decoded frames of the left video.
        right: of the right one.
        paired: pairs of frames that the detector saw.
        undecoded: frames that were damaged or out of order.
        dropped: pairs of a live source for which there was no time.
    """

    left: int = 0
    right: int = 0
    paired: int = 0
    undecoded: int = 0
    dropped: int = 0

    def __str__(self) -> str:
        parts = [f"videos: {self.left:,} and {self.right:,} frames, {self.paired:,} pairs"]
        for count, what in (
            (self.undecoded, "damaged or out of order, left out"),
            (self.dropped, "pairs dropped for lack of time"),
        ):
            parts += [f"{count:,} {what}"] if count else []
        return "; ".join(parts)


class FramePairs:
    """Frames of two videos that belong together.

    Call it with the offset of the last left frame that is not wanted any more: microseconds, from 1. Files wait until
    there is time for the next frames; of live streams the newest ones are taken, the others counted.

    Args:
        left: file or address of the left camera.
        right: the same of the right camera.
        sizes: (width, height) of each camera's images.
        late: seconds by which the right images are later than their times say, as known at present.
        apart_s: frames that are farther apart in time are not paired.
        tell: called with what happens to live streams, and of files that end early, from another thread.

    Raises:
        InputError: a file beside a live stream.
    """

    def __init__(
        self,
        left: str,
        right: str,
        sizes: tuple[tuple[int, int], tuple[int, int]],
        *,
        late: Callable[[], float] = lambda: 0.0,
        apart_s: float = 0.5,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.counts = VideoCounts()
        self.live = is_stream(left)
        if self.live != is_stream(right):
            raise InputError(f"{source_name(left)} and {source_name(right)}: two files or two live streams are needed")
        self._videos, self._sizes = (left, right), sizes
        self._late, self._apart, self._tell = late, apart_s, tell
        self._ended, self._met = threading.Event(), False
        self._running: list[Handover[TimedFrame]] = []
        self._newest: Handover[tuple[TimedFrame, TimedFrame]] | None = None

    def __call__(self, offset: int) -> Iterator[tuple[TimedFrame, TimedFrame]]:
        """The pairs after an offset."""
        # Somewhat earlier frames decide which frames belong together.
        left = self._frames(0, 1e-6 * offset - self._apart)
        right = self._frames(1, 1e-6 * offset - 2 * self._apart - self._late())
        pairs: Iterable[tuple[TimedFrame, TimedFrame]] = self._noted(
            paired_by_time(left, right, self._late, self._apart)
        )
        if self.live:
            pairs = self._newest = Handover(pairs, 1, waits=False)
        for one, other in pairs:
            if one.place > offset:
                yield one, other
            if self._newest is not None:
                self.counts.dropped = self._newest.dropped
        if not (self._met or offset or self.live or self._ended.is_set()):
            raise FileError(
                f"{self._videos[0]} and {self._videos[1]}: no frames within {self._apart:g} s of each other; if the "
                "recordings began at different times, say so with --clock-offset"
            )

    def _noted(self, pairs: Iterator[tuple[TimedFrame, TimedFrame]]) -> Iterator[tuple[TimedFrame, TimedFrame]]:
        for pair in pairs:
            self._met = True
            yield pair

    def close(self) -> None:
        """End the threads that decode."""
        self._ended.set()
        for running in self._running:
            running.close()
        if self._newest is not None:
            self._newest.close()

    def _frames(self, side: int, since: float) -> Iterator[TimedFrame]:
        size, name = self._sizes[side], ("left", "right")[side]
        video, undecoded = self._videos[side], functools.partial(self._count, "undecoded")
        if self.live:
            frames = live_frames(video, size, self._ended, self._tell, undecoded)
        else:
            frames = file_frames(Path(video), size, since, undecoded, self._tell)
        running = Handover(frames, _FRAMES, waits=not self.live)
        self._running.append(running)
        for frame in running:
            self._count(name)
            if self.live and getattr(self.counts, name) == _ALONE and not self._met:
                self._tell(
                    f"{_ALONE} frames of the {name} camera came, none within {self._apart:g} s of one of the other: do"
                    " the clocks of both cameras agree? --clock-offset corrects a known difference"
                )
            yield frame

    def _count(self, name: str) -> None:
        setattr(self.counts, name, getattr(self.counts, name) + 1)
