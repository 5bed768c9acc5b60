"""Numbers without geometry: decompositions that never raise, null spaces, roots of polynomials, nearest matrices."""

from torchsfm.linalg.damped_solve import damped_solve
from torchsfm.linalg.decompositions import eigh, eigvals, eigvalsh, inverse, qr, solve, svd, svdvals, triangular_factor
from torchsfm.linalg.elimination import adjugate_3x3, adjugate_4x4, cross, determinant_3x3
from torchsfm.linalg.magnitude import unit_scale, usable
from torchsfm.linalg.nullspace import null_vector, nullspace_rows, orthonormal_nullspace
from torchsfm.linalg.polynomial import companion_roots, evaluate, solve_cubic, solve_quadratic
from torchsfm.linalg.projections import nearest_psd, nearest_rank, nearest_rotation
from torchsfm.linalg.quartic import solve_quartic
from torchsfm.linalg.real_roots import real_roots

__all__ = [
    "adjugate_3x3",
    "adjugate_4x4",
    "companion_roots",
    "cross",
    "damped_solve",
    "determinant_3x3",
    "eigh",
    "eigvals",
    "eigvalsh",
    "evaluate",
    "inverse",
    "nearest_psd",
    "nearest_rank",
    "nearest_rotation",
    "null_vector",
    "nullspace_rows",
    "orthonormal_nullspace",
    "qr",
    "real_roots",
    "solve",
    "solve_cubic",
    "solve_quadratic",
    "solve_quartic",
    "svd",
    "svdvals",
    "triangular_factor",
    "unit_scale",
    "usable",
]
