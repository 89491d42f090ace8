"""Write tests/promises/accept.txt: which pixel shows which ray, by OpenCV, mrcal, and arithmetic with fractions.

    python -m scripts.make_accept_lines                                 # all but mrcal's, whose lines are kept
    KCAL_MRCAL=/usr/bin/python3 python -m scripts.make_accept_lines     # mrcal's too, from a Python that has it

A reader can check the table without Python: each line names where its numbers come from. Lines "by hand" are written
here, with their arithmetic; they are the first. None of the numbers is computed by kcal.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from scripts.shared.children import interpreter

TABLE = Path(__file__).parents[1] / "tests" / "promises" / "accept.txt"
HEAD = """\
# Which pixel shows which ray: cases that kcal accepts only if both directions hold.
#
# camera NAME | model, width x height, fx fy cx cy | coefficients by name
# NAME | pixel u v | ray x y z | tolerance, px | source
#
# Pixels: (0, 0) is the center of the first pixel, v down. Rays: x right, y down, z forward, of any length. A line holds
# if the ray's pixel is within the tolerance, and if the pixel's ray, seen by the camera again, is.
# scripts/make_accept_lines.py writes this file; tests/promises/test_accept.py reads it.
"""
# Name: model, size, (fx, fy, cx, cy), coefficients. Those of published calibrations are named by their data set.
CAMERAS: dict[str, tuple[str, tuple[int, int], tuple[float, ...], dict[str, float]]] = {
    "plain": ("pinhole", (1001, 801), (1000, 1000, 500, 400), {}),
    "oblong": ("pinhole", (1001, 801), (1000, 500, 500, 400), {}),
    "phone-26mm": ("pinhole", (4032, 3024), (2912, 2912, 2015.5, 1511.5), {}),
    "lens-50mm": ("pinhole", (3600, 2400), (5000, 5000, 1799.5, 1199.5), {}),
    "lens-200mm": ("pinhole", (3600, 2400), (20000, 20000, 1799.5, 1199.5), {}),
    "barrel": ("opencv5", (1001, 801), (1000, 1000, 500, 400), {"k1": -0.2}),
    "fifth-order": ("opencv5", (1001, 801), (1000, 1000, 500, 400), {"k2": 0.16}),
    "decentered": ("opencv5", (1001, 801), (1000, 1000, 500, 400), {"p1": 0.01, "p2": -0.02}),
    "divided": ("opencv8", (1001, 801), (1000, 1000, 500, 400), {"k4": 0.25}),
    "equidistant": ("fisheye4", (1601, 1601), (400, 400, 800, 800), {}),
    "prism": ("opencv12", (1001, 801), (1000, 1000, 500, 400), {"s1": 0.01, "s3": -0.02}),
    "euroc-cam0": ("opencv4", (752, 480), (458.654, 457.296, 367.215, 248.375),
                   {"k1": -0.28340811, "k2": 0.07395907, "p1": 0.00019359, "p2": 1.76187114e-05}),
    "kitti-0926-cam0": ("opencv5", (1392, 512), (984.2439, 980.8141, 690.0, 233.1966),
                        {"k1": -0.3728755, "k2": 0.2037299, "p1": 0.002219027, "p2": 0.001383707, "k3": -0.07233722}),
    "tumvi-cam0": ("fisheye4", (512, 512),
                   (190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504),
                   {"k1": 0.0034823894022493434, "k2": 0.0007150348452162257, "k3": -0.0020532361418706202,
                    "k4": 0.00020293673591811182}),
    "rational": ("opencv8", (1920, 1080), (1400, 1405, 962, 538),
                 {"k1": 0.31, "k2": -0.12, "p1": 4e-4, "p2": -3e-4, "k3": 0.004, "k4": 0.62, "k5": 0.05, "k6": 0.01}),
    "thin-prism": ("opencv12", (1920, 1080), (1400, 1405, 962, 538),
                   {"k1": -0.21, "k2": 0.05, "p1": 4e-4, "p2": -3e-4,
                    "s1": 1e-3, "s2": -4e-4, "s3": -6e-4, "s4": 2e-4}),
    "tilted": ("opencv14", (1920, 1080), (1400, 1405, 962, 538),
               {"k1": -0.21, "k2": 0.05, "p1": 4e-4, "p2": -3e-4, "s1": 1e-3, "tau_x": 0.03, "tau_y": -0.05}),
    "many-terms": ("ext20", (1920, 1080), (1400, 1405, 962, 538),
                   {"k1": -0.25, "k2": 0.09, "k3": -0.03, "k4": 0.02, "k5": -0.01, "k6": 0.005, "k7": 0.01,
                    "k8": -0.004, "k9": 0.002, "k10": -0.001, "p1": 1e-3, "p2": -5e-4, "s1": 1e-3, "s2": 2e-4,
                    "s3": -7e-4, "s4": 1e-4, "s5": 5e-5, "s6": -5e-5}),
}  # fmt: skip
BY_HAND = """\
plain | 500 400 | 0 0 1 | 1e-10 | the principal point
plain | 600 350 | 0.1 -0.05 1 | 1e-10 | 500 + 1000 x 0.1, 400 - 1000 x 0.05
plain | 600 350 | 0.2 -0.1 2 | 1e-10 | the same ray, twice as long
plain | 0 400 | -0.5 0 1 | 1e-10 | 500 - 1000 x 0.5
plain | 1000 800 | 0.5 0.4 1 | 1e-10 | the last pixel
oblong | 600 375 | 0.1 -0.05 1 | 1e-10 | fy is half of fx: 400 - 500 x 0.05
phone-26mm | 4031.5 1511.5 | 18 0 26 | 1e-9 | 26 mm on 36 mm: f = 4032 x 26 / 36 = 2912, the edge is at tan = 18/26
phone-26mm | -0.5 1511.5 | -18 0 26 | 1e-9 | the other edge, half a pixel beyond the first pixel's center
lens-50mm | 3599.5 1199.5 | 18 0 50 | 1e-9 | 50 mm on 36 mm: f = 3600 x 50 / 36 = 5000
lens-50mm | 1799.5 2399.5 | 0 12 50 | 1e-9 | the lower edge of 24 mm
lens-200mm | 3599.5 -0.5 | 18 -12 200 | 1e-9 | 200 mm on 36 mm: f = 20000, the upper right corner
barrel | 975 400 | 0.5 0 1 | 1e-9 | 0.5 (1 - 0.2 x 0.25) = 0.475
barrel | 500 105.4 | 0 -0.3 1 | 1e-9 | 0.3 (1 - 0.2 x 0.09) = 0.2946
barrel | 785 780 | 0.3 0.4 1 | 1e-9 | r = 0.5 again: 0.95 x 0.3 = 0.285, 0.95 x 0.4 = 0.38
fifth-order | 1005 400 | 0.5 0 1 | 1e-9 | 0.5 (1 + 0.16 x 0.0625) = 0.505
fifth-order | 803 804 | 0.3 0.4 1 | 1e-9 | 1.01 x 0.3 = 0.303, 1.01 x 0.4 = 0.404
decentered | 599.4 400.1 | 0.1 0 1 | 1e-9 | x: 0.1 - 0.02 (0.01 + 0.02) = 0.0994; y: 0.01 x 0.01 = 0.0001
decentered | 499.8 500.3 | 0 0.1 1 | 1e-9 | x: -0.02 x 0.01 = -0.0002; y: 0.1 + 0.01 (0.01 + 0.02) = 0.1003
divided | 970.5882352941176 400 | 0.5 0 1 | 1e-9 | 0.5 / (1 + 0.25 x 0.25) = 8/17
divided | 782.3529411764706 776.4705882352941 | 0.3 0.4 1 | 1e-9 | 16/17 x 0.3 and 16/17 x 0.4
equidistant | 1114.1592653589794 800 | 1 0 1 | 1e-9 | 45 degrees: 400 pi / 4
equidistant | 800 590.5604897606805 | 0 -1 1.7320508075688772 | 1e-9 | 30 degrees: 400 pi / 6
equidistant | 1428.3185307179587 800 | 1 0 0 | 1e-9 | 90 degrees: 400 pi / 2
equidistant | 1637.7580409572782 800 | 1.7320508075688772 0 -1 | 1e-9 | 120 degrees, behind the camera: 400 x 2 pi / 3
prism | 600.1 399.8 | 0.1 0 1 | 1e-9 | 0.1 + 0.01 x 0.01, 0 - 0.02 x 0.01
"""
PEERS = ("euroc-cam0", "kitti-0926-cam0", "tumvi-cam0", "rational", "thin-prism", "tilted")
# Of OpenCV's coefficients.
ORDER = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"]
MRCAL = {"opencv4": "OPENCV4", "opencv5": "OPENCV5", "opencv8": "OPENCV8", "opencv12": "OPENCV12"}
# Places over the image, in half widths and half heights from the middle.
GRID = [(a, b) for a in (-0.93, -0.47, 0.04, 0.51, 0.9) for b in (-0.88, -0.43, 0.07, 0.49, 0.92)]


def rays(name: str) -> np.ndarray:
    """(25, 3) rays over most of the image, with few digits."""
    model, (width, height), (fx, fy, cx, cy), _ = CAMERAS[name]
    places = np.array([((width - 1) / 2 * (1 + a) - cx, (height - 1) / 2 * (1 + b) - cy) for a, b in GRID])
    plane = np.round(0.85 * places / (fx, fy), 4)
    if model == "fisheye4":
        angle = np.linalg.norm(plane, axis=1)
        plane = np.round(plane / angle[:, None] * np.tan(np.minimum(angle, 1.35))[:, None], 4)
    return np.column_stack([plane, np.ones(len(plane))])


def line(name: str, pixel: np.ndarray, ray: np.ndarray, source: str, tolerance: str = "1e-8") -> str:
    u, v = (repr(float(value)) for value in pixel)
    return f"{name} | {u} {v} | {' '.join(f'{value:g}' for value in ray)} | {tolerance} | {source}"


def by_opencv() -> Iterator[str]:
    """OpenCV's `projectPoints` and `fisheye.projectPoints`."""
    for name in PEERS:
        model, _, (fx, fy, cx, cy), named = CAMERAS[name]
        matrix, none = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.zeros(3)
        if model == "fisheye4":
            values = np.array([named[f"k{i}"] for i in range(1, 5)])
            pixels, _ = cv2.fisheye.projectPoints(rays(name)[:, None], none, none, matrix, values)
            source = f"OpenCV {cv2.__version__}, fisheye.projectPoints"
        else:
            values = np.array([named.get(key, 0.0) for key in ORDER])
            pixels, _ = cv2.projectPoints(rays(name), none, none, matrix, values)
            source = f"OpenCV {cv2.__version__}, projectPoints"
        for pixel, ray in zip(pixels[:, 0], rays(name), strict=True):
            yield line(name, pixel, ray, source)


def by_mrcal(python: str) -> Iterator[str]:
    """Mrcal's `project`, in the Python that has it; the release does not tell its version."""
    for name in PEERS:
        model, _, (fx, fy, cx, cy), named = CAMERAS[name]
        if model not in MRCAL:
            continue
        data = {"model": f"LENSMODEL_{MRCAL[model]}", "rays": rays(name).tolist(),
                "values": [fx, fy, cx, cy, *(named.get(key, 0.0) for key in ORDER[: int(model[6:])])]}  # fmt: skip
        code = (
            "import json, sys, numpy, mrcal; d = json.load(sys.stdin); "
            "p = mrcal.project(numpy.array(d['rays']), d['model'], numpy.array(d['values'])); "
            "print(json.dumps(p.tolist()))"
        )
        done = subprocess.run([python, "-c", code], input=json.dumps(data), capture_output=True, text=True, check=True)
        for pixel, ray in zip(json.loads(done.stdout), rays(name), strict=True):
            yield line(name, pixel, ray, "mrcal 2.2, project")


def by_fractions() -> Iterator[str]:
    """Eq. 10 of the paper, term by term in rational numbers; rounded once, at the end."""
    for name, (model, _, intrinsics, named) in CAMERAS.items():
        if model != "ext20":
            continue
        k = {key: Fraction(repr(value)) for key, value in named.items()}
        fx, fy, cx, cy = (Fraction(repr(value)) for value in intrinsics)
        for ray in rays(name):
            x, y = (Fraction(f"{value:g}") for value in ray[:2])
            s = x * x + y * y
            over = 1 + sum(k[key] * s**i for i, key in enumerate(("k1", "k2", "k3", "k7", "k8"), 1))
            under = 1 + sum(k[key] * s**i for i, key in enumerate(("k4", "k5", "k6", "k9", "k10"), 1))
            prism_x = sum(k[key] * s**i for i, key in enumerate(("s1", "s2", "s5"), 1))
            prism_y = sum(k[key] * s**i for i, key in enumerate(("s3", "s4", "s6"), 1))
            u = x * over / under + 2 * k["p1"] * x * y + k["p2"] * (s + 2 * x * x) + prism_x
            v = y * over / under + k["p1"] * (s + 2 * y * y) + 2 * k["p2"] * x * y + prism_y
            yield line(name, np.array([float(cx + fx * u), float(cy + fy * v)]), ray, "Eq. 10 in rational numbers")


def main() -> None:
    kept = TABLE.read_text(encoding="utf-8").splitlines() if TABLE.exists() else []
    python = interpreter("mrcal")
    lines = [HEAD.rstrip()]
    for name, (model, (width, height), intrinsics, named) in CAMERAS.items():
        numbers = " ".join(f"{value!r}" for value in intrinsics)
        lines.append(f"camera {name} | {model}, {width} x {height}, {numbers} | "
                     f"{' '.join(f'{key}={value!r}' for key, value in named.items())}".rstrip())  # fmt: skip
    lines += BY_HAND.strip().splitlines()
    lines += [*by_opencv()]
    lines += [*by_mrcal(python)] if python else [text for text in kept if "| mrcal " in text]
    lines += [*by_fractions()]
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{sum(' | ' in text and text[0] not in '#' and not text.startswith('camera ') for text in lines)} cases")


if __name__ == "__main__":
    main()
