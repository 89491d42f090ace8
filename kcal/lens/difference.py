"""How differently two cameras see the same points, over the image, against what is known of both."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.checks import chi2_tail
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.pose import fit_turn, rotation_between, seen_turned
from kcal.lens.projection import FAR
from kcal.lens.uncertainty import largest_sigma, pixel_covariance, pixel_slopes
from kcal.texts import brief, length_text, number_text, range_text

# How far pixels are shifted, over an image.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PixelShift:
    """Where something is seen in place of `pixels`.

    Args:
        pixels: (rows, columns, 2).
        shift: (rows, columns, 2) pixels, from there; NaN where nothing is seen.
    """

    pixels: Tensor
    shift: Tensor

    @property
    def length(self) -> Tensor:
        """(rows, columns) length of the shift, pixels."""
        return torch.linalg.vector_norm(self.shift, dim=-1)

    @property
    def rms(self) -> float:
        """Root mean square of the length over the image, pixels."""
        return float(self.length[self.length.isfinite()].square().mean().sqrt())

    @property
    def largest(self) -> float:
        """Largest length, pixels."""
        return float(self.length[self.length.isfinite()].max())


# How differently two cameras see the same points after the best-fit rotation, against what is known of both.
#
# No calibration determines how a camera's frame is turned in its housing. So the second camera is turned until it sees
# what the first one sees as well as it can (mrcal: the implied rotation), with weights from the error bars of both.

# Cameras that agree differ by more than this in 5 % of cases, like the intervals of `kcal.locate`.
_LEVEL = 0.05
# Share of the median variance that every pixel has at least in the weights, so that none counts alone.
_LEAST_SHARE = 0.01
_SETTLED = 1e-13


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CameraDifference(PixelShift):
    """Where a second camera sees points that a first camera sees at `pixels`.

    Args:
        pixels: (rows, columns, 2) of the first camera.
        shift: (rows, columns, 2) pixels of the second minus those of the first camera; NaN where one has no ray.
        sigma: (rows, columns) one sigma of the shift in the direction in which it is largest, from the error bars of
            the cameras; None if neither has any.
        known: whether the error bars of the first, and of the second camera count in it.
        rotation: (3, 3) from the first camera's frame to the second's.
        translation: (3,) likewise, meters; zero at infinity.
        at: distance of the points, meters.
        ratio: RMS of the shift over what the error bars predict, 1 if they explain it; None without error bars.
        probability: that cameras which agree differ by at least as much; None without error bars.

    Example:
        >>> left = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> right = Camera.build(focal=(800, 800), center=(321, 240), size=(640, 480))
        >>> found = camera_difference(left, right)
        >>> round(float(found.shift[..., 0].abs().max()), 1), round(found.rms, 2)  # most of it is a turn
        (0.1, 0.06)
    """

    __repr__ = brief

    sigma: Tensor | None
    known: tuple[bool, bool]
    rotation: Tensor
    translation: Tensor
    at: float
    ratio: float | None
    probability: float | None

    @property
    def same(self) -> bool | None:
        """Whether the error bars explain the difference, at a level of 5 %; None without error bars."""
        return None if self.probability is None else self.probability >= _LEVEL

    @property
    def turn_deg(self) -> float:
        """Angle of the rotation, degrees."""
        half = 0.5 * torch.linalg.matrix_norm(self.rotation - torch.eye(3, dtype=torch.float64)) / math.sqrt(2.0)
        return math.degrees(2.0 * math.asin(min(1.0, float(half))))


@torch.no_grad()
def camera_difference(
    first: Camera,
    second: Camera,
    *,
    at: float = math.inf,
    rotation: Tensor | None = None,
    grid: tuple[int, int] = (33, 25),
) -> CameraDifference:
    """Compare what two cameras see, after the best-fit rotation of the second.

    The turn minimizes the squared shifts over a grid of the image, weighted by the inverse variances of both cameras
    where their calibration has them, else equally. For points at a distance the second camera may also stand elsewhere.
    Error bars of the cameras are taken as independent.

    Args:
        first: a single camera, with its `calibration` if it has error bars.
        second: a single camera of the same image size.
        at: distance of the points from the first camera, meters.
        rotation: (3, 3) from the first camera's frame to the second's, if it is known: the identity where the frames
            are the same by construction. Nothing is fitted then.
        grid: columns and rows.

    Raises:
        InputError: batches, other image sizes, a distance that is not positive.
        DegenerateError: hardly any pixel that both cameras have a ray for.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1])
        >>> camera_difference(camera, camera).largest < 1e-9
        True
    """
    if first.params.ndim != 1 or second.params.ndim != 1:
        raise InputError("camera_difference: two single cameras are needed, not batches")
    if first.size != second.size:
        raise InputError(
            f"camera_difference: the images have {first.size[0]}x{first.size[1]} and {second.size[0]}x"
            f"{second.size[1]} px; only cameras with the same image can be compared pixel by pixel"
        )
    if not at > 0:
        raise InputError(f"camera_difference: a positive distance is needed, got {at}")
    pixels = first.grid(*grid)
    flat = pixels.reshape(-1, 2)
    rays, good = first.unproject(flat)
    rays_second, seen_by_second = second.unproject(flat)
    good = good & seen_by_second
    if int(good.sum()) < 8:
        raise DegenerateError(f"camera_difference: only {int(good.sum())} of {len(flat)} pixels have a ray in both")
    weight = _inverse_variances(first, second, flat, good)
    points = FAR * rays if math.isinf(at) else first.ray_origins(rays) + at * rays
    freedom = 0 if rotation is not None else 3 if math.isinf(at) else 6
    start = rotation_between(rays, rays_second * weight[:, None]) if rotation is None else rotation.double()
    turn, shift = _fit(second, points[good], flat[good], weight[good], start, freedom)
    moved = points @ turn.T + shift
    seen, visible = second.project(moved)
    good = good & visible
    away = torch.where(good[:, None], seen - flat, torch.nan)
    sigma, ratio, probability = _judged(first, second, (flat, moved), away, torch.where(good, weight, 0.0), at, freedom)
    return CameraDifference(
        pixels=pixels,
        shift=away.reshape(pixels.shape),
        sigma=None if sigma is None else sigma.reshape(pixels.shape[:2]),
        known=(_known_errors(first) is not None, _known_errors(second) is not None),
        rotation=turn,
        translation=shift,
        at=at,
        ratio=ratio,
        probability=probability,
    )


def _known_errors(camera: Camera) -> CameraInformation | None:
    known = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
    return known if known is not None and known.lens_size > 0 else None


def _inverse_variances(first: Camera, second: Camera, pixels: Tensor, good: Tensor) -> Tensor:
    """(N,) inverse variances with mean one, zero where a camera has no ray."""
    variance = torch.zeros_like(pixels[:, 0])
    for camera in (first, second):
        if _known_errors(camera) is not None:
            variance = variance + 0.5 * pixel_covariance(camera, pixels).diagonal(dim1=-2, dim2=-1).sum(-1)
    good = good & variance.isfinite()
    typical = torch.maximum(variance[good].median(), 1e-6 * variance[good].max())
    if not float(typical) > 0:
        return good.double()
    weight = torch.where(good, 1.0 / (variance + _LEAST_SHARE * typical), 0.0)
    return weight / weight[good].mean()


def _fit(
    camera: Camera, points: Tensor, pixels: Tensor, weight: Tensor, rotation: Tensor, freedom: int
) -> tuple[Tensor, Tensor]:
    """The motion after which the camera sees points (N, 3) at pixels (N, 2): nothing, a turn, or a turn and a shift."""
    root = weight.sqrt()
    # So that a unit of the shift counts about as much as a radian.
    unit = torch.cat([torch.ones(3).double(), points.norm(dim=-1).median().expand(3)])[:, None, None]

    def look(rotation: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        seen, rows = seen_turned(camera, points, rotation, unit[3:, 0, 0] * shift if freedom == 6 else None)
        return (unit * rows * root)[:freedom].flatten(1).T, ((seen - pixels.T) * root).flatten()

    if not freedom:
        return rotation, torch.zeros(3, dtype=torch.float64)
    found = fit_turn(rotation, look, more=freedom - 3, settled=_SETTLED)
    return found.rotation, unit[3:, 0, 0] * found.more if freedom == 6 else torch.zeros(3, dtype=torch.float64)


def _judged(
    first: Camera,
    second: Camera,
    places: tuple[Tensor, Tensor],
    away: Tensor,
    weight: Tensor,
    at: float,
    freedom: int,
) -> tuple[Tensor | None, float | None, float | None]:
    """Sigma (N,) of the shift, its RMS over what is expected, and the probability of as large a shift by chance."""
    roots = []
    root = weight.sqrt()[:, None, None]
    for camera, here in zip((first, second), places, strict=True):
        if (known := _known_errors(camera)) is None:
            continue
        wanted = [index for index, slot in enumerate(known.slots) if slot >= 0]
        by_camera, by_motion, good = pixel_slopes(camera, here, at, wanted)
        by_camera = torch.where(good[:, None, None], by_camera, 0.0)
        by_motion = torch.where(good[:, None, None], by_motion, 0.0)[..., :freedom]
        if freedom:
            by_motion = by_motion / by_motion.flatten(0, 1).norm(dim=0)
            # The motion that best undoes each parameter's effect, with the weights with which motions are fitted.
            undo = torch.linalg.lstsq((root * by_motion).flatten(0, 1), (root * by_camera).flatten(0, 1)).solution
            by_camera = by_camera - by_motion @ undo
        roots.append(by_camera @ known.by_parameter(known.half())[:, wanted].T)
    if not roots:
        return None, None, None
    spread = torch.cat(roots, -1)
    sigma = largest_sigma(spread @ spread.mT)
    weighted = (root * spread).flatten(0, 1)
    gram = weighted.T @ weighted
    expected, squared = float(gram.trace()), float(gram.square().sum())
    found = float((weight[:, None] * torch.where(weight[:, None] > 0, away, 0.0).square()).sum())
    if not expected > 0:
        return sigma, None, None
    # The weighted sum of squares of normal errors has nearly a scaled χ² distribution (Satterthwaite 1946).
    scale, degrees = squared / expected, expected**2 / squared
    probability = float(chi2_tail(found / scale, degrees))
    return torch.where(weight > 0, sigma, torch.nan), math.sqrt(found / expected), probability


def difference_text(found: CameraDifference) -> list[str]:
    """What a comparison of two cameras found, one line each."""
    place = "at infinity" if math.isinf(found.at) else f"at {range_text(found.at)}"
    spread = None if found.sigma is None else found.sigma[found.sigma.isfinite()]
    typical = None if spread is None else float(spread.median())
    rms, largest = (number_text(value, typical) for value in (found.rms, found.largest))
    lines = [f"difference {place}: RMS {rms} px, largest {largest} px, over the image"]
    lines.append(f"after a turn by {number_text(found.turn_deg)}°")
    if not math.isinf(found.at):
        lines[-1] += f" and a shift by {length_text(float(found.translation.norm()))}"
    if found.ratio is None or found.probability is None or spread is None or typical is None:
        return [*lines, "no error bars in either file: whether this is more than their uncertainty cannot be said"]
    whose = "both cameras" if all(found.known) else f"the {'first' if found.known[0] else 'second'} camera alone"
    explained = (
        f"{number_text(found.ratio)} times what they predict, as large by chance with probability "
        f"{number_text(found.probability, digits=2)}"
    )
    wide = f"σ {number_text(typical, typical)} px (median), {number_text(float(spread.max()), digits=2)} px (largest)"
    verdict = "no difference beyond" if found.same else "a difference beyond"
    return [*lines, f"{verdict} the error bars of {whose}, {wide}: {explained}"]
