"""Lines and curves of a model that was merged from two halves, beside those of the whole."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.reconstruction import Reconstruction

NEAR = 0.1
"""Metres within which a place of one model's structure counts as there in another's."""
TURN = 0.035
"""Largest angle between lines that are one, in radians."""
STEP = 0.1
"""Metres between the places of a line that are looked up."""
HEAD = """
| model | {what} | images each | error, median px | of it in the whole | of the whole in it |
|---|---|---|---|---|---|"""
CHUNK = 500


def line_row(name: str, model: Reconstruction, whole: Reconstruction) -> str:
    """A row of the table of lines; both models in metres of one frame."""
    assert model.lines is not None
    assert whole.lines is not None
    ends, others = model.lines.ends, whole.lines.ends
    shares = [float(lines_near(a, b).double().mean()) for a, b in ((ends, others), (others, ends))]
    error = float(model.line_residuals().norm(dim=-1).median())
    seen = float(model.lines.support().double().mean())
    return f"| {name} | {len(ends)} | {seen:.2f} | {error:.3f} | {100 * shares[0]:.1f} % | {100 * shares[1]:.1f} % |"


def curve_row(name: str, model: Reconstruction, whole: Reconstruction) -> str:
    """A row of the table of curves, by their samples; both models in metres of one frame."""
    assert model.curves is not None
    assert whole.curves is not None
    X, others = model.curves.X, whole.curves.X
    shares = [float(samples_near(a, b).double().mean()) for a, b in ((X, others), (others, X))]
    error, seen = float(model.curve_residuals().median()), float(model.curves.support().double().mean())
    return f"| {name} | {len(X)} | {seen:.2f} | {error:.3f} | {100 * shares[0]:.1f} % | {100 * shares[1]:.1f} % |"


def lines_near(ends: Float[Tensor, "l 2 3"], others: Float[Tensor, "m 2 3"]) -> Bool[Tensor, "n"]:
    """Of places along lines, whether another line of the same direction passes."""
    direction = torch.nn.functional.normalize(ends[:, 1] - ends[:, 0], dim=-1)
    length = (ends[:, 1] - ends[:, 0]).norm(dim=-1)
    count = (length / STEP).ceil().long().clamp(min=2)
    line = torch.arange(len(ends)).repeat_interleave(count)
    first = (count.cumsum(0) - count)[line]
    share = (torch.arange(len(line)) - first) / (count[line] - 1)
    X = torch.lerp(ends[line, 0], ends[line, 1], share[:, None].to(ends))
    along = others[:, 1] - others[:, 0]
    size = along.square().sum(-1).clamp_min(1e-300)
    parallel = torch.linalg.cross(direction[:, None], torch.nn.functional.normalize(along, dim=-1)[None]).norm(dim=-1) < TURN
    near = []
    for x, of in zip(X.split(CHUNK), line.split(CHUNK), strict=True):
        gap = x[:, None] - others[:, 0]
        place = ((gap * along).sum(-1) / size).clamp(0, 1)
        distance = (gap - place[..., None] * along).norm(dim=-1)
        near.append(((distance < NEAR) & parallel[of]).any(-1))
    return torch.cat(near)


def samples_near(X: Float[Tensor, "n 3"], others: Float[Tensor, "m 3"]) -> Bool[Tensor, "n"]:
    """Whether a sample of another curve is near."""
    return torch.cat([(torch.cdist(x, others) < NEAR).any(-1) for x in X.split(CHUNK)])
