"""Which parameters make the residuals smallest, and how do they move when the data move? Engines that know no geometry."""

from torchsfm.optim.implicit import attach_implicit, attach_optimum, wants_derivative
from torchsfm.optim.loss import Cauchy, GemanMcClure, Huber, Loss, SoftL1, Truncated, Tukey, loss_slope
from torchsfm.optim.manifold import Euclidean, Manifold, RigidMotion, Rotation, Subset, UnitSphere

__all__ = [
    "Cauchy",
    "Euclidean",
    "GemanMcClure",
    "Huber",
    "Loss",
    "Manifold",
    "RigidMotion",
    "Rotation",
    "SoftL1",
    "Subset",
    "Truncated",
    "Tukey",
    "UnitSphere",
    "attach_implicit",
    "attach_optimum",
    "loss_slope",
    "wants_derivative",
]
