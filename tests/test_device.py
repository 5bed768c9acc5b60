"""Data elsewhere than on the CPU: every public function works there, and nothing is taken along unasked.

Without an accelerator the device is a pretended one, which tells when tensors of two devices meet; `--device cuda` takes a real
one.
"""

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import small_model
import torch
from chance import seeded
from elsewhere import CONSTANT, ELSEWHERE, TransferError, elsewhere, fetch, send
from scenes import make_scene
from test_contract import ESTIMATORS

from bench.fuzz.calls import apply, good_arguments
from bench.fuzz.functions import EXCEPTIONS, FUNCTIONS, Function, public_functions
from bench.fuzz.promises import tensors
from bench.fuzz.scene import Scene
from torchsfm._types import tensor_map
from torchsfm.bundle import bundle_adjust_model
from torchsfm.formats.registry import FORMATS_BY_NAME, read_model_or_problem, write_model
from torchsfm.linalg import real_roots
from torchsfm.linalg.semidefinite import SMALL, pseudo_inverse
from torchsfm.reconstruction import align_models, align_upright
from torchsfm.robust import ransac, soft_ransac
from torchsfm.simulation import random_bundle_problem

STEPS = 8
"""Of what is slow."""
OPENCV = "OpenCV takes images and gives points on the CPU"
ON_THE_CPU = EXCEPTIONS | {
    **{
        f"images.{name}": OPENCV
        for name in (
            "detect_chessboard",
            "detect_corners",
            "detect_features",
            "detect_motion",
            "track_curves",
            "track_points",
            "track_sequence",
        )
    },
    "images.list_skipped": "reads a folder",
    "images.retrieve_pairs": "pairs are numbers for the program, not data",
    "linalg.companion_roots": "gives the roots in any order",
    "reconstruction.reconstruct_tracks": "maps on the CPU",
}
"""Public functions that are not tried, and why."""
CALLS = {name: call for name, call in public_functions().items() if name not in ON_THE_CPU}


@dataclass(frozen=True)
class Device:
    """Where the data are to lie."""

    name: torch.device

    @property
    def pretended(self) -> bool:
        return self.name == ELSEWHERE

    def send(self, tree: Any) -> Any:
        return tensor_map(send if self.pretended else lambda t: t.to(self.name), tree)

    def compare(self, call: Callable[[Any], Any], arguments: Any, here: Any) -> None:
        """All results lie there; pretended, they are those here on the CPU, but for rounding."""
        with elsewhere() if self.pretended else nullcontext():
            there = call(self.send(arguments))
        for (name, wanted), (_, found) in zip(tensors(here), tensors(there), strict=True):
            assert found.device.type == self.name.type, name
            assert found.shape == wanted.shape or not self.pretended, name
            assert found.dtype == wanted.dtype, name
            if self.pretended:
                torch.testing.assert_close(fetch(found), wanted, rtol=1e-6, atol=1e-6, equal_nan=True)


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    wanted = request.config.option.device
    if wanted == "cpu":
        yield Device(ELSEWHERE)
        return
    with torch.device("cpu"):  # what is made without `device=` is to be found out
        yield Device(torch.device(wanted))


def agreeable(name: str) -> tuple[dict[str, Any], Any]:
    """Arguments that the function accepts, and its answer, which tests share.

    Some that may be left out belong together, and chance separates them: these are not accepted. What is slow gets one
    problem and few steps: these are enough to see where its numbers lie.
    """
    return _agreeable(name, torch.get_default_device())


@cache
def _agreeable(name: str, device: torch.device) -> tuple[dict[str, Any], Any]:
    call, how = public_functions()[name], FUNCTIONS.get(name, Function())
    batch = (1,) if how.slow else (2,)
    for stream in range(20):
        scene = Scene(seeded(stream), batch if how.batched else (), tuple(how.sizes.items()), how.planar, how.centred)
        arguments = good_arguments(call, how, scene)
        if how.slow and "max_iterations" in inspect.signature(call).parameters:
            arguments["max_iterations"] = STEPS
        try:
            return arguments, apply(call, arguments)
        except ValueError:
            continue
    raise LookupError("no arguments that are accepted")


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.usefixtures("unchecked")
def test_functions(name: str, device: Device) -> None:
    arguments, here = agreeable(name)
    if not any(True for _ in tensors(arguments)):
        pytest.skip("takes no tensors")
    device.compare(lambda given: apply(CALLS[name], given), arguments, here)


@pytest.mark.parametrize("kind", ESTIMATORS, ids=lambda kind: kind.model_name)
def test_estimators(kind: type, device: Device) -> None:
    scene = make_scene(kind, (3,), 60, seeded(), 1e-3)
    sample = tuple(d[:, : kind.sample_size] for d in scene.data)  # type: ignore[attr-defined]
    options = {"threshold": 3e-3, "max_iterations": 200}
    arguments = scene.estimator, scene.model, scene.data, sample
    for call in (
        lambda a: (a[0].minimal(*a[3]), a[0].degenerate(*a[3]), a[0].squared_residual(a[1], *a[2])),
        lambda a: ransac(a[0], *a[2], generator=seeded(1), **options),
        lambda a: soft_ransac(a[0], *a[2], threshold=3e-3, hypotheses=8, generator=seeded(1)),
    ):
        device.compare(call, arguments, call(arguments))


@pytest.mark.parametrize("number", [49, 98, 103, 107])
def test_roots_where_a_division_is_rounded_twice(number: int, device: Device) -> None:
    c = torch.randn(number, 6, dtype=torch.float64, generator=seeded())
    device.compare(real_roots, c, real_roots(c))


@contextmanager
def by_default(device: Device) -> Iterator[None]:
    """Tensors made without `device=` lie there."""
    with elsewhere() if device.pretended else nullcontext(), torch.device(device.name):
        yield


def alike(there: Any, here: Any) -> None:
    for (name, wanted), (_, own) in zip(tensors(here), tensors(there), strict=True):
        assert own.device.type == "cpu", name
        torch.testing.assert_close(own, wanted, rtol=0, atol=0, equal_nan=True)


INDIFFERENT = (
    "images.retrieve_pairs", "images.track_points", "images.track_sequence", "motion.essential_5pt",
    "reconstruction.reconstruct_tracks", "resection.camera_p35pf", "simulation.random_intrinsics", "simulation.random_points",
    "simulation.random_poses", "simulation.simulate_images", "simulation.simulate_segments",
)  # fmt: skip


@pytest.mark.parametrize("name", INDIFFERENT)
@pytest.mark.usefixtures("unchecked")
def test_the_default_device_is_of_no_account(name: str, device: Device) -> None:
    """Data on the CPU stay there, and what is drawn lies where its generator is."""
    call = public_functions()[name]
    arguments, here = agreeable(name)
    with by_default(device):
        there = apply(call, arguments)
    alike(there, here)


def test_large_systems_take_no_account_of_it(device: Device) -> None:
    problem = random_bundle_problem(4, 40, 120, generator=seeded()).problem

    def answers() -> Any:
        adjusted = bundle_adjust_model(problem, linear_solver="pcg", max_iterations=3).result.cost
        inverse = pseudo_inverse(torch.eye(SMALL + 1, dtype=torch.float64, device="cpu"), 1e-12).inverse
        drawn = random_bundle_problem(4, 40, 120, generator=torch.Generator("cpu").manual_seed(0)).problem
        return drawn, torch.tensor(adjusted, device="cpu"), inverse

    here = answers()
    with by_default(device):
        there = answers()
    alike(there, here)


@pytest.mark.parametrize("name", ["model.npz", "colmap", "reconstruction.json", "bundle.out", "kapture", "problem.txt"])
def test_files_take_no_account_of_it(name: str, device: Device, tmp_path: Path) -> None:
    model, kind = small_model.make("radial"), name if name in FORMATS_BY_NAME else None
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    here, there = tmp_path / "a" / name, tmp_path / "b" / name
    write_model(model, here, kind)
    with by_default(device):
        write_model(model, there, kind)
        alike(read_model_or_problem(there), read_model_or_problem(here))
        align_models(model, model)
        align_upright(model)


def test_the_pretended_device_tells() -> None:
    with torch.device("cpu"), elsewhere():
        here = torch.ones(3, 3)
        there = send(here)
        for wrong in (
            lambda: there + here,
            lambda: there.index_select(0, torch.ones(CONSTANT + 1, dtype=torch.long)),
            lambda: torch.cat((there, torch.zeros(1, 3))),
            lambda: there[torch.ones(3, dtype=torch.bool)],
            there.cpu,
        ):
            with pytest.raises(TransferError):
                wrong()
        assert torch.equal(fetch(there + 2 * torch.eye(3, device=there.device)[[0, 1, 2]]), here + 2 * torch.eye(3))
        assert int(there.sum()) == 9
