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
from torchsfm.robust.sampling import hash_integers
from torchsfm.robust.scoring import squared_residual

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
        score: The soft number of inliers of each; 0 in empty slots. Differentiable.
        valid: Which slots hold models.
        sample: The numbers of the data that each sample consists of, in the order in which they were drawn.
        log_sampling: The logarithm of the probability of drawing each sample in its order. Differentiable in the logits.
        status: `OK`; `TOO_FEW` data for a sample; `DEGENERATE`: no sample has a solution; `NOT_FINITE`: too few of the data are
            finite.
    """

    model: M
    probability: Float[Tensor, "*batch h k"]
    score: Float[Tensor, "*batch h k"]
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
        """The model of the highest score of each problem."""
        h, k = self.score.shape[-2:]
        batch = self.score.shape[:-2]
        slot = torch.where(self.valid, self.score.detach(), -1).flatten(-2).argmax(-1)

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
    estimate, use `ransac`, which refines, stops, and takes logits as `scores`.

    A datum at squared distance r^2 counts as sigmoid(sharpness (1 - r^2 / threshold^2)) of an inlier. Data without finite
    numbers are left out. The result for a problem is the same whatever else is in the batch.

    Args:
        estimator: The problem: what to solve and measure.
        *data: The data, `(*batch, n, d)` each, equally many; batch dimensions broadcast.
        threshold: Distance at which a datum counts half, in the unit of the residual; one number or one per problem.
        logits: Logarithm of each datum's share in the samples, up to a constant. None: all alike.
        mask: Which data exist; all of them if not given.
        hypotheses: Number of samples for each problem.
        temperature: The score that makes a hypothesis e times as probable, as a share of the problem's number of data. Towards
            0 the best hypothesis is chosen; larger values let more of them learn.
        sharpness: How fast a datum's count falls at the threshold.
        generator: Source of randomness; PyTorch's global one if not given.

    Returns:
        Hypotheses, their probabilities and scores. Models are differentiable in the data where the solver is; where a solution
        is degenerate its derivative is zero.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.
    """
    if not data:
        raise ValueError("data: wanted at least one tensor of shape (*batch, n, d), got none")
    check_options(
        estimator=(estimator, Estimator),
        temperature=(temperature, "float > 0"),
        sharpness=(sharpness, "float > 0"),
        hypotheses=(hypotheses, "int >= 1"),
    )
    known = {f"data[{i}]": (d, f"n d{i}") for i, d in enumerate(data)}
    limit = threshold if isinstance(threshold, Tensor) else None
    if limit is None:
        check_options(threshold=(threshold, "float > 0"))
    batch = check_tensors(**known, threshold=(limit, "?"), logits=(logits, "?n"), mask=(mask, "?n: bool"))
    limit = data[0].new_tensor(threshold) if limit is None else limit
    n, m, p = data[0].shape[-2], estimator.sample_size, batch.numel()
    if n < m:
        raise ValueError(f"data: wanted n >= {m}, the size of a sample, got {n}")
    seed = int(torch.randint(1 << 62, (), generator=generator, device=None if generator is None else generator.device))
    flat = [d.expand(*batch, n, d.shape[-1]).reshape(p, n, d.shape[-1]) for d in data]
    own = tensor_map(lambda t: t.expand(batch + t.shape[len(batch) :]).reshape(p, *t.shape[len(batch) :]), estimator)
    exists = torch.ones(p, n, dtype=torch.bool, device=flat[0].device)
    exists = exists if mask is None else mask.expand(*batch, n).reshape(p, n)
    usable = exists
    for d in flat:
        usable = usable & torch.isfinite(d).all(-1)
    weights = torch.zeros_like(flat[0][..., 0]) if logits is None else logits.expand(*batch, n).reshape(p, n)
    usable = usable & torch.isfinite(weights)
    flat = [torch.where(usable[..., None], d, 0) for d in flat]
    enough = usable.sum(-1) >= m
    index, log_sampling = _draw(weights, usable, hypotheses, m, seed)

    row = torch.arange(p, device=index.device)[:, None, None]
    wide = tensor_map(lambda t: t[:, None], own)
    sample = [d[row, index] for d in flat]
    solutions = wide.minimal(*sample)
    k = solutions.valid.shape[-1]
    with torch.no_grad():
        bad = wide.degenerate(*(s.detach() for s in sample))
    valid = solutions.valid & ~bad[..., None] & enough[:, None, None]
    models = tensor_map(lambda t: t.flatten(1, 2), solutions.model)
    square = (limit * limit).expand(batch).reshape(p, 1, 1)
    ratio = squared_residual(wide, models, *(d[:, None] for d in flat)) / square
    near = ratio < _FAR
    count = torch.sigmoid(sharpness * (1 - torch.where(near, ratio, _FAR)))
    score = torch.where(valid, (count * usable[:, None]).sum(-1).reshape(p, hypotheses, k), 0)
    # A softmax in which empty slots take no part.
    number = usable.sum(-1).clamp(min=1)[:, None]
    energy = torch.where(valid, score, -torch.inf).flatten(1) / (temperature * number)
    some = valid.flatten(1).any(-1, keepdim=True)
    probability = torch.where(some, torch.softmax(torch.where(some, energy, 0), -1), 0).reshape(score.shape)

    status = torch.where(some[:, 0], int(Status.OK), int(Status.DEGENERATE))
    status = torch.where(enough, status, torch.where(exists.sum(-1) < m, int(Status.TOO_FEW), int(Status.NOT_FINITE)))

    def shaped(t: Tensor) -> Tensor:
        return t.reshape(*batch, *t.shape[1:])

    return SoftSelection(
        tensor_map(shaped, solutions.model), shaped(probability), shaped(score), shaped(valid), shaped(index),
        shaped(log_sampling), status.to(torch.int8).reshape(batch),
    )  # fmt: skip


def uniform_numbers(seed: int, rows: int, columns: int, device: torch.device) -> Float[Tensor, "rows columns"]:
    """Random numbers between 0 and 1 that are a hash of the seed, the row and the column."""
    counter = torch.arange(rows, device=device)[:, None] * (1 << 32) + torch.arange(columns, device=device)
    key = hash_integers(torch.tensor(seed, device=device))
    random = (hash_integers(hash_integers(counter + 1) ^ key) >> 11) & ((1 << 53) - 1)
    return (random.double() + 0.5) * 2.0**-53


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
    chosen = torch.where(torch.isfinite(chosen), chosen, 0)
    taken = chosen.exp().cumsum(-1)
    left = torch.cat((torch.zeros_like(taken[..., :1]), taken[..., :-1]), -1)
    return index, (chosen - (1 - left).clamp(min=_REMAINS).log()).sum(-1)
