"""Read night images, and find stars in them."""

from __future__ import annotations

import dataclasses
import datetime
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kcal.corners.images import VIDEO_SUFFIXES, expand_images, read_gray, time_in_name
from kcal.corners.video import VideoFrames, read_frames
from kcal.errors import FileError, InputError
from kcal.files import read_bytes
from kcal.stars.sky import EARTH_RATE, StarCatalog
from kcal.texts import briefly
from kcal.values import instant

# Find stars in an image to a small part of a pixel, each with its own standard deviation.
#
# Centers are means under a Gaussian window that moves with the star (the windowed centroid of SExtractor, Bertin and
# Arnouts 1996). Points of light that are no stars are left out and counted.

# px: width of the window; stars are 0.5 to 2 px wide.
_WIDTH = 1.3
_TILE = 32
# px: below this, seeing, the sensor and the lens's color errors decide, whatever a star's brightness is.
_LEAST_SIGMA = 0.04
# Bounds of a star's variance under the window over that of the window: below a hot pixel, above a lamp or a cloud.
_NARROWEST, _WIDEST = 0.06, 0.85
# A pixel all of whose neighbors have less than this share of it did not see a star.
_LONE_PIXEL = 0.12
_LEAST_ROUND = 0.5
# px: a second star so near pulls the center.
_CROWDED = 5.0

Floats = NDArray[np.float64]


@briefly
class DetectedStars(NamedTuple):
    """Stars in an image, the brightest first.

    Attributes:
        pixels: (N, 2) centers.
        sigma: (N,) of a center along an axis, px.
        flux: (N,) gray levels over the background.
        background: median gray level of the image over the largest that its type has.
        left_out: how many points of light are no stars, or bad ones, by reason.
    """

    pixels: Floats
    sigma: Floats
    flux: Floats
    background: float
    left_out: Mapping[str, int]


def detect_stars(image: NDArray[Any], *, threshold: float = 6.0, most: int = 400) -> DetectedStars:
    """Find the stars of a night image, with the center of each and its standard deviation.

    Left out and counted by `left_out`: hot pixels, streaks (satellites, aircraft), what is wider than a star (clouds,
    lamps), saturated stars and stars beside another one.

    Args:
        image: (H, W) gray levels, integers of any depth or floating point; frames of a video may be summed.
        threshold: least signal over the noise of the smoothed image.
        most: stop after so many stars.

    Raises:
        InputError: not an image (H, W) of 16 pixels or more, or values that are not finite.

    Example:
        >>> rows, columns = np.mgrid[0:64, 0:96]
        >>> star = 400 * np.exp(-((columns - 40.25) ** 2 + (rows - 20.5) ** 2) / (2 * 1.2**2))
        >>> night = 50 + star + np.random.default_rng(0).normal(0, 2, star.shape)
        >>> detect_stars(night).pixels.round(1).tolist()
        [[40.2, 20.5]]
    """
    if image.ndim != 2 or min(image.shape) < 16:
        raise InputError(f"a gray image (H, W) of 16 pixels or more is needed, got {image.shape}")
    levels = image.astype(np.float64)
    if not np.isfinite(levels).all():
        raise InputError("the image has values that are not finite")
    integer = np.issubdtype(image.dtype, np.integer)
    full = float(np.iinfo(image.dtype).max) if integer else float(levels.max())
    level, noise = _night_sky(levels, quantum=1.0 if integer else 0.0)
    flat = levels - level
    smooth = ndimage.gaussian_filter(flat, _WIDTH)
    signal = smooth / (noise / (2 * np.sqrt(np.pi) * _WIDTH))
    half = int(np.ceil(4 * _WIDTH)) + 1
    top = (smooth == ndimage.maximum_filter(smooth, 7)) & (signal > threshold)
    at = np.argwhere(top)
    at = at[((at >= half) & (at < np.array(levels.shape) - half)).all(1)]
    at = at[np.argsort(-smooth[tuple(at.T)])][: 2 * most]
    background = float(np.median(levels)) / max(full, 1e-9)
    if not len(at):
        return DetectedStars(np.empty((0, 2)), np.empty(0), np.empty(0), background, {})
    around = np.arange(-half, half + 1)
    boxes = flat[at[:, 0, None, None] + around[:, None], at[:, 1, None, None] + around]
    shift, moments = _windowed(boxes, around)
    brightest = levels[at[:, 0, None, None] + around[:, None], at[:, 1, None, None] + around].max((1, 2))
    why = _reasons(boxes, half, shift, moments, brightest >= 0.98 * full if integer else np.zeros(len(at), bool))
    pixels = at[:, ::-1] + shift
    lone = _uncrowded(pixels, boxes.max((1, 2)))
    why = np.where((why == "") & ~lone, "beside another star", why)
    good = why == ""
    found = signal[tuple(at.T)][good]
    sigma = np.hypot(_LEAST_SIGMA, _WIDTH * np.sqrt(2.0) / found)
    distance = (around[:, None] - shift[good, 1, None, None]) ** 2 + (around - shift[good, 0, None, None]) ** 2
    flux = np.where(distance < (3 * _WIDTH) ** 2, boxes[good], 0.0).sum((1, 2))
    order = np.argsort(-flux)[:most]
    reasons, counts = np.unique(why[~good], return_counts=True)
    left_out = dict(zip(reasons.tolist(), counts.tolist(), strict=True))
    return DetectedStars(pixels[good][order], sigma[order], flux[order], background, left_out)


def _night_sky(levels: Floats, *, quantum: float) -> tuple[Floats, Floats]:
    """Level and noise (H, W) of the sky, from the medians of tiles."""
    height, width = levels.shape
    rows, columns = -(-height // _TILE), -(-width // _TILE)
    padded = np.pad(levels, ((0, rows * _TILE - height), (0, columns * _TILE - width)), mode="reflect")
    tiles = padded.reshape(rows, _TILE, columns, _TILE)
    level = np.median(tiles, (1, 3))
    spread = 1.4826 * np.median(np.abs(tiles - level[:, None, :, None]), (1, 3))
    spread = np.hypot(np.maximum(spread, 0.3 * np.median(spread)), quantum / np.sqrt(12.0))
    where = np.meshgrid(*[(np.arange(n) - (_TILE - 1) / 2) / _TILE for n in (height, width)], indexing="ij")
    even = (ndimage.median_filter(values, 3) for values in (level, spread))
    level, spread = (ndimage.map_coordinates(values, where, order=1, mode="nearest") for values in even)
    return level, np.maximum(spread, 1e-9)


def _windowed(boxes: Floats, around: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Centers (N, 2) x, y from the middle of each box, NaN without one, and variances (N, 3) xx, yy, xy."""
    shift = np.zeros((len(boxes), 2))
    moments = np.zeros((len(boxes), 3))
    with np.errstate(all="ignore"):
        for _ in range(20):
            across, down = around - shift[:, 0, None], around - shift[:, 1, None]
            window = np.exp(-(down[:, :, None] ** 2 + across[:, None, :] ** 2) / (2 * _WIDTH**2)) * boxes
            total = window.sum((1, 2))
            mean = np.stack([(window.sum(1) * across).sum(1), (window.sum(2) * down).sum(1)], 1) / total[:, None]
            bad = (total <= 0) | (np.abs(shift) > 2).any(1)
            shift = np.where(bad[:, None], np.nan, shift + 2 * mean)
            if not (np.abs(mean[~bad]).sum(1) > 1e-4).any():
                break
        across, down = around - shift[:, 0, None], around - shift[:, 1, None]
        moments[:, 0] = (window.sum(1) * across**2).sum(1) / total
        moments[:, 1] = (window.sum(2) * down**2).sum(1) / total
        moments[:, 2] = (window * down[:, :, None] * across[:, None, :]).sum((1, 2)) / total
    return shift, moments


def _reasons(
    boxes: Floats, half: int, shift: Floats, moments: Floats, saturated: NDArray[np.bool_]
) -> NDArray[np.str_]:
    """(N,) why each is not a good star; empty for those that are."""
    with np.errstate(all="ignore"):
        mean = (moments[:, 0] + moments[:, 1]) / 2
        difference = np.hypot((moments[:, 0] - moments[:, 1]) / 2, moments[:, 2])
        narrow = np.where(mean > difference, (mean - difference) / (mean + difference), 0.0)
    middle = boxes[:, half - 1 : half + 2, half - 1 : half + 2].reshape(len(boxes), 9)
    ordered = np.sort(middle, 1)
    lone = ordered[:, -2] < _LONE_PIXEL * ordered[:, -1]
    share = mean / _WIDTH**2
    # In a long exposure all stars are streaks.
    streak = narrow < min(_LEAST_ROUND, 0.5 * float(np.nanmedian(narrow[:40]))) if len(narrow) else narrow < 0
    why = np.full(len(boxes), "", dtype="<U24")
    why[~(share <= _WIDEST)] = "wider than a star"
    why[streak] = "streaks"
    why[lone | (share < _NARROWEST)] = "hot pixels"
    why[saturated & (why == "")] = "saturated"
    why[~np.isfinite(shift).all(1)] = "wider than a star"
    return why


def _uncrowded(pixels: Floats, peak: Floats) -> NDArray[np.bool_]:
    """(N,) whether no other point of light of a twentieth of the brightness or more is near."""
    from scipy.spatial import cKDTree

    index = np.flatnonzero(np.isfinite(pixels).all(1))
    pairs = index[cKDTree(pixels[index]).query_pairs(_CROWDED, output_type="ndarray")]
    first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
    alone = np.ones(len(pixels), bool)
    alone[first[peak[second] > 0.05 * peak[first]]] = False
    return alone


# Read night images: ordinary image files of 8 or 16 bits, FITS, and videos whose frames are summed.

FITS_SUFFIXES = frozenset({".fits", ".fit", ".fts"})
# Of a video: more frames show no more stars than drift blurs.
_MOST_FRAMES = 100


def read_night(path: str | Path) -> NDArray[Any]:
    """Read the gray levels (H, W) of a night image, of a FITS file, or the mean of a video's frames.

    Raises:
        FileError: missing, or not such a file.
        InputError: a FITS file without astropy.
    """
    suffix = Path(path).suffix.lower()
    if suffix in FITS_SUFFIXES:
        return _read_fits(Path(path))
    if suffix not in VIDEO_SUFFIXES:
        return read_gray(path)
    total: Any = 0.0
    count = 0
    for frame in itertools.islice(read_frames(path), _MOST_FRAMES):
        total, count = total + np.asarray(frame.image, np.float64), count + 1
    if not count:
        raise FileError(f"{path}: the video has no frames")
    return total / count


def _read_fits(path: Path) -> NDArray[Any]:
    try:
        from astropy.io import fits  # type: ignore[import-not-found, unused-ignore]
    except ImportError as error:
        raise InputError(
            f"{path}: FITS files need astropy (pip install astropy); or convert it to PNG of 16 bits"
        ) from error
    import io

    try:
        with fits.open(io.BytesIO(read_bytes(path))) as parts:
            image = next((part.data for part in parts if part.data is not None and part.data.ndim == 2), None)
    except (OSError, ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:  # of a damaged header
        raise FileError(f"{path}: not a FITS file that can be read: {error}") from error
    if image is None:
        raise FileError(f"{path}: no image (H, W) in this FITS file")
    if bad := int((~np.isfinite(image)).sum()):
        raise FileError(f"{path}: {bad} pixels are no finite numbers; fill them with the gray level around them")
    # Row 0 of a FITS image is the lowest.
    return np.asarray(image[::-1], np.float64)


def expand_nights(inputs: list[str]) -> list[Path]:
    """The files that files, folders and wildcards stand for, as `expand_images`, and FITS and video files."""
    found: list[Path] = []
    for one in inputs:
        other = Path(one).suffix.lower() in FITS_SUFFIXES | VIDEO_SUFFIXES and Path(one).is_file()
        found += [Path(one)] if other else expand_images([one])
    return list(dict.fromkeys(found))


def time_of(text: str | None, path: Path) -> datetime.datetime | None:
    """When an image was taken: `text` itself, or what its name says where the text is `name:Z` or `name:+02:00`.

    What is told is the middle of the exposure. Of a video it is the first frame, and what comes back is the middle of
    the frames that are summed.

    Raises:
        InputError: no zone, a name without a time, or one with another zone.

    Example:
        >>> time_of("name:Z", Path("2019-07-29T204726_Alt40.png")).isoformat()
        '2019-07-29T20:47:26+00:00'
    """
    if text is None:
        return None
    kind, _, zone = text.partition(":")
    if kind != "name":
        return instant(text, "time") + _to_middle(path)
    if not zone:
        raise InputError("--time name: say the zone of the times in the names, name:Z for UTC or name:+02:00")
    found = time_in_name(path.name)
    if found is None:
        raise InputError(f"{path.name}: no time in this name; it should be like 2026-11-24T204726")
    time = instant(f"{found.replace(tzinfo=None).isoformat()}{zone}", "time")
    if found.tzinfo is not None and found != time:
        raise InputError(f"{path.name}: the zone in this name is not that of --time {text}")
    return time + _to_middle(path)


def _to_middle(path: Path) -> datetime.timedelta:
    """From the first frame that `read_night` sums to the middle of them."""
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        return datetime.timedelta(0)
    frames = VideoFrames(path)
    if not 0 < frames.rate < math.inf:
        raise FileError(f"{path}: the video does not say how many frames a second it has; write one as PNG")
    return datetime.timedelta(seconds=0.5 * (min(frames.count, _MOST_FRAMES) - 1) / frames.rate)


# How many stars a camera will see, how well, and what range error follows: before anyone climbs the mast.
#
# A photometric model, not a measurement: it is probably a magnitude too cautious.

# Electrons a second and cm² of a star of magnitude 0: silicon, 400 to 900 nm, behind color filters and glass.
_ELECTRONS = 1.0e6
_READ, _DARK = 2.0, 1.0  # electrons, and electrons a second, of a pixel
_PSF, _PLANNED_SIGMA = 1.0, 0.05  # px
_LEAST_SIGNAL = 7.0
_EXTINCTION = 0.25  # magnitudes for each thickness of the atmosphere
_ARCSECONDS = 206265.0
# Strips of the image, each with its own altitude, and the lowest altitude at which stars are used, degrees.
_STRIPS, _LOWEST = 9, 5.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class NightPlan:
    """A camera and its exposure under a sky.

    Args:
        focal_px: focal length.
        size: of the image, px.
        aperture_mm: diameter of the entrance pupil: the focal length over the f-number.
        seconds: exposure.
        sky_magnitude: brightness of a square second of arc: 21.5 dark, 20.5 rural, 18 suburb.
        altitude_deg: of the middle of the image; 0: level, so that half of it sees the ground.

    Example:
        >>> NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=2.9).seconds
        1.0
    """

    focal_px: float
    size: tuple[int, int]
    aperture_mm: float
    seconds: float = 1.0
    sky_magnitude: float = 20.5
    altitude_deg: float = 0.0

    def __post_init__(self) -> None:
        if not (self.focal_px > 0 and min(self.size) > 0 and self.aperture_mm > 0 and self.seconds > 0):
            raise InputError("night: focal length, size, aperture and exposure must be positive")
        if not (0 <= self.altitude_deg <= 90 and 10 <= self.sky_magnitude <= 23):
            raise InputError("night: an altitude of 0 to 90 degrees and a sky of magnitude 10 to 23 are needed")


class PlannedStars(NamedTuple):
    """How many stars a plan shows, and how well they tell the relative yaw.

    Attributes:
        stars: in an image, on average over the sky.
        faintest: magnitude.
        sigma_px: of a star along an axis, median.
        trail_px: by which a star on the equator moves during the exposure.
        yaw_sigma: radians, of the relative yaw from one pair of images.
    """

    stars: float
    faintest: float
    sigma_px: float
    trail_px: float
    yaw_sigma: float

    def range_share(self, distance: float, baseline: float, pairs: int = 1, clock_sigma: float = 0.0) -> float:
        """Standard deviation of a range over the range: from stars and the clock; lens and marks come on top."""
        return distance / baseline * math.hypot(self.yaw_sigma / math.sqrt(pairs), EARTH_RATE * clock_sigma)


def planned_stars(plan: NightPlan) -> PlannedStars:
    """How many stars of the catalog an image will show, and how well they determine the relative yaw.

    Example:
        >>> found = planned_stars(NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=2.9))
        >>> 20 < found.stars < 120
        True
    """
    magnitude = np.sort(StarCatalog.bundled().magnitude)
    pixel = _ARCSECONDS / plan.focal_px
    trail = 15.04 * plan.seconds / pixel
    width, height = plan.size
    # The solid angle of the image, of a lens without distortion.
    half = width / 2 / plan.focal_px, height / 2 / plan.focal_px
    share = math.asin(half[0] * half[1] / math.hypot(1, half[0]) / math.hypot(1, half[1])) / math.pi / _STRIPS
    stars, weight, faintest = 0.0, 0.0, -math.inf
    sigmas: list[NDArray[np.float64]] = []
    for strip in range(_STRIPS):
        up = math.degrees(math.atan(half[1] * (1 - (2 * strip + 1) / _STRIPS)))
        altitude = min(plan.altitude_deg + up, 90.0)
        if altitude < _LOWEST:
            continue
        air = 1.0 / (math.sin(math.radians(altitude)) + 0.50572 * (altitude + 6.07995) ** -1.6364)
        signal, sigma = _signal(plan, magnitude, air, pixel, trail)
        seen = signal > _LEAST_SIGNAL
        stars += share * float(seen.sum())
        weight += share * float((sigma[seen] ** -2.0).sum())
        faintest = max(faintest, float(magnitude[seen].max(initial=-math.inf)))
        sigmas.append(sigma[seen])
    if not stars:
        return PlannedStars(0.0, -math.inf, math.nan, trail, math.inf)
    # Of a pair: both cameras' noise.
    yaw = math.sqrt(2.0 / weight) / plan.focal_px
    return PlannedStars(stars, faintest, float(np.median(np.concatenate(sigmas))), trail, yaw)


def _signal(
    plan: NightPlan, magnitude: NDArray[np.float64], air: float, pixel: float, trail: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Signal over noise, and the sigma of a center along an axis, px."""
    area = math.pi / 4 * (plan.aperture_mm / 10) ** 2
    star = _ELECTRONS * area * plan.seconds * 10 ** (-0.4 * (magnitude + _EXTINCTION * air))
    sky = _ELECTRONS * area * plan.seconds * 10 ** (-0.4 * (plan.sky_magnitude - 5 * math.log10(pixel)))
    along = math.hypot(_PSF, trail / math.sqrt(12))
    pixels = 4 * math.pi * _PSF * along
    signal = star / np.sqrt(star + pixels * (sky + _DARK * plan.seconds + _READ**2))
    # Image motion in a small aperture.
    seeing = 2.0 * air**0.6 / math.sqrt(1 + plan.seconds / 0.1) / pixel
    return signal, np.sqrt(_PLANNED_SIGMA**2 + (1.2 * along / signal) ** 2 + seeing**2)
