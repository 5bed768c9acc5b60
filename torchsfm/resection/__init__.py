"""The structure is known: where is the camera? (Absolute pose, PnP; photogrammetry's resection.)"""

from torchsfm.resection.camera_p3p import camera_p3p

__all__ = ["camera_p3p"]
