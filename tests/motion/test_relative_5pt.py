"""The poses of five rays against all of every essential matrix."""

import torch
from chance import assert_share
from torch import Tensor
from two_view_scenes import F64, two_views

from torchsfm.motion import essential_5pt
from torchsfm.motion.two_views import relative_5pt
from torchsfm.tensors import essential_from_pose


def rays(generator: torch.Generator, batch: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rays and E; half of the samples from scenes, half with wrong correspondences."""
    X1, X2, E = two_views("random", batch, 5, generator)
    d1, d2 = (torch.nn.functional.normalize(X, dim=-1) for X in (X1, X2))
    d2[batch // 2 :] = d2[batch // 2 :].roll(1, 0)
    return d1, d2, E


def all_poses(E: Tensor) -> Tensor:
    """The four poses of each E, by its singular vectors."""
    U, _, Vh = torch.linalg.svd(E)
    W = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=F64)
    poses = []
    for turn in (W, W.T):
        R = U @ turn @ Vh
        R = R * torch.linalg.det(R)[..., None, None]
        poses += [torch.cat((R, sign * U[..., 2:]), -1) for sign in (1, -1)]
    return torch.stack(poses, -3)


def depths(pose: Tensor, d1: Tensor, d2: Tensor) -> Tensor:
    """Of a s d2 = b R d1 + t in the sense of least squares, times the squared sine of the angle between the rays."""
    turned, t = d1 @ pose[..., :3].mT, pose[..., None, :, 3]
    cosine, first, second = (turned * d2).sum(-1), (turned * t).sum(-1), (d2 * t).sum(-1)
    return torch.stack((second - cosine * first, cosine * second - first))


def test_poses_are_those_in_front(generator: torch.Generator) -> None:
    d1, d2, E = rays(generator, 400)
    slack = torch.full((400,), 1e-3, dtype=F64)
    found, solutions = relative_5pt.relative_5pt(d1, d2, slack), essential_5pt(d1, d2)
    # The poses are unique, so that the sign of E is.
    error = (essential_from_pose(found.model[..., :3], found.model[..., 3])[:200] - E[:200, None]).norm(dim=(-2, -1))
    error = error.masked_fill(~found.valid[:200], torch.inf).amin(-1)
    assert_share(error < 1e-6, 0.99)
    assert relative_5pt.equations(found.model, d1[:, None], d2[:, None])[found.valid].abs().max() < 1e-6
    assert (torch.linalg.det(found.model[..., :3])[found.valid] > 0).all()
    least = depths(found.model, d1[:, None], d2[:, None]).amin((0, -1))
    assert (least[found.valid] > -1e-3 - 1e-6).all()
    every = all_poses(solutions.model)
    least = depths(every, d1[:, None, None], d2[:, None, None]).amin((0, -1))
    gap = (every[:, :, :, None] - found.model[:, None, None]).norm(dim=(-2, -1))
    gap = gap.masked_fill(~found.valid[:, None, None], torch.inf).amin(-1)
    # Beyond doubt in front: found; beyond doubt behind: not.
    ahead, behind = (least > 0) & solutions.valid[..., None], (least < -2e-3) & solutions.valid[..., None]
    assert ahead.sum() > 500
    assert_share(gap[ahead] < 1e-5, 0.997)
    assert (gap[behind] > 1e-6).all()
    # The valid slots come first.
    assert not (~found.valid[:, :-1] & found.valid[:, 1:]).any()
