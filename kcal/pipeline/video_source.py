"""`VideoPairs`: two videos and a detector as the source of a stream."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator

import torch

from kcal.errors import InputError
from kcal.lens.rig import StereoRig
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.detector_call import Detector, detect_in
from kcal.pipeline.disparity import ObjectDisparity
from kcal.pipeline.lines import Moment
from kcal.pipeline.paired_frames import FramePairs
from kcal.pipeline.pairing import pair_objects
from kcal.pipeline.stream import SourceItem
from kcal.pipeline.video_frames import TimedFrame


class VideoPairs:
    """Detect in the frames of two videos that belong together, and match the images inside the boxes.

    Call it with the offset of the last moment that is not wanted any more: it is a source for `Stream.follow`, of
    `FramePairs`.

    Args:
        left: file or address of the left camera.
        right: the same of the right camera.
        rig: the cameras; frames must have their sizes.
        detector: see `detect_in`.
        options: of the pairing of boxes.
        late: seconds by which the right images are later than their times say, as known at present.
        match_sigma: pixels, error of a match along each axis besides what its pixels tell; compression makes it: 0.06
            in H.264 of usual quality (CRF 23 of x264, `scripts/check/compression.py`). Make the tracker with
            `TrackOptions.for_video(match_sigma)`.
        apart_s: frames that are farther apart in time are not paired.
        tell: called with what happens to live streams, and of files that end early, from another thread.

    Raises:
        InputError: a `match_sigma` that is negative or not finite, or a file beside a live stream.
    """

    def __init__(
        self,
        left: str,
        right: str,
        rig: StereoRig,
        detector: Detector,
        options: AssociationOptions,
        *,
        late: Callable[[], float],
        match_sigma: float,
        apart_s: float = 0.5,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        if not 0 <= match_sigma < math.inf:
            raise InputError(f"match_sigma: pixels, not negative, are needed, got {match_sigma}")
        self._compression = match_sigma**2 * torch.diag(torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64))
        sizes = rig.left.size, rig.right.size
        self._frames = FramePairs(left, right, sizes, late=late, apart_s=apart_s, tell=tell)
        self.counts, self.live = self._frames.counts, self._frames.live
        self._rig, self._detector, self._options = rig, detector, options
        self._match = ObjectDisparity(rig)

    def __call__(self, offset: int) -> Iterator[SourceItem]:
        """The moments after an offset: microseconds of the left frame, from 1."""
        for one, other in self._frames(offset):
            yield SourceItem(self._moment(one, other), one.place)

    def close(self) -> None:
        """End the threads that decode."""
        self._frames.close()

    def _moment(self, one: TimedFrame, other: TimedFrame) -> Moment | InputError:
        left, right = (
            detect_in(self._detector, frame.colors(), frame.time, f"{word} image")
            for word, frame in (("left", one), ("right", other))
        )
        images = one.gray(), other.gray()
        try:
            pairs = pair_objects(self._rig, left, right, images, options=self._options, disparity=self._match)
        except InputError as error:
            # Too many boxes: one frame, and not the end.
            return error
        self.counts.paired += 1
        return Moment(one.time, dataclasses.replace(pairs, covariance=pairs.covariance + self._compression))
