"""What `kcal rig` and `kcal station` solve from, as options."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from kcal.cli import kinds
from kcal.cli.inputs import pixel_sigma_and_source
from kcal.cli.options import Kind, Rare, Several
from kcal.values import WithSigma

_REFRACTION_SIGMA = 0.1
_REFRACTION = WithSigma(0.13, _REFRACTION_SIGMA)
# Each of them alone is something to solve from.
_SOURCES = (
    "pairs", "landmarks", "marks", "features", "positions", "baseline", "stars", "scene", "terrain", "tracks",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sources:
    """What a rig is solved from.

    Args:
        pairs: Observations of boards seen by both, LEFT RIGHT; of three cameras and more one file for each camera,
            named as it is.
        match: Which views belong together: columns left,right. By name if not given.
        landmarks: Surveyed places: CSV (name,lat,lon,height,sigma or name,east,north,up,sigma), GeoJSON, GPX.
        marks: Where they are in the images: name,left_u,left_v,right_u,right_v, or one line for each camera:
            name,camera,u,v.
        features: Distant points matched between the images: left_u,left_v,right_u,right_v and range,range_sigma or
            beyond (meters), if known.
        positions: Measured camera positions (GNSS): as --landmarks, names left and right, or of files.
        baseline: Measured distance between the cameras, e.g. 10.02±0.005; of three and more mill:mast=812.4±0.1,...
        site: Origin of the local frame, where the first camera stands; the first surveyed place if not given.
        survey_sigma: How well places of GeoJSON and GPX files are known, where these do not say.
        geoid: Height of the geoid above the WGS84 ellipsoid, added to elevations of GPX and to heights of --terrain.
        stars: Night images of each camera, LEFT RIGHT (folder or quoted wildcard), paired by their times: they
            determine how the cameras are turned, yaw included; with --site and --time also on the Earth. Of three
            cameras and more NAME=IMAGES of some.
        scene: Images of the scene by each camera at the same moments, LEFT RIGHT (file, folder or quoted wildcard):
            features seen by both determine how the cameras are turned; a length must come from elsewhere (--baseline).
        skyline: Images of the skyline by each camera, in their order or as NAME=IMAGES; with --terrain and --positions
            they tell how the cameras look on the Earth, heading included. Those of --scene if not given.
        terrain: Raster of terrain heights for --skyline (GeoTIFF or .asc).
        terrain_sigma: Standard deviation of its heights; 2 is a 30 m raster from satellites, 0.3 one from lidar.
        skyline_picture: the raster's skyline over each image, and the residuals.
        tracks: Where drones, ships or aircraft were (name,time,lat,lon,height,sigma), and what the cameras followed
            (name,camera,time,u,v): landmarks that move.
        tracks_clock: Of the cameras' clocks against that of --tracks; found within three of it.
        clock_sigma: Standard deviation of the offset between the cameras' clocks: 1 s is 2.3 % of a range of 5 km.
        clock_drift: Of the rate at which it changes, seconds an hour; 0 where GPS or a network keeps the clocks.
        temperature: Of the air at night, for stars.
        pressure: There, for stars.
        dut1: UT1 - UTC at night, if known.
        refraction: Refraction of light from landmarks and terrain, and its standard deviation, beforehand; 0±0 for
            straight lines.
    """

    pairs: Several[kinds.Observed] | None = None
    match: Rare[kinds.Table | None] = None
    landmarks: kinds.Survey | None = None
    marks: kinds.Marks | None = None
    features: Rare[kinds.Marks | None] = None
    positions: kinds.Survey | None = None
    baseline: Annotated[str, Kind(metavar="M±SIGMA")] | None = None
    site: Rare[kinds.Place | None] = None
    survey_sigma: Rare[kinds.Meters | None] = None
    geoid: Rare[kinds.Meters | None] = None
    stars: Annotated[Several[str], Kind(metavar="LEFT RIGHT")] | None = None
    scene: Annotated[Several[str], Kind(metavar="LEFT RIGHT")] | None = None
    skyline: Rare[Annotated[Several[str], Kind(metavar="IMAGES")] | None] = None
    terrain: Rare[kinds.Raster | None] = None
    terrain_sigma: Rare[kinds.Sigma | None] = None
    skyline_picture: Rare[kinds.Picture | None] = None
    tracks: Rare[Annotated[tuple[kinds.Table, kinds.Table], Kind(metavar="TRACKS.csv SIGHTINGS.csv")] | None] = None
    tracks_clock: Rare[kinds.Seconds] = 2.0
    time: Rare[kinds.Times | None] = None
    clock_sigma: Rare[kinds.Seconds] = 0.1
    clock_drift: Rare[kinds.Seconds] = 0.05
    temperature: Rare[kinds.Celsius | None] = None
    pressure: Rare[kinds.Hectopascal | None] = None
    dut1: Rare[kinds.Clock | None] = None
    refraction: Rare[kinds.MeasuredRefraction] = _REFRACTION
    pixel_sigma: kinds.PixelSigma | None = None

    @property
    def marks_sigma(self) -> float:
        """Noise of marks, px: as given, or assumed."""
        return pixel_sigma_and_source(self.pixel_sigma)[0]

    @property
    def refraction_sigma(self) -> float:
        """Of the refraction, as given, or as it is by day over land."""
        return _REFRACTION_SIGMA if self.refraction.sigma is None else self.refraction.sigma

    @property
    def given(self) -> bool:
        """Whether there is anything to solve a rig from."""
        return any(getattr(self, name) for name in _SOURCES)
