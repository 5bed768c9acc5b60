import pytest
import torch
from chance import seeded
from elsewhere import ELSEWHERE, elsewhere, send

from torchsfm._types import Status
from torchsfm.resection import camera_dlt, estimate_camera_projective
from torchsfm.resection.camera_dlt import other_camera
from torchsfm.robust import Degeneracy


@pytest.fixture
def make_problem(make_scene):
    """Pixels, points and cameras K [R | t] with |third row| = 1."""

    def make(*batch, n=20, noise=0.0, origin=0.0):
        Y, X, P = make_scene(*batch, n=n, width=0.6)
        K = torch.tensor([[900.0, 3.0, 640.0], [0.0, 950.0, 360.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        x = (Y @ K.T)[..., :2] / Y[..., 2:]
        t = P[..., 3] - (P[..., :3] @ torch.full((3,), origin, dtype=torch.float64))
        P = K @ torch.cat((P[..., :3], t[..., None]), -1)
        generator = seeded(1)
        return x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64), X + origin, P

    return make


def relative(P, Q):
    return ((P - Q).norm(dim=(-2, -1)) / Q.norm(dim=(-2, -1))).max()


def project(P, X):
    h = X @ P[..., :3].mT + P[..., None, :, 3]
    return h[..., :2] / h[..., 2:]


def lines_through(A, B, P):
    """Image lines and Pluecker vectors of the lines through A and B."""
    d = B - A
    a, b = (torch.cat((Z, torch.ones_like(Z[..., :1])), -1) @ P.mT for Z in (A, B))
    return torch.linalg.cross(a, b), torch.cat((d, torch.linalg.cross(A, d)), -1)


@pytest.mark.parametrize("n", [6, 7, 30])
@pytest.mark.parametrize("origin", [0.0, 1e3])
def test_exact_points(make_problem, n, origin):
    x, X, P = make_problem(40, n=n, origin=origin)
    found = camera_dlt(x, X)
    assert (found.status == Status.OK).all()
    assert relative(found.model, P) < 1e-8


def test_five_and_a_half_points(make_problem):
    x, X, P = make_problem(40, n=6)
    weights = torch.ones(6, 2, dtype=torch.float64)
    weights[5, 1] = 0
    x[:, 5, 1] = 1e5
    found = camera_dlt(x, X, weights=weights)
    assert (found.status == Status.OK).all()
    assert relative(found.model, P) < 1e-8
    weights[5, 0] = 0
    assert (camera_dlt(x, X, weights=weights).status == Status.TOO_FEW).all()


@pytest.mark.parametrize(("n", "k"), [(0, 6), (3, 3), (6, 5), (0, 20)])
def test_exact_lines(make_problem, n, k):
    _, X, P = make_problem(30, n=n + 2 * k)
    A, B = X[:, n : n + k], X[:, n + k :]
    line, L = lines_through(A, B, P)
    found = camera_dlt(project(P, X[:, :n]), X[:, :n], -5 * line, 3 * L)
    assert (found.status == Status.OK).all()
    assert relative(found.model, P) < 1e-7


def test_hidden_and_absent_data_do_not_count(make_problem):
    x, X, P = make_problem(3, n=12)
    line, L = lines_through(X[:, :6], X[:, 6:], P)
    weights, line_weights = torch.ones(3, 12, dtype=torch.float64), torch.ones(3, 6, dtype=torch.float64)
    weights[0, 4:] = 0
    line_weights[:, 5] = 0
    x[0, 4:], X[0, 4:] = torch.nan, torch.inf
    line[:, 5] = torch.nan
    found = camera_dlt(x, X, line, L, weights=weights, line_weights=line_weights)
    assert (found.status == Status.OK).all()
    assert relative(found.model, P) < 1e-8


def test_noise(make_problem):
    x, X, P = make_problem(200, n=50, noise=0.5)
    found = camera_dlt(x, X)
    assert (found.status == Status.OK).all()
    r = (project(found.model, X) - project(P, X)).square().sum(-1).mean(-1).sqrt()
    # The bound for the eleven parameters: each of the 2 n coordinates takes its share of their variance.
    bound = 0.5 * (11 / 50) ** 0.5
    assert r.median() < 1.5 * bound


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_coplanar_points_are_reported(make_problem, noise, dtype):
    _, X, P = make_problem(30, n=25)
    X[..., 2] = 0.3 * X[..., 0] - 0.2 * X[..., 1] + 5
    x = project(P, X)
    generator = seeded(2)
    x = x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    found = camera_dlt(x.to(dtype), X.to(dtype))
    assert (found.status == Status.DEGENERATE).all()
    assert found.model.isfinite().all()


def test_points_on_a_twisted_cubic_with_the_centre(generator):
    s = torch.randn(20, 12, generator=generator, dtype=torch.float64)
    M = torch.randn(20, 3, 3, generator=generator, dtype=torch.float64)
    curve = torch.stack((s, s**2, s**3), -1)
    P = torch.cat((M, torch.zeros(20, 3, 1, dtype=torch.float64)), -1)
    found = camera_dlt(project(P, curve), curve)
    assert (found.status == Status.DEGENERATE).all()


def twisted_cubics(make_problem, generator, number, noise):
    _, _, P = make_problem(number, n=6)
    centre = -torch.linalg.solve(P[:, :, :3], P[..., 3:])[..., 0]
    A = torch.randn(number, 3, 3, generator=generator, dtype=torch.float64) * 0.3
    s = torch.rand(number, 40, 1, generator=generator, dtype=torch.float64) * 2 + 0.5
    forward = torch.nn.functional.normalize(P[:, 2, :3], dim=-1)[:, None]
    X = centre[:, None] + 4 * s**3 * forward + torch.cat((s, s**2, s**3), -1) @ A
    x = project(P, X)
    return x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64), X


def test_noisy_points_on_a_twisted_cubic_with_the_centre(make_problem, generator):
    """Two cameras see them, of different depths: their algebraic errors say nothing of which is nearer to the data."""
    x, X = twisted_cubics(make_problem, generator, 400, 0.5)
    assert (camera_dlt(x, X).status != Status.OK).all()


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.5])
def test_robustly_points_on_a_twisted_cubic_leave_the_camera_open(make_problem, generator, noise):
    x, X = twisted_cubics(make_problem, generator, 40, noise)
    found = estimate_camera_projective(x, X, threshold=3.0, max_iterations=300, generator=generator)
    assert ((found.degeneracy != Degeneracy.NONE) | (found.status != Status.OK)).all()
    x, X, _ = make_problem(40, n=40, noise=noise)
    found = estimate_camera_projective(x, X, threshold=3.0, max_iterations=300, generator=generator)
    assert (found.degeneracy == Degeneracy.NONE).all()


@pytest.mark.parametrize("relief", [1e-3, 1e-5, 1e-7])
def test_rounding_does_not_hide_another_camera(generator, relief):
    """A cubic next to a line and to a plane, which passes through the centre at 0."""
    s = torch.rand(100, 40, 1, generator=generator, dtype=torch.float64) * 2 + 0.5
    axes, P = torch.randn(2, 100, 3, 3, generator=generator, dtype=torch.float64)
    X = torch.cat((s**3, 0.05 * s**2, relief * s), -1) @ torch.linalg.qr(axes)[0]
    y = X @ P
    x = y[..., :2] / y[..., 2:]
    x, X = ((t - t.mean(1, keepdim=True)) / t.std((1, 2), keepdim=True) for t in (x, X))
    x = x + 3e-5 * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    assert other_camera(x, X, torch.ones(100, 40, dtype=torch.bool), x.new_full((100,), 1e-7)).all()


def test_a_noisy_plane_and_one_point_off_it(make_problem):
    """The matrix that takes the plane to nothing and the point to its image fits exactly, and is no camera."""
    x, X, P = make_problem(100, n=20)
    X[:, 1:, 2] = 0.2 * X[:, 1:, 0]
    x = project(P, X) + 0.5 * torch.randn(x.shape, generator=seeded(), dtype=torch.float64)
    assert (camera_dlt(x, X).status == Status.DEGENERATE).all()


def test_bad_elements_touch_no_neighbour(make_problem):
    x, X, _ = make_problem(7, n=9, noise=0.5)
    good = camera_dlt(x, X)
    bad_x, bad_X = x.clone(), X.clone()
    bad_x[0, 3] = torch.nan
    bad_X[1, 0, 2] = torch.inf
    bad_X[2] = bad_X[2, :1]
    bad_x[3] = bad_x[3, :1]
    bad_X[4, 5:] = bad_X[4, 4]
    bad_x[4, 5:] = bad_x[4, 4]
    weights = torch.ones(7, 9, dtype=torch.float64)
    weights[5, 5:] = 0
    found = camera_dlt(bad_x, bad_X, weights=weights)
    assert found.status.tolist()[:2] == [Status.NOT_FINITE, Status.NOT_FINITE]
    assert (found.status[[2, 3, 4]] == Status.DEGENERATE).all()
    assert found.status[5] == Status.TOO_FEW
    assert found.model.isfinite().all()
    assert torch.equal(found.model[6], good.model[6])


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
def test_shapes(make_problem, batch):
    x, X, P = make_problem(*batch, n=8)
    found = camera_dlt(x, X)
    assert found.model.shape == (*batch, 3, 4)
    assert found.status.shape == batch
    single = camera_dlt(x.float(), X.float())
    assert single.model.dtype == torch.float32
    if x.numel():
        assert relative(single.model.double(), P) < 1e-2


def test_batched_is_the_same_as_one_by_one(make_problem):
    x, X, _ = make_problem(3, n=9, noise=1.0)
    whole = camera_dlt(x, X).model
    for i in range(3):
        assert torch.allclose(camera_dlt(x[i], X[i]).model, whole[i], rtol=1e-9)
    assert torch.allclose(camera_dlt(x, X[0]).model[0], whole[0], rtol=1e-9)


def test_similarities_of_image_and_world_do_not_matter(make_problem):
    x, X, _ = make_problem(10, n=9, noise=1.0)
    P = camera_dlt(x, X).model
    Q = camera_dlt(0.01 * x + 7, 50 * X - 3).model
    T = torch.diag(torch.tensor([0.01, 0.01, 1.0], dtype=torch.float64))
    T[:2, 2] = 7
    S = torch.diag(torch.tensor([50.0, 50.0, 50.0, 1.0], dtype=torch.float64))
    S[:3, 3] = -3
    back = torch.linalg.inv(T) @ Q @ S
    assert relative(back / back[..., 2:, :3].norm(dim=-1, keepdim=True), P) < 1e-8


def test_most_points_are_at_positive_depth(make_problem):
    x, X, _ = make_problem(20, n=9, noise=1.0)
    P = camera_dlt(x, X).model
    depth = X @ P[:, 2, :3, None] + P[:, 2, 3:, None]
    assert ((depth > 0).sum(-2) > 4).all()
    assert torch.allclose(P[:, 2, :3].norm(dim=-1), torch.ones(20, dtype=torch.float64))


def test_affine_cameras(generator):
    P = torch.randn(10, 3, 4, generator=generator, dtype=torch.float64)
    P[:, 2] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    X = torch.randn(10, 9, 3, generator=generator, dtype=torch.float64)
    x = X @ P[:, :2, :3].mT + P[:, None, :2, 3]
    found = camera_dlt(x, X)
    assert (found.status == Status.OK).all()
    ratio = found.model / found.model[:, 2:, 3:]
    assert relative(ratio, P) < 1e-8


def test_derivatives(make_problem, generator):
    x, X, P = make_problem(n=8, noise=1.0)
    T = torch.diag(torch.tensor([1e-3, 1e-3, 1.0], dtype=torch.float64))
    line, L = lines_through(X[:3], X[3:6], T @ P)
    line = line / line.norm(dim=-1, keepdim=True)
    w = torch.rand(8, generator=generator, dtype=torch.float64) + 0.5
    inputs = tuple(t.detach().clone().requires_grad_() for t in (x * 1e-3, X, line, L, w))
    assert torch.autograd.gradcheck(lambda x, X, line, L, w: camera_dlt(x, X, line, L, weights=w).model, inputs)


def test_nothing_leaves_the_device():
    generator = seeded(0)
    data = (send(torch.randn(4, 8, k, generator=generator)) for k in (2, 3, 3, 6))
    with elsewhere():
        assert camera_dlt(*data).model.device == ELSEWHERE


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(make_problem):
    x, X, _ = make_problem(n=6)
    with pytest.raises(ValueError, match="at least 11 equations"):
        camera_dlt(x[:5], X[:5])
    with pytest.raises(ValueError, match="wanted both or neither"):
        camera_dlt(x, X, torch.ones(2, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="weights: wanted n = 6"):
        camera_dlt(x, X, weights=torch.ones(7, dtype=torch.float64))


@pytest.mark.parametrize("folder", ["model_house", "corridor"])
def test_oxford_sequences(oxford, folder):
    # The stored cameras and points were adjusted together; a camera from the points alone must fit its own image as well.
    scene = oxford(folder)
    x, visible, P, X = scene.x, scene.visible, scene.P, scene.X
    X = X.expand(len(P), -1, -1)
    found = camera_dlt(x, X, weights=visible.double())
    assert (found.status == Status.OK).all()
    for i in range(len(P)):
        r = (project(found.model[i], X[i]) - x[i])[visible[i]].norm(dim=-1)
        stored = (project(P[i], X[i]) - x[i])[visible[i]].norm(dim=-1)
        assert r.square().mean().sqrt() < 1.15 * stored.square().mean().sqrt()
