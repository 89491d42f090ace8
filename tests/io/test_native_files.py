"""kcal's camera and rig files: exact, and refused when they do not fit.

Cameras with a hybrid lens in kcal's files: exact, by name, and refused when they do not fit.
"""

import copy
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import ran
from lenses import FEW_MODES, hybrid_camera
from wrong_files import assert_refused

from kcal import Camera, FileError, InputError, Rig
from kcal.io.camera_file import CameraFile, camera_to_file, load_camera, provenance, save_camera
from kcal.io.rig_file import RigFile, load_rig, rig_to_file, save_rig
from kcal.lens.calibration import BoardRecord, CalibrationRecord, CameraCalibration, Exclusion, RigCalibration
from kcal.lens.model import PRESETS, LensModel
from kcal.native_file import digest


def awkward_camera(model: str | LensModel) -> Camera:
    """A camera whose numbers have no short decimal form."""
    generator = torch.Generator().manual_seed(7)
    lens = torch.randn(LensModel.named(model).size, generator=generator, dtype=torch.float64) * 1e-3
    head = torch.tensor([1600.0 / 3, 1601.0 / 7, 959.5 + 1e-13, -math.pi, 1e-300], dtype=torch.float64)
    return Camera(torch.cat([head, lens]), size=(1920, 1080), model=model)


def rotation_about(axis: list[float], angle: float) -> torch.Tensor:
    x, y, z = axis
    return torch.linalg.matrix_exp(angle * torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))


@pytest.fixture(scope="module")
def camera() -> Camera:
    return awkward_camera("ext20")


@pytest.fixture(scope="module")
def rig(camera: Camera) -> Rig:
    rotation = rotation_about([0.6, 0.0, 0.8], 0.1)
    return Rig.pair(camera, awkward_camera("opencv5"), rotation, torch.tensor([-10.1, 0.2, 1 / 3]).double())


def camera_calibration() -> CalibrationRecord:
    return CalibrationRecord(
        rms=0.157,
        views=2,
        points=108,
        per_view_rms={"a.jpg": 0.1, "b.jpg": 0.2},
        excluded=(Exclusion(name="c.jpg", reason="no board found"),),
        board=BoardRecord(columns=9, rows=6, square=0.025),
        board_warp=(1e-4, -2e-4),
        stop_reason="cost no longer falls",
        iterations=12,
        observations="left.json",
        **provenance(),
    )


def known(camera: Camera, **parts: Any) -> Camera:
    """The same camera with a calibration."""
    camera = copy.deepcopy(camera)
    camera.calibration = CameraCalibration(**parts)
    return camera


def rig_calibration() -> RigCalibration:
    return RigCalibration(
        rms=0.3,
        rms_px=(0.2, 0.4),
        pairs=1,
        per_pair_rms={"01": 0.3},
        flipped=("01",),
        excluded=(Exclusion(name="02", reason="seen by one camera only"),),
        warnings=("the landmarks determine the baseline poorly",),
        **provenance(),
    )


class TestCamera:
    @pytest.mark.parametrize("model", [*PRESETS, LensModel(numerator=1, denominator=4, prism=1)], ids=str)
    def test_round_trip_is_exact(self, tmp_path: Path, model: str | LensModel) -> None:
        before = awkward_camera(model)
        after = load_camera(save_camera(before, tmp_path / "camera.json"))
        assert torch.equal(after.params, before.params)
        assert (after.model, after.size, after.fingerprint) == (before.model, before.size, before.fingerprint)

    def test_record_round_trip(self, tmp_path: Path, camera: Camera) -> None:
        sigma = {name: 0.1 / (1 + i) for i, name in enumerate(camera.names) if name != "skew"}
        before = camera_to_file(known(camera, name="left", sigma=sigma, record=camera_calibration()))
        after = CameraFile.load(before.save(tmp_path / "camera.json"))
        assert after == before
        assert after.standard_deviations is not None
        assert after.standard_deviations["skew"] is None
        assert after.standard_deviations["fy"] == 0.1 / 2
        assert tuple(after.standard_deviations) == camera.names

    def test_what_was_left_out_is_kept_and_absent_elsewhere(self, tmp_path: Path, camera: Camera) -> None:
        record = dataclasses.replace(camera_calibration(), without=("bending",), moves=(0.0, 5.0, 4.0))
        save_camera(known(camera, record=record), tmp_path / "camera.json")
        calibration = load_camera(tmp_path / "camera.json").calibration
        assert calibration is not None
        assert calibration.record == record
        text = save_camera(known(camera, record=camera_calibration()), tmp_path / "camera.json").read_text()
        assert "without" not in text
        assert "moves" not in text

    def test_covariance_round_trip(self, tmp_path: Path, camera: Camera) -> None:
        """By name, without what was held, to the last bit; and as a rig's covariance wants it."""
        count = len(camera.names)
        factor = torch.randn(count, count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        factor[camera.names.index("skew")] = 0.0
        matrix = factor @ factor.T
        file = CameraFile.load(camera_to_file(known(camera, covariance=matrix)).save(tmp_path / "camera.json"))
        assert file.covariance is not None
        assert file.covariance.names == tuple(name for name in camera.names if name != "skew")
        again = file.covariance_matrix()
        assert again is not None
        assert torch.equal(again, matrix)
        assert camera_to_file(camera).covariance_matrix() is None
        exact = camera_to_file(known(camera, covariance=torch.zeros_like(matrix))).covariance_matrix()
        assert exact is not None
        assert torch.equal(exact, torch.zeros_like(matrix))
        shuffled = file.covariance.model_copy(
            update={
                "names": file.covariance.names[::-1],
                "matrix": tuple(row[::-1] for row in file.covariance.matrix[::-1]),
            }
        )
        assert torch.equal(shuffled.expand(camera.names), matrix)

    @pytest.mark.parametrize(
        ("names", "matrix", "message"),
        [
            (("fx", "fy"), ((1.0, 0.0),), "2 rows of 2"),
            (("fx", "fy"), ((1.0, 0.5), (0.4, 1.0)), "symmetric"),
            (("fx", "fy"), ((1.0, 2.0), (2.0, 1.0)), "negative eigenvalue"),
            (("fx", "fx"), ((1.0, 0.0), (0.0, 1.0)), "twice"),
            (("fx", "k9x"), ((1.0, 0.0), (0.0, 1.0)), "k9x is unknown"),
            (("fx",), ((math.inf,),), "finite"),
        ],
    )
    def test_no_covariance(self, tmp_path: Path, camera: Camera, names: Any, matrix: Any, message: str) -> None:
        stated = {"names": names, "matrix": matrix}
        assert_refused(CameraFile.load, tmp_path, camera_to_file(camera).dump(), ["covariance"], stated, message)

    def test_covariance_of_another_camera(self, camera: Camera) -> None:
        with pytest.raises(InputError, match="covariance"):
            camera_to_file(known(camera, covariance=torch.eye(3).double()))

    def test_stored_form(self) -> None:
        # The format, spelled out: whoever reads these files elsewhere depends on it.
        camera = Camera.build(focal=(800, 801), center=(320, 240), size=(640, 480), coefficients=[0.1], model="opencv4")
        content = camera_to_file(camera, name="left").dump()
        assert content.pop("summary")["of"] == digest(content)
        assert content == {
            "kcal": "camera",
            "version": 2,
            "name": "left",
            "image_size": [640, 480],
            "model": dict(numerator=2, denominator=0, tangential=True, prism=0, tilt=False, fisheye=False),
            "intrinsics": {"fx": 800.0, "fy": 801.0, "cx": 320.0, "cy": 240.0, "skew": 0.0},
            "coefficients": {"k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0},
            **dict.fromkeys(("standard_deviations", "covariance", "information", "calibration")),
            "valid_region": {
                "radius": math.tan(math.radians(89.0)),
                "polygon": [[-0.5, 479.5], [-0.5, -0.5], [639.5, -0.5], [639.5, 479.5]],
            },
        }

    def test_valid_region_of_a_lens_that_folds(self, tmp_path: Path) -> None:
        camera = Camera.build(focal=(400, 400), center=(320, 240), size=(640, 480), coefficients=[-0.3, 0.0])
        stored = CameraFile.load(save_camera(camera, tmp_path / "camera.json")).valid_region
        assert stored is not None
        assert stored.radius == pytest.approx(1 / math.sqrt(0.9), abs=1e-12)
        polygon = torch.tensor(stored.polygon, dtype=torch.float64)
        # x - 0.3 x³ turns back at two thirds of 1 / √0.9, 281 px off axis: a circle cut by the image above and below.
        outward = polygon - camera.center
        on_circle = (torch.linalg.vector_norm(outward, dim=-1) - 400 * 2 / 3 / math.sqrt(0.9)).abs() < 2e-3
        on_border = (polygon[:, 1] + 0.5).abs().minimum((polygon[:, 1] - 479.5).abs()) < 1e-3
        assert bool((on_circle | on_border).all())
        assert int(on_circle.sum()) > 50
        assert camera.unproject(camera.center + 0.999 * outward)[1].all()
        assert not camera.unproject(camera.center + 1.001 * outward[on_circle])[1].any()

    def test_values_go_by_name(self, tmp_path: Path, camera: Camera) -> None:
        content = camera_to_file(camera).dump()
        content["coefficients"] = dict(reversed(content["coefficients"].items()))
        path = tmp_path / "reordered.json"
        path.write_text(json.dumps(content))
        assert torch.equal(load_camera(path).params, camera.params)

    @pytest.mark.parametrize(
        ("path_in_file", "value", "message"),
        [
            (["coefficients", "k99"], 0.0, "k99 is unknown"),
            (["coefficients", "k1"], math.nan, "finite"),
            (["coefficients", "k1"], math.inf, "finite"),
            (["coefficients", "k1"], "fast", "number"),
            (["model", "numerator"], 4, "missing|unknown"),
            (["model", "numerator"], 99, "0 to 7"),
            (["model", "mirror"], True, "Extra"),
            (["intrinsics", "fx"], 0.0, "greater than 0"),
            (["intrinsics", "cx"], math.nan, "finite"),
            (["image_size"], [640, 0], "greater than 0"),
            (["image_size"], [640], "required"),
            (["image_size"], [10**400, 480], "has 401 digits"),
            (["image_size"], [10**300, 480], "at most 500 megapixels"),
            (["image_size"], [30_000, 30_000], "30000x30000 pixels; .* at most 500 megapixels"),
            (["image_size"], ["640", "480"], "image_size.0: Input should be a valid integer"),
            (["intrinsics", "fy"], True, "intrinsics.fy: Input should be a valid number"),
            (["intrinsics", "fy"], "1600", "intrinsics.fy: Input should be a valid number"),
            (["calibration", "board_deviation"], [[0.0, 0.0, math.nan]], "finite"),
            (["standard_deviations"], {"fx": 1.0}, "fy is missing"),
            (["standard_deviations", "fx"], -1.0, "greater than or equal to 0"),
            (["calibration", "views"], 3, "per_view_rms has 2"),
            (["calibration", "created"], "2026-01-01T00:00:00", "timezone"),
            (["version"], 3, "version 3"),
            (["color"], "red", "Extra"),
        ],
    )
    def test_wrong_field(
        self, tmp_path: Path, camera: Camera, path_in_file: list[str], value: Any, message: str
    ) -> None:
        sigma = dict.fromkeys(camera.names, 0.1)
        content = camera_to_file(known(camera, sigma=sigma, record=camera_calibration())).dump()
        assert_refused(load_camera, tmp_path, content, path_in_file, value, message)

    def test_missing_coefficient(self, tmp_path: Path, camera: Camera) -> None:
        content = camera_to_file(camera).dump()
        del content["coefficients"]["s6"]
        path = tmp_path / "short.json"
        path.write_text(json.dumps(content))
        with pytest.raises(FileError, match=r"short\.json.*s6 is missing"):
            load_camera(path)

    def test_refused_when_stored(self, camera: Camera) -> None:
        with pytest.raises(InputError, match="k99"):
            camera_to_file(known(camera, sigma={"k99": 0.1}))
        with pytest.raises(InputError, match="finite"):
            camera_to_file(known(camera, sigma={"fx": math.nan}))
        with pytest.raises(InputError, match="batch"):
            camera_to_file(Camera(camera.params.expand(3, -1), size=camera.size, model=camera.model))
        broken = copy.deepcopy(camera)
        with torch.no_grad():
            broken.params[7] = math.nan
        with pytest.raises(InputError, match="finite"):
            camera_to_file(broken)


class TestRig:
    def test_round_trip_is_exact(self, tmp_path: Path, rig: Rig) -> None:
        after = load_rig(save_rig(rig, tmp_path / "rig.json"))
        assert after.left.fingerprint == rig.left.fingerprint
        assert after.right.fingerprint == rig.right.fingerprint
        assert torch.equal(after.right_from_left_rotation, rig.right_from_left_rotation)
        assert torch.equal(after.right_from_left_translation, rig.right_from_left_translation)

    def test_record_round_trip(self, tmp_path: Path, rig: Rig) -> None:
        rig = copy.deepcopy(rig)
        rig.left.calibration = CameraCalibration(name="west", record=camera_calibration())
        rig.calibration = rig_calibration()
        before = rig_to_file(rig)
        after = RigFile.load(before.save(tmp_path / "rig.json"))
        assert after == before
        assert [camera.name for camera in after.cameras] == ["west", "right"]
        assert after.calibration is not None

    def test_kinds_are_told_apart(self, tmp_path: Path, rig: Rig) -> None:
        rig_path = save_rig(rig, tmp_path / "rig.json")
        camera_path = save_camera(rig.left, tmp_path / "camera.json")
        with pytest.raises(FileError, match=r"rig\.json: this is a kcal rig file; a kcal camera file is needed"):
            load_camera(rig_path)
        with pytest.raises(FileError, match=r"camera\.json: this is a kcal camera file; a kcal rig file is needed"):
            load_rig(camera_path)

    @pytest.mark.parametrize(
        ("path_in_file", "value", "message"),
        [
            (["poses", 1, "rotation", 0, 0], 0.5, "no rotation"),
            (["poses", 1, "rotation"], [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "no rotation"),
            (["poses", 1, "rotation", 2, 2], math.nan, "finite"),
            (["poses", 1, "rotation"], [[1, 0], [0, 1]], "required"),
            (["poses", 1, "translation"], [1.0, 2.0], "required"),
            (["names", 1], "left", "unlike names"),
            (["cameras", 0, "coefficients", "k1"], math.inf, "finite"),
            (["cameras", 1, "coefficients", "k9"], 0.0, "k9 is unknown"),
            (["calibration", "pairs"], 5, "per_pair_rms has 1"),
        ],
    )
    def test_wrong_field(self, tmp_path: Path, rig: Rig, path_in_file: list[Any], value: Any, message: str) -> None:
        rig = copy.deepcopy(rig)
        rig.calibration = rig_calibration()
        assert_refused(load_rig, tmp_path, rig_to_file(rig).dump(), path_in_file, value, message)

    @pytest.mark.parametrize(
        ("path_in_file", "value", "message"),
        [
            (["right_from_left", "rotation", 0, 0], 0.5, "no rotation"),
            (["right_from_left", "rotation"], [[1, 0], [0, 1]], "required"),
            (["right_from_left", "translation"], [1.0, 2.0], "required"),
            (["right_from_left", "translation", 0], -10.2, "baseline_m"),
            (["right", "coefficients", "k9"], 0.0, "k9 is unknown"),
            (["calibration", "frame"], "right camera", "left camera"),
            (["calibration", "pairs"], 5, "per_pair_rms has"),
            (["covariance"], [[1.0]], "covariance"),
        ],
    )
    def test_wrong_field_of_a_file_of_1_0(
        self, tmp_path: Path, path_in_file: list[Any], value: Any, message: str
    ) -> None:
        content = json.loads((Path(__file__).parent / "rig.json").read_text(encoding="utf-8"))
        assert content["version"] == 2
        assert_refused(load_rig, tmp_path, content, path_in_file, value, message)

    def test_a_ragged_link_is_refused_by_its_name(self, tmp_path: Path) -> None:
        content = json.loads((Path(__file__).parent / "rig.json").read_text(encoding="utf-8"))
        content["mounting"]["link"][1] = [0.0] * 5
        assert_refused(load_rig, tmp_path, content, ["mounting", "roll_deg"], 6, "the mounting's link must be 26 x 6")

    def test_old_file_survives_a_refused_save(self, tmp_path: Path, rig: Rig) -> None:
        path = save_rig(rig, tmp_path / "rig.json")
        text = path.read_text()
        broken = copy.deepcopy(rig)
        broken.translation[1, 0] = math.nan
        with pytest.raises(InputError, match=r"this rig cannot be stored: translation\.0: .*finite"):
            save_rig(broken, path)
        assert path.read_text() == text
        assert [file.name for file in tmp_path.iterdir()] == ["rig.json"]


@pytest.mark.parametrize("at", [["summary"], ["summary", "cameras", 0], ["cameras", 0, "summary"]])
@pytest.mark.parametrize("damage", ["none", "text", "without a field", "with one more", "wrong type"])
def test_a_wrong_summary_counts_as_none(damage: str, at: list[str | int], rig: Rig, tmp_path: Path) -> None:
    content = rig_to_file(rig).dump()
    paths = (tmp_path / "good.json", tmp_path / "damaged.json")
    paths[0].write_text(json.dumps(content))
    block: Any = content
    for key in at[:-1]:
        block = block[key]
    known = block[at[-1]]
    field = "baseline_m" if at == ["summary"] else "sigma"
    block[at[-1]] = {
        "none": None,
        "text": "text",
        "without a field": {key: value for key, value in known.items() if key != "of"},
        "with one more": known | {"new": 1},
        "wrong type": known | {field: ["a"]},
    }[damage]
    paths[1].write_text(json.dumps(content))
    assert load_rig(paths[1]).fingerprint == rig.fingerprint
    shown = [ran("show", path).output.splitlines()[1:] for path in paths]
    assert shown[0] == shown[1]
    assert len(shown[0]) > 10


@pytest.mark.parametrize("kind", ["webcam", "wide"])
def test_round_trip_is_exact(tmp_path: Path, kind: str) -> None:
    before = hybrid_camera(kind)
    after = load_camera(save_camera(before, tmp_path / "camera.json", name="left"))
    assert type(after) is Camera
    assert torch.equal(after.params, before.params)
    assert (after.model, after.size, after.fingerprint) == (before.model, before.size, before.fingerprint)
    pixels = before.grid(5, 4).flatten(0, 1)
    assert torch.equal(after.unproject(pixels)[0], before.unproject(pixels)[0])
    save_camera(after, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == (tmp_path / "camera.json").read_text()


def test_stored_form() -> None:
    """Spelled out, because whoever reads these files elsewhere depends on it."""
    camera = hybrid_camera("pinhole", modes=FEW_MODES)
    stored = camera_to_file(camera).dump()
    assert stored["model"].pop("hybrid") == {
        "shape": 1.0,
        "radius": camera.model.hybrid.radius,
        "modes": {"radial": 5, "decentered": 4, "astigmatic": 3, "other": 3},
    }
    assert set(stored["model"].values()) == {0}
    assert tuple(stored["coefficients"]) == camera.model.names
    assert stored["coefficients"]["pupil1"] == 2e-3
    assert stored["coefficients"]["z5+1"] == float(camera.params[camera.names.index("z5+1")])
    # Files of other lenses do not mention it.
    assert "hybrid" not in camera_to_file(Camera.build(focal=(1, 1), center=(0, 0), size=(4, 3))).dump()["model"]


def test_covariance_and_rig(tmp_path: Path) -> None:
    camera = hybrid_camera("webcam", modes=FEW_MODES)
    factor = torch.randn(len(camera.names), 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    camera.calibration = CameraCalibration(covariance=factor @ factor.T)
    file = CameraFile.load(camera_to_file(camera).save(tmp_path / "camera.json"))
    again = file.covariance_matrix()
    assert again is not None
    assert torch.equal(again, factor @ factor.T)
    rig = Rig.pair(camera, hybrid_camera("wide", modes=FEW_MODES), torch.eye(3), torch.tensor([-0.5, 0.0, 0.0]))
    back = load_rig(save_rig(rig, tmp_path / "rig.json"))
    assert (back.left.fingerprint, back.right.fingerprint) == (rig.left.fingerprint, rig.right.fingerprint)


@pytest.mark.parametrize(
    ("path_in_file", "value", "message"),
    [
        (["model", "hybrid", "modes", "radial"], 7, "z7.1 is missing"),
        (["model", "hybrid", "modes", "other"], 2, "z3.3 is unknown"),
        (["model", "hybrid", "modes", "radial"], 99, "radial must be a whole number from 0 to 40"),
        (["model", "hybrid", "modes", "coma"], 3, "modes.coma.*Extra"),
        (["model", "hybrid", "radius"], 0.0, "radius of its disc must be positive"),
        (["model", "hybrid", "shape"], 99.0, "within ±10"),
        (["model", "hybrid", "kind"], "spline", "hybrid.kind.*Extra"),
        (["model", "tangential"], True, "terms of its own"),
        (["model", "hybrid"], None, "is unknown"),
        (["coefficients", "z9+9"], 0.0, r"z9.9 is unknown; the lens model needs exactly shape, pupil1"),
        (["coefficients", "z5+1"], float("nan"), "finite"),
    ],
)
def test_wrong_field(tmp_path: Path, path_in_file: list[str], value: Any, message: str) -> None:
    content = camera_to_file(hybrid_camera("webcam", modes=FEW_MODES)).dump()
    assert_refused(load_camera, tmp_path, content, path_in_file, value, message)


def test_a_long_list_of_names_is_cut(tmp_path: Path) -> None:
    content = camera_to_file(hybrid_camera("webcam")).dump()
    del content["coefficients"]["z33+1"]
    path = tmp_path / "short.json"
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=r"z33.1 is missing; .* needs exactly shape, .*, \.\.\., z") as error:
        load_camera(path)
    assert len(str(error.value)) < 400
