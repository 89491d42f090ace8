"""`StereoRig`: two cameras and where one stands from the other; `RigCovariance`: how well that is known."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from kcal.checks import as_covariance, as_points, as_tensor, require_finite
from kcal.dispatch import is_differentiated
from kcal.errors import InputError, warn_user
from kcal.lens.calibration import RigCalibration, UntilChanged
from kcal.lens.camera import Camera
from kcal.lens.camera_like import CameraLike, as_camera
from kcal.lens.mounting import Mounting
from kcal.lens.pose import Movable, rotation_from_vector
from kcal.texts import brief, length_text


class StereoRig(Movable):
    """Two cameras, rigidly joined.

    Convention: the rig frame is the left camera's frame, and `points_right = rotation @ points_left + translation`
    (meters). "Left" is only the first camera's name.

    What else is known of the rig travels with it, is stored by `kcal.save_rig` and used by `StereoLocalizer`, but takes
    no part in projection: the attributes `covariance` (a `RigCovariance`), `mounting` (a `Mounting`) and `calibration`
    (a `RigCalibration`). Each is None until it is set, and again once a camera or the relative pose has changed.

    Args:
        left: the first camera, or a `CameraLike`.
        right: the second camera.
        right_from_left_rotation: (3, 3) rotation matrix, such as R of `cv2.stereoCalibrate`.
        right_from_left_translation: (3,) or (3, 1) meters, such as T if the board was measured in meters.

    Raises:
        InputError: wrong shapes, values that are not finite, or a matrix that is no rotation.

    The pose may be freed: `rig.free("pose")`, `rig.free("rotation")` or `rig.free("translation")` let gradients reach
    it, through a step on top of what is stored (the parameter `pose_step`), so that a rotation stays one under any
    optimizer. A pose with a graph keeps it, and a translation that is an `nn.Parameter` is used as it is.

    A `KcalWarning` says where the right camera stands to the left of the left one, and where the baseline is beyond
    1 mm to 1 km.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080))
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> float(rig.baseline)
        10.0
    """

    covariance = UntilChanged["RigCovariance"](lambda rig, value: value.check(rig))
    mounting = UntilChanged[Mounting]()
    calibration = UntilChanged[RigCalibration]()

    def __init__(
        self,
        left: Camera | CameraLike,
        right: Camera | CameraLike,
        right_from_left_rotation: Tensor | ArrayLike,
        right_from_left_translation: Tensor | ArrayLike,
    ) -> None:
        super().__init__()
        like = getattr(left, "params", None)
        rotation = as_points("right_from_left_rotation", right_from_left_rotation, 3, like)
        translation = as_tensor("right_from_left_translation", right_from_left_translation)
        # OpenCV's T is (3, 1).
        translation = translation[:, 0] if translation.shape == (3, 1) else translation
        translation = as_points("right_from_left_translation", translation, 3, like)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(
                f"rig pose: shapes (3, 3) and (3,) are needed, got {tuple(rotation.shape)} and "
                f"{tuple(translation.shape)}"
            )
        require_finite("rig rotation", rotation)
        require_finite("rig translation", translation)
        identity = torch.eye(3, dtype=torch.float64, device=rotation.device)
        if not torch.allclose(rotation @ rotation.T, identity, atol=1e-6) or torch.linalg.det(rotation) < 0:
            raise InputError("rig rotation: not a rotation matrix (R Rᵀ must be 1 and det R = +1)")
        self.left: Camera = as_camera(left)
        self.right: Camera = as_camera(right)
        if isinstance(right_from_left_translation, nn.Parameter) and translation is not right_from_left_translation:
            raise InputError("right_from_left_translation: as a parameter it must be float64 of shape (3,)")
        self._keep("right_from_left_rotation", rotation, turns=isinstance(right_from_left_rotation, nn.Parameter))
        self._keep("right_from_left_translation", translation)
        if doubt := _pose_doubt(rotation.detach(), translation.detach()):
            warn_user(doubt)

    @property
    def right_from_left_rotation(self) -> Tensor:
        """(3, 3) rotation matrix, with the step of `free`."""
        kept, step = self._kept("right_from_left_rotation"), self.freed_step
        return kept if step is None else rotation_from_vector(step[0]) @ kept

    @property
    def right_from_left_translation(self) -> Tensor:
        """(3,) meters, likewise."""
        kept, step = self._kept("right_from_left_translation"), self.freed_step
        return kept if step is None else kept + step[1]

    @property
    def pose_slots(self) -> dict[str, Any]:
        """What `free` takes: `pose`, or `rotation` and `translation`; the step is that of `RigCovariance`."""
        return {"pose": slice(0, 6), "rotation": slice(0, 3), "translation": slice(3, 6)}

    def _zero_step(self) -> Tensor:
        return torch.zeros(6, dtype=torch.float64, device=self._kept("right_from_left_rotation").device)

    @property
    def baseline(self) -> Tensor:
        """Distance between the cameras' centers, meters."""
        return torch.linalg.vector_norm(self.right_from_left_translation)

    def extra_repr(self) -> str:
        """Baseline, and what else is known, for `repr`."""
        known = (word for word in ("covariance", "mounting", "calibration") if getattr(self, word) is not None)
        return ", ".join([f"baseline={length_text(float(self.baseline))}", *known])

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with either camera and with the relative pose."""
        pose = self.right_from_left_rotation.tolist(), self.right_from_left_translation.tolist()
        return hashlib.sha256(repr((self.left.fingerprint, self.right.fingerprint, pose)).encode()).hexdigest()[:12]

    def to_kornia(self) -> tuple[Any, Any]:
        """Both cameras as `PinholeCamera`s of kornia, posed in the left camera's frame.

        Raises:
            InputError: a lens, which a posed camera of kornia does not hold; rectify the images first.

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
            >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
            >>> float(StereoRig.from_kornia(*rig.to_kornia()).baseline)
            1.0
        """
        from kcal.lens.kornia_cameras import posed_pinholes  # kornia takes long to load

        return posed_pinholes(self.left, self.right, self.right_from_left_rotation, self.right_from_left_translation)

    @classmethod
    def from_kornia(cls, left: Any, right: Any) -> StereoRig:
        """The rig of two `PinholeCamera`s of kornia with poses, whose extrinsics lead from one frame into the cameras.

        Raises:
            InputError: other classes, batches, or a pose that is no rotation.
        """
        from kcal.lens.kornia_cameras import unposed_pinhole

        (first, one), (second, other) = unposed_pinhole(left), unposed_pinhole(right)
        turn = other[:3, :3] @ one[:3, :3].mT
        return cls(Camera.from_kornia(first), Camera.from_kornia(second), turn, other[:3, 3] - turn @ one[:3, 3])

    @property
    def essential(self) -> Tensor:
        """(3, 3) essential matrix E: rayᵀ_right E ray_left = 0 for rays of `Camera.unproject` that meet.

        With `Camera.normalize` it serves the functions of `kornia.geometry.epipolar`, whatever the lenses are.
        """
        from kornia.geometry.epipolar import cross_product_matrix

        skewed = cross_product_matrix(self.right_from_left_translation[None])[0]
        return skewed @ self.right_from_left_rotation

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
        """Move points (..., N, 3) from the left camera's frame into the right camera's."""
        points = as_points("points_left", points_left, 3, self.right_from_left_translation)
        return points @ self.right_from_left_rotation.T + self.right_from_left_translation

    def forward(self, points_left: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project points (..., N, 3) of the rig frame: pixels_left, pixels_right (..., N, 2), valid in both."""
        pixels_left, valid_left = self.left.project(points_left)
        pixels_right, valid_right = self.right.project(self.right_from_left(points_left))
        return pixels_left, pixels_right, valid_left & valid_right


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigCovariance:
    """How well a rig is known: one joint covariance, so that what is correlated stays so.

    The order is: the parameters of the left camera as in `Camera.names`, those of the right one, the rotation of
    right_from_left (3 radians: a rotation vector about the right camera's axes, `exp([ω]x) R`), its translation
    (3 meters), as in `kcal.lens.pose`.

    Args:
        half: (K, P) float64, P = the two cameras' parameters + 6: halfᵀ half is the covariance. As a root it loses
            nothing where coefficients are hardly determined one by one and their sum is.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> sigma = torch.tensor([0, 1e-4, 0, 0, 0, 0], dtype=torch.float64)  # relative yaw
        >>> known = RigCovariance.of(rig, pose=torch.diag(sigma**2))
        >>> tuple(known.half.shape), tuple(known.matrix.shape)
        ((1, 16), (16, 16))
    """

    __repr__ = brief

    half: Tensor

    @classmethod
    def of(
        cls,
        rig: StereoRig,
        *,
        left: Tensor | None = None,
        right: Tensor | None = None,
        pose: Tensor | None = None,
        joint: Tensor | None = None,
    ) -> RigCovariance:
        """Put parts together, each independent of the others and exact where left out; or take a `joint` matrix.

        Cameras and pose of a rig that was solved are not independent: errors of a lens are undone by the pose for all
        that was seen. Parts of a joint covariance taken as independent give intervals that are far too wide.

        Args:
            rig: the rig that they belong to.
            left: of the left camera's parameters, (5 + P, 5 + P).
            right: of the right camera's.
            pose: (6, 6) of the relative pose.
            joint: all of it, in place of the parts.

        Raises:
            InputError: a wrong shape, a matrix that is no covariance, or parts and a joint matrix together.
        """
        sizes = (rig.left.values.shape[-1], rig.right.values.shape[-1], 6)
        if joint is not None:
            if not (left is None and right is None and pose is None):
                raise InputError("rig covariance: give the joint matrix or its parts, not both")
            return cls(half=half_of_covariance(as_covariance("joint covariance", joint, sum(sizes))))
        names = ("left camera's covariance", "right camera's covariance", "pose covariance")
        parts = [as_covariance(*item) for item in zip(names, (left, right, pose), sizes, strict=True)]
        return cls(half=torch.block_diag(*map(half_of_covariance, parts)))

    @property
    def matrix(self) -> Tensor:
        """(P, P) the covariance."""
        return self.half.T @ self.half

    def check(self, rig: StereoRig) -> None:
        """Raise `InputError` unless it has the size of this rig's quantities, and is finite."""
        size = rig.left.values.shape[-1] + rig.right.values.shape[-1] + 6
        if self.half.ndim != 2 or self.half.shape[1] != size:
            raise InputError(f"joint covariance: a root (K, {size}) is needed, got {tuple(self.half.shape)}")
        require_finite("joint covariance", self.half)

    def with_pose(self, covariance: Tensor) -> RigCovariance:
        """This, and an independent error (6, 6) of the relative pose."""
        more = half_of_covariance(as_covariance("pose covariance", covariance, 6)).to(self.half)
        zero = more.new_zeros(len(more), self.half.shape[1] - 6)
        return RigCovariance(half=torch.cat([self.half, torch.cat([zero, more], 1)]))

    def checked_link(self, mounting: Tensor, link: Tensor) -> Tensor:
        """`link` (P, M) as float64, after checking that it fits this covariance and that of the mounting (M, M).

        Raises:
            InputError: a wrong shape, or the three together are no covariance.
        """
        size, more = self.half.shape[1], len(mounting)
        if not isinstance(link, Tensor) or tuple(link.shape) != (size, more):
            raise InputError(f"link: a covariance of the calibration with the mounting, ({size}, {more}), is needed")
        matrix = self.matrix
        link, mounting = link.to(matrix), mounting.to(matrix)
        whole = torch.cat([torch.cat([matrix, link], 1), torch.cat([link.T, mounting], 1)])
        return as_covariance("covariance of calibration and mounting", whole, size + more)[:size, size:]


def _pose_doubt(rotation: Tensor, translation: Tensor) -> str:
    """Why a relative pose is more likely a slip; empty where there is no reason to doubt it."""
    x, y, z = (-translation @ rotation).tolist()
    baseline = math.hypot(x, y, z)
    # Endoscopes have 4 mm. Masts are 10 to 500 m apart; beyond, cameras are stations.
    if baseline and not 1e-3 <= baseline <= 1e3:
        return (
            f"StereoRig: the baseline is {length_text(baseline)}; the translation must be in meters (T of "
            "cv2.stereoCalibrate has the unit of the board's points)"
        )
    # Side by side, and looking to the same side. One above the other, or facing each other, neither is on the left.
    if x < -0.9 * baseline and float(rotation[2, 2]) > 0:
        return (
            f"StereoRig: the right camera stands {length_text(-x)} to the left of the left one: exchanged images, or a "
            "pose left_from_right? points_right = rotation @ points_left + translation is needed"
        )
    return ""


def half_of_covariance(matrix: Tensor) -> Tensor:
    """(K, P) with halfᵀ half = matrix (P, P), K being its rank."""
    if is_differentiated(matrix):
        raise InputError("the root of a covariance has no derivatives; give RigCovariance(half=...)")
    scale = matrix.diagonal().sqrt()
    safe = torch.where(scale > 0, scale, 1.0)
    values, vectors = torch.linalg.eigh(matrix / safe[:, None] / safe[None, :])
    kept = values > 1e-14 * values[-1:].sum().clamp_min(1e-300)
    return (scale[:, None] * vectors[:, kept] * values[kept].sqrt()).T
