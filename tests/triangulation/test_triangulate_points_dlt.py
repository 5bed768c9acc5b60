import pytest
import torch

from torchsfm.triangulation import triangulate_points_dlt


def relative(X, Y):
    return ((X - Y).norm(dim=-1) / Y.norm(dim=-1)).max()


@pytest.mark.parametrize("v", [2, 3, 12])
@pytest.mark.parametrize(("depth", "origin"), [(10.0, 0.0), (1e3, 0.0), (10.0, 1e4), (3.0, -50.0)])
def test_exact_points_are_found(make_scene, v, depth, origin):
    x, P, X = make_scene(v=v, n=300, depth=depth, origin=origin)
    assert relative(triangulate_points_dlt(x, P), X) < 1e-8


def test_unit_normals_and_scale_of_cameras_do_not_matter(make_scene, generator):
    x, P, _ = make_scene(v=4, n=50, noise=2.0)
    scale = torch.randn(4, 1, 1, generator=generator, dtype=torch.float64)
    assert relative(triangulate_points_dlt(x, P * scale), triangulate_points_dlt(x, P)) < 1e-9


def test_similarities_of_the_world_do_not_matter(make_scene):
    x, P, _ = make_scene(v=3, n=50, noise=2.0)
    angle = torch.tensor(0.7, dtype=torch.float64)
    S = torch.eye(4, dtype=torch.float64)
    S[0, 0], S[0, 1], S[1, 0], S[1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    S[:3, :3] *= 250
    S[:3, 3] = torch.tensor([1e3, -2e3, 500.0])
    X = triangulate_points_dlt(x, P) @ S[:3, :3].T + S[:3, 3]
    assert relative(triangulate_points_dlt(x, P @ S.inverse()), X) < 1e-7


@pytest.mark.parametrize("weighted", [False, True])
def test_it_is_the_smallest_singular_vector(make_scene, generator, weighted):
    # In a world where the centres have mean 0 and root-mean-square length 1 the definition is plain.
    x, P, _ = make_scene(v=4, n=40, noise=3.0)
    centre = -torch.linalg.solve(P[..., :3], P[..., 3:])[..., 0]
    middle = centre.mean(0)
    size = (centre - middle).square().sum(-1).mean().sqrt()
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] *= size
    T[:3, 3] = middle
    Q = P @ T
    rows = torch.cat((x[..., :1] * Q[:, None, 2] - Q[:, None, 0], x[..., 1:] * Q[:, None, 2] - Q[:, None, 1])).transpose(0, 1)
    w = torch.rand(4, 40, generator=generator, dtype=torch.float64) + 0.1 if weighted else None
    rows = rows / rows.norm(dim=-1, keepdim=True)
    if weighted:
        rows = rows * w.sqrt().repeat(2, 1).T[..., None]
    h = torch.linalg.svd(rows).Vh[:, -1] @ T.T
    X = triangulate_points_dlt(x, P, weights=w)
    assert relative(X, h[:, :3] / h[:, 3:]) < 1e-9
    H = triangulate_points_dlt(x, P, weights=w, homogeneous=True)
    assert torch.allclose(H[:, :3] / H[:, 3:], X, rtol=1e-12)
    assert torch.allclose(H.norm(dim=-1), torch.ones(40, dtype=torch.float64))
    assert (H[:, 3] > 0).all()


def test_points_at_infinity(make_scene, generator):
    _, P, _ = make_scene(v=3, n=1)
    direction = torch.randn(30, 3, generator=generator, dtype=torch.float64) * 0.2
    direction[:, 2] = 1
    h = direction @ P[..., :3].mT
    x = h[..., :2] / h[..., 2:]
    H = triangulate_points_dlt(x, P, homogeneous=True)
    assert (H[:, 3].abs() < 1e-11).all()
    # The sign puts them ahead of the cameras.
    assert torch.allclose(H[:, :3], direction / direction.norm(dim=-1, keepdim=True), atol=1e-9)
    X = triangulate_points_dlt(x, P)
    assert X.isfinite().all()
    assert (X.norm(dim=-1) > 1e8).all()


def test_affine_cameras(generator):
    P = torch.randn(3, 3, 4, generator=generator, dtype=torch.float64)
    P[:, 2] = torch.tensor([0.0, 0.0, 0.0, 2.0])
    X = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    x = (X @ P[..., :2, :3].mT + P[:, None, :2, 3]) / 2
    assert relative(triangulate_points_dlt(x, P), X) < 1e-10


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,), (2, 0)])
def test_shapes(make_scene, batch):
    x, P, X = make_scene(*batch, v=3, n=7)
    assert triangulate_points_dlt(x, P).shape == X.shape
    assert triangulate_points_dlt(x, P, homogeneous=True).shape == (*batch, 7, 4)
    assert triangulate_points_dlt(x[..., :0, :], P).shape == (*batch, 0, 3)
    assert triangulate_points_dlt(x, P, visible=torch.ones(3, 7, dtype=torch.bool)).shape == X.shape


def test_batched_is_the_same_as_one_by_one(make_scene, generator):
    x, P, _ = make_scene(3, 2, v=5, n=6, noise=1.0)
    visible = torch.rand(3, 2, 5, 6, generator=generator) < 0.7
    whole = triangulate_points_dlt(x, P, visible=visible)
    for i in range(3):
        for j in range(2):
            one = triangulate_points_dlt(x[i, j], P[i, j], visible=visible[i, j])
            determined = visible[i, j].sum(0) >= 2
            assert torch.allclose(one[determined], whole[i, j][determined], rtol=1e-9)


def test_one_rig_for_many_sets_of_points(make_scene):
    x, P, X = make_scene(v=3, n=12)
    sets = x.unflatten(-2, (4, 3)).movedim(-3, 0)
    assert relative(triangulate_points_dlt(sets, P), X.unflatten(0, (4, 3))) < 1e-9
    per_point = triangulate_points_dlt(x.movedim(-2, 0)[:, :, None], P)
    assert relative(per_point[:, 0], X) < 1e-9


def test_large_batches_go_in_pieces(make_scene, monkeypatch):
    import torchsfm.triangulation.observations as observations

    x, P, _ = make_scene(5, v=4, n=9, noise=1.0)
    whole = triangulate_points_dlt(x, P)
    for size in (1, 40, 100):
        monkeypatch.setattr(observations, "PIECE", size)
        assert torch.allclose(triangulate_points_dlt(x, P), whole, rtol=1e-10)


def test_hidden_observations_do_not_count(make_scene):
    x, P, X = make_scene(v=5, n=30)
    visible = torch.ones(5, 30, dtype=torch.bool)
    visible[1, ::2] = False
    visible[3, 5:] = False
    x[~visible] = 1e4
    x[1, 0] = torch.nan
    P = P.clone()
    assert relative(triangulate_points_dlt(x, P, visible=visible), X) < 1e-9
    assert relative(triangulate_points_dlt(x, P, weights=visible.double()), X) < 1e-9


def test_bad_values_stay_finite_and_touch_no_neighbour(make_scene):
    x, P, _ = make_scene(8, v=3, n=4, noise=1.0)
    good = triangulate_points_dlt(x, P)
    x, P = x.clone(), P.clone()
    x[0, 0, 0] = torch.nan
    x[1, 1, 2, 0] = torch.inf
    P[2, 1] = torch.nan
    P[3] = P[3, :1]
    P[4] = 0
    x[5] = 1e300
    P[6, 0, 0, 0] = torch.inf
    visible = torch.ones(8, 3, 4, dtype=torch.bool)
    dense, ragged = triangulate_points_dlt(x, P), triangulate_points_dlt(x, P, visible=visible)
    assert dense.isfinite().all()
    assert ragged.isfinite().all()
    assert torch.equal(dense[7], good[7])
    assert torch.equal(dense[0, 3], good[0, 3])
    assert triangulate_points_dlt(x, P, homogeneous=True).isfinite().all()


def test_no_view_and_one_view_stay_finite(make_scene):
    x, P, _ = make_scene(v=2, n=3)
    assert triangulate_points_dlt(x[:1], P[:1]).isfinite().all()
    assert triangulate_points_dlt(x[:0], P[:0]).isfinite().all()
    assert triangulate_points_dlt(x, P, visible=torch.zeros(2, 3, dtype=torch.bool)).isfinite().all()


def test_single_precision_comes_back_as_such(make_scene):
    x, P, X = make_scene(v=3, n=50)
    found = triangulate_points_dlt(x.float(), P.float())
    assert found.dtype == torch.float32
    assert relative(found.double(), X) < 1e-3


@pytest.mark.parametrize("homogeneous", [False, True])
def test_derivatives(make_scene, generator, homogeneous):
    x, P, _ = make_scene(v=3, n=2, noise=0.01, focal=1.0)
    w = torch.rand(3, 2, generator=generator, dtype=torch.float64) + 0.5
    inputs = tuple(t.requires_grad_() for t in (x, P, w))

    def solve(x, P, w):
        return triangulate_points_dlt(x, P, weights=w, homogeneous=homogeneous)

    assert torch.autograd.gradcheck(solve, inputs)
    assert torch.autograd.gradcheck(lambda x, P: triangulate_points_dlt(x, P, homogeneous=homogeneous), inputs[:2])


def test_bad_points_have_no_derivative(make_scene):
    x, P, _ = make_scene(v=2, n=4)
    x[0, 1] = torch.nan
    x.requires_grad_()
    P = P.clone().requires_grad_()
    triangulate_points_dlt(x, P).sum().backward()
    assert x.grad.isfinite().all()
    assert P.grad.isfinite().all()


def test_nothing_leaves_the_device():
    x, P = torch.empty(6, 3, 5, 2, device="meta"), torch.empty(6, 3, 3, 4, device="meta")
    assert triangulate_points_dlt(x, P).device.type == "meta"


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(make_scene):
    x, P, _ = make_scene(v=3, n=4)
    with pytest.raises(ValueError, match="P: wanted v = 3"):
        triangulate_points_dlt(x, P[:2])
    with pytest.raises(ValueError, match="x: wanted shape"):
        triangulate_points_dlt(x[..., :1], P)
    with pytest.raises(ValueError, match="visible: wanted a bool"):
        triangulate_points_dlt(x, P, visible=torch.ones(3, 4))
    with pytest.raises(ValueError, match="P: wanted dtype"):
        triangulate_points_dlt(x, P.float())


@pytest.mark.reference
def test_opencv_agrees(make_scene):
    cv2 = pytest.importorskip("cv2")
    x, P, X = make_scene(v=2, n=100)
    h = torch.tensor(cv2.triangulatePoints(P[0].numpy(), P[1].numpy(), x[0].T.numpy(), x[1].T.numpy())).T
    found = triangulate_points_dlt(x, P)
    assert relative(h[:, :3] / h[:, 3:], X) < 1e-6
    assert relative(found, h[:, :3] / h[:, 3:]) < 1e-6


@pytest.mark.parametrize(("folder", "limit"), [("model_house", 0.7), ("corridor", 0.6)])
def test_oxford_sequences(oxford, image_of, folder, limit):
    scene = oxford(folder)
    x, visible, P, X = scene.x, scene.visible, scene.P, scene.X
    seen_twice = visible.sum(0) >= 2
    found = triangulate_points_dlt(x, P, visible=visible)
    r = (image_of(P, found) - x).norm(dim=-1)[visible & seen_twice]
    published = (image_of(P, X) - x).norm(dim=-1)[visible & seen_twice]
    assert published.square().mean().sqrt() < limit * 2**0.5
    assert r.median() < 1.1 * published.median()


def test_dinosaur(dinosaur, image_of):
    x, visible, P = dinosaur
    found = triangulate_points_dlt(x, P, visible=visible)
    assert found.isfinite().all()
    r = (image_of(P, found) - x).norm(dim=-1)
    assert r[visible & (visible.sum(0) >= 2)].median() <= 0.22
