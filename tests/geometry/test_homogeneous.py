import math

import pytest
import torch
from chance import seeded
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsfm.geometry import from_homogeneous, normalize_sphere, normalizing_similarity, to_homogeneous, transform_points

numbers = st.floats(-1e6, 1e6, allow_subnormal=False)


@settings(deadline=None, max_examples=100)
@given(st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=8), st.floats(1e-30, 1e30), st.booleans())
def test_from_homogeneous_undoes_to_homogeneous_at_any_scale(rows, scale, negative):
    x = torch.tensor(rows, dtype=torch.float64)
    back, finite = from_homogeneous(to_homogeneous(x) * (-scale if negative else scale))
    assert finite.all()
    torch.testing.assert_close(back, x, rtol=1e-14, atol=1e-250)


def test_points_at_infinity_are_masked_with_finite_values_and_gradients():
    bad = [
        [1.0, 2.0, 0.0],
        [1.0, 2.0, 1e-20],
        [0.0, 0.0, 0.0],
        [math.nan, 1.0, 1.0],
        [1.0, math.inf, 1.0],
        [1.0, 1.0, math.inf],
    ]
    x = torch.tensor([*bad, [4.0, 6.0, 2.0]], dtype=torch.float64, requires_grad=True)
    y, finite = from_homogeneous(x)
    assert finite.tolist() == [False] * 6 + [True]
    assert y[-1].tolist() == [2.0, 3.0]
    assert (y[:-1] == 0).all()
    y.square().sum().backward()
    assert x.grad.isfinite().all()
    assert (x.grad[:-1] == 0).all()
    assert (x.grad[-1] != 0).all()


@pytest.mark.parametrize("scale", [1e-200, 1e-3, 1.0, 1e200])
def test_normalize_sphere(scale, generator):
    x = torch.randn(50, 4, generator=generator, dtype=torch.float64)
    y = normalize_sphere(x * scale)
    torch.testing.assert_close(y.norm(dim=-1), torch.ones(50, dtype=torch.float64))
    torch.testing.assert_close(y * x.norm(dim=-1, keepdim=True), x)


def test_normalize_sphere_of_zero_and_nan_is_zero_without_gradient():
    x = torch.tensor([[0.0, 0.0], [math.nan, 1.0], [math.inf, 0.0], [3.0, 4.0]], dtype=torch.float64, requires_grad=True)
    y = normalize_sphere(x)
    assert y.tolist() == [[0, 0], [0, 0], [0, 0], [0.6, 0.8]]
    y[:, 0].sum().backward()
    assert (x.grad[:3] == 0).all()
    torch.testing.assert_close(x.grad[3], torch.tensor([0.128, -0.096], dtype=torch.float64))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**31), st.floats(1e-4, 1e4), st.floats(-1e4, 1e4), st.sampled_from([2, 3]), st.integers(2, 20))
def test_normalizing_similarity_centres_and_scales(seed, scale, offset, dimension, count):
    generator = seeded(seed)
    x = torch.randn(3, count, dimension, generator=generator, dtype=torch.float64) * scale + offset
    T = normalizing_similarity(x)
    y = transform_points(T, x)
    torch.testing.assert_close(y.mean(-2), torch.zeros(3, dimension, dtype=torch.float64), atol=1e-6, rtol=0)
    torch.testing.assert_close(
        y.square().sum(-1).mean(-1), torch.full((3,), float(dimension), dtype=torch.float64), rtol=1e-6, atol=0
    )
    linear = T[..., :dimension, :dimension]
    torch.testing.assert_close(linear, linear[:, :1, :1] * torch.eye(dimension, dtype=torch.float64).expand_as(linear))
    assert (T[..., -1, :] == torch.eye(dimension + 1, dtype=torch.float64)[-1]).all()


def test_normalizing_similarity_leaves_out_absent_and_broken_points(generator):
    x = torch.randn(10, 2, generator=generator, dtype=torch.float64)
    weights = torch.ones(10, dtype=torch.float64)
    weights[3] = 0
    broken = x.clone()
    broken[3] = math.nan
    broken[7] = math.inf
    kept = torch.tensor([i for i in range(10) if i not in (3, 7)])
    torch.testing.assert_close(normalizing_similarity(broken, weights), normalizing_similarity(x[kept]))
    doubled = torch.cat([x, x[:2]])
    weights = torch.ones(10, dtype=torch.float64)
    weights[:2] = 2
    torch.testing.assert_close(normalizing_similarity(x, weights), normalizing_similarity(doubled))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normalizing_similarity_of_coinciding_points_only_moves_them(dtype):
    point = torch.tensor([1234.567, -0.1], dtype=dtype, requires_grad=True)
    T = normalizing_similarity(point.expand(7, 2))
    expected = torch.eye(3, dtype=dtype)
    expected[:2, 2] = -point.detach()
    torch.testing.assert_close(T, expected)
    T.sum().backward()
    assert point.grad.isfinite().all()
    nothing = normalizing_similarity(torch.zeros(0, 2, dtype=dtype))
    assert (nothing == torch.eye(3, dtype=dtype)).all()
    assert (normalizing_similarity(point.detach().expand(4, 2), torch.zeros(4, dtype=dtype)) == torch.eye(3, dtype=dtype)).all()


@pytest.mark.parametrize("shapes", [((), ()), ((2, 3), (3,)), ((4,), ()), ((), (4,)), ((0,), (0,))])
def test_transform_points_broadcasts_like_a_loop(shapes, generator):
    H = torch.randn(*shapes[0], 3, 3, generator=generator, dtype=torch.float64)
    x = torch.randn(*shapes[1], 5, 2, generator=generator, dtype=torch.float64)
    batch = torch.broadcast_shapes(*shapes)
    y = transform_points(H, x)
    assert y.shape == (*batch, 5, 2)
    full_H, full_x = H.expand(*batch, 3, 3).reshape(-1, 3, 3), x.expand(*batch, 5, 2).reshape(-1, 5, 2)
    for one_H, one_x, one_y in zip(full_H, full_x, y.reshape(-1, 5, 2), strict=True):
        h = one_H @ torch.cat([one_x, torch.ones(5, 1, dtype=torch.float64)], 1).T
        torch.testing.assert_close(one_y, (h[:2] / h[2]).T)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_transform_points_is_finite_at_infinity(dtype):
    H = torch.tensor([[1.0, 0, 0], [0, 1, 0], [1, 0, 0]], dtype=dtype, requires_grad=True)
    x = torch.tensor([[0.0, 3.0], [0.0, 0.0], [math.nan, 1.0], [math.inf, 1.0], [2.0, 4.0]], dtype=dtype, requires_grad=True)
    y = transform_points(H, x)
    assert y.isfinite().all()
    assert y[0, 0] == 0
    assert y[0, 1] > 0.1 / torch.finfo(dtype).eps
    assert y[-1].tolist() == [1.0, 2.0]
    y.sum().backward()
    assert x.grad.isfinite().all()
    assert H.grad.isfinite().all()


@pytest.mark.usefixtures("unchecked")
def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="H, x: wanted shapes"):
        transform_points(torch.eye(4), torch.zeros(5, 2))
    with pytest.raises(ValueError, match="weights: wanted n = 5"):
        normalizing_similarity(torch.zeros(5, 2), torch.zeros(4))
