"""What all tests share: one thread, seeds by option, real data by environment variable, tolerances by dtype."""

import functools
import gc
import importlib
import os
import pkgutil
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest
import torch
import type_checks
from chance import seeded, set_seed, stream_seed
from hypothesis import settings

pytest_plugins = ["scripts"]
# Nearly all that is made until the tests begin stays: to look for what is no longer used there takes long and finds little.
gc.disable()
# Nor is it worth a look at every seven hundred things more, while tests run.
gc.set_threshold(5_000, 10, 10)
torch.set_num_threads(1)
type_checks.install()
# No run remembers another.
settings.register_profile("torchsfm", deadline=None, database=None)
settings.load_profile("torchsfm")

TOLERANCE = {torch.float64: 1e-8, torch.float32: 1e-3}
"""Relative error wanted on exact data."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--seed", type=int, default=0, help="other random numbers in every test")
    parser.addoption("--device", default="cpu", help="where the data of every test lie: cuda, for one")


@pytest.hookimpl(tryfirst=True)  # before hypothesis reads its own
def pytest_configure(config: pytest.Config) -> None:
    set_seed(config.option.seed)
    # Workers share the cores: with threads for all of them in each they would only wait for one another.
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    torch.set_num_threads(max(1, torch.get_num_threads() // workers))
    if config.option.hypothesis_seed is None:
        config.option.hypothesis_seed = config.option.seed


def pytest_collection(session: pytest.Session) -> None:
    import torchsfm  # not before the type checker is in place

    device = session.config.option.device
    if device != "cpu":
        # What modules make when they are imported stays on the CPU, as where nobody sets a default.
        for room in pkgutil.iter_modules(torchsfm.__path__):
            if room.ispkg:
                importlib.import_module(f"torchsfm.{room.name}")
        importlib.import_module("bench.fuzz.functions")
        torch.set_default_device(device)
        # Other programs, with which answers are compared, take them on the CPU.
        torch.Tensor.numpy = functools.partialmethod(torch.Tensor.numpy, force=True)  # type: ignore[method-assign]


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop() -> None:
    gc.freeze()
    gc.enable()


def pytest_report_header(config: pytest.Config) -> str:
    option = config.option
    return f"seed {option.seed}, device {option.device}, {torch.backends.cpu.get_cpu_capability()} arithmetic"


@pytest.fixture(autouse=True)
def _global_stream() -> None:
    torch.manual_seed(stream_seed())


@pytest.fixture
def generator() -> torch.Generator:
    return seeded()


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real data sets; tests that want it are skipped where it is missing."""
    folder = os.environ.get("TORCHSFM_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("TORCHSFM_DATA does not name a folder of data sets")
    return Path(folder)


@pytest.fixture(scope="session")
def courtyard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of five photographs of one scene, to look at and not to change."""
    from command_line import photograph  # not before the type checker is in place

    return photograph(tmp_path_factory.mktemp("courtyard"))


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switch the runtime type checker off, to see the library's own errors for wrong shapes and dtypes."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
