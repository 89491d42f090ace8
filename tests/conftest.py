"""What all tests share: where real data lie, and repeatable property tests."""

import os
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
import torch
from command_line import Command
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


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with the most slow tests come first, so that no process works on one while the others have ended."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


# The states in which the generators of modules of tests began.
_BEGINNINGS: dict[int, dict[str, Any]] = {}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """What is drawn does not depend on the tests that ran before, in this process or in this file."""
    np.random.seed(0)  # noqa: NPY002
    torch.manual_seed(0)
    for value in vars(getattr(item, "module", item)).values():
        if isinstance(value, torch.Generator):
            value.manual_seed(value.initial_seed())
        elif isinstance(value, np.random.Generator):
            value.bit_generator.state = _BEGINNINGS.setdefault(id(value), value.bit_generator.state)


@pytest.fixture(scope="session")
def kcal_data() -> Path:
    """The folder of real data, named by KCAL_DATA; tests that need it skip without it."""
    folder = os.environ.get("KCAL_DATA")
    if not folder:
        pytest.skip("KCAL_DATA is not set: it names the folder with the real images and corners")
    path = Path(folder)
    assert path.is_dir(), f"KCAL_DATA={folder} is no folder"
    return path


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(monkeypatch, capsys)
