"""Boxes in batches, with gradients, and on another device: `PairBoxes`, `Detections` and what takes them."""

import pytest
import torch
from elsewhere import DEVICE, Elsewhere
from torch import Tensor

from kcal import InputError, Localizer, Origin, Rig
from kcal.pipeline.association import AssociationOptions, PairBoxes, associate
from kcal.rig import Mounting, RigCovariance, planned_rig
from kcal.track import Detections, group_objects, pair_objects

SIZE = (1920, 1080)
OPTIONS = AssociationOptions(box_sigma=1.0)


def rig_with_errors() -> Rig:
    rig = planned_rig()
    sigma = torch.tensor([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3], dtype=torch.float64)
    rig.covariance = RigCovariance.of(rig, pose=torch.diag(sigma**2))
    rig.mounting = Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
    return rig


def moments(count: int = 4, things: int = 9, spread: float = 1.0) -> tuple[Rig, Tensor, Tensor, Tensor, Tensor]:
    """Boxes (B, 9, 4) left and (B, 8, 4) right, some of them masked, whose middles err."""
    g, rig = torch.Generator().manual_seed(4), rig_with_errors()
    away = 10 ** (2.2 + 1.2 * torch.rand(count, things, 1, generator=g).double())
    place = torch.rand(count, things, 2, generator=g).double() * torch.tensor([0.8, 0.3]) - torch.tensor([0.4, 0.15])
    left, right = rig(torch.cat([place, torch.ones_like(away)], -1) * away)[0].unbind(-2)
    left, right = (some + spread * torch.randn(some.shape, generator=g).double() for some in (left, right))
    order = torch.rand(count, things, generator=g).argsort(-1)[:, : things - 1]
    half = 2000.0 / away
    left_boxes, right_boxes = torch.cat([left - half, left + half], -1), torch.cat([right - half, right + half], -1)
    right_boxes = right_boxes.gather(1, order[..., None].expand(-1, -1, 4))
    masks = torch.rand(count, things, generator=g) < 0.9, torch.rand(count, things - 1, generator=g) < 0.9
    return rig, left_boxes, right_boxes, *masks


def detections(boxes: Tensor) -> Detections:
    return Detections.read(boxes, size=SIZE, first_pixel=0.0, time=0.0)


def test_a_batch_is_paired_as_each_of_its_moments() -> None:
    rig, left, right, here, there = moments()
    garbage = [torch.where(mask[..., None], some, torch.nan) for some, mask in ((left, here), (right, there))]
    found = PairBoxes(rig, OPTIONS)(*garbage, here, there)
    pairs = 0
    for b in range(len(left)):
        wanted = associate(rig, detections(left[b][here[b]]), detections(right[b][there[b]]), OPTIONS)
        rows = here[b].nonzero()[:, 0][wanted.left]
        assert found.mask[b].nonzero()[:, 0].tolist() == rows.tolist()
        assert found.match[b, rows].tolist() == there[b].nonzero()[:, 0][wanted.right].tolist()
        assert found.ambiguous[b, rows].tolist() == wanted.ambiguous.tolist()
        torch.testing.assert_close(found.score[b, rows], (-0.5 * wanted.cost).exp(), rtol=1e-9, atol=1e-12)
        pairs += len(rows)
    assert pairs > 15
    assert not bool(found.mask.all())
    assert bool((found.score[~found.mask] == 0).all())
    middles = 0.5 * (right[..., :2] + right[..., 2:])
    at = found.match.clamp_min(0)[..., None].expand(-1, -1, 2)
    assert torch.equal(found.right[found.mask], middles.gather(1, at)[found.mask])
    # What has no partner is harmless to a localizer.
    assert bool(torch.isfinite(Localizer(rig)(found.left, found.right, mask=found.mask).enu).all())


def test_kinds_and_empty_images() -> None:
    rig, left, right, here, there = moments(2)
    kinds = torch.zeros(left.shape[:2]).long(), torch.ones(right.shape[:2]).long()
    pair = PairBoxes(rig, OPTIONS)
    assert not bool(pair(left, right, here, there, kinds=kinds).mask.any())
    for first, second in ((left[:, :0], right), (left, right[:, :0]), (left[:0], right[:0])):
        found = pair(first, second)
        assert found.match.shape == first.shape[:2]
        assert not bool(found.mask.any())


@pytest.mark.parametrize("options", [OPTIONS, AssociationOptions(box_sigma=1.0, nearest=1200.0, gate=12.0)])
def test_scores_have_the_derivatives_of_their_boxes(options: AssociationOptions) -> None:
    """Epipolar error, range beyond the nearest, and size; with shared errors of the rig."""
    rig, left, right, here, there = moments(1, 5)
    pair = PairBoxes(rig, options)
    assert int(pair(left, right, here, there).mask.sum()) >= 2

    def logarithm(left: Tensor, right: Tensor) -> Tensor:
        found = pair(left, right, here, there)
        return found.score[found.mask].log()

    inputs = left.requires_grad_(True), right.requires_grad_(True)
    assert torch.autograd.gradcheck(logarithm, inputs, eps=1e-4, atol=2e-4, rtol=2e-4, fast_mode=True)


def test_a_position_is_differentiable_by_the_boxes_of_a_detector() -> None:
    rig, left, right, here, there = moments(1)
    raw = left[0][here[0]].float().requires_grad_(True)
    pairs = pair_objects(rig, detections(raw), detections(right[0][there[0]]), options=OPTIONS)
    Localizer(rig)(pairs.left, pairs.right, pairs.covariance).inverse_range.sum().backward()
    assert raw.grad is not None
    # A step to the right of a left box raises the disparity: 1 / (focal length × baseline) each.
    moved = raw.grad.double().reshape(-1, 2, 2)[..., 0].sum(-1)
    assert torch.allclose(moved[moved != 0], torch.tensor(1.0 / 16000.0).double(), rtol=0.1)
    views = group_objects(Localizer(rig, weights="all"), [detections(raw), detections(right[0])], OPTIONS)
    assert views.pixels.requires_grad


def test_half_precision_is_refused() -> None:
    boxes = torch.tensor([[100.0, 50.0, 112.0, 62.0]])
    for source in (boxes.half(), boxes.bfloat16(), boxes.half().numpy(), {"boxes": boxes.half()}):
        with pytest.raises(InputError, match="16 has steps of"):
            Detections.read(source, size=SIZE)
    with pytest.raises(InputError, match="16 has steps of"):
        PairBoxes(planned_rig())(boxes[None].half(), boxes[None])


def test_what_cannot_be_is_refused() -> None:
    pair, boxes = PairBoxes(planned_rig()), torch.tensor([[[100.0, 50.0, 112.0, 62.0]]])
    with pytest.raises(InputError, match=r"left boxes: number .0, 0., .* has no area; mask it"):
        pair(boxes.flip(-1), boxes)
    with pytest.raises(InputError, match=r"right boxes \(B, K, 4\) and a mask"):
        pair(boxes, boxes, None, torch.ones(1, 2, dtype=torch.bool))
    with pytest.raises(InputError, match="1 left and 2 right images"):
        pair(boxes, boxes.repeat(2, 1, 1))
    with pytest.raises(InputError, match="no keypoints"):
        PairBoxes(planned_rig(), AssociationOptions(anchor=3))


@pytest.mark.slow
def test_all_of_it_on_another_device() -> None:
    """No tensor of the CPU meets those of the device, and results come back there with the same values."""
    # The images are noise: looks cost much and refuse nothing.
    options = AssociationOptions(box_sigma=1.0, gate=8.0)
    rig, left, right, here, there = moments(2)
    images = torch.rand(2, 2, 108, 192, generator=torch.Generator().manual_seed(0)).double()
    images = torch.nn.functional.interpolate(images, scale_factor=10, mode="bilinear")
    wanted = PairBoxes(rig, options)(left, right, here, there, images=(images[0], images[1]))
    assert int(wanted.mask.sum()) > 8
    one = pair_objects(rig, detections(left[0]), detections(right[0]), (images[0, 0], images[0, 0]), options=OPTIONS)
    with Elsewhere():
        moved = [value.to(DEVICE) for value in (left, right, here, there, images)]
        rig = rig.to(DEVICE)
        moved[0].requires_grad_(True)
        found = PairBoxes(rig, options)(*moved[:4], images=(moved[4][0], moved[4][1]))
        found.score.sum().backward()
        seen = detections(moved[0][0]), detections(moved[1][0])
        pairs = pair_objects(rig, *seen, (moved[4][0, 0], moved[4][0, 0]), options=OPTIONS)
        views = group_objects(Localizer(rig, weights="all"), seen, OPTIONS)
        matches = {"keypoints0": pairs.left, "keypoints1": pairs.right, "confidence": pairs.score}
        again = type(pairs).from_matches(matches)
        for value in (*found, pairs.covariance, pairs.time, views.pixels, views.time, views.score, again.covariance):
            assert value.device == DEVICE
        assert moved[0].grad is not None
        torch.testing.assert_close(tuple(value.detach().cpu() for value in found), tuple(wanted), rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(pairs.right.detach().cpu(), one.right, rtol=1e-9, atol=1e-9)
