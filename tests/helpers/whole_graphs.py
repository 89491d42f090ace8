"""Tests that compile a camera or a rig as one graph, which torch up to 2.9 cannot trace."""

import pytest
import torch
from packaging.version import Version

traced_whole = pytest.mark.skipif(
    Version(torch.__version__).release[:2] <= (2, 9),
    reason="torch.compile(..., fullgraph=True) of a camera needs torch newer than 2.9",
)
