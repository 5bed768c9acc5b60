"""A slice of the fuzz of all public functions; `python -m bench.fuzz` runs it by the million."""

import pytest
import torch
from chance import stream_seed

from bench.fuzz.calls import apply, good_arguments, load
from bench.fuzz.campaign import Target
from bench.fuzz.functions import EXCEPTIONS, FUNCTIONS, Function, public_functions
from bench.fuzz.promises import not_finite, verdict
from bench.fuzz.scene import Scene

TRIALS = 3
"""Of each target; one of what is slow, and of functions that search long in vain where problems are damaged."""
SECONDS = frozenset(
    f"{room}.{name}" for room, names in {
        "autocalibration": ("calibrate_planes", "calibrate_view_graph", "constant_intrinsics", "intrinsics_from_plane",
            "intrinsics_from_rotations"),
        "motion": ("estimate_fundamentals", "estimate_homographies", "factorize_points", "fundamental_from_conics",
            "position_globally", "quadrifocal_6pt"),
        "reconstruction": ("reconstruct_tracks",),
        "resection": ("camera_conics",),
        "robust": ("find_structures",),
        "triangulation": ("triangulate_lines", "triangulate_quadrics"),
    }.items() for name in names
)  # fmt: skip
TRIED = [name for name in public_functions() if name not in EXCEPTIONS]


def test_the_tables_name_what_there_is() -> None:
    assert not (FUNCTIONS.keys() | EXCEPTIONS.keys()) - public_functions().keys()
    assert not FUNCTIONS.keys() & EXCEPTIONS.keys()
    assert {target.name.split()[0] for target in load()} == set(TRIED)
    assert set(TRIED) >= SECONDS


@pytest.mark.parametrize("name", TRIED)
def test_good_arguments_are_good(name: str, generator: torch.Generator) -> None:
    how = FUNCTIONS.get(name, Function())
    batch = (2,) if how.slow else (6,)
    scene = Scene(generator, batch if how.batched else (), tuple(how.sizes.items()), how.planar, how.centred)
    call = public_functions()[name]
    result = apply(call, good_arguments(call, how, scene))
    good = verdict(result)
    assert not list(not_finite(result))
    assert good is None or good.any()


@pytest.mark.parametrize("target", load(), ids=lambda target: target.name)
@pytest.mark.filterwarnings("ignore")
def test_promises_are_kept(target: Target, unchecked: None) -> None:
    name, what = target.name.split()
    slow = FUNCTIONS.get(name, Function()).slow or (name in SECONDS and what == "values")
    for trial in range(1 if slow else TRIALS):
        seed = stream_seed() % 10**6 + trial
        assert not target.attempt(seed).broken, f"python -m bench.fuzz --only '{target.name}' --seed {seed}"
