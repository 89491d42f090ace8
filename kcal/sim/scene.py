"""A simulated site with known truth: a rig of two CCTV cameras, its boards, landmarks and far targets.

Its lenses are ray-traced with the entrance pupil where it is, and its board is printed with errors, so that no model of
kcal is the truth. docs/measured/paper.md tells which accuracy the
marks and the calibration allow: 0.05 px of noise in each image alone is 2 % of range at 5 km.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.sim.captures import BoardLike, BoardPose, PrintedBoard, TrueRig, drawn_rig, project_board, sample_board_poses
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.render import RenderOptions, render_board

# Name, horizontal distance in meters, degrees to the right of the heading, meters above the rig.
_TARGETS = (
    ("gate", 100.0, -8.0, -9.0),
    ("shed", 250.0, 14.0, -7.0),
    ("tower", 500.0, -20.0, 12.0),
    ("truck", 1000.0, 6.0, -10.0),
    ("mast", 2000.0, -33.5, 25.0),
    ("pylon", 3500.0, 33.0, 30.0),
    ("drone", 5000.0, 2.0, 180.0),
)
_LANDMARKS = (
    ("post 1", 120.0, 20.0, -11.5),
    ("post 2", 180.0, -30.0, -11.2),
    ("kerb", 260.0, -4.0, -12.0),
    ("chimney", 420.0, 30.0, 18.0),
    ("roof", 650.0, -14.0, 3.0),
    ("silo", 900.0, 11.0, 16.0),
    ("antenna", 1500.0, -23.0, 40.0),
    ("ridge", 2600.0, 4.0, 90.0),
    ("well", 150.0, 9.0, -12.5),
    ("barn", 340.0, -18.0, 9.0),
    ("bridge", 1150.0, -8.0, -24.0),
    ("hill", 2100.0, 19.0, 120.0),
)
_NEAR_BOARD = PrintedBoard(9, 6, 0.06, seed=1)
# mm: the focal length that 1600 px are on a sensor of 1/2.8 inch, whose pixels measure 2.9 µm.
FOCAL_MM = 4.64
_RENDER = RenderOptions(blur=1.0, noise=4.0, vignetting=0.3, gamma=2.2)
Places = tuple[tuple[str, float, float, float], ...]


class NamedPoints(NamedTuple):
    """Names, and positions (N, 3) in meters east, north and up of the left camera."""

    names: tuple[str, ...]
    enu: Tensor


class SceneMarks(NamedTuple):
    """Pixels (N, 2) at which points were marked in both images, and where they truly are."""

    left: Tensor
    right: Tensor
    true_left: Tensor
    true_right: Tensor


class DemoView(NamedTuple):
    """One rendered image.

    Attributes:
        camera: "left" or "right".
        name: of the view, for example "near-07".
        image: (height, width) uint8.
        corners: (N, 2) true pixels of the inner corners, row by row.
        cam_from_board: true pose.
    """

    camera: Literal["left", "right"]
    name: str
    image: Tensor
    corners: Tensor
    cam_from_board: BoardPose


@functools.cache
def demo_rig() -> TrueRig:
    """Two CCTV cameras 10 m apart, 1920 x 1080, f 1600 px, wide glass lenses (72 degrees) of ordinary assembly.

    Their entrance pupils move with the angle, as in the real lens.

    Example:
        >>> round(float(demo_rig().baseline), 3)
        10.0
    """
    return drawn_rig(SURVEILLANCE, 1.0, 1, focal_mm=FOCAL_MM, wander=1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class DemoScene:
    """The site, cameras, boards and marks of the demonstration; the same seed gives the same bytes.

    Convention: the rig frame is the left camera's; ENU has its origin in the left camera's center. Rotations are in
    degrees here, as a site plan has them.

    Args:
        seed: of poses, noise and marks.
        rig: the true cameras.
        lat: of the left camera's center, degrees (WGS 84); a salt flat.
        lon: degrees east.
        height: meters above the ellipsoid.
        heading_deg: azimuth of the left camera's axis, degrees clockwise from true north.
        pitch_deg: of that axis above the horizon, degrees.
        roll_deg: turn of the left camera about its axis, degrees, clockwise as seen from behind it.
        near_board: board for close views of one camera each, held at 0.7 to 1.6 m.
        near_views: how many per camera.
        render: how images look.
        mark_sigma: noise of marks in pixels along each axis in each image.
        survey_sigma: error of surveyed positions in meters, along each axis.
        targets_at: points to locate: name, distance in meters, bearing in degrees to the right of the heading, height
            in meters.
        landmarks_at: points surveyed to orient the rig, likewise.

    Example:
        >>> scene = DemoScene(seed=1, near_views=4)
        >>> scene.images
        8
        >>> scene.targets.names[-1], [round(value) for value in scene.targets.enu[-1].tolist()]
        ('drone', [1545, 4755, 180])
    """

    seed: int = 0
    rig: TrueRig = field(default_factory=demo_rig)
    lat: float = 40.762
    lon: float = -113.896
    height: float = 1282.0
    heading_deg: float = 16.0
    pitch_deg: float = -0.5
    roll_deg: float = 0.4
    near_board: BoardLike = _NEAR_BOARD
    near_views: int = 20
    render: RenderOptions = _RENDER
    mark_sigma: float = 0.1
    survey_sigma: float = 0.02
    targets_at: Places = _TARGETS
    landmarks_at: Places = _LANDMARKS

    @property
    def images(self) -> int:
        """How many images `render_demo` yields."""
        return 2 * self.near_views

    @property
    def enu_from_rig(self) -> Tensor:
        """(3, 3) rotation of the rig frame into east, north, up; both have the same origin."""
        heading, pitch, roll = (math.radians(angle) for angle in (self.heading_deg, self.pitch_deg, self.roll_deg))
        right = torch.tensor([math.cos(heading), -math.sin(heading), 0.0], dtype=torch.float64)
        forward = torch.tensor(
            [math.sin(heading) * math.cos(pitch), math.cos(heading) * math.cos(pitch), math.sin(pitch)],
            dtype=torch.float64,
        )
        level = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
        cosine, sine = math.cos(roll), math.sin(roll)
        return level @ torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=torch.float64)

    @property
    def targets(self) -> NamedPoints:
        """Points to be located, from 100 m to 5 km; two of them near the image's left and right edge."""
        return self.places(self.targets_at)

    @property
    def landmarks(self) -> NamedPoints:
        """Points for the orientation of the rig, from 120 m to 2.6 km, where they truly are."""
        return self.places(self.landmarks_at)

    def surveyed(self, points: NamedPoints) -> NamedPoints:
        """Add the surveyor's errors to points."""
        stream = -20 - sum(map(ord, points.names[0]))
        error = torch.randn(points.enu.shape, dtype=torch.float64, generator=self.generator(stream))
        return NamedPoints(points.names, points.enu + self.survey_sigma * error)

    @property
    def target_marks(self) -> SceneMarks:
        """The targets marked in both images, with the scene's noise."""
        return self.marked(self.targets, -1)

    @property
    def landmark_marks(self) -> SceneMarks:
        """The landmarks marked in both images, with the scene's noise."""
        return self.marked(self.landmarks, -2)

    def points_rig(self, points: NamedPoints) -> Tensor:
        """(N, 3) positions in the left camera's frame."""
        return points.enu @ self.enu_from_rig

    def generator(self, stream: int) -> torch.Generator:
        """Make the random source of one part of the scene, so that the parts do not depend on each other."""
        return torch.Generator().manual_seed((self.seed + 1) * 1_000_003 + stream)

    def marked(self, points: NamedPoints, stream: int) -> SceneMarks:
        """Points marked in both images, with the scene's noise."""
        return mark_points(self.rig, self.points_rig(points), self.mark_sigma, self.generator(stream))

    def places(self, table: Places) -> NamedPoints:
        """Points of a table such as `targets_at`, where they truly are."""
        azimuth = [math.radians(self.heading_deg + bearing) for _, _, bearing, _ in table]
        rows = [
            [distance * math.sin(angle), distance * math.cos(angle), up]
            for angle, (_, distance, _, up) in zip(azimuth, table, strict=True)
        ]
        return NamedPoints(tuple(name for name, *_ in table), torch.tensor(rows, dtype=torch.float64))


def mark_points(rig: TrueRig, points_rig: Tensor, sigma: float, generator: torch.Generator) -> SceneMarks:
    """Mark points in both images with Gaussian noise.

    Args:
        rig: two cameras.
        points_rig: (N, 3) meters in the left camera's frame.
        sigma: standard deviation in pixels, for each axis and image.
        generator: source of the noise.

    Raises:
        InputError: a bad sigma, or a point that is not finite or that one of the cameras does not see.

    Example:
        >>> point = torch.tensor([[0.0, 0.0, 1000.0]])
        >>> marks = mark_points(demo_rig(), point, 0.1, torch.Generator().manual_seed(0))
        >>> bool((marks.left - marks.true_left).abs().max() < 0.5)
        True
    """
    points = as_points("points_rig", points_rig, 3)
    require_finite("points_rig", points)
    if not (sigma >= 0 and math.isfinite(sigma)):
        raise InputError(f"sigma {sigma}: pixels, not negative, are needed")
    with torch.no_grad():
        left, right, valid = rig(points)
    unseen = ~(valid & rig.left.inside(left) & rig.right.inside(right))
    if bool(unseen.any()):
        raise InputError(f"points_rig: point {int(unseen.nonzero()[0])} is not seen by both cameras")
    noise = sigma * torch.randn((2, *left.shape), dtype=torch.float64, generator=generator)
    return SceneMarks(left + noise[0], right + noise[1], left, right)


def render_demo(scene: DemoScene, progress: Callable[[str], None] | None = None) -> Iterator[DemoView]:
    """Render all images of a scene, one after the other: left's views of the board, then right's.

    Args:
        scene: what to render.
        progress: called with a short text after each image was made.

    Yields:
        `scene.images` views.

    Raises:
        InputError: the scene's boards cannot be seen as asked.

    Example:
        >>> view = next(render_demo(DemoScene(seed=1, near_views=1)))
        >>> view.camera, view.name, tuple(view.image.shape), tuple(view.corners.shape)
        ('left', 'near-01', (1080, 1920), (54, 2))
    """
    for index, (side, name, pose) in enumerate(scene_views(scene)):
        camera = getattr(scene.rig, side)
        image = render_board(camera, pose, scene.near_board, scene.render, scene.generator(index))
        corners, _ = project_board(camera, pose, scene.near_board)
        if progress is not None:
            progress(f"{side} {name}")
        yield DemoView(side, name, image, corners, pose)


def scene_views(scene: DemoScene) -> Iterator[tuple[Literal["left", "right"], str, BoardPose]]:
    """Camera, name and pose of each view of the board."""
    sides: tuple[Literal["left", "right"], ...] = ("left", "right")
    for stream, side in enumerate(sides):
        camera = getattr(scene.rig, side)
        poses = sample_board_poses(camera, scene.near_board, scene.near_views, scene.generator(-10 - stream))
        for number, pose in enumerate(poses, 1):
            yield side, f"near-{number:02d}", pose
