import json
import os
import re
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command_line import Command

from kcal import Camera, FileError, InputError, Rig, load_camera, load_rig, save_camera, save_rig
from kcal.corners.images import decode_image
from kcal.io.images import encode_png
from kcal.lens import StereoRectification, Undistort, rotation_from_vector
from kcal.lens.views import new_pinhole

CAMERA = Camera.build(focal=(60, 60), center=(31, 24), size=(64, 48), coefficients=[-0.2, 0.02, 1e-3, -1e-3])


def picture(kind: type, channels: int) -> np.ndarray:
    shape = (48, 64) if channels == 1 else (48, 64, channels)
    top = 255 if kind is np.uint8 else 65535
    return np.random.default_rng(0).integers(0, top, shape, dtype=kind, endpoint=True)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    save_camera(CAMERA, tmp_path / "left.camera.json")
    (tmp_path / "in").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "60")
    return tmp_path


@pytest.mark.parametrize(("kind", "channels"), [(np.uint8, 1), (np.uint8, 3), (np.uint16, 1), (np.uint16, 3)])
def test_depth_and_colors_are_kept(folder: Path, command: Command, kind: type, channels: int) -> None:
    image = picture(kind, channels)
    (folder / "in" / "a[1].png").write_bytes(encode_png(image))
    printed = command("rectify left.camera.json in -o new/out --alpha 1 --mask").out
    assert "1 of 1 images rectified, 64x48 px" in printed

    camera = load_camera(folder / "new/out/left_rectified.json")
    assert torch.equal(camera.params, new_pinhole(CAMERA, 1).params)
    stored = decode_image((folder / "new/out/a[1].png").read_bytes(), "a")
    assert stored.dtype == kind
    expected, mask = Undistort(CAMERA, camera)(torch.from_numpy(np.atleast_3d(image)).permute(2, 0, 1))
    assert np.array_equal(np.atleast_3d(stored), expected.permute(1, 2, 0).numpy())
    shown = decode_image((folder / "new/out/left_mask.png").read_bytes(), "mask")
    assert np.array_equal(shown, np.where(mask.numpy(), 255, 0))
    assert sorted(path.name for path in (folder / "new/out").iterdir()) == [
        "a[1].png", "left_mask.png", "left_rectified.json",
    ]  # fmt: skip


def test_a_bad_image_does_not_stop_the_others(folder: Path, command: Command) -> None:
    whole = cv2.imencode(".jpg", picture(np.uint8, 3))[1].tobytes()
    (folder / "in" / "1.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "in" / "2.jpg").write_bytes(whole)
    (folder / "in" / "3.png").write_bytes(encode_png(np.ascontiguousarray(picture(np.uint8, 1).T)))
    printed = command("rectify left.camera.json in -o out", code=1)
    assert "1 of 3 images rectified" in printed.out
    assert "100.0 % of pixels valid" in printed.out
    assert "in/3.png: the image is 48x64 px, the camera 64x48 px" in printed.err
    assert printed.err.splitlines()[-1].startswith("error: 2 of 3 images could not be resampled: in/1.jpg: ")
    assert sorted(path.name for path in (folder / "out").iterdir()) == ["2.png", "left_rectified.json"]


def test_nothing_usable_writes_nothing(folder: Path, command: Command) -> None:
    (folder / "in" / "1.png").write_bytes(b"no image")
    said = command("rectify left.camera.json in -o out", code=1).err
    assert "none of 1 images could be resampled: in/1.png: not an image" in said
    assert list((folder / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("left.camera.json in -o in", "in/a.png: an input image would be overwritten"),
        ("left.camera.json in b/a.jpg -o out", "both in/a.png and b/a.jpg would become this file"),
        ("nothing.json in -o out", "nothing.json: cannot read"),
        ("left.camera.json in -o left.camera.json", "cannot make this folder"),
        ("left.camera.json no -o out", "no: no such file or folder"),
    ],
)
def test_refused_before_anything_is_written(folder: Path, command: Command, arguments: str, message: str) -> None:
    (folder / "b").mkdir()
    for name in ("in/a.png", "b/a.jpg"):
        (folder / name).write_bytes(encode_png(picture(np.uint8, 1)))
    assert message in command.refuses("rectify", arguments)


def test_alpha_out_of_range(folder: Path, command: Command) -> None:
    command("rectify left.camera.json in -o out --alpha 1.5", code=2)


def test_new_camera_file_is_a_pinhole(folder: Path, command: Command) -> None:
    (folder / "in" / "a.png").write_bytes(encode_png(picture(np.uint8, 4)))
    command("rectify left.camera.json in -o out")
    content = json.loads((folder / "out" / "left_rectified.json").read_text())
    assert content["name"] == "left rectified"
    assert content["coefficients"] == {}


@pytest.mark.slow
def test_done_images_are_not_made_again(folder: Path, command: Command) -> None:
    """They are after a change of the image, of the view, or where the output is gone or another program's."""
    for name in "ab":
        (folder / "in" / f"{name}.png").write_bytes(encode_png(picture(np.uint8, 1)))
    arguments = "left.camera.json in -o out"

    def before(more: str = "") -> str:
        return command("rectify", arguments, more).out.splitlines()[0]

    assert "before" not in before()
    first = (folder / "out" / "a.png").read_bytes()
    assert "(2 of them before)" in before()
    (folder / "in" / "a.png").write_bytes(encode_png(255 - picture(np.uint8, 1)))
    assert "(1 of them before)" in before()
    assert (folder / "out" / "a.png").read_bytes() != first
    (folder / "out" / "b.png").unlink()
    assert "(1 of them before)" in before()
    (folder / "out" / "b.png").write_bytes(encode_png(picture(np.uint8, 1)))
    assert "(1 of them before)" in before()
    # By content, not by the time of the file.
    os.utime(folder / "in" / "a.png", (0, 0))
    assert "(2 of them before)" in before()
    assert "before" not in before("--alpha 1")
    assert "before" not in before()


def test_maps_are_those_of_the_image(folder: Path, command: Command) -> None:
    """By cv2.remap and by torch's grid_sample."""
    image = picture(np.uint8, 1)
    (folder / "in" / "a.png").write_bytes(encode_png(image))
    options = "--fov 40 --pan 8 --tilt -5 --size 50x40 --maps"
    command("rectify left.camera.json in -o out", options)
    made = decode_image((folder / "out" / "a.png").read_bytes(), "a").astype(float)
    map_x, map_y = np.load(folder / "out" / "left_map.npy")
    assert made.shape == map_x.shape == (40, 50)
    assert np.abs(cv2.remap(image.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR) - made).max() < 1.0
    grid = torch.from_numpy(np.load(folder / "out" / "left_grid.npy"))
    sampled = torch.nn.functional.grid_sample(torch.from_numpy(image)[None, None].float(), grid, align_corners=True)
    assert np.abs(sampled[0, 0].numpy() - made).max() <= 0.5 + 1e-3


def test_rig(folder: Path, command: Command) -> None:
    """Two folders of images, the rig of the new images, and a table of ranges."""
    other = Camera.build(focal=(62, 61), center=(33, 22), size=(64, 48), coefficients=[-0.1])
    save_rig(Rig.pair(CAMERA, other, torch.eye(3), torch.tensor([-0.5, 0.01, 0.0])), folder / "rig.json")
    for side in ("left", "right"):
        (folder / side).mkdir()
        (folder / side / "1.png").write_bytes(encode_png(picture(np.uint8, 3)))
    assert "a rig needs LEFT and RIGHT" in command("rectify rig.json left -o out", code=1).err
    printed = command("rectify rig.json left right -o out")
    assert "left: " in printed.out
    assert "disparity, px" in printed.out
    assert "the rig has no error bars" in printed.err
    new = load_rig(folder / "out" / "rectified.rig.json")
    assert torch.equal(new.right_from_left_rotation, torch.eye(3).double())
    assert abs(float(new.baseline) - 0.5001) < 1e-5
    assert np.load(folder / "out" / "Q.npy").shape == (4, 4)
    assert {path.name for path in (folder / "out" / "right").iterdir()} == {"1.png"}


@pytest.mark.parametrize(
    ("place", "line", "warned"),
    [
        ((-0.5, 0.0, 0.0), "disparity is the column in left/ minus the column in right/, and positive", ""),
        ((0.5, 0.0, 0.0), "and negative", "stands to the left of the left one, so that disparities are negative"),
        ((0.0, -0.5, 0.0), "disparity is the row in left/ minus the row in right/, and positive", "stands below"),
        ((0.0, 0.5, 0.0), "and negative", "stands above the left one"),
    ],
)
def test_sides_of_a_rig(
    folder: Path, monkeypatch: pytest.MonkeyPatch, command: Command, place: tuple[float, ...], line: str, warned: str
) -> None:
    """Maps without images; what a disparity is, is said; the rig that is written rectifies to itself."""
    monkeypatch.setenv("COLUMNS", "300")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        save_rig(Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor(place)), folder / "rig.json")
    assert "or --maps for the maps alone" in command("rectify rig.json", code=1).err
    printed = command("rectify rig.json --maps -o out")
    assert line in printed.out
    assert warned in printed.err
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        new = load_rig(folder / "out" / "rectified.rig.json")
    assert torch.allclose(new.right_from_left_translation, torch.tensor(place).double(), atol=1e-12)
    assert torch.allclose(StereoRectification(new).rotation, torch.eye(3).double(), atol=1e-12)
    assert np.allclose(np.load(folder / "out" / "Q.npy")[3, 2], 1.0 / -sum(place))


def test_rays(folder: Path, command: Command) -> None:
    assert "rays 1 x 48 x 64 x 6, float32" in command("rays left.camera.json -o rays.npz").out
    stored = np.load(folder / "rays.npz")
    assert stored["rays"].shape == (1, 48, 64, 6)
    assert stored["rays"].dtype == np.float32
    assert stored["mask"].all()
    assert np.allclose(stored["Ks"][0, :2, 2], [31.5, 24.5])


def test_rays_of_a_rig_are_in_the_frame_of_its_first_camera(folder: Path, command: Command) -> None:
    turns = torch.tensor([[0.1, 0.4, 0.0], [0.0, -0.3, 0.2], [0.0, 0.0, 0.5]], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = rotation_from_vector(turns), torch.arange(9.0).reshape(3, 3).double()
    save_rig(Rig([CAMERA] * 3, ["a", "b", "c"], poses[:, :3, :3], poses[:, :3, 3]), folder / "three.json")
    assert "rays 3 x 48 x 64 x 6, float32" in command("rays three.json -o rays.npz").out
    stored = np.load(folder / "rays.npz")
    assert np.allclose(stored["viewmats"], poses @ poses[0].inverse(), atol=1e-12)
    # Each starts in its camera, that of the first one at the origin.
    start = -(poses[0, :3, :3] @ poses[:, :3, :3].mT) @ poses[:, :3, 3, None] + poses[0, :3, 3, None]
    assert np.allclose(stored["rays"][:, 20, 30, :3], start[..., 0], atol=1e-5)


def test_image_files() -> None:
    """Channels are red, green, blue in memory, and in the file too: OpenCV reads blue, green, red."""
    red = np.zeros((2, 3, 3), np.uint8)
    red[..., 0] = 255
    read = cv2.imdecode(np.frombuffer(encode_png(red), np.uint8), cv2.IMREAD_COLOR)
    assert read is not None
    assert np.array_equal(read, red[..., ::-1])
    with pytest.raises(InputError, match=re.escape("got (2, 3, 2) of uint8")):
        encode_png(red[..., :2])
    with pytest.raises(InputError, match="float64"):
        encode_png(red[..., 0] / 255)  # type: ignore[arg-type]
    floats = cv2.imencode(".tiff", np.ones((4, 4), np.float32))[1].tobytes()
    with pytest.raises(FileError, match=r"x\.tif: pixels are float32"):
        decode_image(floats, "x.tif")
    with pytest.raises(FileError, match="the file is empty"):
        decode_image(b"", "x.png")
