"""The chart on which the inverse net works, and its units: what the net sees and answers has a length of one."""

from __future__ import annotations

import math

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.nets.inverse import InverseNet, InverseNetOptions, train_inverse

BARREL = Camera.build(focal=(300, 300), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.03, 1e-3, 0, 0])


def test_the_chart_is_undone_up_to_89_9_degrees() -> None:
    net = InverseNet(BARREL)
    direction = math.cos(0.7), math.sin(0.7)
    tangents = torch.tensor([math.tan(math.radians(angle)) for angle in (0, 30, 80, 89.85, 89.99)], dtype=torch.float64)
    x, y = tangents * direction[0], tangents * direction[1]
    back = net.from_chart(*net.to_chart(x, y))
    # 2 tan(angle / 2): stereographic.
    torch.testing.assert_close(
        net.to_chart(x, y)[0][1], torch.tensor(2 * math.tan(math.radians(15)) * direction[0]).double()
    )
    torch.testing.assert_close(back[0][:4], x[:4], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(back[1][:4], y[:4], rtol=1e-9, atol=1e-12)
    beyond = torch.stack(back)[:, 4]
    assert abs(math.degrees(math.atan(float(beyond.norm()))) - 89.9) < 1e-3
    assert math.isclose(float(beyond[1] / beyond[0]), math.tan(0.7), rel_tol=1e-9)


def test_the_net_sees_and_answers_lengths_of_one_at_most() -> None:
    net = train_inverse(BARREL, InverseNetOptions(hidden=2, samples=(6, 5), iterations=1)).net
    nodes = [-torch.cos(math.pi * (torch.arange(n, dtype=torch.float64) + 0.5) / n) for n in (6, 5)]
    pixels = torch.cartesian_prod(319.5 + 336 * nodes[0], 239.5 + 252 * nodes[1])  # with a margin of 5 %
    rays, valid = BARREL.unproject(pixels)
    assert bool(valid.all())
    distorted = (pixels - torch.tensor([320.0, 240.0])) / 300
    guess = net.closed_form(*distorted.unbind(-1))
    truth = torch.stack(net.to_chart(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]))
    assert math.isclose(float(guess.norm(dim=0).max()), float(net.reach), rel_tol=1e-9)
    assert math.isclose(float((truth - guess).norm(dim=0).max()), float(net.amplitude), rel_tol=1e-6)


def test_a_fisheye_has_its_own_chart() -> None:
    fisheye = Camera.build(
        focal=(300, 300), center=(320, 240), size=(640, 480), coefficients=[0.02, 0, 0, 0], model="fisheye4"
    )
    net = InverseNet(fisheye)
    x, y = torch.tensor([[0.3, 2.0], [0.1, -0.4]], dtype=torch.float64)
    for mapped in (net.to_chart(x, y), net.from_chart(x, y)):
        assert torch.equal(torch.stack(mapped), torch.stack([x, y]))


@pytest.mark.parametrize(
    ("name", "least", "less"), [("hidden", 1, 0), ("iterations", 1, 0), ("samples", (2, 2), (1, 2))]
)
def test_the_least_that_options_may_be(name: str, least: object, less: object) -> None:
    InverseNetOptions(**{name: least})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="must be at least 1, samples at least 2 x 2"):
        InverseNetOptions(**{name: less})  # type: ignore[arg-type]
