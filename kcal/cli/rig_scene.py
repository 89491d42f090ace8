"""Pairs of images of the scene itself, for `kcal rig --scene`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kcal.errors import InputError

if TYPE_CHECKING:
    from kcal.calibrate.rig.sources import Features
    from kcal.lens.camera import Camera


def read_scene(cameras: tuple[Camera, Camera], given: tuple[str, str], *, scaled: bool) -> tuple[Features, list[str]]:
    """Matches of all pairs of images, and lines that say what was matched and left out.

    Args:
        cameras: left and right.
        given: images of each: a file, a folder or a wildcard.
        scaled: whether anything else tells a length.

    Raises:
        InputError: nothing tells a length, or images without partners or with too little in common.
    """
    from kcal.calibrate.rig.pairs import pair_by_name
    from kcal.cli.console import steps, warn
    from kcal.corners.images import expand_images, read_gray
    from kcal.scene.match import ImagePair, match_scene, scene_of

    if not scaled:
        raise InputError(
            "--scene alone leaves the scale open: with twice the baseline everything would be twice as far away, and "
            "the images the same. Add --baseline, --landmarks, --positions or boards (--pairs)"
        )
    files = [{path.name: path for path in expand_images([one])} for one in given]
    named = [list(own) for own in files]
    chosen = [(named[0][0], named[1][0])] if len(named[0]) == len(named[1]) == 1 else pair_by_name(*named)
    if not chosen:
        raise InputError(f"--scene: no image of {given[0]} belongs to one of {given[1]}; name pairs alike")
    pairs, found, refused = [], [], list[str]()
    with steps("matching the scene", len(chosen)) as advance:
        for left, right in chosen:
            pair = ImagePair(left, read_gray(files[0][left]), read_gray(files[1][right]))
            try:
                found.append(match_scene(cameras, pair))
                pairs.append(pair)
            except InputError as error:
                refused.append(str(error))
            advance(left)
    if not pairs:
        raise InputError(f"--scene: {refused[0]}")
    for text in refused:
        warn(f"{text}; left out")
    features, counts = scene_of(cameras, pairs, found)
    rows: list[tuple[str, ...]] = [("scene", "matched", "no texture", "off the line", "moved", "thinned", "used")]
    rows += [
        (one.name, *map(str, (one.matched, one.untextured, one.off_line, one.moved, one.thinned, one.used)))
        for one in counts
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
    alone = len(named[0]) + len(named[1]) - 2 * len(chosen)
    if alone:
        lines.append(f"{alone} images of the scene without partner")
    if len(pairs) == 1:
        lines.append("one pair: what moves cannot be told from what stands still; give pairs of several times")
    return features, lines
