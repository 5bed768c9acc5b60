"""The two HDF5 files of hloc: features of each image, and matches of each pair (needs the package h5py).

In the file of features each image is a group under its name, with a dataset `keypoints` and often `image_size`; the centre of
the top-left pixel is at (0, 0), as here. In the file of matches the group of a pair is named by both images, their slashes
written as `-`, and holds `matches0`, the match of each keypoint of the first image or -1, and often `matching_scores0`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsfm.formats.joining import numbers, picture_size, reading
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.matched import MatchedImages
from torchsfm.reconstruction.model.files import FREE_BYTES, MAX_RATIO


@on_the_cpu
def read_hloc(features: str | Path, matches: str | Path, *, images: str | Path | None = None) -> MatchedImages:
    """Read features and matches of hloc, for `reconstruct_matches`.

    Args:
        features: The HDF5 file of features.
        matches: The HDF5 file of matches.
        images: Folder of the images, for their sizes where the file of features does not tell them.

    Returns:
        Images in the order of their names, with the scores of the matches as weights where every pair has them.

    Raises:
        ImportError: The package h5py is not installed.
        ValueError: A file is none such, or a damaged one, or does not tell the size of an image; one line that says which.
        OSError: A file cannot be read.

    Example:
        >>> import h5py, torch, torchsfm
        >>> with h5py.File("features.h5", "w") as features:
        ...     for name in ("a.jpg", "b.jpg"):
        ...         features[f"{name}/keypoints"] = torch.rand(10, 2, generator=torch.Generator().manual_seed(0)).numpy()
        ...         features[f"{name}/image_size"] = [640, 480]
        >>> with h5py.File("matches.h5", "w") as matches:
        ...     matches["a.jpg/b.jpg/matches0"] = [0, 1, 2, 3, 4, -1, -1, -1, -1, -1]
        >>> matched = torchsfm.read_hloc("features.h5", "matches.h5")
        >>> matched.names, matched.pairs, len(matched.matches[0])  # as reconstruct_matches takes them
        (('a.jpg', 'b.jpg'), tensor([[0, 1]]), 5)
    """
    try:
        import h5py
    except ImportError:
        raise ImportError("hloc's files are HDF5, which the package h5py reads: pip install h5py") from None
    features, matches = Path(features), Path(matches)
    for path in (features, matches):
        with path.open("rb"):
            pass
    names: list[str] = []
    sizes, keypoints = [], []
    with reading(features, "a file of hloc's features"), _opened(h5py, features) as file:
        found: list[str] = []
        file.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Group) and "keypoints" in item else None)
        for name in sorted(found):
            names.append(name)
            keypoints.append(torch.from_numpy(numbers(_values(file[name]["keypoints"]), -1, 2).astype(np.float32)))
            size = _values(file[name]["image_size"]) if "image_size" in file[name] else None
            if size is None and images is not None:
                size = picture_size(Path(images) / name)
            if size is None:
                raise ValueError(f"it does not tell the size of {name}: say in which folder the images lie")
            sizes.append(numbers(size, 2).astype(np.int64).tolist())
            if min(sizes[-1]) < 1:
                raise ValueError(f"{name} has a size that is none")
    number = {name.replace("/", "-"): i for i, name in enumerate(names)}
    pairs, rows, scores = [], [], []
    with reading(matches, "a file of hloc's matches"), _opened(h5py, matches) as file:
        for first, group in file.items():
            for second, pair in group.items():
                i, j = number[first], number[second]
                match = numbers(_values(pair["matches0"]), -1).astype(np.int64)
                if i == j or len(match) != len(keypoints[i]) or (len(match) and int(match.max()) >= len(keypoints[j])):
                    raise ValueError(f"the matches of {first} and {second} are of keypoints that are not there")
                good = np.flatnonzero(match >= 0)
                pairs.append([i, j])
                rows.append(torch.from_numpy(np.stack([good, match[good]], -1)))
                if "matching_scores0" in pair:
                    scores.append(torch.from_numpy(numbers(_values(pair["matching_scores0"]), len(match))[good]))
    return MatchedImages(
        names=tuple(names),
        image_size=torch.tensor(sizes, dtype=torch.long).reshape(-1, 2),
        keypoints=tuple(keypoints),
        pairs=torch.tensor(pairs, dtype=torch.long).reshape(-1, 2),
        matches=tuple(rows),
        weights=tuple(scores) if len(scores) == len(rows) else None,
    )


@contextmanager
def _opened(h5py: Any, path: Path) -> Iterator[Any]:
    """The file, whose damage is a ValueError as that of any other: HDF5 finds most of it only when asked for what is there."""
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, MemoryError) as error:
        raise ValueError(str(error)) from None


def _values(dataset: Any) -> Any:
    """What a dataset holds.

    Raises:
        ValueError: It says that it holds far more than its file can.
    """
    whole = Path(dataset.file.filename).stat().st_size
    if dataset.nbytes > max(FREE_BYTES, MAX_RATIO * whole):
        raise ValueError(f"{dataset.name} says that it holds {dataset.nbytes} bytes, in a file of {whole}")
    return dataset[()]
