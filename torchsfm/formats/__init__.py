"""How does a model come from other programs, and how do they get it?"""

from torchsfm.formats.bal import read_bal, write_bal
from torchsfm.formats.bundler import read_bundler, write_bundler
from torchsfm.formats.colmap import read_colmap, write_colmap
from torchsfm.formats.colmap_database import read_database, read_features, write_database
from torchsfm.formats.conics import read_conics, write_conics
from torchsfm.formats.curves import write_curves
from torchsfm.formats.export import TARGETS, export_model
from torchsfm.formats.gltf import write_gltf
from torchsfm.formats.hloc import read_hloc
from torchsfm.formats.kapture import read_kapture, write_kapture
from torchsfm.formats.libmv import read_libmv
from torchsfm.formats.lines import read_lines, write_lines
from torchsfm.formats.nerfstudio import read_nerfstudio, write_nerfstudio
from torchsfm.formats.nvm import read_nvm, write_nvm
from torchsfm.formats.objects.kornia import camera_from_kornia, kornia_from_camera
from torchsfm.formats.objects.nerfstudio import camera_from_nerfstudio, nerfstudio_from_camera
from torchsfm.formats.objects.opencv import camera_from_opencv, opencv_from_camera
from torchsfm.formats.objects.pycolmap import model_from_pycolmap, pycolmap_from_model
from torchsfm.formats.objects.pytorch3d import camera_from_pytorch3d, pytorch3d_from_camera
from torchsfm.formats.openmvg import read_openmvg, write_openmvg
from torchsfm.formats.opensfm import read_opensfm, write_opensfm
from torchsfm.formats.pictures import undistorted_model
from torchsfm.formats.ply import PointCloud, read_ply, write_ply
from torchsfm.formats.registry import FORMATS, read_model, write_model
from torchsfm.formats.trajectory import write_kitti, write_tum
from torchsfm.formats.vgg import VggScene, read_vgg

__all__ = [
    "FORMATS",
    "TARGETS",
    "PointCloud",
    "VggScene",
    "camera_from_kornia",
    "camera_from_nerfstudio",
    "camera_from_opencv",
    "camera_from_pytorch3d",
    "export_model",
    "kornia_from_camera",
    "model_from_pycolmap",
    "nerfstudio_from_camera",
    "opencv_from_camera",
    "pycolmap_from_model",
    "pytorch3d_from_camera",
    "read_bal",
    "read_bundler",
    "read_colmap",
    "read_conics",
    "read_database",
    "read_features",
    "read_hloc",
    "read_kapture",
    "read_libmv",
    "read_lines",
    "read_model",
    "read_nerfstudio",
    "read_nvm",
    "read_openmvg",
    "read_opensfm",
    "read_ply",
    "read_vgg",
    "undistorted_model",
    "write_bal",
    "write_bundler",
    "write_colmap",
    "write_conics",
    "write_curves",
    "write_database",
    "write_gltf",
    "write_kapture",
    "write_kitti",
    "write_lines",
    "write_model",
    "write_nerfstudio",
    "write_nvm",
    "write_openmvg",
    "write_opensfm",
    "write_ply",
    "write_tum",
]
