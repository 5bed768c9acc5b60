"""Photographs of boards that are not what calibration takes them for: deviations and answers must say so."""

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import PlaneCalibration, calibrate_planes
from torchsfm.autocalibration.plane_models import LENSES, bend, calibrate_unknown_planes
from torchsfm.geometry import Camera, Distortion, KannalaBrandt, Radial, intrinsics, rotation_from_rotvec

F64 = torch.float64
SIZE = (640.0, 480.0)
COLUMNS, ROWS = 9, 6
FREE = ("focal", "aspect", "principal_point")


def grid() -> Tensor:
    i, j = torch.meshgrid(torch.arange(COLUMNS), torch.arange(ROWS), indexing="xy")
    return torch.stack((i.flatten(), j.flatten()), -1).double()


def photographs(
    generator: torch.Generator, board: Tensor, focal: Tensor, lens: Distortion | None = None, away: float = 10.0, sets: int = 1
) -> Tensor:
    """Image points (sets, v, n, 2) of a board (n, 3) by a camera of focal lengths (v,), 0.05 px of noise."""
    lens = Radial(*torch.tensor([-0.1, 0.02], dtype=F64)) if lens is None else lens
    shape = (sets, len(focal), 3)
    turn = (2 * torch.rand(shape, generator=generator, dtype=F64) - 1) * torch.tensor([0.6, 0.6, 0.5], dtype=F64)
    R = rotation_from_rotvec(turn)
    t = torch.rand(shape, generator=generator, dtype=F64) * torch.tensor([2.0, 1.5, 3.0], dtype=F64)
    t = t + torch.tensor([-1.0, -0.75, away], dtype=F64)
    camera = Camera(intrinsics(focal, torch.tensor([325.0, 236.0], dtype=F64).expand(len(focal), 2)))
    rays = (board - board.mean(0)) @ R.mT + t[..., None, :]
    x = lens.project(rays) @ camera.K[:, :2, :2].mT + camera.K[:, None, :2, 2]
    return x + 0.05 * torch.randn(x.shape, generator=generator, dtype=F64)


def bent(stretch: float = 0.0, sag: float = 0.0) -> Tensor:
    """A board whose rows are longer than they should be, or that hangs through between its ends."""
    X = grid()
    return torch.stack(((1 + stretch) * X[:, 0], X[:, 1], sag * ((X[:, 0] - 4) / 4) ** 2), -1)


def errors(found: PlaneCalibration, focal: float = 480.0) -> Tensor:
    """Of fx, fy, cx, cy over their deviations."""
    K = found.camera.K
    truth = torch.tensor([focal, focal, 325.0, 236.0], dtype=F64)
    return (K[..., [0, 1, 0, 1], [0, 1, 2, 2]] - truth) / found.deviation[..., :4]


ONE = torch.full((10,), 480.0, dtype=F64)


@pytest.mark.parametrize(("stretch", "sag"), [(0.0, 0.03), (0.01, 0.0)])
def test_a_board_that_is_not_flat(stretch: float, sag: float, generator: torch.Generator) -> None:
    """Focal lengths were off by 8 to 20 of their deviations."""
    x = photographs(generator, bent(stretch, sag), ONE, sets=20)
    flat = calibrate_planes(x, grid(), image_size=SIZE)
    assert bool((flat.status == Status.OK).all())
    assert float(errors(flat).square().mean().sqrt()) < 2.5
    assert float(flat.disagreement.min()) > 2
    found = calibrate_planes(x, grid(), image_size=SIZE, free=(*FREE, "board"))
    assert bool((found.status == Status.OK).all())
    assert float(errors(found).square().mean().sqrt()) < 1.4
    assert float(found.disagreement.max()) < 2
    assert float(found.deviation[:, 0].max()) < 0.3 * float(flat.deviation[:, 0].min())
    assert found.parameter_names[-5:] == ("stretch", "shear", "bend_xx", "bend_xy", "bend_yy")
    off = found.board_shape - torch.tensor([stretch, 0.0, sag / 16, 0.0, 0.0], dtype=F64)
    assert float((off / found.deviation[:, -5:]).square().mean().sqrt()) < 1.4
    assert abs(bend(found.board[0]) - sag) < 0.003


def test_two_zooms_contradict_each_other(generator: torch.Generator) -> None:
    """Focal lengths were off by 25 of their deviations in the mean."""
    two = torch.tensor([480.0, 494.0], dtype=F64).repeat(5)
    found = calibrate_planes(photographs(generator, bent(), two, sets=20), grid(), image_size=SIZE)
    assert float(found.disagreement.min()) > 3
    assert float(errors(found, 487.0).square().mean().sqrt()) < 3
    one = calibrate_planes(photographs(generator, bent(), ONE, sets=20), grid(), image_size=SIZE)
    assert float(one.disagreement.max()) < 2


@pytest.mark.parametrize("again", [0.0, 0.01])
def test_copies_are_no_evidence(again: float, generator: torch.Generator) -> None:
    """Four copies of each photograph, or of each saved with a little more noise, halved the deviations."""
    x = photographs(generator, bent(), ONE[:4], sets=2)
    alone = calibrate_planes(x, grid(), image_size=SIZE)
    y = x.repeat(1, 4, 1, 1)
    y[:, 4:] += again * torch.randn(y[:, 4:].shape, generator=generator, dtype=F64)
    found = calibrate_planes(y, grid(), image_size=SIZE)
    assert found.copy_of.tolist() == [[0, 1, 2, 3] * 4] * 2
    assert found.used.tolist() == [[True] * 4 + [False] * 12] * 2
    assert torch.allclose(found.deviation, alone.deviation, rtol=1e-6)
    assert torch.allclose(found.camera.K, alone.camera.K, rtol=1e-8)
    assert torch.allclose(found.poses.t, alone.poses.t.repeat(1, 4, 1), rtol=1e-6)
    assert torch.equal(alone.copy_of, torch.arange(4).expand(2, 4))
    # Photographs from a tripod show the same, each with noise of its own.
    still = x.repeat(1, 2, 1, 1) + 0.1 * torch.randn(2, 8, len(grid()), 2, generator=generator, dtype=F64)
    assert bool(calibrate_planes(still, grid(), image_size=SIZE).used.all())


def test_lens_and_board_by_evidence(generator: torch.Generator) -> None:
    """A fisheye of 92 degrees as a polynomial was 12 of its deviations off; what is as it should be stays as it is."""
    options = {"lenses": LENSES, "boards": (False, True), "free": FREE, "image_size": SIZE}
    lens, found = calibrate_unknown_planes(photographs(generator, bent(), ONE)[0], grid(), **options)
    assert (lens, found.parameter_names[4:]) == ("radial", ("k1", "k2"))
    wide = KannalaBrandt(*torch.tensor([0.01, -0.003, 0.0, 0.0], dtype=F64))
    x = photographs(generator, bent(), ONE * (350 / 480), wide, 5.5)[0]
    lens, found = calibrate_unknown_planes(x, grid(), **options)
    assert (lens, len(found.parameter_names)) == ("fisheye", 8)
    assert float(errors(found, 350.0).abs().max()) < 4.5
    lens, found = calibrate_unknown_planes(photographs(generator, bent(0.01, 0.05), ONE)[0], grid(), **options)
    assert (lens, len(found.parameter_names)) == ("radial", 11)
    assert float(errors(found).abs().max()) < 4.5
    parallel = photographs(generator, bent(), ONE[:1])
    lens, found = calibrate_unknown_planes(parallel[0], grid(), **options)
    assert (lens, int(found.status)) == ("radial", Status.DEGENERATE)
