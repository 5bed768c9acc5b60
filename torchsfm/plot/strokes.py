"""What of a model is drawn as pieces of straight lines: lines, ellipses and curves."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from torchsfm.reconstruction.model.reconstruction import Reconstruction


@dataclass(frozen=True)
class Stroke:
    """Straight pieces that are drawn and hidden together."""

    ends: Float[Tensor, "s 2 3"]
    color: Float[Tensor, "s 3"]
    summary: str


def model_strokes(model: Reconstruction) -> dict[str, Stroke]:
    """Lines, ellipses and curves, those kinds that there are."""
    strokes: dict[str, Stroke] = {}
    if model.lines is not None:
        drawn = model.lines.ends.isfinite().flatten(1).all(-1)
        text = f"{int(drawn.sum()):,} lines"
        if len(model.lines.x):
            support = float(model.lines.support().double().mean())
            text += f", in {support:.1f} images, mean error {float(model.line_residuals().nan_to_num().mean()):.3g} px"
        strokes["lines"] = Stroke(model.lines.ends[drawn], model.lines.color[drawn], text)
    if model.conics is not None:
        conics = model.conics.select(model.conics.axes.isfinite().flatten(1).all(-1) & model.conics.centre.isfinite().all(-1))
        chords = conics.chords()
        text = f"{len(conics):,} ellipses"
        if len(conics):
            text += f", in {float(conics.support().double().mean()):.1f} images"
        if len(model.conics.x):
            text += f", mean error {float(model.conic_residuals().nan_to_num().mean()):.3g} px"
        shades = conics.color.repeat_interleave(len(chords) // max(len(conics), 1), 0)
        strokes["ellipses"] = Stroke(chords, shades, text)
    if model.curves is not None:
        links = model.curves.links()
        links = links[model.curves.X.isfinite().all(-1)[links].all(-1)]
        text = f"{len(model.curves):,} curves"
        if len(model.curves.x):
            support = float(model.curves.support().double().mean())
            text += f", in {support:.1f} images, mean error {float(model.curve_residuals().nan_to_num().mean()):.3g} px"
        strokes["curves"] = Stroke(model.curves.X[links], model.curves.color[links[:, 0]], text)
    return strokes
