"""Which parameters make the residuals smallest, and how do they move when the data move? Engines that know no geometry."""

from torchsfm.optim.covariance import SparseCovariance, marginal_covariance, pair_covariance, sparse_covariance
from torchsfm.optim.implicit import attach_implicit, attach_optimum, for_slots, wants_derivative
from torchsfm.optim.levenberg_marquardt import LeastSquaresResult, levenberg_marquardt
from torchsfm.optim.loss import Cauchy, GemanMcClure, Huber, Loss, SoftL1, Truncated, Tukey, loss_slope
from torchsfm.optim.manifold import (
    Euclidean,
    Manifold,
    Positive,
    Product,
    RigidMotion,
    Rotation,
    Subset,
    UnitSphere,
    rotation_exponential,
)
from torchsfm.optim.sparse_levenberg_marquardt import SparseResult, sparse_levenberg_marquardt
from torchsfm.optim.terms import Block, Term

__all__ = [
    "Block",
    "Cauchy",
    "Euclidean",
    "GemanMcClure",
    "Huber",
    "LeastSquaresResult",
    "Loss",
    "Manifold",
    "Positive",
    "Product",
    "RigidMotion",
    "Rotation",
    "SoftL1",
    "SparseCovariance",
    "SparseResult",
    "Subset",
    "Term",
    "Truncated",
    "Tukey",
    "UnitSphere",
    "attach_implicit",
    "attach_optimum",
    "for_slots",
    "levenberg_marquardt",
    "loss_slope",
    "marginal_covariance",
    "pair_covariance",
    "rotation_exponential",
    "sparse_covariance",
    "sparse_levenberg_marquardt",
    "wants_derivative",
]
