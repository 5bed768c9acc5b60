"""Where photographs say that they were taken: the positions in their Exif tags or XMP, as a local frame in metres."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import enu_from_geodetic, geodetic_from_enu
from torchsfm.images import parse_exif
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.alignment import Alignment, align_to_positions
from torchsfm.reconstruction.model.reconstruction import Reconstruction

MOST_BYTES = 2**30
"""A larger file is no photograph."""


@dataclass(frozen=True)
class GpsAlignment:
    """The similarity to metres east, north and up of an origin.

    Attributes:
        alignment: The similarity, and how far each camera is from where the receiver said.
        origin: Latitude and longitude in degrees, WGS84, and height in metres, of zero.
        photographs: How many files of the model's images were found.

    Example:
        >>> import torch, torchsfm
        >>> from pathlib import Path
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(6, 20, 100, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> home = torch.tensor([55.7041, 13.1914, 52.0]).double()  # latitude, longitude, height
        >>> flown = torchsfm.geometry.geodetic_from_enu(10 * model.poses.centre, home)
        >>> words = "drone-dji:GpsLatitude", "drone-dji:GpsLongitude", "drone-dji:AbsoluteAltitude"
        >>> for name, place in zip(model.names, flown.tolist()):
        ...     said = " ".join(f"{word}='{value}'" for word, value in zip(words, place))
        ...     size = Path(name).write_text(f"<rdf:RDF><a {said}/></rdf:RDF>")
        ...
        >>> found = torchsfm.reconstruction.align_to_gps(model, ".")
        >>> metric = model.transform(found.alignment.similarity)  # metres east, north and up of `found.origin`
        >>> again = torchsfm.geometry.geodetic_from_enu(metric.poses.centre, found.origin)
        >>> off = torchsfm.geometry.enu_from_geodetic(again, home) - 10 * model.poses.centre
        >>> bool(off.norm(dim=-1).max() < 1e-3), bool(found.alignment.distance.max() < 1e-3)  # metres
        (True, True)
    """

    alignment: Alignment
    origin: Float[Tensor, "3"]
    photographs: int

    def summary(self) -> str:
        """One line for people."""
        latitude, longitude, height = self.origin.tolist()
        return f"{self.alignment.summary('positions')}, origin {latitude:.7f} {longitude:.7f} at {height:.2f} m"

    def fault(self) -> str:
        """Why there is no similarity; empty where there is one."""
        count = len(self.alignment.names)
        if count < 3:
            return f"{count} of {self.photographs} photographs found have a position with a height, three are the least"
        return self.alignment.fault()


@on_the_cpu
def align_to_gps(model: Reconstruction, images: str | Path) -> GpsAlignment:
    """The similarity that carries a model to metres east, north and up, by the positions in its photographs' Exif or XMP.

    The origin is in the middle of the positions. Receivers are off by metres, more in height: see `align_to_positions` for what
    is left aside, and for when nothing is determined. Positions without a height do not count.

    Args:
        model: The model.
        images: The folder in which its photographs lie.

    Raises:
        OSError: A photograph cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> from pathlib import Path
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(6, 20, 100, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> home = torch.tensor([55.7041, 13.1914, 52.0]).double()  # latitude, longitude, height
        >>> flown = torchsfm.geometry.geodetic_from_enu(10 * model.poses.centre, home)
        >>> words = "drone-dji:GpsLatitude", "drone-dji:GpsLongitude", "drone-dji:AbsoluteAltitude"
        >>> for name, place in zip(model.names, flown.tolist()):  # as drones write it into photographs
        ...     said = " ".join(f"{word}='{value}'" for word, value in zip(words, place))
        ...     size = Path(name).write_text(f"<rdf:RDF><a {said}/></rdf:RDF>")
        ...
        >>> found = torchsfm.reconstruction.align_to_gps(model, ".")
        >>> found.alignment.similarity.scale, found.fault()
        (tensor(10.0000, dtype=torch.float64), '')
    """
    files = {name: Path(images) / name for name, there in zip(model.names, model.registered.tolist(), strict=True) if there}
    files = {name: path for name, path in files.items() if path.is_file() and path.stat().st_size < MOST_BYTES}
    places = gps_places(list(files.values()))
    known = places.isfinite().all(-1)
    names = [name for name, good in zip(files, known.tolist(), strict=True) if good]
    origin = torch.zeros(3, dtype=torch.float64)
    if names:
        # The median of degrees would be wrong where they jump from 180 to -180.
        first = places[known][0]
        origin = geodetic_from_enu(enu_from_geodetic(places[known], first).median(0).values, first)
    return GpsAlignment(align_to_positions(model, names, enu_from_geodetic(places[known], origin)), origin, len(files))


def gps_places(files: Sequence[str | Path]) -> Float[Tensor, "n 3"]:
    """Latitude, longitude (degrees) and height (metres) in the Exif tags or XMP of image files; NaN where there is none.

    Raises:
        OSError: A file cannot be read.

    See the example of `align_to_gps`.
    """
    rows = []
    for file in files:
        exif = parse_exif(Path(file).read_bytes())
        rows.append([math.nan if value is None else value for value in (exif.latitude, exif.longitude, exif.altitude)])
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
