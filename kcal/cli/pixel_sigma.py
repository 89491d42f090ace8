"""The noise of marks: one option of all commands, with the value that the rig's file states by default."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from kcal.cli.console import err
from kcal.errors import InputError

if TYPE_CHECKING:
    from kcal.lens.camera_rig import CameraRig
    from kcal.lens.rig import StereoRig

# Of marks on sharp images, where nobody said.
ASSUMED = 0.3
PixelSigma: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--pixel-sigma",
        metavar="PX",
        help="Noise of marks along each axis; that in the rig's file, or 0.3, if not given.",
    ),
]


def pixel_sigma_of(given: float | None, rig: StereoRig | CameraRig | None = None) -> float:
    """The noise of marks, px: as given, or as the rig's file states, or assumed; the last two are said."""
    sigma, note = pixel_sigma_and_source(given, rig)
    if note:
        err.print(note)
    return sigma


def pixel_sigma_and_source(given: float | None, rig: StereoRig | CameraRig | None = None) -> tuple[float, str]:
    """The same, and what there is to say of it.

    Raises:
        InputError: not a positive number.
    """
    if given is not None:
        if not 0 < given < 100:
            raise InputError(f"--pixel-sigma {given}: a positive number of pixels is needed")
        return given, ""
    record = None if rig is None else rig.calibration
    if record is not None and record.pixel_sigma is not None:
        return record.pixel_sigma, f"noise of marks: {record.pixel_sigma:g} px, from the rig's file"
    return ASSUMED, f"noise of marks: {ASSUMED:g} px, assumed; --pixel-sigma states it"
