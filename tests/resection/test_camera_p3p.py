import math

import pytest
import torch
from chance import assert_share, seeded

from torchsfm.resection import camera_p3p
from torchsfm.resection.camera_p3p import equations


def world(Y, generator):
    """Random poses for points given in the camera's frame."""
    q = torch.linalg.qr(torch.randn(len(Y), 3, 3, generator=generator, dtype=torch.float64)).Q
    R = q * torch.linalg.det(q)[:, None, None]
    t = torch.randn(len(Y), 3, generator=generator, dtype=torch.float64)
    return (Y - t[:, None]) @ R, torch.cat((R, t[..., None]), -1)


def distance(found, P):
    """Largest difference of the nearest valid pose in any entry."""
    error = (found.model - P[..., None, :, :]).abs().amax((-1, -2))
    return torch.where(found.valid, error, torch.inf).amin(-1)


@pytest.mark.parametrize("width", [1.0, 0.1, 0.01, 0.001])
def test_recall_on_random_scenes(make_scene, width):
    Y, X, P = make_scene(10_000, width=width)
    found = camera_p3p(Y / Y[..., 2:], X)
    assert_share(distance(found, P) < 1e-6, 0.9999)
    assert distance(found, P).median() < 1e-10 / width


def test_recall_in_single_precision(make_scene):
    Y, X, P = make_scene(10_000)
    found = camera_p3p((Y / Y[..., 2:]).float(), X.float())
    assert found.model.dtype == torch.float32
    assert_share(distance(found, P.float()) < 1e-2, 0.98)


def test_every_valid_slot_is_a_solution(make_scene):
    Y, X, _ = make_scene(5000)
    found = camera_p3p(Y, X)
    assert found.model.isfinite().all()
    error = equations(found.model, Y[:, None], X[:, None]).abs().amax(-1)
    assert (error[found.valid] < 1e-8).all()
    assert (error[found.valid].median() < 1e-13).all()
    R, t = found.model[..., :3], found.model[..., 3]
    assert torch.allclose(torch.linalg.det(R[found.valid]), torch.ones(int(found.valid.sum()), dtype=torch.float64))
    seen = X[:, None] @ R.mT + t[..., None, :]
    assert ((seen * Y[:, None]).sum(-1) > 0)[found.valid].all()


def test_slots_differ(make_scene):
    Y, X, _ = make_scene(2000)
    found = camera_p3p(Y, X)
    for i in range(4):
        for j in range(i):
            both = found.valid[:, i] & found.valid[:, j]
            gap = (found.model[:, i] - found.model[:, j]).abs().amax((-1, -2))[both]
            assert (gap > 1e-9).all()


def rays_at_right_angles(generator):
    return torch.eye(3, dtype=torch.float64) * (0.5 + torch.rand(500, 3, 1, generator=generator, dtype=torch.float64))


def equilateral_seen_from_its_axis(generator):
    angle = 2 * math.pi / 3 * torch.arange(3, dtype=torch.float64) + torch.rand(
        500, 1, generator=generator, dtype=torch.float64
    )
    height = 0.5 + 4 * torch.rand(500, 1, generator=generator, dtype=torch.float64)
    return torch.stack((angle.cos(), angle.sin(), height.expand(500, 3)), -1)


def right_isosceles_parallel_to_the_image(generator):
    triangle = torch.tensor([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 1.0, 5.0]], dtype=torch.float64)
    shift = torch.randn(500, 1, 3, generator=generator, dtype=torch.float64)
    shift[..., 2] = 0
    return triangle + shift


def isosceles_with_two_equal_depths(generator):
    a = 0.1 + torch.rand(500, generator=generator, dtype=torch.float64)
    top = torch.randn(500, 2, generator=generator, dtype=torch.float64)
    zero = torch.zeros_like(a)
    left, right = torch.stack((-a.sin(), zero, a.cos()), -1), torch.stack((a.sin(), zero, a.cos()), -1)
    return 5 * torch.stack((left, right, torch.stack((zero, 0.5 * top[:, 0], 0.5 + top[:, 1].abs()), -1)), 1)


def centre_in_the_plane_of_the_points(generator):
    Y = torch.randn(500, 3, 3, generator=generator, dtype=torch.float64)
    a, b = torch.randn(2, 500, 1, generator=generator, dtype=torch.float64)
    Y[:, 2] = a * Y[:, 0] + b * Y[:, 1]
    return Y


def centre_close_to_the_plane_of_the_points(generator):
    Y = centre_in_the_plane_of_the_points(generator)
    return Y + 1e-6 * torch.randn(Y.shape, generator=generator, dtype=torch.float64)


def two_points_on_one_ray(generator):
    Y = torch.randn(500, 3, 3, generator=generator, dtype=torch.float64)
    Y[:, 1] = Y[:, 0] * (1.1 + torch.rand(500, 1, generator=generator, dtype=torch.float64))
    return Y


def rays_all_around(generator):
    return torch.randn(500, 3, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize(
    "points",
    [
        rays_at_right_angles,
        equilateral_seen_from_its_axis,
        right_isosceles_parallel_to_the_image,
        isosceles_with_two_equal_depths,
        centre_in_the_plane_of_the_points,
        centre_close_to_the_plane_of_the_points,
        two_points_on_one_ray,
        rays_all_around,
    ],
)
def test_special_configurations(generator, points):
    Y = points(generator)
    X, P = world(Y, generator)
    assert (distance(camera_p3p(Y, X), P) < 1e-6).all()


def test_double_solutions(generator):
    # The centre on the circular cylinder through the points: two solutions merge, known to the square root of rounding.
    angle = 2 * math.pi * torch.rand(2000, 4, generator=generator, dtype=torch.float64)
    height = torch.randn(2000, generator=generator, dtype=torch.float64)
    circle = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)
    centre = circle[:, 3] + height[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    Y = circle[:, :3] - centre[:, None]
    X, P = world(Y, generator)
    assert_share(distance(camera_p3p(Y, X), P) < 1e-3, 0.97)


def test_all_four_solutions_of_a_known_case():
    # Fischler & Bolles (1981), appendix A: an equilateral triangle with sides 2 sqrt(3), the rays at arccos(5/8) to each other.
    u = torch.tensor([[1.0, 0.0], [-0.5, 3**0.5 / 2], [-0.5, -(3**0.5) / 2]], dtype=torch.float64)
    # The cosine between rays (r u_i, h), |ray| = 1, is h^2 - r^2 / 2 = 5/8.
    r = 0.5
    d = torch.cat((r * u, torch.full((3, 1), 0.75**0.5, dtype=torch.float64)), -1)
    X = torch.cat((2 * u, torch.zeros(3, 1, dtype=torch.float64)), -1)
    found = camera_p3p(d, X)
    assert found.valid.all()
    Y = X @ found.model[..., :3].mT + found.model[..., None, :, 3]
    depths = Y.norm(dim=-1)
    expected = torch.tensor([[4.0, 4.0, 4.0], [1.0, 4.0, 4.0], [4.0, 1.0, 4.0], [4.0, 4.0, 1.0]], dtype=torch.float64)
    gap = (depths[:, None] - expected).abs().amax(-1)
    assert (gap.amin(0) < 1e-9).all()
    assert (gap.amin(1) < 1e-9).all()


def test_order_scale_and_frame_do_not_matter(make_scene, generator):
    Y, X, P = make_scene(300)
    base = camera_p3p(Y, X)
    order = torch.tensor([2, 0, 1])
    stretched = Y * (0.1 + torch.rand(300, 3, 1, generator=generator, dtype=torch.float64))
    for d, Z, scale in ((Y[:, order], X[:, order], 1.0), (stretched, X, 1.0), (Y, 1e4 * X, 1e4), (Y, 1e-4 * X, 1e-4)):
        found = camera_p3p(d, Z)
        assert torch.equal(found.valid.sum(-1), base.valid.sum(-1))
        wanted = torch.cat((P[..., :3], scale * P[..., 3:]), -1)
        assert (distance(found, wanted) / max(scale, 1.0) < 1e-6).all()


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,), (4, 0)])
def test_shapes(make_scene, batch):
    Y, X, P = make_scene(*batch)
    found = camera_p3p(Y, X)
    assert found.model.shape == (*batch, 4, 3, 4)
    assert found.valid.shape == (*batch, 4)
    assert (distance(found, P) < 1e-6).all()


def test_batches_broadcast_and_equal_single_problems(make_scene):
    Y, X, _ = make_scene(4, 5)
    whole = camera_p3p(Y, X)
    for i in range(4):
        one = camera_p3p(Y[i, 2], X[i, 2])
        assert torch.equal(one.valid, whole.valid[i, 2])
        assert torch.allclose(one.model[one.valid], whole.model[i, 2][one.valid], atol=1e-9)
    crossed = camera_p3p(Y[:, :1], X[0])
    assert crossed.model.shape == (4, 5, 4, 3, 4)
    assert torch.equal(crossed.valid[0, 0], whole.valid[0, 0])


def test_degenerate_data_are_marked_and_touch_no_neighbour(make_scene):
    Y, X, _ = make_scene(9)
    good = camera_p3p(Y, X)
    d, Z = Y.clone(), X.clone()
    Z[0, 1] = Z[0, 0]
    Z[1, 2] = 0.3 * Z[1, 0] + 0.7 * Z[1, 1]
    Z[2] = Z[2, :1]
    d[3, 0] = torch.nan
    Z[4, 2, 1] = torch.inf
    d[5, 1] = 0
    d[6] = d[6, :1]
    d[7, 0, 0] = torch.inf
    found = camera_p3p(d, Z)
    assert not found.valid[:8].any()
    assert found.model.isfinite().all()
    assert torch.equal(found.model[8], good.model[8])
    assert torch.equal(found.valid[8], good.valid[8])
    single = camera_p3p(d.float(), Z.float())
    assert not single.valid[:6].any()


def test_derivatives(make_scene):
    Y, X, _ = make_scene(3)
    d = (Y / Y[..., 2:]).requires_grad_()
    X.requires_grad_()
    valid = camera_p3p(d, X).valid
    assert valid.sum() > 3

    def poses(d, X):
        return camera_p3p(d, X).model[valid]

    assert torch.autograd.gradcheck(poses, (d, X))
    assert torch.autograd.gradgradcheck(lambda d, X: poses(d, X)[:1], (d, X), fast_mode=True, atol=1e-3, rtol=1e-2)


def test_values_do_not_depend_on_following_derivatives(make_scene):
    Y, X, _ = make_scene(50)
    plain = camera_p3p(Y, X)
    followed = camera_p3p(Y.clone().requires_grad_(), X)
    assert torch.equal(plain.valid, followed.valid)
    assert torch.equal(plain.model[plain.valid], followed.model.detach()[plain.valid])


def test_empty_slots_and_bad_data_have_no_derivative(make_scene):
    Y, X, _ = make_scene(20)
    X[3, 1] = torch.nan
    X[4, 1] = X[4, 0]
    Y.requires_grad_()
    X.requires_grad_()
    found = camera_p3p(Y, X)
    torch.where(found.valid[..., None, None], 0.0, found.model).sum().backward()
    assert (Y.grad == 0).all()
    assert (X.grad == 0).all()
    camera_p3p(Y, X).model.sum().backward()
    assert X.grad.isfinite().all()
    assert Y.grad.isfinite().all()


# Forward mode makes PyTorch load parts of itself that it calls deprecated.
@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_forward_mode_and_vmap(make_scene):
    Y, X, _ = make_scene(4)
    d = Y / Y[..., 2:]
    valid = camera_p3p(d, X).valid
    direction = torch.ones_like(d)
    _, forward = torch.func.jvp(lambda d: camera_p3p(d, X).model, (d,), (direction,))
    h = 1e-6
    difference = (camera_p3p(d + h * direction, X).model - camera_p3p(d - h * direction, X).model) / (2 * h)
    assert torch.allclose(forward[valid], difference[valid], atol=1e-4, rtol=1e-4)
    mapped = torch.func.vmap(lambda d, X: camera_p3p(d, X).model)(d, X)
    assert torch.allclose(mapped[valid], camera_p3p(d, X).model[valid])


def test_nothing_leaves_the_device():
    d = torch.empty(7, 3, 3, device="meta")
    assert camera_p3p(d, d).model.device.type == "meta"


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(make_scene):
    Y, X, _ = make_scene(2, n=4)
    with pytest.raises(ValueError, match="d: wanted shape"):
        camera_p3p(Y, X[:, :3])
    with pytest.raises(ValueError, match="X: wanted dtype"):
        camera_p3p(Y[:, :3], X[:, :3].float())


@pytest.mark.reference
def test_poselib_finds_as_many(make_scene):
    poselib = pytest.importorskip("poselib")
    Y, X, _ = make_scene(1000)
    u = torch.nn.functional.normalize(Y, dim=-1)
    found = camera_p3p(u, X)
    for i in range(1000):
        theirs = poselib.p3p(list(u[i].numpy()), list(X[i].numpy()))
        assert len(theirs) == found.valid[i].sum()
        ours = found.model[i][found.valid[i]]
        for pose in theirs:
            assert (ours - torch.tensor(pose.Rt)).abs().amax((-1, -2)).min() < 1e-5


@pytest.mark.reference
def test_opencv_solutions_are_among_ours(make_scene):
    cv2 = pytest.importorskip("cv2")
    Y, X, _ = make_scene(200)
    x = Y[..., :2] / Y[..., 2:]
    found = camera_p3p(Y, X)
    hits = 0
    for i in range(200):
        count, rotations, translations = cv2.solveP3P(
            X[i].numpy(), x[i].numpy(), torch.eye(3).double().numpy(), None, flags=cv2.SOLVEPNP_P3P
        )
        for k in range(count):
            R = torch.tensor(cv2.Rodrigues(rotations[k])[0])
            theirs = torch.cat((R, torch.tensor(translations[k])), -1)
            ours = found.model[i][found.valid[i]]
            hits += int((ours - theirs).abs().amax((-1, -2)).min() < 1e-4)
    total = int(found.valid.sum())
    assert hits >= 0.98 * total


def test_a_real_image(pose6dscene):
    x, X, K, truth = pose6dscene
    d = torch.cat((x, torch.ones_like(x[:, :1])), -1) @ torch.linalg.inv(K).T
    generator = seeded()
    sample = torch.stack([torch.randperm(len(x), generator=generator)[:3] for _ in range(300)])
    found = camera_p3p(d[sample], X[sample])
    Y = X @ found.model[..., :3].mT + found.model[..., None, :, 3]
    h = Y @ K.T
    r = (h[..., :2] / h[..., 2:] - x).norm(dim=-1).median(-1).values
    best = torch.where(found.valid, r, torch.inf).amin()
    assert best < 2.0
    slot = torch.where(found.valid, r, torch.inf).flatten().argmin()
    P = found.model.flatten(0, 1)[slot]
    angle = torch.rad2deg(torch.arccos(((P[:, :3] @ truth[:, :3].T).trace() - 1).div(2).clamp(-1, 1)))
    assert angle < 2.0
