import math

import pytest
import torch
from chance import seeded
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsfm import Status
from torchsfm.geometry import Pose, Similarity, random_rotation, rotation_from_rotvec, similarity_from_points


def make(*shape, generator, scale=1.0):
    t = torch.randn(*shape, 3, generator=generator, dtype=torch.float64) * scale
    size = scale * torch.rand(shape, generator=generator, dtype=torch.float64) + 0.1 * scale
    return Similarity(size, random_rotation(*shape, generator=generator, dtype=torch.float64), t)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**31), st.floats(1e-4, 1e4), st.integers(3, 12), st.booleans())
def test_exact_points_give_the_similarity_back(seed, scale, count, planar):
    generator = seeded(seed)
    truth = make(4, generator=generator, scale=scale)
    X = torch.randn(4, count, 3, generator=generator, dtype=torch.float64)
    if planar:
        X[..., 2] = 0
    found = similarity_from_points(X, truth.transform(X))
    assert (found.status == Status.OK).all()
    torch.testing.assert_close(found.scale, truth.scale, rtol=1e-9, atol=0)
    torch.testing.assert_close(found.R, truth.R, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.transform(X), truth.transform(X), rtol=1e-9, atol=1e-9 * scale)


def test_it_is_the_least_squares_optimum(generator):
    """Noisy points: no small change of the seven parameters makes the sum of squares smaller, with weights too."""
    X = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    Y = make(generator=generator).transform(X) + 0.2 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    for weights in (None, torch.rand(30, generator=generator, dtype=torch.float64)):
        best = similarity_from_points(X, Y, weights)

        def cost(delta, best=best, weights=weights):
            changed = Similarity(best.scale * delta[6].exp(), rotation_from_rotvec(delta[:3]) @ best.R, best.t + delta[3:6])
            square = (changed.transform(X) - Y).square().sum(-1)
            return (square if weights is None else weights * square).sum()

        zero = torch.zeros(7, dtype=torch.float64)
        assert torch.func.grad(cost)(zero).abs().max() < 1e-12
        assert torch.linalg.eigvalsh(torch.autograd.functional.hessian(cost, zero)).min() > 0


def test_mirrored_points_still_give_a_rotation(generator):
    X = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    found = similarity_from_points(X, X * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.det(found.R), torch.tensor(1.0, dtype=torch.float64))


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.03])
def test_mirrored_points_are_told(noise, generator):
    X = torch.randn(200, 20, 3, generator=generator, dtype=torch.float64)
    truth = make(200, generator=generator)

    def status(X, Y):
        error = noise * truth.scale[:, None, None] * torch.randn(X.shape, generator=generator, dtype=torch.float64)
        return similarity_from_points(X, Y + error).status

    mirror = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert (status(X, truth.transform(X * mirror)) == Status.DEGENERATE).all()
    assert (status(X, truth.transform(X)) == Status.OK).all()
    # A plane is its own mirror image, and so is what is thinner than its noise.
    for thickness in (0.0, 0.2 * noise):
        flat = X * torch.tensor([1.0, 1.0, thickness], dtype=torch.float64)
        assert (status(flat, truth.transform(flat)) == Status.OK).all()
        assert (status(flat, truth.transform(flat * mirror)) == Status.OK).all()


def test_gradients_of_exact_and_noisy_and_isotropic_points(generator):
    X = torch.randn(2, 6, 3, generator=generator, dtype=torch.float64)
    corners = torch.tensor([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=torch.float64)
    weights = torch.rand(2, 6, generator=generator, dtype=torch.float64) + 0.1
    truth = make(2, generator=generator)

    def fit(*inputs):
        found = similarity_from_points(*inputs)
        return found.scale, found.R, found.t

    Y = truth.transform(X)
    noisy = Y + 0.1 * torch.randn(2, 6, 3, generator=generator, dtype=torch.float64)
    for target in (Y, noisy):
        assert torch.autograd.gradcheck(fit, (X.clone().requires_grad_(), target.clone().requires_grad_()))
    assert torch.autograd.gradcheck(fit, (X.requires_grad_(), noisy, weights.requires_grad_()))
    # The covariance of a cube has one singular value three times: the derivative of an SVD fails there.
    assert torch.autograd.gradcheck(fit, (corners.requires_grad_(), (2 * corners.detach()).requires_grad_()))


def test_absent_and_broken_pairs_and_statuses(generator):
    truth = make(generator=generator)
    X = torch.randn(8, 3, generator=generator, dtype=torch.float64)
    Y = truth.transform(X)
    Y[2] = 100
    X[5, 1] = math.nan
    weights = torch.ones(8, dtype=torch.float64)
    weights[2] = 0
    found = similarity_from_points(X, Y, weights)
    torch.testing.assert_close(found.R, truth.R)
    line = torch.arange(8, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    none = torch.zeros(8, dtype=torch.float64)
    two = torch.tensor([1.0, 1.0] + [0.0] * 6, dtype=torch.float64)
    sets = [(X, Y, weights), (line, line, weights), (X, Y, none), (X, Y, two), (torch.ones_like(X), Y, weights)]
    X, Y, weights = (torch.stack(tensors).requires_grad_() for tensors in zip(*sets, strict=True))
    batched = similarity_from_points(X, Y, weights)
    assert batched.status.tolist() == [Status.OK, Status.DEGENERATE, Status.TOO_FEW, Status.TOO_FEW, Status.DEGENERATE]
    torch.testing.assert_close(batched.R[0], found.R)
    for value in (batched.scale, batched.R, batched.t):
        assert value.isfinite().all()
    (batched.scale.sum() + batched.R.sum() + batched.t.sum()).backward()
    assert all(tensor.grad.isfinite().all() for tensor in (X, Y, weights))


@pytest.mark.parametrize("shape", [(), (2, 3), (0,)])
def test_inverse_matrix_and_poses(shape, generator):
    similarity = make(*shape, generator=generator)
    X = torch.randn(*shape, 5, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(similarity.inverse().transform(similarity.transform(X)), X)
    homogeneous = torch.nn.functional.pad(X, (0, 1), value=1.0) @ similarity.matrix().mT
    torch.testing.assert_close(homogeneous[..., :3], similarity.transform(X))
    t = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    pose = Pose(random_rotation(*shape, generator=generator, dtype=torch.float64), t)
    moved = similarity.transform_pose(pose)
    expected = similarity.scale[..., None, None] * pose.transform(X)
    torch.testing.assert_close(moved.transform(similarity.transform(X)), expected)
    torch.testing.assert_close(moved.centre, similarity.transform(pose.centre[..., None, :]).squeeze(-2))
