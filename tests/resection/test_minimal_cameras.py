"""The laws that the minimal solvers for cameras obey (those for `camera_p3p` have a file of their own)."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from chance import assert_share

from torchsfm._types import Solutions
from torchsfm.geometry import random_rotation
from torchsfm.resection import camera_gp3p, camera_p4pf, camera_p35pf, camera_up2p
from torchsfm.resection.camera_gp3p import equations as gp3p_equations
from torchsfm.resection.camera_p4pf import equations as p4pf_equations
from torchsfm.resection.camera_p35pf import equations as p35pf_equations
from torchsfm.resection.camera_up2p import equations as up2p_equations

F64 = torch.float64
Tensors = tuple[torch.Tensor, ...]


@dataclass(frozen=True)
class Kind:
    solve: Callable[..., Solutions[torch.Tensor]]
    equations: Callable[..., torch.Tensor]
    sample: Callable[..., Tensors]
    points: int
    slots: int


def focal_sample(Y: torch.Tensor, X: torch.Tensor, P: torch.Tensor, generator: torch.Generator) -> Tensors:
    f = 500 + 1500 * torch.rand(*Y.shape[:-2], 1, 1, generator=generator, dtype=F64)
    K = torch.cat((f, f, torch.ones_like(f)), -2)
    return f * Y[..., :2] / Y[..., 2:], X, K * P


def rig_sample(Y: torch.Tensor, X: torch.Tensor, P: torch.Tensor, generator: torch.Generator) -> Tensors:
    p = torch.randn(Y.shape, generator=generator, dtype=F64)
    return p, (Y - p) * (0.1 + torch.rand(*Y.shape[:-1], 1, generator=generator, dtype=F64)), X, P


def upright_sample(Y: torch.Tensor, X: torch.Tensor, P: torch.Tensor, generator: torch.Generator) -> Tensors:
    G = torch.randn(*Y.shape[:-2], 3, generator=generator, dtype=F64)
    return Y / Y[..., 2:], X, 2 * (P[..., :3] @ G[..., None])[..., 0], G, P


KINDS = {
    "p4pf": Kind(camera_p4pf, p4pf_equations, focal_sample, 4, 1),
    "p35pf": Kind(camera_p35pf, p35pf_equations, focal_sample, 4, 10),
    "gp3p": Kind(camera_gp3p, gp3p_equations, rig_sample, 3, 8),
    "up2p": Kind(camera_up2p, up2p_equations, upright_sample, 2, 2),
}
pytestmark = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


@pytest.fixture
def sample(make_scene, generator):
    """Exact measurements, and last the camera they come from."""

    def make(kind: Kind, *batch: int, width: float = 0.6) -> Tensors:
        Y, X, P = make_scene(*batch, n=kind.points, width=width)
        return kind.sample(Y, X, P, generator)

    return make


def distance(found: Solutions[torch.Tensor], P: torch.Tensor) -> torch.Tensor:
    """Of the nearest solution from the truth, relative to it."""
    P = P[..., None, :, :]
    error = (found.model - P).norm(dim=(-1, -2)) / P.norm(dim=(-1, -2))
    return torch.where(found.valid, error, torch.inf).amin(-1)


@pytest.mark.parametrize("width", [1.0, 0.3, 0.1])
def test_recall(kind, sample, width):
    *data, P = sample(kind, 2000, width=width)
    error = distance(kind.solve(*data), P)
    assert_share(error < 1e-6, 0.999)
    assert error.median() < 1e-12 / width


def test_recall_in_single_precision(kind, sample):
    *data, P = sample(kind, 1000)
    found = kind.solve(*(d.float() for d in data))
    assert found.model.dtype == torch.float32
    assert found.model.isfinite().all()
    assert_share(distance(found, P.float()) < 1e-2, 0.98)


def test_every_valid_slot_is_a_solution(kind, sample):
    *data, _ = sample(kind, 1000)
    found = kind.solve(*data)
    assert found.model.shape == (1000, kind.slots, 3, 4)
    assert found.model.isfinite().all()
    error = kind.equations(found.model, *(d[:, None] for d in data)).abs().amax(-1) / found.model.abs().amax((-1, -2)) ** 2
    assert (error[found.valid] < 1e-8).all()
    assert error[found.valid].median() < 1e-13


def test_no_solution_stands_twice(kind, sample):
    *data, _ = sample(kind, 1000)
    found = kind.solve(*data)
    size = found.model.norm(dim=(-1, -2))
    for i in range(kind.slots):
        for j in range(i):
            both = found.valid[:, i] & found.valid[:, j]
            gap = (found.model[:, i] - found.model[:, j]).norm(dim=(-1, -2)) / size[:, i]
            assert (gap[both] > 1e-9).all()


def test_the_order_of_slots_and_points(kind, sample):
    *data, P = sample(kind, 1000)
    turned = [d.flip(-2) if d.ndim == 3 else d for d in data]
    if kind.solve is camera_p35pf:
        turned = [d[:, [2, 0, 1, 3]] for d in data]
    found, again = kind.solve(*data), kind.solve(*turned)
    assert_share(distance(again, P) < 1e-6, 0.998)
    assert_share(found.valid.sum(-1) == again.valid.sum(-1), 0.99)


def test_the_world_may_be_anywhere_and_of_any_size(kind, sample, generator):
    *data, P = sample(kind, 500)
    where = [i for i, d in enumerate(data) if d.ndim == 3][-1]
    S = random_rotation(generator=generator, dtype=F64)
    shift = torch.tensor([30.0, -50.0, 20.0], dtype=F64)
    scale = 1.0 if kind.solve is camera_gp3p else 40.0
    data[where] = scale * data[where] @ S.mT + shift
    if kind.solve is camera_up2p:
        data[3] = data[3] @ S.mT
    R = P[..., :3] @ S.mT
    moved = torch.cat((R, scale * P[..., 3:] - R @ shift[:, None]), -1)
    assert_share(distance(kind.solve(*data), moved) < 1e-6, 0.995)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_shapes(kind, sample, batch):
    *data, P = sample(kind, *batch)
    found = kind.solve(*data)
    assert found.model.shape == (*batch, kind.slots, 3, 4)
    assert found.valid.shape == (*batch, kind.slots)
    if P.numel():
        assert (distance(found, P) < 1e-6).all()


def test_batches_broadcast_and_equal_single_problems(kind, sample):
    *data, _ = sample(kind, 6)
    whole = kind.solve(*data)
    for i in range(6):
        alone = kind.solve(*(d[i] for d in data))
        assert torch.equal(alone.valid, whole.valid[i])
        torch.testing.assert_close(alone.model, whole.model[i], rtol=1e-9, atol=1e-9)
    first, *others = data
    wide = kind.solve(first[:, None], *(d[0] for d in others))
    assert torch.equal(wide.model[0, 0], whole.model[0])


@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf])
def test_bad_values_touch_no_neighbour(kind, sample, poison):
    *data, _ = sample(kind, 64)
    good = kind.solve(*data)
    for k in range(len(data)):
        bad = [d.clone() for d in data]
        bad[k].view(64, -1)[5, 1] = poison
        found = kind.solve(*bad)
        assert not found.valid[5].any()
        assert found.model.isfinite().all()
        others = torch.arange(64) != 5
        assert torch.equal(found.valid[others], good.valid[others])
        assert torch.equal(found.model[others], good.model[others])


def test_degenerate_points(kind, sample):
    *data, _ = sample(kind, 64)
    good = kind.solve(*data)
    where = [i for i, d in enumerate(data) if d.ndim == 3]
    X = data[where[-1]]
    X[0] = X[0, :1]
    X[1, 1] = X[1, 0]
    X[2] = 0
    X[3] = X[3, :1] + (X[3, 1:2] - X[3, :1]) * torch.arange(kind.points, dtype=F64)[:, None] if kind.points > 2 else 0
    d = data[where[-2]]
    d[4] = 0
    d[5] = d[5, :1]
    X[6] = 1e300 * X[6]
    found = kind.solve(*data)
    assert found.model.isfinite().all()
    assert not found.valid[:6].any()
    assert torch.equal(found.model[7:], good.model[7:])
    assert torch.equal(found.valid[7:], good.valid[7:])


def test_derivatives(kind, sample):
    *data, P = sample(kind, 4)
    found = kind.solve(*data)
    gap = (found.model - P[:, None]).norm(dim=(-1, -2))
    slot = torch.where(found.valid, gap, torch.inf).argmin(-1)
    scale = [d.abs().amax() for d in data]

    def solve(*inputs):
        model = kind.solve(*(d * s for d, s in zip(inputs, scale, strict=True))).model[torch.arange(4), slot]
        return model / P.abs().amax((-1, -2), keepdim=True)

    inputs = [(d / s).requires_grad_() for d, s in zip(data, scale, strict=True)]
    assert torch.equal(solve(*inputs), solve(*(d.detach() for d in inputs)))
    assert torch.autograd.gradcheck(solve, inputs, eps=1e-7, rtol=1e-3, atol=1e-3, fast_mode=True)


def test_empty_slots_and_bad_data_have_no_derivative(kind, sample):
    *data, _ = sample(kind, 40)
    data[0][:3] = torch.nan
    data[-1][3:6] = 0
    inputs = [d.requires_grad_() for d in data]
    found = kind.solve(*inputs)
    found.model[~found.valid].sum().backward(retain_graph=True)
    assert all((d.grad == 0).all() for d in inputs)
    found.model.sum().backward()
    assert all(d.grad.isfinite().all() for d in inputs)


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(kind, sample):
    *data, _ = sample(kind, 3)
    with pytest.raises(ValueError, match="wanted shape"):
        kind.solve(data[0][:, :1], *data[1:])
    with pytest.raises(ValueError, match="wanted dtype"):
        kind.solve(data[0].float(), *data[1:])
    with pytest.raises(ValueError, match="do not broadcast"):
        kind.solve(data[0][:2], *data[1:])
