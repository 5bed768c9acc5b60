"""Engine: which model do most of the data agree on? It knows no model; the rooms that do bring an `Estimator`."""

from torchsfm.robust.degeneracy import Degeneracy
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.local_optimisation import damped_solve
from torchsfm.robust.multi_structure import Structures, find_structures
from torchsfm.robust.ransac import RobustResult, ransac
from torchsfm.robust.request import Request
from torchsfm.robust.scores import InlierCount, LeastMedian, Magsac, Msac, Score
from torchsfm.robust.soft_selection import SoftSelection, soft_ransac

__all__ = [
    "Degeneracy",
    "Estimator",
    "InlierCount",
    "LeastMedian",
    "Magsac",
    "Msac",
    "Request",
    "RobustResult",
    "Score",
    "SoftSelection",
    "Structures",
    "damped_solve",
    "find_structures",
    "ransac",
    "soft_ransac",
]
