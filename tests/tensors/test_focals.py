import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry.rotations import rotation_from_rotvec
from torchsfm.tensors import focals_from_fundamental, fundamental_from_pose

F64 = torch.float64
C1, C2 = torch.tensor([320.0, 240], dtype=F64), torch.tensor([300.0, 260], dtype=F64)


def calibration(f: Tensor, c: Tensor) -> Tensor:
    K = torch.zeros(*f.shape, 3, 3, dtype=f.dtype)
    K[..., 0, 0] = K[..., 1, 1] = f
    K[..., :2, 2], K[..., 2, 2] = c, 1
    return K


def scenes(count: int, generator: torch.Generator, equal: bool) -> tuple[Tensor, Tensor]:
    R = rotation_from_rotvec(0.4 * torch.randn(count, 3, dtype=F64, generator=generator))
    t = torch.randn(count, 3, dtype=F64, generator=generator)
    f = 300 + 900 * torch.rand(count, 2, dtype=F64, generator=generator)
    if equal:
        f = f[:, :1].expand(-1, 2)
    return fundamental_from_pose(R, t, calibration(f[:, 0], C1), calibration(f[:, 1], C2)), f


@pytest.mark.parametrize("equal", [False, True])
def test_exact_focal_lengths(equal: bool, generator: torch.Generator) -> None:
    F, f = scenes(1000, generator, equal)
    scale = torch.randn(1000, 1, 1, dtype=F64, generator=generator)
    found = focals_from_fundamental(F * scale, C1, C2, equal=equal)
    assert_share(found.valid, 0.995)
    error = ((found.model - f) / f).abs().amax(-1)
    assert_share((error < 1e-8)[found.valid], 0.99)
    assert (error / found.sensitivity)[found.valid].max() < 1e-12


@pytest.mark.parametrize("equal", [False, True])
def test_sensitivity_foretells_the_error(equal: bool, generator: torch.Generator) -> None:
    F, f = scenes(400, generator, equal)
    size = F.norm(dim=(-2, -1), keepdim=True)
    # Noise of equal relative size in the entries as they are when coordinates are of order 1.
    weights = torch.tensor([1e-3, 1e-3, 1.0], dtype=F64)
    G = F / (weights[:, None] * weights)
    G = G / G.norm(dim=(-2, -1), keepdim=True)
    noise = 1e-7 * torch.randn(F.shape, dtype=F64, generator=generator)
    found = focals_from_fundamental(((G + noise) * weights[:, None] * weights) * size, C1, C2, equal=equal)
    ratio = ((found.model - f) / f).abs().amax(-1) / (1e-7 * found.sensitivity)
    ratio = ratio[found.valid]
    assert 0.01 < ratio.median() < 3
    assert ratio.quantile(0.95) < 10


def test_fixating_cameras_are_reported() -> None:
    # Both axes through (0, 0, 5): the first looks along z, the second from the side, at another distance or the same.
    angle = torch.tensor([0.3, 0.5], dtype=F64)
    R = rotation_from_rotvec(torch.stack((0 * angle, -angle, 0 * angle), -1))
    target = torch.tensor([0.0, 0, 5], dtype=F64)
    far, near = torch.tensor([0.0, 0, 7], dtype=F64), torch.tensor([0.0, 0, 5], dtype=F64)
    f = torch.tensor([700.0, 900.0], dtype=F64)
    for distance, equal_known in ((far, True), (near, False)):
        t = distance - (R @ target[:, None])[..., 0]
        F = fundamental_from_pose(R, t, calibration(f, C1), calibration(f, C2))
        assert (focals_from_fundamental(F, C1, C2).status == Status.DEGENERATE).all()
        shared = focals_from_fundamental(F, C1, C2, equal=True)
        if equal_known:
            torch.testing.assert_close(shared.model, f[:, None].expand(-1, 2), rtol=1e-6, atol=0)
        assert shared.valid.tolist() == [equal_known] * 2


def test_degenerate_elements_stay_alone(generator: torch.Generator) -> None:
    F, _ = scenes(5, generator, False)
    reference = focals_from_fundamental(F, C1, C2)
    F[1] = 0
    F[3, 0, 0] = float("nan")
    F.requires_grad_()
    found = focals_from_fundamental(F, C1, C2)
    assert found.status[[1, 3]].tolist() == [Status.DEGENERATE, Status.NOT_FINITE]
    assert torch.isfinite(found.model).all()
    assert torch.equal(found.model[[0, 2, 4]], reference.model[[0, 2, 4]])
    found.model.sum().backward()
    assert F.grad is not None
    assert torch.isfinite(F.grad).all()


@pytest.mark.parametrize("equal", [False, True])
def test_derivatives(equal: bool, generator: torch.Generator) -> None:
    F, _ = scenes(3, generator, equal)
    weights = torch.tensor([500.0, 500, 1], dtype=F64)
    G = F * weights[:, None] * weights
    G = (G / G.norm(dim=(-2, -1), keepdim=True)).requires_grad_()
    c = (C1 / 500).expand(3, 2).clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda G, c: focals_from_fundamental(G, c, C2 / 500, equal=equal).model, (G, c), rtol=1e-3)


@pytest.mark.reference
def test_against_poselib(generator: torch.Generator) -> None:
    poselib = pytest.importorskip("poselib")
    F, _ = scenes(20, generator, False)
    found = focals_from_fundamental(F, C1, C2)
    for i in range(20):
        camera1, camera2 = poselib.focals_from_fundamental(F[i].numpy(), C1.numpy(), C2.numpy())
        theirs = torch.tensor([camera1.focal(), camera2.focal()], dtype=F64)
        torch.testing.assert_close(found.model[i], theirs, rtol=1e-6, atol=0)
