"""Rows of a filter: against the rig's projection, and against what fits points to their optimum."""

import torch

from kcal import Camera, Localizer, Origin, Rig
from kcal.locate import enu_from_cam
from kcal.locate.views import shared_pixels
from kcal.pipeline.measurements import ALONE_M, known_views, sightings


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
    found = sightings(known_views(posed, common), marks, seen, covariance, torch.zeros(3, 3).double())
    assert found.anchor.tolist() == [0, 1, 2]
    assert found.alone.tolist() == [False, False, True]
    assert bool(found.usable.all())
    torch.testing.assert_close(float(found.inverse[2]) * ALONE_M, 1.0)
    # Pixels at the place that rows are linear around, and where it moves.
    steps = torch.cat([torch.zeros(1, 3), torch.eye(3)]).double() * torch.tensor([1e-6, 1e-6, 1e-9])
    first, second, _ = found.by_ray
    around = [
        rig((found.place + (found.direction + a * first + b * second) / (found.inverse + c)).T)[0]
        for a, b, c in steps.tolist()
    ]
    there = seen[..., None]
    slopes = [
        torch.where(there, (one - around[0]) / steps[axis, axis - 1], 0.0) for axis, one in enumerate(around[1:], 1)
    ]
    assert common is not None
    at = found.place.T, found.direction.T, found.inverse
    shared = shared_pixels(posed, common, at, seen, torch.ones(()).double())
    off = torch.where(there, marks - around[0], 0.0).flatten(1)
    changes = [off, *(slope.flatten(1) for slope in slopes), *(-shared).movedim(-1, 1)]
    # Rows have unit noise: their products are those of pixels, weighed by the inverse covariance of what was seen.
    both = seen.repeat_interleave(2, -1)
    whole = torch.where(both[:, :, None] & both[:, None], covariance, torch.eye(6).double())
    rows = [found.value, *found.late.sum(0).unbind(1), *found.shared.unbind(1)]
    wanted = torch.stack(changes, -1)
    wanted = wanted.mT @ torch.linalg.solve(whole, wanted)
    given = torch.stack(rows, -1).movedim(1, 0)
    scale = wanted.diagonal(dim1=-2, dim2=-1).sqrt().clamp_min(1e-3)
    scale = scale[:, :, None] * scale[:, None]
    torch.testing.assert_close(given.mT @ given / scale, wanted / scale, rtol=0, atol=2e-3)
    assert not bool(given[2, :4].any())
