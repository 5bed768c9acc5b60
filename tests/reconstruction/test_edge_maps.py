"""Maps of edges: the nearest edge point of a pixel against all of them."""

import torch

from torchsfm.reconstruction.curves.edge_maps import EdgeMap, EdgeMaps, EdgePoints

F64 = torch.float64


def test_a_pixel_knows_its_nearest_edge_point(generator: torch.Generator) -> None:
    kind = {"generator": generator, "dtype": F64}
    points = []
    for n in (30, 0, 7):
        x = torch.rand(n, 2, **kind) * torch.tensor([50.0, 40.0], dtype=F64)
        tangent = torch.nn.functional.normalize(torch.randn(n, 2, **kind), dim=-1)
        points.append(EdgePoints(x, tangent, torch.arange(n)))
    of_each = [EdgeMap.of(own, 40, 50) for own in points]
    maps = EdgeMaps.of(of_each)
    y = torch.rand(3, 200, 2, **kind) * 60 - 5
    near = maps.near(y)
    assert (of_each[1].closeness == 0).all()
    for i, own in enumerate(points):
        pixel = y[i].round()
        inside = ((pixel >= 0) & (pixel < torch.tensor([50, 40]))).all(-1)
        if not len(own.x):
            assert (near.tangent[i] == 0).all()
            continue
        gap = torch.cdist(pixel, own.x)
        least, index = gap.min(-1)
        # Within the window of three pixels to each side it is found; far from it never.
        reach = (pixel - own.x[index].round()).abs().amax(-1)
        found = near.tangent[i].abs().sum(-1) > 0
        assert found[inside & (reach <= 3)].all()
        assert not found[~inside | (least > 5.5)].any()
        sure = found & (gap.sort(-1).values[:, :2].diff()[:, 0] > 0.1) & (reach <= 3)
        assert torch.equal(near.tangent[i][sure], own.tangent[index[sure]])
        away, t = y[i] - own.x[index], own.tangent[index]
        across = away[:, 1] * t[:, 0] - away[:, 0] * t[:, 1]
        torch.testing.assert_close(near.r[i][sure], across[sure])
