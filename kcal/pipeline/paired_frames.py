"""`FramesTogether`: frames of videos that belong together, as they come, in bounded memory."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from kcal.errors import FileError, InputError
from kcal.files import is_stream, source_name
from kcal.pipeline.frame_pairs import frames_together, paired_by_time
from kcal.pipeline.handover import Handover
from kcal.pipeline.live_frames import live_frames
from kcal.pipeline.video_frames import TimedFrame, file_frames

# Seconds of the first frame, and what each camera has.
Together = tuple[float, list[TimedFrame | None]]
# Decoded frames that wait for their partners: a third of a second of video.
_FRAMES = 8
# Frames of one live stream after which a lack of partners is told: some seconds.
_ALONE = 100


@dataclasses.dataclass(kw_only=True)
class VideoCounts:
    """What became of frames so far.

    Attributes:
        frames: decoded frames of each camera.
        paired: groups of frames that the detector saw.
        undecoded: frames that were damaged or out of order.
        dropped: groups of a live source for which there was no time.
    """

    frames: dict[str, int]
    paired: int = 0
    undecoded: int = 0
    dropped: int = 0

    def __str__(self) -> str:
        each = [f"{count:,}" for count in self.frames.values()]
        what = "pairs" if len(each) == 2 else "groups"
        parts = [f"videos: {', '.join(each[:-1])} and {each[-1]} frames, {self.paired:,} {what}"]
        for count, words in (
            (self.undecoded, "damaged or out of order, left out"),
            (self.dropped, f"{what} dropped for lack of time"),
        ):
            parts += [f"{count:,} {words}"] if count else []
        return "; ".join(parts)


class FramesTogether:
    """Frames of videos that belong together.

    Call it with the offset of the last group that is not wanted any more: microseconds of its time, from 1. Files wait
    until there is time for the next frames; of live streams the newest ones are taken, the others counted.

    Args:
        videos: file or address of each camera.
        sizes: by the name of each camera, (width, height) of its images.
        pairs: of two videos, only frames that both have; otherwise also those that some have.
        late: seconds by which the images of a camera, from 1, are later than their times say, as known at present.
        apart_s: frames that are farther apart in time do not belong together.
        tell: called with what happens to live streams, and of files that end early, from another thread.

    Raises:
        InputError: another number of videos, or a file beside a live stream.
    """

    def __init__(
        self,
        videos: Sequence[str],
        sizes: dict[str, tuple[int, int]],
        *,
        pairs: bool,
        late: Callable[[int], float] = lambda _: 0.0,
        apart_s: float = 0.5,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        if len(videos) != len(sizes):
            raise InputError(f"{len(sizes)} videos are needed, of {', '.join(sizes)}; got {len(videos)}")
        self.counts = VideoCounts(frames=dict.fromkeys(sizes, 0))
        self.live = is_stream(videos[0])
        if any(is_stream(video) != self.live for video in videos):
            named = " and ".join(source_name(video) for video in videos)
            raise InputError(f"{named}: files alone or live streams alone are needed")
        self._videos, self._sizes, self._pairs = tuple(videos), sizes, pairs
        self._late, self._apart, self._tell = late, apart_s, tell
        self._ended, self._met = threading.Event(), False
        self._running: list[Handover[TimedFrame]] = []
        self._newest: Handover[Together] | None = None

    def __call__(self, offset: int) -> Iterator[tuple[int, Together]]:
        """The groups after an offset, each with its own."""
        # Somewhat earlier frames decide which frames belong together.
        frames = [self._frames(0, 1e-6 * offset - self._apart)]
        for c in range(1, len(self._videos)):
            frames.append(self._frames(c, 1e-6 * offset - 2 * self._apart - self._late(c)))
        if not (offset or self.live or self._pairs):
            self._tell_early()
        groups: Iterable[Together] = self._grouped(frames)
        if self.live:
            groups = self._newest = Handover(groups, 1, waits=False)
        for time, group in groups:
            place = round(1e6 * time) + 1
            if place > offset:
                yield place, (time, group)
            if self._newest is not None:
                self.counts.dropped = self._newest.dropped
        if not (self._met or offset or self.live or self._ended.is_set()):
            raise FileError(
                f"{' and '.join(self._videos)}: no frames within {self._apart:g} s of each other; if the "
                "recordings began at different times, say so with --clock-offset"
            )

    def _tell_early(self) -> None:
        """Say what is left out of files that begin before second 0 of the first one, from which times count."""
        first, *others = self._sizes
        for c, name in enumerate(others, 1):
            if (early := -self._late(c)) > 0:
                self._tell(
                    f"{name}: what it shows in the {early:.3g} s before second 0 of {first} is left out, because times "
                    "count from there; put the camera first that begins first"
                )

    def _grouped(self, frames: list[Iterator[TimedFrame]]) -> Iterator[Together]:
        if self._pairs:
            for pair in paired_by_time(frames[0], frames[1], lambda: self._late(1), self._apart):
                self._met = True
                yield pair[0].time, list(pair)
            return
        for time, group in frames_together(frames, lambda c: self._late(c) if c else 0.0, self._apart):
            self._met = self._met or sum(frame is not None for frame in group) > 1
            yield time, group

    def close(self) -> None:
        """End the threads that decode."""
        self._ended.set()
        for running in self._running:
            running.close()
        if self._newest is not None:
            self._newest.close()

    def _frames(self, camera: int, since: float) -> Iterator[TimedFrame]:
        (name, size), video = list(self._sizes.items())[camera], self._videos[camera]

        def undecoded() -> None:
            self.counts.undecoded += 1

        if self.live:
            frames = live_frames(video, size, self._ended, self._tell, undecoded)
        else:
            frames = file_frames(Path(video), size, since, undecoded, self._tell)
        running = Handover(frames, _FRAMES, waits=not self.live)
        self._running.append(running)
        for frame in running:
            self.counts.frames[name] += 1
            if self.live and self.counts.frames[name] == _ALONE and not self._met:
                self._tell(
                    f"{_ALONE} frames of the {name} camera came, none within {self._apart:g} s of one of another: do "
                    "the clocks of the cameras agree? --clock-offset corrects a known difference"
                )
            yield frame
