"""Programs of `torch.export` are saved and loaded with the named tuples that modules return."""

import importlib
import inspect
import io
import pkgutil
import subprocess
import sys
import typing
from pathlib import Path

import pytest
import torch
from locate_rigs import pinhole_rig
from torch import Tensor, nn

import kcal
from kcal import Localizer, Origin
from kcal.lens.pair_errors import RigCovariance


def named_tuples(kind: object) -> set[type[tuple]]:
    """Those in a type, also inside others."""
    found = {each for part in typing.get_args(kind) for each in named_tuples(part)}
    if isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields"):
        found |= {kind, *(each for part in typing.get_type_hints(kind).values() for each in named_tuples(part))}
    return found


def results_of_modules() -> list[type[tuple]]:
    """The named tuples that the `forward` of a module of the package returns."""
    found: set[type[tuple]] = set()
    for info in pkgutil.walk_packages(kcal.__path__, "kcal."):
        if info.name.startswith(("kcal.cli", "kcal.__main__")):
            continue
        for each in vars(importlib.import_module(info.name)).values():
            if inspect.isclass(each) and issubclass(each, nn.Module) and "forward" in vars(each):
                module = sys.modules[each.__module__]
                if each.__module__ == info.name:
                    found |= named_tuples(typing.get_type_hints(each.forward, vars(module)).get("return"))
    return sorted(found, key=lambda kind: kind.__name__)


class Returns(nn.Module):
    """A module that returns a result of this kind."""

    def __init__(self, kind: type[tuple]) -> None:
        super().__init__()
        self.kind = kind

    def forward(self, x: Tensor) -> tuple:
        return self.kind(*(x + number for number in range(len(self.kind._fields))))  # type: ignore[attr-defined]


def test_every_result_is_saved_and_loaded() -> None:
    kinds = results_of_modules()
    assert {"Localization", "RangeImage"} <= {kind.__name__ for kind in kinds}
    for kind in kinds:
        file, x = io.BytesIO(), torch.ones(2)
        torch.export.save(torch.export.export(Returns(kind), (x,)), file)
        file.seek(0)
        found = torch.export.load(file).module()(x)
        assert type(found) is kind
        assert torch.equal(found[-1], x + len(found) - 1)


@pytest.mark.slow
def test_a_program_runs_in_another_process(tmp_path: Path) -> None:
    """It needs the name of its result there, and nothing else of kcal."""
    rig = pinhole_rig()
    rig.covariance = RigCovariance.of(rig, pose=1e-8 * torch.eye(6).double())
    origin = Origin(lat=19.0, lon=72.0, height=10.0)
    module, path = Localizer(rig.placed(origin=origin, heading_deg=20.0)), tmp_path / "locate.pt2"
    left = torch.tensor([[980.0, 540.0], [960.0, 540.0], [950.0, 530.0]], dtype=torch.float64)
    right = left - torch.tensor([9.0, 0.1], dtype=torch.float64)
    count = torch.export.Dim("count", min=2)
    torch.export.save(torch.export.export(module, (left, right), dynamic_shapes=({0: count}, {0: count})), path)
    lines = (
        "import sys, torch; from kcal.locate.localizer import Localization",
        "run = torch.export.load(sys.argv[1]).module()",
        "left = torch.tensor([[980.0, 540.0], [960.0, 540.0]], dtype=torch.float64)",
        "found = run(left, left - torch.tensor([9.0, 0.1], dtype=torch.float64))",
        "assert isinstance(found, Localization)",
        "torch.save(found.enu, sys.argv[2])",
    )
    subprocess.run([sys.executable, "-c", "\n".join(lines), str(path), str(tmp_path / "points")], check=True)
    torch.testing.assert_close(torch.load(tmp_path / "points"), module(left[:2], right[:2]).enu, rtol=0, atol=1e-9)
