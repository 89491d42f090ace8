"""kcal's own camera file: every parameter by its name, its error bars, and where it came from.

JSON, `"kcal": "camera"`, version 2. Numbers are float64 and read back to
the last bit. Parameters are stored by name, so that a value cannot slip into another one's place.
"""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import pydantic
import torch
from torch import nn

import kcal
from kcal.checks import MOST_FOCAL
from kcal.errors import InputError
from kcal.file_kind import ImageSize
from kcal.io.file_summary import CameraSummary
from kcal.io.record import CovarianceRecord, InformationRecord, LensOrders
from kcal.lens.calibration import CalibrationRecord, CameraCalibration, LensSetting
from kcal.lens.camera import Camera
from kcal.lens.projection import INTRINSICS
from kcal.native_file import NativeFile, Record, storing


class IntrinsicsRecord(Record):
    """Focal lengths, principal point and skew (γ of Eq. 3), pixels, as large as they can be."""

    fx: float = pydantic.Field(gt=0, le=MOST_FOCAL)
    fy: float = pydantic.Field(gt=0, le=MOST_FOCAL)
    cx: float = pydantic.Field(ge=-MOST_FOCAL, le=MOST_FOCAL)
    cy: float = pydantic.Field(ge=-MOST_FOCAL, le=MOST_FOCAL)
    skew: float = pydantic.Field(ge=-MOST_FOCAL, le=MOST_FOCAL)


class ValidRegion(Record):
    """Where the lens is a lens: before it folds back or meets a pole.

    Derived from the camera when the file is written, for readers that cannot compute it; kcal itself measures it again.

    Args:
        radius: of the disc about the optical axis that is valid: on the plane z = 1; for a fisheye, radians off axis;
            for a hybrid lens, on the plane of its base projection.
        polygon: (u, v) pixels around the part of the image that has rays, clockwise as one sees it, to 0.001 px; the
            image's own outline where that is all of it.
    """

    radius: pydantic.NonNegativeFloat
    polygon: tuple[tuple[float, float], ...]


class CameraFile(NativeFile):
    """One camera (file kind `camera`, version 2).

    Convention: pixels as in `Camera`: (0, 0) is the center of the first pixel, y down. Coefficients are stored by
    name in the order of `LensModel.names`; a reader goes by the names, since JSON objects have no order of their own.

    Args:
        name: free text that tells cameras apart, for example `"left"`.
        image_size: (width, height) in pixels.
        model: orders of the lens model, or the constants of a hybrid lens.
        intrinsics: fx, fy, cx, cy, skew in pixels.
        coefficients: name -> value, exactly the names of the model.
        standard_deviations: name -> one sigma of the parameter, None where it was held fixed; the whole is None
            when none was computed.
        covariance: of all parameters together, where that is all that is known of them.
        information: what the calibration says of all parameters together, and of its board; None if that was not
            computed.
        valid_region: where the lens is valid; None if whoever wrote the file did not say.
        calibration: how the camera was calibrated, if it was.
        setting: where zoom and focus stood; None if nobody said.
        summary: what `kcal show` prints of it without computing.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080),
        ...                       coefficients=[-0.1, 0.01], model="opencv4")
        >>> file = camera_to_file(camera, name="left")
        >>> file.coefficients
        {'k1': -0.1, 'k2': 0.01, 'p1': 0.0, 'p2': 0.0}
        >>> file.camera().fingerprint == camera.fingerprint
        True
    """

    KIND: ClassVar[str] = "camera"
    VERSION: ClassVar[int] = 2
    _LATER: ClassVar[Mapping[str, Any]] = {"setting": None, "calibration.without": (), "calibration.moves": None}

    name: str
    image_size: ImageSize
    model: LensOrders
    intrinsics: IntrinsicsRecord
    coefficients: dict[str, float]
    standard_deviations: dict[str, pydantic.NonNegativeFloat | None] | None = None
    covariance: CovarianceRecord | None = None
    information: InformationRecord | None = None
    valid_region: ValidRegion | None = None
    calibration: CalibrationRecord | None = None
    setting: LensSetting | None = None
    summary: CameraSummary | None = None

    @pydantic.field_validator("coefficients", "standard_deviations")
    @classmethod
    def _named(cls, value: dict[str, Any] | None, info: pydantic.ValidationInfo) -> dict[str, Any] | None:
        if value is None or "model" not in info.data:
            return value
        names: tuple[str, ...] = info.data["model"].names
        if info.field_name == "standard_deviations":
            names = (*INTRINSICS, *names)
        missing, unknown = [n for n in names if n not in value], [n for n in value if n not in names]
        if missing or unknown:
            what = f"{missing[0]} is missing" if missing else f"{unknown[0]} is unknown"
            raise ValueError(f"{what}; the lens model needs exactly {_listed(names) or 'nothing'}")
        return {name: value[name] for name in names}

    @pydantic.field_validator("covariance", "information")
    @classmethod
    def _of_model(cls, value: Any, info: pydantic.ValidationInfo) -> Any:
        if value is not None and "model" in info.data:
            names = (*INTRINSICS, *info.data["model"].names)
            own = value.names if isinstance(value, CovarianceRecord) else itertools.chain(*value.unknowns)
            unknown = [name for name in own if name not in names]
            if unknown:
                raise ValueError(f"{info.field_name}: {unknown[0]} is unknown; the lens model has {_listed(names)}")
        return value

    @pydantic.model_validator(mode="after")
    def _usable(self) -> CameraFile:
        # Checked here so that the error names the file.
        if self.information is not None:
            self.information.information(self._values())
        return self

    @pydantic.field_serializer("calibration", mode="wrap")
    def _board_as_before(self, value: CalibrationRecord | None, plain: pydantic.SerializerFunctionWrapHandler):  # type: ignore[no-untyped-def]
        """Leave out fields that checkerboards do not need, so that their files stay as they were."""
        content = plain(value)
        if content is not None and content["board"]["pattern"] == "checkerboard":
            del content["board"]["pattern"], content["board"]["gap"]
        return content

    def covariance_matrix(self) -> torch.Tensor | None:
        """(5 + P, 5 + P) in the order of `Camera.names`, zero for what is exact; None if the file has none."""
        if self.information is not None:
            return self.information.information(self._values()).covariance()
        if self.covariance is None:
            return None
        return self.covariance.expand((*INTRINSICS, *self.coefficients))

    def _values(self) -> dict[str, float]:
        """All parameters by name, in the order of `Camera.names`."""
        return {name: getattr(self.intrinsics, name) for name in INTRINSICS} | self.coefficients

    def camera(self, field: nn.Module | None = None) -> Camera:
        """The camera, equal to the stored one to the last bit, with its `calibration` if the file has one.

        `field` as for `load_camera`.
        """
        parameters = torch.tensor(list(self._values().values()), dtype=torch.float64)
        camera = Camera(parameters, size=self.image_size, model=self.model.model(field))
        stated = (self.standard_deviations, self.covariance, self.information, self.calibration, self.setting)
        if self.name or any(stated):
            camera.calibration = CameraCalibration(
                name=self.name,
                sigma=self.standard_deviations,
                covariance=None if self.covariance is None else self.covariance.expand(camera.names),
                information=None if self.information is None else self.information.information(self._values()),
                record=self.calibration,
                setting=self.setting,
            )
        return camera


def _listed(names: tuple[str, ...]) -> str:
    """Names for a message; the first and the last of very many."""
    return ", ".join(names if len(names) <= 40 else (*names[:12], "...", names[-1]))


def provenance() -> dict[str, Any]:
    """The fields `kcal_version` and `created` of a calibration made now.

    Example:
        >>> sorted(provenance())
        ['created', 'kcal_version']
    """
    return {"kcal_version": kcal.__version__, "created": datetime.datetime.now(datetime.UTC).replace(microsecond=0)}


def camera_to_file(
    camera: Camera,
    *,
    name: str | None = None,
    calibration: CalibrationRecord | None = None,
    setting: LensSetting | None = None,
) -> CameraFile:
    """Put a camera in the form in which it is stored.

    Args:
        camera: a single camera, not a batch, with its `calibration`: names without a sigma, and parameters whose
            variance is zero, were held fixed.
        name: free text that tells cameras apart, in place of the one in `calibration`.
        calibration: how the camera was calibrated, in place of the record there.
        setting: where zoom and focus stood, in place of what is said there.

    Raises:
        InputError: a batch of cameras, a parameter that is not finite, or a name that the camera does not have.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> camera.calibration = CameraCalibration(sigma={"fx": 0.5})
        >>> camera_to_file(camera).standard_deviations["fy"] is None
        True
    """
    values = camera.params.detach()
    if values.ndim != 1:
        raise InputError(f"a camera file contains one camera, got a batch of shape {tuple(values.shape[:-1])}")
    known = camera.calibration or CameraCalibration()
    sigma, information = known.sigma, known.information
    # What is derived from the information is not stored beside it.
    covariance = known.covariance if information is None else None
    if sigma is not None:
        unknown = [key for key in sigma if key not in camera.names]
        if unknown:
            raise InputError(f"standard deviation of {unknown[0]!r}: the camera has {', '.join(camera.names)}")
    stored = dict(zip(camera.names, values.tolist(), strict=True))
    with storing("camera"):
        file = CameraFile(
            name=known.name if name is None else name,
            image_size=camera.size,
            model=LensOrders.of(camera.model),
            intrinsics=IntrinsicsRecord(**{key: stored[key] for key in INTRINSICS}),
            coefficients={key: stored[key] for key in camera.model.names},
            standard_deviations=None if sigma is None else {key: sigma.get(key) for key in camera.names},
            covariance=None if covariance is None else CovarianceRecord.of(covariance.detach(), camera.names),
            information=None if information is None else InformationRecord.of(information, camera.names),
            valid_region=ValidRegion(
                radius=float(camera.valid_radius),
                polygon=tuple((round(u, 3), round(v, 3)) for u, v in camera.valid_polygon().tolist()),
            ),
            calibration=known.record if calibration is None else calibration,
            setting=known.setting if setting is None else setting,
        )
    return file.model_copy(update={"summary": CameraSummary.made(camera, file.model_dump(mode="json"))})


def save_camera(camera: Camera, path: str | Path, *, name: str | None = None) -> Path:
    """Write a camera with its error bars and history (`camera.calibration`); `name` replaces the name it has.

    Raises:
        InputError: see `camera_to_file`.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     load_camera(save_camera(camera, Path(folder, "camera.json"))).focal.tolist()
        [800.0, 800.0]
    """
    return camera_to_file(camera, name=name).save(path)


def load_camera(path: str | Path, *, field: nn.Module | None = None) -> Camera:
    """Read the camera of a kcal camera file; its `calibration` has what else the file contains.

    Args:
        path: of the file.
        field: for a camera whose field is a network of a class of your own: a module of that class. It is copied, and
            the copy gets the weights of the file.

    Raises:
        InputError: the file needs a `field` that was not given, or another one.
        FileError: missing, not JSON, another kind of file (a rig, say), or a field that is wrong; it names the path.

    Example:
        >>> load_camera("no-such-file.json")
        Traceback (most recent call last):
        kcal.errors.FileError: no-such-file.json: cannot read: No such file or directory
    """
    return CameraFile.load(path).camera(field)
