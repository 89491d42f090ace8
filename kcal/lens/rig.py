"""Rigs: where cameras stand from each other, on the Earth and in one frame, and how well that is known."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import math
from collections.abc import Sequence
from typing import Any, Self

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.nn.functional import pad

from kcal.checks import StatedModule, as_covariance, as_points, as_tensor, require_root, scalar
from kcal.doors import shown_in_notebooks
from kcal.errors import InputError, warn_user
from kcal.gaussian import half_of_covariance
from kcal.lens.calibration import RigCalibration, UntilChanged
from kcal.lens.camera import Camera
from kcal.lens.camera_like import CameraLike, as_camera
from kcal.lens.pair_errors import RigCovariance, relative_root
from kcal.lens.pose import Movable, check_motion, enu_from_cam, rotation_from_vector
from kcal.texts import brief, length_text
from kcal.values import number_list

# `Origin` and `Mounting`: where a camera stands on the Earth and where it looks, as plain numbers.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Origin:
    """Where ENU is anchored: for a rig the projection center of its left camera.

    Args:
        lat: geodetic latitude in degrees, -90 to 90.
        lon: longitude in degrees, -180 to 180.
        height: meters above the WGS84 ellipsoid, not above sea level.

    Raises:
        InputError: a value out of range; swapped latitude and longitude are named where they can be told.

    Example:
        >>> Origin.parse("-33.9, 151.2, 10")
        Origin(lat=-33.9, lon=151.2, height=10.0)
    """

    lat: float
    lon: float
    height: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in (self.lat, self.lon, self.height)):
            raise InputError(f"origin: latitude, longitude and height must be finite, got {self}")
        for word, value, most in (("latitude", self.lat, 90), ("longitude", self.lon, 180)):
            # 4319.2162 of receivers is 43 degrees and 19.2162 minutes; up to 360 it may be another angle in degrees.
            degrees, minutes = divmod(abs(value), 100)
            if abs(value) > 360 and degrees <= most and minutes < 60 and value % 1:
                decimal = math.copysign(degrees + minutes / 60, value)
                raise InputError(
                    f"origin: {word} {value:.10g} is outside -{most} to {most}; write decimal degrees: as degrees and "
                    f"minutes it is {decimal:.8f}"
                )
        if abs(self.lat) > 90:
            hint = "; longitude came first? write LAT,LON,HEIGHT" if abs(self.lon) <= 90 else ""
            raise InputError(f"origin: latitude {self.lat:g} is outside -90 to 90{hint}")
        if abs(self.lon) > 180:
            hint = f"; write {self.lon - 360:g}" if 180 < self.lon <= 360 else ""
            raise InputError(f"origin: longitude {self.lon:g} is outside -180 to 180{hint}")
        if not -1000 <= self.height <= 100_000:
            raise InputError(f"origin: height {self.height:g} m is outside -1000 to 100000; meters are needed")

    @classmethod
    def parse(cls, text: str) -> Origin:
        """Read `"LAT,LON,HEIGHT"`: degrees, degrees, meters above the WGS84 ellipsoid.

        Raises:
            InputError: not three numbers, or a value out of range.
        """
        lat, lon, height = number_list(text, "origin", 3, "three numbers LAT,LON,HEIGHT, for example 19.07,72.87,14")
        return cls(lat=lat, lon=lon, height=height)

    @classmethod
    def at(cls, geodetic: Tensor) -> Origin:
        """Of (3,) latitude, longitude, height."""
        lat, lon, height = geodetic.tolist()
        return cls(lat=lat, lon=lon, height=height)

    @property
    def geodetic(self) -> Tensor:
        """(3,) float64: latitude, longitude, height."""
        return torch.tensor([self.lat, self.lon, self.height], dtype=torch.float64)


# Gauss's coefficient of refraction, the mean over land by day. What is not known of it is the gradient of temperature:
# k = 503 p / T² (0.0342 + dT/dz) in hPa, K and K/m (Brunner 1984), so that 0.1 stands for ± 0.016 K/m. That suits lines
# of sight some ten meters above the ground; near it k varies by 1 and more (Hirt et al. 2010).
REFRACTION, REFRACTION_SIGMA = 0.13, 0.1


def check_refraction(refraction: float, sigma: float) -> None:
    """Raise `InputError` for a coefficient of refraction, or its standard deviation, that cannot be."""
    if not -2.0 <= refraction <= 2.0:
        raise InputError(f"refraction {refraction}: a coefficient such as 0.13 is needed, not beyond ±2")
    if not 0.0 <= sigma <= 2.0:
        raise InputError(f"refraction_sigma {sigma}: a number from 0 to 2 is needed, such as 0.1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mounting:
    """Position and attitude of a camera on the Earth, refraction there, and the covariance of both.

    Args:
        origin: place of the camera's projection center.
        heading_deg: azimuth of the optical axis, degrees clockwise from true north.
        pitch_deg: elevation of the optical axis, degrees, positive up.
        roll_deg: degrees, positive clockwise as seen from behind the camera.
        covariance: (7, 7) of east, north, up (meters), of turns about these axes (radians), all at the camera, and of
            the coefficient of refraction; (6, 6) where nothing was found of the last; None: exact.
        refraction: coefficient k, see `Localizer`.

    Example:
        >>> Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0).pitch_deg
        0.0
    """

    __repr__ = brief

    origin: Origin
    heading_deg: float
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    covariance: Tensor | None = None
    refraction: float = REFRACTION

    @property
    def enu_from_cam(self) -> Tensor:
        """(3, 3) rotation of the camera."""
        return enu_from_cam(self.heading_deg, self.pitch_deg, self.roll_deg)


# `Rig`: cameras and where each stands in one frame; `RigCovariance`: how well two of them are known.


class Rig(Movable, StatedModule):
    """Cameras, rigidly joined, and the pose of each in one frame, the rig's.

    Convention: `points_cam = rotation[c] @ points_rig + translation[c]` (meters), `cam_from_rig` of camera c. Two
    cameras are the ordinary case, made by `Rig.pair`: the rig frame is then the left camera's frame. "Left" is only the
    first camera's name. With an `origin`, the frame is east, north, up there.

    `left`, `right`, `baseline`, `right_from_left`, `essential`, `fundamental` and `to_kornia` are views of a rig of two
    cameras; any other number is an `InputError`.

    What else is known of the rig travels with it and is stored in its file, but takes no part in projection. Each of
    these attributes is None until it is set, and again once a camera or a pose has changed:

    * `root`: (K, P) with rootᵀ root the covariance of P quantities: all parameters of each camera in turn
      (`Camera.names`); then for each camera its center (3, meters) and a small turn of it (3, radians), both along and
      about the rig frame's axes; last the coefficient of refraction. None: cameras and poses count as exact;
    * `mounting` (a `Mounting`): where the left one of two cameras, whose frame is the rig's, stands on the Earth. What
      is known of that is read from `root`, as `covariance` (a `RigCovariance`) is: that of the lenses and the relative
      pose. Each of them may be set, and is then independent of what else is known;
    * `calibration` (a `RigCalibration`): how the rig was solved.

    Args:
        cameras: V of them, or `CameraLike`s; one or more.
        names: of the cameras, unlike each other.
        rotation: (V, 3, 3) rotation matrices cam_from_rig. Of two cameras also (3, 3), that of the second one: the
            first camera's frame is then the rig's.
        translation: (V, 3) meters, likewise; or (3,).
        center: (V, 3) projection centers in the rig frame, meters, in place of the translation.
        origin: where the frame is anchored on the Earth.
        refraction: coefficient k, see `Localizer`.

    Raises:
        InputError: wrong shapes, values that are not finite, names that are there twice, or a matrix that is no
            rotation.

    Poses may be freed: `rig.free("pose")`, `rig.free("rotation")`, `rig.free("translation")` or `rig.free("mill")`, of
    the camera with this name, let gradients reach them through a step on top of what is stored (the parameter
    `pose_step`), so that a rotation stays one under any optimizer. A first camera whose frame is the rig's is freed
    only by its name. A pose with a graph keeps it, and a translation that is an `nn.Parameter` is used as it is.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> look = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # north
        >>> rig = Rig([camera] * 3, ["a", "b", "c"], look.repeat(3, 1, 1), center=torch.eye(3) * 1000.0)
        >>> rig.names, rig.quantities
        (('a', 'b', 'c'), 34)
        >>> float(Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0])).baseline)
        10.0
    """

    _repr_html_ = shown_in_notebooks

    refraction: Tensor
    place: Tensor | None
    _stands = UntilChanged[Mounting]()
    root = UntilChanged[Tensor](lambda rig, value: rig.check_root(value))
    calibration = UntilChanged[RigCalibration]()

    def __init__(
        self,
        cameras: Sequence[Camera | CameraLike],
        names: Sequence[str],
        rotation: Tensor | ArrayLike,
        translation: Tensor | ArrayLike | None = None,
        *,
        center: Tensor | ArrayLike | None = None,
        origin: Origin | None = None,
        refraction: float = REFRACTION,
    ) -> None:
        super().__init__()
        count, like = len(cameras), getattr(cameras[0], "params", None) if cameras else None
        turns, moves = as_points("rotation", rotation, 3, like), translation if center is None else center
        if moves is None or (translation is not None and center is not None):
            raise InputError("rig: translations or centers are needed, one of the two")
        shift = as_points("translation" if center is None else "center", moves, 3, like)
        alone = count == 2 and center is None and turns.shape == (3, 3)
        if not count or turns.shape[-3:] != ((3, 3) if alone else (count, 3, 3)) or shift.shape != turns.shape[:-1]:
            raise InputError(
                f"{count} cameras: rotation ({count}, 3, 3) and {'translation' if center is None else 'center'} "
                f"({count}, 3) are needed, got {tuple(turns.shape)} and {tuple(shift.shape)}"
            )
        if len(names) != count or len(set(names)) != count or not all(names):
            raise InputError(f"cameras: {count} unlike names are needed, got {', '.join(names) or 'none'}")
        for name, turn, move in zip(names[alone:], turns.reshape(-1, 3, 3), shift.reshape(-1, 3), strict=True):
            check_motion(f"camera {name}:", turn, move)
        if isinstance(moves, nn.Parameter) and shift is not moves:
            raise InputError(f"translation: as a parameter it must be float64 of shape {tuple(shift.shape)}")
        check_refraction(refraction, 0.0)
        if center is not None:
            shift = -(turns @ shift[..., None])[..., 0]
        if alone and not isinstance(rotation, nn.Parameter):
            turns = torch.stack([torch.eye(3).to(turns), turns])
            shift = moves if isinstance(moves, nn.Parameter) else torch.stack([torch.zeros_like(shift), shift])
        self.cameras = nn.ModuleList(map(as_camera, cameras))
        self.names = tuple(names)
        self.register_buffer("place", None if origin is None else origin.geodetic.to(turns.device))
        self.register_buffer("refraction", scalar(refraction, turns))
        self._keep("rotation", rotation if isinstance(rotation, nn.Parameter) else turns, turns=True)
        self._keep("translation", shift)

    @classmethod
    def pair(
        cls,
        left: Camera | CameraLike,
        right: Camera | CameraLike,
        right_from_left_rotation: Tensor | ArrayLike,
        right_from_left_translation: Tensor | ArrayLike,
    ) -> Self:
        """Two cameras: `points_right = rotation @ points_left + translation`, in the left camera's frame.

        A `KcalWarning` says where the right camera stands to the left of the left one, and where the baseline is beyond
        1 mm to 1 km.

        Args:
            left: the first camera, or a `CameraLike`.
            right: the second camera.
            right_from_left_rotation: (3, 3) rotation matrix, such as R of `cv2.stereoCalibrate`.
            right_from_left_translation: (3,) or (3, 1) meters, such as T if the board was measured in meters.

        Raises:
            InputError: wrong shapes, values that are not finite, or a matrix that is no rotation.

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
            >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
            >>> rig.names, float(rig.baseline)
            (('left', 'right'), 1.0)
        """
        like = getattr(left, "params", None)
        rotation = as_points("right_from_left_rotation", right_from_left_rotation, 3, like)
        translation = as_tensor("right_from_left_translation", right_from_left_translation)
        # OpenCV's T is (3, 1).
        translation = translation[:, 0] if translation.shape == (3, 1) else translation
        translation = as_points("right_from_left_translation", translation, 3, like)
        check_motion("rig", rotation, translation)
        if isinstance(right_from_left_translation, nn.Parameter) and translation is not right_from_left_translation:
            raise InputError("right_from_left_translation: as a parameter it must be float64 of shape (3,)")
        if isinstance(right_from_left_rotation, nn.Parameter):
            rotation = right_from_left_rotation
        if doubt := _pose_doubt(rotation.detach(), translation.detach()):
            warn_user(doubt)
        return cls([left, right], ("left", "right"), rotation, translation)

    @property
    def rotation(self) -> Tensor:
        """(V, 3, 3) cam_from_rig, with the steps of `free`."""
        kept, step = self._kept("rotation"), self.freed_step
        return kept if step is None else rotation_from_vector(step[0]) @ kept

    @property
    def translation(self) -> Tensor:
        """(V, 3) meters, likewise."""
        kept, step = self._kept("translation"), self.freed_step
        kept = torch.stack([torch.zeros_like(kept), kept]) if kept.ndim == 1 else kept
        return kept if step is None else kept + step[1]

    @property
    def center(self) -> Tensor:
        """(V, 3) projection centers in the rig frame, meters."""
        rotation = self.rotation
        # A step of Newton's from the transpose to the inverse: a rotation from a file may have been rounded.
        inverse = 2 * rotation.mT - rotation.mT @ rotation @ rotation.mT
        return -(inverse @ self.translation[..., None])[..., 0]

    @property
    def origin(self) -> Origin | None:
        """Where the frame is anchored on the Earth."""
        return None if self.place is None else Origin.at(self.place)

    @property
    def constants(self) -> object:
        """Names, in order."""
        return self.names

    @property
    def in_first_frame(self) -> bool:
        """Whether the rig's frame is the first camera's, and not one that is anchored on the Earth."""
        first = self.rotation[0], self.translation[0]
        return self.place is None and torch.equal(first[0], torch.eye(3).to(first[0])) and not bool(first[1].any())

    @property
    def is_pair(self) -> bool:
        """Whether these are two cameras in the left one's frame."""
        return len(self) == 2 and self.in_first_frame

    @property
    def pose_slots(self) -> dict[str, Any]:
        """What `free` takes: `pose`, `rotation` and `translation`, or names of cameras; a step is that of `Movable`."""
        free = slice(int(self.in_first_frame and len(self) > 1), None)
        parts = {"pose": slice(0, 6), "rotation": slice(0, 3), "translation": slice(3, 6)}
        named = {name: number for number, name in enumerate(self.names)}
        return {**{name: (free, part) for name, part in parts.items()}, **named}

    def _zero_step(self) -> Tensor:
        return torch.zeros(len(self), 6, dtype=torch.float64, device=self._kept("rotation").device)

    def extra_repr(self) -> str:
        """Names, distance of the cameras, origin, and what else is known, for `repr`."""
        words = *(("covariance", "mounting") if self.is_pair else ("root",)), "calibration"
        known = (word for word in words if getattr(self, word) is not None)
        if len(self) == 2:
            apart = f"baseline={length_text(float(self.baseline))}"
        else:
            apart = f"up to {length_text(float(torch.cdist(self.center, self.center).max()))} apart"
        origin = [] if self.origin is None else [str(self.origin)]
        return ", ".join([*self.names, apart, *origin, *known])

    def __len__(self) -> int:
        """How many cameras there are."""
        return len(self.names)

    def __setattr__(self, name: str, value: Any) -> None:
        """`rig.left` and `rig.right` may be set."""
        if name in ("left", "right"):
            _of_two(self, name)
            self.cameras[int(name == "right")] = as_camera(value)
        else:
            super().__setattr__(name, value)

    def __copy__(self) -> Self:
        """The same cameras, poses and errors in a rig on which others can be set without changing this one."""
        same = type(self).__new__(type(self))
        vars(same).update({name: copy.copy(v) if isinstance(v, dict) else v for name, v in vars(self).items()})
        same.cameras = nn.ModuleList(self.cameras)
        return same

    @property
    def each(self) -> list[Camera]:
        """The cameras."""
        return list(self.cameras)  # type: ignore[arg-type]

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with any camera and any pose."""
        own = [camera.fingerprint for camera in self.each]
        if self.is_pair:
            pose = self.right_from_left_rotation.tolist(), self.right_from_left_translation.tolist()
            # As in 1.0, whose histories of a rig that is watched name it.
            return hashlib.sha256(repr((*own, pose)).encode()).hexdigest()[:12]
        text = repr((own, self.rotation.tolist(), self.translation.tolist(), self.origin, float(self.refraction)))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def left(self) -> Camera:
        """The first of two cameras."""
        return _of_two(self, "left").each[0]

    @property
    def right(self) -> Camera:
        """The second of two cameras."""
        return _of_two(self, "right").each[1]

    @property
    def right_from_left_rotation(self) -> Tensor:
        """(3, 3) rotation matrix."""
        rotation = _of_two(self, "right_from_left_rotation").rotation
        return rotation[1] @ rotation[0].T

    @property
    def right_from_left_translation(self) -> Tensor:
        """(3,) meters."""
        translation = _of_two(self, "right_from_left_translation").translation
        return translation[1] - self.right_from_left_rotation @ translation[0]

    @property
    def baseline(self) -> Tensor:
        """Distance between the centers of two cameras, meters."""
        return torch.linalg.vector_norm(_of_two(self, "baseline").right_from_left_translation)

    def to_kornia(self) -> tuple[Any, Any]:
        """Two cameras as `PinholeCamera`s of kornia, posed in the left camera's frame.

        Raises:
            InputError: a lens, which a posed camera of kornia does not hold; rectify the images first.

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
            >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
            >>> float(Rig.from_kornia(*rig.to_kornia()).baseline)
            1.0
        """
        from kcal.lens.kornia_cameras import posed_pinholes  # kornia takes long to load

        return posed_pinholes(self.left, self.right, self.right_from_left_rotation, self.right_from_left_translation)

    @classmethod
    def from_kornia(cls, left: Any, right: Any) -> Self:
        """The rig of two `PinholeCamera`s of kornia with poses, whose extrinsics lead from one frame into the cameras.

        Raises:
            InputError: other classes, batches, or a pose that is no rotation.
        """
        from kcal.lens.kornia_cameras import unposed_pinhole

        (first, one), (second, other) = unposed_pinhole(left), unposed_pinhole(right)
        turn = other[:3, :3] @ one[:3, :3].mT
        return cls.pair(Camera.from_kornia(first), Camera.from_kornia(second), turn, other[:3, 3] - turn @ one[:3, 3])

    @property
    def essential(self) -> Tensor:
        """(3, 3) essential matrix E: rayᵀ_right E ray_left = 0 for rays of `Camera.unproject` that meet.

        With `Camera.normalize` it serves the functions of `kornia.geometry.epipolar`, whatever the lenses are.
        """
        from kornia.geometry.epipolar import cross_product_matrix

        return cross_product_matrix(self.right_from_left_translation[None])[0] @ self.right_from_left_rotation

    @property
    def fundamental(self) -> Tensor:
        """(3, 3) fundamental matrix F: pixelᵀ_right F pixel_left = 0, of cameras without distortion.

        Raises:
            InputError: a camera whose lens distorts: epipolar lines are curves there. Use `essential` with
                `Camera.normalize`, or undistort the images.
        """
        for word, camera in (("left", self.left), ("right", self.right)):
            if camera.wide or bool((camera.coefficients != 0).any()):
                raise InputError(
                    f"the {word} lens distorts, so that epipolar lines are curves and there is no fundamental matrix; "
                    "use rig.essential with camera.normalize(pixels)"
                )
        from kornia.geometry.epipolar import fundamental_from_essential

        return fundamental_from_essential(self.essential[None], self.left.matrix[None], self.right.matrix[None])[0]

    def right_from_left(self, points_left: Tensor) -> Tensor:
        """Move points (..., N, 3) from the left of two cameras' frame into the right camera's."""
        shift = self.right_from_left_translation
        return as_points("points_left", points_left, 3, shift) @ self.right_from_left_rotation.T + shift

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many parameters each camera has."""
        return tuple(camera.values.shape[-1] for camera in self.each)

    @property
    def quantities(self) -> int:
        """P: how many quantities the covariance is of."""
        return sum(self.sizes) + 6 * len(self) + 1

    def pose_columns(self, camera: int) -> slice:
        """Where the center and the turn of a camera are among the quantities."""
        first = sum(self.sizes) + 6 * camera
        return slice(first, first + 6)

    def check_root(self, root: Tensor) -> None:
        """Raise `InputError` unless `root` has the size of this rig's quantities, and is finite."""
        require_root("root", root, self.quantities)

    @property
    def relative_root(self) -> Tensor | None:
        """(K, P) `root` of two cameras in other quantities.

        These are the lenses' and the relative pose in the order of `RigCovariance`, then place and attitude of the left
        camera and refraction in that of `Mounting.covariance`.
        """
        root = self.root
        return None if root is None or len(self) != 2 else self._changed(root)

    @relative_root.setter
    def relative_root(self, value: Tensor) -> None:
        _of_two(self, "relative_root")
        require_root("joint covariance", value, self.quantities)
        self.root = self._changed(value, back=True)

    def _changed(self, root: Tensor, *, back: bool = False) -> Tensor:
        stands = self._stands
        look = torch.eye(3) if stands is None else stands.enu_from_cam
        return relative_root(root, self.center, self.rotation[1], look, back=back)

    def _take(self, covariance: Tensor | None, stands: Mounting | None, mounting: Tensor | None) -> None:
        """Set `root` to independent errors (K, P - 7) of lenses and relative pose, and (L, 7) of the mounting."""
        self._stands = stands
        size = self.quantities - 7
        parts = [pad(covariance, (0, 7))] if covariance is not None else []
        parts += [pad(mounting, (size, 0))] if mounting is not None else []
        if any(bool(part.any()) for part in parts):
            self.relative_root = torch.cat(parts)
        else:
            self.root = None

    @property
    def known(self) -> bool:
        """Whether lenses and poses have error bars; where a pair stands says nothing of them."""
        return (self.covariance if self.is_pair else self.root) is not None

    @property
    def covariance(self) -> RigCovariance | None:
        """How well two cameras and their relative pose are known; None: nothing is."""
        known = self.relative_root
        half = None if known is None else known[:, :-7]
        return None if half is None or not bool(half.any()) else RigCovariance(half=half[half.any(1)])

    @covariance.setter
    def covariance(self, value: RigCovariance | None) -> None:
        size = _of_two(self, "covariance").quantities - 7
        if value is not None:
            require_root("joint covariance", value.half, size)
        known = self.relative_root
        mounting = None if known is None else known[:, size:]
        self._take(None if value is None else value.half, self._stands, mounting)

    @property
    def mounting(self) -> Mounting | None:
        """Where the left one of two cameras stands, and how well that is known."""
        stands, known = self._stands, self.relative_root
        if stands is None or known is None:
            return stands
        return dataclasses.replace(stands, covariance=known[:, -7:].T @ known[:, -7:])

    @mounting.setter
    def mounting(self, value: Mounting | None) -> None:
        known, half = self.relative_root, None
        if value is not None:
            if not self.is_pair:
                raise InputError("mounting: two cameras in the left one's frame are needed; others have an origin")
            check_refraction(value.refraction, 0.0)
            covariance = torch.zeros(6, 6).double() if value.covariance is None else value.covariance
            covariance = as_covariance("mounting", covariance, 7 if covariance.shape[-1:] == (7,) else 6)
            half = half_of_covariance(covariance)
            if len(covariance) == 6:
                half = torch.block_diag(half, half.new_full((1, 1), REFRACTION_SIGMA))
            value = dataclasses.replace(value, covariance=None)
        self._take(None if known is None else known[:, :-7], value, half)

    def placed(
        self,
        *,
        origin: Origin | None = None,
        heading_deg: float | None = None,
        pitch_deg: float = 0.0,
        roll_deg: float = 0.0,
        covariance: Tensor | None = None,
        refraction: float | None = None,
        refraction_sigma: float | None = None,
    ) -> Self:
        """The same two cameras and poses, elsewhere on the Earth or in other light.

        Args:
            origin: position of the left camera's projection center; with `heading_deg`, or neither: where it stands.
            heading_deg: of the left camera's axis, clockwise from true north; see `kcal.locate.enu_from_cam`.
            pitch_deg: of the same axis, positive up.
            roll_deg: of the left camera, positive clockwise as seen from behind.
            covariance: of a new place, as in `Mounting`.
            refraction: coefficient k, see `Localizer`; 0.13 in a new place if left out. For simulations and other
                straight lines it and its sigma are 0.
            refraction_sigma: its standard deviation; if left out, as it was known where `refraction` is left out too,
                and 0.1 otherwise, which suits lines of sight some ten meters above the ground; near hot or cold ground
                0.5 and more are usual.

        Raises:
            InputError: half a place, no place at all, or a value that cannot be.

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
            >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
            >>> there = rig.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0)
            >>> there.mounting.heading_deg, rig.mounting
            (35.0, None)
        """
        same = copy.copy(self)
        if (origin is None) != (heading_deg is None) or (origin is None and (pitch_deg or roll_deg)):
            raise InputError("origin and heading_deg belong together, and pitch_deg and roll_deg to them")
        if origin is not None and heading_deg is not None:
            same.mounting = Mounting(
                origin=origin, heading_deg=heading_deg, pitch_deg=pitch_deg, roll_deg=roll_deg, covariance=covariance
            )
        elif self._stands is None or covariance is not None:
            raise InputError("refraction: this rig does not say where it stands; give origin and heading_deg")
        if refraction is not None or refraction_sigma is not None:
            light = REFRACTION if refraction is None else refraction
            sigma = REFRACTION_SIGMA if refraction_sigma is None else refraction_sigma
            check_refraction(light, sigma)
            assert same._stands is not None
            same._stands = dataclasses.replace(same._stands, refraction=light)
            known = self.center.new_zeros(0, self.quantities) if same.root is None else same.root
            alone = pad(known.new_full((1, 1), sigma), (self.quantities - 1, 0))
            same.root = torch.cat([pad(known[:, :-1], (0, 1)), alone])
        return same

    def with_errors(
        self,
        *,
        position_m: float | Sequence[float] = 0.0,
        attitude_deg: float | Sequence[float] = 0.0,
        refraction: float = 0.0,
    ) -> Tensor:
        """`root`, and independent errors that are stated besides.

        Args:
            position_m: standard deviation of each center along east, north and up; or three of them.
            attitude_deg: of the turn of each camera about these axes; or three of them.
            refraction: of its coefficient.

        Returns:
            (K, P): set it as `rig.root`, or give it to `Localizer`.

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
            >>> rig = Rig([camera], ["tower"], torch.eye(3)[None], center=torch.zeros(1, 3))
            >>> tuple(rig.with_errors(position_m=0.02, attitude_deg=(0.01, 0.01, 0.02)).shape)
            (6, 12)
        """
        three = [[value] * 3 if isinstance(value, int | float) else list(value) for value in (position_m, attitude_deg)]
        one = [*three[0], *(math.radians(value) for value in three[1])]
        if len(one) != 6 or not all(0 <= value < math.inf for value in (*one, refraction)):
            raise InputError("errors: one or three standard deviations are needed, none negative")
        sigma = self.center.new_tensor([*([0.0] * sum(self.sizes)), *(one * len(self)), refraction])
        more = torch.diag(sigma)[sigma > 0]
        return more if self.root is None else torch.cat([self.root, more])

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (..., N, 3) of the rig frame along straight lines: pixels (..., N, V, 2), and which are seen.

        What is seen (..., N, V) is in the image and in the region where the lens is known.
        """
        points = as_points("points", points, 3, self.translation)
        pixels, seen = [], []
        for camera, rotation, translation in zip(self.each, self.rotation, self.translation, strict=True):
            pixel, valid = camera.project(points @ rotation.T + translation)
            pixels.append(pixel)
            seen.append(valid & camera.inside(pixel))
        return torch.stack(pixels, -2), torch.stack(seen, -1)


def _of_two(rig: Rig, wanted: str) -> Rig:
    """The rig, if it is one of two cameras."""
    if len(rig) != 2:
        raise InputError(f"{wanted}: a rig of two cameras is needed; this one has {len(rig)}: {', '.join(rig.names)}")
    return rig


def _pose_doubt(rotation: Tensor, translation: Tensor) -> str:
    """Why a relative pose is more likely a slip, or ""."""
    x, y, z = (-translation @ rotation).tolist()
    baseline = math.hypot(x, y, z)
    # Endoscopes have 4 mm. Masts are 10 to 500 m apart; beyond, cameras are stations.
    if baseline and not 1e-3 <= baseline <= 1e3:
        return (
            f"Rig: the baseline is {length_text(baseline)}; the translation must be in meters (T of "
            "cv2.stereoCalibrate has the unit of the board's points)"
        )
    # Side by side, and looking to the same side. One above the other, or facing each other, neither is on the left.
    if x < -0.9 * baseline and float(rotation[2, 2]) > 0:
        return (
            f"Rig: the right camera stands {length_text(-x)} to the left of the left one: exchanged images, or a "
            "pose left_from_right? points_right = rotation @ points_left + translation is needed"
        )
    return ""
