"""Two small videos of moving textured targets, and a detector of bright spots."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import torch
from scipy import ndimage
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.rig import Mounting, Origin, Rig
from scripts.shared.marking_scene import Plate, exposed, paint_plate, plate

SIZE = (320, 240)
START = torch.tensor([[-6.0, 1.0, 40.0], [5.0, -3.0, 60.0]]).double()
VELOCITY = torch.tensor([[2.0, 0.5, 1.0], [-3.0, 0.0, -2.0]]).double()
Image = npt.NDArray[np.uint8]


def small_rig() -> Rig:
    """Two pinholes of 320 x 240 px, 2 m apart, that look north."""
    camera = Camera.build(focal=(400, 400), center=(159.5, 119.5), size=SIZE, model="pinhole")
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
    rig.mounting = Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
    return rig


def places(time: float) -> Tensor:
    """Where the targets are, meters in the rig frame."""
    return START + time * VELOCITY


def drawn_image(rig: Rig, side: int, time: float, random: np.random.Generator) -> Image:
    """Gray levels of the left (0) or right (1) camera at a time: bright plates before a dark wall."""
    image = np.full(SIZE[::-1], 30.0)
    for number, point in enumerate(places(time)):
        item = plate(point, (16.0, 12.0), 400.0, 60.0, np.random.default_rng(number))
        paint_plate(image, rig, side, Plate(point=item.point, half=item.half, waves=item.waves, level=150.0))
    return exposed(image, 1.0, random).round().clamp(0, 255).byte().numpy()


def write_video(
    path: Path,
    images: Sequence[Image],
    times: Sequence[float],
    pixel_format: str = "yuvj420p",
    crf: int = 0,
    index_first: bool = False,
) -> Path:
    """A video whose frames have the given times, to a millisecond; without losses if `crf` is 0.

    With `index_first` an MP4 file can be read as far as it goes when its end is missing.
    """
    with av.open(str(path), "w", options={"movflags": "faststart"} if index_first else {}) as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": str(crf), "preset": "fast", "g": "12"})
        stream.width, stream.height = images[0].shape[1], images[0].shape[0]
        stream.pix_fmt = pixel_format
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        # The same film on every machine and in every run: with several threads x264 decides by who is first.
        stream.codec_context.thread_count = 1
        for image, time in zip(images, times, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts, frame.time_base = round(1000 * time), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def film(rig: Rig, side: int, times: Sequence[float], late: float = 0.0) -> list[Image]:
    """What a camera sees at some times of a clock; it exposes `late` seconds later."""
    random = np.random.default_rng(side)
    return [drawn_image(rig, side, time + late, random) for time in times]


def bright_spots(image: Image) -> npt.NDArray[np.float64]:
    """A detector: boxes (N, 4) around what is brighter than the wall."""
    spots, _ = ndimage.label(ndimage.gaussian_filter(image[..., 0].astype(float), 1.0) > 70)
    found = [(x.start, y.start, x.stop, y.stop) for y, x in ndimage.find_objects(spots)]
    return np.array([box for box in found if box[2] - box[0] > 4], dtype=float).reshape(-1, 4)
