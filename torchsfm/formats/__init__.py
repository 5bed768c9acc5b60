"""How does a model come from other programs, and how do they get it?"""

from torchsfm.formats.bal import read_bal, write_bal
from torchsfm.formats.colmap import read_colmap, write_colmap
from torchsfm.formats.libmv import read_libmv
from torchsfm.formats.ply import PointCloud, read_ply, write_ply
from torchsfm.formats.vgg import VggScene, read_vgg

__all__ = [
    "PointCloud",
    "VggScene",
    "read_bal",
    "read_colmap",
    "read_libmv",
    "read_ply",
    "read_vgg",
    "write_bal",
    "write_colmap",
    "write_ply",
]
