"""Which cameras at which settings can be interpolated; what cannot is refused with its cause and cure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.setting_spline import SettingSpline
from kcal.errors import InputError
from kcal.lens.calibration import LensSetting
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.texts import setting_text


def usable_information(camera: Camera, first: Camera, name: str, first_name: str) -> CameraInformation:
    """What is known of a camera that can be used."""
    if camera.params.ndim != 1:
        raise InputError(f"{name}: a batch of cameras; a single one is needed")
    if camera.size != first.size:
        sizes = [f"{width}x{height} px" for width, height in (camera.size, first.size)]
        raise InputError(f"{name}: its image is {sizes[0]}, that of {first_name} {sizes[1]}: not one camera")
    known = camera.calibration
    if known is None or known.setting is None:
        raise InputError(
            f"{name}: it does not say at which setting it was calibrated: kcal calibrate OBS --setting ..."
        )
    if known.setting.interpolated_from:
        raise InputError(f"{name}: it is interpolated itself; use the cameras that it came from")
    information = known.known(camera.params.detach())
    if information is None:
        raise InputError(
            f"{name}: it has no error bars: calibrate it with kcal calibrate OBS --setting {known.setting}"
        )
    return information


def varied_settings(
    cameras: Sequence[Camera], setting: Mapping[str, float], names: Sequence[str]
) -> tuple[list[str], Tensor]:
    """Which kinds of settings vary, and the settings of the cameras (n, D)."""
    LensSetting(values=dict(setting))
    stated = [
        camera.calibration.setting.values for camera in cameras if camera.calibration and camera.calibration.setting
    ]
    for name, values in zip(names, stated, strict=True):
        if values.keys() != setting.keys():
            raise InputError(f"{name}: it states {', '.join(values)}, but {', '.join(setting)} is asked for")
    axes = [axis for axis in setting if len({values[axis] for values in stated} | {setting[axis]}) > 1]
    return axes, torch.tensor([[values[axis] for axis in axes] for values in stated], dtype=torch.float64)


def setting_sigmas(axes: list[str], setting: Mapping[str, float], sigma: Mapping[str, float]) -> Tensor:
    """(D,) standard deviations with which the lens comes back to the settings that vary."""
    for name, value in sigma.items():
        if name not in setting or not 0 <= value < math.inf:
            raise InputError(f"setting sigma {name}={value:g}: a number, not negative, of one of {', '.join(setting)}")
        if value and name not in axes:
            raise InputError(f"setting sigma {name}={value:g}: all cameras have one {name}, so its effect is unknown")
    return torch.tensor([sigma.get(axis, 0.0) for axis in axes], dtype=torch.float64)


def spline_between(axes: list[str], places: Tensor, at: Tensor, names: Sequence[str]) -> SettingSpline:
    """Refuse what cannot be interpolated."""
    if len(places) < len(axes) + 2:
        raise InputError(
            f"{len(places)} cameras do not tell how the lens changes between settings of {' and '.join(axes)}: "
            f"{len(axes) + 2} are needed, 5 are better"
        )
    for i, place in enumerate(places):
        if len(again := (places[:i] == place).all(1).nonzero()):
            raise InputError(f"{names[i]} and {names[int(again[0])]} are at one setting: leave one of them out")
    lowest, highest = places.amin(0).tolist(), places.amax(0).tolist()
    for axis, low, high, value in zip(axes, lowest, highest, at.tolist(), strict=True):
        if not low <= value <= high:
            raise InputError(
                f"{axis}={value:g} is outside the calibrated {axis} of {low:g} to {high:g}: a lens is not "
                f"extrapolated; calibrate it at {axis}={value:g} or beyond"
            )
    if SettingSpline.flat(places):
        raise InputError(f"{' and '.join(axes)} change together in these cameras: calibrate other combinations as well")
    spline = SettingSpline(places)
    if not spline.inside(at):
        text = setting_text(dict(zip(axes, at.tolist(), strict=True)))
        raise InputError(f"{text} does not lie between these calibrations (in their convex hull): calibrate near it")
    return spline
