"""`kcal diff`: how differently two cameras see, against their error bars."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kcal.cli.camera_sources import single_camera
from kcal.cli.console import out, print_wrote, tell
from kcal.cli.inputs import ANY_CAMERA
from kcal.files import check_picture
from kcal.quantities import number_text

if TYPE_CHECKING:
    from kcal.lens.camera import Camera


def diff_command(
    first: Annotated[
        str, typer.Argument(metavar="CAMERA", help="Camera file of kcal or of another program."), ANY_CAMERA
    ],
    second: Annotated[
        str, typer.Argument(metavar="CAMERA", help="Another one; RIG.json:left is a camera of a rig."), ANY_CAMERA
    ],
    at: Annotated[
        float, typer.Option("--at", min=1e-3, metavar="METERS", help="Distance of what is seen; infinity if not given.")
    ] = math.inf,
    turn: Annotated[
        bool, typer.Option("--turn/--no-turn", help="Turn the second camera until it agrees best with the first.")
    ] = True,
    picture: Annotated[Path | None, typer.Option(metavar="PNG", help="Map of the difference and of its sigma.")] = None,
) -> None:
    """Compare two calibrations of a camera: are they the same within their uncertainty?

    Where the second camera sees what the first one sees, after the turn that no calibration determines. The error bars
    of both tell how much of that is expected. Use it for one camera over time, or for two halves of its images.

    **Examples**

    `kcal diff june.camera.json december.camera.json --picture diff.png`

    `kcal diff left.camera.json left.cameramodel`
    """
    import torch

    from kcal.lens.difference import camera_difference
    from kcal.report.difference_text import difference_text

    if picture is not None:
        check_picture(picture)
    cameras = [single_camera(source) for source in (first, second)]
    for source, camera in zip((first, second), cameras, strict=True):
        out.print(f"{source}: {_history(camera)}", markup=False)
    found = camera_difference(*cameras, at=at, rotation=None if turn else torch.eye(3))
    tell(
        at_m=None if math.isinf(at) else at,
        rms_px=found.rms,
        largest_px=found.largest,
        turn_deg=found.turn_deg,
        ratio=found.ratio,
        probability=found.probability,
        same=found.same,
        temperature_c=[_temperature(camera) for camera in cameras],
    )
    then, now = (_temperature(camera) for camera in cameras)
    if then is not None and now is not None and now != then:
        out.print(f"{abs(now - then):g} °C {'warmer' if now > then else 'colder'}", markup=False)
    for line in difference_text(found):
        out.print(line, markup=False)
    if picture is not None:
        from kcal.report.difference import save_difference_picture

        print_wrote(save_difference_picture(picture, found, title=f"{first} and {second}"))


def _temperature(camera: Camera) -> float | None:
    record = camera.calibration.record if camera.calibration else None
    return record.temperature if record else None


def _history(camera: Camera) -> str:
    """Model, focal length and, if the file tells, when the camera was calibrated."""
    from kcal.lens.paraxial import paraxial_focal

    record = camera.calibration.record if camera.calibration else None
    when = ""
    if record:
        when = f", {record.created:%Y-%m-%d %H:%M}, RMS {number_text(record.rms)} px from {record.views} views"
    if camera.calibration and camera.calibration.setting:
        when += f", {camera.calibration.setting}"
    if record and record.temperature is not None:
        when += f", at {record.temperature:g} °C"
    return f"{camera.model}, focal length {paraxial_focal(camera)}{when}"
