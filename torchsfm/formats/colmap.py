"""COLMAP models: the folder of files that COLMAP, and much that was built on it, reads and writes.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5), this library at (0, 0); the half pixel is added and taken away here
and nowhere else.
"""

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np
import torch

from torchsfm.formats import colmap_binary, colmap_text
from torchsfm.formats.colmap_model import (
    NO_POINT,
    PARAMETERS,
    STILL,
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    check_model,
    poses,
)
from torchsfm.formats.joining import Lens, join_cameras
from torchsfm.geometry import DISTORTION_MODELS, Camera, quaternion_wxyz_from_rotation
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import write_whole_files
from torchsfm.reconstruction.model.reconstruction import Reconstruction

HALF_PIXEL = 0.5
TABLES = ("cameras", "images", "points3D", "rigs", "frames")
"""The files of a model; the last two may be missing."""
UNREGISTERED = "unregistered.txt"
"""COLMAP's files have no place for images without a pose: they are listed here, one `IMAGE_ID CAMERA_ID NAME` a line."""


SPLATTING = frozenset({"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"})
"""The camera models that gsplat's reader takes."""


@on_the_cpu
def write_colmap(
    reconstruction: Reconstruction,
    folder: str | Path,
    *,
    text: bool = False,
    models: Collection[str] = PARAMETERS.keys(),
) -> None:
    """Write a model as COLMAP's files, binary or text, with one trivial rig per camera and one frame per image.

    Pinholes are written as SIMPLE_PINHOLE or PINHOLE, radial distortion as SIMPLE_RADIAL or RADIAL where both focal lengths are
    equal and as OPENCV where not, Brown-Conrady as OPENCV or, with k3, FULL_OPENCV, Kannala-Brandt as OPENCV_FISHEYE. Image and
    point numbers in COLMAP are the indices here plus one. Images without a pose go into the text file `unregistered.txt`, which
    COLMAP ignores. Cameras that took no image are left out.

    Args:
        reconstruction: The model.
        folder: Where to; made if it is not there. Files of an earlier model in it are replaced, all of them or none.
        text: Write text files instead, with all digits.
        models: COLMAP's camera models that the reader of the files knows.

    Raises:
        ValueError: A camera has skew, or a distortion, which none of the models has, or text files cannot hold a name.
        OSError: The folder cannot be made or written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_colmap(torchsfm.read_model("model.npz"), "sparse/0", text=True)
        >>> from pathlib import Path
        >>> Path("sparse/0/cameras.txt").read_text().splitlines()[-1].split()[1:4]  # camera model, width, height
        ['RADIAL', '823', '672']
    """
    folder = Path(folder)
    if unknown := set(models) - set(PARAMETERS):
        raise ValueError(f"models: wanted names among {', '.join(PARAMETERS)}, got {min(unknown)!r}")
    model = reconstruction.to("cpu", torch.float64)
    keys = torch.cat([model.camera_index[:, None], model.image_size.to(model.camera_index.dtype)], -1)
    used, index = torch.unique(keys, dim=0, return_inverse=True)
    cameras = {
        i: ColmapCamera(*colmap_parameters(model.cameras[camera], camera, (width, height), models))
        for i, (camera, width, height) in enumerate(used.tolist(), start=1)
    }
    camera_ids = (index + 1).tolist()
    images, points = _tables(model, camera_ids)
    frames = {i: ColmapFrame(image.camera_id, image.cam_from_world, ((image.camera_id, i),)) for i, image in images.items()}
    writer, other = (colmap_text, "bin") if text else (colmap_binary, "txt")
    contents = writer.write_files(ColmapModel(cameras, images, points, {i: {i: STILL} for i in cameras}, frames))
    lines = [
        f"{i} {camera_id} {_one_line(name)}\n"
        for i, (camera_id, name) in enumerate(zip(camera_ids, model.names, strict=True), start=1)
        if i not in images
    ]
    if lines:
        contents[UNREGISTERED] = "".join(lines).encode("utf-8", "surrogateescape")
    folder.mkdir(parents=True, exist_ok=True)
    write_whole_files({folder / name: content for name, content in contents.items()})
    if not lines:
        (folder / UNREGISTERED).unlink(missing_ok=True)
    for name in TABLES:  # a model of the other kind, which readers may prefer
        (folder / f"{name}.{other}").unlink(missing_ok=True)


def _tables(model: Reconstruction, camera_ids: list[int]) -> tuple[dict[int, ColmapImage], ColmapPoints]:
    """The registered images with their image points, and the 3D points with their tracks."""
    in_pose = model.registered[model.view]
    x, view, point = (model.x[in_pose] + HALF_PIXEL).numpy(), model.view[in_pose], model.point[in_pose]
    order = torch.argsort(view, stable=True)
    counts = torch.bincount(view, minlength=len(model.names))
    first = torch.cumsum(counts, 0) - counts
    slot = torch.empty_like(view)
    slot[order] = torch.arange(len(view)) - first[view[order]]
    seen = torch.split(order, counts.tolist())
    motions = torch.cat((quaternion_wxyz_from_rotation(model.poses.R), model.poses.t), -1).tolist()
    images = {
        i + 1: ColmapImage(
            camera_ids[i], model.names[i], tuple(motions[i]), x[seen[i].numpy()], (point[seen[i]] + 1).numpy().astype(np.int64)
        )
        for i in model.registered.nonzero()[:, 0].tolist()
    }
    by_point = torch.argsort(point, stable=True)
    lengths = torch.bincount(point, minlength=model.num_points)
    total = model.X.new_zeros(model.num_points).index_add(0, point, model.residuals()[in_pose])
    points = ColmapPoints(
        np.arange(1, model.num_points + 1),
        model.X.numpy(),
        (model.color.clamp(0, 1) * 255).round().to(torch.uint8).numpy(),
        (total / lengths.clamp_min(1)).numpy(),
        lengths.numpy(),
        torch.stack((view[by_point] + 1, slot[by_point]), -1).numpy(),
    )
    return images, points


@on_the_cpu
def read_colmap(folder: str | Path) -> Reconstruction:
    """Read a COLMAP model, binary or, where there is none, text.

    Image points without a 3D point are left out. Images come in the order of COLMAP's numbers, points too. Cameras of different
    models become the simplest of this library's models that holds them all. Poses are those of the images, with which rigs and
    frames must agree where the model has them.

    Args:
        folder: Where the files lie.

    Returns:
        The model, in float64. All images of COLMAP's files are registered; those of `unregistered.txt`, which `write_colmap`
        leaves, are not.

    Raises:
        FileNotFoundError: There is no such folder.
        ValueError: The folder holds no COLMAP model, a damaged one, or one with cameras that have no equal here.
        OSError: A file cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_colmap(torchsfm.read_model("model.npz"), "sparse")
        >>> torchsfm.read_colmap("sparse").X.shape
        torch.Size([20, 3])
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is not a folder")
    colmap = _read_files(folder)
    try:
        check_model(colmap)
        cameras = _cameras_from_colmap(colmap.cameras)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from None
    camera_ids = list(colmap.cameras)
    camera_of = {camera_id: i for i, camera_id in enumerate(camera_ids)}
    listed = _read_unregistered(folder / UNREGISTERED, camera_of)
    entries = {i: (image.camera_id, image.name) for i, image in colmap.images.items()}
    entries = dict(sorted((listed | entries).items()))
    images = [colmap.images.get(i) for i in entries]
    sizes = [[colmap.cameras[i].width, colmap.cameras[i].height] for i, _ in entries.values()]
    by_number = np.argsort(colmap.points.point_id, kind="stable")
    shown = [np.empty(0, np.int64), *(image.point_id for image in images if image)]
    point_id = np.concatenate(shown)
    view = np.repeat(np.arange(len(images)), [len(image.x) if image else 0 for image in images])
    keep = point_id != NO_POINT
    point = np.searchsorted(colmap.points.point_id[by_number], point_id[keep])
    order = np.argsort(point, kind="stable")
    x = np.concatenate([np.empty((0, 2)), *(image.x for image in images if image)])[keep][order]
    return Reconstruction(
        names=tuple(name for _, name in entries.values()),
        image_size=torch.tensor(sizes, dtype=torch.long).reshape(-1, 2),
        cameras=cameras,
        camera_index=torch.tensor([camera_of[i] for i, _ in entries.values()], dtype=torch.long),
        poses=poses([image.cam_from_world if image else STILL for image in images]),
        registered=torch.tensor([image is not None for image in images], dtype=torch.bool),
        X=torch.from_numpy(colmap.points.X[by_number]),
        color=torch.from_numpy(colmap.points.color[by_number]).double() / 255,
        x=torch.from_numpy(x) - HALF_PIXEL,
        view=torch.from_numpy(view[keep][order]),
        point=torch.from_numpy(point[order]),
    )


def _read_files(folder: Path) -> ColmapModel:
    """Read the tables, from binary files if all of them are there."""
    for reader, ending in ((colmap_binary, "bin"), (colmap_text, "txt")):
        paths = {name: folder / f"{name}.{ending}" for name in TABLES}
        if all(paths[name].is_file() for name in TABLES[:3]):
            cameras = dict(sorted(reader.read_cameras(paths["cameras"]).items()))
            images, points = reader.read_images(paths["images"]), reader.read_points(paths["points3D"])
            rigs = reader.read_rigs(paths["rigs"]) if paths["rigs"].is_file() else {}
            frames = reader.read_frames(paths["frames"]) if paths["frames"].is_file() else {}
            return ColmapModel(cameras, images, points, rigs, frames)
    raise ValueError(f"{folder} does not hold a COLMAP model (cameras, images and points3D, as .bin or .txt)")


def colmap_parameters(
    camera: Camera, index: int, size: tuple[int, int], models: Collection[str]
) -> tuple[str, int, int, tuple[float, ...]]:
    """Choose the COLMAP model that holds a camera exactly: its name, the size of the images, the parameters."""
    (fx, skew, cx), (_, fy, cy) = camera.K[0].tolist(), camera.K[1].tolist()
    if abs(skew) > 1e-9 * abs(fx):
        raise ValueError(f"camera {index} has skew {skew:.3g}, which no camera model of COLMAP has")
    # Two focal lengths that differ by rounding only are one.
    equal = abs(fx - fy) <= 1e-12 * abs(fx)
    lens = type(camera.distortion)
    values = {name: float(getattr(camera.distortion, name)) for name in lens.parameter_names}
    needed = {name for name, value in values.items() if value != 0}
    for name in (name for model in DISTORTION_MODELS.values() if model.includes(lens) for name in model.colmap):
        _, focals, held = PARAMETERS[name]
        if name in models and needed <= set(held) and (equal or focals == 2):
            head = (*(fx, fy)[:focals], cx + HALF_PIXEL, cy + HALF_PIXEL)
            return name, *size, (*head, *(values.get(name, 0.0) for name in held))
    kinds = "no camera model of COLMAP" if len(models) == len(PARAMETERS) else f"none of {', '.join(sorted(models))}"
    detail = f" with {', '.join(sorted(needed))}" if needed else ""
    raise ValueError(f"camera {index} has {lens.__name__} distortion{detail}, which {kinds} has")


def _cameras_from_colmap(cameras: dict[int, ColmapCamera]) -> Camera:
    """Join cameras into one batch, of the first distortion model that holds them all."""
    return join_cameras([lens_from_colmap(camera, str(camera_id)) for camera_id, camera in cameras.items()])


def lens_from_colmap(camera: ColmapCamera, name: str) -> Lens:
    """What a camera of COLMAP is here.

    Raises:
        ValueError: It has no equal, which the message says of the camera of this name.
    """
    known = [model for model in DISTORTION_MODELS.values() if camera.model in model.colmap]
    if not known:
        raise ValueError(f"camera {name} has COLMAP's model {camera.model}, which has no equal here")
    _, focals, names = PARAMETERS[camera.model]
    fx, fy, cx, cy, *rest = camera.parameters[: 2 - focals] + camera.parameters
    values = dict(zip(names, rest, strict=True))
    if lost := [key for key, value in values.items() if value != 0 and key not in known[0].parameter_names]:
        raise ValueError(f"camera {name} is a {camera.model} with {' and '.join(lost)}, which has no equal here")
    return Lens((fx, fy), (cx - HALF_PIXEL, cy - HALF_PIXEL), known[0], values)


def _read_unregistered(path: Path, camera_of: dict[int, int]) -> dict[int, tuple[int, str]]:
    """Read the list of images without a pose, if it is there."""
    images: dict[int, tuple[int, str]] = {}
    if not path.is_file():
        return images
    lines = path.read_bytes().decode("utf-8", "surrogateescape").split("\n")
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            image_id, camera_id, name = line.removesuffix("\r").split(" ", 2)
            images[int(image_id)] = (int(camera_id), ESCAPED.sub(lambda found: ESCAPES[found[1]], name))
        except ValueError:
            raise ValueError(f"{path}, line {number}: wanted 'IMAGE_ID CAMERA_ID NAME', got {line[:100]!r}") from None
        if int(camera_id) not in camera_of:
            raise ValueError(f"{path}, line {number}: there is no camera {camera_id}")
    return images


ESCAPES = {"n": "\n", "r": "\r", "\\": "\\"}
ESCAPED = re.compile(r"\\([nr\\])")


def _one_line(name: str) -> str:
    """A name as `unregistered.txt` holds it."""
    return name.replace("\\", r"\\").replace("\n", r"\n").replace("\r", r"\r")
