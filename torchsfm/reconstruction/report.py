"""What happened to each image and each pair on the way to the models."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from torchsfm.reconstruction.mapping.calibration import Calibration
from torchsfm.reconstruction.matching.view_graph import Verdict
from torchsfm.reconstruction.messages import ReconstructionError, describe_skipped, printable
from torchsfm.reconstruction.model.reconstruction import Reconstruction

STILL = "they stand still where the scene moves, as a watermark or a part of the vehicle does"


@dataclass(frozen=True)
class ImageReport:
    """What became of one image.

    Attributes:
        name: File name.
        model: The number of its model (0 is the largest), or None.
        reason: Why it is in none.
        features: Number of features found in it.
        doubt: Why its place in the model may be wrong; empty where nothing says so.
        rotation_sigma: Standard deviation of its rotation, degrees; infinite where it is not known.
        position_sigma: Standard deviation of its place over the median distance of the points that it sees.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(4, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X)
        >>> x[3] = x[3, torch.randperm(60, generator=g)]  # the last image has nothing to do with the others
        >>> view, track = torch.arange(4).repeat_interleave(60), torch.arange(60).repeat(4)
        >>> found = torchsfm.reconstruct_tracks(x.flatten(0, 1), view, track, torch.tensor([[1000, 750]] * 4), K=K)
        >>> [image.model for image in found.report.images]
        [0, 0, 0, None]
        >>> found.report.images[3].reason
        'has too little in common with every other image'
    """

    name: str
    model: int | None
    reason: str = ""
    features: int = 0
    doubt: str = ""
    rotation_sigma: float = math.inf
    position_sigma: float = math.inf


@dataclass(frozen=True)
class PairReport:
    """All compared pairs: matches, how many agree with F and with H, and what that says of the pair.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.reconstruction import Verdict
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(3, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X)
        >>> x[2] = x[2, torch.randperm(60, generator=g)]
        >>> pairs, same = torch.tensor([[0, 1], [0, 2], [1, 2]]), torch.arange(60)[:, None].expand(60, 2)
        >>> report = torchsfm.reconstruct_matches(list(x), pairs, [same] * 3, torch.tensor([[1000, 750]] * 3), K=K).report.pairs
        >>> report.num_matches, report.fundamental_inliers > 50
        (tensor([60, 60, 60]), tensor([ True, False, False]))
        >>> [Verdict(k).name for k in report.verdict.tolist()]
        ['GENERAL', 'UNRELATED', 'UNRELATED']
    """

    pairs: Int[Tensor, "q 2"]
    """The numbers of both images."""
    num_matches: Int[Tensor, "q"]
    """Matches that were given or found."""
    fundamental_inliers: Int[Tensor, "q"]
    """Of these, how many agree with the fundamental matrix."""
    homography_inliers: Int[Tensor, "q"]
    """How many agree with a homography."""
    verdict: Int[Tensor, "q"]
    """A `Verdict` each."""

    def count(self, verdict: Verdict) -> int:
        """Number of pairs with this verdict."""
        return int((self.verdict == verdict).sum())


@dataclass(frozen=True)
class Report:
    """The course of a reconstruction.

    Attributes:
        images: One entry per input file, in the order of the input.
        pairs: The comparison of all pairs, with indices into the images that could be read (see `compared_names`).
        seconds: Wall-clock time of each stage.
        focal_source: Where each camera's first focal length came from: "given", "exif", "autocalibration", "fundamental
            matrices" or "default".
        autocalibration: For each set of images that was autocalibrated what was assumed, found and determined, or why not.
        skipped: Files and folders in the input folder that may hold photographs but were passed over, each with the reason.
        calibrations: For each model how its cameras were found, and how well they are known.
        method: How the models were made: "incremental", "projective", "global", "windows" or "curves"; empty where the cameras
            were given.
        refusal: Why there is no model, where the method can tell; empty else.
        still: Matches left out because they stand still where the scene moves: of watermarks, dates, parts of a vehicle.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(3, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X).flatten(0, 1)
        >>> view, track = torch.arange(3).repeat_interleave(60), torch.arange(60).repeat(3)
        >>> report = torchsfm.reconstruct_tracks(x, view, track, torch.tensor([[1000, 750]] * 3), K=K).report
        >>> report.focal_source, report.method, len(report.pairs.pairs)
        (('given',), 'incremental', 3)
        >>> report.summary().splitlines()[0]
        '3 pairs compared: 3 general, 0 planar, 0 pure rotation, 0 unrelated'
    """

    images: tuple[ImageReport, ...]
    pairs: PairReport
    seconds: dict[str, float]
    focal_source: tuple[str, ...] = ()
    autocalibration: tuple[str, ...] = ()
    skipped: tuple[tuple[str, str], ...] = ()
    calibrations: tuple[Calibration, ...] = ()
    method: str = ""
    refusal: str = ""
    still: int = 0

    def compared_names(self) -> list[str]:
        """Names of the images that could be read, by the numbers that `pairs` has for them."""
        return [
            image.name
            for image in self.images
            if image.model is not None or image.features > 0 or image.reason.startswith("only 0 features")
        ]

    def summary(self) -> str:
        """A few lines for people."""
        lines = []
        if len(self.pairs.pairs):
            names = {Verdict.GENERAL: "general", Verdict.PLANAR: "planar", Verdict.ROTATION: "pure rotation"}
            kinds = ", ".join(f"{self.pairs.count(kind)} {name}" for kind, name in names.items())
            lines.append(f"{len(self.pairs.pairs)} pairs compared: {kinds}, {self.pairs.count(Verdict.UNRELATED)} unrelated")
        if self.still:
            lines.append(f"{self.still} matches left out: {STILL}")
        if self.method:
            lines.append(f"method: {self.method}")
        if self.focal_source:
            lines.append("focal length first from: " + ", ".join(sorted(set(self.focal_source))))
        lines += [f"autocalibration: {text}" for text in self.autocalibration]
        for number, calibration in enumerate(self.calibrations):
            prefix = f"model {number}: " if len(self.calibrations) > 1 else ""
            remarks = [calibration.remark] if calibration.remark else []
            lines += [prefix + text for text in (*remarks, *calibration.doubts())]
        for image in self.images:
            if image.model is None:
                lines.append(printable(f"not registered: {image.name} ({image.reason})"))
        lines += [f"not read: {text}" for text in describe_skipped(self.skipped)]
        lines += [printable(f"doubtful: {image.name} ({image.doubt})") for image in self.images if image.doubt]
        lines.append("seconds: " + ", ".join(f"{stage} {time:.1f}" for stage, time in self.seconds.items()))
        return "\n".join(lines)


@dataclass(frozen=True)
class SfmResult:
    """Models, the largest first (none when nothing could be reconstructed), and the report.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x, track = torch.rand(60, 2, generator=g, dtype=torch.float64) * 700, torch.arange(60)
        >>> still = x.repeat(2, 1)  # two images of a camera that did not move
        >>> view = torch.arange(2).repeat_interleave(60)
        >>> found = torchsfm.reconstruct_tracks(still, view, track.repeat(2), torch.tensor([[1000, 750]] * 2))
        >>> len(found.models)
        0
        >>> found.failure()
        'the camera only turned about its centre, or zoomed, which gives no depth'
    """

    models: tuple[Reconstruction, ...]
    """The models, the largest first."""
    report: Report
    """What became of every image and pair."""

    @property
    def model(self) -> Reconstruction:
        """The largest model.

        Raises:
            ReconstructionError: Nothing could be reconstructed; the message says why.
        """
        if not self.models:
            raise ReconstructionError("nothing could be reconstructed: " + self.failure())
        return self.models[0]

    def failure(self) -> str:
        """Why there is no model, in one line."""
        if self.report.refusal:
            return self.report.refusal
        pairs = self.report.pairs
        readable = sum(1 for image in self.report.images if image.features)
        if readable < 2:
            return f"{readable} of {len(self.report.images)} images show anything to match"
        related = int((pairs.verdict != Verdict.UNRELATED).sum())
        if not related:
            return f"none of the {len(pairs.pairs)} pairs of images have enough in common"
        if pairs.count(Verdict.ROTATION) == related:
            return "the camera only turned about its centre, or zoomed, which gives no depth"
        if self.report.autocalibration:
            return "autocalibration: " + self.report.autocalibration[0]
        return f"no model could be started from the {related} pairs of images that have something in common"


def pair_report(pairs: Tensor, num_matches: Tensor, num_F: Tensor, num_H: Tensor, verdict: Tensor) -> PairReport:
    """A pair report with integer tensors."""
    return PairReport(*(t.to(torch.long) for t in (pairs, num_matches, num_F, num_H, verdict)))
