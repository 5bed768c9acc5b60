"""Bundle adjustment of a growing model, of all of it or of the neighbourhood of new images."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust
from torchsfm.geometry import Camera
from torchsfm.optim import Cauchy
from torchsfm.reconstruction.mapping import Mapping

NEIGHBOURS = 8
"""Images that move along with new ones in a local adjustment."""

PRINCIPAL_POINT_SIGMA = 0.01
"""How far principal points lie from the middle of the image, as a fraction of its longer side."""
RADIAL_SIGMA = 0.3
TANGENTIAL_SIGMA = 0.01
"""How large the distortion parameters of lenses are."""


def adjust(
    mapping: Mapping,
    *,
    free: tuple[str, ...],
    expected: Camera | None = None,
    focal_sigma: float = 0.5,
    moving: Bool[Tensor, "v"] | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-5,
    loss_scale: float = 1.0,
) -> Mapping:
    """Minimise the robust reprojection error.

    Args:
        mapping: The model so far.
        free: Intrinsic parameters to adjust, by the names `bundle_adjust` knows. Held in a local adjustment.
        expected: What to expect of the cameras before any image point was seen: free parameters have Gaussian priors around
            it, wide enough to matter only where the images say little.
        focal_sigma: Standard deviation of the expected focal length, as a fraction.
        moving: Images whose poses move; the points they see move with them, everything else is held. All images when None.
        max_iterations: Limit on the steps of the optimiser.
        tolerance: Relative decrease of the cost at which it stops.
        loss_scale: Scale of the Cauchy loss in pixels.
    """
    node = mapping.observations()
    view, point = mapping.graph.view[node], mapping.point[node]
    fixed_poses = fixed_points = None
    if moving is not None:
        touched = torch.zeros(len(mapping.X), dtype=torch.bool)
        touched[point[moving[view]]] = True
        keep = touched[point]
        node, view, point = node[keep], view[keep], point[keep]
        fixed_poses, fixed_points, free = ~moving, ~touched, ()
    sigma = _prior_sigma(mapping, free, focal_sigma) if free and expected is not None else None
    result = bundle_adjust(
        mapping.poses,
        mapping.cameras,
        mapping.X,
        mapping.graph.x[node],
        view,
        point,
        camera_index=mapping.camera_index,
        free=free,
        fixed_poses=fixed_poses,
        fixed_points=fixed_points,
        loss=Cauchy(loss_scale),
        intrinsics_sigma=sigma,
        intrinsics_mean=expected,
        max_iterations=max_iterations,
        tolerance=tolerance,
    )
    if result.status == Status.INTERRUPTED:
        # There is more to do than this: let the interrupt through.
        raise KeyboardInterrupt
    return replace(mapping, poses=result.poses, cameras=result.cameras, X=result.X)


def _prior_sigma(mapping: Mapping, free: tuple[str, ...], focal_sigma: float) -> dict[str, float]:
    """Standard deviations of the priors in the unit of the observations' noise, which the cost takes to be one pixel."""
    node = mapping.observations()
    x, _ = mapping.project(mapping.point[node], mapping.graph.view[node])
    # The median of a Rayleigh distribution is 1.18 sigma.
    noise = max(float((x - mapping.graph.x[node]).norm(dim=-1).median()) / 1.18, 0.05)
    side = float(mapping.graph.image_size[mapping.registered].max())
    sigma = {
        "focal": focal_sigma,
        "principal_point": PRINCIPAL_POINT_SIGMA * side,
        "p1": TANGENTIAL_SIGMA,
        "p2": TANGENTIAL_SIGMA,
    }
    return {name: sigma.get(name, RADIAL_SIGMA) / noise for name in free}


def neighbourhood(mapping: Mapping, new: Bool[Tensor, "v"]) -> Bool[Tensor, "v"]:
    """The new images and the registered ones that share most points with them."""
    node = mapping.observations()
    view, point = mapping.graph.view[node], mapping.point[node]
    seen = torch.zeros(len(mapping.X), dtype=torch.bool)
    seen[point[new[view]]] = True
    shared = torch.bincount(view[seen[point]], minlength=len(new))
    shared[new] = 0
    closest = shared.topk(min(NEIGHBOURS, len(new))).indices
    moving = new.clone()
    moving[closest[shared[closest] > 0]] = True
    return moving
