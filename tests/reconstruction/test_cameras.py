"""Which word on the focal length counts: that of the file, or that of the pairs."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import Camera, intrinsics
from torchsfm.reconstruction import ReconstructionError
from torchsfm.reconstruction.mapping.cameras import guess_cameras
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.simulation import random_points, random_poses, simulate_images

SIZE, FOCAL = (1000, 750), 1000.0


def photographs(X: Tensor, generator: torch.Generator) -> ViewGraph:
    """Verified pairs of eight photographs of points, half a pixel off."""
    poses = random_poses(8, distance=(5.0, 7.0), wobble=1.0, generator=generator)
    K = intrinsics(torch.tensor(FOCAL), torch.tensor([499.5, 374.5])).double().expand(8, 3, 3)
    seen = simulate_images(X, poses, Camera(K), image_size=SIZE, noise=0.5, generator=generator)
    view, track = seen.visible.nonzero(as_tuple=True)
    names, color = [f"{i}.png" for i in range(8)], torch.zeros(len(view), 3).double()
    size = torch.tensor([SIZE] * 8)
    return graph_from_tracks(names, size, seen.x[view, track], view, track, color, generator=generator)[0]


def guess(graph: ViewGraph, stated: float) -> tuple[float, str]:
    cameras, source = guess_cameras(graph, torch.zeros(8).long(), model="radial", K=None, exif_focal=[stated] * 8)
    return float(cameras.K[0, 0, 0]), source[0]


def test_intrinsics_in_units_of_the_image_are_refused(generator: torch.Generator) -> None:
    graph = photographs(random_points(300, generator=generator), generator)
    K = torch.tensor([[FOCAL, 0, 499.5], [0, FOCAL, 374.5], [0, 0, 1]], dtype=torch.float64)
    with pytest.raises(ReconstructionError, match=r"K: wanted pixels, got a focal length of 1 for images of 1000 x 750"):
        guess_cameras(graph, torch.zeros(8).long(), model="pinhole", K=torch.diag(1 / K.diagonal()) @ K, exif_focal=[None] * 8)
    cameras, _ = guess_cameras(graph, torch.zeros(8).long(), model="pinhole", K=K, exif_focal=[None] * 8)
    assert torch.equal(cameras.K[0], K)


@pytest.mark.parametrize("stated", [0.5 * FOCAL, 2.2 * FOCAL])
def test_a_stated_focal_length_that_the_pairs_refute_is_not_taken(stated: float, generator: torch.Generator) -> None:
    focal, source = guess(photographs(random_points(300, generator=generator), generator), stated)
    assert source == "fundamental matrices"
    assert abs(focal / FOCAL - 1) < 0.2


def test_a_stated_focal_length_counts_where_the_pairs_do_not_refute_it(generator: torch.Generator) -> None:
    X = random_points(300, generator=generator)
    assert guess(photographs(X, generator), 1.2 * FOCAL) == (1.2 * FOCAL, "exif")
    # What is flat says nothing of the focal length.
    flat = X * X.new_tensor([1.0, 1.0, 0.0])
    assert guess(photographs(flat, generator), 0.5 * FOCAL) == (0.5 * FOCAL, "exif")


def test_the_pairs_of_stretched_images_tell_the_focal_length(generator: torch.Generator) -> None:
    graph, aspect = photographs(random_points(300, generator=generator), generator), 0.6
    back = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1 / aspect, 0.5 / aspect - 0.5], [0.0, 0.0, 1.0]]).double()
    size = torch.tensor([[SIZE[0], round(SIZE[1] * aspect)]] * 8)
    stretched = replace(graph, F=back.mT @ graph.F @ back, image_size=size)
    nothing = {"model": "radial", "K": None, "exif_focal": [None] * 8}
    cameras = [
        guess_cameras(one, torch.zeros(8).long(), aspect=ratio, **nothing)[0].K[0]
        for one, ratio in ((graph, None), (stretched, torch.full((8,), aspect).double()), (stretched, None))
    ]
    assert float(cameras[1][0, 0] / cameras[0][0, 0]) == pytest.approx(1, rel=1e-2)
    assert float(cameras[1][1, 1] / cameras[1][0, 0]) == pytest.approx(aspect)
    assert cameras[1][:2, 2].tolist() == [499.5, 224.5]
    assert abs(float(cameras[2][0, 0]) / FOCAL - 1) > 0.1
