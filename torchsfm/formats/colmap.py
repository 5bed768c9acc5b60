"""COLMAP models: the folder of binary files that COLMAP, and much that was built on it, reads and writes.

Reading and writing is done by pycolmap, an optional package. COLMAP puts the centre of the top-left pixel at (0.5, 0.5), this
library at (0, 0); the half pixel is added and taken away here and nowhere else.
"""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsfm.geometry import (
    DISTORTION_MODELS,
    BrownConrady,
    Camera,
    KannalaBrandt,
    NoDistortion,
    Pose,
    Radial,
    SimpleRadial,
    intrinsics,
    quaternion_wxyz_from_rotation,
)
from torchsfm.reconstruction.reconstruction import Reconstruction

HALF_PIXEL = 0.5
UNREGISTERED = "unregistered.txt"
"""COLMAP's files have no place for images without a pose: they are listed here, one `IMAGE_ID CAMERA_ID NAME` a line."""

# COLMAP's model -> ours, number of focal lengths, and the names of the parameters after the principal point.
MODELS: dict[str, tuple[str, int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("pinhole", 1, ()),
    "PINHOLE": ("pinhole", 2, ()),
    "SIMPLE_RADIAL": ("simple_radial", 1, ("k1",)),
    "RADIAL": ("radial", 1, ("k1", "k2")),
    "OPENCV": ("opencv", 2, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("opencv", 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": ("fisheye", 2, ("k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, ("k1",)),
    "RADIAL_FISHEYE": ("fisheye", 1, ("k1", "k2")),
}
# From special to general: each is the next one with some parameters zero.
POLYNOMIALS = ("pinhole", "simple_radial", "radial", "opencv")


def _import_pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError as error:
        message = "COLMAP models need the package pycolmap, which is not installed: pip install 'torchsfm[colmap]'"
        raise ImportError(message, name="pycolmap") from error
    return pycolmap


def write_colmap(reconstruction: Reconstruction, folder: str | Path) -> None:
    """Write a model as COLMAP's binary files, with one trivial rig per camera and one frame per image.

    Pinholes are written as SIMPLE_PINHOLE or PINHOLE, radial distortion as SIMPLE_RADIAL or RADIAL where both focal lengths are
    equal and as OPENCV where not, Brown-Conrady as OPENCV or, with k3, FULL_OPENCV, Kannala-Brandt as OPENCV_FISHEYE. Image and
    point numbers in COLMAP are the indices here plus one. Images without a pose go into the text file `unregistered.txt`, which
    COLMAP ignores. Cameras that took no image are left out.

    Args:
        reconstruction: The model.
        folder: Where to; made if it is not there. Files of an earlier model in it are overwritten.

    Raises:
        ImportError: pycolmap is not installed.
        ValueError: A camera has skew, which no model of COLMAP has.
        OSError: The folder cannot be made or written.
    """
    pycolmap = _import_pycolmap()
    folder = Path(folder)
    model = reconstruction.to("cpu", torch.float64)
    colmap = pycolmap.Reconstruction()
    camera_ids = _add_cameras(pycolmap, colmap, model)
    in_pose = model.registered[model.view]
    x, view, point = (model.x[in_pose] + HALF_PIXEL).numpy(), model.view[in_pose], model.point[in_pose]
    order = torch.argsort(view, stable=True)
    counts = torch.bincount(view, minlength=len(model.names))
    first = torch.cumsum(counts, 0) - counts
    slot = torch.empty_like(view)
    slot[order] = torch.arange(len(view)) - first[view[order]]
    keypoints = torch.split(order, counts.tolist())
    quaternions = quaternion_wxyz_from_rotation(model.poses.R).roll(-1, -1).numpy()
    translations = model.poses.t.numpy()
    for i in model.registered.nonzero()[:, 0].tolist():
        camera_id = camera_ids[i]
        image = pycolmap.Image(name=model.names[i], keypoints=x[keypoints[i].numpy()], camera_id=camera_id, image_id=i + 1)
        frame = pycolmap.Frame(frame_id=i + 1, rig_id=camera_id)
        frame.add_data_id(image.data_id)
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(quaternions[i]), translations[i])
        colmap.add_frame(frame)
        image.frame_id = i + 1
        colmap.add_image(image)
        colmap.register_frame(i + 1)
    by_point = torch.argsort(point, stable=True)
    images = torch.split(view[by_point] + 1, torch.bincount(point, minlength=model.num_points).tolist())
    slots = torch.split(slot[by_point], [len(part) for part in images])
    color = (model.color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    for X, rgb, image_ids, indices in zip(model.X.numpy(), color, images, slots, strict=True):
        track = pycolmap.Track()
        for image_id, index in zip(image_ids.tolist(), indices.tolist(), strict=True):
            track.add_element(image_id, index)
        colmap.add_point3D(X, track, rgb)
    colmap.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    colmap.write_binary(folder)
    lines = [f"{i + 1} {camera_ids[i]} {name}\n" for i, name in enumerate(model.names) if not model.registered[i]]
    (folder / UNREGISTERED).unlink(missing_ok=True)
    if lines:
        (folder / UNREGISTERED).write_text("".join(lines), encoding="utf-8")


def read_colmap(folder: str | Path) -> Reconstruction:
    """Read a COLMAP model, binary or text.

    Image points without a 3D point are left out. Images come in the order of COLMAP's numbers, points too. Cameras of different
    models become the simplest of this library's models that holds them all.

    Args:
        folder: Where the files lie.

    Returns:
        The model, in float64. All images of COLMAP's files are registered; those of `unregistered.txt`, which `write_colmap`
        leaves, are not.

    Raises:
        ImportError: pycolmap is not installed.
        FileNotFoundError: There is no such folder.
        ValueError: The folder holds no COLMAP model, a damaged one, or one with cameras that have no equal here.
    """
    pycolmap = _import_pycolmap()
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is not a folder")
    try:
        colmap = pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, IndexError) as error:
        raise ValueError(f"{folder} does not hold a COLMAP model ({_last_line(error)})") from error
    camera_ids = sorted(colmap.cameras.keys())
    cameras = _cameras_from_colmap([colmap.cameras[i] for i in camera_ids])
    camera_of = {camera_id: i for i, camera_id in enumerate(camera_ids)}
    images = {i: (image.camera_id, image.name) for i, image in colmap.images.items() if image.has_pose}
    listed = _read_unregistered(folder / UNREGISTERED, camera_of)
    listed = {i: entry for i, entry in listed.items() if i not in images}
    image_ids = sorted(images | listed)
    entries = [(images | listed)[i] for i in image_ids]
    sizes = [[colmap.cameras[i].width, colmap.cameras[i].height] for i, _ in entries]
    Rt = torch.eye(3, 4, dtype=torch.float64).repeat(len(image_ids), 1, 1)
    point_of = {point_id: k for k, point_id in enumerate(sorted(colmap.point3D_ids()))}
    x: list[Any] = []
    view: list[int] = []
    point: list[int] = []
    for i, image_id in enumerate(image_ids):
        if image_id not in images:
            continue
        image = colmap.images[image_id]
        Rt[i] = torch.from_numpy(image.cam_from_world().matrix())
        for observed in image.points2D:
            if observed.has_point3D():
                x.append(observed.xy.tolist())
                view.append(i)
                point.append(point_of[observed.point3D_id])
    points = [colmap.points3D[i] for i in point_of]
    order = torch.argsort(torch.tensor(point, dtype=torch.long), stable=True)
    return Reconstruction(
        names=tuple(name for _, name in entries),
        image_size=torch.tensor(sizes, dtype=torch.long).reshape(-1, 2),
        cameras=cameras,
        camera_index=torch.tensor([camera_of[i] for i, _ in entries], dtype=torch.long),
        poses=Pose.from_matrix(Rt),
        registered=torch.tensor([i in images for i in image_ids], dtype=torch.bool),
        X=torch.tensor([p.xyz.tolist() for p in points], dtype=torch.float64).reshape(-1, 3),
        color=torch.tensor([p.color.tolist() for p in points], dtype=torch.float64).reshape(-1, 3) / 255,
        x=torch.tensor(x, dtype=torch.float64).reshape(-1, 2)[order] - HALF_PIXEL,
        view=torch.tensor(view, dtype=torch.long)[order],
        point=torch.tensor(point, dtype=torch.long)[order],
    )


def _add_cameras(pycolmap: Any, colmap: Any, model: Reconstruction) -> list[int]:
    """Add one camera and its rig for each camera and image size in use; return the camera number of each image."""
    keys = torch.cat([model.camera_index[:, None], model.image_size.to(model.camera_index.dtype)], -1)
    used, index = torch.unique(keys, dim=0, return_inverse=True)
    for i, (camera_index, width, height) in enumerate(used.tolist(), start=1):
        name, parameters = _colmap_parameters(model.cameras[camera_index], camera_index)
        camera = pycolmap.Camera(camera_id=i, model=name, width=width, height=height, params=parameters)
        colmap.add_camera(camera)
        rig = pycolmap.Rig(rig_id=i)
        rig.add_ref_sensor(camera.sensor_id)
        colmap.add_rig(rig)
    return [int(i) + 1 for i in index]


def _colmap_parameters(camera: Camera, index: int) -> tuple[str, list[float]]:
    """Choose the COLMAP model that holds a camera exactly."""
    (fx, skew, cx), (_, fy, cy) = camera.K[0].tolist(), camera.K[1].tolist()
    if abs(skew) > 1e-9 * abs(fx):
        raise ValueError(f"camera {index} has skew {skew:.3g}, which no camera model of COLMAP has")
    # Two focal lengths that differ by rounding only are one.
    equal = abs(fx - fy) <= 1e-12 * abs(fx)
    values = camera.distortion.parameters().tolist()
    match camera.distortion:
        case NoDistortion():
            name = "SIMPLE_PINHOLE" if equal else "PINHOLE"
        case SimpleRadial() | Radial() if not equal:
            name, values = "OPENCV", [*values, 0.0][:2] + [0.0] * 2
        case SimpleRadial():
            name = "SIMPLE_RADIAL"
        case Radial():
            name = "RADIAL"
        case BrownConrady():
            name, values = ("OPENCV", values[:4]) if values[4] == 0 else ("FULL_OPENCV", [*values, 0.0, 0.0, 0.0])
        case KannalaBrandt():
            name = "OPENCV_FISHEYE"
    focal = [fx] if MODELS[name][1] == 1 else [fx, fy]
    return name, [*focal, cx + HALF_PIXEL, cy + HALF_PIXEL, *values]


def _cameras_from_colmap(cameras: list[Any]) -> Camera:
    """Join cameras into one batch, of the simplest distortion model that holds them all."""
    K, kinds, named = [], [], []
    for camera in cameras:
        model = camera.model.name
        if model not in MODELS:
            raise ValueError(f"camera {camera.camera_id} has COLMAP's model {model}, which has no equal here")
        kind, focals, names = MODELS[model]
        fx, fy, cx, cy, *rest = ([camera.params[0]] if focals == 1 else []) + list(camera.params)
        values = dict(zip(names, (float(value) for value in rest), strict=True))
        if model == "FULL_OPENCV" and [values.pop(name) for name in ("k4", "k5", "k6")] != [0, 0, 0]:
            raise ValueError(f"camera {camera.camera_id} is a FULL_OPENCV with k4, k5 or k6, which has no equal here")
        f = torch.tensor(fx, dtype=torch.float64)
        c = torch.tensor([cx, cy], dtype=torch.float64) - HALF_PIXEL
        K.append(intrinsics(f, c, aspect=fy / fx if fx else 1.0))
        kinds.append(kind)
        named.append(values)
    if not K:
        return Camera(torch.zeros(0, 3, 3, dtype=torch.float64))
    if "fisheye" in kinds and set(kinds) != {"fisheye"}:
        raise ValueError("the model mixes fisheye cameras with others, which one batch of cameras cannot hold")
    kind = "fisheye" if "fisheye" in kinds else max(kinds, key=POLYNOMIALS.index)
    cls = DISTORTION_MODELS[kind]
    rows: list[Tensor] = [
        torch.tensor([values.get(name, 0.0) for name in cls.parameter_names], dtype=torch.float64) for values in named
    ]
    return Camera(torch.stack(K), cls.from_parameters(torch.stack(rows)))


def _read_unregistered(path: Path, camera_of: dict[int, int]) -> dict[int, tuple[int, str]]:
    """Read the list of images without a pose, if it is there."""
    images: dict[int, tuple[int, str]] = {}
    if not path.is_file():
        return images
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            image_id, camera_id, name = line.split(" ", 2)
            images[int(image_id)] = (int(camera_id), name)
        except ValueError:
            raise ValueError(f"{path}, line {number}: wanted 'IMAGE_ID CAMERA_ID NAME', got {line!r}") from None
        if int(camera_id) not in camera_of:
            raise ValueError(f"{path}, line {number}: there is no camera {camera_id}")
    return images


def _last_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[-1] if lines else type(error).__name__
