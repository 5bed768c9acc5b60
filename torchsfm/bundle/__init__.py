"""Which poses, cameras and structure, all together, explain the images best?"""

from torchsfm.bundle.bundle_adjust import BundleResult, bundle_adjust

__all__ = ["BundleResult", "bundle_adjust"]
