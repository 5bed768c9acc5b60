"""What all tests share: one thread, fixed seeds, real data by environment variable, tolerances by dtype."""

import os
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest
import torch

torch.set_num_threads(1)

TOLERANCE = {torch.float64: 1e-8, torch.float32: 1e-3}
"""Relative error wanted on exact data."""


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real data sets; tests that want it are skipped where it is missing."""
    folder = os.environ.get("TORCHSFM_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("TORCHSFM_DATA does not name a folder of data sets")
    return Path(folder)


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switch the runtime type checker off, to see the library's own errors for wrong shapes and dtypes."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
