"""A few damaged files of every format that is read; `python -m bench.fuzz.files` tries as many as wanted."""

import pytest
from chance import numpy_seeded, stream_seed

from bench.fuzz.campaign import Target
from bench.fuzz.files import FILES_PER_TRIAL, load
from bench.fuzz.mutations import WAYS, mend_png, mutate

TARGETS = {target.name: target for target in load()}


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_damaged_files_are_refused_or_sound(target: Target) -> None:
    for trial in range(4):
        found = target.attempt(stream_seed(trial))
        assert found.inputs == FILES_PER_TRIAL
        assert not found.broken, (
            f"python -m bench.fuzz.files --only '{target.name}' --seed {stream_seed(trial)}: {found.broken}"
        )


def test_mutations_change_files() -> None:
    """Every way does, mostly; none fails on an empty file."""
    data, random = bytes(range(256)) * 2, numpy_seeded()
    for way in WAYS:
        assert sum(way(data + b"\n1 2", random, b"other") != data + b"\n1 2" for _ in range(50)) > 25, way
        for _ in range(20):
            way(b"", random, b"")
    assert len({mutate(data, random, b"other") for _ in range(100)}) > 90
    assert mend_png(b"") == b""
