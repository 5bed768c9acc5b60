"""Nothing known of the cameras: from image points alone to projective, then metric structure, with the tracks' own gaps.

The road of the affine shape (Sparr 1996; Heyden & Astrom 1996): depths, cameras and points together by factorisation, whatever
the coordinate systems of the images and the order of images and points; projective bundle adjustment; autocalibration, which
says how far the data determine the intrinsics. Then the same for cameras that only move sideways, which determine nothing.

    python examples/nothing_known.py
"""

import torch

from torchsfm import Status
from torchsfm.autocalibration import autocalibrate_points
from torchsfm.bundle import bundle_adjust_projective
from torchsfm.geometry import Camera, Pose, intrinsics, similarity_from_points
from torchsfm.motion import factorize_points
from torchsfm.simulation import random_points, random_poses, simulate_images

SIZE = (1200, 900)
FOCAL = 1000.0


def reconstruct(poses: Pose, X: torch.Tensor, title: str, generator: torch.Generator) -> None:
    """See the points, forget the cameras, and find both again."""
    camera = Camera(intrinsics(torch.tensor(FOCAL).double(), torch.tensor([620.0, 440.0]).double()))
    seen = simulate_images(X, poses, camera, image_size=SIZE, noise=0.5, generator=generator)
    visible = seen.visible & (torch.rand(seen.visible.shape, generator=generator) > 0.3)

    print(title)
    found = factorize_points(seen.x, visible=visible)
    first, last = found.proximity[[0, -1]].tolist()
    print(f"  factorisation: {Status(int(found.status)).name}, proximity {first:.1e} to {last:.1e}, {found.X.shape[0]} points")

    used = torch.isfinite(found.error)
    view, point = used.nonzero().unbind(-1)
    bundle = bundle_adjust_projective(found.P, found.X, seen.x[used], view, point)
    before, after = found.error[used].square().mean().sqrt(), bundle.residuals.square().mean().sqrt()
    print(f"  projective bundle: {before:.3f} px before, {after:.3f} px after")

    metric = autocalibrate_points(bundle.P, bundle.X, seen.x, image_size=SIZE, visible=used)
    print(f"  autocalibration: {Status(int(metric.status)).name}")
    if metric.status == Status.OK:
        f, cx, cy = metric.K[0, 0, 0], metric.K[0, 0, 2], metric.K[0, 1, 2]
        df, _, _, dx, dy = metric.deviation[0].tolist()
        print(f"  focal length {f:.1f} +- {df * f:.1f} px, true {FOCAL:.1f} px")
        print(f"  principal point ({cx:.1f}, {cy:.1f}) +- ({dx:.1f}, {dy:.1f}) px, true (620.0, 440.0) px")
        kept = found.used_point
        gap = similarity_from_points(metric.X[kept], X[kept]).transform(metric.X[kept]) - X[kept]
        print(f"  points: {gap.norm(dim=-1).median() / X.norm(dim=-1).median():.2%} of the scene's size off")


def main() -> None:
    """A motion that tells, and one that does not."""
    generator = torch.Generator().manual_seed(0)
    X = random_points(80, generator=generator)
    reconstruct(random_poses(12, generator=generator), X, "Twelve views from all around:", generator)
    sideways = torch.linspace(-1.5, 1.5, 12, dtype=torch.float64)
    t = torch.stack((sideways, torch.zeros(12).double(), torch.full((12,), 5.0).double()), -1)
    reconstruct(Pose(torch.eye(3).double().expand(12, 3, 3), t), X, "Twelve views, moving sideways:", generator)


if __name__ == "__main__":
    main()
