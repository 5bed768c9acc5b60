"""What does it look like? Figures with matplotlib and an interactive 3D page."""

from torchsfm.plot.flat import plot_epipolar_lines, plot_matches, plot_points_2d, show_image, show_scaled
from torchsfm.plot.live import LiveViewer
from torchsfm.plot.page import write_page
from torchsfm.plot.residuals import plot_residuals
from torchsfm.plot.spatial import plot_cameras, plot_lines_3d, plot_points_3d, plot_tracks

__all__ = [
    "LiveViewer",
    "plot_cameras",
    "plot_epipolar_lines",
    "plot_lines_3d",
    "plot_matches",
    "plot_points_2d",
    "plot_points_3d",
    "plot_residuals",
    "plot_tracks",
    "show_image",
    "show_scaled",
    "write_page",
]
