"""`Videos`: moments of a rig's videos: a detector in frames that belong together, and matched objects."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import torch

from kcal.errors import InputError
from kcal.lens.rig import StereoRig
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.detections import Detections, Detector, detect_in
from kcal.pipeline.grouping import group_objects
from kcal.pipeline.lines import Moment
from kcal.pipeline.paired_frames import FramesTogether, TimedFrame
from kcal.pipeline.pairing import ObjectDisparity, pair_objects
from kcal.pipeline.pairs import ObjectPairs, ObjectViews
from kcal.pipeline.stream import SourceItem


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
        self._match: ObjectDisparity | None = None
        if isinstance(rig, StereoRig):
            self._sizes = {"left": rig.left.size, "right": rig.right.size}
            self._match = ObjectDisparity(rig)
        else:
            self._sizes = {name: camera.size for name, camera in zip(rig.rig.names, rig.rig.each, strict=True)}
        together = self._match is not None
        self._frames = FramesTogether(videos, self._sizes, pairs=together, late=late, apart_s=apart_s, tell=tell)
        self.counts, self.live = self._frames.counts, self._frames.live
        self._rig, self._detector, self._options = rig, detector, options

    def __call__(self, offset: int) -> Iterator[SourceItem]:
        """The moments after an offset: microseconds of the first frame, from 1."""
        for place, (time, group) in self._frames(offset):
            yield SourceItem(self._moment(time, group), place)

    def close(self) -> None:
        """End the threads that decode."""
        self._frames.close()

    def _moment(self, time: float, group: list[TimedFrame | None]) -> Moment | InputError:
        seen = [
            None if frame is None else detect_in(self._detector, frame.colors(), frame.time, f"{name} image")
            for name, frame in zip(self._sizes, group, strict=True)
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
