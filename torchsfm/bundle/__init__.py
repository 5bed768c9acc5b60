"""Which poses, cameras and structure, all together, explain the images best?"""

from torchsfm.bundle.bundle_adjust import BundleResult, bundle_adjust
from torchsfm.bundle.bundle_adjust_projective import ProjectiveBundleResult, bundle_adjust_projective
from torchsfm.bundle.bundle_covariance import BundleCovariance, bundle_covariance

__all__ = [
    "BundleCovariance",
    "BundleResult",
    "ProjectiveBundleResult",
    "bundle_adjust",
    "bundle_adjust_projective",
    "bundle_covariance",
]
