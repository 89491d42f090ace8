"""`kcal rays`: the ray of every pixel, for renderers such as gsplat."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.camera_sources import named_source, single_camera
from kcal.cli.console import out, print_wrote, steps, tell
from kcal.cli.inputs import CAMERA_OR_RIG
from kcal.errors import InputError
from kcal.files import check_writable, write_atomic


def rays_command(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="CAMERA...", help="Camera files of one image size, or one rig file."),
        CAMERA_OR_RIG,
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="NPZ", help="File to write.")],
) -> None:
    """Write the ray of every pixel, for Gaussian splatting and other renderers without lens models.

    The file has `rays` (C, H, W, 6) in float32, as gsplat takes them from version 1.6 on: origin, in meters, and
    direction of each pixel's ray. The origin lies on the camera's axis; for a lens with an entrance pupil that moves it
    is not the same for all pixels. Also `mask` (C, H, W), `viewmats` (C, 4, 4) and `Ks` (C, 3, 3). Rays of single
    cameras are in the camera's frame, those of a rig in the left camera's. Pixels without a ray have zeros.

    **Examples**

    `kcal rays left.camera.json -o rays.npz`

    `kcal rays rig.json -o rays.npz`
    """
    paths = [named_source(source)[0] for source in sources]
    check_writable(output, *paths)
    if output.suffix.lower() != ".npz":
        raise InputError(f"{output}: the name of the file must end with .npz")

    import numpy as np
    import torch

    from kcal.cli.rectify import rig_of
    from kcal.lens.paraxial import paraxial_focal
    from kcal.lens.rays import CameraRays, ray_error

    rig = rig_of(sources[0]) if len(sources) == 1 else None
    cameras = [single_camera(source) for source in sources] if rig is None else [rig.left, rig.right]
    viewmats = torch.eye(4, dtype=torch.float64).repeat(len(cameras), 1, 1)
    if rig is not None:
        viewmats[1, :3, :3], viewmats[1, :3, 3] = rig.right_from_left_rotation, rig.right_from_left_translation
    with steps("rays", 2) as advance:
        module = CameraRays(cameras)
        advance("rounding")
        error = max(ray_error(camera, own) for camera, own in zip(cameras, module(), strict=True))
        advance("writing")
    # gsplat counts pixels from the corner of the first one.
    Ks = torch.stack([camera.matrix.detach() for camera in cameras])
    Ks[:, :2, 2] += 0.5
    for matrix, camera in zip(Ks, cameras, strict=True):
        matrix[[0, 1], [0, 1]] = paraxial_focal(camera).value.detach()
    data = io.BytesIO()
    np.savez(
        data,
        allow_pickle=False,
        rays=module(viewmats).numpy(),
        mask=module.mask.numpy(),
        Ks=Ks.numpy(),
        viewmats=viewmats.numpy(),
    )
    write_atomic(output, data.getvalue())
    moved = float((module.depths * module.mask).abs().max())
    width, height = cameras[0].size
    share = float(module.mask.double().mean())
    text = f"rays {len(cameras)} x {height} x {width} x 6, float32; {100 * share:.1f} % of the pixels have one"
    out.print(text, markup=False)
    out.print(f"rounding: at most {error:.1e} px from the pixel, at 1 m and far away")
    if moved:
        out.print(f"the rays start up to {1e3 * moved:.3g} mm from each other on the axis: the entrance pupil moves")
    tell(cameras=len(cameras), valid=share, rounding_px=error, pupil_m=moved)
    print_wrote(output)
