import math

import pytest
import torch
from chance import assert_share, seeded
from hypothesis import example, given, settings
from hypothesis import strategies as st

from torchsfm._types import tensor_map
from torchsfm.geometry import (
    DISTORTION_MODELS,
    BrownConrady,
    KannalaBrandt,
    NoDistortion,
    Radial,
    SimpleRadial,
)

REAL = {
    "pinhole": [],
    "simple_radial": [-0.2],
    "radial": [-0.25, 0.12],
    "opencv": [-0.28, 0.09, 0.0008, -0.0013, -0.01],
    "fisheye": [-0.02, 0.008, -0.006, 0.001],
}
"""Parameters such as calibrations of real lenses find."""
NAMES = list(DISTORTION_MODELS)
for name in NAMES:
    REAL.setdefault(name, [-0.05 / 4**i for i in range(DISTORTION_MODELS[name].num_parameters)])


def make(name, p=None, dtype=torch.float64):
    return DISTORTION_MODELS[name].from_parameters(torch.tensor(REAL[name] if p is None else p, dtype=dtype))


def rays(angle, generator, count=200, dtype=torch.float64):
    """Rays uniform in the angle to the axis, up to `angle`."""
    theta = torch.rand(count, generator=generator, dtype=torch.float64) * angle
    phi = torch.rand(count, generator=generator, dtype=torch.float64) * 2 * math.pi
    d = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)
    return d.to(dtype)


def angles_between(a, b):
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


def brute_force_fold(coefficients, end):
    """First radius on a fine grid where r (1 + k1 r^2 + ...) stops increasing."""
    r = torch.linspace(0, end, 200001, dtype=torch.float64)
    g = r * (1 + sum(k * r ** (2 * i + 2) for i, k in enumerate(coefficients)))
    falls = (g[1:] <= g[:-1]).nonzero()
    return r[falls[0, 0]].item() if len(falls) else math.inf


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_unproject_undoes_project(name, dtype, generator):
    model = make(name, dtype=dtype)
    widest = 1.5 if name == "fisheye" else 0.7
    d = rays(widest, generator, 5000, dtype)
    found, valid = model.unproject(model.project(d))
    assert model.in_domain(d).all()
    assert valid.all()
    assert found.dtype == dtype
    assert angles_between(found, d).max() < 50 * torch.finfo(dtype).eps
    assert (found[..., 2] == 1).all()


@settings(deadline=None, max_examples=80)
@example("opencv", 12851, 1.0)  # rises to a fold at a radius of 81
@given(st.sampled_from(NAMES[1:]), st.integers(0, 2**31), st.sampled_from([0.05, 0.3, 1.0]))
def test_every_ray_of_the_domain_is_found_again(name, seed, spread):
    """Parameters without any physical sense, too: 0.99 of all rays up to 0.999 of the valid radius."""
    generator = seeded(seed)
    cls = DISTORTION_MODELS[name]
    p = (2 * torch.rand(20, cls.num_parameters, generator=generator, dtype=torch.float64) - 1) * spread
    if name == "opencv":
        p[:, 2:4] *= 0.01
    model = cls.from_parameters(p)
    limit = model.valid_radius()
    limit = limit if name == "fisheye" else limit.atan()
    theta = (
        torch.rand(20, 100, generator=generator, dtype=torch.float64)
        * (0.999 * limit.clamp(max=1.4 if name != "fisheye" else 3.1))[:, None]
    )
    phi = torch.rand(20, 100, generator=generator, dtype=torch.float64) * 2 * math.pi
    d = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)
    u = model.project(d)
    found, valid = model.unproject(u)
    assert found.isfinite().all()
    inside = model.in_domain(d)
    assert_share(inside, 0.98)
    good = valid & (angles_between(found, d) < 1e-6)
    assert_share(good[inside], 0.99)
    again = model.project(found)
    torch.testing.assert_close(again[valid], u[valid], rtol=1e-11, atol=1e-13)
    assert_share(model.in_domain(found)[valid], 0.999)


@settings(deadline=None, max_examples=100)
@example([1.0, 5.45966123444489e-265, 0.0, 5.45966123444489e-265])
@given(st.lists(st.floats(-2, 2, allow_subnormal=False), min_size=1, max_size=4))
def test_valid_radius_is_the_first_fold(coefficients):
    cls = {1: SimpleRadial, 2: Radial, 3: BrownConrady, 4: KannalaBrandt}[len(coefficients)]
    p = [*coefficients[:2], 0.0, 0.0, coefficients[2]] if cls is BrownConrady else coefficients
    radius = cls.from_parameters(torch.tensor(p, dtype=torch.float64)).valid_radius().item()
    end = math.pi if cls is KannalaBrandt else 8.0
    expected = brute_force_fold(coefficients, end)
    s = radius * radius
    if radius < end:
        slope = 1 + sum((2 * i + 3) * k * s ** (i + 1) for i, k in enumerate(coefficients))
        size = 1 + sum(abs((2 * i + 3) * k * s ** (i + 1)) for i, k in enumerate(coefficients))
        assert abs(slope) < 1e-5 * size
        # On the grid a slope that only touches zero may be missed; it may not be found earlier.
        assert expected > radius - 1e-3
    else:
        assert expected >= end - 1e-3
        assert cls is not KannalaBrandt or radius == math.pi


def test_valid_radius_by_hand():
    assert SimpleRadial(torch.tensor(-1 / 3)).valid_radius().item() == pytest.approx(1)
    assert SimpleRadial(torch.tensor([0.1, 0.0])).valid_radius().tolist() == [math.inf, math.inf]
    # 1 - 3 s + 5 k2 s^2 = 0 has the roots 1/2 and 1 when 5 k2 = 2.
    radial = Radial(torch.tensor([-1.0, -1.0], dtype=torch.float64), torch.tensor([0.4, 10.0], dtype=torch.float64))
    torch.testing.assert_close(radial.valid_radius(), torch.tensor([math.sqrt(0.5), math.inf], dtype=torch.float64))
    assert make("fisheye", [0.0] * 4).valid_radius().item() == pytest.approx(math.pi)
    assert NoDistortion().valid_radius().item() == math.inf
    broken = Radial(torch.tensor([math.nan, math.inf, -0.1]), torch.tensor([0.0, 0.0, 0.0])).valid_radius()
    assert broken[:2].tolist() == [0.0, 0.0]
    assert broken[2] > 1


@pytest.mark.parametrize("name", NAMES[1:])
def test_gradients(name, generator):
    d = rays(1.2 if name == "fisheye" else 0.6, generator, 12).requires_grad_()
    with torch.no_grad():
        d[0] = torch.tensor([0.0, 0.0, 1.0])
        d[1] = torch.tensor([1e-9, 0.0, 2.0])
        d[2] = torch.tensor([0.04, 0.0, 1.0])
    p = torch.tensor(REAL[name], dtype=torch.float64, requires_grad=True)
    cls = DISTORTION_MODELS[name]
    assert torch.autograd.gradcheck(lambda d, p: cls.from_parameters(p).project(d), (d, p))
    u = make(name).project(d).detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda u, p: cls.from_parameters(p).unproject(u)[0], (u, p))
    jacobian = torch.func.jacrev
    inverse = torch.func.vmap(jacobian(lambda u: make(name).unproject(u[None])[0][0, :2]))(u)
    forward = torch.func.vmap(jacobian(lambda d: make(name).project(d[None])[0]))(make(name).unproject(u)[0])[..., :2]
    torch.testing.assert_close(inverse @ forward, torch.eye(2, dtype=torch.float64).expand(12, 2, 2))


def test_wide_rays_of_a_fisheye(generator):
    model = make("fisheye", [0.01, 0.0, 0.0, 0.0])
    d = rays(3.0, generator, 500)
    found, valid = model.unproject(model.project(d))
    assert valid.all()
    assert angles_between(found, d).max() < 1e-13
    behind = d[:, 2] < 0
    assert behind.any()
    torch.testing.assert_close(found[behind].norm(dim=-1), torch.ones(int(behind.sum()), dtype=torch.float64))
    assert (found[d[:, 2] > 0.01][:, 2] == 1).all()
    edge = rays(0.0, generator, 3)
    edge[:] = torch.tensor([[1.0, 0.0, 0.0], [0.6, 0.8, 1e-9], [0.6, 0.8, -1e-9]])
    edge.requires_grad_()
    u = model.project(edge)
    torch.testing.assert_close(u.norm(dim=-1), torch.full((3,), math.pi / 2 * (1 + 0.01 * math.pi**2 / 4), dtype=torch.float64))
    found, valid = model.unproject(u)
    assert valid.all()
    found.sum().backward()
    assert edge.grad.isfinite().all()


@pytest.mark.parametrize(
    ("name", "folding"),
    [
        ("simple_radial", [-0.3]),
        ("radial", [-0.3, -0.1]),
        ("opencv", [-0.3, -0.1, 0.001, 0.001, -0.02]),
        ("fisheye", [-0.1, -0.05, 0.0, 0.0]),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_beyond_the_fold_is_masked_and_finite(name, folding, dtype):
    p = torch.tensor(folding, dtype=dtype, requires_grad=True)
    model = DISTORTION_MODELS[name].from_parameters(p)
    limit = model.valid_radius().item()
    theta = torch.tensor([0.0, 0.3 * limit, 0.9 * limit, 1.1 * limit, 1.5 * limit], dtype=dtype)
    if name != "fisheye":
        theta = theta.atan()
    d = torch.stack([theta.sin() * 0.6, theta.sin() * 0.8, theta.cos()], -1)
    assert model.in_domain(d).tolist() == [True, True, True, False, False]
    found, valid = model.unproject(model.project(d).detach())
    assert valid[:3].all()
    assert angles_between(found[:3], d[:3]).max() < 300 * torch.finfo(dtype).eps
    # A ray beyond the fold has the image of another ray within it, or none: it is never returned itself.
    assert angles_between(found[3:], d[3:]).min() > 0.01
    top = 3.0 * model.project(d[2:3]).norm().item()
    far = torch.tensor([[top, 0.0], [1e3, 1e3], [-1e9, 1e18], [math.inf, 0.0], [math.nan, 1.0], [0.1, 0.1]], dtype=dtype)
    far.requires_grad_()
    found, valid = model.unproject(far)
    assert valid.tolist() == [False] * 5 + [True]
    assert found.isfinite().all()
    found.sum().backward()
    assert far.grad.isfinite().all()
    assert p.grad.isfinite().all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_awkward_rays_project_to_finite_points_with_finite_gradients(name, dtype):
    d = [[0, 0, 1], [0, 0, 0], [1, 2, 0], [1, -2, 1e-30], [1, 2, -3], [0, 0, -1], [1e-6, 0, 1e-6], [1e3, -1e4, 1e-4]]
    d += [[math.nan, 1, 1], [1, math.inf, 2], [1, 1, -math.inf]]
    d = torch.tensor(d, dtype=dtype, requires_grad=True)
    p = torch.tensor(REAL[name], dtype=dtype, requires_grad=True)
    u = DISTORTION_MODELS[name].from_parameters(p).project(d)
    assert u.isfinite().all()
    u.sum().backward()
    assert d.grad.isfinite().all()
    assert p.numel() == 0 or p.grad.isfinite().all()
    if name == "pinhole":
        assert u[4].tolist() == pytest.approx([-1 / 3, -2 / 3])
        assert u[2].abs().min() > 0.1 / torch.finfo(dtype).eps


@pytest.mark.parametrize("name", NAMES[1:])
def test_broken_parameters_are_masked(name, generator):
    p = torch.tensor(REAL[name], dtype=torch.float64).repeat(3, 1)
    p[1, -1] = math.nan
    p[2, 0] = math.inf
    model = DISTORTION_MODELS[name].from_parameters(p)
    u = 0.2 * torch.randn(7, 2, generator=generator, dtype=torch.float64)
    d, valid = model.unproject(u)
    assert valid.tolist() == [[True] * 7, [False] * 7, [False] * 7]
    alone, _ = make(name).unproject(u)
    assert d[0].equal(alone)


@pytest.mark.parametrize("name", NAMES[1:])
@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_batches_equal_loops(name, shape, generator):
    cls = DISTORTION_MODELS[name]
    p = 0.05 * torch.randn(*shape, cls.num_parameters, generator=generator, dtype=torch.float64)
    d = rays(0.6, generator, 4)
    model = cls.from_parameters(p)
    assert model.parameters().equal(p)
    u = model.project(d)
    found, valid = model.unproject(u)
    assert found.shape == (*shape, 4, 3)
    assert valid.shape == (*shape, 4)
    for index in (
        torch.cartesian_prod(*(torch.arange(size) for size in shape)).reshape(-1, len(shape)).tolist() if shape else [[]]
    ):
        one = cls.from_parameters(p[tuple(index)])
        assert u[tuple(index)].equal(one.project(d))
        assert found[tuple(index)].equal(one.unproject(u[tuple(index)])[0])


@pytest.mark.parametrize("name", NAMES)
def test_many_points_and_vmap_give_the_same(name, generator):
    """More points than one block holds, in one call and in pieces, and through torch.func.vmap."""
    u = 0.5 * torch.rand(3, 15000, 2, generator=generator, dtype=torch.float64)
    model = make(name)
    whole, valid = model.unproject(u)
    assert valid.all()
    assert whole[1, 5000:5010].equal(model.unproject(u[1, 5000:5010])[0])
    assert whole[2].equal(model.unproject(u[2])[0])
    if name != "pinhole":
        cls = DISTORTION_MODELS[name]
        p = model.parameters() * torch.linspace(0.5, 1, 3, dtype=torch.float64)[:, None]
        batched, _ = cls.from_parameters(p).unproject(u[0, :50])
        mapped, _ = torch.func.vmap(lambda p: cls.from_parameters(p).unproject(u[0, :50]))(p)
        torch.testing.assert_close(mapped, batched, rtol=1e-14, atol=1e-14)


def test_names_and_counts():
    for cls in DISTORTION_MODELS.values():
        assert cls.num_parameters == len(cls.parameter_names)
    assert BrownConrady.parameter_names == ("k1", "k2", "p1", "p2", "k3")
    doubled = tensor_map(lambda k: 2 * k, make("radial"))
    assert doubled.parameters().tolist() == [-0.5, 0.24]
    with pytest.raises(ValueError, match="p: wanted shape"):
        Radial.from_parameters(torch.zeros(3))


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from(NAMES[1:]),
    st.sampled_from([torch.float32, torch.float64]),
    st.integers(0, 2**31),
    st.sampled_from([1e-30, 1e-3, 1.0, 1e3]),
    st.sampled_from([1e-30, 1e-6, 1.0, 1e3, 1e6]),
)
def test_any_numbers_give_finite_numbers_and_gradients(name, dtype, seed, size, distance):
    generator = seeded(seed)
    cls = DISTORTION_MODELS[name]
    p = (size * torch.randn(20, cls.num_parameters, generator=generator, dtype=torch.float64)).to(dtype).requires_grad_()
    u = (distance * torch.randn(20, 10, 2, generator=generator, dtype=torch.float64)).to(dtype).requires_grad_()
    d, _ = cls.from_parameters(p).unproject(u)
    X = torch.cat([u, u[..., :1].roll(1, 0)], -1)
    x = cls.from_parameters(p).project(X)
    for result in (d.clamp(-1e3, 1e3), x):
        assert result.isfinite().all()
        for gradient in torch.autograd.grad(result.sum(), (u, p)):
            assert gradient.isfinite().all()


@pytest.mark.reference
@pytest.mark.parametrize("name", ["simple_radial", "radial", "opencv"])
def test_opencv_agrees(name, generator):
    cv2 = pytest.importorskip("cv2")
    numpy = pytest.importorskip("numpy")
    coefficients = numpy.zeros(5)
    coefficients[: len(REAL[name])] = REAL[name]
    d = rays(0.6, generator, 500) * (0.5 + torch.rand(500, 1, generator=generator, dtype=torch.float64))
    expected = cv2.projectPoints(d.numpy(), numpy.zeros(3), numpy.zeros(3), numpy.eye(3), coefficients)[0][:, 0]
    u = make(name).project(d)
    torch.testing.assert_close(u, torch.from_numpy(expected), rtol=1e-13, atol=1e-14)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # one function since OpenCV 5
    back = undistort(u.numpy()[:, None], numpy.eye(3), coefficients, R=numpy.eye(3), P=numpy.eye(3), criteria=criteria)
    found, valid = make(name).unproject(u)
    assert valid.all()
    torch.testing.assert_close(found[:, :2], torch.from_numpy(back)[:, 0], rtol=0, atol=1e-9)


@pytest.mark.reference
def test_opencv_fisheye_agrees(generator):
    cv2 = pytest.importorskip("cv2")
    numpy = pytest.importorskip("numpy")
    coefficients = numpy.array(REAL["fisheye"])
    d = rays(1.3, generator, 500)
    zero = numpy.zeros(3)
    expected = cv2.fisheye.projectPoints(d.numpy()[:, None], zero, zero, numpy.eye(3), coefficients)[0][:, 0]
    u = make("fisheye").project(d)
    torch.testing.assert_close(u, torch.from_numpy(expected), rtol=1e-12, atol=1e-13)
    back = cv2.fisheye.undistortPoints(u.numpy()[:, None], numpy.eye(3), coefficients)[:, 0]
    found, valid = make("fisheye").unproject(u)
    assert valid.all()
    torch.testing.assert_close(found[:, :2], torch.from_numpy(back), rtol=1e-7, atol=1e-9)
