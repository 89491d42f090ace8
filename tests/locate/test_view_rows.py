"""Rows of a filter: against the rig's projection, and against what fits points to their optimum."""

from __future__ import annotations

import torch

from kcal import Camera, Localizer, Origin, Rig
from kcal.locate import enu_from_cam
from kcal.locate.views import shared_pixels
from kcal.pipeline.measurements import ALONE_M, known_views, view_rows


def mixed_stations() -> Rig:
    """Three cameras of two lens models, 1.5 km apart, with errors of attitude, lens and refraction."""
    curved = Camera.build(focal=(2000, 2010), center=(960, 540), size=(1920, 1080), coefficients=[-0.2, 0.05, 1e-3])
    plain = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
    look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 345.0, 15.0)])
    places = torch.tensor([[0.0, 0.0, 30.0], [1500.0, 0.0, 40.0], [-1500.0, 0.0, 35.0]], dtype=torch.float64)
    origin = Origin(lat=45.0, lon=6.0, height=100.0)
    rig = Rig([curved, curved, plain], ["a", "b", "c"], look, center=places, origin=origin, refraction=0.0)
    lens = torch.zeros(3, rig.quantities, dtype=torch.float64)
    lens[0, 0], lens[1, 5], lens[2, sum(rig.sizes[:2]) + 1], lens[2, -1] = 0.5, 1e-3, 0.7, 0.02
    rig.root = torch.cat([rig.with_errors(attitude_deg=0.01), lens])
    return rig


def test_rows_are_those_of_the_rig() -> None:
    rig = mixed_stations()
    localize = Localizer(rig)
    points = torch.tensor([[0.0, 5000.0, 100.0], [300.0, 4000.0, 50.0], [-200.0, 6000.0, 80.0]], dtype=torch.float64)
    pixels, seen = rig(points)
    assert bool(seen.all())
    seen[1, 0], seen[2, :2] = False, False
    mix = torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    covariance = (mix @ mix.T + torch.eye(6)).expand(3, 6, 6)
    posed, common = localize.posed, localize.common
    marks = torch.where(seen[..., None], pixels + torch.tensor([0.3, 0.0]), torch.nan)
    found = view_rows(known_views(posed, common), marks, seen, covariance)
    assert found.anchor.tolist() == [0, 1, 2]
    assert found.alone.tolist() == [False, False, True]
    assert bool(found.fitted.all())
    torch.testing.assert_close(float(found.inverse[2]) * ALONE_M, 1.0)
    # Pixels at the place that rows are linear around, and where it moves.
    steps = torch.cat([torch.zeros(1, 3), torch.eye(3)]).double() * torch.tensor([1e-6, 1e-6, 1e-9])
    first, second = found.sides
    around = [
        rig((found.place + (found.direction + a * first + b * second) / (found.inverse + c)).T)[0]
        for a, b, c in steps.tolist()
    ]
    there = seen[..., None]
    off = torch.where(there, around[0] - marks, 0.0).flatten(1).T
    torch.testing.assert_close(found.residual, off, rtol=0, atol=1e-6)
    for axis in range(3):
        slope = torch.where(there, (around[1 + axis] - around[0]) / steps[1 + axis, axis], 0.0).flatten(1).T
        scale = float(slope.abs().max())
        torch.testing.assert_close(found.jacobian[:, axis] / scale, slope / scale, rtol=0, atol=2e-3)
    assert common is not None
    at = found.place.T, found.direction.T, found.inverse
    shared = shared_pixels(posed, common, at, seen, torch.ones(()).double())
    torch.testing.assert_close(found.shared[:, :-1], shared.transpose(0, 1), rtol=1e-9, atol=1e-12)
    # Rows of what nobody saw are those of unit noise.
    both = seen.repeat_interleave(2, -1)
    whole = torch.where(both[:, :, None] & both[:, None], covariance, torch.eye(6).double())
    white = found.white.movedim(-1, 0)
    torch.testing.assert_close(white @ whole @ white.mT, torch.eye(6).double().expand(3, 6, 6))
