"""A model in a web page that this program serves, so that it can change while one looks: viser, the extra `viser`."""

import contextlib
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsfm.geometry.rotations import quaternion_wxyz_from_rotation
from torchsfm.images import ImageError, read_image
from torchsfm.plot.framing import frame
from torchsfm.plot.strokes import model_strokes
from torchsfm.reconstruction.model.reconstruction import Reconstruction

MISSING = "the live viewer needs viser (pip install 'torchsfm[viser]')"
POINT, CAMERA, STROKE = 0.003, 0.05, 0.001
"""Sizes of what is drawn, over the radius of the model."""
FAR, NEAREST = 2.2, 1e-3
"""How far away one begins, and how near one can come, over the same."""
PHOTOGRAPH = 320
"""Longer side of the photographs at the cameras, pixels."""


class LiveViewer:
    """A server on this machine, and the model that its page shows.

    Args:
        host: Address to listen at; by default programs of this machine alone reach it.
        port: The port, or the next free one.

    Raises:
        ImportError: viser is not installed.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50).truth, "model.npz")
        >>> viewer = torchsfm.plot.LiveViewer()
        >>> viewer.show(torchsfm.read_model("model.npz"))  # a browser shows it at once
        >>> viewer.address.startswith("http://127.0.0.1:")
        True
        >>> viewer.close()
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        try:
            import viser
        except ImportError:
            raise ImportError(MISSING) from None
        with _quietly():
            self._server = viser.ViserServer(host=host, port=port, verbose=False)
        self._shown: list[Any] = []

    @property
    def address(self) -> str:
        """Where a browser finds the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def show(self, model: Reconstruction, *, images: str | Path | None = None) -> None:
        """Show a model in the place of the one before: points, cameras, lines, ellipses and curves.

        Args:
            model: The model.
            images: Folder with the photographs under their names; those that can be read are shown at the cameras.
        """
        for handle in self._shown:
            handle.remove()
        model, scene = model.to("cpu", torch.float64), self._server.scene
        framing = frame(model)
        scene.set_up_direction(tuple(framing.R[2].tolist()))
        # From the side of the cameras, as the page does.
        start, eye = self._server.initial_camera, framing.centre + FAR * framing.radius * framing.direction
        start.look_at, start.position = (tuple((x @ framing.R).tolist()) for x in (framing.centre, eye))
        start.near, start.far = framing.radius * NEAREST, framing.radius / NEAREST
        good = model.X.isfinite().all(-1)
        self._shown = [
            scene.add_point_cloud(
                "/points", _floats(model.X[good]), _levels(model.color[good]), point_size=POINT * framing.radius,
                precision="float32",
            )
        ]  # fmt: skip
        for kind, stroke in model_strokes(model).items():
            colors = _levels(stroke.color)[:, None].repeat(2, 1)
            self._shown.append(
                scene.add_line_segments(f"/{kind}", _floats(stroke.ends), colors, thickness=STROKE * framing.radius)
            )
        centres, turns = model.poses.centre.numpy(), quaternion_wxyz_from_rotation(model.poses.R.mT).numpy()
        for i in model.registered.nonzero()[:, 0].tolist():
            width, height = model.image_size[i].tolist()
            fy = float(model.cameras.K[model.camera_index[i], 1, 1])
            photograph = None if images is None else _photograph(Path(images) / model.names[i])
            self._shown.append(
                scene.add_camera_frustum(
                    f"/cameras/{i}", 2 * math.atan(height / 2 / fy), width / height, scale=CAMERA * framing.radius,
                    wxyz=turns[i], position=centres[i], image=photograph,
                )
            )  # fmt: skip

    def close(self) -> None:
        """End the server."""
        with _quietly():
            self._server.stop()


def _quietly() -> contextlib.redirect_stdout[io.StringIO]:
    """What viser prints by itself is left to those who ask for `address`."""
    return contextlib.redirect_stdout(io.StringIO())


def _photograph(path: Path) -> NDArray[np.uint8] | None:
    """A small copy; None where the file cannot be read."""
    try:
        pixels = read_image(path, max_size=PHOTOGRAPH).pixels
    except (ImageError, OSError):
        return None
    return _levels(pixels.expand(3, -1, -1).permute(1, 2, 0))


def _floats(x: Tensor) -> NDArray[np.float32]:
    return x.detach().float().numpy()


def _levels(color: Tensor) -> NDArray[np.uint8]:
    return (color.detach().nan_to_num(0).clamp(0, 1) * 255).round().byte().numpy()
