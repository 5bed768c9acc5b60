"""The edges of photographs, as they are and as a camera without distortion sees them."""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Camera
from torchsfm.images import detect_edges
from torchsfm.reconstruction.curves.edge_maps import EdgePoints
from torchsfm.reconstruction.curves.fusion import piece_tangents
from torchsfm.reconstruction.matching.image_points import nearest_colors


@dataclass(frozen=True)
class ImageEdges:
    """Edge points of an image, chain by chain, in order: the brighter side is to the left as seen on the screen."""

    x: Float[Tensor, "n 2"]
    """Pixels."""
    normal: Float[Tensor, "n 2"]
    """Unit vectors, from the x axis to the y axis of what is forwards."""
    curvature: Float[Tensor, "n"]
    """1/pixel, positive where the chain bends to the normal."""
    sigma: Float[Tensor, "n"]
    """Standard deviation across the edge, for the image's noise, pixels."""
    color: Float[Tensor, "n 3"]
    """Red, green, blue in [0, 1]."""
    chain: Int[Tensor, "n"]

    def __len__(self) -> int:
        """Number of edge points."""
        return len(self.x)

    @classmethod
    def of(cls, image: Float[Tensor, "c h w"], *, min_edgels: int = 8) -> "ImageEdges":
        """Those of an image, in chains of so many or more."""
        found = detect_edges(image, min_edgels=min_edgels)
        n = int(found.valid.sum())
        x, chain = found.x[:n], found.chain[:n]
        tangent = piece_tangents(x, chain)
        normal = torch.stack((-tangent[:, 1], tangent[:, 0]), -1)
        return cls(x, normal, found.curvature[:n], found.sigma[:n], nearest_colors(image, x).to(x), chain)

    @classmethod
    def none(cls) -> "ImageEdges":
        """Those of an image that is missing."""
        empty = torch.zeros(0)
        return cls(empty.reshape(0, 2), empty.reshape(0, 2), empty, empty, empty.reshape(0, 3), empty.long())

    def where(self, keep: Bool[Tensor, "n"]) -> "ImageEdges":
        """Some of the edge points; what is taken out of a chain leaves two."""
        chain, out = self.chain[keep], (~keep).long().cumsum(0)[keep]
        new = torch.zeros_like(chain)
        new[1:] = (chain[1:] != chain[:-1]) | (out[1:] != out[:-1])
        kept = {field.name: getattr(self, field.name)[keep] for field in fields(self)}
        return ImageEdges(**kept | {"chain": new.cumsum(0)})

    def seen_by(self, camera: Camera) -> tuple["ImageEdges", EdgePoints]:
        """Those that the camera's lens shows, and where they are without its distortion."""
        d, valid = camera.unproject(self.x.to(camera.K))
        good = valid & (d[:, 2] > 0.1)
        y = d[good].double() @ camera.K.double().mT
        x, kept = y[:, :2] / y[:, 2:], self.where(good)
        return kept, EdgePoints(x, piece_tangents(x, kept.chain), kept.chain)
