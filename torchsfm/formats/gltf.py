"""Binary glTF 2.0 (`.glb`) for Blender, browsers and game engines: the points and the cameras.

Cameras look down their negative z axis, y up, there: half a turn about the x axis, done here. They are pinholes whose axis goes
through the centre of the picture. Positions are in single precision.
"""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from torchsfm.formats.joining import cameras_within
from torchsfm.geometry import NoDistortion
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction

BYTES, FLOATS, POINTS, ARRAY = 5121, 5126, 0, 34962
"""Numbers of glTF for types of values, for points as what is drawn, and for data of vertices."""


@on_the_cpu
def write_gltf(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the coloured points and the cameras of the images that have a pose, each with the name of its image.

    Args:
        reconstruction: The model, of pinhole cameras.
        path: The file to write.

    Raises:
        ValueError: The format cannot hold these cameras: distortion, skew, or a principal point that is not the centre.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.formats.undistorted_model(torchsfm.read_model("model.npz"), centred=True)
        >>> torchsfm.write_gltf(model, "model.glb")
    """
    model = reconstruction.to("cpu").to(dtype=reconstruction.X.double().dtype)
    if cameras_within(model.cameras, NoDistortion) is None:
        raise ValueError(f"glTF has no {type(model.cameras.distortion).__name__} distortion; undistorted pictures have none")
    posed = model.registered.nonzero()[:, 0].tolist()
    R, centre = model.poses.R.mT.numpy() @ np.diag([1.0, -1.0, -1.0]), model.poses.centre.numpy()
    cameras, nodes = [], []
    for i in posed:
        K, (width, height) = model.cameras.K[model.camera_index[i]].numpy(), model.image_size[i].tolist()
        if max(abs(K[0, 2] - (width - 1) / 2), abs(K[1, 2] - (height - 1) / 2), abs(K[0, 1])) > 1e-6:
            raise ValueError("glTF has the principal point at the centre of the image; undistort the pictures, centred")
        angle, aspect = 2 * math.atan(height / (2 * K[1, 1])), (width / K[0, 0]) / (height / K[1, 1])
        cameras.append({"type": "perspective", "perspective": {"yfov": angle, "aspectRatio": aspect, "znear": 0.01}})
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = R[i], centre[i]
        name = model.names[i].encode("utf-8", "replace").decode()
        nodes.append({"name": name, "camera": len(cameras) - 1, "matrix": matrix.T.flatten().tolist()})
    content: dict[str, Any] = {"asset": {"version": "2.0", "generator": "torchsfm"}, "scene": 0}
    data = b""
    if model.num_points:
        X = model.X.numpy().astype("<f4")
        color = np.full((len(X), 4), 255, np.uint8)
        color[:, :3] = (model.color.clamp(0, 1) * 255).round().byte().numpy()
        data = X.tobytes() + color.tobytes()
        views = [(0, X.nbytes), (X.nbytes, color.nbytes)]
        content |= {
            "bufferViews": [{"buffer": 0, "byteOffset": at, "byteLength": size, "target": ARRAY} for at, size in views],
            "accessors": [
                {"bufferView": 0, "componentType": FLOATS, "count": len(X), "type": "VEC3",
                 "min": X.min(0).tolist(), "max": X.max(0).tolist()},
                {"bufferView": 1, "componentType": BYTES, "normalized": True, "count": len(X), "type": "VEC4"},
            ],
            "meshes": [{"name": "points", "primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": POINTS}]}],
            "buffers": [{"byteLength": len(data)}],
        }  # fmt: skip
        nodes.append({"name": "points", "mesh": 0})
    if cameras:
        content["cameras"] = cameras
    if nodes:
        content["nodes"] = nodes
    content["scenes"] = [{"nodes": list(range(len(nodes)))}] if nodes else [{}]
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if data:
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    with whole_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
