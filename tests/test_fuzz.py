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
"""Of each target; one of what is slow."""
TRIED = [name for name in public_functions() if name not in EXCEPTIONS]


def test_the_tables_name_what_there_is() -> None:
    assert not (FUNCTIONS.keys() | EXCEPTIONS.keys()) - public_functions().keys()
    assert not FUNCTIONS.keys() & EXCEPTIONS.keys()
    assert {target.name.split()[0] for target in load()} == set(TRIED)


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
    slow = FUNCTIONS.get(target.name.split()[0], Function()).slow
    for trial in range(1 if slow else TRIALS):
        seed = stream_seed() % 10**6 + trial
        assert not target.attempt(seed).broken, f"python -m bench.fuzz --only '{target.name}' --seed {seed}"
