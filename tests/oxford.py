"""The Oxford sequences as the tests read them: points and line segments of several views, with Oxford's cameras."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor


def read(data: Path, name: str, views: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Points (v, n, 2) and segments (v, m, 2, 2) that all of some views see, and cameras (v, 3, 4)."""
    folder = data / "vgg" / name / "2D"
    cameras = sorted(folder.glob("*.P")) or sorted((folder.parent / "3D").glob("*.P"))
    P = torch.tensor(np.stack([np.loadtxt(cameras[k]) for k in views]))
    found = []
    for kind, columns in (("corners", 2), ("lines", 4)):
        files = [p for p in sorted(folder.glob(f"*.{kind}")) if "nview" not in p.name]
        (table,) = folder.glob(f"*nview-{kind}")
        rows = [line.split() for line in table.read_text().splitlines() if line.strip()]
        index = torch.tensor([[-1 if entry == "*" else int(entry) for entry in row] for row in rows]).T[views]
        index = index[:, (index >= 0).all(0)]
        features = [torch.tensor(np.loadtxt(files[k])[:, :columns]) for k in views]
        found.append(torch.stack([f[i] for f, i in zip(features, index, strict=True)]))
    return found[0], found[1].unflatten(-1, (2, 2)), P


def lines_of(segments: Tensor) -> Tensor:
    """Lines with unit normal through end points (..., 2, 2)."""
    a, b = (torch.nn.functional.pad(x, (0, 1), value=1.0) for x in segments.unbind(-2))
    line = torch.linalg.cross(a, b, dim=-1)
    return line / line[..., :2].norm(dim=-1, keepdim=True)
