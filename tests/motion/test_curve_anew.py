"""Image curves put together by cameras."""

import math

import torch

from torchsfm._types import Status
from torchsfm.geometry import camera_from_krt, curve_from_samples, project_points, rotation_from_rotvec
from torchsfm.geometry.curve_places import curve_places
from torchsfm.motion import factorize_curves
from torchsfm.motion.many_views.curve_anew import put_together
from torchsfm.motion.many_views.curve_fit import Scene
from torchsfm.motion.many_views.curve_search import agreement, approach, typical_misfit
from torchsfm.triangulation import triangulate_points_dlt

F64 = torch.float64


def test_a_curve_of_which_nothing_is_known(generator: torch.Generator) -> None:
    """Cameras in a projective frame and two curves; images of a third begin anywhere and run either way."""
    v, c, n, m = 6, 3, 400, 40
    kind = {"generator": generator, "dtype": F64}
    t = torch.arange(n, dtype=F64) * (2 * math.pi / n)
    ring = torch.stack((t.cos(), t.sin(), 0.4 * (2 * t + 0.5).cos()), -1)
    X = torch.stack((ring, ring[:, [2, 0, 1]] + 0.3, ring[:, [1, 2, 0]] - 0.3))
    R = rotation_from_rotvec(torch.linspace(-0.4, 0.4, v, dtype=F64)[:, None] * torch.tensor([0.4, 1.0, 0.2], dtype=F64))
    P = camera_from_krt(
        torch.eye(3, dtype=F64) * torch.tensor([10.0, 10.0, 1.0], dtype=F64), R, torch.tensor([0.0, 0, 10]).double()
    )
    x = project_points(P[:, None], X)
    back = torch.rand(v, generator=generator) < 0.5
    slot = torch.where(back[:, None], -torch.arange(n), torch.arange(n)) + torch.randint(n, (v, 1), generator=generator)
    x[:, 2] = x[:, 2].gather(1, (slot % n)[..., None].expand(v, n, 2))
    curves = curve_from_samples(x[None], closed=True)
    frame = torch.eye(4, dtype=F64) + 0.05 * torch.randn(4, 4, **kind)
    u = torch.nn.functional.normalize(
        torch.nn.functional.pad(X[:, :: n // m].flatten(0, 1), (0, 1), value=1.0) @ frame.T, dim=-1
    )
    side = torch.where(torch.rand(v, 1, 1, generator=generator) < 0.5, -1.0, 1.0)
    place = (torch.arange(m, dtype=F64) * (n / m)).expand(1, v, c, m)
    start = Scene((side * P @ torch.linalg.inv(frame))[None], u.T[None], place)
    right = torch.ones(1, v, c, m, dtype=F64)
    assert float(agreement(curve_places(curves), right, start)) < 0.8
    right[:, :, 2] = 0
    put = put_together(curves, torch.ones(1, v, c, dtype=torch.bool), right, start, 0.0)
    assert put is not None
    turned, x = put
    everything = torch.ones_like(right)
    images = curve_places(turned)
    x = approach(images, everything, x)
    assert float(agreement(images, everything, x)) > 0.8
    assert float(typical_misfit(images, everything, x)) < 1e-3


def test_a_curve_that_looks_alike_from_both_ends() -> None:
    """Its images run one way as well as the other, all guesses are wrong for it, and it is put together by the other curves.

    One scene for all seeds, as this is not so of each.
    """
    v, n = 5, 300
    generator = torch.Generator().manual_seed(0)
    kind = {"generator": generator, "dtype": F64}
    turn = torch.linspace(-0.5, 0.5, v, dtype=F64)[:, None] * math.radians(40) * torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    R = rotation_from_rotvec(0.15 * torch.randn(v, 3, **kind)) @ rotation_from_rotvec(turn)
    K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)
    P = camera_from_krt(K, R, torch.tensor([0.0, 0.0, 10.0], dtype=F64) + 0.3 * torch.randn(v, 3, **kind))
    t = torch.arange(n, dtype=F64) * (2 * math.pi / n)
    waves = torch.stack([w for k in (1, 2, 3) for w in ((k * t).cos() / k**2, (k * t).sin() / k**2)], -1)
    bends = torch.randn(2, 6, 3, **kind)
    bends = 1.5 * bends / bends.square().sum((-2, -1), keepdim=True).sqrt()
    alike = torch.stack((t.cos(), t.sin(), 0.3 * (2 * t).cos()), -1)[None]
    X = torch.cat((waves @ bends, alike)) + 0.7 * torch.randn(3, 1, 3, **kind)
    x = project_points(P[:, None], X)
    back = torch.rand(v, 3, 1, generator=generator) < 0.5
    slot = torch.where(back, -torch.arange(n), torch.arange(n)) + torch.randint(n, (v, 3, 1), generator=generator)
    hidden = x.gather(2, (slot % n)[..., None].expand_as(x))
    found = factorize_curves(curve_from_samples(hidden, closed=True), samples=24)
    assert int(found.status) == Status.OK
    points = x[:, :, ::20].flatten(1, 2)
    seen = project_points(found.P, triangulate_points_dlt(points, found.P))
    assert float((seen - points).square().sum(-1).mean().sqrt()) < 1e-2
