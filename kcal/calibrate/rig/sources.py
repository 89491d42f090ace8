"""All that a rig is solved from: the list of its sources."""

from __future__ import annotations

import dataclasses

from kcal.calibrate.rig.boards import Boards
from kcal.calibrate.rig.features import Features
from kcal.calibrate.rig.landmarks import Landmarks
from kcal.calibrate.rig.measured import Baseline, MeasuredPosition
from kcal.calibrate.rig.skyline import SkylineSource
from kcal.calibrate.rig.source import ItemSource, Measurement, Source, check_names
from kcal.calibrate.rig.stars import StarSource
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RigData:
    """All that a rig is solved from; any of it may be missing.

    All of it is in one local frame in meters: east, north, up of an origin where anything is known on the Earth
    (`kcal.locate.survey` reads latitudes and longitudes), the first camera's frame where nothing is. The solver goes
    through `sources`; a new one needs a field here and nothing else.

    Args:
        cameras: calibrated, two or more, or one with landmarks; unlike sizes and models are welcome. One camera that
            was moved from place to place is given once for each place (`lenses`).
        names: of the cameras.
        boards: see `Boards`.
        landmarks: see `Landmarks`.
        features: see `Features`.
        stars: see `StarSource`.
        skyline: see `SkylineSource`.
        baselines: see `Baseline`.
        positions: see `MeasuredPosition`.

    Raises:
        InputError: names or shapes that do not fit each other, one camera without landmarks or skyline.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080))
        >>> RigData(cameras=(camera, camera), names=("left", "right")).absolute
        False
    """

    __repr__ = brief

    cameras: tuple[Camera, ...]
    names: tuple[str, ...]
    boards: Boards | None = None
    landmarks: Landmarks | None = None
    features: Features | None = None
    stars: StarSource | None = None
    skyline: SkylineSource | None = None
    baselines: tuple[Baseline, ...] = ()
    positions: tuple[MeasuredPosition, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.cameras)
        if not count or (count == 1 and self.landmarks is None and self.skyline is None):
            raise InputError("a rig has two cameras or more; one camera alone needs landmarks, or a skyline")
        check_names("cameras", self.names, count)
        if not all(isinstance(camera, Camera) and camera.params.ndim == 1 for camera in self.cameras):
            raise InputError("a rig is made of single cameras")
        for source in self.sources:
            source.check(count, absolute=self.absolute)

    @property
    def lenses(self) -> tuple[int, ...]:
        """For each camera, the number of the first one that has the same lens.

        Cameras have the same lens if they are one `Camera` with a calibration, or if their parameters are equal and
        come from a calibration, as its record says. Two cameras of one type have equal nominal parameters, and two
        lenses. A lens is one block of unknowns: its data count once, and its errors are the same at all places.
        """
        return tuple(
            next((first for first in range(c) if _same_lens(self.cameras[first], camera)), c)
            for c, camera in enumerate(self.cameras)
        )

    @property
    def sources(self) -> tuple[Source, ...]:
        """All that there are, in the order of their fields."""
        values = (getattr(self, field.name) for field in dataclasses.fields(self)[2:])
        each = (value if isinstance(value, tuple) else (value,) for value in values)
        return tuple(source for some in each for source in some if source is not None)

    @property
    def seen(self) -> tuple[ItemSource, ...]:
        """Those whose items have unknowns of their own."""
        return tuple(source for source in self.sources if isinstance(source, ItemSource))

    @property
    def measured(self) -> tuple[Measurement, ...]:
        """Those about the cameras alone."""
        return tuple(source for source in self.sources if isinstance(source, Measurement))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of what shifts many items of a source together."""
        return tuple(effect.name for source in self.seen for effect in source.effects)

    @property
    def absolute(self) -> bool:
        """Whether anything places the rig in the local frame; otherwise that is the first camera's."""
        return any(source.absolute for source in self.sources)


def _same_lens(one: Camera, other: Camera) -> bool:
    if one.calibration is None or other.calibration is None:
        return False
    measured = one.calibration.record is not None and other.calibration.record is not None
    return one is other or (measured and one.fingerprint == other.fingerprint)
