"""Affine factorisation and its metric upgrade."""

import pytest
import torch
from chance import assert_share, seeded
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import random_rotation, rotation_from_rotvec, rotvec_from_rotation, similarity_from_points
from torchsfm.motion import AffineFactorization, factorize_affine

MODELS = ("orthographic", "weak_perspective", "paraperspective")


def scene(
    model: str, batch: int, views: int, n: int, *, noise: float = 0.0, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Images, points, rotations and scales."""
    g = seeded(seed)
    kind = {"generator": g, "dtype": torch.float64}
    X = torch.randn(batch, n, 3, **kind)
    X = X - X.mean(1, keepdim=True)
    R = random_rotation(batch, views, **kind)
    scale = 1 + torch.rand(batch, views, **kind) if model != "orthographic" else torch.ones(batch, views, dtype=torch.float64)
    t = torch.randn(batch, views, 2, **kind) * (0.3 if model == "paraperspective" else 5)
    Y = X[:, None] @ R.mT
    x = Y[..., :2]
    if model == "paraperspective":
        x = x - t[:, :, None] * Y[..., 2:]
    x = scale[..., None, None] * x + t[:, :, None]
    return x + noise * torch.randn(x.shape, **kind), X, R, scale


def shape_error(found: AffineFactorization, X: Tensor) -> Tensor:
    """Of the points after the best similarity, of the two mirror images; relative to their size."""
    errors = []
    for mirror in (1.0, -1.0):
        Z = found.X * torch.tensor([1.0, 1.0, mirror], dtype=X.dtype)
        errors.append((similarity_from_points(Z, X).transform(Z) - X).square().mean((-2, -1)).sqrt())
    return torch.minimum(*errors) / X.square().mean((-2, -1)).sqrt()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("views", "n"), [(3, 6), (10, 40)])
def test_exact_points_are_found_exactly(model: str, views: int, n: int) -> None:
    x, X, R, scale = scene(model, 10, views, n)
    found = factorize_affine(x, model=model)
    assert (found.status == Status.OK).all()
    assert found.error.max() < 1e-9
    assert shape_error(found, X).max() < 1e-7
    ratio = found.scale / scale
    torch.testing.assert_close(ratio, ratio[:, :1].expand_as(ratio), rtol=1e-7, atol=0)
    # Rotations and scales give the images.
    Y, t = found.X[:, None] @ found.R.mT, found.P[..., :2, 3]
    again = Y[..., :2] - (t[:, :, None] * Y[..., 2:] if model == "paraperspective" else 0)
    torch.testing.assert_close(found.scale[..., None, None] * again + t[:, :, None], x, rtol=0, atol=1e-7)
    if model != "paraperspective":
        # Relative rotations are those of the truth, or of its mirror image.
        mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
        relative, truth = found.R[:, 1:] @ found.R[:, :1].mT, R[:, 1:] @ R[:, :1].mT
        gap = [(relative - T).abs().amax((-3, -2, -1)) for T in (truth, mirror @ truth @ mirror)]
        assert torch.minimum(*gap).max() < 1e-7
    torch.testing.assert_close(found.R @ found.R.mT, torch.eye(3, dtype=torch.float64).expand_as(found.R), rtol=0, atol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_missing_data(model: str) -> None:
    x, X, _, _ = scene(model, 10, 10, 40)
    visible = torch.rand(10, 10, 40, generator=seeded(3)) < 0.5
    found = factorize_affine(torch.where(visible[..., None], x, torch.nan), model=model)
    assert (found.status == Status.OK).all()
    used = visible & found.used_point[:, None]
    assert used.sum() > 0.95 * visible.sum()
    assert found.error[used].max() < 1e-6
    for one, truth, kept in zip(found.X, X, found.used_point, strict=True):
        gap = [one[kept] * torch.tensor([1.0, 1.0, m], dtype=torch.float64) for m in (1.0, -1.0)]
        gap = [similarity_from_points(Z, truth[kept]).transform(Z) - truth[kept] for Z in gap]
        # Paraperspective is a statement about the centroid, and that of fewer points is another one.
        assert min(g.abs().max() for g in gap) < (0.1 if model == "paraperspective" else 1e-5)
    assert torch.isinf(found.error[~visible]).all()


def test_noise_gives_the_least_squares_answer_of_the_decomposition() -> None:
    x, X, _, _ = scene("weak_perspective", 5, 8, 30, noise=0.02)
    found = factorize_affine(x)
    W = (x - x.mean(2, keepdim=True)).mT.reshape(5, 16, 30)
    s = torch.linalg.svdvals(W)
    left = s[:, 3:].square().sum(-1)
    torch.testing.assert_close(found.error.square().sum((-2, -1)), left, rtol=1e-5, atol=0)
    torch.testing.assert_close(found.singular_values, s[:, :3], rtol=1e-4, atol=0)
    assert shape_error(found, X).max() < 0.05


def test_weights_and_order() -> None:
    x, _, _, _ = scene("weak_perspective", 2, 6, 20, noise=0.02)
    w = torch.ones(2, 6, 20, dtype=torch.float64)
    w[:, :, 3] = 0
    kept = [i for i in range(20) if i != 3]
    a, b = factorize_affine(x, weights=w), factorize_affine(x[:, :, kept])
    torch.testing.assert_close(a.error[:, :, kept], b.error, rtol=0, atol=1e-7)
    order = torch.randperm(6, generator=seeded())
    torch.testing.assert_close(factorize_affine(x[:, order]).error, factorize_affine(x).error[:, order], rtol=0, atol=1e-7)


def test_data_that_do_not_determine_the_answer_say_so() -> None:
    x, _, _, _ = scene("orthographic", 6, 5, 20, noise=1e-3)
    visible = torch.ones(6, 5, 20, dtype=torch.bool)
    x[0] = (x[0, :1] @ torch.randn(5, 2, 2, generator=seeded(), dtype=torch.float64)) + 1  # a plane
    x[1] = x[1, :1]  # no motion
    x[2, :, ::2] = torch.nan  # ten points are enough
    visible[3, 2:] = False
    visible[4, :, 3:] = False
    found = factorize_affine(x, visible=visible, model="orthographic")
    wanted = [Status.DEGENERATE, Status.DEGENERATE, Status.OK, Status.TOO_FEW, Status.TOO_FEW, Status.OK]
    assert found.status.tolist() == wanted
    for tensor in (found.P, found.X, found.R, found.scale, found.singular_values):
        assert torch.isfinite(tensor).all()
    alone = factorize_affine(x[5], model="orthographic")
    torch.testing.assert_close(alone.error, found.error[5], rtol=0, atol=1e-8)
    assert factorize_affine(x[:0]).X.shape == (0, 20, 3)
    assert factorize_affine(x.float()).X.dtype == torch.float32


@pytest.mark.parametrize("views", [3, 8])
@pytest.mark.parametrize("model", ["orthographic", "weak_perspective"])
@pytest.mark.parametrize("kind", ["plane", "two orientations", "thin", "small turns", "line"])
def test_noise_that_leaves_the_shape_open_is_told(kind: str, model: str, views: int) -> None:
    g = seeded(7)
    draw = {"generator": g, "dtype": torch.float64}
    X = torch.rand(40, 30, 3, **draw) * 2 - 1
    R = rotation_from_rotvec(0.4 * torch.randn(40, views, 3, **draw))
    if kind == "plane":
        X[..., 2] = 0.3 * X[..., 0]
    if kind == "line":
        X = X[..., :1] * torch.randn(40, 1, 3, **draw)
    if kind == "thin":
        X[..., 2] *= 0.01
    if kind == "two orientations":
        R = R[:, [i % 2 for i in range(views)]]
    if kind == "small turns":
        R = rotation_from_rotvec(0.004 * torch.randn(40, views, 3, **draw))
    x = (X[:, None] @ R.mT)[..., :2] + 0.01 * torch.randn(40, views, 30, 2, **draw)
    # Noise may be less than it seems once in twenty times.
    assert_share(factorize_affine(x, model=model).status != Status.OK, 0.95)


@pytest.mark.parametrize(("views", "n"), [(3, 4), (3, 30), (8, 5), (8, 30)])
@pytest.mark.parametrize("noise", [0.003, 0.01])
def test_rotations_are_as_near_as_is_said(views: int, n: int, noise: float) -> None:
    x, _, R, _ = scene("weak_perspective", 200, views, n, noise=noise)
    found = factorize_affine(x)
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    relative, truth = found.R[:, 1:] @ found.R[:, :1].mT, R[:, 1:] @ R[:, :1].mT
    turns = [rotvec_from_rotation(relative @ T.mT).norm(dim=-1) for T in (truth, mirror @ truth @ mirror)]
    error = torch.where((turns[0].amax(-1) < turns[1].amax(-1))[:, None], *turns)
    told = (found.deviation[:, 1:].square() + found.deviation[:, :1].square()).sqrt()
    good = found.status == Status.OK
    assert_share((error < 4 * told).all(-1)[good], 0.98)
    if n == 30:
        assert_share(good, 0.98)
        assert told[good].median() < 3 * error[good].median()


@pytest.mark.usefixtures("unchecked")
def test_wrong_input_is_named() -> None:
    x = torch.zeros(3, 5, 2)
    with pytest.raises(ValueError, match="x"):
        factorize_affine(x[0])
    with pytest.raises(ValueError, match="model"):
        factorize_affine(x, model="perspective")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="visible"):
        factorize_affine(x, visible=torch.ones(3, 4, dtype=torch.bool))
