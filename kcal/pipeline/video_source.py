"""`Videos`: the videos of a rig's cameras and a detector as the source of a stream."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import torch

from kcal.errors import FileError, InputError
from kcal.lens.rig import StereoRig
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.detections import Detections
from kcal.pipeline.detector_call import Detector, detect_in
from kcal.pipeline.disparity import ObjectDisparity
from kcal.pipeline.frame_pairs import frames_together, paired_by_time
from kcal.pipeline.grouping import group_objects
from kcal.pipeline.handover import Handover
from kcal.pipeline.lines import Moment
from kcal.pipeline.live_frames import live_frames
from kcal.pipeline.object_views import ObjectViews
from kcal.pipeline.pairing import pair_objects
from kcal.pipeline.pairs import ObjectPairs
from kcal.pipeline.stream import SourceItem
from kcal.pipeline.video_frames import TimedFrame, file_frames
from kcal.sources import is_stream, source_name

# Seconds of the first frame, and what each camera has.
_Together = tuple[float, list[TimedFrame | None]]
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


class Videos:
    """Detect in frames that belong together; of two cameras of one mast, match the images inside the boxes too.

    Call it with the offset of the last moment that is not wanted any more: it is a source for `Stream.follow`. Files
    wait until there is time for the next frames; of live streams the newest ones are taken, the others counted.

    Args:
        videos: file or address of each camera, in the order of the rig.
        rig: the cameras, with what is known of them where they are many; frames must have their sizes.
        detector: see `detect_in`.
        options: of the pairing of boxes.
        late: seconds by which the images of a camera, from 1, are later than their times say, as known at present.
        match_sigma: pixels, error of a match along each axis besides what its pixels tell; compression makes it: 0.06
            in H.264 of usual quality (CRF 23 of x264, `scripts/check/compression.py`). Make the tracker with
            `TrackOptions.for_video(match_sigma)`. Boxes alone have none of it.
        apart_s: frames that are farther apart in time are not paired.
        tell: called with what happens to live streams, and of files that end early, from another thread.

    Raises:
        InputError: a `match_sigma` that is negative or not finite, a file beside a live stream, or another number of
            videos than of cameras.
    """

    def __init__(
        self,
        videos: Sequence[str],
        rig: StereoRig | MultiViewLocalizer,
        detector: Detector,
        options: AssociationOptions,
        *,
        late: Callable[[int], float],
        match_sigma: float,
        apart_s: float = 0.5,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        if not 0 <= match_sigma < math.inf:
            raise InputError(f"match_sigma: pixels, not negative, are needed, got {match_sigma}")
        self._compression = match_sigma**2 * torch.diag(torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64))
        self._names: tuple[str, ...]
        self._match: ObjectDisparity | None = None
        if isinstance(rig, StereoRig):
            self._names, self._cameras = ("left", "right"), [rig.left, rig.right]
            self._match = ObjectDisparity(rig)
        else:
            self._names, self._cameras = rig.rig.names, rig.rig.each
        if len(videos) != len(self._names):
            raise InputError(f"{len(self._names)} videos are needed, of {', '.join(self._names)}; got {len(videos)}")
        self.counts = VideoCounts(frames=dict.fromkeys(self._names, 0))
        self.live = is_stream(videos[0])
        if any(is_stream(video) != self.live for video in videos):
            named = " and ".join(source_name(video) for video in videos)
            raise InputError(f"{named}: files alone or live streams alone are needed")
        self._videos, self._rig, self._detector, self._options = tuple(videos), rig, detector, options
        self._late, self._apart, self._tell = late, apart_s, tell
        self._ended, self._met = threading.Event(), False
        self._running: list[Handover[TimedFrame]] = []
        self._newest: Handover[_Together] | None = None

    def __call__(self, offset: int) -> Iterator[SourceItem]:
        """The moments after an offset: microseconds of the first frame, from 1."""
        # Somewhat earlier frames decide which frames belong together.
        frames = [self._frames(0, 1e-6 * offset - self._apart)]
        for c in range(1, len(self._videos)):
            frames.append(self._frames(c, 1e-6 * offset - 2 * self._apart - self._late(c)))
        groups: Iterable[_Together] = self._together(frames)
        if self.live:
            groups = self._newest = Handover(groups, 1, waits=False)
        for time, group in groups:
            place = round(1e6 * time) + 1
            if place > offset:
                yield SourceItem(self._moment(time, group), place)
            if self._newest is not None:
                self.counts.dropped = self._newest.dropped
        if not (self._met or offset or self.live or self._ended.is_set()):
            raise FileError(
                f"{' and '.join(self._videos)}: no frames within {self._apart:g} s of each other; if the "
                "recordings began at different times, say so with --clock-offset"
            )

    def _together(self, frames: list[Iterator[TimedFrame]]) -> Iterator[_Together]:
        if self._match is not None:
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

    def _frames(self, side: int, since: float) -> Iterator[TimedFrame]:
        size, name, video = self._cameras[side].size, self._names[side], self._videos[side]

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

    def _moment(self, time: float, group: list[TimedFrame | None]) -> Moment | InputError:
        seen = [
            None if frame is None else detect_in(self._detector, frame.colors(), frame.time, f"{name} image")
            for name, frame in zip(self._names, group, strict=True)
        ]
        try:
            found = self._objects(seen, group)
        except InputError as error:
            # Too many boxes: one frame, and not the end.
            return error
        self.counts.paired += 1
        return Moment(time, found)

    def _objects(self, seen: list[Detections | None], group: list[TimedFrame | None]) -> ObjectPairs | ObjectViews:
        if not isinstance(self._rig, StereoRig):
            return group_objects(self._rig, seen, self._options)
        (left, right), (one, other) = seen, group
        assert left is not None and right is not None and one is not None and other is not None  # noqa: PT018
        images = one.gray(), other.gray()
        pairs = pair_objects(self._rig, left, right, images, options=self._options, disparity=self._match)
        return dataclasses.replace(pairs, covariance=pairs.covariance + self._compression)
