"""Models one after the other, each of images that those before it left."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import DISTORTION_MODELS
from torchsfm.reconstruction.evidence.consistency import PairAgreement
from torchsfm.reconstruction.evidence.missing import Conflicts
from torchsfm.reconstruction.mappers.beginning import Beginning, Grown, grow_by
from torchsfm.reconstruction.mappers.choose_mapper import choose_mapper
from torchsfm.reconstruction.mappers.cropped import map_cropped, may_be_off_centre
from torchsfm.reconstruction.mappers.incremental import MappingOptions, extend_model, finish
from torchsfm.reconstruction.mappers.projective import projective_start
from torchsfm.reconstruction.mappers.rivals import rival_focal
from torchsfm.reconstruction.mappers.settle import settle
from torchsfm.reconstruction.mappers.unfold import unfold
from torchsfm.reconstruction.mappers.zoomed import better_beginning, part_zoomed
from torchsfm.reconstruction.mapping.cameras import group_bodies, group_cameras
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.tracks import build_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.messages import ReconstructionError

METHODS = ("incremental", "projective", "global", "windows", "auto")
MIN_IMAGES = 2
"""Smallest number of images of a model."""


@dataclass(frozen=True)
class Given:
    """What is known of images before any model.

    Attributes:
        graph: Image points and verified matches.
        labels: What the files say of the camera, per image.
        exif_focal: Focal length in pixels stated in each file.
        track: Track of each image point, or None to build tracks from the matches.
        known_cameras: Whether labels tell for certain which images one camera took.
    """

    graph: ViewGraph
    labels: Sequence[str]
    exif_focal: Sequence[float | None]
    track: Int[Tensor, "n"] | None = None
    known_cameras: bool = False


@dataclass(frozen=True)
class Wanted:
    """How models are to be made; see `reconstruct`.

    Attributes:
        camera: Name of the distortion model; None for "radial", or what explains the images better, or "pinhole" where the
            camera is known.
        shared_camera: Whether one camera took all images of the same size.
        K: Known intrinsics.
        free_principal_point: Whether to estimate the principal point.
        aspect: About how many times as much as along x each image is stretched along y, which is estimated then; None where
            pixels are square.
        method: "incremental", "projective", "global", "windows", or "auto" for what `choose_mapper` and `best_attempt` say.
    """

    camera: str | None = None
    shared_camera: bool | None = None
    K: Float[Tensor, "3 3"] | None = None
    free_principal_point: bool = True
    method: str = "auto"
    aspect: Float[Tensor, "v"] | None = None

    def __post_init__(self) -> None:
        if self.camera is not None and self.camera not in DISTORTION_MODELS:
            raise ReconstructionError(f"no camera model '{self.camera}'; there are {', '.join(DISTORTION_MODELS)}")
        if self.method not in METHODS:
            raise ReconstructionError(f"no method '{self.method}'; there are {', '.join(METHODS)}")
        if self.method == "projective" and self.K is not None:
            raise ReconstructionError(
                "the projective method finds the camera itself; known intrinsics are for the incremental one"
            )

    @property
    def lens(self) -> str:
        """Name of the distortion model."""
        return self.camera or ("radial" if self.K is None else "pinhole")

    @property
    def pixels_are_open(self) -> bool:
        """Whether images may say that they were stretched."""
        return self.K is None and self.method != "projective"

    @property
    def lens_is_open(self) -> bool:
        """Whether images may say that another lens took them."""
        return self.camera is None and self.pixels_are_open

    @property
    def free(self) -> tuple[str, ...]:
        """The intrinsic parameters to estimate."""
        focal, centre = (("focal",), ("principal_point",)) if self.K is None else ((), ())
        aspect = () if self.aspect is None else ("aspect",)
        return focal + aspect + DISTORTION_MODELS[self.lens].parameter_names + (centre if self.free_principal_point else ())


@dataclass(frozen=True)
class Component:
    """A model of images that hang together, and what its making told.

    Attributes:
        model: The model.
        options: How it was made.
        off_centre: Whether principal points seem not to be where those of whole images are, and no model with others is better.
        uncertain: Images that hang on a relation which may be one of like things, see `unfold`.
        conflicts: What missing correspondences say of it, if that is known.
        agreement: How all pairs agree with it, if that is known.
        rival: The focal length that explains each of few images nearly as well, see `rival_focal`.
    """

    model: Mapping
    options: MappingOptions
    off_centre: bool
    uncertain: Bool[Tensor, "v"] | None = None
    conflicts: Conflicts | None = None
    agreement: PairAgreement | None = None
    rival: Float[Tensor, "v"] | None = None

    def moved(self, model: Mapping) -> "Component":
        """With a model whose cameras are elsewhere, for which what pairs and missing correspondences said does not hold."""
        return self if model is self.model else replace(self, model=model, conflicts=None, agreement=None)

    def finished(self) -> "Component":
        """Adjusted by how well each track fits. Noise alone moves it: what pairs said of it holds."""
        return replace(self, model=finish(self.model, self.options))


@dataclass
class Growth:
    """Makes models until the images that are left make none.

    Attributes:
        begun: What all models begin with.
        method: One of `METHODS` but "auto".
        family: Images of the same number may be of one camera, by all but their size.
        copies: Whether what looks alike may have been taken for the same thing: tracks that are given are not.
        progress: Called with the number of registered images and of all.
        first: The first model, where choosing cameras has made it already.
        empty: A mapping without images; once a model was unfolded, without the relations that were given up.
        taken: Images that are in a model.
        given_up: Images that were in one which turned out to be folded.
        reasons: Why images that were tried do not fit.
        source: Where first focal lengths come from.
        autocalibration: What the projective method assumed and found, for each model.
    """

    begun: Beginning
    method: str
    family: Int[Tensor, "v"]
    copies: bool
    progress: Callable[[int, int], None]
    first: Grown | None
    empty: Mapping = field(init=False)
    taken: Bool[Tensor, "v"] = field(init=False)
    given_up: Bool[Tensor, "v"] = field(init=False)
    reasons: dict[int, str] = field(init=False, default_factory=dict)
    source: tuple[str, ...] = field(init=False)
    autocalibration: list[str] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.empty, self.source = self.begun.empty, self.begun.source
        self.taken = self.given_up = self.empty.registered

    @classmethod
    def of(cls, given: Given, wanted: Wanted, generator: torch.Generator, progress: Callable[[int, int], None]) -> "Growth":
        """Choose the cameras to begin with, and the method."""
        graph, track, method = given.graph, given.track, wanted.method
        if track is None:
            # Matches of strongly linked pairs come first: they are wrong less often.
            track = build_tracks(graph.view, graph.match, graph.fundamental_inliers[graph.match_pair])
        begin = partial(
            Beginning.of, graph, track, model=wanted.lens, K=wanted.K, exif_focal=given.exif_focal, free=wanted.free,
            generator=generator, aspect=wanted.aspect,
        )  # fmt: skip
        together = group_cameras(graph.image_size, given.labels, wanted.shared_camera, wanted.aspect)
        unsaid = wanted.shared_camera is None and not given.known_cameras
        body = group_bodies(graph.image_size, given.labels, wanted.aspect) if unsaid else None
        begun = begin(together, body=body)
        if method == "auto":
            method = choose_mapper(graph.pairs, graph.fundamental_inliers, begun.options.focal_sigma[together])
        first: Grown | None = None
        if unsaid and wanted.K is None and method != "projective":
            told = torch.tensor([focal is not None for focal in given.exif_focal])
            apart = part_zoomed(graph, together, told, wanted.aspect)
            if apart is not None:
                begun, first = better_beginning(begun, begin(apart, body=body), partial(_settled, method, progress))
        # Of images that do not differ but in size, one camera may have taken all, and some were cropped.
        family = group_cameras(torch.zeros_like(graph.image_size), given.labels, wanted.shared_camera)
        return cls(begun, method, family, given.track is None, progress, first)

    def by(self, method: str) -> "Growth":
        """From the same beginning, by another mapper."""
        return replace(self, method=method, first=None)

    def components(self) -> Iterator[Component]:
        """The models, in the order in which they are made."""
        number = 0
        while int((~self.taken).sum()) >= MIN_IMAGES:
            made = self._by_autocalibration() if self.method == "projective" else self._from_cameras()
            if made is None:
                return
            grown, failed = made
            model, parted, agreement = settle(grown.model, self.taken, grown.options, self.progress)
            if number == 0:
                self.reasons |= failed | parted
            component = replace(grown, model=model, agreement=agreement)
            if self.method != "projective":
                component = self._unfolded(component) if self.copies else component
                component = replace(component, rival=rival_focal(self.empty, component.model, component.options))
            self.taken, number = self.taken | component.model.registered, number + 1
            yield component.finished()

    def _from_cameras(self) -> tuple[Component, dict[int, str]] | None:
        """A model from first cameras, and why images that were tried do not fit."""
        options = self.begun.options
        grow = partial(grow_by, self.method, progress=self.progress)
        empty = replace(self.empty, registered=self.taken)
        grown, self.first = self.first or grow(empty, options), None
        if grown is None:
            return None
        off_centre = may_be_off_centre(grown[0], options)
        if off_centre:
            cropped = map_cropped(empty, grown[0], self.taken, options, self.family, grow, self.progress)
            if cropped is not None:
                (grown, options), off_centre = cropped, False
        return Component(grown[0], options, off_centre), grown[1]

    def _by_autocalibration(self) -> tuple[Component, dict[int, str]] | None:
        """A model without first cameras, and why images that were tried do not fit."""
        options = self.begun.options
        while True:
            start = projective_start(self.empty, ~self.taken, threshold=options.reprojection, min_angle=options.min_angle)
            if start is None:
                return None
            self.autocalibration.append(start.summary)
            if start.mapping is not None:
                self.source = tuple("autocalibration" for _ in start.focal_sigma)
                metric = replace(options, expected=start.expected(), focal_sigma=start.focal_sigma)
                model, failed = extend_model(start.mapping, self.taken, metric, self.progress)
                return Component(model, metric, off_centre=False), failed
            # What was refused is not tried again in smaller parts.
            self.taken = self.taken.clone()
            self.taken[start.views] = True
            self.reasons |= dict.fromkeys(start.views.tolist(), "autocalibration was refused")

    def _unfolded(self, component: Component) -> Component:
        """A model in which like things do not pass for the same one, as far as relations between images tell."""
        settled = component.model
        grow = partial(grow_by, self.method)
        unfolded = unfold(self.empty, settled, self.taken, component.options, self.progress, grow, component.agreement)
        model = unfolded.model
        self.given_up = self.given_up | (settled.registered & ~model.registered)
        # What is left is mapped without the relations that were given up.
        self.empty = replace(self.empty, graph=model.graph, track=model.track)
        return replace(component.moved(model), uncertain=unfolded.uncertain, conflicts=unfolded.conflicts)


def _settled(
    method: str, progress: Callable[[int, int], None], empty: Mapping, options: MappingOptions
) -> tuple[Grown, Mapping] | None:
    """The first model, and what is left of it without images that contradict it."""
    grown = grow_by(method, empty, options, progress)
    return None if grown is None else (grown, settle(grown[0], empty.registered, options, progress)[0])
