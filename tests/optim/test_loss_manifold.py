import pytest
import torch

from torchsfm.geometry import Line3D
from torchsfm.optim import (
    Cauchy,
    Euclidean,
    GemanMcClure,
    Huber,
    Manifold,
    Positive,
    Product,
    RigidMotion,
    Rotation,
    SoftL1,
    Subset,
    Truncated,
    Tukey,
    UnitSphere,
    levenberg_marquardt,
    loss_slope,
    rotation_exponential,
)

F64 = torch.float64
LOSSES = [Huber(0.7), SoftL1(0.7), Cauchy(0.7), GemanMcClure(0.7), Tukey(0.7), Truncated(0.7)]


@pytest.mark.parametrize("loss", LOSSES, ids=lambda x: type(x).__name__)
def test_losses(loss: object) -> None:
    s = torch.cat((torch.linspace(0, 3, 301, dtype=F64), torch.tensor([1e6, 1e12, 1e300], dtype=F64)))
    rho = loss(s)
    assert rho.isfinite().all()
    assert (rho.diff() >= 0).all()
    assert (rho <= s * (1 + 1e-15)).all()
    small = torch.tensor(1e-9, dtype=F64)
    torch.testing.assert_close(loss(small) / small, torch.ones((), dtype=F64), rtol=1e-8, atol=0)
    variable = s.clone().requires_grad_()
    (automatic,) = torch.autograd.grad(loss(variable).sum(), variable)
    torch.testing.assert_close(loss.slope(s), automatic)
    torch.testing.assert_close(loss_slope(lambda v: loss(v), s), automatic)
    assert loss_slope(loss, torch.tensor([torch.nan, torch.inf], dtype=F64)).isfinite().all()


MANIFOLDS = [
    Euclidean(4),
    Subset(5, (0, 3)),
    RigidMotion(),
    Rotation(),
    UnitSphere(2),
    UnitSphere(3),
    UnitSphere(4),
    UnitSphere(9),
    Positive(2),
    Line3D(),
    Product((Rotation(), Positive(), Line3D())),
]


def point(manifold: Manifold, generator: torch.Generator, *batch: int) -> torch.Tensor:
    x = torch.randn((*batch, manifold.ambient), generator=generator, dtype=F64)
    if isinstance(manifold, Rotation | RigidMotion):
        x[..., :9] = rotation_exponential(x[..., :3]).flatten(-2)
    if isinstance(manifold, Line3D):
        x[..., 3:] = torch.linalg.cross(x[..., 3:], x[..., :3])
    if isinstance(manifold, Product):
        x = torch.cat([point(part, generator, *batch) for part in manifold.parts], -1)
    return x


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=repr)
def test_retractions(manifold: Manifold, generator: torch.Generator) -> None:
    assert isinstance(manifold, Manifold)
    x = point(manifold, generator, 50, 2)
    zero = torch.zeros(manifold.tangent, dtype=F64)
    torch.testing.assert_close(manifold.retract(x, zero), x, rtol=1e-14, atol=1e-15)
    delta = torch.randn(50, 2, manifold.tangent, generator=generator, dtype=F64)
    moved = manifold.retract(x, delta)
    assert moved.shape == x.shape
    for i in (0, 7):
        torch.testing.assert_close(manifold.retract(x[i, 1], delta[i, 1]), moved[i, 1])
    slope = torch.func.vmap(torch.func.jacrev(manifold.retract, argnums=1))(x[:, 0], torch.zeros_like(delta[:, 0]))
    assert (torch.linalg.matrix_rank(slope) == manifold.tangent).all()
    step = 1e-6
    numeric = (manifold.retract(x[:, 0], step * delta[:, 0]) - manifold.retract(x[:, 0], -step * delta[:, 0])) / (2 * step)
    torch.testing.assert_close((slope @ delta[:, 0, :, None])[..., 0], numeric, rtol=1e-7, atol=1e-8)
    assert torch.autograd.gradcheck(manifold.retract, (x[:3, 0], delta[:3, 0].clone().requires_grad_()))
    if isinstance(manifold, Positive):
        assert torch.equal(moved.sign(), x.sign())
    if isinstance(manifold, Line3D):
        torch.testing.assert_close((moved[..., :3] * moved[..., 3:]).sum(-1), torch.zeros(50, 2, dtype=F64))
        torch.testing.assert_close(moved.norm(dim=-1), x.norm(dim=-1))
    if isinstance(manifold, Rotation | RigidMotion):
        rotation = moved[..., :9].unflatten(-1, (3, 3))
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=F64).expand(50, 2, 3, 3))
    if isinstance(manifold, UnitSphere):
        torch.testing.assert_close(moved.norm(dim=-1), x.norm(dim=-1))


def test_sphere_step_is_an_angle(generator: torch.Generator) -> None:
    sphere = UnitSphere(3)
    x = torch.nn.functional.normalize(torch.randn(100, 3, generator=generator, dtype=F64), dim=-1)
    x = torch.cat((x, torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)))
    delta = 0.4 * torch.randn(106, 2, generator=generator, dtype=F64)
    angle = torch.acos((x * sphere.retract(x, delta)).sum(-1).clamp(-1, 1))
    torch.testing.assert_close(angle, delta.norm(dim=-1))


def test_rotation_exponential_is_the_matrix_exponential(generator: torch.Generator) -> None:
    w = torch.randn(100, 3, generator=generator, dtype=F64)
    w[50:] *= torch.logspace(-12, 0, 50, dtype=F64)[:, None]
    zero = torch.zeros_like(w[:, 0])
    cross = torch.stack((zero, -w[:, 2], w[:, 1], w[:, 2], zero, -w[:, 0], -w[:, 1], w[:, 0], zero), -1).unflatten(-1, (3, 3))
    torch.testing.assert_close(rotation_exponential(w), torch.linalg.matrix_exp(cross), rtol=1e-13, atol=1e-14)
    assert torch.autograd.gradcheck(rotation_exponential, (torch.zeros(1, 3, dtype=F64, requires_grad=True),))
    assert torch.autograd.gradgradcheck(rotation_exponential, (torch.zeros(1, 3, dtype=F64, requires_grad=True),))


def test_lines_through_the_origin_and_at_infinity() -> None:
    """Nothing blows up there, and a step leaves them."""
    e = torch.eye(6, dtype=F64)
    x = torch.cat((e, torch.zeros(1, 6, dtype=F64)))
    for delta in (torch.zeros(4, dtype=F64), torch.tensor([0.1, -0.2, 0.3, 0.4], dtype=F64)):
        step = delta.expand(7, 4).clone().requires_grad_()
        moved = Line3D().retract(x, step)
        torch.testing.assert_close(moved.norm(dim=-1), x.norm(dim=-1))
        torch.testing.assert_close((moved[:, :3] * moved[:, 3:]).sum(-1), torch.zeros(7, dtype=F64))
        (slope,) = torch.autograd.grad(moved.square().sum() + moved[:, ::2].sum(), step)
        assert slope.isfinite().all()
    torch.testing.assert_close(Line3D().retract(x, torch.zeros(7, 4, dtype=F64)), x)
    assert (moved[:6].abs() > 1e-3).sum(-1).min() >= 4


def test_lines_from_their_points(generator: torch.Generator) -> None:
    """A line is found again from noisy points near it, as the principal axis of the points."""
    points = torch.randn(8, 1, 3, generator=generator, dtype=F64) * torch.linspace(-2, 2, 20, dtype=F64)[:, None]
    points = points + torch.tensor([3.0, 1.0, 2.0], dtype=F64) + 0.01 * torch.randn(8, 20, 3, generator=generator, dtype=F64)

    def residual(line: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        d, m = line[..., None, :3], line[..., None, 3:]
        return (torch.linalg.cross(points, d.expand_as(points)) - m) / d.norm(dim=-1, keepdim=True)

    d = points[:, -1] - points[:, 0] + 0.3 * torch.randn(8, 3, generator=generator, dtype=F64)
    start = torch.cat((d, torch.linalg.cross(points[:, 5], d)), -1)
    found = levenberg_marquardt(residual, start, points, retract=Line3D().retract, size=4)
    middle = points.mean(1, keepdim=True)
    axis = torch.linalg.svd(points - middle).Vh[:, 0]
    cosine = (torch.nn.functional.normalize(found.x[:, :3], dim=-1) * axis).sum(-1).abs()
    torch.testing.assert_close(cosine, torch.ones(8, dtype=F64))
    off = torch.linalg.cross(middle[:, 0], found.x[:, :3]) - found.x[:, 3:]
    assert off.abs().max() < 1e-6


def test_a_loss_of_ones_own(generator: torch.Generator) -> None:
    """A plain function of the squared residual is the loss written with its slope."""
    x = torch.randn(5, 30, 1, generator=generator, dtype=F64)
    x[:, :4] += 20

    def away(m: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        return m[..., None, :] - x

    start = torch.ones(5, 1, dtype=F64)
    given = levenberg_marquardt(away, start, x, loss=Cauchy(1.5))
    own = levenberg_marquardt(away, start, x, loss=lambda s: 2.25 * torch.log1p(s / 2.25))
    torch.testing.assert_close(own.x, given.x, rtol=1e-6, atol=1e-6)
    assert (own.x.abs() < 1).all()
