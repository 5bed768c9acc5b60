"""
4. Minimal solvers and their gradients
======================================

A minimal solver takes as few measurements as the problem has unknowns, and finds all solutions there are. It is a polynomial
system in disguise: seven points give one or three fundamental matrices, five rays up to ten essential ones. We solve the first
by hand, count solutions of thousands of problems at once, and then ask for derivatives: what goes wrong if you differentiate
the solver, what the implicit function theorem does instead, and where no derivative exists.

*About 20 minutes. Reading: Hartley & Zisserman, 11.1.2; Nistér 2004 for five points.*
"""

# %%
import math

import matplotlib.pyplot as plt
import torch

from torchsfm.geometry import Camera, intrinsics, sampson_distance, to_homogeneous
from torchsfm.motion import essential_5pt, fundamental_7pt
from torchsfm.simulation import random_points, random_poses, simulate_images
from torchsfm.tensors import essential_from_pose, fundamental_from_essential

torch.set_default_dtype(torch.float64)

# %% [markdown]
# Counting
# --------
# ============================ ========= ==================== ====== =========
# model                        unknowns  equations per point  points solutions
# ============================ ========= ==================== ====== =========
# homography                   8         2                    4      1
# fundamental matrix           7         1                    7      1 or 3
# essential matrix             5         1                    5      up to 10
# pose from known points (P3P) 6         2                    3      up to 4
# ============================ ========= ==================== ====== =========
#
# Why bother, when eight points give *F* by a linear system? Because of wrong matches. If half of the matches are wrong, a
# sample of seven is clean with probability :math:`2^{-7}`, one of eight with :math:`2^{-8}`: twice the work. And a minimal
# solver does not average: it meets its equations exactly.
#
# Seven points by hand
# --------------------
# Each match gives one linear equation in the nine entries of *F*. Seven of them leave a two-dimensional null space,
# :math:`F = (1 - a) F_1 + a F_2`. The last condition, :math:`\det F = 0`, is a cubic in *a*. Four values of it are enough
# to know it.

# %%
size, camera = (1000, 750), Camera(intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])))


def matches(problems: int, count: int, seed: int, noise: float = 0.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Matches of pairs of random views, in units of 500 pixels around the middle of the image, and the true E."""
    g = torch.Generator().manual_seed(seed)
    X, poses = random_points(problems, count, generator=g), random_poses(problems, 2, generator=g)
    images = simulate_images(X, poses, camera, image_size=size, noise=noise, generator=g)
    x = (images.x_true + (images.x - images.x_true) * images.visible[..., None] - camera.K[:2, 2]) / 500
    motion = poses[:, 1] @ poses[:, 0].inverse()
    return x[:, 0], x[:, 1], essential_from_pose(motion.R, motion.t)


def epipolar_rows(x1: torch.Tensor, x2: torch.Tensor) -> torch.Tensor:
    """One row of nine for each match, so that row @ F.flatten() = x2' F x1."""
    return (to_homogeneous(x2)[..., :, None] * to_homogeneous(x1)[..., None, :]).flatten(-2)


def null_by_svd(A: torch.Tensor) -> torch.Tensor:
    """Two unit vectors that span the null space of A, (..., 2, 9)."""
    return torch.linalg.svd(A).Vh[..., -2:, :]


def seven_by_hand(x1: torch.Tensor, x2: torch.Tensor, null=null_by_svd) -> torch.Tensor:
    """All real F of one problem."""
    F1, F2 = null(epipolar_rows(x1, x2)).unflatten(-1, (3, 3))
    at = torch.tensor([-1.0, 0.0, 1.0, 2.0])
    values = torch.linalg.det((1 - at)[:, None, None] * F1 + at[:, None, None] * F2)
    c = torch.linalg.solve(torch.vander(at, increasing=True), values)  # c0 + c1 a + c2 a^2 + c3 a^3
    companion = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    companion[:, 2] = -(c[:3] / c[3]).detach()
    roots = torch.linalg.eigvals(companion)
    a = roots.real[roots.imag.abs() < 1e-9]
    a = a - (c[0] + a * (c[1] + a * (c[2] + a * c[3]))) / (c[1] + a * (2 * c[2] + a * 3 * c[3])).detach()  # a Newton step
    F = (1 - a)[:, None, None] * F1 + a[:, None, None] * F2
    return F / torch.linalg.matrix_norm(F, keepdim=True)


x1, x2, _ = matches(200, 7, seed=0)
library = fundamental_7pt(x1, x2)
print("the library's shapes: model", tuple(library.model.shape), "valid", tuple(library.valid.shape))
worst = 0.0
for i in range(50):
    mine, theirs = seven_by_hand(x1[i], x2[i]), library.model[i][library.valid[i]]
    alignment = (mine.flatten(1) @ theirs.flatten(1).mT).abs()  # unit matrices, either sign
    assert len(mine) == len(theirs)
    worst = max(worst, float((1 - alignment.max(1).values).max()))
print(f"fifty problems: as many solutions as by hand, and the same but for {worst:.0e}")

fig, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
angle = torch.linspace(0, math.pi, 400)
for ax, number, example in ((axes[0], 1, 2), (axes[1], 3, 8)):  # not those where the curve nearly touches zero
    i = int((library.valid.sum(-1) == number).nonzero()[example])
    F1, F2 = null_by_svd(epipolar_rows(x1[i], x2[i])).unflatten(-1, (3, 3))
    value = torch.linalg.det(angle.cos()[:, None, None] * F1 + angle.sin()[:, None, None] * F2)
    ax.plot(angle, value / value.abs().max())
    own = library.model[i][library.valid[i]].flatten(1)
    place = torch.atan2(own @ F2.flatten(), own @ F1.flatten()) % math.pi
    ax.plot(place, torch.zeros(len(place)), "o", color="tab:red", label="fundamental_7pt")
    ax.axhline(0, color="black", linewidth=0.6)
    ax.set(
        title=f"{number} real solution{'s' * (number > 1)}",
        xlabel="angle in the null space: cos F1 + sin F2",
        ylabel="determinant",
    )
    ax.legend()

# %% [markdown]
# How many solutions?
# -------------------
# Solvers return ``Solutions``: a fixed number of slots, and ``valid``, which says in which of them a solution stands. So
# any batch has one shape, and counting is one line. Four thousand problems of each kind, with exact data: is the true
# matrix always among the solutions?

# %%
x1, x2, E_true = matches(4000, 7, seed=1)
rays = [to_homogeneous(x * 500 / 900) for x in (x1, x2)]
seven, five = fundamental_7pt(x1, x2), essential_5pt(*(d[:, :5] for d in rays))
K = torch.diag(torch.tensor([900 / 500, 900 / 500, 1.0]))
fig, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
for ax, name, found, true in (
    (axes[0], "seven points", seven, fundamental_from_essential(E_true, K, K)),
    (axes[1], "five rays", five, E_true),
):
    near = (found.model.flatten(2) * true.flatten(1)[:, None]).sum(-1).abs()
    near = near / found.model.flatten(2).norm(dim=-1) / true.flatten(1).norm(dim=-1)[:, None]
    recall = (((1 - near) < 1e-8) & found.valid).any(-1).double().mean()
    number = found.valid.sum(-1)
    print(f"{name}: {number.double().mean():.2f} solutions on average, the true one among them in {100 * recall:.2f} %")
    share = torch.bincount(number, minlength=found.valid.shape[-1] + 1) / len(number)
    ax.bar(range(len(share)), share)
    ax.set(title=name, xlabel="number of real solutions", ylabel="share of problems", xticks=range(len(share)))

# %% [markdown]
# Complex solutions come in pairs, so the numbers are odd for seven points (a cubic) and even for five (degree ten).
#
# **Exercise 1.** How do you choose among them? *Hint:* with one more match. What does ``sampson_distance`` of the eighth
# point say for each solution? This is what RANSAC does, with hundreds of matches.
#
# Gradients, the easy way
# -----------------------
# PyTorch differentiates ``torch.linalg.svd``, ``torch.linalg.eigh`` and so on. So why not differentiate the solver by hand
# as it stands? The Newton step at its end lets the derivative of the root through. Two common ways to the null space, and
# as the reference the library's derivative, which the next section explains:


# %%
def null_by_eigh(A: torch.Tensor) -> torch.Tensor:
    """The same from the eigenvectors of A'A, as many published layers do."""
    return torch.linalg.eigh(A.mT @ A).eigenvectors[..., :2].mT


x1, x2, _ = matches(200, 7, seed=0)
probe = torch.arange(9.0)  # any function of F will do: a weighted sum of its entries
for name, null in (("svd", null_by_svd), ("eigh", null_by_eigh)):
    errors, size_of_gradient = [], []
    for i in range(60):
        z = x1[i].clone().requires_grad_()
        library = fundamental_7pt(z, x2[i])
        for F in seven_by_hand(z, x2[i], null):
            alike = library.model.detach().flatten(1) @ F.detach().flatten()
            k = int((alike.abs() * library.valid).argmax())
            (mine,) = torch.autograd.grad(alike[k].sign() * (F.flatten() @ probe), z, retain_graph=True)
            (right,) = torch.autograd.grad(library.model[k].flatten() @ probe, z, retain_graph=True)
            errors.append((mine - right).norm() / right.norm())
            size_of_gradient.append(mine.norm())
    errors, size_of_gradient = torch.stack(errors), torch.stack(size_of_gradient)
    print(
        f"through {name:4s}: median |gradient| {size_of_gradient.median():.1e}, "
        f"relative error: median {errors.median():.0e}, largest {errors.max():.0e}"
    )

# %% [markdown]
# Through the *svd* the gradient is zero: *A* has seven rows, and PyTorch gives no derivative to the right singular vectors
# beyond the seventh. Nothing warns; a network behind it would just not learn. Through *eigh* the two eigenvalues are
# zero, equal up to rounding. The derivative of an eigenvector divides by their difference; zero over zero happens to cancel
# in *F*, but digits are lost, and where the eigenvalues come out equal it is NaN. The null *space* is well determined, its
# basis is not. The way out is not to look inside the solver at all.
#
# Gradients, the right way
# ------------------------
# A solution satisfies its defining equations, whatever road led there: seven epipolar equations, :math:`\det F = 0` and
# :math:`|F|^2 = 1`. Nine equations :math:`g(F, x) = 0` in nine unknowns. Move *x* a little, and *F* must move so that they
# still hold:
#
# .. math:: \frac{\partial g}{\partial F}\, dF + \frac{\partial g}{\partial x}\, dx = 0
#    \quad\Longrightarrow\quad \frac{dF}{dx} = -\left(\frac{\partial g}{\partial F}\right)^{-1} \frac{\partial g}{\partial x}.
#
# That is the *implicit function theorem*. It needs the equations and one linear system, at the solution, and not one line
# of the solver. Autograd provides both Jacobians.

# %%


def equations(f: torch.Tensor, x1: torch.Tensor, x2: torch.Tensor) -> torch.Tensor:
    """Zero for a solution: nine equations in the nine entries of F."""
    return torch.cat((epipolar_rows(x1, x2) @ f, torch.stack((f.unflatten(0, (3, 3)).det(), f @ f - 1))))


z1, z2, _ = matches(1, 7, seed=5)
z1 = z1[0].clone().requires_grad_()
found = fundamental_7pt(z1, z2[0])
slot = int(found.valid.nonzero()[0])
f = found.model[slot].detach().flatten()
dg_df = torch.func.jacrev(equations, argnums=0)(f, z1.detach(), z2[0])
dg_dx = torch.func.jacrev(equations, argnums=1)(f, z1.detach(), z2[0]).flatten(1)
by_hand = -torch.linalg.solve(dg_df, dg_dx)  # (9, 14)

library_jacobian = torch.stack(
    [torch.autograd.grad(entry, z1, retain_graph=True)[0].flatten() for entry in found.model[slot].flatten()]
)
step = 1e-6
numeric = []
for k in range(14):
    nudge = torch.zeros(14)
    nudge[k] = step
    ends = [fundamental_7pt(z1.detach() + sign * nudge.view(7, 2), z2[0]).model[slot].flatten() for sign in (1, -1)]
    ends = [end * (end @ f).sign() for end in ends]  # F and -F are the same solution
    numeric.append((ends[0] - ends[1]) / (2 * step))
numeric = torch.stack(numeric, 1)
scale = by_hand.norm()
print(f"|dF/dx| = {scale:.1f}")
print(f"by hand against the library: {(by_hand - library_jacobian).norm() / scale:.0e}")
print(f"by hand against finite differences: {(by_hand - numeric).norm() / scale:.0e}")

# %% [markdown]
# Every minimal solver of the library works like this: its file states ``equations`` once, and they serve for the last
# digits of the value, for the derivative and for the tests. See ``torchsfm.optim.attach_implicit`` to do the same with a
# solver of your own.
#
# Where solutions meet
# --------------------
# Three solutions become one when two of them meet and turn complex. Let one image point move along a straight path, and
# follow the solutions. Where two meet, :math:`\partial g / \partial F` is singular, and the derivative grows without bound:
# no method could give one, because there is none.

# %%
x1, x2, _ = matches(60, 7, seed=1)
path = torch.linspace(-1, 1, 801)


def along(i: int, s: torch.Tensor) -> torch.Tensor:
    """Problem i, its first point moved to the right by s."""
    shift = torch.zeros(7, 2)
    shift[0, 0] = 1.0
    return x1[i] + s[..., None, None] * shift


number = torch.stack([fundamental_7pt(along(i, path), x2[i : i + 1]).valid.sum(-1) for i in range(60)])
changes = (number[:, 1:] != number[:, :-1]).sum(1)
three = (number == 3).sum(1)
i = int((changes * ((three > 200) & (three < 600))).argmax())  # one with folds well inside
s = path.clone().requires_grad_()
found = fundamental_7pt(along(i, s), x2[i : i + 1])
e2 = torch.linalg.svd(found.model.detach()).U[..., -1]  # the left null vector: an epipole
height = torch.atan2(e2[..., 1], e2[..., 0]) % math.pi  # its direction, one number to draw
entries = found.model.flatten(2).sum(0)  # every place depends on its own shift alone: one sum gives all derivatives
derivatives = [[torch.autograd.grad(entry, s, retain_graph=True)[0] for entry in slot] for slot in entries]
speed = torch.stack([torch.stack(slot).norm(dim=0) for slot in derivatives], 1)  # |dF / ds|, (places, slots)

fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
for k, color in enumerate(("tab:blue", "tab:orange", "tab:green")):
    there = found.valid[:, k]
    left.plot(path[there], height[there, k], ".", markersize=3, color=color, label=f"slot {k}")
    right.semilogy(path[there], speed[there, k].abs(), ".", markersize=3, color=color, label=f"slot {k}")
left.set(
    title="Solutions as a point moves: folds",
    xlabel="shift of the point [500 px]",
    ylabel="direction of the epipole [rad, modulo π]",
)
right.set(title="Their derivative by autograd", xlabel="shift of the point [500 px]", ylabel="|dF / d shift|")
left.legend()
number = found.valid.sum(-1)
change = (number[1:] != number[:-1]).nonzero()[:, 0]
beside = torch.maximum(speed[change], speed[change + 1]).amax(-1)
print(f"problem {i}: three solutions along {100 * (number == 3).double().mean():.0f} % of the path")
print(f"|dF/ds| is typically {speed[found.valid].median():.1f}, beside the folds {beside.min():.0f} to {beside.max():.0f}")

# %% [markdown]
# Slots are filled in no order, so the colours change along a curve. In empty slots the derivative is exactly zero, and
# never NaN: a batch in which one problem is degenerate trains on.
#
# **Exercise 2.** Near a fold the derivative grows like one over the square root of the distance. Fit the slope in a plot
# with both axes logarithmic. *Hint:* :math:`y^2 = x` has the derivative :math:`1 / (2 \sqrt x)`.
#
# What autograd adds: a camera calibrated through the five-point solver
# ---------------------------------------------------------------------
# The five-point solver needs rays, so a focal length. Suppose it is unknown. With the wrong one, the essential matrix of
# five matches fits the other matches badly. So: draw samples of five from several image pairs, solve all in one batch, keep
# the best solution of each, measure how well it fits the other matches, and follow the gradient back through the solver to
# the focal length.


# %%
def calibrate(seed: int = 0, noise: float = 0.1, steps: int = 40, show: bool = False) -> float:
    """The focal length in pixels (900 is true) found from 16 image pairs with a tenth of a pixel of noise."""
    x1, x2, _ = matches(16, 40, seed=seed, noise=noise)
    g = torch.Generator().manual_seed(seed)
    log_focal = torch.tensor(math.log(600 / 500), requires_grad=True)
    optimizer = torch.optim.Adam([log_focal], lr=0.05)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        index = torch.rand(16, 12, 40, generator=g).argsort(-1)[..., :5]  # 12 samples of five from each pair
        sample = [torch.gather(x[:, None].expand(-1, 12, -1, -1), 2, index[..., None].expand(-1, -1, -1, 2)) for x in (x1, x2)]
        K = intrinsics(log_focal.exp(), torch.zeros(2))
        E = essential_5pt(*(to_homogeneous(x / log_focal.exp()) for x in sample))
        F = fundamental_from_essential(E.model, K, K)
        error = 500 * sampson_distance(F, x1[:, None, None], x2[:, None, None])  # pixels, (pair, sample, slot, match)
        error = torch.where(E.valid, error.square().clamp(max=25.0).mean(-1), 25.0)
        loss = error.amin(-1).log().mean()  # the best solution of every sample
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if show and step % 10 == 0:
            print(f"step {step:2d}: loss {loss.item():.3f}, focal length {500 * log_focal.exp().item():.0f}")
    return 500 * float(log_focal.detach().exp())


print(f"found {calibrate(show=True):.0f} px, true 900 px")

# %% [markdown]
# **Exercise 3.** Raise the noise to half a pixel, with a few seeds. The answer becomes too long, by two to twelve percent. Why?
# *Hint:* five noisy matches are met exactly whatever the focal length; only the others tell.
#
# **Exercise 4.** ``torchsfm.motion.relative_6pt_focal`` has the focal length as an unknown of the solver: six points, up to
# fifteen solutions. Take the median over many samples. Which is nearer to 900?
#
# **Exercise 5.** Let the two cameras of a pair have different focal lengths. For which motions can the loss not tell?
# *Hint:* optical axes that meet, or are parallel.
