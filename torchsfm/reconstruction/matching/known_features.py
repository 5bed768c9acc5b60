"""The features of photographs that are not at hand: what an earlier run saved of them, or another program."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.matching.image_points import camera_label
from torchsfm.reconstruction.messages import ReconstructionError
from torchsfm.reconstruction.model.files import load_arrays
from torchsfm.reconstruction.model.reconstruction import Reconstruction

SAME = 0.1
"""Pixels within which an observation of a model is a feature."""
SHARE = 0.9
"""The least share of a model's observations that must be features, if these are the model's."""
BLOCK = 1024
"""Observations compared at once with all features of their image."""


@dataclass(frozen=True)
class KnownFeatures:
    """Features of images that need not be at hand.

    Attributes:
        names: File names of the images.
        x: Places of the features of each, pixels, the centre of the top-left pixel at (0, 0).
        descriptors: What they look like: RootSIFT times 256 as uint8, as `detect_features` makes them.
        labels: What the files say of the camera, empty where nothing is known.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(4, 50, 150, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> x = tuple(model.x[model.view == i].float() for i in range(4))  # where features of each image are
        >>> descriptors = tuple(torch.randint(0, 256, (len(part), 128), generator=g, dtype=torch.uint8) for part in x)
        >>> known = torchsfm.reconstruction.KnownFeatures(model.names, x, descriptors, ("",) * 4)
        >>> len(known.names), sum(map(len, known.descriptors))
        (4, 150)
    """

    names: tuple[str, ...]
    x: tuple[Float[Tensor, "_ 2"], ...]
    descriptors: tuple[Shaped[Tensor, "_ d"], ...]
    labels: tuple[str, ...]


@on_the_cpu
def saved_features(folder: str | Path, model: Reconstruction) -> KnownFeatures | None:
    """The features that a run into a folder saved of the photographs of its model; None where there are none.

    Args:
        folder: What was the folder of the results of `torchsfm reconstruct`, or `out` of `reconstruct`.
        model: Its model, whose images are those that could be read, in their order.

    Raises:
        ReconstructionError: What is there is damaged, or belongs to other photographs.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> files = torchsfm.render_sequence(views=3, width=320, height=240, generator=g).save("photos")
        >>> model = torchsfm.reconstruct("photos", out="run").model
        >>> known = torchsfm.reconstruction.saved_features("run", model)
        >>> len(known.x), known.names == model.names
        (3, True)
    """
    paths = sorted((Path(folder) / "stages" / "features").glob("*.npz"))
    if not paths:
        return None
    x, descriptors, labels, sizes = list[Tensor](), list[Tensor](), list[str](), list[list[int]]()
    for path in paths:
        try:
            shard: dict[str, Any] = {
                key: torch.from_numpy(value) for key, value in load_arrays(path).items() if key != "fingerprint"
            }
            counts = shard["count"].tolist()
            x += torch.split(shard["x"], counts)
            descriptors += [shard[f"descriptors-{k}"] for k in range(len(counts))]
            sizes += shard["size"].tolist()
            records = bytes(shard["records"].numpy()).decode("utf-8", "surrogateescape").split("\0")
            labels += [record for record, good in zip(records, shard["readable"].tolist(), strict=True) if good]
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            raise ReconstructionError(f"{path}: not the features of a run ({error})") from None
    if len(x) != len(model.names) or sizes != model.image_size.tolist():
        raise ReconstructionError(f"{folder}: the features that are saved there are of other photographs than the model's")
    known = tuple(camera_label(name, record) for name, record in zip(model.names, labels, strict=True))
    return KnownFeatures(model.names, tuple(x), tuple(descriptors), known)


def observed_features(model: Reconstruction, x: Sequence[Float[Tensor, "_ 2"]]) -> Int[Tensor, "m"]:
    """Which feature of its image each observation of a model is; -1 where there is none.

    Args:
        model: The model.
        x: The features of each of its images.

    Raises:
        ReconstructionError: They are of other photographs: few of the observations are features.
    """
    found = torch.full((model.num_observations,), -1, dtype=torch.long)
    for i in torch.unique(model.view).tolist():
        rows = (model.view == i).nonzero()[:, 0]
        if not len(x[i]):
            continue
        for some in torch.split(rows, BLOCK):
            gap = torch.cdist(model.x[some].double(), x[i].double(), compute_mode="donot_use_mm_for_euclid_dist")
            nearest = gap.min(dim=1)
            found[some] = torch.where(nearest.values <= SAME, nearest.indices, -1)
    share = float((found >= 0).double().mean()) if len(found) else 0.0
    if share < SHARE:
        raise ReconstructionError(f"the features are not the model's: {100 * share:.0f} % of its observations are among them")
    return found
