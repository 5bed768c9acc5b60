"""What is in the image, and where? Files, features, corners, tracks and matches; the only room with OpenCV and kornia."""

from torchsfm.images.corners import Corners, detect_corners
from torchsfm.images.exif import Exif, parse_exif
from torchsfm.images.features import Features, detect_features
from torchsfm.images.matching import match_descriptors, match_features
from torchsfm.images.reading import ImageError, Photograph, list_images, read_image, save_image, scale_image
from torchsfm.images.tracking import TrackedPoints, Tracks, track_points, track_sequence

__all__ = [
    "Corners",
    "Exif",
    "Features",
    "ImageError",
    "Photograph",
    "TrackedPoints",
    "Tracks",
    "detect_corners",
    "detect_features",
    "list_images",
    "match_descriptors",
    "match_features",
    "parse_exif",
    "read_image",
    "save_image",
    "scale_image",
    "track_points",
    "track_sequence",
]
