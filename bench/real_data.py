"""The photographs that the benchmarks reconstruct, with what is known of the truth.

The sets are published by others and are not part of this project. `TORCHSFM_DATA` names the folder that holds them.
"""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PhotographSet:
    """Photographs of one scene.

    Attributes:
        name: What the tables call it.
        paths: The image files.
        poses: True [R t], cam_from_world, by file name; empty where nobody knows.
        focal: True focal length in pixels (mean of x and y), if known.
        unit: Millimetres per unit of the true translations; 0 where their scale is arbitrary.
        K: Intrinsics to be given to the programs; None where they are to find out.
        sequence: Whether the programs may use the order of the images.
        remark: How far the truth can be trusted.
    """

    name: str
    paths: list[Path]
    poses: dict[str, Array] = field(default_factory=dict)
    focal: float | None = None
    unit: float = 0.0
    K: Array | None = None
    sequence: bool = False
    remark: str = ""


def data_folder() -> Path | None:
    """The folder `TORCHSFM_DATA` names, if it is there."""
    folder = os.environ.get("TORCHSFM_DATA")
    return Path(folder) if folder and Path(folder).is_dir() else None


def strecha(data: Path, name: str) -> PhotographSet:
    """Strecha et al. 2008 at half size; poses from a laser scan, in metres."""
    folder = data / "images" / name
    paths = sorted((folder / "images").glob("*.jpg"))
    K = np.zeros((3, 3))
    poses = {}
    for path in paths:
        rows = [[float(v) for v in line.split()] for line in (folder / "gt" / f"{path.stem}.txt").read_text().splitlines()]
        K = np.array(rows[:3])
        poses[path.name] = np.array(rows[3:6])
    return PhotographSet(name, paths, poses, float(K[0, 0] + K[1, 1]) / 2, 1000.0)


def sceaux(data: Path) -> PhotographSet:
    """Moulon, Sceaux castle at half size; only K is known."""
    folder = data / "images/sceaux_castle"
    return PhotographSet("sceaux_castle", sorted(folder.glob("*.JPG")), focal=float(np.loadtxt(folder / "K.txt")[0, 0]))


def temple(data: Path, known_K: bool = False, sequence: bool = False) -> PhotographSet:
    """Seitz et al., the Middlebury temple ring: 47 views around an object on black, calibrated to sub-millimetres."""
    folder = data / "images/temple_ring"
    rows = [line.split() for line in (folder / "templeR_par.txt").read_text().splitlines()[1:]]
    numbers = {row[0]: np.array(row[1:], dtype=float) for row in rows if row}
    poses = {name: np.column_stack([v[9:18].reshape(3, 3), v[18:21]]) for name, v in numbers.items()}
    K = next(iter(numbers.values()))[:9].reshape(3, 3)
    name = "temple_ring" + (" with K" if known_K else "") + (" as sequence" if sequence else "")
    paths = [folder / name for name in sorted(numbers)]
    return PhotographSet(name, paths, poses, float(K[0, 0] + K[1, 1]) / 2, 1000.0, K if known_K else None, sequence)


def berlin(data: Path) -> PhotographSet:
    """Three telephone photographs of OpenSfM's test data, with that program's own result in place of a truth."""
    folder = data / "images/opensfm_berlin"
    result = json.loads((folder / "reconstruction_example.json").read_text())[0]
    camera = next(iter(result["cameras"].values()))
    poses = {
        name: np.column_stack([cv2.Rodrigues(np.array(shot["rotation"]))[0], shot["translation"]])
        for name, shot in result["shots"].items()
    }
    focal = camera["focal"] * max(camera["width"], camera["height"])
    return PhotographSet(
        "opensfm_berlin", sorted((folder / "images").glob("*.jpg")), poses, focal, remark="against OpenSfM's estimate"
    )


def model_house(data: Path) -> PhotographSet:
    """Oxford VGG model house; its cameras were estimated by Oxford and their focal lengths differ by 10 %."""
    folder = data / "vgg/model_house"
    points = np.loadtxt(folder / "3D/house.p3d")[:, :3]
    poses, focals = {}, []
    for path in sorted((folder / "images").glob("*.pgm")):
        P = np.loadtxt(folder / "3D" / f"{path.stem}.P")
        P /= np.linalg.norm(P[2, :3])
        P *= np.sign(np.median(points @ P[2, :3] + P[2, 3]))
        _, K, R, *_ = cv2.RQDecomp3x3(P[:, :3])
        signs = np.diag(np.sign(np.diag(K)))
        K, R = K @ signs, signs @ R
        # A left-handed world seen from the front becomes right-handed by a mirror, the same for all cameras.
        mirror = np.diag([1, 1, np.linalg.det(R).round()])
        poses[path.name] = np.column_stack([R @ mirror, np.linalg.solve(K, P[:, 3])])
        focals.append((K[0, 0] + K[1, 1]) / 2)
    paths = sorted((folder / "images").glob("*.pgm"))
    remark = "against Oxford's estimate, ten cameras with focal lengths that differ by 10 %: no measure of accuracy"
    return PhotographSet("model_house", paths, poses, float(np.median(focals)), remark=remark)


SETS: dict[str, Callable[[Path], PhotographSet]] = {
    "fountain": lambda data: strecha(data, "fountain-P11"),
    "castle": lambda data: strecha(data, "castle-P19"),
    "entry": lambda data: strecha(data, "entry-P10"),
    "sceaux": sceaux,
    "temple": temple,
    "temple-K": lambda data: temple(data, known_K=True),
    "temple-sequence": lambda data: temple(data, sequence=True),
    "berlin": berlin,
    "house": model_house,
}
