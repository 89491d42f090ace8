"""Write docs/reference/migration.md: what of kcal 1.0 has another name, another place or is gone.

    python -m scripts.make_migration

The lists of names, commands and options of 1.0 are those that its commit promises; what became of each that is no
longer promised stands here, or is found in the code. The script fails where one has no answer.
"""

from __future__ import annotations

import re
import subprocess

from scripts.make_promises import FOLDER
from scripts.make_reference import DOORS
from scripts.shared.page import DOCS, table

FIRST = "35b517ae"  # the commit of 1.0
ROOT = DOCS.parents[1]
PAGE = ROOT / "docs" / "reference" / "migration.md"
# Command and option of 1.0 -> how it is said now.
OPTIONS = {
    "--origin": "`--site LAT,LON,HEIGHT[±M]`", "calibrate --place": "`--site`", "--lat": "`--site`",
    "--lon": "`--site`",
    "--height": "`--site`", "--origin-sigma": "`--site ...±M`", "--heading-sigma": "`--heading DEG±SIGMA`",
    "--refraction-sigma": "`--refraction K±SIGMA`", "--baseline-error": "`--baseline M±SIGMA`",
    "--yaw": "`--yaw-sigma`",
    "--altitude": "`--pitch`", "budget --stars": "`--aperture MM` alone", "--star-time": "`--time`",
    "--celsius": "`--temperature`", "--hectopascal": "`--pressure`", "watch --temperature": "`--temperatures`",
    "--geoid-height": "`--geoid M`", "--night": "`--stars NAME=IMAGES ...`", "rig solve --observations": "`--pairs`",
    "--position": "`--positions`", "--reference": "`--reference-images`", "--watch": "`--history`",
    "watch --history": "`-o`, `--output`", "--relock": "`--relock RIG.json`", "init --camera": "`--source`",
    "--range": "`--distance`", "--at": "`--distance`", "--setting-sigma": "`--setting NAME=VALUE±SIGMA`",
    "--page": "`--paper`", "--to": "`--format`", "import --camera": "`FILE:NAME`", "--sigma": "`--survey-sigma`",
    "--scene": "`--scene`: words up to the next option", "rig solve --stars": "`--stars`: words up to the next option",
    "rig solve --pairs": "`--pairs`: words up to the next option", "station takes": "the survey is `--landmarks`",
    "undistort": "`kcal rectify`",
}  # fmt: skip
# Names of 1.0 -> what replaces them.
NAMES = {
    "StereoRig": "`kcal.Rig.pair`", "rig.CameraRig": "`kcal.Rig`", "StereoLocalizer": "`kcal.Localizer`",
    "locate.MultiViewLocalizer": "`kcal.Localizer`", "locate.ViewsLocalization": "result of `kcal.Localizer`",
    "locate.Triangulate": "`kcal.Localizer`; of rays `kcal.locate.triangulate`",
    "locate.TriangulateViews": "`kcal.Localizer`",
    "locate.Triangulation": "result of `kcal.Localizer`", "locate.ViewsResult": "result of `kcal.Localizer`",
    "locate.ViewMarks": "`kcal.locate.Marks`", "locate.read_views": "`kcal.locate.read_marks`",
    "locate.GroundPlaces": "result of `kcal.locate_points`",
    "locate.locate_on_ground":
    "`kcal.locate_points` of a rig of one", "locate.locate_views": "`kcal.locate_points`",
    "rig.load_camera_rig": "`kcal.load_rig`",
    "rig.save_camera_rig": "`kcal.save_rig`", "rig.CameraRigCalibration": "`kcal.lens.calibration.RigCalibration`",
    "rig.LandmarkEffect": "`kcal.rig.Effect`", "stars.StarEffect": "`kcal.rig.Effect`",
    "rig.SourceResidual": "`kcal.lens.calibration.RigSource`",
    "rig.drift_effect": "`kcal.rig.check_rig`, then `effect`",
    "rig.relocked": "`kcal.rig.check_rig`, then `relocked`", "lens.CameraPose": "`kcal.lens.pose.Pose`",
    "calibrate.RejectedCorner": "`kcal.calibrate.camera.result.Rejected`",
    "calibrate.RejectedView": "`kcal.calibrate.camera.result.Rejected`", "stars.parse_time": "`kcal.values.instant`",
    "track.ObjectPairs": "`kcal.pipeline.pairing.ObjectViews`",
    **{f"lens.{name}": f"`kcal.nets.{name}`" for name in ("InverseNet", "InverseNetOptions", "train_inverse")},
}  # fmt: skip
INTRO = """# From 1.0 to 2.0

Files of 1.0 load as they are, to the same numbers: camera, rig and observation files, stations too. 2.0 writes rig
files of version 4, which 1.0 refuses. What programs and scripts say in another way stands here; it is all of what
1.0 [promised](promises.md) and 2.0 does not. `python -m scripts.make_migration` makes this page."""


def promised(file: str) -> tuple[list[str], dict[str, str]]:
    """Lines of 1.0 that are no longer there; and those that are, by their names."""
    show = ["git", "show", f"{FIRST}:tests/promises/{file}"]
    old = subprocess.run(show, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    new = (FOLDER / file).read_text(encoding="utf-8").splitlines()
    return [line for line in old if line not in set(new)], {line.split("(")[0]: line for line in new}


def option_rows() -> list[list[str]]:
    """Options that are gone, each with the commands that had it."""
    found: dict[tuple[str, str], list[str]] = {}
    for line in promised("commands.txt")[0]:
        words = line.removeprefix("kcal ").split()
        option = next((word for word in words if word.startswith("-") or word == "takes"), "")
        command = " ".join(words[: words.index(option)])
        key = next((key for key in (command, f"{command} {option}", option) if key in OPTIONS), None)
        if key is None:
            raise SystemExit(f"{line}: what became of it?")
        old = f"`{option}`" if option.startswith("-") and key != command else f"`kcal {command}`"
        commands = found.setdefault((old, OPTIONS[key]), [])
        commands += [command] if command not in commands else []
    return [[old, ", ".join(commands), new] for (old, new), commands in sorted(found.items())]


def python_rows() -> tuple[list[list[str]], dict[str, list[str]]]:
    """Names that something replaces; and by module those that only left their door."""
    gone, there = promised("python.txt")
    doors, replaced, moved = set(DOORS), dict[str, list[str]](), dict[str, list[str]]()
    sources = {path: path.read_text(encoding="utf-8") for path in sorted((ROOT / "kcal").rglob("*.py"))}
    sources = {path: text for path, text in sources.items() if path.parent.name != "cli"}
    for name in sorted({line.split("(")[0].strip() for line in gone} - set(there)):
        door, _, last = name.rpartition(".")
        short = name.removeprefix("kcal.")
        if door not in doors:
            continue
        own = re.compile(rf"^(?:class|def) {last}\b|^{last}\b.* = ", re.MULTILINE)
        places = [path for path, text in sources.items() if own.search(text)]
        if short in NAMES or not places:
            picture = "`kcal.report.save_picture`, with a figure" if last.startswith("save_") else None
            if (new := NAMES.get(short, picture)) is None:
                raise SystemExit(f"{name}: what became of it?")
            replaced.setdefault(new, []).append(short)
            continue
        moved.setdefault(".".join(places[0].relative_to(ROOT).with_suffix("").parts), []).append(last)
    return sorted([", ".join(names), new] for new, names in replaced.items()), moved


def argument_rows() -> list[list[str]]:
    """Functions whose arguments of 1.0 are no longer all taken in their order."""
    rows, (gone, there) = [], promised("python.txt")
    for old in gone:
        new = there.get(name := old.split("(")[0])
        before, after = (re.findall(r"[\w*]+", line.partition("(")[2]) for line in (old, new or ""))
        if new and "(*," not in new and [each for each in after if each in before] != before:
            rows.append([f"`{name}`", *(f"`({line.partition('(')[2]}`" for line in (old, new))])
    return rows


def main() -> None:
    replaced, moved = python_rows()
    lines = [INTRO, "", "## Commands", "", *table(["1.0", "of", "2.0"], option_rows()), "", "## Python", ""]
    lines += [
        *table(["1.0, below `kcal`", "2.0"], replaced),
        "",
        *table(["arguments of", "1.0", "2.0"], argument_rows()),
    ]
    lines += ["", "Results of functions, and helpers of commands, are imported from the modules that define them:", ""]
    lines += table(["from", "import"], ([f"`{module}`", ", ".join(names)] for module, names in sorted(moved.items())))
    PAGE.write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"wrote {PAGE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
