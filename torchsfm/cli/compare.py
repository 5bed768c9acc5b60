"""`torchsfm compare`: how far a model is from the truth, whatever its frame and scale."""

import math
from pathlib import Path, PurePosixPath
from typing import Annotated

import torch
import typer
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.cli.export import load
from torchsfm.cli.job import Job, UserError, told
from torchsfm.geometry import Pose
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.messages import printable
from torchsfm.reconstruction.model.evaluation import pose_auc, pose_errors, position_rmse

THRESHOLDS = (1.0, 2.0, 5.0)
"""Degrees up to which the area under the curve of errors is taken."""


def compare(
    model: Annotated[
        Path, typer.Argument(help="Folder written by `torchsfm reconstruct`, or a model of any format.", show_default=False)
    ],
    truth: Annotated[
        Path, typer.Argument(help="A model of any format with the true poses of the same images.", show_default=False)
    ],
) -> None:
    """Compare the cameras of a model with true ones: pose AUC, position error, and the error of each image.

    Images are the same that have the same name, or, where no names are the same, the same name without folder and ending. Those
    of the truth that the model has no pose for count as wrong.
    """
    with told(Job(model)) as job:
        found, wanted = (load(path).to("cpu", torch.float64) for path in (model, truth))
        posed = wanted.registered.nonzero()[:, 0]
        names = [wanted.names[i] for i in posed.tolist()]
        place = same_images(found, names)
        known = place >= 0
        if int(known.sum()) < 2:
            raise UserError(
                f"{model}: has a pose for {int(known.sum())} of the {len(names)} images of {truth}, two are the least"
                f" (it has {printable(next(iter(found.names), 'none'))!r}, the truth {printable(next(iter(names), 'none'))!r})"
            )
        place = place.clamp(min=0)
        poses, poses_true = found.poses[place], wanted.poses[posed]
        K, K_true = (one.cameras.K[one.camera_index[i]] for one, i in ((found, place), (wanted, posed)))
        errors = pose_errors(poses, poses_true, known)
        typer.echo(f"{int(known.sum())} of {len(names)} images have a pose")
        for key, words in true_errors(poses, known, K, poses_true, K_true).items():
            typer.echo(f"{key}: {words}")
        width = max(len(printable(name)) for name in ("image", *names))
        typer.echo(f"\n{'image':<{width}}  rotation, deg    position  focal, found / true")
        rows = []
        columns = (names, known.tolist(), errors.image_rotation.tolist(), errors.image_position.tolist())
        for i, (name, there, rotation, position) in enumerate(zip(*columns, strict=True)):
            focal, focal_true = float(K[i, 0, 0]), float(K_true[i, 0, 0])
            words = f"{rotation:>13.4f}  {position:>10.5g}  {focal:.2f} / {focal_true:.2f}" if there else "not registered"
            typer.echo(f"{printable(name):<{width}}  {words}")
            row = {"name": name, "registered": there, "rotation_error_deg": rotation, "position_error": position}
            rows.append(row | {"focal": focal if there else None, "focal_true": focal_true})
        auc = pose_auc(errors.pose, THRESHOLDS).tolist()
        job.voice.record.update(
            auc={f"{limit:g}": area for limit, area in zip(THRESHOLDS, auc, strict=True)},
            position_rmse=float(position_rmse(poses, poses_true, known)),
            registered=int(known.sum()), images_of_truth=len(names), images=rows,
        )  # fmt: skip


def same_images(model: Reconstruction, names: list[str]) -> Int[Tensor, "n"]:
    """Which image of a model each name is, of those that have a pose; -1 where none is."""
    posed = [(name, i) for i, name in enumerate(model.names) if bool(model.registered[i])]
    for short in (lambda name: name, lambda name: PurePosixPath(name.replace("\\", "/")).stem):
        mine = [short(name) for name, _ in posed]
        place = {key: i for key, (_, i) in zip(mine, posed, strict=True) if mine.count(key) == 1}
        theirs = [short(name) for name in names]
        found = [place.get(key, -1) if theirs.count(key) == 1 else -1 for key in theirs]
        if any(i >= 0 for i in found):
            break
    return torch.tensor(found, dtype=torch.long)


def true_errors(
    poses: Pose, registered: Bool[Tensor, "v"], K: Float[Tensor, "v 3 3"], poses_true: Pose, K_true: Float[Tensor, "v 3 3"]
) -> dict[str, str]:
    """True errors of poses and cameras, in words."""
    errors = pose_errors(poses, poses_true, registered)
    focal, focal_true = K[:, 0, 0][registered], K_true[:, 0, 0][registered]
    rotation = errors.image_rotation[registered]
    both = torch.isfinite(errors.pose)
    rmse = float(position_rmse(poses, poses_true, registered))
    distance = torch.pdist(poses_true.centre).max().item()
    areas = ", ".join(f"{area:.3f}" for area in pose_auc(errors.pose, THRESHOLDS).tolist())
    share = f"{100 * rmse / distance:.3f} %" if distance > 0 else "all true cameras are at one place"
    words = {
        "rotation error, mean / largest": f"{rotation.mean():.4f} / {rotation.max():.4f} deg",
        "relative rotation of pairs, median": f"{errors.rotation[both].median():.4f} deg" if both.any() else "no pairs",
        "direction of baselines, median": f"{errors.direction[both].median():.4f} deg" if both.any() else "no pairs",
        "position error (RMS), of the largest distance between cameras": share,
        "focal length, found / true": f"{focal.mean():.2f} / {focal_true.mean():.2f} px",
        "focal length error": f"{100 * ((focal - focal_true).abs() / focal_true).mean():.3f} %",
        "pose AUC at 1, 2, 5 deg": areas,
    }
    return {key: value for key, value in words.items() if not math.isnan(rmse)}
