"""Cameras whose numbers have names: what keys mean in files of OpenCV, ROS, SLAM programs and tutorials.

Names are compared without case and punctuation. A key that nobody read and that may describe the lens, by its name or
its shape, refuses the file: a lens must not become another one because a key is spelled unlike others.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch.nn.functional import pad

import kcal.io.foreign as foreign
from kcal.io.foreign_lenses import foreign_camera, nearest_hybrid
from kcal.lens.camera import Camera
from kcal.lens.camera_conversions import OPENCV_MODELS, ImageTransform
from kcal.lens.pose import Pose, rotation_from_vector

_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# The same as vikit calls them (SVO, FAST-LIVO).
_COUNTED = ("d0", "d1", "d2", "d3", "d4")
_COEFS = "(?:coef+s?|coef+icients?|param(?:eter)?s?|vec(?:tor)?)"
_IMAGE = "(?:image|img|frame|gray)?"
_MATRIX = "(?:intrinsics?)?(?:matrix|mtx|mat)"
_LENS, _DEVIATIONS = f"(?:lens)?dist(?:ort|ortion)?s?{_COEFS}?", "std(?:ard)?dev(?:iation)?s?"
# Names and how many numbers belong to them; -1 for a text or a switch.
_ROLES: dict[str, tuple[str, Sequence[int]]] = {
    "matrix": (f"{_MATRIX}|intrinsics?(?:param(?:eter)?s?)?|kk?|m|cm|a", (4, 9)),
    "lens": (f"{_LENS}|coef+(?:icient)?s?|d|kc", range(15)),
    "width": (f"{_IMAGE}(?:width|w)|imagecols", (1,)),
    "height": (f"{_IMAGE}(?:height|h)|imagerows", (1,)),
    "size": (f"{_IMAGE}(?:size|resolution|dims?|dimensions?)", (2,)),
    "kind": ("(?:lens|distortion|dist|projection|calib(?:ration)?|opencv)?(?:model|type|modeltype|modelname)", (-1,)),
    "fisheye": ("(?:is|use)?fisheye(?:model)?", (-1, 1)),
    "sigmas": (f"{_DEVIATIONS}(?:intrinsics)?", range(4, 19)),
    # As OpenCV's interactive calibration has them.
    "matrix_sigmas": (f"{_MATRIX}{_DEVIATIONS}", (4,)),
    "lens_sigmas": (f"{_LENS}{_DEVIATIONS}", range(4, 15)),
    "rotation": ("(?:stereo)?(?:r|rot(?:ation)?(?:matrix|mat|vector|vec)?|rmat|rvec)", (3, 9)),
    "translation": ("(?:stereo)?(?:t|trans(?:lation)?(?:vector|vec)?|tvec)", (3,)),
    # ORB-SLAM3's first camera from the second, OKVIS's body from a camera, and MC-Calib's first camera from one.
    "second": ("(?:stereo)?tc1c2|tlr", (12, 16)),
    "body": ("tsc|(?<=camera)posematrix", (16,)),
    "binning_x": ("binningx?", (1,)),
    "binning_y": ("binningy", (1,)),
    "roi": ("roi|regionofinterest", (-1,)),
    "fx": ("fx|flx|fu|focal(?:length)?x|gamma1|mu", (1,)),
    "fy": ("fy|fly|fv|focal(?:length)?y|gamma2|mv", (1,)),
    "f": ("f|fc|focal(?:length)?", (1, 2)),
    "center": ("cc|pp|center|principalpoint", (2,)),
    "cx": ("cx|cu|u0|ppx|(?:principal(?:point)?|center)x", (1,)),
    "cy": ("cy|cv|v0|ppy|(?:principal(?:point)?|center)y", (1,)),
    **{name: (name, (1,)) for name in ("xi", "alpha", "skew", *_COEFFICIENTS, *_COUNTED)},
}
_PATTERNS = {role: re.compile(f"(?:cam(?:era)?)?(?:{names})") for role, (names, _) in _ROLES.items()}
_AFTER = re.compile(r"(.+?)(left|right|l|r|(?:cam(?:era)?)?[0-9]{1,3})")
# Lenses of OpenCV, its fisheye, what both may be called, and lenses that are neither.
_PLAIN = re.compile(
    "plumbbob|rational(?:polynomial)?|radtan8?|radialtangential|brown(?:conrady)?|opencv[0-9]*|standard|normal|thinprism|tilted"
    "|rectilinear"
)
_FISHEYE = re.compile("(?:(?:open)?cv2?)?fisheye(?:opencv)?|equi(?:distant)?|kannalabrandt[48]?|kb[48]?")
_EITHER = re.compile("|none|null|generic|pinhole|perspective|camera|mono|monocular|stereo|central|rectified")
# What is no name of a lens may be that of a product, or of a way to calibrate.
_LOOSE = re.compile("(?:camera|calib(?:ration)?|opencv)?(?:type|model)")
_FOREIGN = re.compile(
    ".*(fish|omni|spher|ucm|mei|fov|atan|divis|scara|ocam|poly|radial|prism|cahv|pano|equi|ortho|unified|brown)|ds|kb"
)
_OMNI = re.compile("omni(?:dir|directional)?|mei")
# Of RealSense, as `_realsense_lens` calls them; without distortion where all coefficients are zero.
_REALSENSE = {"inversebrownconrady": "inverse", "modifiedbrownconrady": "modified_brown_conrady", "ftheta": "fov"}


def _role(key: str, value: Any) -> tuple[str, str] | None:
    """What a key of a camera means, and the side of the rig that it names."""
    name, found = foreign.bare(key), foreign.flat(value)
    count = len(found) if found is not None else -1
    many = isinstance(value, list | tuple | Mapping) or hasattr(value, "tolist")
    before, after = foreign.BEFORE.fullmatch(name), _AFTER.fullmatch(name)
    ways = [(name, ""), (before and before[2], before and before[1]), (after and after[1], after and after[2])]
    for base, side in ways:
        for role, pattern in _PATTERNS.items():
            # A distance is one number; no list of coefficients is.
            if base and count in _ROLES[role][1] and pattern.fullmatch(base) and (role != "lens" or many or count > 1):
                return role, re.sub("cam(?:era)?|(?<=[lr])(?:eft|ight)", "", side or "")
    return None


class _Named:
    """Values of cameras by (role, side), with the key of each."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self.keys, self.at = foreign.Keys(content), dict[tuple[str, str], str]()
        for key, value in content.items():
            role = _role(key, value)
            if role is None or (role[0] == "kind" and not isinstance(value, str)):
                continue
            if (other := self.at.get(role)) is not None and role[0] not in ("kind", "rotation", "translation"):
                if foreign.flat(content[other]) != foreign.flat(value):
                    raise ValueError(f"{other} and {key} are both there and differ; delete the one that is not meant")
                self.keys[key]
            self.at.setdefault((f"kind {key}", role[1]) if role[0] == "kind" else role, key)

    def get(self, role: str, side: str = "") -> Any:
        """The value for a side, else the one for all sides; None if there is neither."""
        key = self.at.get((role, side)) or self.at.get((role, ""))
        return None if key is None else self.keys[key]

    def key(self, role: str, side: str) -> str:
        """The key of that value in the file."""
        return self.at.get((role, side)) or self.at.get((role, ""), role)

    def number(self, role: str, side: str, otherwise: float = 0.0) -> float:
        """The value as a number; `otherwise` if there is none."""
        found = self.get(role, side)
        return otherwise if found is None else foreign.numbers(found, 1, self.key(role, side))[0]

    def size(self, side: str) -> tuple[int, int] | None:
        """(width, height) as stated."""
        both = [self.get("width", side), self.get("height", side)]
        if None in both:
            both = self.get("size", side)
        return None if both is None else foreign.whole_size(*foreign.numbers(both, 2, "the image size"))

    def core(self, side: str) -> tuple[list[float], float]:
        """fx, fy, cx, cy, and the skew in the matrix."""
        if (matrix := self.get("matrix", side)) is not None:
            found, key = foreign.flat(matrix) or [], self.key("matrix", side)
            # Four numbers that are called intrinsics are fx, fy, cx, cy.
            four = len(found) == 4 and "intrin" in foreign.bare(key)
            core, skew = (found, 0.0) if four else foreign.core_of(found, key)
            self.agrees(("fx", "fy", "cx", "cy"), core, side, key)
            return core, skew
        focal, center = (foreign.flat(self.get(role, side)) or [] for role in ("f", "center"))
        fx = self.number("fx", side, *focal[:1])
        found = [fx, self.number("fy", side, *focal[1:] or [fx])]
        found += [self.number(name, side, *center[i : i + 1] or [math.nan]) for i, name in enumerate(("cx", "cy"))]
        if missing := [name for name, value in zip(("cx", "cy"), found[2:], strict=True) if math.isnan(value)]:
            raise ValueError(f"{' and '.join(missing)} of the principal point are missing")
        return found, 0.0

    def agrees(self, names: Sequence[str], values: Sequence[float], side: str, key: str) -> None:
        """Refuse numbers that the file states a second time, each by its name, if they differ."""
        for name, value in zip(names, values, strict=False):
            if (name, side) in self.at and abs(self.number(name, side) - value) > 1e-6 * abs(value):
                raise ValueError(f"{key} and {self.key(name, side)} are both there and differ; delete the one that is "
                                 "not meant")  # fmt: skip

    def kind(self, side: str, fisheye: bool | None, notes: list[str]) -> bool | str | None:
        """Whether the lens is a fisheye's, or the name of one of RealSense's; None if the file does not say.

        Raises:
            ValueError: a lens that is neither, or keys that contradict each other.
        """
        said: dict[bool, str] = {}
        bent = any(foreign.flat(self.get("lens", side)) or [])
        for (role, where), key in self.at.items():
            if where not in ("", side) or role.split()[0] not in ("kind", "fisheye"):
                continue
            value = self.keys[key]
            text = re.sub("^(?:(?:rs2)?distortion|lensmodel)|(?<=.)camera$", "", foreign.bare(value))
            if role == "fisheye":
                said[value not in (0, "0", "no", "No") and text not in ("false", "00")] = key
            elif text in _REALSENSE and bent and fisheye is None:
                return _REALSENSE[text]
            elif _FISHEYE.fullmatch(text) or _PLAIN.fullmatch(text) or text in _REALSENSE:
                said[bool(_FISHEYE.fullmatch(text))] = f"{key} {value}"
            elif text in ("none", "null") and bent:
                raise ValueError(f"{key} {value}, but there are coefficients that are not zero; delete one of them")
            elif _EITHER.fullmatch(text) or (_OMNI.fullmatch(text) and ("xi", side) in self.at) or fisheye is not None:
                continue
            elif _LOOSE.fullmatch(foreign.bare(key)) and not _FOREIGN.match(text):
                notes.append(f"{key} {value}: no name of a lens model; not read")
            else:
                raise ValueError(
                    f"{key} {value}: kcal reads plumb_bob, rational_polynomial, radtan, equidistant, fisheye and none; "
                    "if this is no name of a lens model, say --fisheye or --no-fisheye"
                )
        if len(said) == 2 and fisheye is None:
            raise ValueError(f"{' and '.join(said.values())} contradict each other: say --fisheye or --no-fisheye")
        return fisheye if fisheye is not None else next(iter(said), None)


def has_camera(content: Mapping[str, Any]) -> bool:
    """Whether keys of a mapping name a camera's matrix or focal length."""
    return any(role is not None and role[0] in ("matrix", "fx", "f") for role in map(_role, content, content.values()))


def speaks_of_camera(text: str) -> bool:
    """Whether a text has such keys at the beginning of its lines."""
    names = map(foreign.bare, re.findall(r"^[ \t\"'{-]*+([A-Za-z][\w. -]{0,40}?)[\"']?[ \t]*[:=]", text, re.MULTILINE))
    return any(
        pattern.fullmatch(base)
        for name in names
        for base in (name, (foreign.BEFORE.fullmatch(name) or ("", "", ""))[2], (_AFTER.fullmatch(name) or ("", ""))[1])
        for pattern in (_PATTERNS["matrix"], _PATTERNS["fx"])
    )


def read_keyed(content: Mapping[str, Any], name: str, hints: foreign.Hints, title: str) -> foreign.ImportedCameras:
    """Read the cameras of a mapping: one, several whose keys name a side, or those of mappings inside it.

    Poses are those of each camera, or R and T of the second one of two.

    Raises:
        ValueError: no camera, a lens that kcal does not have, or keys that it does not know.
    """
    notes: list[str] = []
    inside, outer = _cameras_inside(content)
    if inside:
        named, shared = _Named(_flattened(outer)), _for_all(outer)
        named.keys.read.update(shared)
        parts = {
            str(part.get("name") or part.get("camera_name") or (key if len(inside) > 1 else name)): (
                _Named(_with_shared(shared, part)), "",
            )
            for key, part in inside.items()
        }  # fmt: skip
        if len(parts) == 2 and named.get("rotation") is not None:
            # R and T are of the right or second camera, wherever that one stands in the file.
            if len({re.sub("left|right|[lr]$|[0-9]+$", "", label.lower()) for label in parts}) == 1:
                parts = dict(sorted(parts.items()))
            else:
                notes.append("R and T are taken as those of {1} from {0}".format(*parts))
    else:
        named = _Named(_flattened(content))
        sides = sorted({side for role, side in named.at if role in ("matrix", "fx", "f")}, key=lambda one: one.zfill(3))
        labels = ["left", "right"] if len(sides) == 2 else [
            {"l": "left", "r": "right"}.get(side, f"camera{side}") for side in sides
        ]  # fmt: skip
        parts = {label if len(sides) > 1 else name: (named, side) for label, side in zip(labels, sides, strict=True)}
    cameras, refused = foreign.each_readable(
        (label, partial(_camera, *part, label, hints, notes, "fish" in str(content).lower()))
        for label, part in parts.items()
    )
    poses = _poses(named, list(parts.values()), hints, notes)
    if not parts and not poses:
        named.keys.rest()
        needed = "a matrix (camera_matrix, K, M1, ...), or fx, fy, cx and cy, is needed"
        raise ValueError(f"no camera: {needed}; corners are read with --board")
    if cameras and len(poses) == len(parts):
        poses = tuple(pose for pose, label in zip(poses, parts, strict=True) if label not in refused)
    for whole in {id(part): part for part, _ in [*parts.values(), (named, "")]}.values():
        notes += whole.keys.rest()
    return foreign.ImportedCameras(
        format=title, cameras=cameras, poses=poses, notes=tuple(dict.fromkeys(notes)), unread=refused
    )


_SIZES, _KINDS = ("width", "height", "size"), ("kind", "fisheye")


def _for_all(content: Mapping[str, Any], roles: Sequence[str] = (*_SIZES, *_KINDS)) -> dict[str, Any]:
    """What a mapping says of all cameras inside it."""
    found = {key: _role(key, value) for key, value in content.items()}
    return {key: content[key] for key, role in found.items() if role is not None and role[0] in roles}


def _with_shared(shared: Mapping[str, Any], part: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a camera, with those of all cameras; a size of its own is in place of theirs."""
    own = _flattened(part)
    return _for_all(shared, _KINDS if _for_all(own, _SIZES) else (*_SIZES, *_KINDS)) | own


def _cameras_inside(content: Mapping[str, Any]) -> tuple[dict[str, Mapping[str, Any]], dict[str, Any]]:
    """Mappings in it, in its `cameras` or deeper, that have a camera each; and what else there is."""
    if has_camera(content):
        return {}, dict(content)
    outer, found = dict(content), dict[str, Mapping[str, Any]]()
    listed: Any = next((outer.pop(key) for key in list(outer) if foreign.bare(key) == "cameras"), {})
    if isinstance(listed, list):
        listed = {str(i): part for i, part in enumerate(listed)}
    listed = listed if isinstance(listed, Mapping) else {}
    for key, part in (outer | listed).items():
        if not isinstance(part, Mapping) or "data" in part:
            continue
        deeper, rest = _cameras_inside(part)
        # Blocks such as `projection_parameters` are parts of one camera.
        whole = key in listed or not re.search("param|intrin|proj", foreign.bare(key))
        if len(deeper) < 2 and whole and has_camera(_flattened(part)):
            found[str(key)] = part
            outer.pop(key, None)
        elif deeper:
            shared = _for_all(rest)
            found |= {f"{key} {name}": _with_shared(shared, one) for name, one in deeper.items()}
            outer[key] = {name: value for name, value in rest.items() if name not in shared}
    return found, outer


def _flattened(content: Mapping[str, Any]) -> dict[str, Any]:
    """With the keys of the mappings inside it, such as `projection_parameters` of camodocal."""
    found: dict[str, Any] = {}
    for key, value in content.items():
        block = isinstance(value, Mapping) and "data" not in value and _role(key, value) is None
        # A board has a size, too.
        block = block and not re.search("object|board|chess|pattern|target|marker", foreign.bare(key))
        inner = value if block and any(map(_role, value, value.values())) else {key: value}
        if twice := [one for one in inner if one in found and str(found[one]) != str(inner[one])]:
            raise ValueError(f"{min(twice)} is there twice, in {key} and elsewhere; kcal cannot tell which is meant")
        found |= inner
    if len(foreign.flat(found.get("cameraExtrinsics")) or []) in (5, 8) and "cameraIntrinsics" in found:
        found["distCoeffs"] = found.pop("cameraExtrinsics")  # as older files of PhotonVision call it
    if "mu" in found and "k5" in found:
        # camodocal counts the coefficients of its fisheye from k2.
        found = {f"k{int(key[1]) - 1}" if re.fullmatch("k[2-5]", key) else key: value for key, value in found.items()}
    if "camera_pose_matrix" in found and (number := found.get("distortion_type")) in (0, 1):
        found["distortion_type"] = "fisheye" if number else "radtan"  # as MC-Calib counts lenses
    return found


def _camera(
    named: _Named, side: str, name: str, hints: foreign.Hints, notes: list[str], speaks_of_fisheye: bool
) -> Camera:
    stated_size = named.size(side)
    size = foreign.known_size(hints.size or stated_size)
    core, skew = named.core(side)
    matrix = named.key("matrix", side)
    fisheye = named.kind(side, hints.fisheye, notes)
    stated, xi = named.get("lens", side), named.number("xi", side)
    # A switch of VINS that says fisheye is one for its mask.
    order = ("k1", "k2", "k3", "k4") if fisheye is True and not xi else _COEFFICIENTS
    lens = _coefficients(named, side, order) if stated is None else (foreign.flat(stated) or [])
    key = named.key("lens", side) if stated is not None else "the coefficients k1, k2, p1, p2"
    named.agrees(order, lens, side, key)
    if isinstance(fisheye, str):
        plain = foreign.named_camera(name, core, size, "pinhole")
        return _realsense_lens(fisheye, plain, foreign.numbers(lens, 5, key), notes)
    if fisheye and len(lens) > 4 and not any(lens[4:]):
        lens = lens[:4]
    if ("xi", side) in named.at and ("alpha", side) in named.at and not any(lens):
        return foreign_camera("ds", name, core, size, [xi, named.number("alpha", side)], notes, skew)
    if xi:
        if len(lens) != 4:
            raise ValueError(f"an omnidir camera has 4 coefficients, {key} has {len(lens)}")
        return foreign_camera("omni-radtan", name, core, size, [xi, *lens], notes, skew)
    if fisheye and lens and len(lens) != 4:
        raise ValueError(f"a fisheye has 4 coefficients, {key} has {len(lens)}")
    lens = foreign.numbers(lens, (4,) if fisheye and lens else tuple(OPENCV_MODELS), key)
    if fisheye is None and len(lens) == 4 and stated is not None:
        # OpenCV's other calibrations fit no skew.
        if skew or speaks_of_fisheye:
            why = f"{matrix} has a skew" if skew else "the file speaks of a fisheye"
            raise ValueError(f"{key} may be k1 k2 p1 p2, or k1 to k4 of a fisheye, and {why}: say --fisheye or "
                             "--no-fisheye")  # fmt: skip
        notes.append("4 coefficients read as k1 k2 p1 p2; if they are a fisheye's, use --fisheye")
    if (
        stated is None
        and fisheye is None
        and ("k4", side) in named.at
        and not any((one, side) in named.at for one in ("p1", "p2", "k5", "k6"))
    ):
        raise ValueError("k1 to k4 without p1 and p2 may be a fisheye's, or those of a rational lens: say --fisheye or "
                         "--no-fisheye")  # fmt: skip
    if not lens:
        notes.append(f"{name}: no coefficients of a lens in the file; read as one without distortion")
    if skew and not fisheye:
        notes.append(f"{matrix} has a skew of {skew:g}, which OpenCV does not use and kcal does not take over")
        skew = 0.0
    skew = skew or named.number("skew", side)
    model = "fisheye4" if fisheye else OPENCV_MODELS[len(lens)]
    camera = foreign.named_camera(name, core, size, model, lens or [0.0] * 4 * bool(fisheye), skew)
    if sigmas := _stated_sigmas(named, side, core, len(lens)):
        notes.append(foreign.with_sigmas(camera, sigmas))
    return camera if hints.size else _delivered(named, side, camera, notes)


def _stated_sigmas(named: _Named, side: str, core: Sequence[float], coefficients: int) -> list[float]:
    """Standard deviations of fx, fy, cx, cy and the coefficients; none if the file has none."""
    if not side and (whole := named.get("sigmas")) is not None:
        # OpenCV always states those of 14 coefficients.
        return foreign.numbers(whole, (4 + coefficients, 18), named.key("sigmas", side))[: 4 + coefficients]
    first, rest = (foreign.flat(named.get(role, side)) or [] for role in ("matrix_sigmas", "lens_sigmas"))
    if not first:
        return []
    # One focal length is stated once.
    return [first[0] or first[1] * (core[0] == core[1]), *first[1:], *(rest or [0.0] * coefficients)]


def _realsense_lens(kind: str, like: Camera, lens: list[float], notes: list[str]) -> Camera:
    """A lens of librealsense: its inverse one says where the ray of a distorted point is, as its documentation says."""
    name = foreign.camera_name(like, "camera")
    if kind != "inverse":
        if kind == "fov" and any(lens[1:]):
            raise ValueError("ftheta with more than one coefficient, which is not RealSense's: kcal does not read it")
        own = lens[:1] if kind == "fov" else lens
        return foreign_camera(kind, name, like.params[:4].tolist(), like.size, own, notes)
    straight = Camera.build(focal=(1, 1), center=(0, 0), size=(2, 2), coefficients=lens, model="opencv5")

    def rays(pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found, good = straight.project(pad(like.normalize(pixels)[0], (0, 1), value=1.0))
        return pad(found, (0, 1), value=1.0), good

    camera = nearest_hybrid(rays, like, "its inverse_brown_conrady lens", notes)
    corner = torch.tensor(like.size, dtype=torch.float64)[None] - 1.0
    off = 2.0 * float((like.project(rays(corner)[0])[0] - corner).norm())
    notes.append(f"{name}: inverse_brown_conrady is read as RealSense documents it, from distorted points to rays; "
                 "librealsense computes it as modified_brown_conrady since version 2.45, some "
                 f"{off:.2g} px away in a corner: write that name into the file if it is meant")  # fmt: skip
    return camera


def _coefficients(named: _Named, side: str, order: Sequence[str]) -> list[float]:
    """Those that have a name each: OpenCV's first 0, 4, 5 or 8, or the four of a fisheye."""
    order = order if named.get("d0", side) is None else _COUNTED
    stated = [named.number(name, side) for name in order]
    last = max((i + 1 for i, name in enumerate(order) if named.get(name, side) is not None), default=0)
    return stated[: next(count for count in (0, 4, 5, 8) if count >= last)]


def _delivered(named: _Named, side: str, camera: Camera, notes: list[str]) -> Camera:
    """The camera of the images that are delivered, of which ROS states the window of the sensor and the binning."""
    width, height = camera.size
    bins = [int(max(1.0, named.number(f"binning_{axis}", side, 1.0))) for axis in "xy"]
    roi = named.get("roi", side)
    roi = roi if isinstance(roi, Mapping) else {}
    left, top, wide, high = (int(roi.get(key, 0)) for key in ("x_offset", "y_offset", "width", "height"))
    wide, high = (wide or width - left) // bins[0], (high or height - top) // bins[1]
    if (wide, high) == (width, height):
        return camera
    images = f"the delivered images of {wide}x{high} px, part of {width}x{height} px in bins of {bins[0]}x{bins[1]}"
    fx, fy, cx, cy, skew, *lens = camera.params.tolist()
    if abs(cx / wide - 0.5) + abs(cy / high - 0.5) < 0.1 < abs(cx / width - 0.5) + abs(cy / height - 0.5):
        notes.append(
            f"the principal point ({cx:g}, {cy:g}) is in the middle of {images}: taken as that of these images"
        )
        name = foreign.camera_name(camera, "")
        return foreign.named_camera(name, (fx, fy, cx, cy), (wide, high), camera.model, lens, skew)
    notes.append(f"the camera is that of {images}")
    cut = camera.cropped(left, top, (wide * bins[0], high * bins[1]))
    return cut.transformed(ImageTransform.resize(cut.size, (wide, high)))


def _poses(
    named: _Named, parts: Sequence[tuple[_Named, str]], hints: foreign.Hints, notes: list[str]
) -> tuple[Pose, ...]:
    """Of each camera, or of the second one of two from the first."""
    meters = hints.meters or 1.0
    if len({str(part.keys.get("camera_group")) for part, _ in parts if part is not named}) > 1:
        notes.append("camera_group: the cameras are not of one group, and have no common frame: no pose is read")
        return ()
    each = [part is not named and (part.get("body", side) is not None or
            (part.get("rotation", side) is not None and part.get("translation", side) is not None))
            for part, side in parts]  # fmt: skip
    if each and all(each):
        poses = [_pose_of_keys(part, side, meters) for part, side in parts]
    elif len(parts) in (0, 2) and named.get("rotation") is not None and named.get("translation") is not None:
        poses = [Pose.still(), _pose_of_keys(named, "", meters)]
    elif len(parts) == 2 and named.get("second") is not None:
        poses = [Pose.still(), _inverse_of(named, "second", "", meters)]
    else:
        if any(each):
            notes.append("some cameras have no rotation: no pose is read")
        return ()
    longest = max(float(pose.translation.norm()) for pose in poses)
    if hints.meters is None and longest > 0:
        notes.append(f"the unit of the translation is not in the file: taken as meters, {longest:.4g} m "
                     "(--unit mm for millimeters, --unit cm for centimeters)")  # fmt: skip
    return tuple(poses)


def _pose_of_keys(named: _Named, side: str, meters: float) -> Pose:
    if named.get("body", side) is not None:
        return _inverse_of(named, "body", side, meters)
    turn = foreign.numbers(named.get("rotation", side), (3, 9), named.key("rotation", side))
    if len(turn) == 3 and (angle := math.hypot(*turn)) > 2.0 * math.pi:
        raise ValueError(f"{named.key('rotation', side)} is a turn by {angle:.4g} rad, more than a whole one: is it in "
                         "degrees? Radians are needed")  # fmt: skip
    rotation = foreign.plain(rotation_from_vector(torch.tensor(turn, dtype=torch.float64))) if len(turn) == 3 else turn
    shift = foreign.numbers(named.get("translation", side), 3, named.key("translation", side))
    return foreign.checked_pose(rotation, [meters * value for value in shift])


def _inverse_of(named: _Named, role: str, side: str, meters: float) -> Pose:
    pose = foreign.pose_of(named.get(role, side), named.key(role, side)).inverse()
    return Pose(pose.rotation, meters * pose.translation)
