"""`VideoPairs`: two videos and a detector as the source of a stream."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path

from kcal.errors import FileError
from kcal.lens.rig import StereoRig
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.detector_call import Detector, detect_in
from kcal.pipeline.disparity import ObjectDisparity
from kcal.pipeline.frame_pairs import paired_by_time
from kcal.pipeline.handover import Handover
from kcal.pipeline.lines import Moment
from kcal.pipeline.pairing import pair_objects
from kcal.pipeline.stream import SourceItem
from kcal.pipeline.video_frames import TimedFrame, file_frames

# Decoded frames that wait for their partners: a third of a second of video.
_FRAMES = 8


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


class VideoPairs:
    """Detect in the frames of two video files that belong together, and match the images inside the boxes.

    Call it with the offset of the last moment that is not wanted any more: it is a source for `Stream.follow`.

    Args:
        left: file of the left camera.
        right: file of the right camera.
        rig: the cameras; frames must have their sizes.
        detector: see `detect_in`.
        options: of the pairing of boxes.
        late: seconds by which the right images are later than their times say, as known at present.
        apart_s: frames that are farther apart in time are not paired.
    """

    def __init__(
        self,
        left: Path,
        right: Path,
        rig: StereoRig,
        detector: Detector,
        options: AssociationOptions,
        *,
        late: Callable[[], float],
        apart_s: float = 0.5,
    ) -> None:
        self.counts = VideoCounts()
        self._files, self._rig, self._detector, self._options = (left, right), rig, detector, options
        self._late, self._apart = late, apart_s
        self._match = ObjectDisparity(rig)
        self._running: list[Handover[TimedFrame]] = []

    def __call__(self, offset: int) -> Iterator[SourceItem]:
        """The moments after an offset: microseconds of the left frame, from 1."""
        # Somewhat earlier frames decide which frames belong together.
        left = self._frames(0, 1e-6 * offset - self._apart)
        right = self._frames(1, 1e-6 * offset - 2 * self._apart - self._late())
        paired = 0
        for one, other in paired_by_time(left, right, self._late, self._apart):
            paired += 1
            if one.place > offset:
                yield SourceItem(self._moment(one, other), one.place)
        if not paired and not offset:
            raise FileError(
                f"{self._files[0]} and {self._files[1]}: no frames within {self._apart:g} s of each other; if the "
                "recordings began at different times, say so with --clock-offset"
            )

    def close(self) -> None:
        """End the threads that decode."""
        for running in self._running:
            running.close()

    def _frames(self, side: int, since: float) -> Iterator[TimedFrame]:
        size, name = ((self._rig.left, self._rig.right)[side].size, ("left", "right")[side])
        decode = file_frames(self._files[side], size, since, functools.partial(self._count, "undecoded"))
        running = Handover(decode, _FRAMES, waits=True)
        self._running.append(running)
        for frame in running:
            self._count(name)
            yield frame

    def _count(self, name: str) -> None:
        setattr(self.counts, name, getattr(self.counts, name) + 1)

    def _moment(self, one: TimedFrame, other: TimedFrame) -> Moment:
        left, right = (
            detect_in(self._detector, frame.colors(), frame.time, f"{word} image")
            for word, frame in (("left", one), ("right", other))
        )
        images = one.gray(), other.gray()
        pairs = pair_objects(self._rig, left, right, images, options=self._options, disparity=self._match)
        self._count("paired")
        return Moment(one.time, pairs)
