"""What all tests share: where real data lie, and repeatable property tests."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import torch
from waiting import Watch

# The same examples each time: a failure belongs to the change that is tested. Time is not what is tested.
hypothesis.settings.register_profile(
    "kcal", derandomize=True, deadline=None, print_blob=True, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("kcal")


def pytest_configure(config: pytest.Config) -> None:
    """No test waits for more than a minute."""
    if sys.platform == "linux":
        config.pluginmanager.register(Watch(float(os.environ.get("KCAL_WAIT", "60"))))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """What is drawn without a generator of its own does not depend on the tests that ran before in this process."""
    np.random.seed(0)  # noqa: NPY002
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def kcal_data() -> Path:
    """The folder of real data, named by KCAL_DATA; tests that need it skip without it."""
    folder = os.environ.get("KCAL_DATA")
    if not folder:
        pytest.skip("KCAL_DATA is not set: it names the folder with the real images and corners")
    path = Path(folder)
    assert path.is_dir(), f"KCAL_DATA={folder} is no folder"
    return path
