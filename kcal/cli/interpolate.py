"""`kcal interpolate`: a camera at a setting of zoom or focus between those at which its lens was calibrated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.console import out, print_table, print_wrote, tell
from kcal.cli.inputs import CALIBRATED
from kcal.cli.lens_setting import named_numbers, stated_settings
from kcal.errors import InputError
from kcal.files import check_writable
from kcal.quantities import number_text


def interpolate_command(
    cameras: Annotated[
        list[Path],
        typer.Argument(
            metavar="CAMERA...",
            help="Camera file at each setting, from `kcal calibrate --setting`.",
            show_default=False,
        ),
        CALIBRATED,
    ],
    setting: Annotated[
        list[str], typer.Option(metavar="NAME=NUMBER", help="Setting of the camera to make; may be repeated.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Camera file to write.")],
    setting_sigma: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=NUMBER",
            help="Standard deviation with which the lens comes back to a setting (0 if not given).",
        ),
    ] = None,
) -> None:
    """Make a camera at a zoom or focus between those at which its lens was calibrated, with its error bars.

    Error bars grow by what the curve between the settings may hide: three settings tell little of that, five tell more.
    Outside the settings nothing is made. Commands take the file as they take any camera file.

    **Example**

    `kcal interpolate near.camera.json middle.camera.json far.camera.json --setting focus=4 -o now.camera.json`
    """
    check_writable(output, *cameras)
    (wanted,) = stated_settings(setting, 1)
    spread = {}
    for name, values in named_numbers(setting_sigma, "--setting-sigma").items():
        if len(values) > 1:
            raise InputError(f"--setting-sigma {name}: one number is needed")
        spread[name] = values[0]

    from kcal.calibrate.camera.at_setting import camera_at_setting
    from kcal.io.camera_file import load_camera, save_camera
    from kcal.lens.calibration import LensSetting

    loaded = [load_camera(path) for path in cameras]
    found = camera_at_setting(loaded, wanted, setting_sigma=spread, names=[str(path) for path in cameras])
    *stated, made = [camera.calibration and camera.calibration.setting for camera in (*loaded, found.camera)]
    weights = [number_text(weight, 0.01, sign=True) for weight in found.weights]
    rows = zip(map(str, cameras), map(str, stated), weights, strict=True)
    print_table([["camera", "setting", "weight"], *map(list, rows)], left=(0, 1))
    parts = {
        "calibrations": found.calibration_px,
        "interpolation": found.interpolation_px,
        "setting": found.setting_px,
        "misfit": found.misfit_px,
    }
    total = sum(value**2 for value in parts.values()) ** 0.5
    if isinstance(made, LensSetting) and made.interpolated_from:
        text = ", ".join(f"{number_text(value, digits=2)} by {name}" for name, value in parts.items() if value)
        out.print(
            f"{made}, interpolated: far directions ± {number_text(total, digits=2)} px (median): {text}", markup=False
        )
    else:
        out.print(f"{made}, calibrated: far directions ± {number_text(total, digits=2)} px (median)", markup=False)
    tell(setting=wanted, weights=list(found.weights), sigma_px={"median": total, **parts})
    save_camera(found.camera, output, name=output.name.split(".")[0])
    print_wrote(output)
