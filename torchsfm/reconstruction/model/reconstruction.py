"""The model: images, cameras, poses, points and the observations that tie them together."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.bundle.conics import ellipse_distances
from torchsfm.bundle.curves import edge_distances
from torchsfm.bundle.lines import segment_distances
from torchsfm.geometry import DISTORTION_MODELS, BundleProblem, Camera, Pose, Similarity
from torchsfm.reconstruction.model.conics import Conics
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.files import load_arrays, whole_file
from torchsfm.reconstruction.model.lines import Lines


@dataclass(frozen=True, kw_only=True)
class Reconstruction(BundleProblem):
    """Cameras and 3D points in one world frame, whose scale is arbitrary unless it was aligned to known positions.

    Images that could not be placed stay in the list with `registered` False and the identity as pose, so that indices mean the
    same in every model made from one set of images. Observations are sorted by point, then by image.

    Attributes:
        names: File names of the images.
        image_size: Width and height of each image in pixels.
        cameras: Intrinsics and distortion of the distinct cameras.
        camera_index: Which of the cameras took each image.
        poses: `cam_from_world` of each image.
        registered: Which images have a pose.
        X: Points in the world frame.
        color: Red, green, blue in [0, 1] of each point.
        x: Observed image points in pixels, the centre of the top-left pixel at (0, 0).
        view: Image of each observation.
        point: Point of each observation.
        lines: Lines and the segments that show them, where lines were looked for.
        conics: Ellipses in space and the measured ones that show them, where there are some.
        curves: Curves in space and the edge points that show them, where curves were looked for.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "problem.npz")
        >>> model = torchsfm.read_model("problem.npz")
        >>> model.num_registered, model.num_points, model.num_observations
        (3, 20, 50)
        >>> model.poses.centre.shape, bool(model.residuals().max() < 10)  # pixels
        (torch.Size([3, 3]), True)
    """

    names: tuple[str, ...]
    image_size: Int[Tensor, "v 2"]
    registered: Bool[Tensor, "v"]
    color: Float[Tensor, "n 3"]
    lines: Lines | None = None
    conics: Conics | None = None
    curves: Curves | None = None

    @property
    def num_registered(self) -> int:
        """Number of images with a pose."""
        return int(self.registered.sum())

    @property
    def num_points(self) -> int:
        """Number of 3D points."""
        return len(self.X)

    @property
    def num_observations(self) -> int:
        """Number of image points that belong to a 3D point."""
        return len(self.x)

    def to(self, *args: Any, **kwargs: Any) -> "Reconstruction":
        """Move to a device or floating dtype; the arguments are those of `Tensor.to`. Indices keep their integer type."""

        def move(tensor: Tensor) -> Tensor:
            moved = tensor.to(*args, **kwargs)
            return moved if tensor.is_floating_point() else moved.to(tensor.dtype)

        return tensor_map(move, self)

    def track_lengths(self) -> Int[Tensor, "n"]:
        """Number of observations of each point."""
        return torch.bincount(self.point, minlength=self.num_points)

    def view_errors(self) -> Float[Tensor, "v"]:
        """Mean reprojection error of each image in pixels; zero where an image has no observations."""
        total = self.X.new_zeros(len(self.names)).index_add(0, self.view, self.residuals())
        return total / torch.bincount(self.view, minlength=len(self.names)).clamp(min=1)

    def point_errors(self) -> Float[Tensor, "n"]:
        """Mean reprojection error of each point in pixels."""
        total = self.X.new_zeros(self.num_points).index_add(0, self.point, self.residuals())
        return total / self.track_lengths().clamp(min=1)

    def line_residuals(self) -> Float[Tensor, "k 2"]:
        """Distances of both ends of each segment from the image of its line, in pixels."""
        if self.lines is None:
            return self.X.new_zeros(0, 2)
        return segment_distances(self.poses, self.cameras[self.camera_index], self.lines.bundle(ends=True)).abs()

    def conic_residuals(self) -> Float[Tensor, "k"]:
        """Root-mean-square distance of each measured ellipse from the image of its ellipse in space, in pixels."""
        if self.conics is None:
            return self.X.new_zeros(0)
        apart = ellipse_distances(self.poses, self.cameras[self.camera_index], self.conics.bundle())
        return apart.square().mean(-1).sqrt()

    def curve_residuals(self) -> Float[Tensor, "k"]:
        """Distances of samples of curves from each edge point that shows them, across the edge, in pixels."""
        if self.curves is None:
            return self.X.new_zeros(0)
        return edge_distances(self.poses, self.cameras[self.camera_index], self.curves.bundle()).abs()

    def transform(self, similarity: Similarity) -> "Reconstruction":
        """The same model in another world frame, `X' = s R X + t`; reprojections do not change."""
        poses = similarity.transform_pose(self.poses)
        keep = self.registered
        poses = Pose(
            R=torch.where(keep[:, None, None], poses.R, self.poses.R), t=torch.where(keep[:, None], poses.t, self.poses.t)
        )
        lines = None if self.lines is None else self.lines.transform(similarity)
        conics = None if self.conics is None else self.conics.transform(similarity)
        curves = None if self.curves is None else self.curves.transform(similarity)
        return replace(self, X=similarity.transform(self.X), poses=poses, lines=lines, conics=conics, curves=curves)

    def summary(self) -> str:
        """A few lines for people: what was registered, how many points, how well they fit, the cameras found."""
        lines = [f"{self.num_registered} of {len(self.names)} images registered"]
        if self.num_points:
            length = self.num_observations / self.num_points
            known = f"{self.num_observations} observations, mean track length {length:.2f}"
            lines.append(f"{self.num_points} points, {known if self.num_observations else 'no observations'}")
        if self.num_observations:
            lines.append(f"mean reprojection error {float(self.residuals().mean()):.3f} px")
        if self.lines is not None and len(self.lines):
            shown = _shown(self.lines.support(), self.line_residuals())
            lines.append(f"{len(self.lines)} lines, {len(self.lines.x)} segments{shown}")
        if self.conics is not None and len(self.conics):
            lines.append(f"{len(self.conics)} ellipses{_shown(self.conics.support(), self.conic_residuals())}")
        if self.curves is not None and len(self.curves):
            shown = _shown(self.curves.support(), self.curve_residuals())
            lines.append(f"{len(self.curves)} curves, {len(self.curves.X)} samples{shown}")
        used = torch.unique(self.camera_index[self.registered]).tolist()
        for index in used:
            camera = self.cameras[index]
            (fx, _, cx), (_, fy, cy) = camera.K[0].tolist(), camera.K[1].tolist()
            text = f"camera {index}: f = {fx:.2f}" + ("" if abs(fx - fy) < 1e-9 * fx else f", {fy:.2f}")
            text += f", principal point ({cx:.2f}, {cy:.2f}) px"
            values = camera.distortion.parameters().tolist()
            names = camera.distortion.parameter_names
            text += "".join(f", {name} = {value:.5f}" for name, value in zip(names, values, strict=True))
            lines.append(text)
        return "\n".join(lines)

    def save(self, path: str | Path) -> None:
        """Write everything to one `.npz` file of plain arrays, without pickle."""
        arrays: dict[str, NDArray[Any]] = {
            f.name: getattr(self, f.name).detach().cpu().numpy()
            for f in fields(self)
            if isinstance(getattr(self, f.name), Tensor)
        }
        for prefix, some in (("line", self.lines), ("conic", self.conics), ("curve", self.curves)):
            if some is not None:
                arrays |= {f"{prefix}_{f.name}": getattr(some, f.name).detach().cpu().numpy() for f in fields(some)}
        distortion = self.cameras.distortion
        model = next(name for name, cls in DISTORTION_MODELS.items() if type(distortion) is cls)
        count = len(self.cameras.K)
        arrays |= {
            "names": np.array(self.names, dtype=np.str_),
            "camera_model": np.array(model),
            "camera_K": self.cameras.K.detach().cpu().numpy(),
            "camera_distortion": distortion.parameters().detach().cpu().numpy().reshape(count, distortion.num_parameters),
            "pose_R": self.poses.R.detach().cpu().numpy(),
            "pose_t": self.poses.t.detach().cpu().numpy(),
        }
        with whole_file(path) as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "Reconstruction":
        """Read what `save` wrote.

        Raises:
            ValueError: The file is not a saved reconstruction, or a damaged one: arrays missing or of other shapes, indices out
                of range, cameras that are not finite. One line that says which.
            OSError: It cannot be read.
        """
        try:
            arrays = load_arrays(Path(path))
            _check(arrays)
        except ValueError as error:
            raise ValueError(f"{path} is not a saved reconstruction ({error})") from None
        tensors = {name: torch.from_numpy(arrays[name]) for name in LAYOUT if name not in ("names", "camera_model")}
        lines = {name.removeprefix("line_"): torch.from_numpy(arrays[name]) for name in LINES if "line_ends" in arrays}
        conics = {name.removeprefix("conic_"): torch.from_numpy(arrays[name]) for name in CONICS if "conic_centre" in arrays}
        curves = {name.removeprefix("curve_"): torch.from_numpy(arrays[name]) for name in CURVES if "curve_X" in arrays}
        distortion = DISTORTION_MODELS[str(arrays["camera_model"])].from_parameters(tensors.pop("camera_distortion"))
        return cls(
            names=tuple(arrays["names"].tolist()),
            cameras=Camera(tensors.pop("camera_K"), distortion),
            poses=Pose(tensors.pop("pose_R"), tensors.pop("pose_t")),
            lines=Lines(**lines) if lines else None,
            conics=Conics(**conics) if conics else None,
            curves=Curves(**curves) if curves else None,
            **tensors,
        )


def _shown(support: Int[Tensor, "n"], apart: Tensor) -> str:
    """In how many images things are seen and how well they fit, in words; nothing where none is seen."""
    return f", in {support.double().mean():.2f} images each, {apart.mean():.3f} px off" if apart.numel() else ""


LAYOUT = {
    "names": ("v", "text"),
    "image_size": ("v 2", "integers"),
    "camera_model": ("", "text"),
    "camera_K": ("c 3 3", "numbers"),
    "camera_distortion": ("c p", "numbers"),
    "camera_index": ("v", "integers"),
    "pose_R": ("v 3 3", "numbers"),
    "pose_t": ("v 3", "numbers"),
    "registered": ("v", "yes or no"),
    "X": ("n 3", "numbers"),
    "color": ("n 3", "numbers"),
    "x": ("m 2", "numbers"),
    "view": ("m", "integers"),
    "point": ("m", "integers"),
}
"""The arrays of a saved model: shape, where a letter is the same number everywhere, and contents."""
LINES = {
    "line_ends": ("l 2 3", "numbers"),
    "line_color": ("l 3", "numbers"),
    "line_x": ("k 2 2", "numbers"),
    "line_weight": ("k", "numbers"),
    "line_view": ("k", "integers"),
    "line_line": ("k", "integers"),
}
"""Those of a model with lines."""
CONICS = {
    "conic_centre": ("e 3", "numbers"),
    "conic_axes": ("e 2 3", "numbers"),
    "conic_color": ("e 3", "numbers"),
    "conic_x": ("q 5", "numbers"),
    "conic_covariance": ("q 5 5", "numbers"),
    "conic_view": ("q", "integers"),
    "conic_conic": ("q", "integers"),
}
"""Those of a model with ellipses."""
CURVES = {
    "curve_X": ("s 3", "numbers"),
    "curve_curve": ("s", "integers"),
    "curve_closed": ("r", "yes or no"),
    "curve_color": ("s 3", "numbers"),
    "curve_sigma": ("s", "numbers"),
    "curve_x": ("o 2", "numbers"),
    "curve_normal": ("o 2", "numbers"),
    "curve_curvature": ("o", "numbers"),
    "curve_weight": ("o", "numbers"),
    "curve_view": ("o", "integers"),
    "curve_sample": ("o", "integers"),
}
"""Those of a model with curves."""
KINDS = {"text": "U", "integers": "i", "numbers": "f", "yes or no": "b"}


def _check(arrays: dict[str, NDArray[Any]]) -> None:
    """See that arrays make a model.

    Raises:
        ValueError: One is missing, has the wrong shape or type, is not finite where it must be, or points at what is not there.
    """
    sizes: dict[str, int] = {}
    others = {"line_ends": LINES, "conic_centre": CONICS, "curve_X": CURVES}
    layout = LAYOUT | {name: what for first, some in others.items() if first in arrays for name, what in some.items()}
    for name, (shape, kind) in layout.items():
        if name not in arrays:
            raise ValueError(f"it has no array '{name}'")
        array = arrays[name]
        words = shape.split()
        pairs = zip(words, array.shape, strict=False)
        wanted = [int(word) if word.isdigit() else sizes.setdefault(word, size) for word, size in pairs]
        if array.ndim != len(words) or list(array.shape) != wanted:
            raise ValueError(f"{name}: wanted shape ({shape}){f' with {sizes}' if sizes else ''}, got {array.shape}")
        if array.dtype.kind != KINDS[kind]:
            raise ValueError(f"{name}: wanted {kind}, got {array.dtype}")
        if kind == "numbers" and not name.endswith("color") and array.size and array.dtype != arrays["camera_K"].dtype:
            raise ValueError(f"{name}: wanted {arrays['camera_K'].dtype} as camera_K has, got {array.dtype}")
    model = DISTORTION_MODELS.get(str(arrays["camera_model"]))
    if model is None or model.num_parameters != sizes["p"]:
        raise ValueError(f"camera_model: there is no {str(arrays['camera_model'])[:40]!r} with {sizes['p']} parameters")
    limits = {"camera_index": "c", "view": "v", "point": "n", "line_view": "v", "line_line": "l"}
    limits |= {"conic_view": "v", "conic_conic": "e", "curve_view": "v", "curve_sample": "s", "curve_curve": "r"}
    for name, limit in ((name, sizes[letter]) for name, letter in limits.items() if name in layout):
        bad = (arrays[name] < 0) | (arrays[name] >= limit)
        if bad.any():
            raise ValueError(f"{name}: there is no number {arrays[name][bad][0]} among {limit}")
    if "curve_curve" in layout and (np.diff(arrays["curve_curve"]) < 0).any():
        raise ValueError("curve_curve: not ascending")
    for name in ("camera_K", "camera_distortion", "pose_R", "pose_t"):
        rows = arrays[name][arrays["registered"]] if name.startswith("pose") else arrays[name]
        if not np.isfinite(rows).all():
            raise ValueError(f"{name}: not finite")
