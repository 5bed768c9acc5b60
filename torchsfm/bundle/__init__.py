"""Which poses, cameras and structure, all together, explain the images best?"""

from torchsfm.bundle.bundle_adjust import BundleResult, bundle_adjust
from torchsfm.bundle.bundle_covariance import BundleCovariance, bundle_covariance

__all__ = ["BundleCovariance", "BundleResult", "bundle_adjust", "bundle_covariance"]
