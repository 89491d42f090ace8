"""A scene in 3-D for the viewer rerun: cameras with the field of view of their lenses, images, boards and positions."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from kcal.calibrate.rig.pairs import pose_alone
from kcal.checks import chi2_quantile
from kcal.corners.images import decode_image, to_8bit
from kcal.corners.observations import Observations
from kcal.errors import FileError, InputError, with_extra
from kcal.files import read_bytes, write_atomic
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose
from kcal.lens.rig import Rig
from kcal.locate.localizer import Localizer
from kcal.locate.points import camera_poses
from kcal.locate.positions import Located
from kcal.locate.survey import Survey
from kcal.locate.tables import NUMBERS
from kcal.report.tables import interval_text, range_unit
from kcal.solve.lm import LMOptions
from kcal.texts import unix_seconds

Shown = Located | Survey | Observations | NDArray[np.uint8]

# The field of view: points along each side of the image, and halvings on the way to where the lens ends.
_SIDE, _HALVINGS = 32, 12
# Cells of the mesh that carries an image, along each side; and the most pixels of its texture's longer side.
_CELLS, _TEXTURE = 32, 1024
# The viewer has float32: the scene's zero is moved by whole multiples of this, meters, so that a digit is below 4 mm.
_FAR = 1e5
# Numbers from here on are Unix seconds; below they count from the beginning of a video.
_UNIX = 1e8
# 95 % of a Gaussian in three dimensions: its ellipsoid is so many sigma wide.
_REACH = float(chi2_quantile(3, 0.95)) ** 0.5
_CAMERAS = ((86, 156, 255), (255, 120, 100), (120, 220, 140), (230, 170, 255))
_TARGETS, _LANDMARKS, _FAINT = (255, 190, 40), (90, 230, 120), (130, 130, 130)


def field_border(camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays along the border of what a camera sees: through the image's edge, or where its lens ends inside the image.

    Returns:
        (128, 3) of length one, clockwise from the image's upper left corner, every 32nd toward a corner; and whether
        each goes through the image's edge.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        >>> rays, whole = field_border(camera)
        >>> (rays[0] / rays[0, 2]).round(decimals=4).tolist(), bool(whole.all())
        ([-0.6, -0.3375, 1.0], True)
    """
    width, height = camera.size
    share = torch.linspace(0, 1, _SIDE + 1, dtype=torch.float64)[:-1]
    one, zero = torch.ones_like(share), torch.zeros_like(share)
    sides = [(share, zero), (one, share), (1 - share, one), (zero, 1 - share)]
    size, middle = torch.tensor([width, height]).double(), torch.tensor([width - 1, height - 1]).double() / 2
    edge = torch.cat([torch.stack(side, -1) for side in sides]) * size - 0.5
    rays, whole = _rays(camera, edge)
    reach = whole.double()
    for step in 0.5 ** torch.arange(1, _HALVINGS + 1) if not bool(whole.all()) else ():
        further = torch.where(whole, reach, reach + step)
        tried, valid = _rays(camera, middle + further[:, None] * (edge - middle))
        reach, rays = torch.where(valid, further, reach), torch.where(valid[:, None], tried, rays)
    return rays, whole


def _rays(camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        rays, valid = camera.unproject(pixels.to(camera.params.device))
    return rays.cpu(), valid.cpu()


def ellipsoids(covariance: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Half sizes (N, 3) and turns (N, 4), as quaternions x, y, z, w, of 95 % ellipsoids of covariances (N, 3, 3)."""
    values, axes = np.linalg.eigh(covariance)
    # A reflection is no turn: any axis may point the other way.
    axes[..., 0] *= np.sign(np.linalg.det(axes))[..., None]
    return _REACH * np.sqrt(values.clip(0)), Rotation.from_matrix(axes).as_quat() if len(axes) else np.zeros((0, 4))


def save_view(path: str | Path, rig: Rig | Localizer, *shown: Shown, reach: float | None = None) -> Path:
    """Write a scene as a recording, `.rrd`, that the viewer rerun opens.

    Args:
        path: of the file.
        rig: see `log_view`.
        shown: likewise.
        reach: likewise.

    Raises:
        InputError: as `log_view`, or another suffix.

    Example:
        >>> from kcal import load_rig
        >>> save_view("rig.rrd", load_rig("assets/sample-rig.json"))  # doctest: +SKIP
    """
    if Path(path).suffix != ".rrd":
        raise InputError(f"{path}: a recording of rerun ends in .rrd; write {Path(path).with_suffix('.rrd')}")
    with with_extra("view", "the viewer needs"):
        import rerun as rr
    recording = rr.RecordingStream("kcal", recording_id=Path(path).stem, send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    scene = _logged(rr, recording, rig, shown, reach)
    recording.send_blueprint(scene.blueprint())
    return write_atomic(path, rr.binary_stream(recording).read() or b"")


def log_view(recording: Any, rig: Rig | Localizer, *shown: Shown, reach: float | None = None) -> None:
    """Log a rig and what it saw to a recording of rerun; a connected viewer shows it at once.

    The scene is east, north, up of the origin of a rig that has a place on the Earth, and the rig's own frame otherwise
    (x right, y down, z forward of the first of two cameras), in meters. Each camera is an entity with its pose, and in
    its frame the edges of its image as rays of its lens, on a sphere: also beyond 180°.

    Args:
        recording: a `rerun.RecordingStream`.
        rig: or a `Localizer`, for another place.
        shown: any of `Located`, with 95 % ellipsoids of three dimensions and the intervals of the ranges, over time if
            its rows have a column `time`; landmarks as a `Survey`; and for each camera in turn `Observations`, whose
            boards, and images that are still there, are shown view by view, or an image (H, W) or (H, W, 3), uint8.
            Images lie on the rays of their pixels.
        reach: radius of that sphere, meters; if not given, as far as the farthest thing that is shown.

    Raises:
        InputError: positions of another place, observations or images for more cameras than there are, or of another
            size, a time that cannot be read, or rerun is not installed.

    Example:
        >>> import rerun  # doctest: +SKIP
        >>> log_view(rerun.RecordingStream("masts"), load_rig("assets/sample-rig.json"))  # doctest: +SKIP
    """
    with with_extra("view", "the viewer needs"):
        import rerun as rr
    _logged(rr, recording, rig, shown, reach)


def _logged(rr: Any, recording: Any, rig: Rig | Localizer, shown: Sequence[Shown], reach: float | None) -> _Recorded:
    scene = _Recorded(rr, recording, rig if isinstance(rig, Localizer) else Localizer(rig))
    seen = [one for one in shown if isinstance(one, Observations)]
    images = [one for one in shown if isinstance(one, np.ndarray)]
    for what, given in (("observations", seen), ("images", images)):
        if given and len(given) != len(scene.names):
            raise InputError(f"{len(given)} {what}: one for each camera is needed, in order: {', '.join(scene.names)}")
    for one in shown:
        if isinstance(one, Located):
            scene.add_positions(one)
        elif isinstance(one, Survey):
            scene.add_landmarks(one)
    boards = [scene.boards(camera, one) for camera, one in enumerate(seen)]
    scene.reach = scene.extent() if reach is None else reach
    for camera in range(len(scene.names)):
        scene.add_camera(camera, images[camera] if images else None)
    scene.add_views(seen, boards)
    return scene


class _Recorded:
    """Where things go in a recording, and how far they reach."""

    def __init__(self, rr: Any, recording: Any, localize: Localizer) -> None:
        self.rr, self.recording, self.localize = rr, recording, localize
        self.names, self.cameras = localize.rig.names, localize.rig.each
        with torch.no_grad():
            center, turn = camera_poses(localize)
        self.zero = ((center.mean(0) / _FAR).round() * _FAR).numpy()
        self.center, self.turn = center.numpy() - self.zero, turn.numpy()
        # Radius of the spheres, and what is drawn on them; what is shown; and how far boards are from their cameras.
        self.reach, self.drawn, self.places, self.away = 1.0, [self.center], np.zeros((0, 3)), [0.0]
        self.level = localize.on_earth or not localize.rig.in_first_frame
        recording.log("/", rr.ViewCoordinates.RFU if self.level else rr.ViewCoordinates.RDF, static=True)

    def put(self, path: list[str], kind: Any, style: dict[str, Any], times: Any, lengths: Any, **data: Any) -> None:
        """Log rows of data, all at once, or `lengths` of them at each time."""
        where = self.rr.new_entity_path(path)
        self.recording.log(where, kind.from_fields(**style), static=True)
        if times is None:
            self.recording.log(where, kind.from_fields(**data), static=True)
        else:
            column = {"timestamp" if times[0] >= _UNIX else "duration": times}
            index = self.rr.TimeColumn("time", **column)
            self.recording.send_columns(where, [index], kind.columns(**data).partition(lengths))

    def add_camera(self, camera: int, image: NDArray[np.uint8] | None) -> None:
        """A camera at its pose, and in its own frame the border of what it sees, with the rays to the corners."""
        rr, path, color = self.rr, ["cameras", self.names[camera]], _CAMERAS[camera % len(_CAMERAS)]
        turn = Rotation.from_matrix(self.turn[camera]).as_quat()
        pose = rr.Transform3D(translation=self.center[camera], quaternion=turn)
        self.recording.log(path, pose, rr.ViewCoordinates.RDF, static=True)
        edge = self.reach * field_border(self.cameras[camera])[0].numpy()
        self.drawn.append(self.center[camera] + edge @ self.turn[camera].T)
        strips = [np.concatenate([edge, edge[:1]]), *(np.stack([0 * ray, ray]) for ray in edge[::_SIDE])]
        lines = rr.LineStrips3D(strips, colors=color, radii=self.dots(0.8))
        self.recording.log([*path, "field of view"], lines, static=True)
        self.recording.log([*path, "center"], rr.Points3D([[0, 0, 0]], colors=color, radii=self.dots(4)), static=True)
        # Seen from afar, cameras of a mast are one point: their names stand at corners of their images.
        near = np.linalg.norm(self.center - self.center[0], axis=-1).max() < 0.1 * self.reach
        name = rr.Points3D([edge[camera * _SIDE % len(edge)] * near], colors=color, labels=self.names[camera])
        self.recording.log([*path, "name"], name, static=True)
        if image is not None:
            self.recording.log([*path, "image"], self.mesh(camera, image), static=True)

    def dots(self, size: float) -> Any:
        """A radius in points of the screen, however far away."""
        return self.rr.Radius.ui_points(size)

    def mesh(self, camera: int, image: NDArray[np.uint8]) -> Any:
        """An image on the rays of its pixels, in the camera's frame."""
        size = width, height = self.cameras[camera].size
        if image.shape[1::-1] != size:
            raise InputError(
                f"camera {self.names[camera]} has {width}x{height} px, its image {image.shape[1]}x{image.shape[0]}: of "
                f"another camera, resized, or in another order than {', '.join(self.names)}"
            )
        share = np.stack(np.meshgrid(*[np.linspace(0, 1, _CELLS + 1)] * 2), -1).reshape(-1, 2)
        rays, valid = _rays(self.cameras[camera], torch.from_numpy(share * size - 0.5))
        corner = np.arange((_CELLS + 1) ** 2).reshape(_CELLS + 1, -1)[:-1, :-1].reshape(-1, 1)
        cells = (corner + np.array([0, 1, _CELLS + 1, 1, _CELLS + 2, _CELLS + 1])).reshape(-1, 3)
        step = -(-max(size) // _TEXTURE)
        small = np.asarray(Image.fromarray(image).resize((width // step, height // step), Image.Resampling.BOX))
        return self.rr.Mesh3D(
            vertex_positions=self.reach * rays.numpy(), triangle_indices=cells[valid.numpy()[cells].all(-1)],
            vertex_texcoords=share, albedo_texture=small if small.ndim == 3 else np.stack([small] * 3, -1),
        )  # fmt: skip

    def add_positions(self, located: Located) -> None:
        """Positions with their ellipsoids and intervals, all at once, or each at its time."""
        if located.origin != self.localize.origin:
            raise InputError(
                f"positions of another place: the rig stands at {self.localize.origin}, they count from "
                f"{located.origin}; locate them with this rig"
            )
        columns, unit = located.columns, range_unit(located)
        rows = np.flatnonzero(columns.located)
        if not len(rows):
            raise InputError(f"none of the {len(columns.names)} points has a position; nothing of them can be shown")
        texts = next((columns.extras[name] for name in ("time", "time_s") if name in columns.extras), None)
        times, lengths = None, None
        if texts is not None:
            seconds = np.array([unix_seconds(texts[row]) for row in rows])
            if not np.isfinite(seconds).all():
                bad = rows[~np.isfinite(seconds)][0]
                raise InputError(f"{columns.names[bad]}: time {texts[bad]!r}: seconds, or ISO with a zone, are needed")
            rows = rows[seconds.argsort(kind="stable")]
            times, lengths = np.unique(seconds, return_counts=True)
        numbers, positions = columns.numbers[rows], [located.positions[row] for row in rows]
        first, upper = (NUMBERS.index(name) for name in ("east_m", "cov_ee_m2"))
        enu = numbers[:, first : first + 3]
        half, turn = ellipsoids(numbers[:, upper + np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])])
        foot = located.feet.numpy()[rows]
        ends = numbers[:, [NUMBERS.index("range_low_m"), NUMBERS.index("range_high_m")]]
        ends = np.where(np.isfinite(ends), ends, np.linalg.norm(enu - foot, axis=-1)[:, None])[..., None]
        sight = (enu - foot) / np.linalg.norm(enu - foot, axis=-1, keepdims=True)
        lines = foot[:, None] + ends * sight[:, None] - self.zero
        places = enu - self.zero
        labels = [f"{one.name} {interval_text(one, unit)} {unit.name}" for one in positions]
        self.places = np.concatenate([self.places, places])
        rr, at = self.rr, (times, lengths)
        color, regions = {"colors": [_TARGETS]}, {"centers": places, "half_sizes": half, "quaternions": turn}
        style = color | {"fill_mode": rr.components.FillMode.MajorWireframe, "line_radii": self.dots(0.8)}
        self.put(["targets", "ellipsoids"], rr.Ellipsoids3D, style, *at, **regions)
        self.put(["targets", "intervals"], rr.LineStrips3D, color | {"radii": self.dots(1.5)}, *at, strips=lines)
        self.put(["targets"], rr.Points3D, color | {"radii": self.dots(4)}, *at, positions=places, labels=labels)
        if times is not None:
            past = rr.Points3D(places, colors=_FAINT, radii=self.dots(1.5))
            self.recording.log(["targets", "at all times"], past, static=True)

    def add_landmarks(self, survey: Survey) -> None:
        """Landmarks with their names."""
        if survey.origin not in (None, self.localize.origin):
            raise InputError("landmarks of another place: read them with the origin of the rig")
        places = survey.points.numpy() - self.zero
        self.places = np.concatenate([self.places, places])
        marks = self.rr.Points3D(places, colors=_LANDMARKS, radii=self.dots(4), labels=survey.names)
        self.recording.log("landmarks", marks, static=True)

    def boards(self, camera: int, seen: Observations) -> tuple[Pose, Tensor]:
        """Poses of the boards in the camera's frame, and the RMS of each view; NaN where it has no pose."""
        if seen.image_size != self.cameras[camera].size:
            raise InputError(
                f"camera {self.names[camera]} has {self.cameras[camera].size} px, its observations {seen.image_size}: "
                f"of another camera, or in another order than {', '.join(self.names)}"
            )
        poses, rms = pose_alone(seen.board.points, seen.pixels(), self.cameras[camera], LMOptions())
        self.away.append(float(poses.translation.norm(dim=-1).nan_to_num(0.0).max()))
        return poses, rms

    def add_views(self, seen: Sequence[Observations], boards: Sequence[tuple[Pose, Tensor]]) -> None:
        """Boards and images of each camera, view by view; views of one name are of one moment."""
        rr, log = self.rr, self.recording.log
        names = list(dict.fromkeys(itertools.chain(*(one.names for one in seen))))
        for number, name in enumerate(names):
            self.recording.set_time("view", sequence=number)
            for camera, (one, (poses, rms)) in enumerate(zip(seen, boards, strict=True)):
                path = ["cameras", self.names[camera]]
                view = one.names.index(name) if name in one.names else None
                log([*path, "image"], rr.Clear(recursive=False))
                log([*path, "board"], rr.Clear(recursive=True))
                # Images that are no longer there, or no longer the same, are not shown.
                with suppress(FileError):
                    if view is not None and one.views[view].image:
                        image = view_image(one.views[view].image or "", one.views[view].sha256)
                        log([*path, "image"], self.mesh(camera, image))
                if view is None or not bool(rms[view].isfinite()):
                    continue
                corners = (one.board.points @ poses.rotation[view].T + poses.translation[view]).numpy()
                there = one.views[view].seen
                color, text = _CAMERAS[camera % len(_CAMERAS)], f"{name}: {float(rms[view]):.3f} px"
                # Through the corners that are outermost toward each corner of the board.
                x, y = one.board.points[:, 0], one.board.points[:, 1]
                around = [corners[int(value.argmax())] for value in (-x - y, x - y, x + y, y - x, -x - y)]
                log([*path, "board"], rr.LineStrips3D([around], colors=color, radii=self.dots(1.5), labels=text))
                log([*path, "board", "corners"], rr.Points3D(corners[there], colors=color, radii=self.dots(2)))
        self.recording.disable_timeline("view")

    def extent(self) -> float:
        """How far the farthest thing that is shown is from the cameras, meters; of cameras alone, from each other."""
        middle = self.center.mean(0)
        shown = max([*np.linalg.norm(self.places - middle, axis=-1), *self.away])
        return float(shown or np.linalg.norm(self.center - middle, axis=-1).max() or 1.0)

    def blueprint(self) -> Any:
        """One view from above the cameras and from their side, from which ellipsoids show how long they are."""
        show, drawn = self.rr.blueprint, np.concatenate(self.drawn)
        up, forward = np.array([0, 0, 1.0]) if self.level else np.array([0, -1.0, 0]), self.turn[:, :, 2].mean(0)
        aside = 0.6 * up - 0.8 * forward + 0.5 * np.cross(forward, up)
        low, high = drawn.min(0), drawn.max(0)
        middle, away = (low + high) / 2, 0.75 * np.linalg.norm(high - low) / np.linalg.norm(aside)
        eye = show.EyeControls3D(position=middle + away * aside, look_target=middle, eye_up=up)
        return show.Blueprint(
            show.Spatial3DView(origin="/", name="kcal", eye_controls=eye), show.BlueprintPanel(state="collapsed"),
            show.SelectionPanel(state="collapsed"), show.TimePanel(state="collapsed"),
        )  # fmt: skip


def view_image(path: str | Path, sha256: str | None = None) -> NDArray[np.uint8]:
    """An image file as it is shown, (H, W) or (H, W, 3).

    Raises:
        FileError: no image that can be read, or another one than that of the digest.
    """
    data = read_bytes(path)
    if sha256 not in (None, hashlib.sha256(data).hexdigest()):
        raise FileError(f"{path}: the image has changed since its corners were found")
    image = to_8bit(decode_image(data, path))
    return image[..., :3] if image.ndim == 3 else image
