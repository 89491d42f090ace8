"""Every `nn.Module` of the package: derivatives, batches, states, copies, vmap, devices, and the page about them."""

import warnings
from collections.abc import Iterator

import pytest
import torch

from scripts.make_modules import (
    BASES,
    CASES,
    COLUMNS,
    PAGE,
    SLOW,
    Case,
    copies,
    derivatives,
    floating,
    has_batches,
    kinds,
    loaded,
    maps_inputs,
    maps_modules,
    modules,
    moves,
    results,
    row,
    table_rows,
)

ALL = [pytest.param(case, name, id=name) for name, case in CASES.items()]
each = pytest.mark.parametrize(("case", "name"), ALL)


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def written(name: str) -> dict[str, str]:
    """What the page says of a module."""
    return table_rows(PAGE.read_text(encoding="utf-8"))[name]


def test_each_module_has_a_case_and_a_row() -> None:
    """A module that is new fails here until it has a case in scripts/make_modules.py."""
    assert set(CASES) == set(table_rows(PAGE.read_text(encoding="utf-8")))
    assert set(modules()) - BASES == {name.partition(" (")[0] for name in CASES}


@pytest.mark.slow
@each
def test_derivatives(case: Case, name: str) -> None:
    """Backward, forward and central differences agree by every input, parameter and buffer, for every result."""
    found, wrong = derivatives(case)
    assert not wrong
    assert written(name)["Gradients by"] == kinds(case, found)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.functional and not case.forward])
def test_what_has_no_forward_derivatives_says_so(name: str) -> None:
    case = CASES[name]
    module, inputs = case.make(0), case.inputs()
    parameter = next(n for n, p in module.named_parameters() if p.is_floating_point())
    with pytest.raises(NotImplementedError, match="forward AD"):
        torch.func.jacfwd(lambda x: results(module, inputs, {parameter: x}))(floating(case, module)[parameter])


@each
def test_batches(case: Case, name: str) -> None:
    assert written(name)["Batch"] == ("yes" if has_batches(case) else "no")


@each
def test_vmap(case: Case, name: str) -> None:
    """Mapped calls give the values of single ones, or an error."""
    assert written(name)["vmap over inputs"] == ("yes" if maps_inputs(case) else "no")
    assert written(name)["vmap over modules"] == ("yes" if maps_modules(case) else "no")


@each
def test_a_state_is_taken_whole(case: Case, name: str) -> None:
    """Found: a localizer took poses and kept its own origin, sigma and refraction: 1,934 m for 1,610 m."""
    assert loaded(case)
    assert copies(case)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.otherwise])
def test_another_state_is_refused(name: str) -> None:
    case = CASES[name]
    assert case.otherwise is not None
    with pytest.raises((RuntimeError, ValueError), match=r"state"):
        case.otherwise().load_state_dict(case.make(0).state_dict())


@each
def test_precision_and_devices(case: Case, name: str) -> None:
    """Geometry is float64 whatever comes in and whatever is asked of the module; all of it moves."""
    assert written(name)["Moves"] == ("yes" if moves(case) else "no")
    module, inputs = case.make(0), case.inputs()
    kinds_before = [t.dtype for t in (*module.parameters(), *module.buffers())]
    assert [
        t.dtype for t in (*module.half().parameters(), *module.buffers())
    ] == kinds_before or name == "LevenbergMarquardt"
    if name in ("LevenbergMarquardt", "Cylinder", "ObjectDisparity"):
        return
    single = {k: v.float() if isinstance(v, torch.Tensor) and v.is_floating_point() else v for k, v in inputs.items()}
    double = {k: v.double() if isinstance(v, torch.Tensor) and v.is_floating_point() else v for k, v in single.items()}
    wanted, found = results(module, double), results(module, single)
    for part, value in wanted.items():
        images = name in ("Undistort", "UndistortImage", "StereoRectification")
        assert found[part].dtype == (torch.float32 if images else value.dtype)
        size = float(value[value.isfinite()].abs().amax()) if value.isfinite().any() else 1.0
        # Corners are fitted to an image of float32 in float32.
        relative, absolute = (1e-4, 1e-5) if images else (1e-6, 1e-7) if name == "RefineCorners" else (1e-9, 1e-9)
        torch.testing.assert_close(found[part].double(), value, rtol=relative, atol=absolute * size)


@pytest.mark.slow
@each
def test_graphs(case: Case, name: str) -> None:
    for column in SLOW:
        assert written(name)[column] == ("yes" if COLUMNS[column](case) else "no"), column


def test_the_table_is_made_by_the_probes() -> None:
    """What `row` finds of one module is its row of the page."""
    columns = tuple(column for column in COLUMNS if column not in SLOW)
    assert row("Cylinder", columns).items() <= written("Cylinder").items()
