"""Closed-form Jacobians equal automatic and numerical ones, for every model, term and free subset.

This shows that derivatives fit the values; that the values are right is shown by `test_opencv_values` and
`test_lens_conventions`.
"""

import itertools

import pytest
import torch
from differences import numeric
from lenses import HYBRID, MODELS, distort_with_jacobian, parameters, strong
from torch import Tensor
from torch.func import jacfwd

from kcal.lens.model import LensModel
from kcal.lens.projection import project_components
from scripts.shared.distorted import distort

STATES = ("zero", "strong")
# (3, N): about the axis, on both coordinate axes, in all four quadrants, near and far.
POINTS = torch.tensor(
    [
        [0.0, 0.5, 0.0, 0.9, -1.1, -0.5, 2.0, 1e-9],
        [0.0, 0.0, -1.2, 0.4, 0.7, -0.3, -1.5, 1e-9],
        [1.0, 2.0, 3.0, 1.7, 2.5, 0.9, 9.0, 4.0],
    ],
    dtype=torch.float64,
)


def state(model: str | LensModel, kind: str) -> Tensor:
    lens = strong(model)
    return parameters(model, lens if kind == "strong" else torch.zeros_like(lens))


@pytest.mark.parametrize("kind", STATES)
@pytest.mark.parametrize("model", [*MODELS, HYBRID], ids=str)
class TestProjection:
    def test_by_camera(self, model: str | LensModel, kind: str) -> None:
        lens, at = LensModel.named(model), state(model, kind)

        def pixels(values: Tensor) -> Tensor:
            return project_components(POINTS, values, lens).pixels

        result = project_components(POINTS, at, lens, range(at.numel()))
        assert bool(result.regular.all())
        analytic = result.by_camera.movedim(-3, -1)
        torch.testing.assert_close(analytic, jacfwd(pixels)(at), rtol=1e-12, atol=1e-14)
        # Fourth-order differences with this step leave rounding (1e-16 / 1e-3) and truncation near 1e-12.
        torch.testing.assert_close(analytic, numeric(pixels, at, 1e-3), rtol=0, atol=1e-10)

    def test_by_point(self, model: str | LensModel, kind: str) -> None:
        lens, at = LensModel.named(model), state(model, kind)
        result = project_components(POINTS, at, lens, range(5))
        for n in range(POINTS.shape[1]):

            def pixels(point: Tensor) -> Tensor:
                return project_components(point[:, None], at, lens).pixels[:, 0]

            point = POINTS[:, n]
            analytic = result.by_point[..., n].T
            torch.testing.assert_close(analytic, jacfwd(pixels)(point), rtol=1e-12, atol=1e-14)
            # As above; derivatives by the point are steeper at the edge, hence ten times the room.
            torch.testing.assert_close(analytic, numeric(pixels, point, 1e-3), rtol=0, atol=1e-9)

    def test_any_subset_of_blocks(self, model: str | LensModel, kind: str) -> None:
        """Freeing fewer parameters gives the same columns, bit for bit, in the order asked for."""
        lens, at = LensModel.named(model), state(model, kind)
        full = project_components(POINTS, at, lens, range(at.numel())).by_camera
        names = ("fx", "fy", "cx", "cy", "skew", *lens.names)
        blocks = {
            "focal": [0, 1],
            "center": [2, 3],
            "skew": [4],
            "numerator": [5 + i for i in lens.numerator_index],
            "denominator": [5 + i for i in lens.denominator_index],
            "tangential": [names.index("p1"), names.index("p2")] if lens.tangential else [],
            "prism": [5 + i for row in lens.prism_index for i in row],
            "tilt": [names.index("tau_x"), names.index("tau_y")] if lens.tilt else [],
            "shape": [names.index("shape")] if lens.hybrid else [],
            "pupil": [names.index("pupil1"), names.index("pupil2")] if lens.hybrid else [],
            "Zernike": [i for i, name in enumerate(names) if name.startswith("z")],
        }
        present = [rows for rows in blocks.values() if rows]
        chosen = (c for r in range(len(present) + 1) for c in itertools.combinations(present, r))
        subsets = [list(itertools.chain(*rows)) for rows in chosen]
        subsets += [[i] for i in range(len(names))]
        subsets += [list(reversed(range(len(names))))]
        for wanted in subsets:
            part = project_components(POINTS, at, lens, wanted)
            assert torch.equal(part.by_camera, full[wanted]), [names[i] for i in wanted]

    def test_distortion_alone(self, model: str | LensModel, kind: str) -> None:
        at = state(model, kind)[5:]
        normalized = (POINTS[:2] / POINTS[2]).T
        value, by_point, by_coefficients = distort_with_jacobian(normalized, at, model)
        assert torch.equal(value, distort(normalized, at, model))
        torch.testing.assert_close(
            by_coefficients, jacfwd(lambda c: distort(normalized, c, model))(at), rtol=1e-12, atol=1e-14
        )
        dense = jacfwd(lambda p: distort(p, at, model))(normalized)
        own = torch.stack([dense[n, :, n] for n in range(normalized.shape[0])])
        torch.testing.assert_close(by_point, own, rtol=1e-12, atol=1e-14)


def test_states_reach_every_term() -> None:
    """The strong state is strong: without any one of its coefficients the pixels would be elsewhere."""
    for model in (*MODELS, HYBRID):
        at = state(model, "strong")
        pixels = project_components(POINTS, at, LensModel.named(model)).pixels
        for i in range(5, at.numel()):
            without = at.clone()
            without[i] = 0.0
            other = project_components(POINTS, without, LensModel.named(model)).pixels
            assert float((pixels - other).abs().max()) > 1e-5


def test_no_derivative_is_formed_unasked() -> None:
    result = project_components(POINTS, state("ext24", "strong"), LensModel.named("ext24"))
    assert result.by_point.numel() == 0
    assert result.by_camera.numel() == 0
