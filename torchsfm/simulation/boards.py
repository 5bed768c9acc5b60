"""Photographs of calibration patterns."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.geometry import Camera, Pose
from torchsfm.simulation.randomness import drawn
from torchsfm.simulation.shapes import fine_samples, photograph

_PAPER, _INK, _ROOM = 0.85, 0.15, 0.5


def render_board(
    poses: Pose,
    camera: Camera,
    columns: int,
    rows: int,
    *,
    radius: float | None = None,
    width: int = 640,
    height: int = 480,
    blur: float = 0.6,
    noise: float = 0.005,
    fine: int = 4,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "v 1 h w"]:
    """Photograph a chessboard or a grid of dark circles in the plane z = 0.

    The inner corners of the chessboard, or the centres of the circles, are at (column, row), one unit apart.

    Args:
        poses: Camera from board, batch (v,).
        camera: That took all photographs.
        columns: Points in a row.
        rows: Points in a column.
        radius: Of the circles; a chessboard where none is given.
        width: Of the photographs, in pixels.
        height: Of the photographs.
        blur: Standard deviation of the blur, in pixels.
        noise: Standard deviation of the noise of image values.
        fine: Samples for each pixel and axis.
        generator: Source of randomness; torch's own where none is given.

    Returns:
        The photographs.

    Example:
        >>> import torch, torchsfm
        >>> centre = torch.tensor([2.0, 1.5, -6.0], dtype=torch.float64)  # before the middle of the board
        >>> poses = torchsfm.Pose(torch.eye(3, dtype=centre.dtype)[None], -centre[None])
        >>> K = torchsfm.intrinsics(torch.tensor(100.0), torch.tensor([49.5, 37.0])).double()
        >>> torchsfm.simulation.render_board(poses, torchsfm.Camera(K), 5, 4, width=100, height=75).shape
        torch.Size([1, 1, 75, 100])
    """
    check_options(
        poses=(poses, Pose), camera=(camera, Camera), columns=(columns, "int >= 2"), rows=(rows, "int >= 2"),
        radius=(radius, "?float > 0"), width=(width, "int >= 8"), height=(height, "int >= 8"), blur=(blur, "float > 0"),
        noise=(noise, "float >= 0"), fine=(fine, "int >= 1"),
    )  # fmt: skip
    if len(poses.shape) != 1:
        raise ValueError(f"poses: wanted batch shape (views,), got {tuple(poses.shape)}")
    if camera.shape:
        raise ValueError(f"camera: wanted a single camera, got batch shape {tuple(camera.shape)}")
    x, y = (fine_samples(n, blur, fine, camera.K) for n in (width, height))
    pixel = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    d, seen = camera.unproject(pixel.reshape(-1, 2))
    images = []
    for i in range(poses.shape[0]):
        R, t = poses.R[i], poses.t[i]
        ray, start = d @ R, -(t @ R)
        away = -start[2] / torch.where(ray[:, 2].abs() > 1e-9, ray[:, 2], 1e-9)
        X = start[:2] + away[:, None] * ray[:, :2]
        value = torch.where(seen & (away > 0), _board(X, columns, rows, radius), _ROOM)
        images.append(photograph(value.reshape(pixel.shape[:2]), width, height, blur, fine))
    clean = torch.stack(images) if images else pixel.new_zeros(0, 1, height, width)
    return clean + noise * drawn(torch.randn, clean.shape, clean, generator)


def _board(X: Tensor, columns: int, rows: int, radius: float | None) -> Tensor:
    """The grey of the board at its points."""
    last = X.new_tensor([columns - 1, rows - 1])
    margin = 1.5 if radius is None else 1.0
    paper = ((-margin < X) & (last + margin > X)).all(-1)
    if radius is None:
        inside = ((X > -1) & (last + 1 > X)).all(-1)
        ink = inside & (X.floor().sum(-1).remainder(2) == 0)
    else:
        ink = torch.linalg.vector_norm(X - torch.minimum(X.round().clamp_min(0), last), dim=-1) < radius
    grey = torch.full_like(X[..., 0], _PAPER).masked_fill(ink, _INK)
    return grey.masked_fill(~paper, _ROOM)
