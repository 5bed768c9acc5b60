"""Relative poses of verified pairs of images, as many as the rotations of all images need.

Verification has found the epipolar geometry of each pair already. With the cameras it makes an essential matrix, one of whose
four poses is next to the minimum: a few Gauss-Newton steps lead there. Only where that does not explain the matches (points of
a plane, cameras far from what they are taken to be) samples of five say what the pose is.
"""

from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.motion import RelativePoseEstimator
from torchsfm.motion.two_views.sampson_sphere import step_equations
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mapping.calibration import LEAST_NOISE
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.robust import ransac
from torchsfm.tensors import essential_from_fundamental, pose_from_essential

FORESTS = 8
"""Every two parts of the images stay connected by so many pairs, or by all that there are."""
MATCHES = 100
"""Matches of a pair that its relative pose is estimated from: those in excess say little more of it."""
VOTERS = 32
"""Matches of a pair that choose among the four poses of an essential matrix."""
ROWS = 200_000
"""Padded matches worked on at once."""
STEPS = (9.0, 4.0, 1.0, 1.0)
"""Squared thresholds of the steps, in units of the squared threshold."""
EXPLAINED = 0.9
"""Share of the verified matches that a pose must explain."""


def strongest_pairs(
    pairs: Int[Tensor, "q 2"], strength: Int[Tensor, "q"] | Float[Tensor, "q"], views: int, forests: int = FORESTS
) -> Bool[Tensor, "q"]:
    """Few pairs that hold the images together about as firmly as all do.

    Those of a maximum spanning forest, of another one of the pairs that are left, and so on: of the pairs between any two parts
    of the images, as many of the strongest are kept as there are forests, or all (Nagamochi & Ibaraki 1992). Their number
    is in proportion to that of the images, however many each is matched with.

    Args:
        pairs: Pairs of images, none with itself.
        strength: How much each pair counts; of equals the earlier is taken.
        views: Number of images.
        forests: Number of forests.

    Returns:
        Which pairs are kept.

    Example:
        >>> import torch
        >>> from torchsfm.reconstruction.mappers.pair_poses import strongest_pairs
        >>> pairs = torch.combinations(torch.arange(4))
        >>> pairs[strongest_pairs(pairs, torch.tensor([9, 8, 7, 1, 2, 3]), 4, forests=1)]
        tensor([[0, 1],
                [0, 2],
                [0, 3]])
    """
    parents = [list(range(views)) for _ in range(forests)]

    def joined(parent: list[int], a: int, b: int) -> tuple[bool, int, int]:
        while parent[a] != a:
            parent[a] = a = parent[parent[a]]
        while parent[b] != b:
            parent[b] = b = parent[parent[b]]
        return a == b, a, b

    chosen = []
    order = torch.argsort(strength, descending=True, stable=True)
    for q, i, j in zip(order.tolist(), *pairs[order].mT.tolist(), strict=True):
        # What a forest joins, those before it join: the first that does not is found by halving.
        low, high = 0, forests
        while low < high:
            middle = (low + high) // 2
            low, high = (middle + 1, high) if joined(parents[middle], i, j)[0] else (low, middle)
        if low < forests:
            _, a, b = joined(parents[low], i, j)
            parents[low][b] = a
            chosen.append(q)
    kept = torch.zeros(len(pairs), dtype=torch.bool)
    kept[chosen] = True
    return kept


def relative_poses(
    mapping: Mapping, chosen: Int[Tensor, "q"], options: MappingOptions
) -> tuple[Float[Tensor, "q 3 4"], Float[Tensor, "q 3 3"], Bool[Tensor, "q"]]:
    """The relative pose of pairs of images, the covariance of its rotation, and where there are both.

    Args:
        mapping: Cameras, and the view graph.
        chosen: The pairs.
        options: Largest distance of an inlier, and randomness.
    """
    graph, (q, dtype) = mapping.graph, (len(chosen), mapping.graph.x.dtype)
    order = torch.argsort(graph.match_pair, stable=True)
    counts = torch.bincount(graph.match_pair, minlength=len(graph.pairs))
    first = counts.cumsum(0) - counts
    match = graph.match[order]
    d, valid = mapping.rays(torch.arange(len(graph.view)))
    d = torch.nn.functional.normalize(d, dim=-1)
    K = mapping.cameras.K[mapping.camera_index]
    limit = (options.reprojection / K[:, 0, 0][graph.pairs].mean(-1)).clamp(max=0.1)
    E = essential_from_fundamental(graph.F[chosen], *K[graph.pairs[chosen]].unbind(1))
    motion, spread = torch.zeros(q, 3, 4, dtype=dtype), torch.zeros(q, 3, 3, dtype=dtype)
    good = torch.zeros(q, dtype=torch.bool)
    # Pairs of like numbers together, so that few rows are empty.
    rank = torch.argsort(counts[chosen], descending=True, stable=True)
    while len(rank):
        width = min(int(counts[chosen[rank[0]]]), MATCHES)
        rows = max(1, ROWS // max(width, 1))
        some, rank = rank[:rows], rank[rows:]
        own = chosen[some]
        # Every so many-th of those in excess.
        slots = (torch.arange(width) * (counts[own, None] / width).clamp(min=1)).long()
        mask = slots < counts[own, None]
        a, b = match[torch.where(mask, first[own, None] + slots, 0)].unbind(-1)
        mask = mask & valid[a] & valid[b]
        data, edge = (d[a], d[b]), limit[own]
        least = LEAST_NOISE * edge / options.reprojection
        motion[some] = _nearest(E[some], data, mask, edge)
        spread[some], determined, explained = _rotation_covariance(motion[some], data, mask, edge, least)
        good[some] = determined & explained
        lost = (~good[some]).nonzero()[:, 0]
        if len(lost):
            data, mask, edge = (data[0][lost], data[1][lost]), mask[lost], edge[lost]
            found = ransac(RelativePoseEstimator(edge), *data, threshold=edge, mask=mask, generator=options.generator)
            motion[some[lost]] = found.model
            spread[some[lost]], determined, _ = _rotation_covariance(found.model, data, mask, edge, least[lost])
            good[some[lost]] = (found.status == Status.OK) & determined
    return motion, spread, good


def _nearest(
    E: Float[Tensor, "q 3 3"], data: tuple[Tensor, Tensor], mask: Bool[Tensor, "q n"], limit: Float[Tensor, "q"]
) -> Float[Tensor, "q 3 4"]:
    """The pose of an essential matrix for which the rays meet in front of the cameras, and from there to the minimum."""
    every = -(-mask.shape[1] // VOTERS)
    pose = pose_from_essential(E, data[0][:, ::every], data[1][:, ::every], mask[:, ::every]).pose
    model = torch.cat((pose.R, pose.t[..., None]), -1)
    estimator = RelativePoseEstimator(limit)
    for factor in STEPS:
        model = estimator.step(model, *data, weigh=partial(_weigh, reach=factor * limit[:, None].square(), mask=mask))
    return model


def _weigh(squared: Tensor, *, reach: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the slope and of the curvature: those of reweighted least squares."""
    weights = _falling(squared, reach, mask)
    return weights, weights


def _falling(squared: Tensor, reach: Tensor, mask: Tensor) -> Tensor:
    """Weights that fall to zero within the reach of a squared distance."""
    return torch.where(mask, (1 - squared / reach).clamp(min=0), 0)


def _rotation_covariance(
    model: Float[Tensor, "q 3 4"],
    data: tuple[Tensor, Tensor],
    mask: Bool[Tensor, "q n"],
    limit: Float[Tensor, "q"],
    least: Float[Tensor, "q"],
) -> tuple[Float[Tensor, "q 3 3"], Bool[Tensor, "q"], Bool[Tensor, "q"]]:
    """That of the rotation of each pose by the scatter of its matches, where it is determined, and where it explains them."""
    squared = RelativePoseEstimator(limit).squared_residual(model, *data)
    weights = _falling(squared, limit[:, None].square(), mask)
    H, _ = step_equations(model, *data, limit, lambda _: (weights, weights))
    # A move along the translation changes nothing.
    t = model[..., 3]
    H[:, 3:, 3:] += t[:, :, None] * t[:, None] * H.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    inverse, info = torch.linalg.inv_ex(H)
    freedom = (weights.sum(-1) - RelativePoseEstimator.dimension).clamp(min=1)
    noise = ((weights * squared.nan_to_num(posinf=0.0)).sum(-1) / freedom).clamp(min=least.square())
    covariance = noise[:, None, None] * inverse[:, :3, :3]
    explained = (weights > 0).sum(-1) >= EXPLAINED * mask.sum(-1)
    determined = (info == 0) & covariance.isfinite().all(-1).all(-1) & (torch.linalg.cholesky_ex(covariance)[1] == 0)
    return covariance, determined, explained
