"""`transforms.json` of nerfstudio, instant-ngp and many radiance fields after NeRF: cameras, and beside them points as PLY.

Poses are world from camera, with OpenGL's axes: x to the right, y up, z backwards. Here cameras look along z and y points down:
half a turn about the x axis, done here. The centre of the top-left pixel is at (0.5, 0.5) there, at (0, 0) here. Observations
have no place in the file.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from torchsfm.formats.joining import Lens, Rows, numbers, picture_size, reading
from torchsfm.formats.ply import read_ply, write_ply
from torchsfm.geometry import Camera, KannalaBrandt
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction

HALF_PIXEL = 0.5
PICTURES = "images"
"""The folder of the pictures, beside the file."""
POINTS = "points.ply"
TURN = np.diag([1.0, -1.0, -1.0])
LENS_NUMBERS = ("k1", "k2", "k3", "k4", "p1", "p2")


@on_the_cpu
def write_nerfstudio(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the cameras as `transforms.json`, and the points as `points.ply` beside it.

    Pinholes are written as PINHOLE, radial and Brown-Conrady distortion as OPENCV, Kannala-Brandt as OPENCV_FISHEYE. Every
    frame has the intrinsics of its camera. Pictures are named as they would lie in the folder `images` beside the file; images
    without a pose are left out.

    Args:
        reconstruction: The model.
        path: The file to write; its folder must be there.

    Raises:
        ValueError: A camera has skew, which the format has not.
        OSError: A file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_nerfstudio(torchsfm.read_model("model.npz"), "transforms.json")
        >>> import json
        >>> from pathlib import Path
        >>> len(json.loads(Path("transforms.json").read_text())["frames"])
        3
    """
    path = Path(path)
    model = reconstruction.to("cpu").to(dtype=reconstruction.X.double().dtype)
    described = [_describe(model.cameras[k], k) for k in range(len(model.cameras.K))]
    camera_to_world = np.zeros((len(model.names), 4, 4))
    camera_to_world[:, :3, :3] = model.poses.R.mT.numpy() @ TURN
    camera_to_world[:, :3, 3], camera_to_world[:, 3, 3] = model.poses.centre.numpy(), 1
    frames = []
    for i in model.registered.nonzero()[:, 0].tolist():
        width, height = model.image_size[i].tolist()
        frame = {"file_path": f"{PICTURES}/{model.names[i]}", "w": width, "h": height, **described[int(model.camera_index[i])]}
        frames.append(frame | {"transform_matrix": camera_to_world[i].tolist()})
    kinds = {frame["camera_model"] for frame in frames}
    # One model for all is also said where readers look that know no other place.
    head = {"camera_model": kinds.pop()} if len(kinds) == 1 else {}
    write_ply(model.X, path.with_name(POINTS), color=model.color)
    with whole_file(path) as file:
        file.write(json.dumps({**head, "ply_file_path": POINTS, "frames": frames}, indent=1).encode())


def _describe(camera: Camera, index: int) -> dict[str, Any]:
    """The numbers of a camera under the names of the format."""
    (fx, skew, cx), (_, fy, cy) = camera.K[0].tolist(), camera.K[1].tolist()
    if abs(skew) > 1e-9 * abs(fx):
        raise ValueError(f"camera {index} has skew {skew:.3g}, which transforms.json has no place for")
    lens = camera.distortion
    values = {name: float(getattr(lens, name)) for name in lens.parameter_names}
    model = "OPENCV_FISHEYE" if isinstance(lens, KannalaBrandt) else "OPENCV" if values else "PINHOLE"
    return {"camera_model": model, "fl_x": fx, "fl_y": fy, "cx": cx + HALF_PIXEL, "cy": cy + HALF_PIXEL, **values}


@on_the_cpu
def read_nerfstudio(path: str | Path) -> Reconstruction:
    """Read cameras from `transforms.json`, and the points of the PLY file that it names.

    Args:
        path: The file. Intrinsics may stand in each frame or before all of them, focal lengths also as `camera_angle_x`; sizes
            that are not there are those of the pictures.

    Returns:
        The model, in float64, without observations. Names are those of the frames without the folder `images`.

    Raises:
        ValueError: The file is none such, or a damaged one, or has cameras that have no equal here; one line that says why.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_nerfstudio(torchsfm.read_model("model.npz"), "transforms.json")
        >>> torchsfm.read_nerfstudio("transforms.json").num_registered
        3
    """
    path = Path(path)
    data = path.read_bytes()
    rows = Rows()
    with reading(path, "a transforms.json"):
        content = json.loads(data)
        known: dict[Any, int] = {}
        for frame in content["frames"]:
            about = {**content, **frame}
            name = str(about["file_path"]).removeprefix("./")
            lens, size = _lens(about, path.parent / name)
            key = (lens.f, lens.c, lens.kind, tuple(sorted(lens.numbers.items())), size)
            if key not in known:
                known[key] = len(rows.lenses)
                rows.lenses.append(lens)
            matrix = numbers(np.array(about["transform_matrix"], dtype=np.float64)[:3], 3, 4)
            R = TURN @ matrix[:, :3].T
            rows.add_image(name.removeprefix(f"{PICTURES}/"), size, known[key], R, -R @ matrix[:, 3])
        points = content.get("ply_file_path")
    if points is not None:
        cloud = read_ply(path.parent / str(points))
        finite = cloud.X.isfinite().all(-1)
        rows.X = cloud.X[finite].numpy()
        rows.color = None if cloud.color is None else cloud.color[finite].nan_to_num(0).numpy()
    with reading(path, "a transforms.json"):
        return rows.join()


def _lens(about: dict[str, Any], picture: Path) -> tuple[Lens, tuple[int, int]]:
    """The camera of a frame, and the size of its picture."""
    size = (int(about["w"]), int(about["h"])) if "w" in about and "h" in about else None
    size = size or picture_size(picture) or picture_size(picture.with_suffix(".png"))
    if size is None:
        raise ValueError(f"it does not tell the size of {about['file_path']}")
    width, height = size
    fx = float(about["fl_x"]) if "fl_x" in about else 0.5 * width / math.tan(0.5 * float(about["camera_angle_x"]))
    f = (fx, float(about.get("fl_y", fx)))
    c = (float(about.get("cx", width / 2)) - HALF_PIXEL, float(about.get("cy", height / 2)) - HALF_PIXEL)
    values = {name: float(about[name]) for name in LENS_NUMBERS if name in about}
    match about.get("camera_model", "OPENCV"):
        case "OPENCV_FISHEYE":
            return Lens(f, c, KannalaBrandt, {name: values.get(name, 0.0) for name in KannalaBrandt.parameter_names}), size
        case "PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" | "FULL_OPENCV":
            return Lens.simplest(f, c, values), size
        case other:
            raise ValueError(f"camera model {other!r}, which has no equal here")
