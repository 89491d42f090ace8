"""What the numbers mean: axes, pixel centers, skew, names and their order. One worked value for each."""

import math
from collections.abc import Callable

import pytest
import torch

from kcal import Camera, InputError, Rig
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import INTRINSICS, parameter_names
from scripts.shared.distorted import distort

OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")


def pixel(camera: Camera, point: list[float]) -> list[float]:
    pixels, valid = camera.project(torch.tensor([point], dtype=torch.float64))
    assert bool(valid.all())
    return pixels[0].tolist()


class TestFrames:
    camera = Camera.build(focal=(1000, 1100), center=(640, 360), size=(1280, 720), model="pinhole")

    def test_axis_hits_the_principal_point(self) -> None:
        assert pixel(self.camera, [0.0, 0.0, 7.0]) == [640.0, 360.0]

    def test_x_right_y_down_z_forward(self) -> None:
        assert pixel(self.camera, [1.0, 0.0, 10.0]) == [740.0, 360.0]
        assert pixel(self.camera, [0.0, 1.0, 10.0]) == [640.0, 470.0]
        assert pixel(self.camera, [1.0, 0.0, 5.0]) == [840.0, 360.0]

    def test_ray_points_where_the_pixel_looks(self) -> None:
        rays, valid = self.camera.unproject(torch.tensor([[1640.0, 360.0], [640.0, 1460.0]], dtype=torch.float64))
        half = math.sqrt(0.5)
        expected = torch.tensor([[half, 0.0, half], [0.0, half, half]], dtype=torch.float64)
        torch.testing.assert_close(rays, expected, rtol=0, atol=1e-15)
        assert valid.tolist() == [True, True]

    def test_integer_pixel_is_a_center(self) -> None:
        # An image of 1280 columns reaches from -0.5 (left edge) to 1279.5 (right edge); its middle is 639.5.
        edges = torch.tensor(
            [[-0.5, 0.0], [-0.51, 0.0], [1279.5, 0.0], [1279.51, 0.0], [0.0, -0.51], [0.0, 719.5], [0.0, 719.51]]
        )
        assert self.camera.inside(edges).tolist() == [True, False, True, False, False, True, False]

    def test_skew_is_gamma_of_eq_3(self) -> None:
        camera = Camera.build(focal=(1000, 1100), center=(640, 360), size=(1280, 720), skew=20.0, model="pinhole")
        # u = fx x + γ y + cx: skew moves u with y, and v not at all.
        assert pixel(camera, [0.0, 1.0, 10.0]) == [642.0, 470.0]
        assert camera.matrix.tolist() == [[1000.0, 20.0, 640.0], [0.0, 1100.0, 360.0], [0.0, 0.0, 1.0]]
        rays, _ = camera.unproject(torch.tensor([[642.0, 470.0]], dtype=torch.float64))
        torch.testing.assert_close(
            rays[0] / rays[0, 2], torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64), rtol=0, atol=1e-15
        )

    def test_skew_acts_after_the_lens(self) -> None:
        camera = Camera.build(
            focal=(1000, 1000), center=(0, 0), size=(10, 10), skew=100.0, coefficients=[-0.25], model="opencv4"
        )
        # y = 0.5 is distorted to 0.46875 first.
        assert pixel(camera, [0.0, 0.5, 1.0]) == [46.875, 468.75]

    def test_rig_frame_is_the_left_camera(self) -> None:
        # The right camera stands 10 m to the right: its points are 10 m further left.
        rig = Rig.pair(self.camera, self.camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        pixels, valid = rig(torch.tensor([[0.0, 0.0, 100.0]]))
        (left, right), valid = pixels.unbind(-2), valid.all(-1)
        assert (left.tolist(), right.tolist(), valid.tolist()) == ([[640.0, 360.0]], [[540.0, 360.0]], [True])

    def test_rig_rotation_applies_before_translation(self) -> None:
        quarter = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        rig = Rig.pair(self.camera, self.camera, quarter, torch.tensor([1.0, 2.0, 3.0]))
        assert rig.right_from_left(torch.tensor([[4.0, 5.0, 6.0]])).tolist() == [[7.0, 7.0, -1.0]]


class TestTerms:
    """Each coefficient alone on one point whose arithmetic is exact: s = x² + y² = 0.3125."""

    X, Y, S = 0.5, 0.25, 0.3125

    @pytest.mark.parametrize(
        ("name", "expected"),
        [
            *((f"k{i}", lambda x, y, s, j=j: (x * (1 + s**j / 8), y * (1 + s**j / 8))) for i, j in
              ((1, 1), (2, 2), (3, 3), (7, 4), (8, 5), (11, 6), (13, 7))),
            *((f"k{i}", lambda x, y, s, j=j: (x / (1 + s**j / 8), y / (1 + s**j / 8))) for i, j in
              ((4, 1), (5, 2), (6, 3), (9, 4), (10, 5), (12, 6), (14, 7))),
            ("p1", lambda x, y, s: (x + x * y / 4, y + (s + 2 * y * y) / 8)),
            ("p2", lambda x, y, s: (x + (s + 2 * x * x) / 8, y + x * y / 4)),
            *((f"s{i}", lambda x, y, s, j=j: (x + s**j / 8, y)) for i, j in ((1, 1), (2, 2), (5, 3), (7, 4))),
            *((f"s{i}", lambda x, y, s, j=j: (x, y + s**j / 8)) for i, j in ((3, 1), (4, 2), (6, 3), (8, 4))),
            # A tilt about x: w = cos τ - sin τ y; x cos τ / w, y / w.
            ("tau_x", lambda x, y, s: (
                x * math.cos(0.125) / (math.cos(0.125) - math.sin(0.125) * y),
                y / (math.cos(0.125) - math.sin(0.125) * y),
            )),
            # A tilt about y: w = cos τ + sin τ x; x / w, y cos τ / w.
            ("tau_y", lambda x, y, s: (
                x / (math.cos(0.125) + math.sin(0.125) * x),
                y * math.cos(0.125) / (math.cos(0.125) + math.sin(0.125) * x),
            )),
        ],
    )  # fmt: skip
    def test_alone(self, name: str, expected: Callable[[float, float, float], tuple[float, float]]) -> None:
        model = LensModel(numerator=7, denominator=7, tangential=True, prism=4, tilt=True)
        coefficients = torch.zeros(model.size, dtype=torch.float64)
        coefficients[model.names.index(name)] = 0.125
        point = torch.tensor([[self.X, self.Y]], dtype=torch.float64)
        want = torch.tensor([expected(self.X, self.Y, self.S)], dtype=torch.float64)
        torch.testing.assert_close(distort(point, coefficients, model), want, rtol=0, atol=2e-16)
        # The term must do something, or the formula above would prove nothing.
        assert not torch.equal(want, point)

    def test_every_name_is_covered(self) -> None:
        model = LensModel(numerator=7, denominator=7, tangential=True, prism=4, tilt=True)
        (mark,) = (m for m in type(self).test_alone.pytestmark if m.name == "parametrize")
        assert {case[0] for case in mark.args[1]} == set(model.names)


class TestNames:
    def test_opencv_vectors_are_prefixes(self) -> None:
        for size in (4, 5, 8, 12, 14):
            assert LensModel.named(f"opencv{size}").names == OPENCV_ORDER[:size]

    @pytest.mark.parametrize("name", [name for name in PRESETS if name.startswith("ext")])
    def test_extended_models_begin_with_opencv(self, name: str) -> None:
        assert LensModel.named(name).names[:14] == OPENCV_ORDER

    def test_extended_names(self) -> None:
        assert LensModel.named("ext24").names[14:] == (
            "k7", "k8", "k9", "k10", "s5", "s6", "k11", "k12", "k13", "k14",
        )  # fmt: skip
        assert LensModel.named("ext20").names[14:] == ("k7", "k8", "k9", "k10", "s5", "s6")
        assert LensModel.named("ext20b").names[14:] == ("k7", "k8", "k9", "k10", "k11", "k12")

    def test_sizes_are_in_the_preset_names(self) -> None:
        digits = {name: int("".join(c for c in name if c.isdigit()) or 0) for name in PRESETS}
        assert {name: model.size for name, model in PRESETS.items()} == digits

    def test_parameters_begin_with_the_intrinsics(self) -> None:
        assert INTRINSICS == ("fx", "fy", "cx", "cy", "skew")
        assert parameter_names(LensModel.named("opencv5")) == (*INTRINSICS, "k1", "k2", "p1", "p2", "k3")

    def test_contains(self) -> None:
        ladder = [LensModel.named(f"opencv{size}") for size in (4, 5, 8, 12, 14)]
        for i, small in enumerate(ladder):
            for j, large in enumerate(ladder):
                assert large.contains(small) == (i <= j)
        assert not LensModel.named("ext20").contains(LensModel.named("ext20b"))

    @pytest.mark.parametrize(
        "orders", [{"numerator": 8}, {"numerator": -1}, {"denominator": 1.5}, {"prism": True}, {"prism": 5}], ids=str
    )
    def test_wrong_orders(self, orders: dict) -> None:
        with pytest.raises(InputError, match="whole number"):
            LensModel(**orders)

    def test_unknown_preset_lists_the_known(self) -> None:
        with pytest.raises(InputError, match=r"opencv14.*ext24"):
            LensModel.named("fisheye")
