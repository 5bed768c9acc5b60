"""How does a model come from other programs, and how do they get it?"""

from torchsfm.formats.colmap import read_colmap, write_colmap
from torchsfm.formats.ply import PointCloud, read_ply, write_ply

__all__ = ["PointCloud", "read_colmap", "read_ply", "write_colmap", "write_ply"]
