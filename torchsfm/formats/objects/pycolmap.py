"""Whole models as `pycolmap.Reconstruction`."""

import tempfile
from pathlib import Path
from typing import Any

from torchsfm.formats.colmap import read_colmap, write_colmap
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.reconstruction import Reconstruction


@on_the_cpu
def pycolmap_from_model(model: Reconstruction) -> Any:
    """The model as a `pycolmap.Reconstruction`.

    Args:
        model: Cameras, poses, points and tracks.

    Raises:
        ImportError: pycolmap is not installed.
        ValueError: COLMAP has no such cameras.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> same = torchsfm.formats.model_from_pycolmap(torchsfm.formats.pycolmap_from_model(model))
        >>> same.num_points, bool(same.X.allclose(model.X))
        (20, True)
    """
    import pycolmap

    with tempfile.TemporaryDirectory() as folder:
        write_colmap(model, folder)
        return pycolmap.Reconstruction(folder)


@on_the_cpu
def model_from_pycolmap(reconstruction: Any) -> Reconstruction:
    """The model that a `pycolmap.Reconstruction` holds.

    Args:
        reconstruction: The `pycolmap.Reconstruction`.

    Raises:
        ValueError: It has cameras that have no equal here.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> import pycolmap
        >>> torchsfm.write_colmap(torchsfm.read_model("model.npz"), "sparse")
        >>> torchsfm.formats.model_from_pycolmap(pycolmap.Reconstruction("sparse")).num_registered
        3
    """
    with tempfile.TemporaryDirectory() as folder:
        reconstruction.write(folder)
        return read_colmap(Path(folder))
