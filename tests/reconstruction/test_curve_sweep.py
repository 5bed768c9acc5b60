"""Depths at which edge points may be: what maps hold at the images of points."""

import torch

from torchsfm.reconstruction.curves.sweep import _felt


def test_maps_are_looked_up_at_the_nearest_pixel(generator: torch.Generator) -> None:
    """Outside, behind, and of a camera that is not known, there is nothing."""
    v, s, h, w = 3, 40, 30, 50
    closeness = torch.rand(v, h, w, generator=generator)
    A, B = (torch.randn(*shape, generator=generator) for shape in ((v, 3), (v, s, 3)))
    A = A * torch.tensor([20.0, 10.0, 0.7])
    B = B * torch.tensor([25.0, 15.0, 0.0]) + torch.tensor([25.0, 15.0, 1.0])
    A[2, 1] = torch.nan
    grid = torch.rand(s, 64, generator=generator)
    wanted = torch.zeros_like(grid)
    sure = torch.ones_like(grid, dtype=torch.bool)
    for j in range(2):
        y = A[j] * grid[..., None] + B[j][:, None]
        pixel = y[..., :2] / y[..., 2:]
        column, row = pixel.round().unbind(-1)
        inside = (y[..., 2] > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
        at = (column.clamp(0, w - 1).long(), row.clamp(0, h - 1).long())
        wanted += torch.where(inside, closeness[j][at[1], at[0]], 0)
        # On the border of two pixels, or next to the plane of the camera, rounding decides.
        sure &= ((pixel - pixel.floor() - 0.5).abs() > 1e-3).all(-1) & (y[..., 2].abs() > 1e-3)
    assert sure.float().mean() > 0.9
    assert (wanted > 0).float().mean() > 0.05
    torch.testing.assert_close(_felt(closeness, A, B, grid)[sure], wanted[sure])
