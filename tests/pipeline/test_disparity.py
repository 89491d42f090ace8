"""Disparity of objects in both images, and where objects are refused."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from kcal import Camera, InputError, Localizer, Rig
from kcal.corners import MatchStatus, patches
from kcal.lens import rotation_from_vector
from kcal.locate.stereo import flagged
from kcal.pipeline.pairing import DisparityOptions, ObjectDisparities, ObjectDisparity, _brightest, _Objects
from scripts.shared.marking_scene import background, exposed, paint_plate, plate, texture_gradient, true_box

# Rendered objects before a rig, with boxes that err, for tests of matching.

SIZE = (240, 160)
FOCAL = 800.0


def rig_of(lens: tuple[float, ...] = (-0.3, 0.1), roll: float = 0.02) -> Rig:
    camera = Camera.build(focal=(FOCAL, FOCAL), center=(119.5, 79.5), size=SIZE, coefficients=lens)
    other = Camera.build(focal=(790, 795), center=(121.0, 78.0), size=SIZE, coefficients=lens)
    turn = rotation_from_vector(torch.tensor([0.003, -0.002, roll], dtype=torch.float64))
    return Rig.pair(camera, other, turn, torch.tensor([-5.0, 0.2, 0.1]))


class Case(NamedTuple):
    rig: Rig
    left: Tensor
    right: Tensor
    boxes: Tensor
    aims: Tensor
    truth: Tensor


def case(
    seed: int = 0, size: float = 14.0, noise: float = 0.2, box_sigma: float = 1.0, amplitude: float = 0.8, **rig: object
) -> Case:
    """One object at 500 to 2,000 m, rendered; `truth` is where the left anchor's point is in the right image."""
    random = np.random.default_rng(seed)
    rig_ = rig_of(**rig)  # type: ignore[arg-type]
    distance = random.uniform(500, 2000)
    point = torch.tensor([random.uniform(-0.05, 0.05) * distance, 0.02 * distance, distance], dtype=torch.float64)
    item = plate(point, (size, size), FOCAL, 40.0, random)
    images = [background(rig_, side, np.random.default_rng(seed), amplitude) for side in (0, 1)]
    for side in (0, 1):
        paint_plate(images[side], rig_, side, item)
    boxes = [true_box(rig_, side, item) for side in (0, 1)]
    sigma = noise * texture_gradient(images[0], boxes[0])
    left, right = (exposed(image, sigma, random) for image in images)
    seen = [torch.from_numpy(box + random.normal(0, box_sigma, 4)) for box in boxes]
    middle = 0.5 * (seen[0][:2] + seen[0][2:])
    ray, _ = rig_.left.unproject(middle[None])
    truth, _ = rig_.right.project(rig_.right_from_left(ray * distance / ray[:, 2:]))
    return Case(rig_, left, right, seen[0][None], 0.5 * (seen[1][:2] + seen[1][2:])[None], truth)


def match(scene: Case, **changes: Tensor) -> ObjectDisparities:
    given = scene._asdict() | changes
    return ObjectDisparity(scene.rig)(given["left"], given["right"], given["boxes"], given["aims"])


def test_error_is_small_and_covered() -> None:
    errors, sigmas = [], []
    for seed in range(16):
        scene = case(seed)
        found = match(scene)
        if int(found.status[0]) == MatchStatus.GOOD:
            errors.append((found.pixels - scene.truth)[0].numpy())
            sigmas.append(found.covariance[0].diagonal().sqrt().numpy())
    ratio = np.abs(np.array(errors)) / np.array(sigmas)
    assert len(errors) >= 14
    assert math.sqrt(np.mean(np.square(errors))) < 0.1
    assert np.mean(ratio < 1.96) > 0.8
    assert 0.6 < math.sqrt(np.mean(np.square(ratio))) < 1.5


@pytest.mark.parametrize("changes", [{"lens": ()}, {"lens": (-0.3, 0.1), "roll": 0.5}, {"lens": (0.4, 0.2)}])
def test_lenses_and_roll_do_not_matter(changes: dict) -> None:
    scene = case(3, noise=0.02, box_sigma=0.5, amplitude=0.0, size=24, **changes)
    found = match(scene)
    assert int(found.status[0]) == MatchStatus.GOOD
    assert float((found.pixels - scene.truth).abs().max()) < 0.03
    assert float(found.off_line[0]) < 0.05


def test_a_large_object_has_larger_steps() -> None:
    scene = case(1, size=90, box_sigma=1.0, amplitude=0.0)
    found = match(scene)
    assert int(found.status[0]) == MatchStatus.GOOD
    assert float((found.pixels - scene.truth).abs().max()) < 0.1


def test_many_objects_at_once_are_as_one_by_one() -> None:
    scenes = case(0), case(5)
    rig, left, right = scenes[0].rig, scenes[0].left, scenes[0].right
    boxes = torch.cat([scene.boxes for scene in scenes] + [torch.tensor([[30.0, 30, 110, 120]])]).double()
    aims = torch.cat([scene.aims for scene in scenes] + [torch.tensor([[65.0, 75.0]])]).double()
    together = ObjectDisparity(rig)(left, right, boxes, aims)
    for number in range(3):
        alone = ObjectDisparity(rig)(left, right, boxes[number : number + 1], aims[number : number + 1])
        assert int(alone.status[0]) == int(together.status[number])
        # The patch is as large as the largest object's, which adds pixels of no weight.
        assert torch.allclose(alone.pixels[0], together.pixels[number], atol=2e-3)


def test_an_object_does_not_depend_on_its_neighbors() -> None:
    """Each stops when it has converged itself, whatever the others still do."""
    scene = case(0)
    shifts = torch.tensor([[0.0, 0.0], [-7.0, 3.0], [9.0, -5.0], [2.0, 11.0]], dtype=torch.float64)
    boxes, aims = scene.boxes[:1] + shifts.repeat(1, 2), scene.aims[:1] + shifts.flip(0)
    match = ObjectDisparity(scene.rig)
    together = match(scene.left, scene.right, boxes, aims)
    statuses = set()
    for number in range(4):
        alone = match(scene.left, scene.right, boxes[number : number + 1], aims[number : number + 1])
        statuses.add(int(alone.status[0]))
        assert int(alone.status[0]) == int(together.status[number])
        assert torch.allclose(alone.pixels[0], together.pixels[number], rtol=0, atol=1e-8)
    assert len(statuses) > 1


def test_a_mask_replaces_the_ellipse() -> None:
    scene = case(2, amplitude=1.6, box_sigma=0.5)
    mask = torch.zeros(1, *SIZE[::-1], dtype=torch.bool)
    left, top, right, bottom = scene.boxes[0].round().int().tolist()
    mask[0, top + 1 : bottom, left + 1 : right] = True
    found = ObjectDisparity(scene.rig)(scene.left, scene.right, scene.boxes, scene.aims, masks=mask)
    assert int(found.status[0]) == MatchStatus.GOOD
    assert float((found.pixels - scene.truth).abs().max()) < 0.3
    empty = ObjectDisparity(scene.rig)(scene.left, scene.right, scene.boxes, scene.aims, masks=mask & False)
    assert int(empty.status[0]) != MatchStatus.GOOD


class TestRefusals:
    """What cannot be known is refused, with the reason; nothing is NaN."""

    def check(self, found: ObjectDisparities, *statuses: MatchStatus) -> None:
        assert MatchStatus(int(found.status[0])) in statuses
        assert bool(found.pixels.isfinite().all())
        assert bool(torch.isinf(found.covariance[0].diagonal()).all())

    def test_flat(self) -> None:
        scene = case()
        flat = torch.full_like(scene.left, 100.0)
        self.check(match(scene, left=flat, right=flat), MatchStatus.FLAT)
        noise = torch.Generator().manual_seed(0)
        images = {side: flat + torch.randn(flat.shape, generator=noise) for side in ("left", "right")}
        self.check(match(scene, **images), MatchStatus.FLAT, MatchStatus.NO_MATCH)

    def test_one_straight_edge_along_the_epipolar_line(self) -> None:
        """Rows that do not change along the line say nothing of the disparity."""
        scene = case(lens=(), roll=0.0)
        rows = torch.sigmoid((torch.arange(SIZE[1]) - 80.0)[:, None].expand(SIZE[::-1]).double()) * 100
        random = torch.Generator().manual_seed(0)
        left, right = (rows + 0.5 * torch.randn(rows.shape, generator=random) for _ in range(2))
        self.check(match(scene, left=left, right=right), MatchStatus.FLAT, MatchStatus.NO_MATCH,
                   MatchStatus.AMBIGUOUS, MatchStatus.NOT_CONVERGED)  # fmt: skip

    def test_absent(self) -> None:
        scene, other = case(0), case(9)
        self.check(match(scene, right=other.right), MatchStatus.NO_MATCH, MatchStatus.OCCLUDED)

    def test_hidden_by_half(self) -> None:
        scene = case(0, size=20, amplitude=0.0, box_sigma=0.0)
        right = scene.right.clone()
        u, v = scene.truth[0].round().int().tolist()
        noise = torch.rand(60, 40, generator=torch.Generator().manual_seed(1)).double()
        right[v - 30 : v + 30, u - 2 : u + 38] = 100 + 60 * noise
        self.check(match(scene, right=right), MatchStatus.OCCLUDED, MatchStatus.NO_MATCH)
        # Flat and as bright as the object, so that the rest still correlates.
        right = scene.right.clone()
        right[v - 30 : v + 30, u + 2 : u + 38] = float(scene.right[v - 5 : v + 6, u - 5 : u + 6].mean())
        strict = ObjectDisparity(scene.rig, DisparityOptions(min_score=0.3, min_share=0.85))
        self.check(strict(scene.left, right, scene.boxes, scene.aims), MatchStatus.OCCLUDED)

    def test_a_corner_hidden_does_not_move_it(self) -> None:
        scene = case(0, size=24, amplitude=0.0, box_sigma=0.0)
        right = scene.right.clone()
        u, v = scene.truth[0].round().int().tolist()
        right[v + 3 : v + 30, u - 20 : u - 2] = 130.0
        found = match(scene, right=right)
        assert int(found.status[0]) == MatchStatus.GOOD
        assert float((found.pixels - scene.truth).abs().max()) < 0.15

    def test_repeated(self) -> None:
        rig = rig_of((), 0.0)
        wave = torch.sin(torch.arange(SIZE[0]) * 2 * math.pi / 6.0).expand(SIZE[::-1]).double()
        rows = torch.sin(torch.arange(SIZE[1]) / 2.0)[:, None].double()
        image = 100 + 30 * wave + 10 * rows
        boxes = torch.tensor([[100.0, 60, 130, 90]])
        found = ObjectDisparity(rig)(image, image.roll(-3, 1), boxes, torch.tensor([[112.0, 75.0]]))
        self.check(found, MatchStatus.AMBIGUOUS)

    def test_saturated(self) -> None:
        scene = case(0, size=20, amplitude=0.0)
        left, right = ((image * 4.0).clamp(0, 255).to(torch.uint8) for image in (scene.left, scene.right))
        self.check(match(scene, left=left, right=right), MatchStatus.SATURATED, MatchStatus.FLAT)
        # The same brightness without a limit is a picture.
        assert int(match(scene, left=scene.left * 4, right=scene.right * 4).status[0]) == MatchStatus.GOOD

    def test_at_the_border_and_without_ray(self) -> None:
        scene = case()
        edge = torch.tensor([[-8.0, 40, 4, 52]], dtype=torch.float64)
        self.check(match(scene, boxes=edge, aims=torch.tensor([[5.0, 46.0]])), MatchStatus.OUTSIDE)
        self.check(match(scene, boxes=torch.full((1, 4), torch.nan)), MatchStatus.NO_RAY)
        found = ObjectDisparity(scene.rig)(scene.left, scene.right, scene.boxes, torch.full((1, 2), torch.inf))
        assert int(found.status[0]) == MatchStatus.NO_RAY


def test_gradients_to_both_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against differences, in the direction of the gradient and in random ones, at a constant scale of residuals."""
    scene = case(4, noise=0.1, amplitude=0.0)
    monkeypatch.setattr(patches, "_scale", lambda residual, weight: residual.new_full((len(residual),), 0.25))
    images = [scene.left.clone().requires_grad_(), scene.right.clone().requires_grad_()]
    module = ObjectDisparity(scene.rig)
    found = module(*images, scene.boxes, scene.aims)
    weight = torch.tensor([[1.0, 0.3]], dtype=torch.float64)
    gradients = torch.autograd.grad((found.pixels * weight).sum(), images)
    random = torch.Generator().manual_seed(1)
    for number, gradient in enumerate(gradients):
        assert float(gradient.abs().max()) > 0
        noise = torch.randn(gradient.shape, generator=random, dtype=torch.float64)
        for direction in (gradient, noise * (gradient != 0)):
            wanted = float((gradient * direction).sum())
            step = 0.01 / abs(wanted)  # moves the result by 0.01 px each way
            values = []
            for sign in (-1, 1):
                moved = [image.detach().clone() for image in images]
                moved[number] += sign * step * direction
                values.append(float((module(*moved, scene.boxes, scene.aims).pixels * weight).sum()))
            assert (values[1] - values[0]) / (2 * step) == pytest.approx(wanted, rel=0.05)


def test_range_of_an_object() -> None:
    """With the rig, boxes err by tens of percent and matching by one."""
    scene = case(3, noise=0.1, amplitude=0.0, box_sigma=1.5)
    middle = 0.5 * (scene.boxes[:, :2] + scene.boxes[:, 2:])
    locate = Localizer(scene.rig)
    ranges = [float(locate(middle, pixels).enu[0, 2]) for pixels in (scene.truth, match(scene).pixels, scene.aims)]
    assert abs(ranges[1] / ranges[0] - 1) < 0.03
    assert abs(ranges[2] / ranges[0] - 1) > 0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"left": torch.zeros(5, 5)}, "left camera needs"),
        ({"right": torch.full(SIZE[::-1], torch.nan)}, "not finite"),
        ({"boxes": torch.zeros(2, 4)}, "boxes"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        match(case(), **changes)


# Where objects are refused, just within and just beyond each limit; what belongs to an object, and its steps.


GOOD = MatchStatus.GOOD


@pytest.fixture(scope="module")
def scene() -> Case:
    return case(3, noise=0.1, amplitude=0.0, size=24)


def found(scene: Case, **options: Any) -> ObjectDisparities:
    given = scene.left, scene.right, scene.boxes, scene.aims
    return ObjectDisparity(scene.rig, DisparityOptions(**options))(*given)


def status(result: ObjectDisparities) -> MatchStatus:
    return MatchStatus(int(result.status[0]))


def test_limits_of_what_was_found(scene: Case) -> None:
    usual = found(scene)
    assert status(usual) == GOOD
    score, off = float(usual.score[0]), float(usual.off_line[0])
    sigma = float(usual.covariance[0].diagonal().sum().sqrt())
    assert 0.6 < score < 1.0
    for name, value, refused in (
        ("min_score", score, MatchStatus.NO_MATCH), ("max_sigma", sigma, MatchStatus.FLAT),
        ("max_off_line", off, MatchStatus.OFF_LINE),
    ):  # fmt: skip
        step = 1e-3 if name == "min_score" else -1e-3 * value
        assert status(found(scene, **{name: value - step})) == GOOD, name
        assert status(found(scene, **{name: value + step})) == refused, name


def test_derivatives_by_the_anchor(scene: Case) -> None:
    """By moving the point of the left image that is wanted, the object staying what it is."""
    match, given = ObjectDisparity(scene.rig), (scene.left, scene.right, scene.boxes, scene.aims)
    middle = 0.5 * (scene.boxes[:, :2] + scene.boxes[:, 2:])
    slopes = []
    for step in 0.5 * torch.eye(2).double():
        up, down = (match(*given, anchors_left=middle + sign * step).pixels[0] for sign in (1, -1))
        slopes.append(up - down)
    by_anchor = match(*given).by_anchor[0]
    torch.testing.assert_close(by_anchor, torch.stack(slopes, -1), rtol=0, atol=1e-3)
    # The right camera is rolled beside the left one.
    assert abs(float(by_anchor[0, 1] - by_anchor[1, 0])) > 0.03


def test_what_is_refused_has_no_numbers(scene: Case) -> None:
    refused = found(scene, min_score=1.0)
    assert torch.equal(refused.pixels, scene.aims)
    assert torch.equal(refused.by_anchor[0], torch.eye(2).double())
    assert float(refused.off_line[0]) == 0.0
    assert 0.6 < float(refused.score[0]) < 1.0
    nowhere = scene._replace(aims=torch.full((1, 2), torch.nan).double())
    assert float(found(nowhere).score[0]) == 0.0


def objects(masks: Tensor | None = None) -> _Objects:
    boxes = torch.tensor([[10.0, 20.0, 30.0, 28.0]]).double()
    middle = torch.tensor([[20.0, 24.0]]).double()
    return _Objects(boxes, middle, middle, middle, masks, 5, 0)


def test_the_ellipse_in_a_box() -> None:
    """One up to .85 of its radii, zero from 1.15 of them, and half in the middle between."""
    at = torch.tensor([[20.0, 24.0], [28.4, 24.0], [30.0, 24.0], [20.0, 28.0], [20.0, 28.7], [31.5, 24.0]]).double()
    assert objects().weight(at[None, None])[0, 0].tolist() == pytest.approx([1.0, 1.0, 0.5, 0.5, 0.0, 0.0])
    slope = objects().weight(torch.tensor([[[[29.4, 24.0]]]]).double())
    assert float(slope) == pytest.approx((1.15 - 0.94) / 0.3)


def test_masks_are_those_of_the_nearest_pixels() -> None:
    masks = torch.zeros(1, 40, 50, dtype=torch.bool)
    masks[0, 24, 20] = masks[0, 39, 49] = masks[0, 0, 7] = True
    at = torch.tensor([[20.4, 23.6], [20.6, 24.0], [20.0, 24.6], [60.0, 45.0], [7.2, -9.0], [24.0, 20.0]]).double()
    assert objects(masks).weight(at[None, None])[0, 0].tolist() == [1.0, 0.0, 0.0, 1.0, 1.0, 0.0]


def test_patches_have_at_most_24_steps_to_each_side(scene: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 1.15 of half a box, in steps of powers of two; objects of one step size are matched together."""
    seen: list[tuple[int, int, list[float]]] = []

    def collected(self: ObjectDisparity, left: Tensor, right: Tensor, part: _Objects) -> ObjectDisparities:
        size = (part.boxes[:, 2:] - part.boxes[:, :2]).amax(-1)
        seen.append((part.level, part.half, size.tolist()))
        count = len(size)
        return ObjectDisparities(
            part.right, torch.eye(2).double().expand(count, 2, 2), torch.zeros(count).long(), size, size,
            torch.eye(2).double().expand(count, 2, 2),
        )  # fmt: skip

    monkeypatch.setattr(ObjectDisparity, "_match", collected)
    sides = [4.0, 20.0, 41.7, 41.8, 83.4, 83.6]
    boxes = torch.tensor([[30.0, 40.0, 30.0 + side, 40.0 + 0.5 * side] for side in sides], dtype=torch.float64)
    aims = torch.zeros(6, 2).double()
    aims[1] = torch.nan
    result = ObjectDisparity(scene.rig)(scene.left, scene.right, boxes, aims)
    levels = [(level, half, pytest.approx(size)) for level, half, size in seen]
    assert levels == [(0, 24, [4.0, 41.7]), (1, 24, [41.8, 83.4]), (2, 13, [83.6])]
    assert result.status.tolist() == [0, MatchStatus.NO_RAY, 0, 0, 0, 0]
    seen.clear()
    ObjectDisparity(scene.rig)(scene.left, scene.right, boxes[:1], aims[:1])
    assert seen == [(0, 3, [4.0])]


def test_what_is_named_last_counts() -> None:
    start = torch.zeros(3, dtype=torch.int64)
    yes, no = torch.tensor([True, True, False]), torch.tensor([False, True, False])
    status = flagged(start, (yes, MatchStatus.FLAT), (no, MatchStatus.NO_RAY))
    assert status.tolist() == [MatchStatus.FLAT, MatchStatus.NO_RAY, 0]


def test_the_brightest_gray_level_is_that_of_the_type() -> None:
    usual = DisparityOptions()
    assert _brightest(torch.zeros(2, 2, dtype=torch.uint8), usual) == 255.0
    assert _brightest(torch.zeros(2, 2, dtype=torch.int16), usual) == 32767.0
    assert _brightest(torch.zeros(2, 2), usual) == math.inf
    assert _brightest(torch.zeros(2, 2), DisparityOptions(brightest=99.0)) == 99.0


def test_half_of_an_object_may_be_too_bright(scene: Case) -> None:
    """By its left part above one gray level: the share that may be is what `min_share` leaves."""
    left = scene.left.clone()
    box = scene.boxes[0]
    columns = torch.arange(left.shape[1]).double()
    for share, refused in ((0.3, False), (0.7, True)):
        bright = left.clone()
        bright[:, columns < float(box[0] + share * (box[2] - box[0]))] = 1000.0
        spoilt = found(scene._replace(left=bright), brightest=1000.0, min_share=0.5)
        assert (status(spoilt) == MatchStatus.SATURATED) is refused


@pytest.mark.parametrize(("good", "bad"), [
    ({"search": 1.0}, {"search": 0.9}), ({"search": 200.0}, {"search": 201.0}),
    ({"max_off_line": 1e-9}, {"max_off_line": 0.0}), ({"max_off_line": 20.0}, {"max_off_line": 20.1}),
    ({"max_sigma": 1e9}, {"max_sigma": math.inf}), ({"max_sigma": 1e-9}, {"max_sigma": 0.0}),
    ({"min_score": 1.0}, {"min_score": 1.1}), ({"max_rival": 1.0}, {"max_rival": 0.0}),
    ({"min_share": 1e-9}, {"min_share": 0.0}),
])  # fmt: skip
def test_options_at_their_limits(good: dict[str, float], bad: dict[str, float]) -> None:
    DisparityOptions(**good)
    with pytest.raises(InputError, match="disparity options"):
        DisparityOptions(**bad)
