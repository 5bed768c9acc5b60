"""Run by test_compiled.py with a seed and names of estimators: costs of models, compiled and as they are."""

import importlib
import pkgutil
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from scenes import make_scene

import torchsfm
from torchsfm import compile_kernels
from torchsfm._types import tensor_map
from torchsfm.robust import InlierCount, LeastMedian, Magsac, Msac
from torchsfm.robust.hypotheses import _costs, losses

seed, wanted = int(sys.argv[1]), sys.argv[2:]
rooms = [importlib.import_module(f"torchsfm.{room.name}") for room in pkgutil.iter_modules(torchsfm.__path__) if room.ispkg]
kinds = {kind.model_name: kind for room in rooms for kind in getattr(room, "ESTIMATORS", ())}
generator = torch.Generator().manual_seed(seed)
for name in wanted or kinds:
    scores = (Msac(), InlierCount(), Magsac(), LeastMedian()) if wanted else (Msac(),)
    for score in scores:
        for g, s, n in ((3, 4, 50), (1, 1, 1), (5, 1, 17), (1, 33, 300)):
            scene = make_scene(kinds[name], (g,), n, generator, 1e-3)
            models = tensor_map(lambda t: torch.stack([t + 1e-3 * k for k in range(s)], 1), scene.model)  # noqa: B023
            wide = tensor_map(lambda t: t[:, None], scene.estimator)
            data, limit = [d[:, None] for d in scene.data], torch.full((g,), 1e-4, dtype=torch.float64)
            for counts in (None, torch.arange(n).expand(g, n) % 3 != 1):
                compile_kernels(False)
                plain = losses(wide, models, data, limit, counts, score)
                compile_kernels()
                compiled = losses(wide, models, data, limit, counts, score)
                torch.testing.assert_close(compiled, plain, rtol=1e-4, atol=1e-9, msg=lambda m: f"{name} {(g, s, n)}: {m}")  # noqa: B023
    print(name, "agrees", flush=True)
for variants in _costs._variants.values():
    # No size is taken for a constant.
    assert not any("Eq(" in variant.reason for variant in variants), variants
