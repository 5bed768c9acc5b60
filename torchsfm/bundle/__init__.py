"""Which poses, cameras and structure, all together, explain the images best?"""

from torchsfm.bundle.blocks import BundleTerms
from torchsfm.bundle.bundle_adjust import BundleResult, bundle_adjust
from torchsfm.bundle.bundle_adjust_model import AdjustedModel, BundleModel, bundle_adjust_model
from torchsfm.bundle.bundle_adjust_projective import ProjectiveBundleResult, bundle_adjust_projective
from torchsfm.bundle.bundle_covariance import BundleCovariance, bundle_covariance
from torchsfm.bundle.conics import BundleConics
from torchsfm.bundle.curves import BundleCurves
from torchsfm.bundle.gauge import Gauge
from torchsfm.bundle.intrinsics_covariance import intrinsics_covariance
from torchsfm.bundle.lines import BundleLines
from torchsfm.bundle.match_weights import match_weights
from torchsfm.bundle.priors import CentrePrior, PointPrior, PosePrior, Prior, RelativePosePrior
from torchsfm.bundle.rig import Rig
from torchsfm.bundle.structure import Structure
from torchsfm.bundle.track_weights import track_weights

__all__ = [
    "AdjustedModel",
    "BundleConics",
    "BundleCovariance",
    "BundleCurves",
    "BundleLines",
    "BundleModel",
    "BundleResult",
    "BundleTerms",
    "CentrePrior",
    "Gauge",
    "PointPrior",
    "PosePrior",
    "Prior",
    "ProjectiveBundleResult",
    "RelativePosePrior",
    "Rig",
    "Structure",
    "bundle_adjust",
    "bundle_adjust_model",
    "bundle_adjust_projective",
    "bundle_covariance",
    "intrinsics_covariance",
    "match_weights",
    "track_weights",
]
