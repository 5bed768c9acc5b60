"""
1. Projection and cameras
=========================

A camera turns a point of space into a point of the image. This notebook takes the step apart: where the camera stands, what is
inside it, what a lens does, and how the image changes when the camera does. The last is a derivative, and PyTorch knows it.

*About 15 minutes. Reading: Hartley & Zisserman, chapters 6 to 8.*
"""

# %%
import math

import matplotlib.pyplot as plt
import torch

from torchsfm.geometry import (
    Camera,
    Pose,
    Radial,
    camera_centre,
    camera_from_krt,
    from_homogeneous,
    intrinsics,
    krt_from_camera,
    project_points,
    rotation_angle,
    rotation_from_rotvec,
    to_homogeneous,
)
from torchsfm.plot import plot_cameras, plot_points_2d, plot_points_3d, show_image
from torchsfm.simulation import look_at, render_sequence

torch.set_default_dtype(torch.float64)

# %% [markdown]
# One point, by hand
# ------------------
# The *pose* :math:`(R, t)` moves a point from the world to the camera, :math:`X_{cam} = R X + t`. The camera looks along
# its own z axis; x points right and y points down. Dividing by the depth gives a point on the plane at distance 1. The
# *intrinsics*
#
# .. math:: K = \begin{pmatrix} f & 0 & c_x \\ 0 & f & c_y \\ 0 & 0 & 1 \end{pmatrix}
#
# make pixels of it: *f* is the focal length in pixels, *c* the principal point, where the optical axis meets the image. In
# homogeneous coordinates all of it is one product, :math:`x \sim K [R \,|\, t]\, X`, where :math:`\sim` means equal up to
# scale.

# %%
width, height = 480, 360
K = intrinsics(torch.tensor(440.0), torch.tensor([(width - 1) / 2, (height - 1) / 2]))
pose = look_at(centre=torch.tensor([4.0, -4.2, 2.2]), target=torch.tensor([0.0, 0.0, 0.8]))
X = torch.tensor([-2.8, 2.8, 3.2])  # the upper corner of a courtyard

X_cam = pose.R @ X + pose.t
x = K @ X_cam
x = x[:2] / x[2]
print(f"in the camera: {X_cam.numpy().round(3)}, depth {X_cam[2]:.2f} m")
print(f"in the image:  {x.numpy().round(1)} pixels")

# %% [markdown]
# The library's ``project_points`` does the same for any number of points and any batch of cameras. *P* is the 3x4 camera
# matrix :math:`K [R \,|\, t]`.

# %%
P = camera_from_krt(K, pose.R, pose.t)
print(f"the library differs by {(project_points(P, X[None])[0] - x).abs().max():.1e} pixels")

# %% [markdown]
# A scene to look at
# ------------------
# The library renders photographs of a small courtyard, with the truth about every pixel. Here are two, by a camera without
# a lens. On the left the points it projected for us, over the first photograph; on the right the same points in space, and
# the two cameras: a pyramid is what a camera sees, a tick marks the upper edge of its image.

# %%
poses = Pose.stack([pose, look_at(torch.tensor([5.2, -1.0, 1.4]), torch.tensor([0.0, 0.3, 0.8]))])
seen = render_sequence(
    poses=poses, camera=Camera(K), width=width, height=height, points=1500, generator=torch.Generator().manual_seed(0)
)
fig = plt.figure(figsize=(11, 4.8), layout="constrained")
left, right = fig.add_subplot(1, 2, 1), fig.add_subplot(1, 2, 2, projection="3d")
show_image(seen.images[0], title="the first photograph, every fifth point projected", ax=left)
plot_points_2d(seen.x[0, ::5], visible=seen.visible[0, ::5], ax=left, color="cyan", markersize=4)
plot_points_3d(seen.X, color=seen.color.double(), ax=right)
plot_cameras(poses, Camera(K), names=["1", "2"], size=1.2, ax=right)
right.view_init(elev=35, azim=-60)
right.set_zlabel("z", labelpad=-5)
right.set_zticks(range(4))
right.set_title("the points in space, in metres")

# %% [markdown]
# What a camera matrix knows
# --------------------------
# *P* has twelve numbers, of which the scale is free. The *centre* of the camera is the only point it cannot project:
# :math:`P C = 0`. And *P* can be taken apart again. Its left 3x3 block is :math:`K R`, an upper triangular matrix times a
# rotation, which is an RQ decomposition.

# %%
C = camera_centre(P)
K_back, R_back, t_back = krt_from_camera(-7 * P)  # any multiple is the same camera
print(f"centre: {C.numpy().round(3)}, and P C = {(P @ to_homogeneous(C)).abs().max():.0e}")
print(
    f"taken apart: K off by {(K_back - K).abs().max():.0e}, R by {math.degrees(rotation_angle(R_back @ pose.R.mT)):.0e} degrees"
)

# %% [markdown]
# Vanishing points
# ----------------
# A direction *d* is a point at infinity, :math:`(d, 0)`. Its image, the *vanishing point*, is :math:`v \sim K R d`: where
# the camera stands does not matter. All lines of that direction meet there. The rows of bricks run along x, the other
# wall's foot along y, edges of walls along z.

# %%
directions = torch.eye(3)
v, _ = from_homogeneous((K @ pose.R @ directions).mT)  # and which of them are finite
starts = {
    "x": [(-2.8, 2.8, z) for z in (0.0, 1.0, 2.0, 3.2)],
    "y": [(-2.8, -5.5, z) for z in (0.0, 1.0, 2.0, 3.2)],
    "z": [(-2.8, 2.8, 0.0), (1.0, 2.8, 0.0), (-2.8, -1.5, 0.0)],
}
length = {"x": 8.5, "y": 8.3, "z": 3.2}
fig, ax = plt.subplots(figsize=(10, 5.2), layout="constrained")
show_image(seen.images[0], ax=ax)
for i, (name, color) in enumerate(zip("xyz", ("tab:red", "tab:green", "tab:blue"), strict=True)):
    for start in torch.tensor(starts[name]):
        ends = torch.stack((start, start + length[name] * directions[i]))
        inside = (pose.transform(ends)[:, 2] > 0.1).all()
        if inside:
            a, b = project_points(P, ends)
            ax.plot(*torch.stack((a, b)).T, color=color, linewidth=2)
            ax.plot(*torch.stack((a, v[i])).T, color=color, linewidth=0.6, linestyle="--")
    if name != "z":
        ax.plot(*v[i], "o", color=color)
        ax.annotate(f"vanishing point of {name}", v[i].tolist(), (0, 12), textcoords="offset points", color=color, ha="center")
ax.set(xlim=(-340, 780), ylim=(430, -80), title="Parallel lines meet in a vanishing point; that of z is far below")
for name, point in zip("xyz", v, strict=True):
    print(f"vanishing point of {name}: {point.numpy().round(1)} pixels")

# %% [markdown]
# **Exercise 1.** The vanishing points of x and y span the *horizon*. Compute it as a cross product of homogeneous points
# and draw it. Which points of the scene lie on it? *Hint:* they are as high as the camera, 2.2 m.
#
# **Exercise 2.** Two vanishing points of perpendicular directions tell the focal length, if the principal point is known:
# the rays :math:`K^{-1} v` are perpendicular. Write that out and solve for *f*. *Hint:* :math:`(v_1 - c)^T (v_2 - c) =
# -f^2`. You should find 440.

# %% [markdown]
# What a lens does
# ----------------
# A real lens bends straight lines, most near the border. The usual model moves a point at distance *r* from the optical
# axis (on the plane at depth 1) to the distance :math:`r\,(1 + k_1 r^2 + k_2 r^4)`. A negative :math:`k_1` is a barrel, a
# positive one a cushion. ``Camera`` holds intrinsics and distortion; ``unproject`` goes back, from pixels to rays, by
# solving the polynomial.

# %%
lens = Camera(K, Radial(torch.tensor(-0.25), torch.tensor(0.05)))
bent = render_sequence(
    poses=poses[:1], camera=lens, width=width, height=height, points=0, generator=torch.Generator().manual_seed(0)
)
wall = torch.stack(
    [torch.tensor([-2.8, 2.8, z]) + torch.linspace(0, 8.5, 60)[:, None] * directions[0] for z in (1.0, 2.0, 3.2)]
)
fig, axes = plt.subplots(1, 2, figsize=(11, 4.7), layout="constrained")
for ax, image, camera, title in ((axes[0], seen.images[0], Camera(K), "pinhole"), (axes[1], bent.images[0], lens, "barrel")):
    show_image(image, title=title, ax=ax)
    for row in wall:
        on = pose.transform(row)
        u = camera.project(on)[camera.in_domain(on)]
        ax.plot(*u.T, color="cyan", linewidth=1)
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))

grid = torch.cartesian_prod(torch.linspace(0, width - 1, 25), torch.linspace(0, height - 1, 19))
rays, known = lens.unproject(grid)
print(f"pixels to rays and back: {(lens.project(rays) - grid)[known].norm(dim=-1).max():.0e} pixels off")
corner = lens.project(Camera(K).unproject(torch.zeros(1, 2))[0])
print(f"the lens moves the corner of the image by {corner.norm():.1f} pixels")

# %% [markdown]
# How the image moves: derivatives
# --------------------------------
# Everything above is differentiable. A small motion has six numbers: a rotation vector *w* and a translation *v*, in the
# camera's own frame; ``pose.retract`` applies them. They move the world as the camera sees it: with *v* along z the world
# recedes, which is the same as a camera that walks backwards. ``torch.func.jacrev`` differentiates all image points by the
# six numbers at once. Each of the six columns is a *motion field*: how pixels move per unit of that motion.

# %%
shown = seen.X[seen.visible[0]][::4]


def image_after(motion: torch.Tensor) -> torch.Tensor:
    """Where the points are seen after the camera has moved a little."""
    return Camera(K).project(pose.retract(motion).transform(shown))


J = torch.func.jacrev(image_after)(torch.zeros(6))  # (points, 2, 6)
at = image_after(torch.zeros(6))
depth = pose.transform(shown)[:, 2]
fig, axes = plt.subplots(2, 3, figsize=(11, 5.8), layout="constrained", sharex=True, sharey=True)
titles = [f"{kind} {axis}" for kind in ("turn about", "move along") for axis in "xyz"]
for i, (ax, title) in enumerate(zip(axes.flat, titles, strict=True)):
    arrows = ax.quiver(*at.T, *J[..., i].T, depth, angles="xy", cmap="viridis", width=0.004)
    ax.set(title=title, xlim=(0, width), ylim=(height, 0), aspect="equal")
fig.colorbar(arrows, ax=axes, label="depth in metres")
fig.suptitle("Motion fields: the columns of the Jacobian (arrows scaled panel by panel)")

# %% [markdown]
# Look at the colours. In the upper row they do not matter: when the camera *turns*, near and far points move alike, so a
# turning camera tells nothing of depth. When it *moves*, near points (dark) move most. All of structure from motion lives
# on that difference. The two numbers below say it without a picture: the correlation of inverse depth with the length of
# the arrows.

# %%
lengths = J.norm(dim=1)
for i, title in ((1, titles[1]), (3, titles[3])):
    correlation = torch.corrcoef(torch.stack((1 / depth, lengths[:, i])))[0, 1]
    print(f"{title}: correlation of arrows with 1 / depth {correlation:.3f}")

# %% [markdown]
# What autograd adds: a camera finds its place
# --------------------------------------------
# Where was the photograph taken? Guess a pose, see how far the projections are off, and improve it: with the Jacobian, the
# best small motion is a linear least squares problem (Gauss-Newton). Six lines replace pages of hand-made derivatives. The
# guess is half a metre and eight degrees off.

# %%
measured = Camera(K).project(pose.transform(shown)) + 0.5 * torch.randn(
    len(shown), 2, generator=torch.Generator().manual_seed(1)
)
guess = pose.retract(torch.tensor([0.1, -0.08, 0.05, 0.3, -0.2, 0.35]))
for step in range(6):

    def residual(motion: torch.Tensor, guess: Pose = guess) -> torch.Tensor:
        """Reprojection errors, two for each point."""
        return (Camera(K).project(guess.retract(motion).transform(shown)) - measured).flatten()

    r = residual(torch.zeros(6))
    print(
        f"step {step}: rms error {r.square().mean().sqrt():10.4f} px, centre off by {(guess.centre - pose.centre).norm():.4f} m"
    )
    J = torch.func.jacrev(residual)(torch.zeros(6))
    guess = guess.retract(torch.linalg.lstsq(J, -r[:, None]).solution[:, 0])

# %% [markdown]
# The error stops at half a pixel: that is the noise we added, and the centre is known to two millimetres. Three steps
# suffice: the nearer the minimum, the better the linear problem is. Notebook 7 asks the same question without a guess, and
# notebook 8 for all cameras and points together.
#
# **Exercise 3.** Let the focal length be unknown as well: seven numbers instead of six. *Hint:* ``motion[6]`` scales
# ``K[:2, :2]``; build the new *K* with ``intrinsics``. How much less well is the centre then known?
#
# **Exercise 4.** The *dolly zoom*: walk backwards from the ball near the origin and lengthen *f* so that the ball keeps its
# size. Render three such images with ``render_sequence``. *Hint:* size in the image is *f* / depth. What happens to the
# wall behind?
#
# **Exercise 5.** ``rotation_from_rotvec`` turns a vector into a rotation. Check with ``torch.func.jacrev`` that its
# derivative at zero is made of the three cross-product matrices.

# %%
generators = torch.func.jacrev(rotation_from_rotvec)(torch.zeros(3))  # entry [i, j, k]: dR_ij / dw_k
print(generators[..., 2].numpy())  # the turn about z: what does it do to (1, 0, 0)?
