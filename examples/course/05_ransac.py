"""
5. RANSAC: from ten lines to hundreds of pairs
==============================================

Some of the data are wrong, and least squares does not forgive. RANSAC guesses: take the smallest sample that fixes a model, see
how many of the other data agree, and do it again. We write it in ten lines, do it for all samples at once, then for hundreds of
image pairs at once, and turn every knob there is: threshold, score, confidence, sampler. At the end a network learns, through
RANSAC, which matches to trust.

*About 20 minutes. Reading: Hartley & Zisserman, 4.7 and 11.6; Fischler & Bolles 1981.*
"""

# %%
import math
import time

import matplotlib.pyplot as plt
import torch
from torch import nn

from torchsfm.geometry import Camera, intrinsics, sampson_distance
from torchsfm.motion import FundamentalEstimator, estimate_fundamental
from torchsfm.robust import InlierCount, Magsac, Msac, Prosac, Uniform, soft_ransac
from torchsfm.simulation import random_points, random_poses, simulate_images

torch.set_default_dtype(torch.float64)

# %% [markdown]
# Ten lines
# ---------
# A hundred points, forty of them on a line but for some noise. A line in homogeneous coordinates is :math:`l = (a, b, c)`
# with :math:`a x + b y + c = 0`; through two points it is their cross product, and with :math:`a^2 + b^2 = 1` the left side
# is the distance.

# %%
g = torch.Generator().manual_seed(4)
t = torch.rand(40, 1, generator=g)
on_line = torch.tensor([[0.05, 0.2]]) + t * torch.tensor([[0.9, 0.5]]) + 0.01 * torch.randn(40, 2, generator=g)
points = torch.cat((on_line, torch.rand(60, 2, generator=g)))
homogeneous = torch.cat((points, torch.ones(100, 1)), 1)


def ransac_line(h: torch.Tensor, threshold: float, samples: int) -> tuple[torch.Tensor, int]:
    """The line that most points agree with, and how many these are."""
    best, most = torch.zeros(3), 0
    for _ in range(samples):
        i, j = torch.randperm(len(h), generator=g)[:2]
        line = torch.linalg.cross(h[i], h[j])
        line = line / line[:2].norm()
        count = int(((h @ line).abs() < threshold).sum())
        if count > most:
            best, most = line, count
    return best, most


line, count = ransac_line(homogeneous, 0.03, 50)
spread = torch.linalg.svd(points - points.mean(0)).Vh[1]  # total least squares: the normal of least spread
fit = torch.cat((spread, -(points.mean(0) @ spread)[None]))
fig, ax = plt.subplots(figsize=(5.5, 4.6), layout="constrained")
near = (homogeneous @ line).abs() < 0.03
ax.plot(*points[near].T, ".", color="tab:green", label=f"{count} agree")
ax.plot(*points[~near].T, ".", color="tab:red", label="do not")
x = torch.linspace(0, 1, 2)
for (a, b, c), style, label in ((line, "-", "RANSAC"), (fit, "--", "least squares")):
    ax.plot(x, -(a * x + c) / b, style, color="black", label=label)
ax.set(xlim=(0, 1), ylim=(0, 1), title="A line among clutter")
ax.legend(loc="upper left", bbox_to_anchor=(1, 1))
slope, slope_of_fit = float(-line[0] / line[1]), float(-fit[0] / fit[1])
print(f"slope: true {0.5 / 0.9:.3f}, RANSAC {slope:.3f}, least squares {slope_of_fit:.3f}")

# %% [markdown]
# How many samples?
# -----------------
# If a share *w* of the data is right, a sample of *m* is free of wrong data with probability :math:`w^m`, and *N* samples
# all fail with :math:`(1 - w^m)^N`. To succeed with *confidence* *p*:
#
# .. math:: N = \frac{\log(1 - p)}{\log(1 - w^m)}.
#
# This is why samples should be minimal. *w* is not known, but every better model shows more agreement, so *N* is computed
# anew on the way: that is when RANSAC stops.

# %%
w = torch.linspace(0.1, 0.95, 100)
fig, ax = plt.subplots(figsize=(6, 4), layout="constrained")
for m, name in ((2, "line"), (4, "homography"), (5, "essential"), (7, "fundamental"), (8, "eight-point")):
    ax.semilogy(w, math.log(1 - 0.99) / torch.log1p(-(w**m)), label=f"{m}: {name}")
ax.set(xlabel="share of right data", ylabel="samples for 99 %", ylim=(1, 1e7), title="The price of a larger sample")
ax.legend(title="size of the sample")
ax.grid(alpha=0.3)
for m in (5, 7, 8):
    print(f"half of the data wrong, samples of {m}: {math.log(0.01) / math.log1p(-(0.5**m)):.0f} needed for 99 %")

# %% [markdown]
# All samples at once
# -------------------
# The loop has no memory but the best. So there need not be a loop: draw all samples, solve all, measure all, take the
# largest count. A batch of problems is one more dimension on the left. Below: five hundred lines in clutter, each with its
# own twenty samples.

# %%
problems = 500
g = torch.Generator().manual_seed(0)
ends = torch.rand(problems, 2, 2, generator=g)
t = torch.rand(problems, 40, 1, generator=g)
on_line = (1 - t) * ends[:, :1] + t * ends[:, 1:] + 0.01 * torch.randn(problems, 40, 2, generator=g)
h = nn.functional.pad(torch.cat((on_line, torch.rand(problems, 60, 2, generator=g)), 1), (0, 1), value=1.0)

index = torch.rand(problems, 20, 100, generator=g).argsort(-1)[..., :2]  # (problem, sample, two different points)
pair = torch.gather(h[:, None].expand(-1, 20, -1, -1), 2, index[..., None].expand(-1, -1, -1, 3))
lines = torch.linalg.cross(pair[:, :, 0], pair[:, :, 1])
lines = lines / lines[..., :2].norm(dim=-1, keepdim=True)
counts = ((lines @ h.mT).abs() < 0.03).sum(-1)  # (problem, sample)
best = lines[torch.arange(problems), counts.argmax(-1)]
off = (nn.functional.pad(ends, (0, 1), value=1.0) @ best[..., None])[..., 0].abs().amax(-1)
print(f"500 lines, 10,000 samples, no loop: {100 * (off < 0.05).double().mean():.0f} % within 0.05 of the truth at both ends")

# %% [markdown]
# The formula promises a clean sample for 97 %: :math:`1 - (1 - 0.4^2)^{20}`. A clean sample of two points close together is
# still a bad line.
#
# **Exercise 1.** Look at the failures: too few samples, or lines so short that clutter has longer ones? *Hint:* compare
# ``counts.amax(-1)`` and ``(ends[:, 0] - ends[:, 1]).norm(dim=-1)`` of the failures with those of the others, and draw more
# samples.
#
# Hundreds of image pairs
# -----------------------
# The library does this with any model. What it adds to the ten lines: each problem of the batch stops by itself; the best
# model is improved on the data that agree with it (*local optimisation*); a robust least squares fit ends it. ``mask`` says
# which matches exist, so pairs with different numbers of matches share a batch.

# %%
SIZE, NOISE = (1000, 750), 0.5


def image_pairs(pairs: int, matches: int, wrong: float, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Matches x1, x2 with half a pixel of noise, their exact places y1, y2, which are visible, and which of them are wrong."""
    g = torch.Generator().manual_seed(seed)
    camera = Camera(intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])))
    X, poses = random_points(pairs, matches, generator=g), random_poses(pairs, 2, generator=g)
    images = simulate_images(
        X, poses, camera, image_size=SIZE, noise=NOISE, outliers=1 - (1 - wrong) ** 0.5, dropout=0.1, generator=g
    )  # a match is wrong if either of its points is
    return *images.x.unbind(1), *images.x_true.unbind(1), images.visible.all(1), images.outlier.any(1)


x1, x2, y1, y2, visible, wrong = image_pairs(200, 150, wrong=0.4)
clock = time.perf_counter()
found = estimate_fundamental(x1, x2, threshold=1.5, mask=visible, generator=torch.Generator().manual_seed(1))
seconds = time.perf_counter() - clock
error = sampson_distance(found.model, y1, y2).median(-1).values
few, many = int(visible.sum(-1).min()), int(visible.sum(-1).max())
print(f"200 pairs, {few} to {many} matches each: {1000 * seconds / 200:.1f} ms a pair")
print(f"samples drawn: from {int(found.iterations.min())} to {int(found.iterations.max())}")
print(f"median error of exact points: {error.median():.2f} px; worst of the 200 pairs {error.max():.2f} px")
caught = (found.inliers & ~wrong)[visible].sum() / (~wrong)[visible].sum()
slipped = (found.inliers & wrong)[visible].sum() / wrong[visible].sum()
print(f"of the right matches {100 * caught:.0f} % are inliers, of the wrong ones {100 * slipped:.0f} %")

# %% [markdown]
# Some wrong matches are inliers: they happen to lie near their epipolar line. *F* cannot tell; a third view can.
#
# The threshold
# -------------
# Here are the distances of all matches from the estimated *F*. The right ones are within a few times the noise; the wrong
# ones are anywhere. A threshold separates them, if it is somewhere in the valley.

# %%
distance = sampson_distance(found.model, x1, x2)
fig, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
bins = torch.logspace(-2, 3, 60)
for chosen, label, color in ((~wrong & visible, "right", "tab:green"), (wrong & visible, "wrong", "tab:red")):
    axes[0].hist(distance[chosen], bins=bins, alpha=0.6, label=label, color=color)
axes[0].axvline(1.5, color="black", linestyle="--", label="threshold")
axes[0].set(xscale="log", xlabel="distance from the epipolar geometry [px]", ylabel="matches", title="Right and wrong matches")
axes[0].legend()

pairs = image_pairs(24, 150, wrong=0.45, seed=1)
thresholds = [0.5, 1.0, 4.0, 16.0, 32.0]


def errors_with(threshold: float, **options: object) -> torch.Tensor:
    """For each pair the median distance of exact points."""
    x1, x2, y1, y2, visible, _ = pairs
    F = estimate_fundamental(
        x1, x2, threshold=threshold, mask=visible, generator=torch.Generator().manual_seed(1), **options
    ).model
    return sampson_distance(F, y1, y2).median(-1).values


print("errors in pixels, of the median pair and of the worst one")
print(f"{'threshold':11s}" + "".join(f"{threshold:13g}" for threshold in thresholds))
for scoring in (InlierCount(), Msac(), Magsac()):
    name = type(scoring).__name__
    errors = torch.stack([errors_with(threshold, scoring=scoring) for threshold in thresholds])
    print(f"{name:11s}" + "".join(f"{error.median():8.2f}{error.max():5.2f}" for error in errors))
    axes[1].loglog(thresholds, errors.amax(1), "o-", label=f"{name}, worst pair")
    axes[1].loglog(thresholds, errors.median(1).values, "--", color=axes[1].lines[-1].get_color())
axes[1].axvline(NOISE, color="black", linestyle=":", label="noise")
axes[1].set(xlabel="threshold [px]", ylabel="error [px]", title="Too wide a threshold (dashed: the median pair)")
axes[1].set_xticks(thresholds, [f"{threshold:g}" for threshold in thresholds])
axes[1].set_yticks([0.1, 0.2, 0.5, 1, 2, 5], ["0.1", "0.2", "0.5", "1", "2", "5"])
axes[1].minorticks_off()
axes[1].legend()

# %% [markdown]
# Three ways to score a model. ``InlierCount`` counts, as in 1981: all within the threshold are equal, so with a wide
# threshold a crooked model is as good as a straight one. ``Msac`` adds squared distances, cut at the threshold: nearer is
# better. ``Magsac`` averages over all noise levels up to the threshold, and suffers least from one that is too wide. For
# the median pair even a threshold of 16 pixels costs ``Msac`` and ``Magsac`` little: the final fit finds the noise by
# itself. The worst pair tells the scores apart.
#
# **Exercise 2.** Try a threshold of 0.1, a fifth of the noise. How many samples are drawn, and why? *Hint:* by what count
# is the share of right matches judged?
#
# Confidence, and who is drawn
# ----------------------------
# The number of samples grows with the logarithm of the share of failures that is allowed. A better *sampler* saves them.
# Matchers give each match a score, such as the ratio of descriptor distances. ``Prosac`` draws from the best-scored matches
# first and admits the others little by little.

# %%
confidences = [0.5, 0.9, 0.99, 0.999, 0.9999]
shares = [0.2, 0.35, 0.5]
fig, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
x1, x2, y1, y2, visible, _ = image_pairs(24, 150, wrong=0.5, seed=2)
for confidence in confidences:
    found = estimate_fundamental(
        x1, x2, threshold=1.5, mask=visible, confidence=confidence, generator=torch.Generator().manual_seed(1)
    )
    failed = sampson_distance(found.model, y1, y2).median(-1).values > 2
    print(f"confidence {confidence:g}: {found.iterations.double().mean():6.0f} samples, {int(failed.sum())} of 24 pairs failed")
    axes[0].plot(-math.log10(1 - confidence), found.iterations.double().mean(), "o", color="tab:blue")
axes[0].set(xlabel="confidence", ylabel="samples drawn", title="Samples for a confidence (half are wrong)", ylim=(0, None))
axes[0].set_xticks([-math.log10(1 - c) for c in confidences], [f"{c:g}" for c in confidences])
for name, sampler in (("Uniform", Uniform()), ("Prosac", Prosac())):
    numbers = []
    for share in shares:
        x1, x2, _, _, visible, wrong = image_pairs(24, 150, wrong=share, seed=3)
        luck = torch.randn(wrong.shape, generator=torch.Generator().manual_seed(4))
        hint = luck + 1.0 * ~wrong  # higher for right matches, often
        found = estimate_fundamental(
            x1, x2, threshold=1.5, mask=visible, quality=hint, sampler=sampler, generator=torch.Generator().manual_seed(1)
        )
        numbers.append(float(found.iterations.double().mean()))
    print(f"{name:8s}" + "".join(f"{number:8.0f}" for number in numbers))
    axes[1].semilogy(shares, numbers, "o-", label=name)
axes[1].set(xlabel="share of wrong matches", ylabel="samples drawn", title="Scores of matches save samples")
axes[1].set_xticks(shares)
axes[1].legend()

# %% [markdown]
# No pair fails even at a confidence of one half. The formula takes a sample that is not clean for useless; local
# optimisation makes much of one that is nearly clean.
#
# **Exercise 3.** What does local optimisation buy? Limit ``max_iterations`` to 64, 128, 256 and compare the error with the
# best of as many samples as they are, ``soft_ransac(...).best()``. *Hint:* ``examples/ransac_variants.py``.
#
# **Exercise 4.** Give ``estimate_fundamental`` a threshold of 1000 pixels, or matches that are all wrong. What does
# ``found.status`` say?
#
# What autograd adds, first: the estimate has a derivative
# --------------------------------------------------------
# Drawing and choosing have no derivative. But the final fit is the optimum of a smooth function of the inliers, and an
# optimum has one (notebook 8 says how). A match that was rejected has no influence at all, which the gradient shows.

# %%
x1, x2, y1, y2, visible, wrong = image_pairs(1, 150, wrong=0.4, seed=5)
x1 = x1[0].clone().requires_grad_()
found = estimate_fundamental(x1, x2[0], threshold=1.5, mask=visible[0], generator=torch.Generator().manual_seed(1))
at = (visible[0] & ~wrong[0]).nonzero()[0]
distance = sampson_distance(found.model, y1[0, at], y2[0, at])  # how far F is off, at one exact match
(gradient,) = torch.autograd.grad(distance.sum(), x1)
influence = gradient.norm(dim=-1)
print(f"a match moves by a pixel, and F there by {influence[found.inliers].mean():.4f} px if it is an inlier, on average,")
print(f"                                         {influence[~found.inliers].max():.4f} px if it is not")

# %% [markdown]
# What autograd adds, second: learning whom to trust
# --------------------------------------------------
# A match comes with clues: how near the descriptors are, how much nearer than the second-best, how strong the corner is.
# Which of them tell right from wrong? Let a linear layer turn three clues into a *logit* for each match. A sample takes one
# match after the other, each with a probability proportional to exp(logit) among those that are left. The loss is how badly
# the chosen hypotheses fit exact points.
#
# ``soft_ransac`` makes this trainable in two ways at once. Hypotheses are scored softly and chosen with a softmax, so the
# choice has a derivative. And the *expectation* over the random samples has one, although a sample has none: if a sample
# lowered the loss, make its matches more probable (the score-function trick, ``SoftSelection.expectation`` does it with a
# baseline that keeps the noise low).


# %%
def clued_matches(pairs: int, seed: int) -> tuple[torch.Tensor, ...]:
    """Matches in units of 500 pixels around the middle, clues (pairs, matches, 3), and exact matches of other points."""
    x1, x2, y1, y2, visible, wrong = image_pairs(pairs, 100, wrong=0.6, seed=seed)
    g = torch.Generator().manual_seed(seed)
    right = (visible & ~wrong).double()
    noise = torch.randn(*right.shape, 3, generator=g)
    clues = torch.stack(
        (-0.8 * right + noise[..., 0], 0.8 * right + noise[..., 1], noise[..., 2]), -1
    )  # the third is worthless
    middle = torch.tensor([499.5, 374.5])
    x1, x2, y1, y2 = ((points - middle) / 500 for points in (x1, x2, y1, y2))
    return x1[:, :80], x2[:, :80], visible[:, :80], clues[:, :80], y1[:, 80:], y2[:, 80:]


def best_of_few(logits: torch.Tensor | None, data: tuple[torch.Tensor, ...]) -> float:
    """The median error in pixels of the best of 24 hypotheses."""
    x1, x2, visible, _, y1, y2 = data
    chosen = soft_ransac(
        FundamentalEstimator(), x1, x2, threshold=3 / 500, logits=logits, mask=visible, hypotheses=24,
        generator=torch.Generator().manual_seed(1),
    ).best()  # fmt: skip
    # A model is F and, in a fourth column, an epipole, which tells front from behind.
    return float(500 * sampson_distance(chosen[..., :3], y1, y2).median(-1).values.median())


def train(seed: int = 0, steps: int = 40) -> tuple[float, float, list[float], torch.Tensor]:
    """Learn to weigh the clues; the error of few samples without and with them, the losses, and the weights."""
    layer = torch.zeros(3, requires_grad=True)
    optimizer = torch.optim.Adam([layer], lr=0.12)
    losses = []
    for step in range(steps):
        x1, x2, visible, clues, y1, y2 = clued_matches(16, seed=1000 * seed + step + 1)
        chosen = soft_ransac(
            FundamentalEstimator(), x1, x2, threshold=3 / 500, logits=clues @ layer, mask=visible, hypotheses=48,
            generator=torch.Generator().manual_seed(1000 * seed + step),
        )  # fmt: skip
        error = 500 * sampson_distance(chosen.model[..., :3], y1[:, None, None], y2[:, None, None]).mean(-1)
        loss = chosen.expectation(torch.log1p(error)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    fresh = clued_matches(200, seed=1000 * seed)
    return best_of_few(None, fresh), best_of_few(fresh[3] @ layer.detach(), fresh), losses, layer.detach()


before, after, losses, weights = train()
print(f"best of 24 samples on new pairs: uniform {before:.1f} px, learned {after:.1f} px")
print(f"weights of the three clues: {weights.numpy().round(2)}")
fig, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
axes[0].plot(losses, color="tab:blue", alpha=0.4)
axes[0].plot(range(4, len(losses)), torch.tensor(losses).unfold(0, 5, 1).mean(-1), color="tab:blue", label="mean of five steps")
axes[0].set(xlabel="step", ylabel="expected log(1 + error / px)", title="Training through RANSAC")
axes[0].legend()
axes[1].bar(["descriptor\ndistance", "margin to the\nsecond best", "strength of\nthe corner"], weights)
axes[1].axhline(0, color="black", linewidth=0.8)
axes[1].set(title="What it learned", ylabel="weight in the logit")

# %% [markdown]
# Nobody told the layer which matches were right. It found the sign of both useful clues, that they are worth about the
# same, and that the third is worth nothing. The learned logits also serve ``estimate_fundamental`` as ``quality``, for
# ``Prosac`` to start from.
#
# **Exercise 5.** Replace the layer by a small network, and make a clue useful only when another one is high. *Hint:*
# ``examples/train_match_weights.py`` has the network.
#
# **Exercise 6.** Set ``temperature`` to 0.001 and to 1. Which loses the gradient, and which forgets to choose?
