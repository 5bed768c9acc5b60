"""From problems of bundle adjustment, which have no names, sizes and colours, to models."""

import torch

from torchsfm.geometry import BundleProblem
from torchsfm.reconstruction.model.reconstruction import Reconstruction


def as_reconstruction(model: BundleProblem) -> Reconstruction:
    """With names that are numbers, grey points, and images as large as their observations need; a model as it is."""
    if isinstance(model, Reconstruction):
        return model
    views = model.poses.shape[0]
    order = torch.argsort(model.point * views + model.view)
    size = torch.ones(views, 2, dtype=torch.int64)
    size.scatter_reduce_(0, model.view[:, None].expand(-1, 2), model.x.nan_to_num(0).ceil().long() + 1, "amax")
    return Reconstruction(
        names=tuple(f"{k:06d}" for k in range(views)),
        image_size=size,
        cameras=model.cameras,
        camera_index=model.camera_index,
        poses=model.poses,
        registered=torch.ones(views, dtype=torch.bool),
        X=model.X,
        color=torch.full_like(model.X, 0.5),
        x=model.x[order],
        view=model.view[order],
        point=model.point[order],
    )
