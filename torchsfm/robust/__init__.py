"""Engine: which model do most of the data agree on? It knows no model; the rooms that do bring an `Estimator`."""

from torchsfm.robust.degeneracy import Degeneracy
from torchsfm.robust.doors import RansacOptions, SearchOptions, check_counts, check_door, estimate_robustly
from torchsfm.robust.estimator import (
    Diagnosed,
    Differentiable,
    Estimator,
    Located,
    Mixed,
    NeverZero,
    SolvedInSingle,
    Weigh,
    WithAlternatives,
    constant_weights,
)
from torchsfm.robust.multi_structure import Structures, find_structures
from torchsfm.robust.ransac import RobustResult, ransac
from torchsfm.robust.samplers import Neighbours, Prosac, Sampler, Uniform
from torchsfm.robust.scoring import InlierCount, LeastMedian, Magsac, Msac, Scoring
from torchsfm.robust.soft_selection import SoftSelection, soft_ransac

__all__ = [
    "Degeneracy",
    "Diagnosed",
    "Differentiable",
    "Estimator",
    "InlierCount",
    "LeastMedian",
    "Located",
    "Magsac",
    "Mixed",
    "Msac",
    "Neighbours",
    "NeverZero",
    "Prosac",
    "RansacOptions",
    "RobustResult",
    "Sampler",
    "Scoring",
    "SearchOptions",
    "SoftSelection",
    "SolvedInSingle",
    "Structures",
    "Uniform",
    "Weigh",
    "WithAlternatives",
    "check_counts",
    "check_door",
    "constant_weights",
    "estimate_robustly",
    "find_structures",
    "ransac",
    "soft_ransac",
]
