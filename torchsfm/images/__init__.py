"""What is in the image, and where? Files, features, corners, tracks and matches; the only room with OpenCV and kornia."""

from torchsfm.images.boards import BoardPoints, detect_chessboard, detect_circles_grid
from torchsfm.images.corners import Corners, detect_corners
from torchsfm.images.curve_tracking import TrackedCurves, track_curves
from torchsfm.images.dense_motion import DenseMotion, detect_motion
from torchsfm.images.edges import Edges, detect_edges
from torchsfm.images.ellipses import Ellipses, detect_ellipses
from torchsfm.images.exif import Exif, parse_exif
from torchsfm.images.features import Features, detect_features
from torchsfm.images.film import extract_frames
from torchsfm.images.fit_ellipse import EllipseFit, fit_ellipse
from torchsfm.images.hough import HoughLines, hough_lines
from torchsfm.images.learned import LearnedDetector, LearnedMatcher, load_detector, load_matcher
from torchsfm.images.listing import FILMS, SUFFIXES, list_images, list_skipped
from torchsfm.images.matching import match_descriptors, match_features
from torchsfm.images.preemptive import preview_matches, promising_pairs
from torchsfm.images.reading import MAX_PIXELS, ImageError, Photograph, read_image, save_image, scale_image
from torchsfm.images.retrieval import describe_images, retrieve_pairs
from torchsfm.images.segment_matching import describe_segments, match_segments
from torchsfm.images.segments import Segments, detect_segments
from torchsfm.images.tracking import TrackedPoints, Tracks, track_points, track_sequence
from torchsfm.images.undistort import Pinholes, undistort_images, undistorted_cameras

__all__ = [
    "FILMS",
    "MAX_PIXELS",
    "SUFFIXES",
    "BoardPoints",
    "Corners",
    "DenseMotion",
    "Edges",
    "EllipseFit",
    "Ellipses",
    "Exif",
    "Features",
    "HoughLines",
    "ImageError",
    "LearnedDetector",
    "LearnedMatcher",
    "Photograph",
    "Pinholes",
    "Segments",
    "TrackedCurves",
    "TrackedPoints",
    "Tracks",
    "describe_images",
    "describe_segments",
    "detect_chessboard",
    "detect_circles_grid",
    "detect_corners",
    "detect_edges",
    "detect_ellipses",
    "detect_features",
    "detect_motion",
    "detect_segments",
    "extract_frames",
    "fit_ellipse",
    "hough_lines",
    "list_images",
    "list_skipped",
    "load_detector",
    "load_matcher",
    "match_descriptors",
    "match_features",
    "match_segments",
    "parse_exif",
    "preview_matches",
    "promising_pairs",
    "read_image",
    "retrieve_pairs",
    "save_image",
    "scale_image",
    "track_curves",
    "track_points",
    "track_sequence",
    "undistort_images",
    "undistorted_cameras",
]
