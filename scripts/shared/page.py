"""Sections of pages in docs/measured/ that scripts write: each between two comments that name it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from scripts.shared.timing import row

DOCS = Path(__file__).parents[2] / "docs" / "measured"
# What to conclude from each page that one script writes whole. Check it against the figures when they are made anew.
CONCLUSIONS = {
    "first-contact.md": (
        "**Conclusion.** Fewer than 1,500 words lead to the first position, no how-to is longer than a screen, and "
        "tests run every Python example. Every command refuses a missing file before it loads torch. `kcal "
        "--help` takes 0.4 s of processor time where kcal is installed for development; 0.3 s is the aim."
    ),
    "versions.md": (
        "**Conclusion.** The newest versions work on Python 3.11, 3.12 and 3.13, from the sdist: torch 2.13.0, numpy "
        "up to 2.5. The lowest versions that `pyproject.toml` allows work on 3.11, from the wheel: torch 2.7.1, numpy "
        "2.0.2, scipy 1.13.1; on 3.12 and 3.13 they have not been run."
    ),
    "cpus.md": (
        "**Conclusion.** Another make of CPU gives the same camera. Under six settings that stand for other CPUs, "
        "cameras, their σ, rigs and positions differ by at most 6e-4 σ; the aim is 1e-3. One default camera of "
        "seven differs by that much, another by 3e-5 σ, all other stages by less than 1e-5. No status depends on "
        "the setting. `fish_l` is refused under all of them, except with five coefficients."
    ),
    "capture.md": (
        "**Conclusion.** Follow the outline: half of the views are enough. The σ of 20 random views is reached with 6 "
        "to 15 guided ones (median 9); true errors are then 0.76 of those of the random views (geometric mean of six "
        "lenses)."
    ),
    "chain.md": (
        "**Conclusion.** Let the rig refine its cameras, as it does by default. Lenses then err by 65 to 79 m at 5 "
        "km, on exact boards and on boards as they are printed, with entrance pupils that move by 0 to 3 mm/rad². "
        "Cameras held as exact err by 138 to 208 m. OpenCV's err by 115 to 241 m on exact boards (8 coefficients; with "
        "14, from one draw each, 123 to 804 m) and by 2 km on printed ones, those of `calibrateCameraRO` by 237 m "
        "(three of the ten draws, 3 mm/rad²). Parametric models of kcal whose board is taken as flat fare as OpenCV's "
        "on printed boards (one draw): leave the model out. The total error is 1.17 to 1.18 times what noise in the "
        "marks leaves. 94.3 to 95.5 % of the intervals contain the true range at each of the seven distances; with "
        "cameras held 87 to 94 %."
    ),
    "demo.md": (
        "**Conclusion.** The intervals of `kcal demo` contain the true range as often as they state: over 40 runs, "
        "each with its own photographs, survey and marks, 96.4 ± 1.9 % of the 95 % intervals do. Every target is "
        "located in every run. In 10 of the 40 runs, one of the seven intervals does not contain the true range."
    ),
    "fields.md": (
        "**Conclusion.** Keep Zernike modes. Fields of every kind predict held-out views equally well to 3 %. "
        "Zernike modes are best on the wide lens and cost the least there. Four widths of Gaussian units gain 1 % on "
        "one of the two small cameras, at six times the time; there are no simulations here that would show local "
        "structure. Random features are nearly as good as trained ones."
    ),
    "folds.md": (
        "**Conclusion.** None of 10,000 lenses that were built to fold unseen gave two rays for a pixel; of the first "
        "1,000, 240 did before regions were proven. Single directions are proven; whether the images of different "
        "directions overlap is sampled at 1,024 places of the edge, so a lens with strong prism terms could still "
        "escape. Of 424 ordinary cameras one loses pixels that samples found valid: 24 coefficients fitted to a wide "
        "lens, which fold inside the image. The proof takes 3 to 12 ms of processor time for each camera, a fifth to "
        "two fifths of the time before."
    ),
    "lens.md": (
        "**Conclusion.** For many points, compile the camera. From 10,000 points on, compiled kcal projects 5 to 18 "
        "times as fast as OpenCV and finds rays 5 to 8 times as fast; for 100 points OpenCV is faster. `cv2.remap` is "
        "2 to 7 times as fast as kcal for whole images, kornia slower than both. Accuracy is equal. Only kcal marks "
        "the pixels that have no ray; the others return a wrong one."
    ),
    "locate.md": (
        "**Conclusion.** The 95 % intervals contain the true range in 94.6 to 95.8 % of the cases from 100 m to 5 km, "
        "if the covariance of the calibration is given. Intervals of the marks alone contain it in 90.4 to 92.6 % "
        "only, so solve and locate with the rig's covariance. Triangulation is as accurate as OpenCV's and kornia's; "
        "with 10,000 points its closed form is faster than both, with 100 points mostly not."
    ),
    "locate_table.md": (
        "**Conclusion.** `kcal locate` takes tables of any length in the memory of a short one: 405 MB for a CSV of a "
        "million rows, 378 MB for a hundred thousand. A row costs 9 µs of processor time to CSV (108,000 rows a "
        "second; 16 µs with the covariances of cameras and pose) and 33 to 42 µs to GeoJSON, which contains a region "
        "of 73 corners for each point: 28,000 to 30,000 rows a second with exact cameras, where 30,000 were the aim. "
        "With a thousand rows, start-up takes most of the time."
    ),
    "verdict.md": (
        "**Conclusion.** A no can be believed, and tells why: of 200 captures with a planted fault, 167 of which were "
        "off by more than required, 3 got a yes (1.8 %; 1 % is the aim). All three have a moving pupil that the model "
        "leaves out, and are off by 1.04, 1.05 and 1.44 times what was required. The fault was named in 171 of 200. Of "
        "85 clean captures that meet the requirement, 2 were refused. A yes is a standard deviation: 11 of 94 clean "
        "cameras with a yes are off by more than was required, one of them by 2.5 times."
    ),
    "opencv.md": (
        "**Conclusion.** On the same corners kcal and OpenCV reach the same calibration: projections agree to 1e-12 "
        "px, RMS to 1e-7 px up to 12 coefficients, and with 14 coefficients kcal's RMS is lower by 3e-5 and 5e-5 px. "
        "On these 13 views OpenCV is faster: 4 to 19 times for one camera with up to 12 coefficients, up to 2.5 times "
        "with 14, and 9 to 12 times for the rig."
    ),
    "paper.md": (
        "**Conclusion.** With a printed board and entrance pupils that move, as in life, kcal's default camera errs by "
        "42 to 51 m at the target at 5 km and by 66 to 80 m all over the image; OpenCV's pipeline by 197 to 425 m, and "
        "by 1.5 km and more all over the image. The aim of a fifth of OpenCV's error is met in every cell, that of 1 % "
        "of the range with two of three kinds of lenses (*glass*: 1.02 %). Of what is left, the landmarks' noise is "
        "the larger part. No number of coefficients helps: 14 to 24 differ little, because the board and the pupil "
        "decide."
    ),
    "refraction.md": (
        "**Conclusion.** Mark some landmarks as far away as your targets. With the coefficient of refraction off by "
        "0.2, heights at 5 km are then wrong by 0.05 m; from landmarks within 400 m they are wrong by 0.35 m, 1.8 of "
        "the sigmas that are stated."
    ),
    "weak_geometry.md": (
        "**Conclusion.** Spread landmarks over the image and over distances: none of 200 random sets was refused, one "
        "was warned of, and their intervals contain the truth in 95 % of the cases. Landmarks in a row 1 km away were "
        "refused in all 56 sets. Of 200 nearly degenerate sets 111 were refused and 55 warned of; the intervals of the "
        "others contain the truth in 94 %. The intervals of those warned of are widened, and contain the truth in 89 % "
        "(65 % before), those of tight clusters in 66 %. No set that gave useful ranges was refused."
    ),
    "rig.md": (
        "**Conclusion.** Twelve surveyed landmarks give honest intervals: 94 to 97 % of them contain the true range "
        "from 100 m to 5 km. From 1 km on, the error is within 10 % of the bound that the marks set. A measured "
        "baseline or far summits improve the yaw further. Marks that are wrong by 2 px and heights wrong by 1 m are "
        "always found, a mark wrong by 0.5 px in a quarter of the rigs. 40 static features find a turn of 0.01° every "
        "time; correcting it reduces the error at 5 km from 478 m to 45 m."
    ),
}


def write_section(page: str, name: str, text: str) -> None:
    """Put a section between its markers in a page, at the page's end if it is not there yet."""
    path = DOCS / page
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    whole = path.read_text(encoding="utf-8")
    block = f"{begin}\n{text.strip()}\n{end}"
    if begin in whole:
        head, rest = whole.split(begin)
        whole = head + block + rest.split(end)[1]
    else:
        whole = f"{whole.rstrip()}\n\n{block}\n"
    path.write_text(whole, encoding="utf-8")


def read_section(page: str, name: str) -> str:
    """What `write_section` put there; empty if it never did."""
    whole = (DOCS / page).read_text(encoding="utf-8")
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    return whole.split(begin)[1].split(end)[0].strip() if begin in whole else ""


def table(heads: Sequence[object], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table."""
    return [row(*heads), row(*["---"] * len(heads)), *(row(*cells) for cells in rows)]
