import math

import numpy as np
import pytest
import torch
from locate_rigs import SIZE, pinhole_rig, real_rig, spread_points, standing, tensor, turned

from kcal import Camera, DegenerateError, InputError, Origin, PositionStatus, Rig
from kcal.lens import rotation_from_vector
from kcal.lens.projection import project_components
from kcal.locate import enu_from_cam, enu_to_geodetic
from kcal.locate.localizer import Localization, Localizer
from kcal.rig import RigCovariance, mounting_covariance

ORIGIN = Origin(lat=-33.9, lon=151.2, height=40.0)
RIG = real_rig()
ATTITUDE = {"heading_deg": 200.0, "pitch_deg": 3.0, "roll_deg": -2.0}
N = 8000


def localizer(rig: Rig = RIG, **options: object) -> Localizer:
    """Of a rig that sees along straight lines."""
    straight = {"refraction": 0.0, "refraction_sigma": 0.0}
    return standing(rig, **{"origin": ORIGIN, **ATTITUDE, **straight, **options})


def noise(sigma: float, *shape: int, seed: int = 3) -> torch.Tensor:
    return sigma * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def covered(found: Localization, truth: torch.Tensor) -> float:
    return ((found.range_low <= truth) & (truth <= found.range_high)).double().mean().item()


def test_exact_marks_give_enu_and_wgs84() -> None:
    points = spread_points(torch.logspace(1.8, 4, 40, dtype=torch.float64))
    left, right = RIG(points)[0].unbind(-2)
    found = localizer(pixel_sigma=0.01)(left, right)
    enu = points @ enu_from_cam(*ATTITUDE.values()).T
    assert (found.status == PositionStatus.OK).all()
    # At range Z pixels that hold 1e-13 give Z² / (f b) * 1e-13 m.
    assert ((found.enu - enu).norm(dim=-1) / points.norm(dim=-1)).max() < 1e-10
    expected = enu_to_geodetic(enu, ORIGIN)
    assert torch.allclose(found.geodetic, expected, rtol=0, atol=1e-6)
    assert (found.geodetic - expected)[:, :2].abs().max() < 1e-11
    assert torch.allclose(found.bearing, enu / enu.norm(dim=-1, keepdim=True), atol=1e-12)
    assert torch.allclose(1.0 / found.inverse_range, points.norm(dim=-1), rtol=1e-10)
    assert found.reprojection.max() < 1e-9


def test_the_point_has_the_least_weighted_reprojection_error() -> None:
    left, right = RIG(spread_points(tensor(80.0, 400.0, 2500.0)))[0].unbind(-2)
    left, right = left + noise(0.4, 3, 2), right + noise(0.4, 3, 2, seed=4)
    root = noise(0.3, 3, 4, 4, seed=5) + 0.3 * torch.eye(4, dtype=torch.float64)
    cov = root @ root.mT + 0.02 * torch.eye(4, dtype=torch.float64)
    points = localizer()(left, right, cov).enu @ enu_from_cam(*ATTITUDE.values())
    points = points.requires_grad_()
    again = torch.cat(RIG(points)[0].unbind(-2), -1)
    misses = again - torch.cat([left, right], -1)
    (gradient,) = torch.autograd.grad((misses[:, None] @ torch.linalg.inv(cov) @ misses[..., None]).sum(), points)
    # Per meter; the cost changes by one over some meters here.
    assert gradient.abs().max() < 1e-6


@pytest.mark.parametrize("z", [100.0, 1000.0, 5000.0])
def test_covariance_and_interval_cover_what_noise_does(z: float) -> None:
    point = z * tensor([0.2, -0.05, 1.0])
    left, right = RIG(point)[0].unbind(-2)
    # Unlike and correlated noise in the four coordinates.
    root = 0.1 * tensor([1.0, 0, 0, 0], [0.3, 0.8, 0, 0], [0.2, 0, 1.5, 0], [0, 0.1, 0.4, 0.5])
    marks = torch.cat([left, right], -1) + noise(1.0, N, 4) @ root.T
    found = localizer()(marks[:, :2], marks[:, 2:], root @ root.T)
    assert (found.status == PositionStatus.OK).all()
    # 8000 draws know 95 % to 0.24 %.
    assert 0.94 < covered(found, point.norm()) < 0.96
    spread, claimed = torch.cov(found.enu.T), found.covariance.median(0).values
    scale = claimed.diagonal().sqrt()
    # To first order; at 5 km the range spreads by 3 % and is skewed.
    assert ((spread - claimed) / scale[:, None] / scale[None, :]).abs().max() < 0.06


@pytest.mark.parametrize("z", [150.0, 5000.0])
def test_errors_of_the_calibration_are_in_the_interval(z: float) -> None:
    """Rigs drawn from their own covariance, with correlations, seen by a user who believes the mean rig."""
    left = Camera.build(focal=(1600, 1605), center=(957, 541), size=SIZE, coefficients=[-0.2, 0.05], model="opencv4")
    rig = Rig.pair(left, left, turned(0.5, 0.2), tensor(-10.0, 0.1, 0.3))
    sigma = torch.cat(
        [tensor(0.4, 0.4, 0.3, 0.3, 0.0, 1e-4, 1e-4, 1e-5, 1e-5)] * 2 + [tensor(3e-5, 3e-5, 3e-5, 1e-3, 1e-3, 1e-3)]
    )
    root = torch.diag(sigma)
    root[20, 1] = root[19, 18] = 2e-5  # the rig's rotation leans on the cameras, as after a joint solve
    known = RigCovariance.of(rig, joint=root @ root.T)
    assert torch.allclose(known.matrix, root @ root.T, rtol=1e-9, atol=1e-18)
    count = 4000
    draws = noise(1.0, count, len(sigma), seed=8) @ root.T
    point = z * tensor([0.15, 0.1, 1.0])
    turn = rotation_from_vector(draws[:, 18:21]) @ rig.right_from_left_rotation
    in_right = (turn @ point[0])[:, None] + (rig.right_from_left_translation + draws[:, 21:])[:, None]
    seen = [
        project_components(points.mT, left.params + part, left.model).pixels[..., 0]
        for points, part in ((point.expand(count, 1, 3), draws[:, :9]), (in_right, draws[:, 9:18]))
    ]
    marks = torch.cat(seen, -1) + noise(0.1, count, 4, seed=9)
    found = standing(rig, origin=ORIGIN, heading_deg=0.0, pixel_sigma=0.1, calibration=known)(
        marks[:, :2], marks[:, 2:]
    )
    # 4000 draws know 95 % to 0.34 %; three of those.
    assert 0.94 < covered(found, point.norm()) < 0.96
    blind = Localizer(rig.placed(origin=ORIGIN, heading_deg=0.0), pixel_sigma=0.1)(marks[:, :2], marks[:, 2:])
    assert covered(blind, point.norm()) < 0.85


def test_mounting_adds_the_origin_and_what_a_turn_does_at_a_distance() -> None:
    left, right = RIG(spread_points(tensor(1000.0)))[0].unbind(-2)
    plain = localizer()(left, right)
    standing_errors = mounting_covariance(origin_m=(0.5, 0.0, 0.0), attitude_deg=(0.0, 0.0, 0.1))
    added = localizer(covariance=standing_errors)(left, right).covariance - plain.covariance
    east, north, _ = plain.enu[0].tolist()
    turn = math.radians(0.1)
    expected = tensor(
        [0.25 + (turn * north) ** 2, -(turn**2) * east * north, 0],
        [-(turn**2) * east * north, (turn * east) ** 2, 0],
        [0, 0, 0],
    )
    assert torch.allclose(added[0], expected, atol=1e-9)


def test_places_follow_the_origin_and_turns_of_the_mounting() -> None:
    """By autograd through a rigid motion; with origin and attitude correlated, the signs of turns show."""
    left, right = RIG(spread_points(tensor(300.0, 1000.0)))[0].unbind(-2)
    plain = localizer()(left, right)

    def moved(standing: torch.Tensor, enu: torch.Tensor) -> torch.Tensor:
        return rotation_from_vector(standing[3:]) @ enu + standing[:3]

    root = torch.diag(tensor(0.5, 0.3, 0.2, 1e-3, 2e-3, 3e-3)) @ (torch.eye(6).double() + 0.3 * noise(1.0, 6, 6))
    added = localizer(covariance=root @ root.T)(left, right).covariance - plain.covariance
    for enu, more in zip(plain.enu, added, strict=True):
        rows = torch.autograd.functional.jacobian(lambda standing, enu=enu: moved(standing, enu), 0 * root[0])
        torch.testing.assert_close(more, rows @ root @ root.T @ rows.T, rtol=1e-6, atol=1e-6)


def test_refraction_lowers_the_point() -> None:
    left, right = RIG(spread_points(tensor(5000.0)))[0].unbind(-2)
    straight, bent = localizer()(left, right), localizer(refraction=0.13)(left, right)
    assert (straight.enu - bent.enu)[0, 2].item() == pytest.approx(
        0.13 * float(straight.enu[0, :2].norm()) ** 2 / 2 / 6.37e6, rel=5e-3
    )
    assert (straight.geodetic - bent.geodetic)[0, 2].item() == pytest.approx(0.255, abs=0.005)


def test_refraction_of_standard_air_is_the_default() -> None:
    """k = 0.13 ± 0.1: the up component alone moves, and what is not known of k is added to its variance."""
    left, right = RIG(spread_points(tensor(300.0, 1000.0, 5000.0)))[0].unbind(-2)
    straight, found = localizer()(left, right), standing(RIG, origin=ORIGIN, **ATTITUDE)(left, right)
    bend = straight.enu[:, :2].square().sum(-1) / (2 * 6.371e6)
    torch.testing.assert_close(found.enu[:, :2], straight.enu[:, :2], rtol=0, atol=0)
    torch.testing.assert_close(straight.enu[:, 2] - found.enu[:, 2], 0.13 * bend, rtol=5e-3, atol=0)
    more = found.covariance - straight.covariance
    torch.testing.assert_close(more[:, 2, 2], (0.1 * bend) ** 2, rtol=1e-2, atol=1e-12)
    more[:, 2, 2] = 0.0
    assert more.abs().max() < 1e-9
    assert torch.equal(found.range_high, straight.range_high)
    # The sigma counts also where k is 0.
    vague = localizer(refraction_sigma=0.5)(left, right)
    assert torch.equal(vague.enu, straight.enu)
    more = (vague.covariance - straight.covariance)[2, 2, 2]
    assert float(more.sqrt()) == pytest.approx(0.5 * float(bend[2]), rel=5e-3)


def test_heights_are_inside_their_intervals_where_light_bends() -> None:
    """Draws of k and of the marks at 5 km: deviations of the height in its sigmas are those of a normal variable."""
    azimuth = math.radians(200.0) + torch.linspace(-0.3, 0.3, 400, dtype=torch.float64)
    # Level, so that errors of the range do not show in the height.
    enu = 5000.0 * torch.stack([azimuth.sin(), azimuth.cos(), torch.zeros_like(azimuth)], -1)
    k = 0.13 + 0.1 * torch.randn(len(enu), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    seen = enu + torch.stack([0 * k, 0 * k, k * enu[:, :2].square().sum(-1) / (2 * 6.371e6)], -1)
    left, right = RIG(seen @ enu_from_cam(*ATTITUDE.values()))[0].unbind(-2)
    found = standing(RIG, origin=ORIGIN, **ATTITUDE, pixel_sigma=0.05)(
        left + noise(0.05, 400, 2), right + noise(0.05, 400, 2, seed=4)
    )
    error = (found.enu - enu)[:, 2] / found.covariance[:, 2, 2].sqrt()
    assert abs(float(error.mean())) < 4 / 20
    assert float(error.square().mean()) == pytest.approx(1.0, abs=4 * (2 / 400) ** 0.5)


BAD = [
    # left, right, status; f = 1600 px, b = 10 m, center (959.5, 539.5), sigma 0.3 px
    ((980.0, 540.0), (970.0, 540.0), PositionStatus.OK),
    ((980.0, 540.0), (979.5, 540.0), PositionStatus.BEARING_ONLY),
    ((-0.5, 1079.5), (-0.5, 1079.5), PositionStatus.PARALLEL),
    ((960.0, 540.0), (970.0, 540.0), PositionStatus.PARALLEL),
    ((math.nan, 540.0), (970.0, 540.0), PositionStatus.NOT_FINITE),
    ((980.0, 540.0), (970.0, math.inf), PositionStatus.NOT_FINITE),
    ((-0.6, 540.0), (-20.0, 540.0), PositionStatus.OUTSIDE_IMAGE),
    ((980.0, 540.0), (970.0, 1079.51), PositionStatus.OUTSIDE_IMAGE),
    ((980.0, 540.0), (970.0, 540.0), PositionStatus.MASKED),
    ((980.0, 540.0), (970.0, 540.0), PositionStatus.BAD_COVARIANCE),
    ((980.0, 540.0), (970.0, 540.0), PositionStatus.BAD_COVARIANCE),
]  # fmt: skip


def test_rounded_covariances_are_accepted() -> None:
    """A matrix may be symmetric to rounding only, and have zeros."""
    cov = torch.diag(tensor(0.09, 0.04, 0.09, 0.04))
    cov[0, 2], cov[2, 0] = 0.01, 0.01 * (1 + 1e-12)
    localize = Localizer(pinhole_rig().placed(origin=ORIGIN, heading_deg=0.0))
    left, right = tensor([980.0, 540.0], [980.0, 540.0]), tensor([970.0, 540.0], [970.0, 540.0])
    crooked = cov.clone()
    crooked[2, 0] = 0.02
    statuses = localize(left, right, torch.stack([cov, crooked])).status.tolist()
    assert statuses == [int(PositionStatus.OK), int(PositionStatus.BAD_COVARIANCE)]


def test_statuses_and_no_nan_in_values_or_gradients() -> None:
    left = tensor(*(row[0] for row in BAD)).requires_grad_()
    right = tensor(*(row[1] for row in BAD)).requires_grad_()
    cov = (0.09 * torch.eye(4, dtype=torch.float64)).repeat(len(BAD), 1, 1)
    cov[9, 0, 0], cov[10, 1, 2] = -1.0, math.nan
    cov.requires_grad_()
    mask = torch.ones(len(BAD), dtype=torch.bool)
    mask[8] = False
    found = Localizer(pinhole_rig().placed(origin=ORIGIN, heading_deg=0.0))(left, right, cov, mask)
    assert [PositionStatus(s).name for s in found.status.tolist()] == [row[2].name for row in BAD]
    for name, value in found._asdict().items():
        assert not torch.isnan(value).any(), name
    assert (found.enu[1:] == 0).all()
    assert torch.isinf(found.covariance[1:].diagonal(dim1=-2, dim2=-1)).all()
    # Disparity 0.5 px: nearest is 16 000 / (0.5 + 1.96 * 0.42) m, farthest is open; at -10 px no range is left.
    assert found.range_low[1].item() == pytest.approx(12_016, rel=1e-3)
    assert torch.isinf(found.range_high[1:4]).all()
    assert torch.isinf(found.range_low[3])
    assert (found.range_low[4:] == 0).all()
    assert (found.bearing[:4].norm(dim=-1) - 1).abs().max() < 1e-12
    total = sum(torch.where(torch.isfinite(v), v, 0.0).sum() for v in found if v.is_floating_point())
    for gradient in torch.autograd.grad(total, (left, right, cov)):
        assert torch.isfinite(gradient).all()
        assert (gradient[0] != 0).any()
        assert (gradient[4:] == 0).all()
    # Also without a point: the inverse range leads a detector back from beyond infinity.
    (slope,) = torch.autograd.grad(localizer()(left, right).inverse_range[1:4].sum(), left)
    assert (slope[1:4, 0] > 0).all()


def test_gradients_of_everything() -> None:
    left, right = RIG(spread_points(tensor(60.0, 900.0)))[0].unbind(-2)
    left, right = left + noise(0.5, 2, 2), right + noise(0.5, 2, 2, seed=4)
    cov = 0.1 * torch.eye(4, dtype=torch.float64).repeat(2, 1, 1) + 0.02
    module = localizer()
    home = ORIGIN.geodetic

    def outputs(left: torch.Tensor, right: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found = module(left, right, 0.5 * (half + half.mT))
        # 1e5 m a degree: all in meters.
        place = (found.geodetic - home) * tensor(1e5, 1e5, 1.0)
        return (
            found.enu,
            place,
            1e6 * found.inverse_range,
            found.covariance * 1e-2,
            found.range_high,
            found.reprojection,
        )

    inputs = (left.requires_grad_(), right.requires_grad_(), cov.requires_grad_())
    # Degrees of 151 hold 3e-14: with steps of 1e-4 that is 3e-5 of a slope.
    assert torch.autograd.gradcheck(outputs, inputs, eps=1e-4, rtol=1e-5, atol=1e-3)


def test_batches_pieces_and_precision() -> None:
    left, right = RIG(spread_points(torch.linspace(50, 3000, 40_000, dtype=torch.float64)))[0].unbind(-2)
    module = localizer()
    flat = module(left, right)
    deep = module(left[:24].reshape(2, 3, 4, 2), right[:24].reshape(2, 3, 4, 2))
    assert deep.enu.shape == (2, 3, 4, 3)
    assert deep.covariance.shape == (2, 3, 4, 3, 3)
    for own, other in zip(deep, flat, strict=True):
        assert own.shape[:3] == (2, 3, 4)
        assert torch.allclose(own.reshape(24, *own.shape[3:]), other[:24], rtol=1e-8)
    assert module(left[:0], right[:0]).enu.shape == (0, 3)
    halved = localizer(real_rig()).half()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got = halved(left[:9].float(), right[:9].float())
    for own, other in zip(got, module(left[:9].float().double(), right[:9].float().double()), strict=True):
        assert torch.equal(own, other)


def test_sensitivities() -> None:
    rig = pinhole_rig(1600.0, 10.0)
    left, right = rig(tensor([0.0, 0.0, 5000.0], [0.0, 0.0, 1000.0]))[0].unbind(-2)
    slopes = Localizer(rig.placed(origin=ORIGIN, heading_deg=0.0)).sensitivity(left, right)
    # Z² / (f b) m/px, and Z² / b m/rad: 436 m for 0.01° at 5 km.
    assert slopes.meters_per_pixel.tolist() == pytest.approx([1562.5, 62.5], rel=1e-3)
    assert slopes.meters_per_degree.tolist() == pytest.approx([43_633, 1745.3], rel=1e-3)
    # By turning the rig and locating again.
    turned_rig = Rig.pair(rig.left, rig.right, turned(1e-4), rig.right_from_left_translation)
    module = Localizer(turned_rig.placed(origin=ORIGIN, heading_deg=0.0))
    moved = module(left, right).enu.norm(dim=-1) - tensor(5000.0, 1000.0)
    assert moved.abs().tolist() == pytest.approx([4.3633, 0.17453], rel=2e-3)


def test_what_was_seen_may_be_an_array() -> None:
    pixels, seen = tensor([980.0, 540.0], [960.0, 540.0]).expand(2, 2, 2), np.array([[True, True], [True, False]])
    assert localizer()(pixels.numpy(), seen).status.tolist() == [PositionStatus.OK, PositionStatus.MASKED]


def test_bad_arguments() -> None:
    module, marks = localizer(), tensor([980.0, 540.0])
    for arguments, message in (
        ((marks.long(), marks), "floating point"),
        ((marks, marks[0]), "same shape"),
        ((marks[0], marks[0]), "same shape"),
        ((torch.stack([marks[0], marks[0]]),), r"\(\.\.\., N, 2, 2\) is needed, got \(2, 2\)"),
        ((marks, marks, torch.eye(2).double()), "cov"),
        ((marks, marks, None, torch.ones(1)), "bool"),
    ):
        with pytest.raises(InputError, match=message):
            module(*arguments)
    for options, message in (
        *(({"pixel_sigma": wrong}, "pixel_sigma") for wrong in (0.0, -1.0, math.nan, math.inf, 1e300, 1e-300)),
        ({"refraction": 13.0}, "refraction"),
        ({"refraction_sigma": -0.1}, "refraction_sigma"),
        ({"refraction_sigma": math.nan}, "refraction_sigma"),
        ({"covariance": torch.eye(3)}, "mounting"),
        ({"calibration": RigCovariance(half=torch.eye(3))}, "joint covariance"),
        ({"heading_deg": math.nan}, "heading"),
    ):
        with pytest.raises(InputError, match=message):
            localizer(**options)
    with pytest.raises(InputError, match="no negative eigenvalue"):
        RigCovariance.of(RIG, pose=-torch.eye(6, dtype=torch.float64))
    with pytest.raises(InputError, match="not both"):
        RigCovariance.of(RIG, pose=torch.eye(6), joint=torch.eye(26))
    with pytest.raises(InputError, match="sigmas"):
        mounting_covariance(origin_m=(-1.0, 0.0, 0.0))
    with pytest.raises(DegenerateError, match="same place"):
        localizer(Rig.pair(RIG.left, RIG.left, torch.eye(3), torch.zeros(3)))
