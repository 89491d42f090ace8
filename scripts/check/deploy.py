"""The whole localizer compiled and exported, with lenses of every kind, against eager results.

    python -m scripts.check.deploy                     all kinds, some minutes each
    python -m scripts.check.deploy --lenses opencv5    one kind

Among the pixels are one that is not finite and one outside the image; the number of pairs differs from the traced one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.lens.mounting import Origin
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.lens.zernike import ZernikeModes
from kcal.locate.localizer import StereoLocalizer
from scripts.shared.timing import row, show

LENSES = ("pinhole", "opencv5", "opencv14", "ext24", "fisheye4", "hybrid")


def localizer(lens: str) -> StereoLocalizer:
    """Of two cameras with mild lenses, with all error terms."""
    modes = ZernikeModes(radial=5, decentered=4, astigmatic=3, other=3)
    model = LensModel(hybrid=HybridForm(shape=0.7, radius=1.4, modes=modes)) if lens == "hybrid" else lens
    values = {"fisheye4": [0.02, -0.01, 0.003, -0.0005], "hybrid": [0.2, 0.01, -0.004], "pinhole": []}
    lens_values = values.get(lens, [-0.1, 0.02])
    camera = Camera.build(
        focal=(1600, 1610), center=(955, 541), size=(1920, 1080), coefficients=lens_values, model=model
    )  # fmt: skip
    rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.1, 0.2]))
    rig.covariance = RigCovariance.of(rig, pose=1e-8 * torch.eye(6, dtype=torch.float64))
    mounting = 1e-6 * torch.eye(6, dtype=torch.float64)
    origin = Origin(lat=19.07, lon=72.87, height=14.0)
    return StereoLocalizer(rig, origin=origin, heading_deg=35.0, pixel_sigma=0.1, mounting=mounting)


def marks(module: StereoLocalizer, repeats: int) -> tuple[Tensor, Tensor]:
    points = torch.tensor([[30.0, 10, 800], [-100, 40, 900], [5, 5, 100], [200, -30, 5000]], dtype=torch.float64)
    left, right, _ = module.rig(points)
    bad = torch.tensor([[torch.nan, 3.0], [5000.0, 5.0]], dtype=torch.float64)
    fine = torch.tensor([[4.0, 3.0], [5.0, 5.0]], dtype=torch.float64)
    return torch.cat([left, bad]).repeat(repeats, 1), torch.cat([right, fine]).repeat(repeats, 1)


def difference(found: Sequence[Tensor], wanted: Sequence[Tensor]) -> float:
    """Largest relative difference of all fields; what is infinite must be so in both."""
    largest = 0.0
    for some, other in zip(found, wanted, strict=True):
        one, two = some.double(), other.double()
        if not torch.equal(one.isfinite(), two.isfinite()):
            return float("inf")
        apart = torch.nan_to_num(one - two, 0.0, 0.0, 0.0).abs() / (1.0 + torch.nan_to_num(two, 0.0, 0.0, 0.0).abs())
        largest = max(largest, float(apart.max()))
    return largest


@torch.no_grad()
def checked(lens: str, ways: Sequence[str]) -> list[str]:
    """The largest difference for each way, with the seconds that it took."""
    module = localizer(lens)
    few, many = marks(module, 1), marks(module, 3)
    wanted = module(*many)
    count = torch.export.Dim("count", min=2)
    cells = []
    for way in ways:
        torch.compiler.reset()
        start = time.process_time()
        if way == "compile":
            found = torch.compile(module, fullgraph=True, dynamic=True, backend="eager")(*many)
        else:
            found = torch.export.export(module, few, dynamic_shapes=({0: count}, {0: count})).module()(*many)
        cells.append(f"{difference(found, wanted):.0e} ({time.process_time() - start:.0f} s)")
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lenses", nargs="+", default=LENSES)
    parser.add_argument("--ways", nargs="+", default=("compile", "export"))
    options = parser.parse_args()
    show([row("lens", *options.ways), row(*["---"] * (1 + len(options.ways)))])
    for lens in options.lenses:
        show([row(lens, *checked(lens, options.ways))])


if __name__ == "__main__":
    main()
