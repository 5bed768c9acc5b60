from pathlib import Path

import numpy as np
import pytest
import torch
from chance import assert_share
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import focal_from_fundamentals
from torchsfm.motion import fundamental_8pt

FOCAL = 1800.0
CENTRE = (750.0, 500.0)
SIZE = torch.tensor([1500.0, 1000.0], dtype=torch.float64)


def poses(kind: str, v: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rotations and centres of cameras about the origin."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    tilt = 0.1 * normal(v, 3)
    if kind == "walk":
        C = torch.stack((0.7 * torch.arange(v, dtype=torch.float64), 0.2 * normal(v), -5 + 0.5 * normal(v)), -1)
        target = C + torch.tensor([0.0, 0.0, 5.0]) + normal(v, 3)
    elif kind == "object":
        angle, distance = 0.8 * normal(v), 5 + normal(v)
        C = torch.stack((distance * angle.sin(), 0.6 * normal(v), -distance * angle.cos()), -1)
        target = 0.7 * normal(v, 3)
    elif kind == "turntable":
        angle = 0.2 * torch.arange(v, dtype=torch.float64)
        C = torch.stack((5 * angle.sin(), -torch.ones_like(angle), -5 * angle.cos()), -1)
        target, tilt = torch.zeros(v, 3, dtype=torch.float64), 0 * tilt
    elif kind == "forward":
        C = torch.zeros(v, 3, dtype=torch.float64)
        C[:, 2] = 0.6 * torch.arange(v) - 8
        target, tilt = torch.zeros(v, 3, dtype=torch.float64), 0 * tilt
    else:
        C = 0.7 * normal(v, 3) + torch.tensor([0.0, 0.0, -6.0])
        target, tilt = C + torch.tensor([0.0, 0.0, 5.0]), 0 * tilt
    z = torch.nn.functional.normalize(target - C, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).to(z) + tilt, z), dim=-1)
    return torch.stack((x, torch.linalg.cross(z, x), z), -2), C


def fundamentals(R: Tensor, C: Tensor, K: Tensor, X: Tensor, noise: float, generator: torch.Generator) -> Tensor:
    """F of all pairs of views, from noisy images of points."""
    P = K @ torch.cat((R, -R @ C[..., None]), -1)
    h = X @ P[..., :3].mT + P[..., None, :, 3]
    x = h[..., :2] / h[..., 2:]
    x = x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    i, j = torch.triu_indices(len(C), len(C), 1)
    return fundamental_8pt(x[i], x[j])


def simulate(
    kind: str, v: int, noise: float, generator: torch.Generator, planar: bool = False, n: int = 150
) -> tuple[Tensor, Tensor]:
    K = torch.tensor([[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]], dtype=torch.float64)
    X = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    if planar:
        X[:, 2] = 0
    F = fundamentals(*poses(kind, v, generator), K, X, noise, generator)
    return F, torch.tensor(CENTRE, dtype=torch.float64).expand(len(F), 2)


@pytest.mark.parametrize("kind", ["walk", "object"])
@pytest.mark.parametrize("v", [2, 6])
def test_exact_pairs(generator, kind, v):
    F, c = simulate(kind, v, 0.0, generator)
    found = focal_from_fundamentals(F, c, c, image_size=SIZE)
    assert found.status == Status.OK
    assert abs(found.model - FOCAL) < 1e-4 * FOCAL
    assert (found.asymmetry < 1e-6).all()


@pytest.mark.parametrize("kind", ["walk", "object"])
@pytest.mark.parametrize(("noise", "limit"), [(0.5, 0.003), (2.0, 0.012)])
def test_noise(generator, kind, noise, limit):
    errors = []
    for _ in range(10):
        F, c = simulate(kind, 6, noise, generator)
        found = focal_from_fundamentals(F, c, c, image_size=SIZE)
        assert found.status == Status.OK
        error = abs(float(found.model / FOCAL) - 1)
        assert error < 5 * found.uncertainty
        errors.append(error)
    assert sorted(errors)[8] < limit


def test_many_wrong_pairs(generator):
    F, c = simulate("object", 8, 1.0, generator)
    planar, _ = simulate("object", 8, 1.0, generator, planar=True)
    wrong = torch.rand(len(F), generator=generator) < 0.5
    mixed = torch.where(wrong[:, None, None], planar, F)
    mixed[3] = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    mixed[5] = torch.nan
    wrong[[3, 5]] = True
    found = focal_from_fundamentals(mixed, c, c, image_size=SIZE)
    assert found.status == Status.OK
    assert abs(found.model / FOCAL - 1) < 0.01
    assert (found.asymmetry[~wrong] < 0.02).all()
    assert found.asymmetry[5] == 1


@pytest.mark.parametrize("kind", ["turntable", "translation"])
@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("v", [2, 7])
def test_motions_that_do_not_tell_are_reported(generator, kind, noise, v):
    F, c = simulate(kind, v, noise, generator)
    found = focal_from_fundamentals(F, c, c, image_size=SIZE)
    assert found.status == Status.DEGENERATE
    assert found.model.isfinite()
    assert found.uncertainty == 1


def test_a_pair_that_noise_closes_by_chance_tells_nothing(generator):
    """Some focal length makes one of two equations of noise true, and the other is small by luck."""

    def told(kind, trials, n):
        pairs = [simulate(kind, 2, 3.0, generator, n=n) for _ in range(trials)]
        F, c = (torch.stack(parts) for parts in zip(*pairs, strict=True))
        return focal_from_fundamentals(F, c, c, image_size=SIZE).status == Status.OK

    assert_share(~torch.cat([told(kind, 300, 20) for kind in ("forward", "translation")]), 0.97)
    assert_share(told("object", 60, 150), 0.9)


def test_uninformative_pairs_do_no_harm(generator):
    F, c = simulate("object", 5, 0.5, generator)
    G, d = simulate("turntable", 8, 0.5, generator)
    found = focal_from_fundamentals(torch.cat((F, G)), torch.cat((c, d)), torch.cat((c, d)), image_size=SIZE)
    assert found.status == Status.OK
    assert abs(found.model / FOCAL - 1) < 0.01


def test_planes_alone_are_reported(generator):
    for _ in range(5):
        F, c = simulate("object", 6, 0.5, generator, planar=True)
        assert focal_from_fundamentals(F, c, c, image_size=SIZE).status in (Status.NO_CONSENSUS, Status.DEGENERATE)


def test_images_of_different_size_and_swapped_views(generator):
    F, c = simulate("walk", 5, 0.0, generator)
    # Crop the second images.
    T = torch.eye(3, dtype=torch.float64)
    T[:2, 2] = torch.tensor([-100.0, 60.0])
    cropped = T.inverse().T @ F
    moved = c + T[:2, 2]
    found = focal_from_fundamentals(cropped, c, moved, image_size=SIZE)
    swapped = focal_from_fundamentals(-7 * cropped.mT, moved, c, image_size=SIZE)
    assert abs(found.model - FOCAL) < 1e-3
    assert abs(found.model - swapped.model) < 1e-6


def test_weights_and_search_range(generator):
    F, c = simulate("object", 4, 0.5, generator)
    base = focal_from_fundamentals(F, c, c, image_size=SIZE)
    bad = torch.cat((F, torch.full((1, 3, 3), torch.nan, dtype=torch.float64)))
    weights = torch.tensor([1.0] * len(F) + [0.0], dtype=torch.float64)
    centres = torch.cat((c, c[:1]))
    assert torch.allclose(focal_from_fundamentals(bad, centres, centres, weights=weights, image_size=SIZE).model, base.model)
    assert torch.allclose(focal_from_fundamentals(F, c, c).model, base.model, rtol=1e-7)
    ranged = focal_from_fundamentals(F, c, c, focal_range=(500.0, 9000.0))
    assert torch.allclose(ranged.model, base.model, rtol=1e-7)
    assert ranged.candidates[0] >= 499
    assert ranged.candidates[-1] <= 9001
    # The true focal length is outside the range.
    outside = focal_from_fundamentals(F, c, c, focal_range=(4000.0, 9000.0))
    assert outside.status in (Status.DEGENERATE, Status.NO_CONSENSUS)


def test_the_cost_curve_has_its_minimum_there(generator):
    F, c = simulate("walk", 4, 0.5, generator)
    found = focal_from_fundamentals(F, c, c, image_size=SIZE)
    lowest = found.candidates[found.cost.argmin()]
    assert abs((lowest / found.model).log()) < 0.02
    # The asymmetry is what the singular values say.
    K = torch.diag(torch.stack((found.model, found.model, torch.ones_like(found.model))))
    K[0, 2], K[1, 2] = CENTRE
    s = torch.linalg.svdvals(K.T @ F @ K)
    assert torch.allclose(found.asymmetry, (s[:, 0] - s[:, 1]) / (s[:, 0] + s[:, 1]), atol=1e-7)


def test_batches_and_bad_elements(generator):
    problems = [simulate("object", 4, 0.5, generator) for _ in range(5)]
    F, c = (torch.stack(parts) for parts in zip(*problems, strict=True))
    good = focal_from_fundamentals(F, c, c, image_size=SIZE)
    for i in range(5):
        alone = focal_from_fundamentals(F[i], c[i], c[i], image_size=SIZE)
        assert torch.allclose(alone.model, good.model[i], rtol=1e-9)
        assert alone.status == good.status[i]
    F = F.clone()
    F[1] = torch.nan
    F[2] = 0
    weights = torch.ones(5, 6, dtype=torch.float64)
    weights[3] = 0
    found = focal_from_fundamentals(F, c, c, weights=weights, image_size=SIZE)
    assert found.status.tolist()[1:4] == [Status.NOT_FINITE, Status.NOT_FINITE, Status.TOO_FEW]
    for name in ("model", "uncertainty", "candidates", "cost", "asymmetry"):
        assert getattr(found, name).isfinite().all()
        assert torch.equal(getattr(found, name)[[0, 4]], getattr(good, name)[[0, 4]])
    assert focal_from_fundamentals(F[:, :0], c[:, :0], c[:, :0], image_size=SIZE).status.tolist() == [Status.TOO_FEW] * 5
    assert focal_from_fundamentals(F[:0], c[:0], c[:0], image_size=SIZE).model.shape == (0,)
    single = focal_from_fundamentals(F[0].float(), c[0].float(), c[0].float(), image_size=SIZE.float())
    assert single.model.dtype == torch.float32
    assert abs(single.model / FOCAL - 1) < 0.02


def test_derivatives(generator):
    F, c = simulate("object", 3, 0.5, generator)
    S = torch.diag(torch.tensor([1e3, 1e3, 1.0], dtype=torch.float64))
    F = S @ F @ S
    F = (F / torch.linalg.matrix_norm(F)[:, None, None]).requires_grad_()
    c1, c2 = (c / 1e3).clone().requires_grad_(), (c / 1e3).clone().requires_grad_()
    w = torch.rand(len(F), generator=generator, dtype=torch.float64).add(0.5).requires_grad_()

    def solve(F, c1, c2, w):
        return focal_from_fundamentals(F, c1, c2, weights=w, image_size=SIZE / 1e3).model

    assert torch.autograd.gradcheck(solve, (F, c1, c2, w), fast_mode=True)


def test_nothing_leaves_the_device():
    F = torch.empty(2, 5, 3, 3, device="meta")
    c = torch.empty(2, 5, 2, device="meta")
    assert focal_from_fundamentals(F, c, c).model.device.type == "meta"


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(generator):
    F, c = simulate("object", 3, 0.5, generator)
    with pytest.raises(ValueError, match="focal_range"):
        focal_from_fundamentals(F, c, c, focal_range=(3.0, 2.0))
    with pytest.raises(ValueError, match="num_candidates"):
        focal_from_fundamentals(F, c, c, num_candidates=3)
    with pytest.raises(ValueError, match="c1: wanted p = 3"):
        focal_from_fundamentals(F, c[:2], c)


def test_fountain(data: Path, generator: torch.Generator):
    # True poses and intrinsics, simulated points near the fountain, half a pixel of noise.
    files = sorted((data / "images" / "fountain-P11" / "gt").glob("*.txt"))
    K = torch.tensor(np.stack([np.loadtxt(p, max_rows=3) for p in files]))
    Rt = torch.tensor(np.stack([np.loadtxt(p, skiprows=3) for p in files]))
    R, C = Rt[..., :3], -(Rt[..., :3].mT @ Rt[..., 3:])[..., 0]
    axis = R[:, 2]
    middle = torch.linalg.lstsq(
        (torch.eye(3) - axis[:, :, None] * axis[:, None]).flatten(0, 1),
        ((torch.eye(3) - axis[:, :, None] * axis[:, None]) @ C[..., None]).flatten(0, 1),
    ).solution[:, 0]
    X = middle + 1.2 * torch.randn(200, 3, generator=generator, dtype=torch.float64)
    F = fundamentals(R, C, K, X, 0.5, generator)
    i, j = torch.triu_indices(len(files), len(files), 1)
    size = torch.tensor([1536.0, 1024.0], dtype=torch.float64)
    truth = K[0, 0, 0]
    found = focal_from_fundamentals(F, K[i, :2, 2], K[j, :2, 2], image_size=size)
    assert found.status == Status.OK
    assert abs(found.model / truth - 1) < 0.01
    centred = ((size - 1) / 2).expand(len(F), 2)
    assert abs(focal_from_fundamentals(F, centred, centred, image_size=size).model / truth - 1) < 0.05
