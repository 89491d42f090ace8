"""Poses that a user frees: gradients reach them, and a rotation stays one."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from kcal import Camera, InputError, Localizer, Origin, Rig, load_rig, save_rig
from kcal.lens import rotation_from_vector
from kcal.rig import Mounting
from scripts.make_modules import PLACES, pairs, rig, stations, stereo


def marks(truth: Rig) -> tuple[Tensor, Tensor]:
    left, right = truth(PLACES)[0].unbind(-2)
    return left.detach(), right.detach()


def test_an_optimizer_finds_a_turn_and_keeps_rotations() -> None:
    truth = rig(free=False)
    turn = rotation_from_vector(torch.tensor([[0.002, -0.003, 0.001]], dtype=torch.float64))[0]
    off = Rig.pair(truth.left, truth.right, turn @ truth.right_from_left_rotation, truth.right_from_left_translation)
    assert not list(p for p in off.parameters() if p.requires_grad)
    off.free("rotation")
    optimizer = torch.optim.LBFGS([p for p in off.parameters() if p.requires_grad], line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        pixels = torch.stack(off(PLACES)[0].unbind(-2))
        value: Tensor = (pixels - torch.stack(marks(truth))).square().sum()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    for _ in range(5):
        optimizer.step(loss)
    found = off.right_from_left_rotation.detach()
    torch.testing.assert_close(found, truth.right_from_left_rotation, rtol=0, atol=1e-6)  # of 4e-3
    torch.testing.assert_close(found @ found.T, torch.eye(3).double(), rtol=0, atol=1e-14)
    assert torch.equal(off.right_from_left_translation, truth.right_from_left_translation)
    assert not off.requires_grad_(False).freed_step[0].requires_grad  # type: ignore[index]


def test_what_is_known_of_another_pose_is_forgotten(tmp_path: Path) -> None:
    own = rig(free=False)
    before = own.fingerprint
    own.mounting = Mounting(origin=Origin(lat=0.0, lon=0.0, height=0.0), heading_deg=0.0)
    own.free()
    assert own.fingerprint == before
    assert own.mounting is not None
    with torch.no_grad():
        own.pose_step += 0.01  # type: ignore[operator]
    assert own.fingerprint != before
    assert own.mounting is None
    again = load_rig(save_rig(own, tmp_path / "rig.json"))
    torch.testing.assert_close(again.right_from_left_rotation, own.right_from_left_rotation, rtol=0, atol=1e-15)


def test_states_with_and_without_a_step() -> None:
    freed, plain = rig(), rig(1, free=False)
    with torch.no_grad():
        freed.pose_step += 0.01  # type: ignore[operator]
    plain.load_state_dict(freed.state_dict())
    assert plain.fingerprint == freed.fingerprint
    assert not plain.pose_step.requires_grad  # type: ignore[union-attr]
    still = rig(1, free=False)
    freed.load_state_dict(still.state_dict())
    assert freed.fingerprint == still.fingerprint


def test_what_has_a_graph_keeps_it() -> None:
    """Found: `Rig(..., nn.Parameter)` detached without a word."""
    start = rig(free=False)
    shift = nn.Parameter(start.right_from_left_translation.clone())
    own = Rig.pair(start.left, start.right, start.right_from_left_rotation, shift)
    assert dict(own.named_parameters())["translation"] is shift
    found = Localizer(own)(*pairs().values())
    (by_shift,) = torch.autograd.grad(found.enu.sum(), shift)
    vector = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    made = Rig.pair(start.left, start.right, rotation_from_vector(vector)[0], start.right_from_left_translation)
    (by_turn,) = torch.autograd.grad(Localizer(made)(*pairs().values()).inverse_range.sum(), vector)
    assert bool((by_shift != 0).all() and (by_turn != 0).all())


def test_what_cannot_be_had_is_said() -> None:
    start = rig(free=False)
    turn, shift = start.right_from_left_rotation, start.right_from_left_translation
    with pytest.raises(InputError, match="free"):
        Rig.pair(start.left, start.right, nn.Parameter(turn), shift)
    with pytest.raises(InputError, match="float64"):
        Rig.pair(start.left, start.right, turn, nn.Parameter(shift.float()))
    with pytest.raises(InputError, match="pose, rotation, translation"):
        start.free("yaw")


def test_one_station_of_several_and_a_mounting() -> None:
    several = stations().free("church")
    pixels, _ = several(torch.tensor([[0.0, 5000, 100]], dtype=torch.float64))
    pixels.sum().backward()
    moved = several.pose_step.grad.abs().sum(-1) > 0  # type: ignore[union-attr]
    assert moved.tolist() == [False, True, False]
    localize = stereo(0).free("attitude")
    assert isinstance(localize, Localizer)
    found = localize(*pairs().values())
    found.enu.sum().backward()
    by_origin, by_turn = localize.pose_step.grad.split(3)  # type: ignore[union-attr]
    assert not by_origin.any()
    assert by_turn.all()
    with torch.no_grad():
        localize.pose_step += torch.tensor([10.0, 0, 0, 0, 0, 0.01])  # type: ignore[operator]
    again = localize(*pairs().values())
    torch.testing.assert_close(again.enu.norm(dim=-1), found.enu.norm(dim=-1), rtol=1e-6, atol=0)
    assert localize.origin.lon > 72.87
    assert localize.attitude_deg[0] == pytest.approx(30.0 - 0.573, abs=1e-3)


def test_ranges_and_covariance_without_the_earth() -> None:
    one = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
    own = Rig.pair(one, one, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
    left = torch.tensor([[960.0, 540.0], [960.0, 540.0], [float("nan"), 0.0]], dtype=torch.float64)
    right = left - torch.tensor([[16.0, 0.0], [-1.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    found = Localizer(own, pixel_sigma=0.1)(left, right)
    assert found.range.tolist() == pytest.approx([1000.0, float("inf"), float("inf")])
    # Z = f b / d: its sigma is Z² / (f b) times that of a disparity, √2 of a mark's.
    assert float(found.covariance[0, 2, 2].sqrt()) == pytest.approx(1000.0**2 / 16000 * 0.1 * 2**0.5, rel=1e-3)
    assert found.covariance[1].diagonal().tolist() == [float("inf")] * 3
    located = Localizer(own.placed(origin=Origin(lat=0, lon=0, height=0), heading_deg=0.0))(left, right)
    assert located.range.tolist() == pytest.approx([1000.0, float("inf"), float("inf")])


def test_what_is_set_on_a_rig_elsewhere_is_not_set_on_the_first_one() -> None:
    """A rig that was placed, or copied for other errors, has cameras and poses of its own."""
    one = rig(free=False)
    lens, pose, columns = one.left, one.right_from_left_translation.clone(), one.quantities
    other = one.placed(origin=Origin(lat=0.0, lon=0.0, height=0.0), heading_deg=0.0)
    for copied in (other, Localizer(one, root=torch.zeros(1, columns, dtype=torch.float64)).rig):
        copied.left = Camera.build(focal=(9, 9), center=(1, 1), size=lens.size, model="pinhole")
        copied.free("right")
        copied.pose_step.data += 1.0
    assert one.left is lens
    assert torch.equal(one.right_from_left_translation, pose)
    assert not any(p.requires_grad for p in one.parameters())
