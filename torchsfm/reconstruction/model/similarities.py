"""The similarity between places of a model and measured ones, some of them wrong, and how well it is known."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry import Similarity, similarity_from_points
from torchsfm.linalg import eigvalsh

OUTLYING = 4.0
"""Robust standard deviations beyond which a pair of positions does not count."""
DEVIATION = 1.4826
"""A normal distribution's standard deviation over its median absolute value."""
SAMPLES, SETTLING = 1000, 30
"""Triples that are tried, all of them where there are fewer; and steps of reweighting."""
MOST_TURN, MOST_SCALE = math.radians(6), 0.1
"""Standard deviations, radians and relative, beyond which a similarity is not known."""


@dataclass(frozen=True)
class Certainty:
    """How well measured places determine a similarity.

    Attributes:
        sigma: Standard deviation of a coordinate of the places, by how far they are from the fit, in their unit.
        scale: That of the scale, relative.
        turn: That of the rotation about the axis about which it is known least, radians; infinite for places on a line.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(8, 20, 100, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> measured = 10 * model.poses.centre + 0.1 * torch.randn(8, 3, generator=g)  # metres, each to about 10 cm
        >>> found = torchsfm.reconstruction.align_to_positions(model, model.names, measured)
        >>> bool(0.03 < found.known.sigma < 0.2), bool((found.similarity.scale / 10 - 1).abs() < 4 * found.known.scale)
        (True, True)
    """

    sigma: float
    scale: float
    turn: float


def robust_similarity(
    X: Float[Tensor, "n 3"],
    Y: Float[Tensor, "n 3"],
    generator: torch.Generator | None = None,
    *,
    sigma: Float[Tensor, "n"] | None = None,
) -> tuple[Similarity, Bool[Tensor, "n"]]:
    """The similarity from X to Y that most pairs agree on, of least squares over those, and which they are.

    Least trimmed squares (Rousseeuw & Van Driessen 2006) over three fifths of the pairs, started from triples; then pairs count
    that are no farther off than noise would have it. So two fifths may be wrong, of seven pairs or more; of fewer, one or none.

    Args:
        X: Places in the one frame.
        Y: In the other, in whose unit distances are.
        generator: Source of the triples; the same ones each time if not given.
        sigma: How uncertain each pair is, up to a factor; all alike if not given.
    """
    n = len(X)
    if n < 3:
        return similarity_from_points(X, Y), torch.ones(n, dtype=torch.bool)
    # In units of the middle one, so that distances keep theirs.
    spread = torch.ones_like(X[:, 0]) if sigma is None else sigma / sigma.median()
    weights = spread.square().reciprocal()
    generator = generator or torch.Generator().manual_seed(0)
    if math.comb(n, 3) <= SAMPLES:
        triple = torch.combinations(torch.arange(n), 3)
    else:
        triple = torch.rand(SAMPLES, n, generator=generator).topk(3, dim=-1).indices
    kept = min(n, max(5, math.ceil(0.6 * n)))
    models = similarity_from_points(X[triple], Y[triple])
    for _ in range(2):
        squared = (models.transform(X) - Y).square().sum(-1) * weights
        near = squared.topk(kept, dim=-1, largest=False).indices
        models = similarity_from_points(X[near], Y[near], weights[near])
    squared = (models.transform(X) - Y).square().sum(-1) * weights
    best = squared.topk(kept, dim=-1, largest=False).values.sum(-1).argmin()
    distance = squared[best].sqrt()
    # Exact places differ by rounding.
    floor = 1e-9 * (Y - Y.mean(0)).norm(dim=-1).median()
    # Few pairs are fitted more closely than they are exact (Rousseeuw & Leroy 1987, 5.1).
    reach = OUTLYING * DEVIATION * (1 + 5 / max(n - 3, 1))
    used = torch.ones(n, dtype=torch.bool)
    for _ in range(SETTLING):
        before, used = used, distance <= reach * distance.median() + floor
        similarity = similarity_from_points(X, Y, used * weights)
        distance = (similarity.transform(X) - Y).norm(dim=-1) / spread
        if bool((used == before).all()):
            break
    return similarity, used


def four_places(X: Float[Tensor, "n 3"]) -> Float[Tensor, "4 3"]:
    """Four places that stand for many: their mean, and along each axis as far off as they are."""
    mean = X.mean(0)
    spread = (X - mean).square().mean(0).sum().sqrt()
    return mean + spread * torch.eye(4, 3, dtype=X.dtype).roll(1, 0)


def certainty(similarity: Similarity, X: Float[Tensor, "n 3"], Y: Float[Tensor, "n 3"], used: Bool[Tensor, "n"]) -> Certainty:
    """How well the pairs that are used determine the similarity which fits them best."""
    apart, around = (similarity.transform(X) - Y)[used], similarity.transform(X)[used]
    around = around - around.mean(0)
    sigma = float((apart.square().sum() / max(3 * len(apart) - 7, 1)).sqrt())
    spread = around.mT @ around
    # About an axis a turn moves what is beside it.
    narrow = float((spread.trace() - eigvalsh(spread)[0][-1]).clamp(min=0))
    wide = float(spread.trace())
    thin = narrow <= 1e-12 * wide
    return Certainty(sigma, sigma / math.sqrt(wide) if wide > 0 else math.inf, math.inf if thin else sigma / math.sqrt(narrow))
