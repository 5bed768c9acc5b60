"""OpenMVG's `sfm_data.json` (version 0.3): views, intrinsics, poses and structure.

A pose is a rotation, world to camera, and a centre; the centre of the top-left pixel is at (0, 0), as here. One focal length a
camera. Colours have no place in the file.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from torchsfm.formats.joining import Lens, Rows, numbers, reading, running_numbers
from torchsfm.geometry import BrownConrady, Camera, KannalaBrandt, Radial
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction

FIRST = 2**31
"""Added to the number of an object, or of the name of a type, where it occurs for the first time (the way of cereal)."""
PLAIN = 2**30
"""The number of the type of views that are nothing more."""
NONE = 2**32 - 1
LENSES = {"disto_k1": ("k1",), "disto_k3": ("k1", "k2", "k3"), "disto_t2": ("k1", "k2", "k3", "p1", "p2")}
"""The arrays of distortion and what they hold; as the fisheye's, k1 to k4."""


@on_the_cpu
def write_openmvg(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write a model as `sfm_data.json`.

    Pinholes are written as pinhole, radial distortion as pinhole_radial_k3, Brown-Conrady as pinhole_brown_t2, Kannala-Brandt
    as fisheye.

    Args:
        reconstruction: The model.
        path: The file to write.

    Raises:
        ValueError: A camera has skew, or pixels that are not square, for which the format has no place.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_openmvg(torchsfm.read_model("model.npz"), "sfm_data.json")
        >>> import json
        >>> from pathlib import Path
        >>> list(json.loads(Path("sfm_data.json").read_text()))
        ['sfm_data_version', 'root_path', 'views', 'intrinsics', 'extrinsics', 'structure', 'control_points']
    """
    model = reconstruction.to("cpu").to(dtype=reconstruction.X.double().dtype)
    ids: dict[tuple[int, int, int], int] = {}
    intrinsics: list[Any] = []
    views: list[Any] = []
    named: dict[str, int] = {}
    camera_of = zip(model.camera_index.tolist(), model.image_size.tolist(), strict=True)
    for i, (name, (k, (width, height))) in enumerate(zip(model.names, camera_of, strict=True)):
        key = (k, width, height)
        if key not in ids:
            ids[key] = len(ids)
            kind, data = _describe(model.cameras[k], k, width, height)
            new: dict[str, Any] = {} if kind in named else {"polymorphic_name": kind}
            head = {"polymorphic_id": named.setdefault(kind, len(named) + 1) + (FIRST if new else 0), **new}
            pointer = {"id": FIRST + len(model.names) + len(ids), "data": data}
            intrinsics.append({"key": ids[key], "value": head | {"ptr_wrapper": pointer}})
        folder, _, base = name.rpartition("/")
        data = {"local_path": folder, "filename": base, "width": width, "height": height, "id_view": i}
        data |= {"id_intrinsic": ids[key], "id_pose": i}
        views.append({"key": i, "value": {"polymorphic_id": PLAIN, "ptr_wrapper": {"id": FIRST + 1 + i, "data": data}}})
    R, centre = model.poses.R.tolist(), model.poses.centre.tolist()
    posed = model.registered.nonzero()[:, 0].tolist()
    columns = zip(model.view.tolist(), running_numbers(model.view), model.x.tolist(), strict=True)
    seen = [{"key": view, "value": {"id_feat": feature, "x": x}} for view, feature, x in columns]
    ends = np.cumsum(model.track_lengths().numpy()).tolist()
    starts = [0, *ends][: len(ends)]
    structure = zip(model.X.tolist(), starts, ends, strict=True)
    content = {
        "sfm_data_version": "0.3",
        "root_path": "",
        "views": views,
        "intrinsics": intrinsics,
        "extrinsics": [{"key": i, "value": {"rotation": R[i], "center": centre[i]}} for i in posed],
        "structure": [{"key": k, "value": {"X": X, "observations": seen[a:b]}} for k, (X, a, b) in enumerate(structure)],
        "control_points": [],
    }
    with whole_file(path) as file:
        file.write(json.dumps(content).encode())


def _describe(camera: Camera, index: int, width: int, height: int) -> tuple[str, dict[str, Any]]:
    """The name of a camera's type, and its numbers."""
    (fx, skew, cx), (_, fy, cy) = camera.K[0].tolist(), camera.K[1].tolist()
    if abs(skew) > 1e-9 * abs(fx) or abs(fy - fx) > 1e-9 * abs(fx):
        raise ValueError(f"camera {index} has skew or pixels that are not square, which sfm_data.json has no place for")
    plain = {"width": width, "height": height, "focal_length": fx, "principal_point": [cx, cy]}
    lens = camera.distortion
    values = {name: float(getattr(lens, name)) for name in lens.parameter_names}
    if isinstance(lens, KannalaBrandt):
        return "fisheye", {"value0": plain, "fisheye": list(values.values())}
    if isinstance(lens, BrownConrady):
        return "pinhole_brown_t2", {"value0": plain, "disto_t2": [values[name] for name in LENSES["disto_t2"]]}
    if values:
        return "pinhole_radial_k3", plain | {"disto_k3": [values.get(name, 0.0) for name in LENSES["disto_k3"]]}
    return "pinhole", plain


@on_the_cpu
def read_openmvg(path: str | Path) -> Reconstruction:
    """Read a model from `sfm_data.json`.

    Args:
        path: The file.

    Returns:
        The model, in float64, with grey points. Images come in the order of their numbers. Views without intrinsics are left
        out.

    Raises:
        ValueError: The file is none such, or a damaged one, or has cameras that have no equal here; one line that says why.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_openmvg(torchsfm.read_model("model.npz"), "sfm_data.json")
        >>> torchsfm.read_openmvg("sfm_data.json").X.shape
        torch.Size([20, 3])
    """
    path = Path(path)
    data = path.read_bytes()
    with reading(path, "an OpenMVG file"):
        content = json.loads(data)
        rows, camera_of = Rows(), {}
        for entry in content["intrinsics"]:
            camera_of[int(entry["key"])] = len(rows.lenses)
            rows.lenses.append(_lens(entry["value"]["ptr_wrapper"]["data"]))
        poses = {
            int(entry["key"]): (numbers(entry["value"]["rotation"], 3, 3), numbers(entry["value"]["center"], 3))
            for entry in content["extrinsics"]
        }
        row_of: dict[int, int] = {}
        views = [entry["value"]["ptr_wrapper"]["data"] for entry in content["views"]]
        for view in sorted(views, key=lambda view: int(view["id_view"])):
            if int(view["id_intrinsic"]) == NONE:
                continue
            name = f"{view['local_path']}/{view['filename']}" if view.get("local_path") else str(view["filename"])
            R, centre = poses.get(int(view["id_pose"]), (None, None))
            row_of[int(view["id_view"])] = len(rows.names)
            t = None if R is None or centre is None else -R @ centre
            rows.add_image(name, (int(view["width"]), int(view["height"])), camera_of[int(view["id_intrinsic"])], R, t)
        points = [entry["value"] for entry in content.get("structure", [])]
        rows.X = numbers([point["X"] for point in points], -1, 3)
        seen = [(row_of[int(o["key"])], k, o["value"]["x"]) for k, point in enumerate(points) for o in point["observations"]]
        rows.view, rows.point = [view for view, _, _ in seen], [point for _, point, _ in seen]
        rows.x = numbers([x for _, _, x in seen], -1, 2)
        return rows.join()


def _lens(data: dict[str, Any]) -> Lens:
    about = {**data, **data.get("value0", {})}
    f = float(about["focal_length"])
    cx, cy = numbers(about["principal_point"], 2).tolist()
    if "fisheye" in about:
        values = numbers(about["fisheye"], 4).tolist()
        return Lens((f, f), (cx, cy), KannalaBrandt, dict(zip(("k1", "k2", "k3", "k4"), values, strict=True)))
    for name, held in LENSES.items():
        if name in about:
            found = dict(zip(held, numbers(about[name], len(held)).tolist(), strict=True))
            brown = name == "disto_t2" or found.get("k3", 0) != 0
            return Lens((f, f), (cx, cy), BrownConrady if brown else Radial, {n: v for n, v in found.items() if v or brown})
    if other := [name for name in about if name.startswith("disto")]:
        raise ValueError(f"a camera with {other[0]}, which has no equal here")
    return Lens.simplest((f, f), (cx, cy), {})
