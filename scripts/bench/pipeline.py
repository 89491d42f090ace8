"""Time of one frame from detections to positions: 1, 10 and 100 objects, eager and compiled.

    python -m scripts.bench.pipeline --write           docs/measured/pairing.md, section latency
    python -m scripts.bench.pipeline --calls 20 --no-compile

One thread. `localize` is `StereoLocalizer` alone, with a covariance for each pair, compiled with `cpp_wrapper`;
`associate` pairs as many detections of both images; `match` is `ObjectDisparity` on boxes of 12 px, all of which have
their image in both. One graph is compiled for any number of pairs from two; a single pair goes twice.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from kcal.lens.mounting import Origin
from kcal.locate.budget import planned_rig
from kcal.locate.localizer import StereoLocalizer
from kcal.pipeline.association import associate
from kcal.pipeline.detections import Detections
from kcal.pipeline.disparity import ObjectDisparity
from scripts.check.pairing import OPTIONS, SIZE, site_rig
from scripts.shared.page import table, write_section

COUNTS = (1, 10, 100)
SHIFT = 16


def milliseconds(call: Callable[[], object], calls: int) -> str:
    """Median and 99th percentile of the clock, and processor time of a call, after five calls that do not count."""
    for _ in range(5):
        call()
    found, before = [], time.process_time()
    for _ in range(calls):
        start = time.perf_counter()
        call()
        found.append(1e3 * (time.perf_counter() - start))
    spent = 1e3 * (time.process_time() - before) / calls
    return f"{np.median(found):.2f} / {np.quantile(found, 0.99):.2f} ({spent:.2f})"


def boxes(pixels: Tensor) -> Detections:
    """Detections of 12 px around pixels."""
    return Detections.read(torch.cat([pixels - 6, pixels + 6], -1), size=SIZE, first_pixel=0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=200)
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rig = site_rig()
    localize = StereoLocalizer(rig, origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0)
    compiled = None
    if not options.no_compile:
        compiled = torch.compile(localize, fullgraph=True, dynamic=True, options={"cpp_wrapper": True})
    match = ObjectDisparity(planned_rig())
    random = torch.Generator().manual_seed(0)
    texture = torch.rand(1, 1, SIZE[1] // 4, SIZE[0] // 4, generator=random)
    left = 255 * torch.nn.functional.interpolate(texture, scale_factor=4.0, mode="bicubic")[0, 0]
    right = left.roll(-SHIFT, 1)
    rows: list[list[object]] = []
    for count in COUNTS:
        depth = 10 ** torch.empty(count, dtype=torch.float64).uniform_(2.3, 3.7, generator=random)
        place = torch.stack([torch.empty(count).uniform_(-s, s, generator=random) for s in (0.45, 0.25)], -1)
        points = torch.cat([place.double(), torch.ones(count, 1)], -1) * depth[:, None]
        exact = rig(points)
        pixels, others = (at + 0.1 * torch.randn(count, 2, generator=random, dtype=torch.float64) for at in exact[:2])
        covariance = 0.01 * torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
        first, second = boxes(pixels), boxes(others)
        # In images that are shifted by a whole number of pixels, so that all objects are 1 km away.
        objects = (pixels.clamp_min(60.0)).round()
        aims = objects - torch.tensor([SHIFT - 1.0, 0.5], dtype=torch.float64)
        seen = boxes(objects).boxes
        calls: list[Callable[[], object]] = [lambda a=pixels, b=others, c=covariance: localize(a, b, c)]  # type: ignore[misc]
        if compiled is not None:
            given = (pixels, others, covariance)
            twice = [torch.cat([value, value])[: max(count, 2)] for value in given]
            if not rows:
                # With ten rows no other size of the inputs is the same, which the compiler would take for a rule.
                start = time.process_time()
                compiled(*(value.repeat(10, *[1] * (value.ndim - 1)) for value in given))
                print(f"compiled in {time.process_time() - start:.0f} s of processor time", flush=True)
            calls.append(lambda of=twice: compiled(*of))  # type: ignore[misc]
        calls.append(lambda a=first, b=second: associate(rig, a, b, OPTIONS))  # type: ignore[misc]
        calls.append(lambda a=seen, b=aims: match(left, right, a, b))  # type: ignore[misc]
        rows.append([count, *(milliseconds(call, options.calls) for call in calls)])
        print(*rows[-1], sep=" | ", flush=True)
    heads = [
        "objects",
        "localize, eager",
        *(["localize, compiled"] if compiled is not None else []),
        "associate",
        "match",
    ]
    text = (
        "Milliseconds a call: median / 99th percentile (processor time, mean). Made by `scripts/bench/pipeline.py`.\n\n"
        + "\n".join(table(heads, rows))
    )
    if options.write:
        write_section("pairing.md", "latency", text)


if __name__ == "__main__":
    main()
