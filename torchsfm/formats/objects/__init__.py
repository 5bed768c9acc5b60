"""Cameras and poses as other libraries hold them in memory: OpenCV, kornia, PyTorch3D, nerfstudio and pycolmap.

Each function has the direction in its name. None of these libraries is needed here but pycolmap, whose objects are made: the
others get arrays or tensors for the arguments of theirs. Where a library puts the centre of the top-left pixel at (0.5, 0.5),
the half pixel is added and taken away.
"""
