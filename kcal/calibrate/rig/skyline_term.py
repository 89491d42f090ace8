"""The skylines of a rig as a term of its adjustment."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from kcal.calibrate.rig.blocks import PosedCamera
from kcal.calibrate.rig.problem import SharedTerm
from kcal.calibrate.rig.skyline_source import SkylineSource
from kcal.lens.pose import vector_from_rotation


class SkylineTerm(SharedTerm):
    """The skylines of all images, as residuals of attitudes, centers and lenses."""

    def __init__(self, source: SkylineSource) -> None:
        self.cameras, self.count = tuple(sorted(set(source.cameras))), len(source.residual)
        self._source = source
        count = len(source.rotation)
        sizes = [3] * (2 * count) + [len(one) for one in source.parameters]
        parts = source.rows.split(sizes, 1)
        self._turn, self._center, self._lens = parts[:count], parts[count : 2 * count], parts[2 * count :]

    def rows(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `SharedTerm.rows`."""
        out = self._source.residual.new_zeros((shared_size + 1, self.count))
        out[-1] = self._source.residual
        for c in self.cameras:
            posed, source = cameras[c], self._source
            turn, center, lens = self._turn[c], self._center[c], self._lens[c]
            out[-1] += turn @ vector_from_rotation(posed.rotation @ source.rotation[c].T)
            out[-1] += center @ (posed.center - source.center[c]) + lens @ (posed.parameters - source.parameters[c])
            known = posed.by_unknown.shape[1]
            out[:known] += (lens @ posed.by_unknown).T
            if posed.turn is not None:
                out[posed.turn] += turn.T
            if posed.shift is not None:
                out[posed.shift] += center.T
        return out

    def against(self, off: Tensor, sigma: Tensor) -> str:
        """See `SharedTerm.against`."""
        times = float((off.square() / (1.0 + sigma.square())).mean().sqrt())
        return f"without it the cameras look elsewhere than their skylines say, by {times:.1f} times its sigmas"
