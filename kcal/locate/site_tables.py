"""Sites from a table, and from a rig of stations with what is known of it."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from kcal.errors import FileError, InputError
from kcal.lens.camera_rig import CameraRig
from kcal.lens.mounting import Origin
from kcal.locate.ground import Ground
from kcal.locate.multi_localizer import errors_by_camera
from kcal.locate.siting import Site
from kcal.locate.stations import station_mounting
from kcal.locate.tables import TableRow, read_rows
from kcal.locate.views import CommonErrors, PosedCameras, shared_pixels

_HEADER = "name,lat,lon,height"
_COLUMNS = (
    "name", "lat", "lon", "height", "mast", "heading", "field", "sigma", "elevation_sigma", "position_sigma", "reach",
)  # fmt: skip
# Pixels along each axis at which a rig's directions are judged.
_PLACES = 7
# Meters: so far away that errors of positions do not count.
_FAR = 1e8


def read_sites(path: str | Path, ground: Ground | None = None) -> list[Site]:
    r"""Read `name,lat,lon,height` and, if they are there, the other columns of a `Site`.

    These are heading, field, sigma and elevation_sigma (degrees), position_sigma and reach (meters); empty cells are as
    in `Site`. In place of height (of the camera, above the ellipsoid) there may be mast: meters above the ground.

    Raises:
        FileError: see `kcal.locate.read_marks`; a height and a mast, or neither; a mast where no ground is known.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "sites.csv")
        ...     _ = path.write_text("name,lat,lon,height,heading,field\nmill,45,6,812,90,60\n")
        ...     site = read_sites(path)[0]
        >>> site.name, site.heading_deg, site.field_deg
        ('mill', 90.0, 60.0)
    """
    return [_table_site(row, ground) for row in read_rows(path, _HEADER, _COLUMNS, ("name", "lat", "lon"))]


def _table_site(row: TableRow, ground: Ground | None) -> Site:
    stated = {column: row.number(column) for column in _COLUMNS[1:] if row.cells.get(column)}
    if ("height" in stated) == ("mast" in stated):
        raise FileError(
            f"{row.where}: {row.name!r} needs a height (of the camera, above the ellipsoid) or a mast (above the "
            "ground), and one of them only"
        )
    lat, lon = row.number("lat"), row.number("lon")
    if "mast" in stated:
        below = math.nan if ground is None else float(ground(*torch.tensor([[lat], [lon]], dtype=torch.float64)))
        if not math.isfinite(below):
            why = "no terrain was given" if ground is None else "the terrain has no height there"
            raise FileError(f"{row.where}: {row.name!r} has a mast, and {why}; write its height")
        stated["height"] = below + stated["mast"]
    names = {
        "heading": "heading_deg", "field": "field_deg", "sigma": "sigma_deg", "reach": "reach_m",
        "elevation_sigma": "elevation_sigma_deg", "position_sigma": "position_m",
    }  # fmt: skip
    more = {names[column]: value for column, value in stated.items() if column in names}
    try:
        origin = Origin(lat=lat, lon=lon, height=stated["height"])
        return Site(name=row.name, origin=origin, **more)  # type: ignore[arg-type]
    except InputError as error:
        raise FileError(f"{row.where}: {error}") from error


@torch.no_grad()
def sites_of(rig: CameraRig, pixel_sigma: float = 0.3) -> list[Site]:
    """The cameras of a rig as sites, with what is known of lens and attitude together, half-way over the image.

    What errors of several cameras have in common is not part of it: `MultiViewLocalizer` knows it.

    Args:
        rig: with an origin.
        pixel_sigma: of a mark along each axis, px.

    Raises:
        InputError: a rig without an origin.

    Example:
        >>> from kcal import Camera
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = CameraRig([camera], ["mill"], enu_from_cam(90.0).T[None], torch.zeros(1, 3),
        ...                 origin=Origin(lat=45.0, lon=6.0, height=812.0))
        >>> rig.root = rig.with_errors(attitude_deg=(0.01, 0.01, 0.2))
        >>> site = sites_of(rig, pixel_sigma=1.0)[0]
        >>> round(site.heading_deg), round(site.sigma_deg, 2), round(site.elevation_sigma_deg, 2)
        (90, 0.2, 0.04)
    """
    sites = []
    for c, (name, camera) in enumerate(zip(rig.names, rig.each, strict=True)):
        stands = station_mounting(rig, c)
        width, height = camera.size
        across, down = (
            torch.linspace(0.25, 0.75, _PLACES, dtype=torch.float64) * (side - 1) for side in (width, height)
        )
        pixels = torch.cartesian_prod(across, down)
        rays, valid = camera.unproject(pixels)
        pixels, rays = pixels[valid], rays[valid]
        # Degrees that a pixel is wide and high there.
        steps = [
            torch.rad2deg((camera.unproject(pixels + step)[0] - rays).norm(dim=-1)) for step in torch.eye(2).double()
        ]
        spread = torch.full((len(rays), 2), pixel_sigma**2, dtype=torch.float64)
        position = 0.0
        if rig.root is not None:
            position = float((stands.covariance[:2, :2].trace() / 2).sqrt()) if stands.covariance is not None else 0.0
            alone = CameraRig([camera], [name], rig.rotation[c : c + 1], rig.center[c : c + 1], refraction=0.0)
            first = sum(rig.sizes[:c])
            columns = torch.cat([rig.root[:, first : first + rig.sizes[c]], rig.root[:, rig.pose_columns(c)]], 1)
            root = torch.nn.functional.pad(columns, (0, 1))
            half, bending, lens = errors_by_camera(alone, root)
            if half is not None and bending is not None:
                spread = spread + _common_variance(alone, CommonErrors(lens, half, bending), rays @ rig.rotation[c])
        sigma = [float((spread[:, axis].sqrt() * steps[axis]).median()) for axis in (0, 1)]
        sites.append(Site(
            name=name, origin=stands.origin, heading_deg=stands.heading_deg, pitch_deg=stands.pitch_deg,
            roll_deg=stands.roll_deg, camera=camera, sigma_deg=sigma[0], elevation_sigma_deg=sigma[1],
            position_m=position,
        ))  # fmt: skip
    return sites


def _common_variance(alone: CameraRig, common: CommonErrors, rays: Tensor) -> Tensor:
    """(N, 2) variance that common errors of one camera give its pixels of things far away, in px²."""
    posed = PosedCameras(alone.each, alone.rotation, alone.center)
    used = torch.ones(len(rays), 1, dtype=torch.bool)
    place, inverse = alone.center.expand(len(rays), 3), torch.full((len(rays),), 1.0 / _FAR, dtype=torch.float64)
    moved = shared_pixels(posed, common, (place, rays, inverse), used, posed.scale)
    return moved.square().sum(0).T
