"""Cameras mixed up: the same one twice, left and right swapped throughout, and mirror images of a rig."""

import dataclasses
import math
from typing import Any

import pytest
import torch
from rig_scenes import CAMERAS, CENTER, boards, features, landmarks, normal, see, spread_points, tensor

from kcal import Baseline, Camera, Features, InputError, MeasuredPosition, RigData, RigOptions, solve_rig

BASELINE = Baseline(first=0, second=1, length=float((CENTER[0] - CENTER[1]).norm()), sigma=0.005)
POSITIONS = tuple(MeasuredPosition(camera=c, point=CENTER[c], sigma=torch.full((3,), 0.02).double()) for c in (0, 1))


def near(count: int = 20) -> Features:
    """Things from 60 m to 2 km, whose range is not known."""
    truth = spread_points(count, 60.0, 2000.0, 9)
    pixels = torch.stack([see(truth, c) for c in (0, 1)], 1)
    return Features(
        names=tuple(f"gable {i}" for i in range(count)),
        pixels=pixels + 0.1 * normal(pixels.shape, 400),
        inverse_range=torch.zeros(count).double(),
        inverse_range_sigma=torch.full((count,), math.inf).double(),
        pixel_sigma=0.1,
    )


SOURCES: dict[str, dict[str, Any]] = {
    "boards": {"boards": boards(noise=0.1)},
    "landmarks": {"landmarks": landmarks(noise=0.1, error=0.02)},
    "features of known range": {"features": features(noise=0.1, known=0.1), "baselines": (BASELINE,)},
    "features of unknown range": {"features": near(), "baselines": (BASELINE,)},
    "features and positions": {"features": near(), "positions": POSITIONS},
    "landmarks and features": {"landmarks": landmarks(noise=0.1, error=0.02), "features": near()},
}


def swapped(source: Any) -> Any:
    """A source with its two cameras exchanged."""
    if isinstance(source, tuple):
        return tuple(dataclasses.replace(p, camera=1 - p.camera) if hasattr(p, "camera") else p for p in source)
    return dataclasses.replace(source, pixels=source.pixels.flip(1))


class TestSwap:
    @pytest.mark.parametrize("kind", list(SOURCES))
    def test_of_everything_is_told_by_the_side(self, kind: str) -> None:
        """Cameras, pixels and positions agree with each other; only the names are wrong."""
        sources = {name: swapped(source) for name, source in SOURCES[kind].items()}
        names = ("left", "right")
        found = solve_rig(RigData(cameras=CAMERAS[1::-1], names=names, **sources))
        (text,) = [text for text in found.warnings if "swapped" in text]
        assert "m to the left of the left camera: left and right are swapped" in text
        right = solve_rig(RigData(cameras=CAMERAS[:2], names=names, **SOURCES[kind]))
        assert not any("swapped" in text for text in right.warnings)

    def test_cameras_of_other_names_have_no_sides(self) -> None:
        shown = swapped(boards(noise=0.1))
        assert solve_rig(RigData(cameras=CAMERAS[1::-1], names=("A", "B"), boards=shown)).warnings == ()

    def test_of_cameras_that_lie_on_their_sides_is_judged_by_the_vertical(self) -> None:
        """Both cameras turned by 180° about their axes: landmarks know what is up, boards do not."""
        turn = torch.diag(tensor(-1.0, -1.0, 1.0))
        cameras = tuple(
            Camera.build(focal=camera.focal, center=tensor(1919.0, 1079.0) - camera.center, size=camera.size)
            for camera in CAMERAS[:2]
        )
        marks, shown = landmarks(), boards()
        for c in (0, 1):
            rays, _ = CAMERAS[c].unproject(marks.pixels[:, c])
            marks.pixels[:, c] = cameras[c].project(rays @ turn)[0]
            rays, _ = CAMERAS[c].unproject(shown.pixels[:, c])
            shown.pixels[:, c] = cameras[c].project(rays @ turn)[0]
        assert solve_rig(RigData(cameras=cameras, names=("left", "right"), landmarks=marks)).warnings == ()
        loose = solve_rig(RigData(cameras=cameras, names=("left", "right"), boards=shown))
        assert ["or both cameras hang upside down" in text for text in loose.warnings] == [True]

    def test_cameras_above_each_other_have_no_sides(self) -> None:
        camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        centers = tensor([0.0, 0.0, 0.0], [-0.5, 1.0, 0.0])
        draw = torch.rand(12, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        points = tensor(-4.0, -4.0, 20.0) + draw * tensor(8.0, 8.0, 60.0)
        pixels = torch.stack([camera.project(points - center)[0] for center in centers], 1)
        known = 1.0 / points.norm(dim=-1)
        far = Features(
            names=tuple("abcdefghijkl"), pixels=pixels, inverse_range=known, inverse_range_sigma=0.01 * known
        )
        length = Baseline(first=0, second=1, length=float(centers[1].norm()), sigma=0.001)
        found = solve_rig(RigData(cameras=(camera, camera), names=("left", "right"), features=far, baselines=(length,)))
        torch.testing.assert_close(found.center[1], centers[1], rtol=0, atol=0.05)
        assert not any("swapped" in text for text in found.warnings)

    def test_of_the_features_alone_is_told_by_negative_parallax(self) -> None:
        """Landmarks say where the cameras stand; the marks of features are in each other's columns."""
        camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        look, centers = tensor([1.0, 0, 0], [0, 0, -1], [0, 1, 0]), tensor([0.0, 0, 0], [10.0, 0, 0])
        draw = torch.rand(20, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        points = (draw - 0.5) * tensor(80.0, 0.0, 40.0) + tensor(0.0, 150.0, 0.0) + draw * tensor(0.0, 300.0, 0.0)
        pixels = torch.stack([camera.project((points - center) @ look.T)[0] for center in centers], 1)
        survey = dataclasses.replace(landmarks(), points=points[:12], pixels=pixels[:12])
        known = torch.zeros(8).double(), torch.full((8,), math.inf).double()
        gables = Features(
            names=tuple("abcdefgh"), pixels=pixels[12:], inverse_range=known[0], inverse_range_sigma=known[1]
        )
        data = RigData(cameras=(camera, camera), names=("left", "right"), landmarks=survey, features=gables)
        assert solve_rig(data).warnings == ()
        found = solve_rig(dataclasses.replace(data, features=swapped(gables)))
        assert found.left_out == ()
        (text,) = found.warnings
        assert text.startswith("8 of 8 features have negative parallax")
        assert "left and right marks are swapped" in text

    def test_a_few_features_with_negative_parallax_are_left_out_and_named(self) -> None:
        """A wrong match on its epipolar line has no residual; its lines meet behind the cameras."""
        good, away = near(), spread_points(20, 60.0, 2000.0, 9)[:2] - CENTER[0]
        pixels = good.pixels.clone()
        # Where a point as far behind, on the same line of the left camera, would have its image.
        pixels[:2, 1] = see(2.0 * CENTER[1] - CENTER[0] + 40.0 * away / away.norm(dim=-1, keepdim=True), 1)
        wrong = dataclasses.replace(good, pixels=pixels)
        data = RigData(cameras=CAMERAS[:2], names=("left", "right"), features=wrong, landmarks=landmarks(noise=0.1))
        found = solve_rig(data)
        assert {item.name for item in found.left_out} == {"gable 0", "gable 1"}
        assert all("negative parallax" in item.reason for item in found.left_out)
        assert found.warnings == ()

    def test_a_survey_in_millimeters_is_asked_for_its_unit(self) -> None:
        survey = landmarks(noise=0.1, error=0.02)
        large = dataclasses.replace(survey, points=1e3 * survey.points, sigma=1e3 * survey.sigma)
        straight = RigOptions(refraction=0.0, refraction_sigma=0.0)
        asked = [
            [text for text in solve_rig(data, straight).warnings if "as if the survey were not in meters" in text]
            for source in (survey, large)
            for data in [RigData(cameras=CAMERAS[:2], names=("left", "right"), landmarks=source)]
        ]
        assert (asked[0], len(asked[1])) == ([], 1)
        assert "the cameras 10.0 km apart" in asked[1][0]

    def test_a_rig_is_not_taken_for_its_mirror_image(self) -> None:
        """Features of unknown range fit a reversed baseline with negative ranges as well."""
        found = solve_rig(RigData(cameras=CAMERAS[:2], names=("left", "right"), **SOURCES["features and positions"]))
        assert float(found.stereo().right_from_left_translation[0]) < -9.0
        assert [text for text in found.warnings if "swapped" in text or "parallax" in text] == []


class TestSameCamera:
    @pytest.mark.parametrize("kind", ["boards", "landmarks", "features"])
    def test_twice_is_refused(self, kind: str) -> None:
        source = {"boards": boards(noise=0.1), "landmarks": landmarks(), "features": near()}[kind]
        same = dataclasses.replace(source, pixels=source.pixels[:, [0, 0]])  # type: ignore[type-var]
        with pytest.raises(InputError, match="left and right have the same pixels everywhere: this is the same camera"):
            solve_rig(RigData(cameras=CAMERAS[:2], names=("left", "right"), **{kind: same}))

    def test_among_three_is_named(self) -> None:
        shown = boards(cameras=3, noise=0.1)
        same = dataclasses.replace(shown, pixels=shown.pixels[:, [0, 1, 1]])
        with pytest.raises(InputError, match="right and middle have the same pixels"):
            solve_rig(RigData(cameras=CAMERAS, names=("left", "right", "middle"), boards=same))
