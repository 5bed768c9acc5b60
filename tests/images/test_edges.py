import math

import numpy as np
import pytest
import torch
from chance import assert_unit_variance, numpy_seeded
from painting import disc, half_plane, polygon
from torch import Tensor

from torchsfm.images import Edges, detect_edges
from torchsfm.images.edge_chains import chain_curvature, link_edgels, order_chains

NAMES = ("x", "gradient", "sigma", "width", "curvature", "chain", "closed", "valid")


def lines_of(angles: np.ndarray, offsets: np.ndarray) -> Tensor:
    return torch.stack([half_plane(a, o) for a, o in zip(angles, offsets, strict=True)])


def distances(edges: Edges, angles: np.ndarray, offsets: np.ndarray) -> Tensor:
    """From the middle of the edge, zero in empty slots."""
    normal = torch.tensor(np.stack((np.cos(angles), np.sin(angles)), -1))
    away = ((edges.x - 31.5) * normal[:, None]).sum(-1) - torch.tensor(offsets)[:, None]
    return torch.where(edges.valid, away, 0.0)


@pytest.mark.parametrize("blur", [0.5, 0.7, 1.2])
def test_straight_edges_are_where_they_were_painted(blur: float) -> None:
    rng = numpy_seeded()
    angles, offsets = rng.uniform(0, 2 * math.pi, 12), rng.uniform(-0.5, 0.5, 12)
    image = torch.stack([half_plane(a, o, blur=blur) for a, o in zip(angles, offsets, strict=True)])
    edges = detect_edges(image, 200)
    away = distances(edges, angles, offsets)
    assert bool((edges.valid.sum(-1) >= 54).all())
    assert bool((edges.chain[edges.valid] == 0).all())
    assert float(away.abs().max()) < 0.01
    assert float(away.square().sum().div(edges.valid.sum()).sqrt()) < 0.003
    wanted = math.sqrt(blur**2 + 1 + 1 / 12 + 1 / 3)
    assert float((edges.width[edges.valid] / wanted - 1).abs().max()) < 0.1
    normal = torch.tensor(np.stack((np.cos(angles), np.sin(angles)), -1))[:, None]
    across = torch.nn.functional.normalize(edges.gradient, dim=-1)
    assert float((across * normal).sum(-1)[edges.valid].min()) > math.cos(0.04)  # central differences turn it by up to 0.03


def test_edges_follow_small_shifts() -> None:
    offsets = np.arange(0, 1, 0.05)
    for angle in numpy_seeded(1).uniform(0, 2 * math.pi, 2):
        angles = np.full(len(offsets), angle)
        edges = detect_edges(lines_of(angles, offsets), 100)
        mean = distances(edges, angles, offsets).sum(-1) / edges.valid.sum(-1)
        assert float(mean.abs().max()) < 0.002


@pytest.mark.parametrize("noise", [0.01, 0.02])
def test_deviations_are_those_of_noise(noise: float, generator: torch.Generator) -> None:
    rng = numpy_seeded(2)
    angles, offsets = rng.uniform(0, 2 * math.pi, 40), rng.uniform(-0.5, 0.5, 40)
    image = lines_of(angles, offsets)
    image = image + noise * torch.randn(image.shape, generator=generator, dtype=image.dtype)
    edges = detect_edges(image, 200, noise=noise, high=0.1)
    # Every sixth point of an edge: the smoothing ties neighbours together.
    taken = edges.valid & (torch.arange(200) % 6 == 3)
    score = (distances(edges, angles, offsets) / torch.where(edges.valid, edges.sigma, 1.0))[taken]
    assert len(score) > 300
    # The formula is good to a tenth of the variance; the rest is chance.
    assert abs(float(score.square().mean()) - 1) < 0.15 + 5 * math.sqrt(2 / len(score))
    assert float(score.abs().max()) < 6
    ratio = detect_edges(image, 200).noise / noise
    assert float((ratio - 1).abs().mean()) < 0.08


@pytest.mark.parametrize("radius", [6.0, 10.0, 16.0, 25.0])
def test_discs_have_one_closed_chain_of_their_radius(radius: float) -> None:
    rng = numpy_seeded(3)
    for sign in (1, -1):
        cx, cy = 31.5 + rng.uniform(-0.5, 0.5, 2)
        image = disc(cx, cy, radius)
        edges = detect_edges(image if sign > 0 else 1 - image, 400)
        x, curvature = edges.x[edges.valid], edges.curvature[edges.valid]
        assert bool(edges.closed[edges.valid].all())
        assert int(edges.chain.max()) == 0
        away = (x - torch.tensor([cx, cy])).norm(dim=-1) - radius
        assert abs(float(away.mean())) < 0.01
        assert float(away.square().mean().sqrt()) < 0.08 / radius
        assert float(away.abs().max()) < 0.04
        # Walking with the bright side to the left, a bright disc is walked around from y to x.
        assert abs(float(-sign * curvature.mean() * radius) - 1) < 0.005
        turn = torch.atan2(*(x - torch.tensor([cx, cy])).flip(-1).unbind(-1)).diff()
        turn = torch.remainder(turn + math.pi, 2 * math.pi) - math.pi
        assert bool((turn * -sign > 0).all())
        assert abs(float(turn.sum())) > 1.8 * math.pi


def test_chains_are_in_order_and_whole() -> None:
    corners = torch.tensor([[12.3, 10.1], [50.2, 14.7], [45.1, 49.9], [15.0, 44.0]])
    image = torch.stack((polygon(corners), polygon(corners, blur=1.0), disc(20, 31, 14) + disc(50, 31, 10)))
    edges = detect_edges(image, 1000)
    for e in range(3):
        valid = edges.valid[e]
        assert bool((valid[1:] <= valid[:-1]).all())
        chain, x = edges.chain[e][valid], edges.x[e][valid]
        assert bool((chain.diff() >= 0).all() and (chain.diff() <= 1).all())
        lengths = chain.bincount()
        assert bool((lengths.diff() <= 0).all())
        steps = x.diff(dim=0).norm(dim=-1)[chain.diff() == 0]
        assert float(steps.max()) < 2.7  # neighbours within 2.2 px, then moved by up to a quarter at corners
        for k in range(int(chain.max()) + 1):
            mine = x[chain == k]
            ends = float((mine[0] - mine[-1]).norm())
            assert not bool(edges.closed[e][valid][chain == k].any()) or ends < 2.7
    assert bool(edges.closed[:2][edges.valid[:2]].all())
    assert bool((edges.x[~edges.valid] == 0).all() and (edges.chain[~edges.valid] == -1).all())
    some = detect_edges(image, 130)
    assert bool((edges.valid.sum(-1) == some.valid.sum(-1) + some.left_out).all())
    assert bool((some.left_out[2:] > 0).all())
    for name in NAMES:
        part, whole = getattr(some, name), getattr(edges, name)[:, :130]
        assert torch.equal(part[some.valid], whole[some.valid])


def test_rings_and_rows_are_ordered(generator: torch.Generator) -> None:
    """Links with a known order, numbered at random."""
    angle = torch.arange(40, dtype=torch.float64) / 40 * 2 * math.pi
    ring = torch.stack((angle.cos(), angle.sin()), -1) * 9 + 20
    row = torch.stack((torch.arange(25.0, dtype=torch.float64) + 40, 0 * angle[:25] + 8), -1)
    x = torch.cat((ring, row))
    gradient = torch.cat((torch.stack((angle.cos(), angle.sin()), -1), torch.tensor([0.0, -1]).expand(25, 2)))
    shuffled = torch.randperm(len(x), generator=generator)
    x, gradient = x[shuffled], gradient[shuffled]
    place = x[:, 1].round().long() * 80 + x[:, 0].round().long()
    following, preceding = link_edgels(x, gradient, place, (1, 40, 80))
    own = torch.arange(len(x))
    linked = following != own
    assert torch.equal(preceding[following[linked]], own[linked])
    assert int((~linked).sum()) == 1
    chains = order_chains(preceding, torch.zeros_like(own))
    assert chains.length.tolist() == [40] * 40 + [25] * 25
    assert chains.closed.tolist() == [True] * 40 + [False] * 25
    steps = x[chains.order].diff(dim=0).norm(dim=-1)
    assert float(steps[:39].max()) < 1.5
    torch.testing.assert_close(x[chains.order][40:], row)
    curvature = chain_curvature(x[chains.order], chains)
    torch.testing.assert_close(curvature[:40], torch.full((40,), 1 / 9, dtype=torch.float64))
    torch.testing.assert_close(curvature[40:], torch.zeros(25, dtype=torch.float64))


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_is_its_elements(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    rng = numpy_seeded(4)
    one = [disc(*rng.uniform(28, 34, 2), rng.uniform(8, 20)) for _ in range(math.prod(shape))]
    images = torch.stack(one).reshape(*shape, 1, 64, 64) if one else torch.zeros(*shape, 1, 64, 64)
    images = (images + 0.01 * torch.randn(images.shape, generator=generator)).to(dtype)
    edges = detect_edges(images, 300)
    assert edges.x.shape == (*shape, 300, 2)
    assert edges.noise.shape == edges.left_out.shape == shape
    assert edges.x.dtype == edges.sigma.dtype == dtype
    for index in np.ndindex(*shape):
        alone = detect_edges(images[index], 300)
        assert int(alone.valid.sum()) > 30
        for name in (*NAMES, "noise", "left_out"):
            assert torch.equal(getattr(edges, name)[index], getattr(alone, name))


def test_turned_images_have_turned_edges() -> None:
    image = disc(25.3, 33.1, 14.2)
    edges, turned = (detect_edges(i, 300) for i in (image, image.transpose(-1, -2)))
    x, y = edges.x[edges.valid], turned.x[turned.valid].flip(-1)
    assert len(x) == len(y)
    assert float((x[:, None] - y).norm(dim=-1).amin(-1).max()) < 1e-9


def test_thresholds_mask_and_short_chains() -> None:
    image = 0.3 * half_plane(0.3, 0.0) + 0.05 * disc(12, 30, 8)
    every = detect_edges(image, 500, low=0.005, high=0.01)
    strong = detect_edges(image, 500, low=0.005, high=0.05)
    assert int(every.valid.sum()) > int(strong.valid.sum()) > 40
    assert float(strong.gradient.norm(dim=-1)[strong.valid].max()) > 0.05
    assert int(detect_edges(image, 500, high=0.5).valid.sum()) == 0
    assert int(detect_edges(image, 500, min_edgels=100).valid.sum()) == 0
    mask = torch.zeros(64, 64, dtype=torch.bool)
    mask[:32] = True
    half = detect_edges(image, 500, mask=mask)
    assert 0 < int(half.valid.sum()) < int(strong.valid.sum())
    assert float(half.x[half.valid][:, 1].max()) < 32


def test_flat_and_broken_images_have_none_and_spoil_none(generator: torch.Generator) -> None:
    image = disc(30, 30, 15).expand(4, 1, 64, 64).clone() + 0.01 * torch.randn(4, 1, 64, 64, generator=generator)
    good = detect_edges(image, 200)
    bad = image.clone()
    bad[1] = 0.5
    bad[2] = torch.nan
    bad[3, :, 30, 40] = torch.inf
    edges = detect_edges(bad, 200)
    assert edges.valid.any(-1).tolist() == [True, False, False, True]
    for name in NAMES:
        assert torch.equal(getattr(edges, name)[0], getattr(good, name)[0])
    for name in ("x", "gradient", "sigma", "width", "curvature", "noise"):
        assert bool(getattr(edges, name).isfinite().all())
    near = (edges.x[3][edges.valid[3]] - torch.tensor([40.0, 30.0])).abs().amax(-1)
    assert float(near.min()) > 4


def test_noise_alone_has_hardly_an_edge(generator: torch.Generator) -> None:
    image = 0.5 + 0.05 * torch.randn(8, 1, 128, 128, generator=generator, dtype=torch.float64)
    assert int(detect_edges(image, 2000).valid.sum()) < 200


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument() -> None:
    image = torch.zeros(1, 40, 40)
    with pytest.raises(ValueError, match="1 or 3 channels"):
        detect_edges(torch.zeros(2, 40, 40))
    with pytest.raises(ValueError, match="h >= 8"):
        detect_edges(torch.zeros(1, 5, 40))
    for name, wrong in {"max_edgels": 0, "blur": 0.1, "low": -1.0, "high": None, "noise": -1.0, "min_edgels": 0}.items():
        with pytest.raises(ValueError, match=name):
            detect_edges(image, **{name: wrong})


def test_scores_of_independent_images_have_unit_variance(generator: torch.Generator) -> None:
    """The mean offset of a chain, with the number of independent points that the documentation states."""
    noise, angle, offset = 0.02, 0.4, 0.2
    image = half_plane(angle, offset).expand(60, 1, 64, 64)
    image = image + noise * torch.randn(image.shape, generator=generator, dtype=image.dtype)
    edges = detect_edges(image, 100, noise=noise, high=0.1)
    count = edges.valid.sum(-1)
    away = distances(edges, np.full(60, angle), np.full(60, offset))
    mean = away.sum(-1) / count
    sigma = edges.sigma.sum(-1) / count / (count / (2 * math.sqrt(math.pi))).sqrt()
    # No more trials than would tell that the formula is good to a tenth.
    assert_unit_variance(mean / sigma)
