"""Recordings for the viewer rerun, read back with its own reader."""

import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from locate_rigs import located_pairs, pinhole_rig, real_rig, spread_points, tensor
from PIL import Image
from scipy.spatial.transform import Rotation

from kcal import Board, Camera, InputError, Localizer, Observations, Origin, Rig, View, locate_points
from kcal.locate import Marks, enu_from_cam
from kcal.locate.positions import Located
from kcal.locate.survey import Survey
from kcal.report import log_view, save_view
from kcal.report.view import ellipsoids, field_border

rerun = pytest.importorskip("rerun")

ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)
FISHEYE = Camera.build(focal=(320, 320), center=(639.5, 479.5), size=(1280, 960), model="fisheye4")
WIDE = Camera.build(focal=(180, 180), center=(639.5, 479.5), size=(1280, 960), model="fisheye4")


def recorded(path: Path) -> dict[str, dict[str, list[tuple[Any, Any]]]]:
    """(time, value) of each component of each entity, in the order of time; None: at all times."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, list[tuple[Any, Any]]]] = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream():
        rows = chunk.to_record_batch()
        times = rows[chunk.timeline_names[0]].to_pylist() if chunk.timeline_names else [None] * rows.num_rows
        for name, column in zip(rows.schema.names, rows.columns, strict=True):
            if ":" in name:
                values = zip(times, column.to_pylist(), strict=True)
                found[chunk.entity_path][name].extend((time, value) for time, value in values if value is not None)
    for components in found.values():
        for rows in components.values():
            rows.sort(key=lambda row: (row[0] is not None, row[0]))
    return found


def only(rows: list[tuple[Any, Any]]) -> np.ndarray:
    """What holds at all times."""
    ((time, value),) = rows
    assert time is None
    return np.array(value)


def alone(camera: Camera) -> Rig:
    return Rig([camera], ["eye"], torch.eye(3)[None], torch.zeros(1, 3))


def targets(**options: Any) -> Located:
    left, right = real_rig()(spread_points(tensor(100.0, 900.0, 4000.0)))[0].unbind(-2)
    return located_pairs(real_rig(), left, right, names=["gate", "mast", "ship"], **options)


def standing() -> Localizer:
    return Localizer(real_rig().placed(origin=ORIGIN, heading_deg=35.0, pitch_deg=-2.0), pixel_sigma=0.1)


def test_border_rays_are_those_of_the_lens(tmp_path: Path) -> None:
    camera = real_rig().left
    data = recorded(save_view(tmp_path / "a.rrd", alone(camera), reach=50.0))
    border, *spokes = data["/cameras/eye/field\\ of\\ view"]["LineStrips3D:strips"][0][1]
    edge = [(x, y) for x, y in np.array([[0, 0], [0.5, 0], [1, 0], [1, 1], [0, 1], [0, 0.5]]) * (1920, 1080) - 0.5]
    rays, valid = camera.unproject(tensor(*edge))
    assert valid.all()
    drawn = np.array(border)[[0, 16, 32, 64, 96, 112]]
    assert np.abs(drawn - 50.0 * rays.numpy()).max() < 1e-5
    assert border[0] == border[-1]
    assert [spoke[0] for spoke in spokes] == [[0, 0, 0]] * 4
    assert [spoke[1] for spoke in spokes] == [border[i] for i in (0, 32, 64, 96)]
    # No pinhole's pyramid: through the middle of the upper edge it is elsewhere.
    plain = np.array([0.0, (-0.5 - camera.center[1]) / camera.focal[1], 1.0])
    assert np.abs(drawn[1] / drawn[1][2] - plain)[1] > 0.005


def test_a_fisheye_sees_behind_itself_and_its_image_ends_inside() -> None:
    """Equidistant, 320 px a radian: the left edge is at 2 rad; corners are beyond 2.5 rad."""
    rays, whole = field_border(FISHEYE)
    assert whole.all()
    left = rays[112]
    assert left.tolist() == pytest.approx([-math.sin(2.0), 0.0, math.cos(2.0)], abs=1e-9)
    assert left[2] < 0
    rays, whole = field_border(WIDE)
    # The image's edge would be at 3.56 rad from the axis: the lens ends at π, behind the camera, all around.
    assert not whole[112]
    assert whole[16]
    angles = torch.acos(rays[:, 2].clamp(-1, 1))
    assert torch.equal(angles[~whole] > 3.1, torch.ones_like(angles[~whole], dtype=torch.bool))
    assert WIDE.project(rays[~whole] * 7.0)[1].all()


def test_cameras_stand_where_they_are_and_frames_are_right_handed(tmp_path: Path) -> None:
    rig = real_rig()
    data = recorded(save_view(tmp_path / "a.rrd", standing()))
    # rerun's ViewDir: 1 is up, 2 down, 3 right, 5 forward.
    assert only(data["/"]["ViewCoordinates:xyz"]).tolist() == [[3, 5, 1]]
    look = enu_from_cam(35.0, -2.0, 0.0)
    for name, turn, center in zip(("left", "right"), rig.rotation, rig.center, strict=True):
        entity = data[f"/cameras/{name}"]
        assert only(entity["Transform3D:translation"])[0] == pytest.approx((look @ center).numpy(), abs=1e-6)
        rotation = Rotation.from_quat(only(entity["Transform3D:quaternion"])[0]).as_matrix()
        assert rotation == pytest.approx((look @ turn.T).numpy(), abs=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
    own = recorded(save_view(tmp_path / "b.rrd", rig))
    assert only(own["/"]["ViewCoordinates:xyz"]).tolist() == [[3, 2, 5]]
    assert only(own["/cameras/right"]["Transform3D:translation"])[0] == pytest.approx(rig.center[1].numpy(), abs=1e-6)


def test_ellipsoids_contain_95_percent() -> None:
    random = np.random.default_rng(1)
    root = random.normal(size=(4, 3, 3)) * [400.0, 3.0, 0.3]
    covariance = root @ root.transpose(0, 2, 1)
    half, turn = ellipsoids(covariance)
    axes = Rotation.from_quat(turn).as_matrix()
    # 7.8147 is the 95 % quantile of χ² of three degrees of freedom.
    assert axes * half[:, None] ** 2 @ axes.transpose(0, 2, 1) == pytest.approx(7.814727903 * covariance, rel=1e-8)
    noise = random.normal(size=(40_000, 3)) @ root[0].T
    inside = (((noise @ axes[0]) / half[0]) ** 2).sum(-1) < 1.0
    assert inside.mean() == pytest.approx(0.95, abs=0.005)


def test_positions_have_ellipsoids_intervals_and_labels(tmp_path: Path) -> None:
    located = targets(origin=ORIGIN, heading_deg=35.0, pitch_deg=-2.0, pixel_sigma=0.1)
    data = recorded(save_view(tmp_path / "a.rrd", standing(), located))
    enu = located.enu.numpy()
    shown = data["/targets/ellipsoids"]
    # float32 at 4 km.
    assert np.abs(only(shown["Ellipsoids3D:centers"]) - enu).max() < 5e-4
    half, turn = only(shown["Ellipsoids3D:half_sizes"]), only(shown["Ellipsoids3D:quaternions"])
    axes = Rotation.from_quat(turn).as_matrix()
    for i, position in enumerate(located.positions):
        spread = axes[i] * half[i] ** 2 @ axes[i].T
        assert spread == pytest.approx(7.814727903 * np.array(position.covariance), rel=1e-4, abs=1e-5 * half[i].max())
        assert np.linalg.det(axes[i]) == pytest.approx(1.0)
    assert half[2].max() / half[2].min() > 300
    # The longest axis is the line of sight.
    assert abs(axes[2][:, half[2].argmax()] @ enu[2]) / np.linalg.norm(enu[2]) > 0.9999
    for line, position in zip(only(data["/targets/intervals"]["LineStrips3D:strips"]), located.positions, strict=True):
        ends = np.linalg.norm(line, axis=-1)
        assert ends == pytest.approx([position.range_low_m, position.range_high_m], rel=1e-6)
    labels = only(data["/targets"]["Points3D:labels"]).tolist()
    assert [label.split(" ")[0] for label in labels] == ["gate", "mast", "ship"]
    low, high = (float(word) for word in labels[2].removesuffix(" m").split(" ", 1)[1].split(" – "))
    assert (low, high) == pytest.approx((located.positions[2].range_low_m, located.positions[2].range_high_m), rel=0.01)
    # As far as the farthest target.
    border = np.array(data["/cameras/left/field\\ of\\ view"]["LineStrips3D:strips"][0][1][0])
    away = np.linalg.norm(enu[2] - (standing().enu_from_rig @ real_rig().center.mean(0)).numpy())
    assert np.linalg.norm(border, axis=-1) == pytest.approx(away, rel=1e-6)


@pytest.mark.parametrize(
    ("times", "unit"),
    [
        (["1767225600.5", "1767225602", "1767225600.5"], "timestamp[ns]"),
        (["2026-01-01T00:00:00.5Z", "2026-01-01T01:00:02+01:00", "2026-01-01T00:00:00.5Z"], "timestamp[ns]"),
        (["0.5", "2", "0.5"], "duration[ns]"),
    ],
)
def test_times_are_those_of_the_table(
    times: list[str], unit: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from rerun.chunk import RrdReader

    points = spread_points(tensor(100.0, 900.0, 4000.0))
    marks = Marks(("a", "b", "c"), standing().rig(points)[0], extras={"time": times})
    path = save_view(tmp_path / "a.rrd", standing(), located := locate_points(standing(), marks))
    # Nor does rerun complain.
    assert capfd.readouterr().err == ""
    data = recorded(path)
    centers, labels = data["/targets/ellipsoids"]["Ellipsoids3D:centers"], data["/targets"]["Points3D:labels"]
    assert len(centers) == len(labels) == 2
    assert np.abs(np.array(centers[0][1]) - located.enu[[0, 2]].numpy()).max() < 5e-4
    assert [label[0] for label in labels[1][1]] == ["b"]
    chunk = next(c for c in RrdReader(path).stream() if c.entity_path == "/targets" and not c.is_static)
    column = chunk.to_record_batch()["time"]
    assert str(column.type) == unit
    start = 1_767_225_600 if unit.startswith("time") else 0
    assert column.cast("int64").to_pylist() == [(start * 10**9) + 500_000_000, (start + 2) * 10**9]
    assert only(data["/targets/at\\ all\\ times"]["Points3D:positions"]).shape == (3, 3)


def test_boards_stand_where_the_camera_saw_them(tmp_path: Path) -> None:
    board, camera = Board(columns=6, rows=5, square=0.04), real_rig().left
    turn, shift = enu_from_cam(20.0, 10.0, 5.0) @ enu_from_cam(0.0).T, tensor(-0.1, -0.05, 0.9)
    corners = board.points @ turn.T + shift
    pixels = camera.project(corners)[0]
    seen = tuple(None if i == 7 else (u, v) for i, (u, v) in enumerate(pixels.tolist()))
    image = np.full((1080, 1920), 90, np.uint8)
    image[:, 960:] = 200
    Image.fromarray(image).save(tmp_path / "one.png")
    views = (View(name="one.png", pixels=seen, image=str(tmp_path / "one.png")), View(name="two.png", pixels=seen))
    data = recorded(
        save_view(tmp_path / "a.rrd", alone(camera), Observations(board=board, image_size=(1920, 1080), views=views))
    )
    there = data["/cameras/eye/board/corners"]["Points3D:positions"]
    assert [time for time, _ in there] == [0, 1]
    assert np.abs(np.array(there[0][1]) - np.delete(corners.numpy(), 7, 0)).max() < 1e-5
    (outline,) = data["/cameras/eye/board"]["LineStrips3D:strips"][0][1]
    assert np.abs(np.array(outline) - corners[[0, 5, 29, 24, 0]].numpy()).max() < 1e-5
    assert data["/cameras/eye/board"]["LineStrips3D:labels"][0][1] == ["one.png: 0.000 px"]
    # The image lies on the rays of its pixels; the second view has none.
    mesh = data["/cameras/eye/image"]
    ((first, vertices),) = mesh["Mesh3D:vertex_positions"]
    (_, texture), (_, coordinates) = mesh["Mesh3D:albedo_texture_buffer"][0], mesh["Mesh3D:vertex_texcoords"][0]
    assert first == 0
    assert mesh["Clear:is_recursive"][-1][0] == 1
    pixels = np.array(coordinates) * (1920, 1080) - 0.5
    rays = camera.unproject(torch.from_numpy(pixels))[0].numpy()
    reach = np.linalg.norm(vertices[0])
    assert np.abs(np.array(vertices) - reach * rays).max() < 2e-5 * reach
    colors = np.array(texture, np.uint8).reshape(540, 960, 3)
    assert colors[0, 0].tolist() == [90] * 3
    assert colors[-1, -1].tolist() == [200] * 3


def test_the_view_begins_outside_of_what_is_drawn(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    reader = RrdReader(save_view(tmp_path / "a.rrd", alone(WIDE), reach=9.0))
    (blueprint,) = reader.blueprints()
    parts = [part.to_record_batch() for part in reader.stream(store=blueprint)]
    (eye,) = (
        part["EyeControls3D:position"].to_pylist()[0][0]
        for part in parts
        if "EyeControls3D:position" in part.schema.names
    )
    assert np.linalg.norm(eye) > 9.0
    # From above, y being down, and from behind.
    assert eye[1] < 0
    assert eye[2] < 0


def test_what_has_no_ray_carries_no_image(tmp_path: Path) -> None:
    mesh = recorded(save_view(tmp_path / "a.rrd", alone(WIDE), np.zeros((960, 1280), np.uint8)))["/cameras/eye/image"]
    cells = only(mesh["Mesh3D:triangle_indices"])
    pixels = only(mesh["Mesh3D:vertex_texcoords"]) * (1280, 960) - 0.5
    assert 0 < len(cells) < 2 * 32 * 32
    assert WIDE.unproject(torch.from_numpy(pixels[np.unique(cells)]))[1].all()


def test_stations_and_landmarks_far_apart(tmp_path: Path) -> None:
    look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 315.0, 45.0)])
    places = tensor([0.0, 0, 30], [5000.0, 0, 40], [-5000.0, 0, 35])
    rig = Rig([real_rig().left] * 3, ["mill/1", "church", "mast"], look, center=places, origin=ORIGIN)
    survey = Survey(("spire",), tensor([100.0, 3000.0, 50.0]), tensor([0.1, 0.1, 0.1]), ORIGIN)
    data = recorded(save_view(tmp_path / "a.rrd", rig, survey))
    assert only(data["/cameras/church"]["Transform3D:translation"])[0] == pytest.approx(places[1].numpy())
    assert "/cameras/mill\\/1" in data
    assert only(data["/landmarks"]["Points3D:positions"]).tolist() == [[100.0, 3000.0, 50.0]]
    # A frame whose zero is far away, such as the Earth's center: coordinates keep their millimeters.
    there = tensor(4_000_123.25, 3_000_045.5, 3_999_987.125)
    far = Rig([real_rig().left] * 3, ["a", "b", "c"], look, center=places + there)
    data = recorded(save_view(tmp_path / "b.rrd", far, reach=10.0))
    assert only(data["/cameras/b"]["Transform3D:translation"])[0].tolist() == [5123.25, 45.5, 27.125]


def test_a_recording_of_ones_own(tmp_path: Path) -> None:
    recording = rerun.RecordingStream("mine")
    log_view(recording, real_rig(), targets())
    recording.save(tmp_path / "mine.rrd")
    recording.flush()
    log_view(recording, real_rig(), targets())
    recording.disconnect()
    assert {"/cameras/left", "/targets/ellipsoids"} <= recorded(tmp_path / "mine.rrd").keys()


def test_refusals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, path = real_rig(), tmp_path / "a.rrd"
    with pytest.raises(InputError, match=r"ends in \.rrd; write .*a\.rrd"):
        save_view(tmp_path / "a.html", rig)
    with pytest.raises(InputError, match="positions of another place"):
        save_view(path, rig, targets(origin=ORIGIN, heading_deg=35.0))
    with pytest.raises(InputError, match="landmarks of another place"):
        save_view(path, rig, Survey(("a",), tensor([0.0, 0, 0]), tensor([1.0, 1, 1]), ORIGIN))
    image = np.zeros((1080, 1920, 3), np.uint8)
    with pytest.raises(InputError, match="1 images: one for each camera is needed, in order: left, right"):
        save_view(path, rig, image)
    with pytest.raises(InputError, match=r"camera right has 1920x1080 px, its image 960x540"):
        save_view(path, rig, image, image[::2, ::2])
    seen = Observations(board=Board(columns=2, rows=2, square=0.1), image_size=(64, 48), views=())
    with pytest.raises(InputError, match=r"camera eye has \(1920, 1080\) px, its observations \(64, 48\)"):
        save_view(path, alone(rig.left), seen)
    parallel = pinhole_rig()
    marks = Marks(("sky",), tensor([[960.0, 540.0], [960.0, 540.0]]))
    with pytest.raises(InputError, match="none of the 1 points has a position"):
        save_view(path, parallel, locate_points(parallel, marks))
    late = Marks(("a",), rig(tensor([0.0, 0.0, 500.0]))[0], extras={"time": ["2026-01-01T00:00:00"]})
    with pytest.raises(InputError, match="a: time '2026-01-01T00:00:00': seconds, or ISO with a zone"):
        save_view(path, rig, locate_points(rig, late))
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install 'kcal\[view\]'"):
        save_view(path, rig)
    assert not path.exists()
