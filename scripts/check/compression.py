"""What compression of videos does to matched disparities: ten moving plates of 16 by 12 px at several qualities.

    python -m scripts.check.compression

The default of `kcal live --match-sigma` is what compression adds at CRF 23.
"""

from __future__ import annotations

import functools
import itertools
import math
import tempfile
from collections.abc import Iterator
from fractions import Fraction

import av
import numpy as np
import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.rig import StereoRig
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.video_source import VideoPairs
from scripts.shared.object_scene import Floats, exposed, paint_plate, plate, true_box
from scripts.shared.page import table

SIZE, FOCAL, FRAMES, RATE = (320, 240), 400.0, 40, 25
ACROSS = [(-120, -80), (-40, -80), (40, -80), (110, -80), (-100, 0), (-20, 0), (60, 0), (-90, 80), (0, 80), (90, 80)]
DEPTHS = [40.0, 50.0, 60.0, 45.0, 70.0, 40.0, 80.0, 55.0, 65.0, 45.0]


def places(time: float) -> Tensor:
    depth = torch.tensor(DEPTHS, dtype=torch.float64)
    start = torch.tensor(ACROSS, dtype=torch.float64) * depth[:, None] / FOCAL
    pace = torch.from_numpy(np.random.default_rng(3).normal(0.0, 1.5, (len(depth), 3)))
    return torch.cat([start, depth[:, None]], 1) + time * pace


def drawn(rig: StereoRig, side: int, time: float, random: np.random.Generator) -> tuple[Tensor, list[Floats]]:
    """Gray levels and the true boxes."""
    image = np.full(SIZE[::-1], 30.0)
    items = [plate(point, (16.0, 12.0), FOCAL, 60.0, np.random.default_rng(k)) for k, point in enumerate(places(time))]
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


def next_of(turns: Iterator[Floats], _: object) -> Floats:
    return next(turns)


def main() -> None:
    torch.set_num_threads(1)
    camera = Camera.build(focal=(FOCAL, FOCAL), center=(159.5, 119.5), size=SIZE, model="pinhole")
    rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
    films, boxes = [], []
    for side in (0, 1):
        random = np.random.default_rng(side)
        made = [drawn(rig, side, number / RATE, random) for number in range(FRAMES)]
        films.append([image for image, _ in made])
        boxes.append([np.array(found) + 0.5 for _, found in made])
    rows: list[list[object]] = []
    for crf in (0, 17, 23, 28):
        with tempfile.TemporaryDirectory() as folder:
            videos = [f"{folder}/{side}.mp4" for side in (0, 1)]
            for video, film in zip(videos, films, strict=True):
                write(video, film, crf)
            # The detector is asked for the left and the right image in turn, and knows the answers.
            turns = itertools.chain.from_iterable(zip(*boxes, strict=True))
            source = VideoPairs(
                videos[0], videos[1], rig, functools.partial(next_of, turns), AssociationOptions(),
                late=lambda: 0.0, match_sigma=0.0,
            )  # fmt: skip
            errors, stated = [], []
            for item in source(0):
                assert not isinstance(item.moment, Exception)
                pairs, true = item.moment.pairs, places(item.moment.time)
                left, right, _ = rig(true)
                which = torch.cdist(pairs.left, left).argmin(-1)
                c = pairs.covariance
                matched = c[:, 0, 2] > 0.5
                error = (pairs.left - pairs.right)[:, 0] - (left - right)[which, 0]
                errors.append(error[matched])
                stated.append((c[:, 0, 0] + c[:, 2, 2] - 2 * c[:, 0, 2])[matched])
        error, variance = float(torch.cat(errors).square().mean()), float(torch.cat(stated).mean())
        more = math.sqrt(max(error - variance, 0.0))
        rows.append([crf, f"{math.sqrt(error):.3f}", f"{math.sqrt(variance):.3f}", f"{more:.3f}"])
    print("\n".join(table(["CRF of x264", "RMS of disparity, px", "stated, px", "compression adds, px"], rows)))


if __name__ == "__main__":
    main()
