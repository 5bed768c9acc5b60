"""RANSAC that can be trained through: hypotheses drawn by learned weights, chosen softly, with the gradient of the expectation.

Hypotheses come from samples drawn without replacement with probabilities q given by logits (Plackett & Luce). Each gets a soft
number of inliers s, and is chosen with probability p = softmax(s / temperature) (DSAC: Brachmann et al. 2017). For losses l of
the models, L = sum p l is a function of the data and the scores, and is differentiated as such, through the solver. The
derivative by the logits is that of the expectation over samples: the sum over samples of (L - L') d log q, where L' is L
without the sample. L' does not depend on the sample, so the estimate has no bias (Williams 1992; Brachmann & Rother 2019 have
one baseline for all), and L - L' = p (l - L') is small for all samples but those that matter.
"""

from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.hypotheses import squared_residual
from torchsfm.robust.problems import Flat
from torchsfm.robust.sampling import draw_seed, uniform_numbers

M = TypeVar("M")

_FAR = 1e4
"""Squared distances in units of the squared threshold are cut off here, infinite ones too."""
_REMAINS = 1e-9
"""Least probability left for the later data of a sample."""


@dataclass(frozen=True)
class SoftSelection(Generic[M]):
    """Hypotheses for each problem of a batch, and with what probability each is chosen.

    Attributes:
        model: The models of `h` samples with `k` solution slots each; empty slots hold finite numbers without meaning.
        probability: With which each is chosen: sums to 1, or is 0 everywhere where no sample has a solution. Differentiable.
        support: The soft number of inliers of each; 0 in empty slots. Differentiable.
        valid: Which slots hold models.
        sample: The numbers of the data that each sample consists of, in the order in which they were drawn.
        log_sampling: The logarithm of the probability of drawing each sample in its order. Differentiable in the logits.
        status: `OK`; `TOO_FEW` data for a sample; `DEGENERATE`: no sample has a solution; `NOT_FINITE`: too few of the data are
            finite.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(50, 2, generator=g, dtype=torch.float64)
        >>> x2 = torch.cat((x1[:30] + 0.1, torch.rand(20, 2, generator=g, dtype=torch.float64)))  # 40 % are wrong
        >>> logits = torch.zeros(50, dtype=x1.dtype, requires_grad=True)
        >>> estimator = torchsfm.motion.HomographyEstimator()
        >>> chosen = torchsfm.soft_ransac(estimator, x1, x2, threshold=1e-2, logits=logits, generator=g)
        >>> chosen.model.shape, chosen.probability.shape  # of 64 samples each
        (torch.Size([64, 1, 3, 3]), torch.Size([64, 1]))
        >>> chosen.best().shape
        torch.Size([3, 3])
        >>> (-chosen.expectation(chosen.support)).backward()  # what lowers the expected loss
        >>> bool(logits.grad[:30].mean() < logits.grad[30:].mean())  # trusting right matches more
        True
    """

    model: M
    probability: Float[Tensor, "*batch h k"]
    support: Float[Tensor, "*batch h k"]
    valid: Bool[Tensor, "*batch h k"]
    sample: Int[Tensor, "*batch h m"]
    log_sampling: Float[Tensor, "*batch h"]
    status: Int[Tensor, "*batch"]

    def expectation(self, loss: Float[Tensor, "*batch h k"]) -> Float[Tensor, "*batch"]:
        """The expected loss of the chosen model, with the derivatives to train by.

        Args:
            loss: What each model would cost; what stands in empty slots, and losses that are not finite, count as nothing.

        Returns:
            Its value is the sum of probability times loss. Its derivative is that of the sum by whatever probabilities and
            losses depend on, plus an unbiased estimate of the derivative by the sampling logits.

        Raises:
            ValueError: Wrong shape or dtype.
        """
        h, k = self.probability.shape[-2:]
        check_tensors(probability=(self.probability, "h k"), loss=(loss, f"{h} {k}"))
        counts = self.valid & torch.isfinite(loss)
        kept = torch.where(counts, loss, 0)
        share = torch.where(counts, self.probability, 0)
        mean = (share * kept).sum((-2, -1))
        if not self.log_sampling.requires_grad:
            return mean
        with torch.no_grad():
            own, product = share.double().sum(-1), (share * kept).double().sum(-1)
            rest = _without_each(own)
            some = rest > 0
            others = torch.where(some, _without_each(product) / torch.where(some, rest, 1), 0)
            # What a sample changes: L with it, less L without it.
            advantage = (product - own * others).to(mean.dtype)
        change = (advantage * (self.log_sampling - self.log_sampling.detach())).sum(-1)
        return mean + change

    def best(self) -> M:
        """The model of the most support of each problem."""
        h, k = self.support.shape[-2:]
        batch = self.support.shape[:-2]
        slot = torch.where(self.valid, self.support.detach(), -1).flatten(-2).argmax(-1)

        def pick(t: Tensor) -> Tensor:
            flat = t.reshape(batch.numel(), h * k, *t.shape[len(batch) + 2 :])
            chosen = flat[torch.arange(batch.numel(), device=t.device), slot.reshape(-1)]
            return chosen.reshape(*batch, *t.shape[len(batch) + 2 :])

        return tensor_map(pick, self.model)


def _without_each(x: Float[Tensor, "*batch h"]) -> Float[Tensor, "*batch h"]:
    """For each element the sum of the others, without cancellation."""
    zero = torch.zeros_like(x[..., :1])
    before = torch.cat((zero, x[..., :-1].cumsum(-1)), -1)
    after = torch.cat((x[..., 1:].flip(-1).cumsum(-1).flip(-1), zero), -1)
    return before + after


def soft_ransac(
    estimator: Estimator[M],
    *data: Float[Tensor, "*#batch n _"],
    threshold: float | Float[Tensor, "*#batch"],
    logits: Float[Tensor, "*#batch n"] | None = None,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    hypotheses: int = 64,
    temperature: float = 0.02,
    sharpness: float = 4.0,
    generator: torch.Generator | None = None,
) -> SoftSelection[M]:
    """Draw hypotheses, score them softly, and choose softly among them, so that everything has a derivative.

    For training: a network gives `logits`, or moves the data, and `SoftSelection.expectation` of a loss leads back to it. To
    estimate, use `ransac`, which refines, stops, and takes logits as `quality`.

    A datum at squared distance r^2 counts as sigmoid(sharpness (1 - r^2 / threshold^2)) of an inlier. Data without finite
    numbers are left out. The result for a problem is the same whatever else is in the batch.

    Args:
        estimator: The problem: what to solve and measure.
        *data: The data, `(*batch, n, d)` each, equally many; batch dimensions broadcast.
        threshold: Distance at which a datum counts half, in the unit of the residual; one number or one per problem.
        logits: Logarithm of each datum's share in the samples, up to a constant. None: all alike.
        mask: Which data exist; all of them if not given.
        hypotheses: Number of samples for each problem.
        temperature: The support that makes a hypothesis e times as probable, as a share of the problem's number of data.
            Towards 0 the best hypothesis is chosen; larger values let more of them learn.
        sharpness: How fast a datum's count falls at the threshold.
        generator: Source of randomness; PyTorch's global one if not given.

    Returns:
        Hypotheses, their probabilities and support. Models are differentiable in the data where the solver is; where a solution
        is degenerate its derivative is zero.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x = torch.rand(50, 2, generator=g, dtype=torch.float64)
        >>> logits = torch.zeros(50, dtype=x.dtype, requires_grad=True)
        >>> estimator = torchsfm.motion.HomographyEstimator()
        >>> chosen = torchsfm.soft_ransac(estimator, x, x + 0.1, threshold=1e-2, logits=logits, generator=g)
        >>> chosen.expectation(1 - chosen.support / 50).backward()  # trains what gave the logits
        >>> chosen.probability.shape, round(float(chosen.probability.sum()), 6), logits.grad.shape
        (torch.Size([64, 1]), 1.0, torch.Size([50]))
    """
    flat = Flat.of(estimator, data, threshold, mask, logits=logits)
    check_options(
        temperature=(temperature, "float > 0"), sharpness=(sharpness, "float > 0"), hypotheses=(hypotheses, "int >= 1")
    )
    (p, n), m = flat.shape, estimator.sample_size
    if n < m:
        raise ValueError(f"data: wanted n >= {m}, the size of a sample, got {n}")
    seed = draw_seed(generator)
    weights = flat.of_data.get("logits", torch.zeros_like(flat.data[0][..., 0]))
    usable = torch.isfinite(weights) if flat.exists is None else torch.isfinite(weights) & flat.exists
    for d in flat.data:
        usable = usable & torch.isfinite(d).all(-1)
    rows = [torch.where(usable[..., None], d, 0) for d in flat.data]
    enough = usable.sum(-1) >= m
    index, log_sampling = _draw(weights, usable, hypotheses, m, seed)

    row = torch.arange(p, device=index.device)[:, None, None]
    wide = tensor_map(lambda t: t[:, None], flat.estimator)
    sample = [d[row, index] for d in rows]
    solutions = wide.minimal(*sample)
    k = solutions.valid.shape[-1]
    with torch.no_grad():
        bad = wide.degenerate(*(s.detach() for s in sample))
    valid = solutions.valid & ~bad[..., None] & enough[:, None, None]
    models = tensor_map(lambda t: t.flatten(1, 2), solutions.model)
    square = (flat.bound * flat.bound)[:, None, None]
    ratio = squared_residual(wide, models, *(d[:, None] for d in rows)) / square
    near = ratio < _FAR
    count = torch.sigmoid(sharpness * (1 - torch.where(near, ratio, _FAR)))
    support = torch.where(valid, (count * usable[:, None]).sum(-1).reshape(p, hypotheses, k), 0)
    # A softmax in which empty slots take no part.
    number = usable.sum(-1).clamp(min=1)[:, None].to(support.dtype)
    energy = torch.where(valid, support, -torch.inf).flatten(1) / (temperature * number)
    some = valid.flatten(1).any(-1, keepdim=True)
    probability = torch.where(some, torch.softmax(torch.where(some, energy, 0), -1), 0).reshape(support.shape)

    status = torch.where(some[:, 0], int(Status.OK), int(Status.DEGENERATE))
    status = torch.where(enough, status, flat.refused()).to(torch.int8)
    found = SoftSelection(solutions.model, probability, support, valid, index, log_sampling, status)
    return flat.unflatten(found)


def _draw(
    logits: Float[Tensor, "p n"], usable: Bool[Tensor, "p n"], hypotheses: int, size: int, seed: int
) -> tuple[Int[Tensor, "p h m"], Float[Tensor, "p h"]]:
    """Samples without replacement, and the logarithms of their probabilities.

    The largest of logits plus Gumbel noise are such a sample, in its order (Kool, van Hoof & Welling 2019). The noise is a hash
    of the seed, the hypothesis and the datum, so that it does not depend on the batch.
    """
    p, n = logits.shape
    device = logits.device
    uniform = uniform_numbers(seed, hypotheses, n, device)
    noise = -torch.log(-torch.log(uniform))
    with torch.no_grad():
        keys = torch.where(usable, logits.double(), -torch.inf)[:, None] + noise
        index = keys.topk(size, dim=-1).indices
    # With too few data nothing is drawn that means anything; the probabilities must stay finite.
    some = usable.any(-1, keepdim=True)
    masked = torch.where(usable, logits, -torch.inf)
    log_share = torch.log_softmax(torch.where(some, masked, 0), -1)
    chosen = log_share[:, None].expand(p, hypotheses, n).gather(-1, index)
    # So unlikely that no number says how much, in the sum either.
    chosen = torch.where(torch.isfinite(chosen), chosen, 0).clamp(min=torch.finfo(chosen.dtype).min / (2 * size))
    taken = chosen.exp().cumsum(-1)
    left = torch.cat((torch.zeros_like(taken[..., :1]), taken[..., :-1]), -1)
    return index, (chosen - (1 - left).clamp(min=_REMAINS).log()).sum(-1)
