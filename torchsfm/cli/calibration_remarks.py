"""What `torchsfm calibrate` says of a calibration besides its numbers: what is doubtful, why, and what would help."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import PlaneCalibration
from torchsfm.autocalibration.board_shape import NAMES
from torchsfm.autocalibration.plane_doubts import DISAGREE, foreign_views, shift_by_centre, turn_of_board
from torchsfm.autocalibration.plane_models import bend

_UNSURE = 0.02
"""Standard deviation of the focal length, over it, that is worth a remark."""
_ALIKE = 10.0
"""Degrees by which a board has to turn between photographs to tell the focal length."""


def remarks(
    found: PlaneCalibration, x: Tensor, X: Tensor, options: dict[str, Any], names: Sequence[str], pitch: float
) -> list[str]:
    """Sentences.

    Args:
        found: The calibration.
        x: Points of the photographs.
        X: Those of the board.
        options: What it was found with.
        names: Of the photographs.
        pitch: Distance between neighbours.
    """
    sound = found.status == Status.OK
    said = [_shape(found, pitch)] if NAMES[0] in found.parameter_names else []
    contradictory = float(found.disagreement) > DISAGREE
    if contradictory:
        said.append(_contradiction(found, x, X, options, names))
    elif not sound:
        said.append(_too_little(found))
    deviation = float(found.deviation[0] / found.camera.K[0, 0])
    if sound and not contradictory and deviation > _UNSURE:
        said.append(f"Doubtful: the focal length is known to {100 * deviation:.2g} % only. {_more(found)}")
    if sound and "principal_point" not in options["free"]:
        shift = shift_by_centre(x, X, found, **options)
        if shift > float(found.deviation[0]):
            said.append(
                "The principal point was held in the middle of the photographs. If it is off that by a hundredth of their"
                f" width, as those of cameras are, the focal length is off by another {shift:.2g} px, which its standard"
                " deviation does not say."
            )
    return said


def _shape(found: PlaneCalibration, pitch: float) -> str:
    stretch = float(found.board_shape[0])
    return (
        f"The board is not what was said: its rows are {100 * abs(stretch):.2f} % too {'long' if stretch > 0 else 'short'}, and"
        f" its points are {bend(found.board):.3g} off a plane, from the lowest to the highest, where neighbours are {pitch:g}"
        " apart. The camera was found with that."
    )


def _contradiction(found: PlaneCalibration, x: Tensor, X: Tensor, options: dict[str, Any], names: Sequence[str]) -> str:
    ratio = float(found.disagreement)
    said = f"Doubtful: the photographs contradict each other {ratio:.1f} times more than their noise lets them"
    if found.status == Status.OK:
        said += ", by which the standard deviations are multiplied"
    foreign = [names[i] for i in foreign_views(x, X, found, **options)]
    if foreign:
        one = len(foreign) == 1
        return (
            f"{said}. Without {', '.join(foreign)} they agree: {'it' if one else 'they'} may be of another camera or zoom,"
            f" turned, mirrored or cropped, or show another board. Leave {'it' if one else 'them'} out."
        )
    held = "" if {"aspect", "principal_point"} <= set(options["free"]) else " what is held may be another number,"
    return (
        f"{said}. They may be of different cameras or zooms, some may be turned, mirrored or cropped, the lens may be of"
        f" another kind,{held} or the board may not be what was said, or have moved or bent between them."
    )


def _too_little(found: PlaneCalibration) -> str:
    if int(found.used.sum()) == 1:
        return "One photograph does not tell all of this: take more, from other directions, or hold what is known by --free."
    return f"The photographs say too little of the camera. {_more(found)}"


def _more(found: PlaneCalibration) -> str:
    turn = turn_of_board(found)
    if turn < _ALIKE:
        return f"The board turns by {turn:.1f} degrees between them: tilt it, or take it from the side, by 20 degrees and more."
    return "More of them would help, from other directions and with the board near the edges of the image."
