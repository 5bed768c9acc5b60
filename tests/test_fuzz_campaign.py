"""The campaign itself: what hangs is told, and no target keeps the others from their turn."""

from pathlib import Path

import pytest

from bench.fuzz.campaign import run

TARGETS = """
from bench.fuzz.campaign import Target, Trial

def load():
    return [
        Target("a.idle", lambda seed: Trial(0)),
        Target("a.spins", lambda seed: Trial(sum(range(10**12)))),
        Target("a.works", lambda seed: Trial(1, ("bad: always",) if seed % 2 else ())),
    ]
"""


def test_hangs_are_told_and_all_get_their_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "made_targets.py").write_text(TARGETS)
    monkeypatch.syspath_prepend(str(tmp_path))
    seen: list[int] = []
    monkeypatch.setattr("bench.fuzz.campaign.CHECKPOINT", 0.0)
    names = ["a.idle", "a.spins", "a.works"]
    options = {"workers": 1, "seed": 0, "seconds": None, "limit": 0.3}
    found = run(["made_targets"], names, inputs=40, checkpoint=lambda tallies: seen.append(len(tallies)), **options)
    assert found["a.spins"].kinds.keys() == {"hung"}
    assert found["a.works"].kinds.keys() == {"bad"}
    assert found["a.works"].inputs > 10
    assert max(seen) == 3
