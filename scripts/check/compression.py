"""What compression of videos does to matched disparities: ten plates of 16 by 12 px at several paces and qualities.

The default of `kcal live --match-sigma` is what compression adds at CRF 23. A part of the errors stays the same over
all frames, which the tracker must know (`TrackOptions.lasting_px`): it shows in the mean of each plate's errors.
"""

from __future__ import annotations

import itertools
import math
import tempfile
from fractions import Fraction
from typing import NamedTuple

import av
import numpy as np
import torch
from torch import Tensor

from kcal import Camera, Rig
from kcal.pipeline.video_source import Videos
from kcal.track import AssociationOptions
from scripts.shared.marking_scene import Floats, exposed, paint_plate, plate, true_box
from scripts.shared.page import Lines, section

SIZE, FOCAL, FRAMES, RATE = (320, 240), 400.0, 100, 25
# Shares of the full pace, at which plates move by some 0.4 px a frame.
PACES = (1.0, 0.2, 0.0)
ACROSS = [(-120, -80), (-40, -80), (40, -80), (110, -80), (-100, 0), (-20, 0), (60, 0), (-90, 80), (0, 80), (90, 80)]
DEPTHS = [40.0, 50.0, 60.0, 45.0, 70.0, 40.0, 80.0, 55.0, 65.0, 45.0]


def places(time: float, pace: float) -> Tensor:
    depth = torch.tensor(DEPTHS, dtype=torch.float64)
    start = torch.tensor(ACROSS, dtype=torch.float64) * depth[:, None] / FOCAL
    velocity = torch.from_numpy(np.random.default_rng(3).normal(0.0, 1.5, (len(depth), 3)))
    return torch.cat([start, depth[:, None]], 1) + time * pace * velocity


def drawn(rig: Rig, side: int, time: float, pace: float, random: np.random.Generator) -> tuple[Tensor, list[Floats]]:
    """Gray levels and the true boxes."""
    image = np.full(SIZE[::-1], 30.0)
    items = [
        plate(point, (16.0, 12.0), FOCAL, 60.0, np.random.default_rng(k)) for k, point in enumerate(places(time, pace))
    ]
    for item in items:
        paint_plate(image, rig, side, item)
    return exposed(image, 1.0, random).round().clamp(0, 255).byte(), [true_box(rig, side, item) for item in items]


def write(path: str, images: list[Tensor], crf: int) -> None:
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"crf": str(crf), "preset": "medium"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuvj420p"
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image.numpy(), format="gray")
            frame.pts, frame.time_base = number, Fraction(1, RATE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


class Errors(NamedTuple):
    """Of matched disparities (frames, plates), and the variances stated for them; NaN where a plate was not matched."""

    error: Floats
    variance: Floats


def errors_of(rig: Rig, films: list[list[Tensor]], boxes: list[list[Floats]], pace: float, crf: int) -> Errors:
    """Of videos of a quality."""
    found = Errors(*(np.full((FRAMES, len(DEPTHS)), np.nan) for _ in Errors._fields))
    with tempfile.TemporaryDirectory() as folder:
        videos = [f"{folder}/{side}.mp4" for side in (0, 1)]
        for video, film in zip(videos, films, strict=True):
            write(video, film, crf)
        # The detector is asked for the left and the right image in turn, and knows the answers.
        turns = itertools.chain.from_iterable(zip(*boxes, strict=True))
        source = Videos(videos, rig, lambda _: next(turns), AssociationOptions(), late=lambda _: 0.0, match_sigma=0.0)
        for frame, item in enumerate(source(0)):
            assert not isinstance(item.moment, Exception)
            pairs = item.moment.pairs
            left, right = rig(places(item.moment.time, pace))[0].unbind(-2)
            which = torch.cdist(pairs.left, left).argmin(-1)
            c = pairs.covariance
            error = (pairs.left - pairs.right)[:, 0] - (left - right)[which, 0]
            variance = c[:, 0, 0] + c[:, 2, 2] - 2 * c[:, 0, 2]
            for i in (c[:, 0, 2] > 0.5).nonzero()[:, 0].tolist():
                found.error[frame, which[i]], found.variance[frame, which[i]] = error[i], variance[i]
    return found


@section("pairing.md", "compression", paces=(1.0,), qualities=(23,))
def compression(paces: tuple[float, ...] = PACES, qualities: tuple[int, ...] = (0, 17, 23, 28)) -> Lines:
    yield (
        f"Ten plates of 16 by 12 px in {FRAMES} frames, H.264 by x264. *Pace*: 1 is some 0.4 px a frame, 0 stands "
        "still. *Lasts*: the part of each plate's error that is the same in all frames."
    )
    yield ["pace", "CRF of x264", "RMS of disparity, px", "stated, px", "compression adds, px", "lasts, px"]
    camera = Camera.build(focal=(FOCAL, FOCAL), center=(159.5, 119.5), size=SIZE, model="pinhole")
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
    for pace in paces:
        films, boxes = [], []
        for side in (0, 1):
            random = np.random.default_rng(side)
            made = [drawn(rig, side, number / RATE, pace, random) for number in range(FRAMES)]
            films.append([image for image, _ in made])
            boxes.append([np.array(found) + 0.5 for _, found in made])
        for crf in qualities:
            error, variance = errors_of(rig, films, boxes, pace, crf)
            rms, stated = (math.sqrt(float(np.nanmean(value))) for value in (error**2, variance))
            more = math.sqrt(max(rms**2 - stated**2, 0.0))
            # The mean over n frames has this variance, besides that of noise: its scatter within the plate over n.
            noise = np.nanvar(error, 0, ddof=1) / (~np.isnan(error)).sum(0)
            lasting = math.sqrt(max(float((np.nanmean(error, 0) ** 2 - noise).mean()), 0.0))
            yield [f"{pace:g}", crf, *(f"{value:.3f}" for value in (rms, stated, more, lasting))]
