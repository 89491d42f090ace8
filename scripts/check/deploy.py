"""The whole localizer compiled, exported and in onnxruntime, with lenses of every kind, against eager results.

Among the pixels are one that is not finite and one outside the image; the number of pairs differs from the traced one.
It ends with an error if a field of the result differs by more than 1e-9 of one plus its size: 1e-9 px, 1e-5 m at 5 km.
`trace` is one graph by `torch.compile` that runs as it is; `inductor` also translates it to C++.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import onnxruntime
import torch
from torch import Tensor

from kcal import Camera, Origin, Rig
from kcal.lens import LensModel, save_onnx
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes
from kcal.locate.localizer import Localization, Localizer
from kcal.rig import RigCovariance
from scripts.shared.page import Lines, section, timed

LENSES = ("pinhole", "opencv5", "opencv14", "ext24", "fisheye4", "hybrid")
WAYS = ("trace", "inductor", "export", "onnx")
ALLOWED = 1e-9


def localizer(lens: str) -> Localizer:
    """Of two cameras with mild lenses, with all error terms."""
    modes = ZernikeModes(radial=5, decentered=4, astigmatic=3, other=3)
    model = LensModel(hybrid=HybridForm(shape=0.7, radius=1.4, modes=modes)) if lens == "hybrid" else lens
    values = {"fisheye4": [0.02, -0.01, 0.003, -0.0005], "hybrid": [0.2, 0.01, -0.004], "pinhole": []}
    lens_values = values.get(lens, [-0.1, 0.02])
    camera = Camera.build(
        focal=(1600, 1610), center=(955, 541), size=(1920, 1080), coefficients=lens_values, model=model
    )  # fmt: skip
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.1, 0.2]))
    rig.covariance = RigCovariance.of(rig, pose=1e-8 * torch.eye(6, dtype=torch.float64))
    mounting = 1e-6 * torch.eye(6, dtype=torch.float64)
    origin = Origin(lat=19.07, lon=72.87, height=14.0)
    return Localizer(rig.placed(origin=origin, heading_deg=35.0, covariance=mounting), pixel_sigma=0.1)


def marks(module: Localizer, repeats: int) -> tuple[Tensor, Tensor]:
    points = torch.tensor([[30.0, 10, 800], [-100, 40, 900], [5, 5, 100], [200, -30, 5000]], dtype=torch.float64)
    left, right = module.rig(points)[0].unbind(-2)
    bad = torch.tensor([[torch.nan, 3.0], [5000.0, 5.0]], dtype=torch.float64)
    fine = torch.tensor([[4.0, 3.0], [5.0, 5.0]], dtype=torch.float64)
    return torch.cat([left, bad]).repeat(repeats, 1), torch.cat([right, fine]).repeat(repeats, 1)


def difference(found: Sequence[Tensor], wanted: Localization, origin: Tensor) -> float:
    """Largest difference of all fields, of one plus their size; what is infinite must be so in both.

    Latitude and longitude count in meters from the origin.
    """
    largest, meters = 0.0, torch.tensor([111_320.0, 111_320.0, 1.0], dtype=torch.float64)
    for name, some, other in zip(wanted._fields, found, wanted, strict=True):
        one, two = some.double(), other.double()
        if name == "geodetic":
            one, two = ((each - origin) * meters for each in (one, two))
        if not torch.equal(one.isfinite(), two.isfinite()):
            return float("inf")
        apart = torch.nan_to_num(one - two, 0.0, 0.0, 0.0).abs() / (1.0 + torch.nan_to_num(two, 0.0, 0.0, 0.0).abs())
        largest = max(largest, float(apart.max()))
    return largest


@torch.no_grad()
def result(way: str, module: Localizer, few: tuple[Tensor, Tensor], many: tuple[Tensor, Tensor]) -> list[Tensor]:
    """What a way of deployment that has seen `few` pairs gives for `many`."""
    if way in {"trace", "inductor"}:
        compiled = torch.compile(module, fullgraph=True, dynamic=True, backend="eager" if way == "trace" else way)
        compiled(*few)
        return list(compiled(*many))
    if way == "export":
        count = torch.export.Dim("count", min=2)
        return list(torch.export.export(module, few, dynamic_shapes=({0: count}, {0: count})).module()(*many))
    with tempfile.TemporaryDirectory() as folder:
        session = onnxruntime.InferenceSession(save_onnx(module, few, Path(folder, "localizer.onnx")))
        inputs = {place.name: pixels.numpy() for place, pixels in zip(session.get_inputs(), many, strict=True)}
        return [torch.from_numpy(values) for values in session.run(None, inputs)]


def checked(lens: str, ways: Sequence[str]) -> list[tuple[float, float]]:
    """The largest difference for each way, and the seconds of processor time that it took."""
    module = localizer(lens)
    few, many = marks(module, 1), marks(module, 3)
    wanted = module(*many)
    found = []
    for way in ways:
        torch.compiler.reset()
        values, seconds = timed(result, way, module, few, many)
        found.append((difference(values, wanted, module.geodetic_of_origin), seconds))
    return found


@section("other-programs.md", "deploy", lenses=("pinhole",), ways=("trace",))
def deploy(lenses: tuple[str, ...] = LENSES, ways: tuple[str, ...] = WAYS) -> Lines:
    yield ["lens", *ways]
    worst = 0.0
    for lens in lenses:
        found = checked(lens, ways)
        worst = max(worst, *(apart for apart, _ in found))
        yield [lens, *(f"{apart:.0e} ({seconds:.0f} s)" for apart, seconds in found)]
    if not worst < ALLOWED:
        raise RuntimeError(f"largest difference {worst:.1e}: more than {ALLOWED:.0e}")
