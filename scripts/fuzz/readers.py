"""Readers of kcal's own files, of other programs', tables, images and lines, with a whole file of each."""

from __future__ import annotations

import base64
import contextlib
import importlib
import importlib.util
import io
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.io import savemat

from kcal import (
    Camera,
    InputError,
    Observations,
    Origin,
    Rig,
    load_camera,
    load_rig,
    locate_points,
    save_camera,
    save_rig,
)
from kcal.calibrate import load_measured_board, save_measured_board
from kcal.calibrate.batch.jobs import read_jobs
from kcal.calibrate.rig.pairs import read_pairs
from kcal.cli.options import read_settings, toml_text
from kcal.corners.board import Board, target_fields
from kcal.corners.foreign_corners import import_corners
from kcal.corners.images import read_gray, turned_images
from kcal.corners.video import VideoFrames, read_frames
from kcal.file_kind import file_kind
from kcal.files import read_bytes
from kcal.io.foreign import ImportedCameras
from kcal.io.format_prior import prior_of, write_priors
from kcal.io.formats import FORMATS, import_cameras
from kcal.lens import CameraCalibration, bake, export_cameras, load_lookup, save_lookup
from kcal.locate import terrain, write_positions
from kcal.locate.marks import COVARIANCE, Marks, read_marks, write_marks
from kcal.locate.survey import import_survey, read_features, read_survey
from kcal.mark.session import Journal
from kcal.pipeline.grouping import read_moment
from kcal.pipeline.stream import Ledger
from kcal.report.map_page import local_image
from kcal.report.practice_score import located_rows
from kcal.rig import Mounting
from kcal.stars.detect import read_night
from kcal.track import AssociationOptions, Detections
from scripts.check.device_files import files
from scripts.fuzz.reader import PROMISED, Reader, whole_text
from scripts.shared.captures import as_observations

BOARD = Board(columns=3, rows=2, square=0.1)
CAMERA = Camera.build(focal=(300, 301), center=(159.5, 119.5), size=(320, 240), coefficients=[-0.1, 0.02, 0, 0, 0])


def board_points() -> np.ndarray:
    """(2, 6, 2) px of two views of the board."""
    grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(2.0)), -1).reshape(-1, 2)
    return np.stack([40.0 + 30.0 * grid + shift for shift in (0.0, 5.0)])


def _opencv_corners(path: Path) -> None:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 320)
    file.write("image_height", 240)
    file.write("image_points", board_points().astype(np.float32))
    file.release()


def _kept(found: ImportedCameras) -> Any:
    """Sizes and parameters that are not zero: a file may say a richer model, whose further terms are."""
    return [
        (camera.size, {name: value for name, value in zip(camera.names, camera.params.tolist(), strict=True) if value})
        for camera in found.cameras
    ]


def _foreign(name: str, suffix: str) -> Reader:
    known = FORMATS[name]

    def save(found: ImportedCameras, path: Path) -> None:
        first = found.cameras[0]
        if len(found.cameras) > 1 or str(first.model) not in known.models:
            raise InputError("several cameras, or a lens that is only read")
        export_cameras(first, path, format=name, model=str(first.model))

    return Reader(
        lambda path: import_cameras(path, format=name), suffix,
        lambda path: known.write and known.write([CAMERA if "opencv5" in known.models else _four()], [], path),
        save, 1e-9, kept=_kept,
    )  # fmt: skip


def _four() -> Camera:
    return Camera.build(focal=(300, 301), center=(159.5, 119.5), size=(320, 240), model="opencv4")


def _prior(path: Path) -> None:
    camera = Camera.build(focal=(300, 301), center=(159.5, 119.5), size=(320, 240), coefficients=[-0.1, 0.02])
    camera.calibration = CameraCalibration(covariance=1e-4 * torch.eye(10, dtype=torch.float64))
    write_priors("ceres", [prior_of("ceres", camera)], path)


_OMNI = ("cam0: {camera_model: omni, distortion_model: radtan, intrinsics: [0.9, 300, 301, 159.5, 119.5], "
         "distortion_coeffs: [-0.1, 0.02, 0, 0], resolution: [320, 240]}\n")  # fmt: skip
_RESULTS = """cam0 (/cam0/image_raw):
     type: <class 'aslam_cv.libaslam_cv_python.DistortedPinholeCameraGeometry'>
     distortion: [-0.1 0.02 0.0 0.0] +- [0.003 0.002 0.0001 0.0001]
     projection: [300 301 159.5 119.5] +- [0.21 0.2 0.3 0.25]
"""
_QUALISYS = """<calibration><cameras><camera serial="1"><fov_video left="0" top="0" right="319" bottom="239"/>
<transform x="0" y="0" z="0" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/>
<intrinsic focalLengthU="19200" focalLengthV="19264" centerPointU="10240" centerPointV="7680" skew="0"
 radialDistortion1="-0.1" radialDistortion2="0.02" radialDistortion3="0" tangentalDistortion1="0"
 tangentalDistortion2="0"/></camera></cameras></calibration>"""
_AGISOFT = """<document><chunk><sensors><sensor id="0"><calibration type="frame" class="adjusted">
<resolution width="320" height="240"/><f>300</f><k1>-0.1</k1></calibration>
<covariance><params>f k1</params><coeffs>4 0 0 1e-6</coeffs></covariance></sensor></sensors></chunk></document>"""


def _packed_inputs() -> bytes:
    turned = np.array([[0.3, 0.1 * k, 0.0, 0.1 * k - 0.2, 0.0, 1.0] for k in range(5)])
    grid = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0), np.ones(1)), -1).reshape(1, 6, 7, 3)
    index = np.array([[k, 0, -1] for k in range(5)])
    data = io.BytesIO()
    np.savez(data, intrinsics=[[300.0, 301, 159.5, 119.5]], frames_rt_toref=turned, calibration_object_spacing=0.05,
             observations_board=grid.repeat(5, 0), indices_frame_camintrinsics_camextrinsics=index)  # fmt: skip
    return data.getvalue()


def _with_inputs(path: Path, packed: bytes) -> None:
    content = {"lensmodel": "LENSMODEL_PINHOLE", "intrinsics": [300.0, 301.0, 159.5, 119.5], "extrinsics": [0.0] * 6,
               "imagersize": [320, 240], "optimization_inputs": base64.b85encode(packed)}  # fmt: skip
    path.write_text(repr(content))


def _unpacked(path: Path) -> object:
    """Damage below the base 85, which damage of the text hardly ever reaches."""
    model = path.with_suffix(".cameramodel")
    _with_inputs(model, read_bytes(path, 2**26))
    return import_cameras(model)


def _corners(path: Path) -> Observations:
    return import_corners(path, BOARD, (320, 240))


_FOREIGN: dict[str, Reader] = {
    **{f"{name} {suffix}": _foreign(name, suffix) for name, suffix in (
        ("opencv", ".yml"), ("opencv", ".xml"), ("opencv", ".json"), ("ros", ".yaml"), ("kalibr", ".yaml"),
        ("mrcal", ".cameramodel"), ("colmap", ".txt"), ("colmap", ".bin"), ("nerfstudio", ".json"), ("matlab", ".mat"),
        ("opensfm", ".json"), ("toml", ".toml"), ("gtsam", ".json"))},
    "mrcal inputs": Reader(import_cameras, ".cameramodel", lambda path: _with_inputs(path, _packed_inputs())),
    "packed inputs": Reader(_unpacked, ".npz", lambda path: path.write_bytes(_packed_inputs())),
    "prior .json": Reader(import_cameras, ".json", _prior),
    "prior .npz": Reader(import_cameras, ".npz", _prior),
    "omni": Reader(import_cameras, ".yaml", whole_text(_OMNI)),
    "Kalibr's results": Reader(lambda path: import_cameras(path, size=(320, 240)), ".txt", whole_text(_RESULTS)),
    "qualisys": Reader(lambda path: import_cameras(path, format="qualisys"), ".txt", whole_text(_QUALISYS)),
    "agisoft": Reader(lambda path: import_cameras(path, format="agisoft"), ".xml", whole_text(_AGISOFT)),
    **{program: Reader(lambda path: import_cameras(path, size=(1280, 720)), Path(name).suffix,
                       whole_text(content if isinstance(content, str) else json.dumps(content)))
       for program, _, _, name, content, _ in files() if program in ("Azure Kinect", "ZED", "KITTI")},
    "any camera": Reader(import_cameras, ".yml",
                         lambda path: export_cameras(CAMERA, path, format="opencv", model="opencv5")),
    "target": Reader(target_fields, ".yaml", whole_text(
        "target_type: aprilgrid\ntagCols: 6\ntagRows: 4\ntagSize: 0.08\ntagSpacing: 0.25\n")),
    "corners .vnl": Reader(_corners, ".vnl", whole_text(
        "# filename x y level\n" + "".join(f"a.png {u} {v} 0\n" for u, v in board_points()[0].tolist()))),
    "corners .csv": Reader(_corners, ".csv", whole_text(
        "image,u,v\n" + "".join(f"a.png,{u},{v}\n" for u, v in board_points()[0].tolist()))),
    "corners .yml": Reader(_corners, ".yml", _opencv_corners),
    "corners .xml": Reader(_corners, ".xml", _opencv_corners),
    "corners .mat": Reader(_corners, ".mat", lambda path: savemat(
        path, {"imagePoints": np.moveaxis(board_points(), 0, -1), "imageSize": [[240.0, 320.0]]}, do_compression=True)),
}  # fmt: skip


RIG = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))


def _observations(path: Path) -> None:
    as_observations(torch.from_numpy(board_points()), (320, 240), BOARD, names=["0.png", "1.png"]).save(path)


def _video(path: Path) -> None:
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for k in range(3):
        video.write(np.full((48, 64, 3), 40 * k, np.uint8))
    video.release()


def _raster(path: Path) -> None:
    rasterio = importlib.import_module("rasterio")
    with warnings.catch_warnings(action="ignore"), rasterio.open(
        path, "w", driver="GTiff", width=8, height=8, count=1, dtype="float32", crs="EPSG:4326",
        transform=rasterio.transform.from_origin(20.0, 10.0, 0.01, 0.01),
    ) as raster:  # fmt: skip
        raster.write(np.ones((1, 8, 8), np.float32))


def placed_rig() -> Rig:
    """A rig that says where it stands."""
    rig = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
    rig.mounting = Mounting(origin=Origin(lat=10.0, lon=20.0, height=3.0), heading_deg=30.0)
    return rig


def _promised(name: str) -> Callable[[Path], object]:
    return lambda path: path.write_bytes((PROMISED / name).read_bytes())


def _settings(path: Path) -> Any:
    own = path.parent / "settings" / "kcal.toml"
    own.parent.mkdir(exist_ok=True)
    own.write_bytes(read_bytes(path))
    return read_settings(own.parent)


def _journal(path: Path) -> Any:
    # It is repaired in place, which a later case must not see.
    own = path.with_suffix(".own")
    own.write_bytes(read_bytes(path))
    with contextlib.closing(Journal(own)) as journal:
        return journal.state


def _live_journal(path: Path) -> Any:
    output = path.with_name("out.csv")
    output.write_bytes(b"x" * 100)
    read_bytes(path)  # a journal that is missing is begun
    with contextlib.closing(Ledger(path, [output])) as ledger:
        return ledger.place, ledger.checkpoint_at, ledger.state


def _whole_journal(path: Path) -> None:
    output = path.with_name("out.csv")
    ledger = Ledger(path, [output])
    ledger.checkpoint({"tracks": [1, 2.5]})
    ledger.append([b"abc"], 1.5, 10)
    ledger.append([b"def"], 2.5, 20)
    ledger.close()


def _positions(path: Path) -> None:
    pixels = RIG(torch.tensor([[0.0, 0.0, 50.0], [5.0, 1.0, 100.0]], dtype=torch.float64))[0]
    write_positions(path, locate_points(placed_rig(), Marks(("a", "b"), pixels)))


def _fits(path: Path) -> None:
    fits = importlib.import_module("astropy.io.fits")
    fits.writeto(path, overwrite=True, data=np.arange(48, dtype=np.float32).reshape(6, 8))


# Of parameters of which nothing was known before the calibration.
_PRIOR = ("information.sigma",)
_MARK = {"u": 10.5, "v": 20.0, "cov": [0.01, 0.0, 0.01], "frame": "1"}
ACTIONS = [
    {"key": "key-number-1", "action": {"do": "add", "name": "mast", "kind": "target"}},
    {"key": "key-number-2", "action": {"do": "put", "name": "mast", "side": "left", "mark": _MARK}},
    {"key": "key-number-3", "action": {"do": "put", "name": "mast", "side": "right", "mark": _MARK, "matched": True}},
    {"key": "key-number-4", "action": {"do": "undo"}},
    {"key": "key-number-5", "action": {"do": "rename", "name": "mast", "to": "mill", "kind": "landmark"}},
    {"key": "key-number-6", "action": {"do": "survey", "name": "hill", "place": {"at": [1, 2, 3], "sigma": 0.1}}},
]
_BOXES = {"time": 2.5, "size": [320, 240], "boxes": [[10, 10, 20, 20], [50, 60, 70, 80.5]], "scores": [0.9, 0.5],
          "categories": ["ship", "car"], "tracks": ["7", None]}  # fmt: skip
_PAIRS_LINE = json.dumps({"time": [1.5, 1.6], "left": [[40, 50]], "right": [[30, 50]], "sigma": 0.2,
                          "covariance": [np.eye(4).tolist()], "categories": ["car"], "scores": [0.5],
                          "ambiguous": [False]})  # fmt: skip
_TRUTH = {"origin": {"lat": 10.0, "lon": 20.0, "height": 3.0}}
_ROWS = "0,40,50,30,50\n1,60,70,50,70\n"
_PLACES = [(f"p{k}", 20.0 + 0.1 * k, 10.0, 3.0) for k in range(3)]
READERS: dict[str, Reader] = {
    **_FOREIGN,
    "camera": Reader(load_camera, ".json", lambda path: save_camera(CAMERA, path), save_camera,
                     infinite=_PRIOR, more="*/*.camera.json"),
    "rig": Reader(load_rig, ".json", lambda path: save_rig(placed_rig(), path), save_rig,
                  infinite=_PRIOR, more="*/rig.json"),
    "camera rig": Reader(load_rig, ".json", _promised("1.0/camera-rig.json"), save_rig, infinite=_PRIOR),
    "board": Reader(load_measured_board, ".json", _promised("1.0/board.json"), save_measured_board),
    "lookup": Reader(load_lookup, ".npz", lambda path: save_lookup(bake(CAMERA, 0.1), path), save_lookup),
    "observations": Reader(Observations.load, ".json", _observations, lambda found, path: found.save(path),
                           more="*/observations.json"),
    "settings": Reader(_settings, ".toml", whole_text('board = "9x6"\npixel_sigma = 0.2\nbaseline = 10\n'), named=False,
                       save=lambda found, path: path.write_text(toml_text(found)),
                       kept=lambda found: sorted(found.items())),
    "pairs": Reader(lambda path: read_pairs(path, ["a1", "a2"], ["b1", "b2"]), ".csv",
                    whole_text("left,right\na1,b1\na2,b2\n")),
    "jobs": Reader(lambda path: read_jobs(path, BOARD, "hybrid"), ".csv", whole_text(
        "camera,images,board,square,model\na,good.csv,9x6,25mm,hybrid\nb,*.csv,charuco:9x6,2cm,opencv5\n")),
    "marking log": Reader(_journal, ".jsonl", whole_text("".join(
        json.dumps(line) + "\n" for line in ({"kcal": "marking log", "version": 1}, *ACTIONS)))),
    "live journal": Reader(_live_journal, ".journal", _whole_journal),
    "live line": Reader(lambda path: read_moment(read_bytes(path), RIG, AssociationOptions(), 0.3), ".json",
                        whole_text(_PAIRS_LINE), named=False),
    "live boxes": Reader(lambda path: read_moment(read_bytes(path), RIG, AssociationOptions(), 0.3), ".json",
                         whole_text(json.dumps({"left": _BOXES, "right": _BOXES})), named=False),
    "detections": Reader(lambda path: Detections.read(read_bytes(path)), ".json",
                         whole_text(json.dumps({**_BOXES, "keypoints": [[[1, 2]], [[3, 4]]]})), named=False,
                         infinite=("keypoints",), unknown=("keypoints",)),
    "positions .csv": Reader(lambda path: located_rows(path, _TRUTH), ".csv", _positions, infinite=("range_high_m",)),
    "positions .geojson": Reader(lambda path: located_rows(path, _TRUTH), ".geojson", _positions,
                                 infinite=("range_high_m",)),
    "file kind": Reader(file_kind, ".json", lambda path: save_camera(CAMERA, path), named=False),
    "image .png": Reader(read_gray, ".png", lambda path: cv2.imwrite(str(path), np.eye(40, dtype=np.uint8) * 200)),
    "image .jpg": Reader(lambda path: (turned_images([path]), read_gray(path)), ".jpg",
                         lambda path: cv2.imwrite(str(path), np.eye(40, dtype=np.uint8) * 200)),
    "video": Reader(lambda path: (list(read_frames(path)), VideoFrames(path).count), ".avi", _video),
    "FITS": Reader(read_night, ".fits", _fits),
    "map picture": Reader(local_image, ".tif", _raster),
    "terrain": Reader(terrain, ".tif", _raster, unknown=("heights",)),
    "survey .csv": Reader(read_survey, ".csv", whole_text(
        "name,lat,lon,height,sigma\n" + "".join(f"{n},{b},{a},{h},0.1\n" for n, a, b, h in _PLACES))),
    "survey .geojson": Reader(lambda path: import_survey(path, Origin(lat=10.0, lon=20.0, height=0.0)), ".geojson",
                              whole_text(json.dumps({"type": "FeatureCollection", "features": [
                                  {"type": "Feature", "properties": {"name": n, "sigma": 0.1},
                                   "geometry": {"type": "Point", "coordinates": at}} for n, *at in _PLACES]}))),
    "survey .gpx": Reader(lambda path: import_survey(path, sigma=0.1, geoid=0.0), ".gpx", whole_text(
        "<gpx>" + "".join(f'<wpt lat="{b}" lon="{a}"><ele>{h}</ele><name>{n}</name></wpt>' for n, a, b, h in _PLACES)
        + "</gpx>")),
    "marks": Reader(read_marks, ".csv", whole_text(
        f"name,left_u,left_v,right_u,right_v,{','.join(COVARIANCE)}\n"
        "a,40,50,30,50,0.1,0,0,0,0.1,0,0,0.1,0,0.1\nb,60,70,50,70,,,,,,,,,,\n"),
        lambda found, path: write_marks(path, found), unknown=("covariance",),
        # Control characters in names are written in words.
        kept=lambda found: (len(found.names), found.left, found.right, found.covariance)),
    "view marks": Reader(lambda path: read_marks(path, ["a", "b"]), ".csv", whole_text(
        "name,camera,u,v,time,sigma\np,a,1,2,0.5,0.1\np,b,3,4,0.5,\nq,b,5,6,1.5,0.3\n"), unknown=("pixels", "sigma")),
    "features": Reader(lambda path: read_features(path, 0.3), ".csv", infinite=("inverse_range_sigma",),
                       write=whole_text(
        "name,left_u,left_v,right_u,right_v\n" + _ROWS)),
}  # fmt: skip
_NEEDED = {"terrain": "rasterio", "map picture": "rasterio", "FITS": "astropy"}


def missing(name: str) -> str:
    """The package that a reader needs and that is not installed, or ""."""
    package = _NEEDED.get(name, "kcal")
    return "" if importlib.util.find_spec(package) else package
