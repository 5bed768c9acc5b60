"""OpenSfM's `reconstruction.json`, with the observations in `tracks.csv` beside it.

Rotations are rotation vectors, world to camera. Image coordinates there are relative to the centre of the image and in units of
its longer side: the centre of the top-left pixel, (0, 0) here, is at ((1 - width) / 2, (1 - height) / 2) / max(width, height).
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsfm.formats.joining import Lens, Rows, numbers, reading, running_numbers
from torchsfm.geometry import (
    BrownConrady,
    Camera,
    Distortion,
    KannalaBrandt,
    Radial,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import write_whole_files
from torchsfm.reconstruction.model.reconstruction import Reconstruction

TRACKS = "tracks.csv"
VERSION = "OPENSFM_TRACKS_VERSION_v"
BROWN = ("k1", "k2", "p1", "p2", "k3")
KINDS: dict[str, tuple[type[Distortion], tuple[str, ...]]] = {
    "perspective": (Radial, ("k1", "k2")),
    "brown": (BrownConrady, BROWN),
    "fisheye_opencv": (KannalaBrandt, ("k1", "k2", "k3", "k4")),
}
"""Kinds of cameras, and the numbers of their distortion."""


@on_the_cpu
def write_opensfm(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write a model as `reconstruction.json`, and its observations as `tracks.csv` beside it.

    Pinhole and radial cameras whose principal point is the centre of the image are written as `perspective`, other ones and
    Brown-Conrady as `brown`, Kannala-Brandt as `fisheye_opencv`. Images without a pose are not in the file.

    Args:
        reconstruction: The model.
        path: The file to write; its folder must be there.

    Raises:
        ValueError: A camera has skew, or a name a tab or line break, for which the format has no place.
        OSError: A file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_opensfm(torchsfm.read_model("model.npz"), "reconstruction.json")
        >>> import json
        >>> from pathlib import Path
        >>> list(json.loads(Path("reconstruction.json").read_text())[0])
        ['cameras', 'shots', 'points']
    """
    path = Path(path)
    model = reconstruction.to("cpu").to(dtype=reconstruction.X.double().dtype)
    if odd := [name for name in model.names if any(c in name for c in "\n\r\t")]:
        raise ValueError(f"{TRACKS} cannot hold the name {odd[0]!r}")
    rotvec, t = rotvec_from_rotation(model.poses.R).tolist(), model.poses.t.tolist()
    cameras, shots = {}, {}
    for i in model.registered.nonzero()[:, 0].tolist():
        (width, height), k = model.image_size[i].tolist(), int(model.camera_index[i])
        key = f"camera {k} {width} {height}"
        cameras[key] = _describe(model.cameras[k], k, width, height)
        shots[model.names[i]] = {"rotation": rotvec[i], "translation": t[i], "camera": key, "orientation": 1}
    color = (model.color.clamp(0, 1) * 255).round().tolist()
    points = {str(k): {"color": rgb, "coordinates": X} for k, (X, rgb) in enumerate(zip(model.X.tolist(), color, strict=True))}
    size = model.image_size[model.view].double()
    x = ((model.x + 0.5 - size / 2) / size.amax(-1, keepdim=True)).tolist()
    columns = zip(model.view.tolist(), model.point.tolist(), running_numbers(model.view), x, strict=True)
    rgb = [" ".join(str(int(level)) for level in row).replace(" ", "\t") for row in color]
    lines = [f"{model.names[v]}\t{p}\t{f}\t{a}\t{b}\t0.001\t{rgb[p]}\t-1\t-1\n" for v, p, f, (a, b) in columns]
    content = json.dumps([{"cameras": cameras, "shots": shots, "points": points}])
    tracks = "".join([f"{VERSION}2\n", *lines]).encode("utf-8", "surrogateescape")
    write_whole_files({path.with_name(TRACKS): tracks, path: content.encode()})


def _describe(camera: Camera, index: int, width: int, height: int) -> dict[str, Any]:
    (fx, skew, cx), (_, fy, cy) = camera.K[0].tolist(), camera.K[1].tolist()
    if abs(skew) > 1e-9 * abs(fx):
        raise ValueError(f"camera {index} has skew {skew:.3g}, which OpenSfM has no place for")
    size = max(width, height)
    off = ((cx - (width - 1) / 2) / size, (cy - (height - 1) / 2) / size)
    lens = camera.distortion
    values = {name: float(getattr(lens, name)) for name in lens.parameter_names}
    about: dict[str, Any] = {"width": width, "height": height}
    if Radial.includes(type(lens)) and max(map(abs, off)) < 1e-12 and abs(fx - fy) <= 1e-12 * fx:
        return about | {"projection_type": "perspective", "focal": fx / size, **{n: values.get(n, 0.0) for n in ("k1", "k2")}}
    about |= {"focal_x": fx / size, "focal_y": fy / size, "c_x": off[0], "c_y": off[1]}
    if isinstance(lens, KannalaBrandt):
        return about | {"projection_type": "fisheye_opencv", **values}
    return about | {"projection_type": "brown", **{name: values.get(name, 0.0) for name in BROWN}}


@on_the_cpu
def read_opensfm(path: str | Path) -> Reconstruction:
    """Read the first reconstruction of `reconstruction.json`, with the observations of `tracks.csv` where that lies beside.

    Args:
        path: The file.

    Returns:
        The model, in float64. All images of it are registered. Tracks without a point are left out.

    Raises:
        ValueError: A file is none such, or a damaged one, or has cameras that have no equal here; one line that says why.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_opensfm(torchsfm.read_model("model.npz"), "reconstruction.json")
        >>> torchsfm.read_opensfm("reconstruction.json").X.shape
        torch.Size([20, 3])
    """
    path = Path(path)
    data = path.read_bytes()
    rows = Rows()
    with reading(path, "an OpenSfM reconstruction"):
        content = json.loads(data)[0]
        camera_of: dict[str, int] = {}
        sizes: list[tuple[int, int]] = []
        for key, about in content["cameras"].items():
            camera_of[key] = len(sizes)
            lens, size = _lens(about)
            rows.lenses.append(lens)
            sizes.append(size)
        shots = list(content["shots"].items())
        rotvec = torch.from_numpy(numbers([shot["rotation"] for _, shot in shots], -1, 3))
        for (name, shot), R in zip(shots, rotation_from_rotvec(rotvec).numpy(), strict=True):
            k = camera_of[shot["camera"]]
            rows.add_image(name, sizes[k], k, R, numbers(shot["translation"], 3))
        points = list(content["points"].values())
        rows.X = numbers([point["coordinates"] for point in points], -1, 3)
        rows.color = numbers([point["color"] for point in points], -1, 3) / 255
        number = {key: k for k, key in enumerate(content["points"])}
    tracks = path.with_name(TRACKS)
    if tracks.is_file():
        with reading(tracks, "OpenSfM's tracks"):
            _read_tracks(tracks, rows, number)
    with reading(path, "an OpenSfM reconstruction"):
        return rows.join()


def _lens(about: dict[str, Any]) -> tuple[Lens, tuple[int, int]]:
    """A camera and the size of its images."""
    width, height = int(about["width"]), int(about["height"])
    size = max(width, height)
    fx = float(about["focal"] if "focal" in about else about["focal_x"]) * size
    fy = float(about["focal_y"]) * size if "focal_y" in about else fx
    c = (float(about.get("c_x", 0)) * size + (width - 1) / 2, float(about.get("c_y", 0)) * size + (height - 1) / 2)
    if about.get("projection_type") not in KINDS:
        raise ValueError(f"a camera of the kind {about.get('projection_type')!r}, which has no equal here")
    kind, names = KINDS[about["projection_type"]]
    return Lens((fx, fy), c, kind, {name: float(about.get(name, 0)) for name in names}), (width, height)


def _read_tracks(path: Path, rows: Rows, number: dict[str, int]) -> None:
    """Fill in the observations."""
    lines = path.read_bytes().decode("utf-8", "surrogateescape").split("\n")
    lines = lines[1:] if lines[0].startswith(VERSION) else lines
    image_of = {name: i for i, name in enumerate(rows.names)}
    view, point, x = [], [], []
    for line in lines:
        if not line:
            continue
        name, track, _, *rest = line.split("\t")
        if name in image_of and track in number:
            view.append(image_of[name])
            point.append(number[track])
            x.append((float(rest[0]), float(rest[1])))
    size = np.array(rows.sizes, dtype=np.float64).reshape(-1, 2)[view]
    rows.view, rows.point = view, point
    rows.x = numbers(x, -1, 2) * size.max(-1, initial=0, keepdims=True) + size / 2 - 0.5
