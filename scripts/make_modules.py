"""Find out what each module of kcal can do, and write the table of docs/reference/modules.md.

    python -m scripts.make_modules            # compare the page with what is found
    python -m scripts.make_modules --write    # write it; compiling and exporting take some minutes

`tests/test_modules.py` runs the same probes, and fails for a module without a case here.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import functools
import importlib
import io
import pickle
import pkgutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, jvp, stack_module_state, vjp, vmap

import kcal
from kcal import Board, CalibrationOptions, Camera, Localizer, Origin, Rig
from kcal.calibrate import CalibrationLayer
from kcal.corners import RefineCorners
from kcal.lens import CameraRays, StereoRectification, Undistort, UndistortImage, Unproject, rotation_from_vector
from kcal.lens.baking import LookupCamera, bake
from kcal.lens.camera_parameters import CameraDistortion, ExtendedDistortion
from kcal.lens.views import Cylinder
from kcal.locate import DisparityRanges, enu_from_cam
from kcal.nets import InverseNet, ResidualNet
from kcal.rig import mounting_covariance
from kcal.solve import LevenbergMarquardt
from kcal.track import ObjectDisparity, PairBoxes
from scripts.shared.page import table

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "modules.md"
# What only others are made of.
BASES = {
    "Float64Module", "StatedModule", "Movable", "LensParameters", "CameraParameters", "ConvertibleCamera", "Network",
    "Operations", "_Method", "AdaptedCamera",
}  # fmt: skip
STEPS = (1e-3, 1e-4, 1e-5, 1e-6)
# Meters by which heights on the ellipsoid are rounded.
ROUNDED = 2e-9
Values = dict[str, Tensor]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """How a module is made and called, and what it is known not to do.

    Args:
        make: a module; of 0 and of 1, made alike with other numbers.
        inputs: keyword arguments of the call; what is floating is differentiated.
        batched: which of them may have one more leading dimension.
        detached: results without any derivative, although they depend on tensors.
        constant: beginnings of names of inputs (`input ...`), parameters and buffers that count as constants.
        rtol: of derivatives against differences.
        forward: whether there are forward derivatives; `grid_sample` of PyTorch has none, and says so.
        functional: whether `torch.func` (vmap, jacrev, jacfwd) works, besides ordinary autograd.
        otherwise: a module that is made for something else, and refuses the state.
        native: which inputs have a batch of their own in front.
        nudge: relative change of inputs between two mapped calls.
        steps: of central differences, shares of a twentieth of each tensor.
    """

    make: Callable[[int], nn.Module]
    inputs: Callable[[], dict[str, Any]]
    batched: tuple[str, ...] = ()
    detached: tuple[str, ...] = ()
    constant: tuple[str, ...] = ()
    rtol: float = 1e-5
    forward: bool = True
    functional: bool = True
    otherwise: Callable[[], nn.Module] | None = None
    native: tuple[str, ...] = ()
    nudge: float = 1e-4
    steps: tuple[float, ...] = STEPS


def noise(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def camera(number: int = 0, size: tuple[int, int] = (640, 480), model: str = "opencv5") -> Camera:
    """A camera with distortion, focal length and center of its own."""
    focal = size[0] * (1.25 + 0.02 * number)
    center = 0.5 * size[0] - 0.5 - 2.0 * number, 0.5 * size[1] + 1.0
    lens = [] if model == "pinhole" else [-0.1 + 0.01 * number, 0.02, 0.001, -0.001, 0.003]
    return Camera.build(focal=(focal, 1.01 * focal), center=center, size=size, model=model, coefficients=lens)


def rig(number: int = 0, size: tuple[int, int] = (640, 480), *, free: bool = True) -> Rig:
    """Two cameras some meters apart, the right one turned."""
    turn = rotation_from_vector(torch.tensor([[0.01, 0.02 - 0.002 * number, -0.01]], dtype=torch.float64))[0]
    made = Rig.pair(camera(number, size), camera(1 - number, size), turn, torch.tensor([-5.0 - number, 0.1, 0.2]))
    return made.free("left", "right") if free else made


PLACES = torch.tensor([[4.0, -8.0, 160.0], [-30.0, 14.0, 120.0], [2.0, 2.0, 40.0]], dtype=torch.float64)


def pairs() -> Values:
    """Marked pixels of three points in both images."""
    left, right = rig()(PLACES)[0].unbind(-2)
    return {"pixels": left.detach() + 0.1 * noise(3, 2), "other": right.detach() + 0.1 * noise(3, 2, seed=1)}


def pair_cov() -> Tensor:
    """Covariances of these pixels."""
    root = 0.1 * noise(3, 4, 4, seed=2)
    return root @ root.mT + 0.1 * torch.eye(4, dtype=torch.float64)


def stereo(number: int) -> Localizer:
    """With every kind of error."""
    own = rig(number)
    own = own.placed(
        origin=Origin(lat=19.07 + number, lon=72.87, height=14.0), heading_deg=30.0 + number, pitch_deg=1.0,
        covariance=mounting_covariance(origin_m=(0.1, 0.1, 0.1), attitude_deg=(0.1, 0.1, 0.1)),
        refraction=0.13 + 0.01 * number,
    )  # fmt: skip
    known = own.relative_root
    assert known is not None
    linked = torch.cat([1e-4 * noise(5, 26, seed=3), 1e-3 * noise(5, 6, seed=4), torch.zeros(5, 1).double()], 1)
    own.relative_root = torch.cat([linked, known])
    return Localizer(own, pixel_sigma=0.3 + 0.1 * number).free()


def stations(number: int = 0) -> Rig:
    """Three cameras kilometers apart."""
    look = torch.stack([enu_from_cam(heading + number, 1.0, 0.5).T for heading in (0.0, 315.0, 45.0)])
    where = torch.tensor([[0.0, 0, 30], [5000.0, 0, 40], [-5000.0, 0, 35 + number]], dtype=torch.float64)
    each = [camera(number), camera(), camera(1)]
    made = Rig(each, ["mill", "church", "mast"], look, center=where, origin=Origin(lat=19.07, lon=72.87, height=14.0))
    return made.free()


def seen_by_stations() -> Tensor:
    """(2, 3, 2) marked pixels."""
    pixels, _ = stations()(torch.tensor([[0.0, 5000, 100], [300.0, 4000, 80]], dtype=torch.float64))
    return pixels.detach() + 0.1 * noise(2, 3, 2)


def several(number: int) -> Localizer:
    """Whose errors are shared."""
    own = stations(number)
    root = torch.cat([own.with_errors(position_m=0.1, attitude_deg=0.01, refraction=0.1), 1e-4 * noise(3, 49, seed=5)])
    return Localizer(own, root=root, clock_sigma=0.01 + 0.01 * number, pixel_sigma=0.3 + 0.1 * number)


SMALL = (32, 24)


def image(size: tuple[int, int] = SMALL, seed: int = 6) -> Tensor:
    """A smooth picture."""
    coarse = noise(1, 1, 5, 6, seed=seed)
    return 100.0 + 20.0 * nn.functional.interpolate(coarse, size[::-1], mode="bicubic", align_corners=True)[0]


def rectification(number: int) -> StereoRectification:
    """Of small images; what is chosen once does not depend on the number."""
    return StereoRectification(rig(number, SMALL, free=False), field_of_view=30.0, size=SMALL)


class Mean(nn.Module):
    """A residual with weights."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([1.0, 2.0 + number, 3.0], dtype=torch.float64))

    def forward(self, x: Tensor, data: Tensor) -> Tensor:
        """Three residuals of one unknown, curved."""
        return self.weight * (x[0] + 0.1 * x[0] ** 2 - data)


def boards() -> dict[str, Any]:
    """Corners of a board in four views."""
    board = Board(columns=5, rows=4, square=0.05).points
    tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
    shift = torch.tensor([-0.1, -0.1, 0.6], dtype=torch.float64)
    pixels, _ = camera(model="opencv5").project(board @ rotation_from_vector(tilts).mT + shift)
    return {"pixels": pixels.detach() + 0.1 * noise(4, 20, 2), "board_points": board}


def boxes() -> Values:
    """Of two moments, with pairs that are clear."""
    left = torch.tensor([[[300.0, 200, 320, 220], [400, 300, 430, 320]]], dtype=torch.float64).repeat(2, 1, 1)
    own = rig(free=False)
    far = 200.0 * own.left.unproject(0.5 * (left[..., :2] + left[..., 2:]).reshape(-1, 2))[0]
    right = own.right.project(own.right_from_left(far))[0].reshape(2, 2, 2)
    half = 0.5 * (left[..., 2:] - left[..., :2])
    return {"left": left + 0.2 * noise(2, 2, 4), "right": torch.cat([right - half, right + half], -1).detach()}


def objects() -> dict[str, Any]:
    """A textured scene far away, and a box in it."""
    size = (96, 72)
    left = 10.0 * nn.functional.interpolate(noise(1, 1, 24, 32, seed=7), size[::-1], mode="bicubic")[0, 0] + 100.0
    return {
        "left": left, "right": left.roll(-2, 1) + 0.5 * noise(*left.shape, seed=8),
        "boxes": torch.tensor([[40.0, 28.0, 60.0, 46.0]], dtype=torch.float64),
        "anchors_right": torch.tensor([[47.6, 37.2]], dtype=torch.float64),
    }  # fmt: skip


def crossings() -> Values:
    """A crossing in each of two images, with its rough place and the side of its squares."""
    x, middle = torch.arange(40.0, dtype=torch.float64), torch.tensor([[20.6, 19.3], [18.9, 20.2]]).double()
    edges = torch.erf((x - middle[..., None]) / 1.4)
    light = 0.3 * edges[:, 1, :, None] * edges[:, 0, None, :] + 0.5 + 0.002 * noise(2, 40, 40)
    return {
        "image": light[:, None], "pixels": middle[:, None].round(), "side": torch.full((2, 1), 15.0).double(),
    }  # fmt: skip


def plain_rig(number: int) -> Rig:
    """Parallel pinholes with a small image."""
    one = Camera.build(focal=(90.0 + number, 90.0), center=(47.5, 35.5), size=(96, 72), model="pinhole")
    return Rig.pair(one, copy.deepcopy(one), torch.eye(3), torch.tensor([-2.0 - number, 0.0, 0.0]))


def tables(number: int) -> LookupCamera:
    """Baked, and moved by some pixels."""
    made = bake(camera(0, SMALL), tolerance=0.1)
    made.pixels_from_chart.coefficients.add_(number)
    return made


POINTS = PLACES / PLACES[:, 2:] * torch.tensor([[2.0], [3.0], [4.0]], dtype=torch.float64)
PIXELS = torch.tensor([[300.3, 200.2], [400.1, 100.7], [50.9, 440.4]], dtype=torch.float64)
ANGLES = torch.tensor([[0.1, 0.2], [-0.3, 0.1], [0.2, -0.2]], dtype=torch.float64)

CASES: dict[str, Case] = {
    "Camera": Case(
        make=camera, inputs=lambda: {"points_cam": POINTS}, batched=("points_cam",),
        otherwise=lambda: camera(size=(600, 480)),
    ),
    "Unproject": Case(
        make=lambda n: Unproject(camera(n)), inputs=lambda: {"pixels": PIXELS}, batched=("pixels",),
        otherwise=lambda: Unproject(camera(size=(600, 480))),
    ),
    "ExtendedDistortion": Case(
        make=lambda n: ExtendedDistortion([-0.1 + 0.01 * n, 0.02], "ext20"), inputs=lambda: {"normalized": ANGLES},
        batched=("normalized",),
    ),
    "CameraDistortion": Case(
        make=lambda n: CameraDistortion(camera(n)), inputs=lambda: {"normalized": ANGLES}, batched=("normalized",),
    ),
    "LookupCamera": Case(
        make=tables, inputs=lambda: {"points_cam": POINTS}, batched=("points_cam",),
    ),
    "Cylinder": Case(
        make=lambda n: Cylinder(focal=100.0 + n, center=(157.0, 50.0), size=(315, 101)), inputs=dict,
        otherwise=lambda: Cylinder(focal=100.0, center=(157.0, 50.0), size=(310, 101)),
    ),
    "CameraRays": Case(
        make=lambda n: CameraRays(camera(n, (6, 4))),
        inputs=lambda: {"viewmats": torch.eye(4, dtype=torch.float64)[None], "dtype": torch.float64},
        batched=("viewmats",), nudge=1e-6, steps=(1e-5, 1e-6), constant=("depths", "directions"),
    ),
    "Undistort": Case(
        make=lambda n: Undistort(camera(n, SMALL), camera(0, SMALL, "pinhole")), inputs=lambda: {"image": image()},
        batched=("image",), forward=False,
        otherwise=lambda: Undistort(camera(0, SMALL), camera(0, SMALL, "pinhole"), at=10.0),
    ),
    "UndistortImage": Case(
        make=lambda n: UndistortImage(camera(n, SMALL), camera(0, SMALL, "pinhole")),
        inputs=lambda: {"image": image()}, batched=("image",), forward=False,
    ),
    "StereoRectification": Case(
        make=rectification, inputs=lambda: {"left": image(), "right": image(seed=8)}, batched=("left", "right"),
        constant=("rig.rotation", "rig.translation"), forward=False,
    ),
    "Rig": Case(
        make=stations, inputs=lambda: {"points": 10.0 * PLACES + torch.tensor([0.0, 4000, 0], dtype=torch.float64)},
        batched=("points",),
    ),
    "Localizer": Case(
        make=stereo, inputs=lambda: {**pairs(), "cov": pair_cov()}, batched=("pixels", "other", "cov"),
        detached=("misfit",),
    ),
    "Localizer (several cameras)": Case(
        make=several, inputs=lambda: {"pixels": seen_by_stations(), "velocity": noise(2, 3, 2, seed=9)},
        batched=("pixels", "velocity"), detached=("misfit",), rtol=1e-4,
    ),
    "DisparityRanges": Case(
        make=lambda n: DisparityRanges(rectification(n), disparity_sigma=0.3 + 0.1 * n),
        inputs=lambda: {"disparity": torch.full(SMALL[::-1], 2.0, dtype=torch.float64)}, batched=("disparity",),
        detached=("range", "sigma", "low", "high"),
    ),
    "PairBoxes": Case(
        make=lambda n: PairBoxes(rig(n)), inputs=boxes, functional=False, constant=("rig.",), native=("left", "right"),
    ),
    "ObjectDisparity": Case(
        make=lambda n: ObjectDisparity(plain_rig(n)), inputs=objects, functional=False,
        rtol=0.3,  # the scale of the biweight counts as constant
        detached=("covariance", "score", "off_line", "by_anchor"), constant=("rig.", "input boxes", "input anchors"),
    ),
    "InverseNet": Case(
        make=lambda n: InverseNet(camera(n)), inputs=lambda: {"distorted": ANGLES}, batched=("distorted",),
        otherwise=lambda: InverseNet(camera(), radial=False),
    ),
    "ResidualNet": Case(make=lambda n: ResidualNet(camera(n)), inputs=dict),
    "LevenbergMarquardt": Case(
        make=lambda n: LevenbergMarquardt(Mean(n)),
        inputs=lambda: {"start": torch.zeros(1, dtype=torch.float64), "data": torch.arange(3.0, dtype=torch.float64)},
        batched=("start", "data"), constant=("input start",), detached=("cost", "history"),
        otherwise=lambda: LevenbergMarquardt(Mean(0), backward="none"),
    ),
    "RefineCorners": Case(
        make=lambda _: RefineCorners(), inputs=crossings, functional=False, native=("image", "pixels", "side"),
        detached=("covariance", "blur"), constant=("input pixels", "input side"),
        rtol=0.01,  # what corners of an image know together counts as constant
    ),
    "CalibrationLayer": Case(
        make=lambda n: CalibrationLayer((640, 480), CalibrationOptions(model="opencv5")), inputs=boards,
        functional=False, rtol=1e-4,
        otherwise=lambda: CalibrationLayer((640, 480), CalibrationOptions(model="opencv4")),
    ),
}  # fmt: skip


def modules() -> dict[str, type[nn.Module]]:
    """Every module class of the package by its name."""
    for found in pkgutil.walk_packages(kcal.__path__, "kcal."):
        importlib.import_module(found.name)

    def below(kind: type[nn.Module]) -> Iterator[type[nn.Module]]:
        for one in kind.__subclasses__():
            yield one
            yield from below(one)

    return {kind.__name__: kind for kind in below(nn.Module) if kind.__module__.startswith("kcal.")}


def results(module: nn.Module, inputs: dict[str, Any], state: Values | None = None) -> Values:
    """Floating results of a call by name."""
    data = dict(inputs)
    first = (data.pop("start"), data.pop("data")) if isinstance(module, LevenbergMarquardt) else ()
    if isinstance(module, Cylinder):  # which has no `forward`
        names = dict(module.named_buffers())
        own = copy.copy(module)
        own._buffers = {**names, **(state or {})}
        found: Any = (*own.project(POINTS), own.unproject(PIXELS)[0])
    else:
        found = functional_call(module, state or {}, first, data)
    if isinstance(found, Tensor):
        found = (found,)
    if dataclasses.is_dataclass(found):
        found = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
        found = {**found, "x": found["state"][0]} if "state" in found else found
    elif isinstance(found, tuple):
        found = found._asdict() if hasattr(found, "_asdict") else {str(i): part for i, part in enumerate(found)}
    return {name: part for name, part in found.items() if isinstance(part, Tensor) and part.is_floating_point()}


def floating(case: Case, module: nn.Module) -> Values:
    """All floating tensors that enter: inputs, parameters, buffers."""
    inputs = {f"input {name}": value for name, value in case.inputs().items() if isinstance(value, Tensor)}
    state = dict([*module.named_parameters(), *module.named_buffers()])
    return {name: t.detach() for name, t in {**inputs, **state}.items() if t.is_floating_point() and t.numel()}


def derivatives(case: Case, *, seed: int = 1) -> tuple[set[str], list[str]]:
    """By what a module has derivatives, and where backward, forward and central differences differ.

    Results are summed with random weights, and tensors are moved along random directions.
    """
    module = case.make(0)
    values, inputs = floating(case, module), case.inputs()

    def call(v: Values) -> Values:
        data = {**inputs, **{name[6:]: value for name, value in v.items() if name.startswith("input ")}}
        found = results(module, data, {name: value for name, value in v.items() if not name.startswith("input ")})
        return {name: torch.where(part.isfinite(), part, 0.0) for name, part in found.items()}

    base = call(values)
    weights = {name: noise(*part.shape, seed=seed) for name, part in base.items()}
    size = {name: float((weights[name] * part).abs().sum()) for name, part in base.items()}

    def summed(v: Values) -> Tensor:
        found = call(v)
        return torch.stack([(weights[name] * found[name]).sum() for name in base])

    along = {}
    for name, value in values.items():
        largest = float(value.abs().max())
        step = 0.05 * noise(*value.shape, seed=seed) * value.abs().clamp(min(0.3 * largest or 1e-3, 1e3), 1e3)
        if name.endswith("pose_step"):
            # What is not freed is held, whatever its step.
            step = step * module.get_buffer(name.replace("pose_step", "pose_mask"))
        along[name] = 0.5 * (step + step.mT) if name.endswith("cov") else step
    live = {name: value.clone().requires_grad_() for name, value in values.items()}
    out = summed(live)
    back = []
    for row in out:
        by = [None] * len(live)
        if row.requires_grad:
            by = torch.autograd.grad(row, list(live.values()), retain_graph=True, allow_unused=True)  # type: ignore
        back.append([0.0 if g is None else float((g * along[n]).sum()) for g, n in zip(by, live, strict=True)])
    tangents: Values | None = None
    if case.functional:
        _, pull = vjp(summed, values)[:2]
        rows = [pull(row)[0] for row in torch.eye(len(base), dtype=torch.float64)]
        tangents = {n: torch.stack([(row[n] * along[n]).sum() for row in rows]) for n in values}

    @functools.cache
    def differences(name: str, h: float) -> Tensor:
        ends = [
            summed({**values, name: (values[name] + k * h * along[name]).requires_grad_()}).detach()
            for k in (1, -1, 2, -2)
        ]
        return (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h)

    wrong, found = [], set()
    for number, name in enumerate(values):
        ways = {"autograd": torch.tensor([row[number] for row in back], dtype=torch.float64)}
        if tangents is not None:
            ways["jacrev"] = tangents[name]
        if case.functional and case.forward:
            ways["jacfwd"] = jvp(lambda x: summed({**values, name: x}), (values[name],), (along[name],))[1]  # noqa: B023
        constant = name.startswith(case.constant) if case.constant else False
        for which, part in enumerate(base):
            noisy = ROUNDED if part == "geodetic" else 0.0
            for way, got in ways.items():
                mine = float(got[which])
                if constant or part in case.detached:
                    if mine != 0.0:
                        wrong.append(f"{part} by {name}: {way} {mine:g}, documented as constant")
                    continue
                truths = []
                for h in case.steps[: 2 if noisy else None]:
                    truths.append(float(differences(name, h)[which]))
                    bound = case.rtol * max(abs(truths[-1]), abs(mine)) + (noisy + 1e-15 * size[part]) / h + 1e-12
                    if abs(truths[-1] - mine) <= bound:
                        break
                else:
                    wrong.append(f"{part} by {name}: {way} {mine:.8g}, differences {truths}")
                if abs(mine) > 1e-9 * size[part]:  # the start of a search leaves rounding
                    found.add(name)
    return found, wrong


def kinds(case: Case, names: set[str]) -> str:
    """Inputs, parameters, buffers: which of them have derivatives."""
    own = case.make(0)
    groups = {
        "inputs": any(name.startswith("input ") for name in names),
        "parameters": any(name in names for name, _ in own.named_parameters()),
        "buffers": any(name in names for name, _ in own.named_buffers()),
    }
    return ", ".join(name for name, there in groups.items() if there) or "none"


def close(one: Values, other: Values, rtol: float = 1e-9) -> bool:
    """Whether two calls gave the same, measured by the largest finite number of each result."""
    for name, part in one.items():
        size = float(torch.where(part.isfinite(), part, 0.0).abs().max().detach()) if part.numel() else 0.0
        if not torch.allclose(part, other[name].to(part), rtol=rtol, atol=rtol * size, equal_nan=True):
            return False
    return True


def has_batches(case: Case) -> bool:
    """Whether one more leading dimension of the inputs is one more of the results, with the same values."""
    module, inputs = case.make(0), case.inputs()
    if case.native:
        whole = results(module, inputs)
        each = [results(module, {**inputs, **{n: inputs[n][i : i + 1] for n in case.native}}) for i in (0, 1)]
        return close(whole, {name: torch.cat([one[name] for one in each]) for name in whole})
    if not case.batched:
        return False
    single = results(module, inputs)
    several = results(module, {**inputs, **{name: torch.stack([inputs[name]] * 2) for name in case.batched}})
    skip = {"history"}
    wanted = {name: part.expand(2, *part.shape) for name, part in single.items() if name not in skip}
    return close(wanted, {name: several[name] for name in wanted})


def maps_inputs(case: Case) -> bool:
    """Whether `vmap` over the inputs gives what calls one by one give."""
    if not (case.batched and case.functional):
        return False
    module, inputs = case.make(0), case.inputs()
    stacked = {name: torch.stack([inputs[name], inputs[name] * (1 + case.nudge)]) for name in case.batched}
    try:
        found = vmap(lambda mapped: results(module, {**inputs, **mapped}))(stacked)
    except (RuntimeError, kcal.KcalError):
        return False
    each = [results(module, {**inputs, **{name: value[i] for name, value in stacked.items()}}) for i in (0, 1)]
    # A graph takes a fixed number of steps, so that values agree to what is stated where they are fixed.
    return all(close(one, {name: part[i] for name, part in found.items()}, 1e-5) for i, one in enumerate(each))


def maps_modules(case: Case) -> bool:
    """Whether `stack_module_state` over two modules and `vmap` give what each gives."""
    if not case.functional:
        return False
    made, inputs = [case.make(0), case.make(1)], case.inputs()
    try:
        parameters, buffers = stack_module_state(made)
        shell = copy.deepcopy(made[0])
        found = vmap(lambda state: results(shell, inputs, state))({**parameters, **buffers})
    except (RuntimeError, kcal.KcalError):
        return False
    return all(
        close(results(one, inputs), {name: part[i] for name, part in found.items()}, 1e-5) for i, one in enumerate(made)
    )


def moves(case: Case) -> bool:
    """Whether all of a module is on the device to which it was moved."""
    moved = case.make(0).to("meta")
    return all(part.is_meta for part in [*moved.parameters(), *moved.buffers()])


def agrees(case: Case, made: Callable[[nn.Module, dict[str, Any]], Any]) -> bool:
    """Whether what is made of a module gives the results of the module itself."""
    module, inputs = case.make(0), case.inputs()
    if isinstance(module, Cylinder | LevenbergMarquardt):
        return False
    wanted = results(module, inputs)
    try:
        return close(wanted, results(made(module, inputs), inputs), 1e-5)
    except Exception:  # of many kinds; none of them is a wrong number
        return False


def compiles(case: Case) -> bool:
    """Whether it is one graph without breaks, with the same results."""
    torch.compiler.reset()
    return agrees(case, lambda module, _: torch.compile(module, backend="eager", fullgraph=True))


def exports(case: Case) -> bool:
    """Whether `torch.export` makes a program of it, with the same results."""
    return agrees(case, lambda module, inputs: torch.export.export(module, (), inputs).module())


def loaded(case: Case) -> bool:
    """Whether a module that is made with other numbers gives the results of the one whose state it loads."""
    one, other, inputs = case.make(0), case.make(1), case.inputs()
    wanted = results(one, inputs)
    buffer = io.BytesIO()
    torch.save(one.state_dict(), buffer)
    buffer.seek(0)
    other.load_state_dict(torch.load(buffer, weights_only=True))
    return close(wanted, results(other, inputs))


def copies(case: Case) -> bool:
    """Whether deep copies and pickled ones give the same."""
    one, inputs = case.make(0), case.inputs()
    wanted = results(one, inputs)
    return close(wanted, results(copy.deepcopy(one), inputs)) and close(
        wanted, results(pickle.loads(pickle.dumps(one)), inputs)
    )


COLUMNS = {
    "Batch": has_batches, "vmap over inputs": maps_inputs, "vmap over modules": maps_modules, "Moves": moves,
    "compile": compiles, "export": exports,
}  # fmt: skip
SLOW = ("compile", "export")


def row(name: str, columns: tuple[str, ...] = tuple(COLUMNS)) -> dict[str, str]:
    """One row of the table."""
    case = CASES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {"Module": f"`{name}`", "Gradients by": kinds(case, derivatives(case)[0])}
        constant = [*(f"by {part.removeprefix('input ').rstrip('._')}" for part in case.constant), *case.detached]
        found["Without gradient"] = ", ".join(f"`{part}`" if " " not in part else part for part in constant) or "-"
        return {**found, **{column: "yes" if COLUMNS[column](case) else "no" for column in columns}}


def table_rows(text: str) -> dict[str, dict[str, str]]:
    """The table of a page, by module."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {one[0].strip("`"): dict(zip(cells[0], one, strict=True)) for one in cells[2:]}


def page(rows: list[dict[str, str]]) -> str:
    """The whole page."""
    head = list(rows[0])
    lines = table(head, ([one[column] for column in head] for one in rows))
    before = PAGE.read_text(encoding="utf-8").split("\n|", 1)[0] if PAGE.exists() else "# Modules\n"
    return before.rstrip() + "\n\n" + "\n".join(lines) + "\n"


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the page")
    options = parser.parse_args()
    text = page([row(name) for name in sorted(CASES)])
    if options.write:
        PAGE.write_text(text, encoding="utf-8")
    elif text != PAGE.read_text(encoding="utf-8"):
        raise SystemExit("docs/reference/modules.md is not what is found; run with --write")


if __name__ == "__main__":
    main()
