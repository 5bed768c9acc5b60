"""Between models and problems of bundle adjustment, which have no names, sizes and colours."""

from typing import Any

import torch

from torchsfm.geometry import BundleProblem
from torchsfm.reconstruction.reconstruction import Reconstruction

Model = Reconstruction | BundleProblem


def as_problem(model: Model) -> BundleProblem:
    """The members that count."""
    names: dict[str, Any] = {name: getattr(model, name) for name in BundleProblem.__dataclass_fields__}
    return BundleProblem(**names)


def as_reconstruction(model: Model) -> Reconstruction:
    """With names that are numbers, grey points, and images as large as their observations need."""
    if isinstance(model, Reconstruction):
        return model
    views = model.poses.shape[0]
    order = torch.argsort(model.point * views + model.view)
    size = torch.ones(views, 2, dtype=torch.int64)
    size.scatter_reduce_(0, model.view[:, None].expand(-1, 2), model.x.nan_to_num(0).ceil().long() + 1, "amax")
    return Reconstruction(
        tuple(f"{k:06d}" for k in range(views)),
        size,
        model.cameras,
        model.camera_index,
        model.poses,
        torch.ones(views, dtype=torch.bool),
        model.X,
        torch.full_like(model.X, 0.5),
        model.x[order],
        model.view[order],
        model.point[order],
    )
