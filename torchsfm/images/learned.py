"""Learned detectors and matchers, for those who have their weights: kornia's DISK, DeDoDe and LightGlue.

Nothing is downloaded: weights come from files the user names, read without running code from them. What the weights may be used
for is the business of their own licence.
"""

import os
import pickle
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.images.features import Features
from torchsfm.images.matching import unit_descriptors
from torchsfm.images.reading import Photograph, pixels_of

DetectorName = Literal["disk", "dedode-b", "dedode-g"]
MatcherName = Literal["disk", "dedode-b", "dedode-g", "sift"]


@dataclass(frozen=True)
class LearnedDetector:
    """A network that finds and describes points; made by `load_detector`, called like `detect_features`.

    Example:
        >>> import torch, torchsfm
        >>> from kornia.feature import DISK
        >>> weights = DISK().state_dict()  # untrained; those of its authors come as a file
        >>> torch.save(weights, "weights.pth")
        >>> detector = torchsfm.images.load_detector("disk", "weights.pth")
        >>> features = detector(torch.rand(3, 64, 80, generator=torch.Generator().manual_seed(0)), max_features=50)
        >>> detector.name, features.descriptors.shape[1], bool((features.response.diff() <= 0).all())  # the best first
        ('disk', 128, True)
    """

    name: str
    """Of the network, as `load_detector` knows it."""
    network: torch.nn.Module
    """The network with its weights."""

    def __call__(
        self, image: Photograph | Float[Tensor, "c h w"], max_features: int = 8192, *, max_size: int = 1600
    ) -> Features:
        """The points of one image.

        Args:
            image: A photograph, or pixels in [0, 1], grey or red, green, blue.
            max_features: How many points are kept at most: those the network scores highest.
            max_size: Larger images are scaled down to this longer side; positions are those of the image given.

        Returns:
            Points in descending order of score, on the network's device, `response` being the score. These networks give no
            size and no orientation: `scale` is that of one pixel of the image the network saw, `angle` is 0.

        Raises:
            ValueError: The shape of the image is wrong.
        """
        pixels = pixels_of(image)
        if pixels.ndim != 3 or pixels.shape[0] not in (1, 3) or 0 in pixels.shape:
            raise ValueError(f"image: wanted shape (1, h, w) or (3, h, w), got {tuple(pixels.shape)}")
        weight = next(self.network.parameters())
        pixels = pixels.to(weight.device, weight.dtype).expand(3, -1, -1)[None]
        height, width = pixels.shape[-2:]
        shrink = min(1.0, max_size / max(height, width))
        if shrink < 1:
            size = (max(1, round(height * shrink)), max(1, round(width * shrink)))
            pixels = torch.nn.functional.interpolate(pixels, size, mode="bilinear", antialias=True, align_corners=False)
        with torch.inference_mode():
            x, score, descriptors = _detect(self.name, self.network, pixels, max_features)
        zoom = pixels.new_tensor([width / pixels.shape[-1], height / pixels.shape[-2]])
        order = score.argsort(descending=True, stable=True)
        x = ((x[order].to(zoom) + 0.5) * zoom - 0.5).clone()
        return Features(
            x=x,
            scale=zoom.mean().expand(len(x)).clone(),
            angle=x.new_zeros(len(x)),
            response=score[order].to(zoom).clone(),
            descriptors=unit_descriptors(descriptors[order].to(zoom)).clone(),
        )


@dataclass(frozen=True)
class LearnedMatcher:
    """A network that matches the points of two images; made by `load_matcher`.

    Example:
        >>> import torch, torchsfm
        >>> from kornia.feature import LightGlue
        >>> torch.save(LightGlue(None, input_dim=128, add_scale_ori=True).state_dict(), "weights.pth")  # untrained
        >>> matcher = torchsfm.images.load_matcher("sift", "weights.pth", min_score=0.0)
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> features = torchsfm.detect_features(image)
        >>> matches = matcher(features, features, (160, 120), (160, 120))  # each point in one match at most
        >>> matches.shape[1], bool((matches[:, 0].diff() > 0).all())
        (2, True)
    """

    name: str
    """Of the detector whose points it matches."""
    network: Any
    """The network with its weights."""

    def __call__(
        self, features1: Features, features2: Features, size1: tuple[int, int], size2: tuple[int, int]
    ) -> Int[Tensor, "k 2"]:
        """Match two images.

        Args:
            features1: Points of the first image, from the detector that the matcher was trained for.
            features2: Points of the second image.
            size1: Width and height of the first image.
            size2: Width and height of the second image.

        Returns:
            Rows (index in the first image, index in the second), sorted by the first; each point is in one match at most.

        Raises:
            ValueError: The descriptors have the wrong length.
        """
        weight = next(self.network.parameters())
        wanted = self.network.conf.input_dim
        data = {}
        for key, features, size in (("image0", features1, size1), ("image1", features2, size2)):
            if features.descriptors.shape[1] != wanted:
                got = features.descriptors.shape[1]
                raise ValueError(f"features: a matcher for {self.name} wants descriptors of {wanted} values, got {got}")
            box = torch.tensor(size, dtype=weight.dtype, device=weight.device)
            x = features.x.to(weight)
            data[key] = {
                "keypoints": torch.minimum(x.clamp_min(0), box)[None],
                "descriptors": unit_descriptors(features.descriptors).to(weight)[None],
                "image_size": box[None],
                # In the sizes of OpenCV, which are diameters.
                "scales": features.scale.to(weight)[None] * 2 ** (5 / 6),
                "oris": features.angle.to(weight)[None],
            }
        if min(len(features1), len(features2)) == 0:
            return torch.zeros(0, 2, dtype=torch.long, device=weight.device)
        with torch.inference_mode():
            matches: Tensor = self.network(data)["matches"][0]
        return matches[matches[:, 0].argsort()].long().clone()


def load_detector(
    name: DetectorName,
    weights: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    device: torch.device | str = "cpu",
) -> LearnedDetector:
    """A learned detector with weights from files.

    Args:
        name: `disk` (Tyszkiewicz et al., NeurIPS 2020) or `dedode-b`, `dedode-g` (Edstedt et al., 3DV 2024).
        weights: The file of the network's parameters, as its authors or kornia publish it, or as `torch.save` makes it of a
            `state_dict`. DeDoDe wants two files: the detector's (of kind L), then the descriptor's.
        device: Where to run it.

    Returns:
        The detector, ready to be called with images.

    Raises:
        ValueError: An unknown name, or a file that is missing, unreadable or of another network.

    Example:
        >>> import torch, torchsfm
        >>> from kornia.feature import DISK
        >>> torch.save(DISK().state_dict(), "weights.pth")  # untrained; those of its authors come as a file
        >>> detector = torchsfm.images.load_detector("disk", "weights.pth")
        >>> features = detector(torch.rand(3, 64, 80, generator=torch.Generator().manual_seed(0)), max_features=50)
        >>> features.x.shape[1], features.descriptors.shape[1]
        (2, 128)
    """
    from kornia import feature

    paths = [weights] if isinstance(weights, str | os.PathLike) else list(weights)
    wanted = {"disk": 1, "dedode-b": 2, "dedode-g": 2}.get(name)
    if wanted is None:
        raise ValueError(f"name: wanted 'disk', 'dedode-b' or 'dedode-g', got {name!r}")
    if len(paths) != wanted:
        raise ValueError(f"weights: {name} wants {wanted} file{'s' if wanted > 1 else ''}, got {len(paths)}")
    network: Any
    if name == "disk":
        network = feature.DISK()
        parts = [network]
    else:
        network = feature.DeDoDe(descriptor_model=name[-1].upper(), amp_dtype=torch.float32)
        parts = [network.detector, network.descriptor]
    for part, path in zip(parts, paths, strict=True):
        _fill(part, path, _read_weights(path), name)
    return LearnedDetector(name, network.to(device).eval())


def load_matcher(
    name: MatcherName,
    weights: str | os.PathLike[str],
    *,
    min_score: float = 0.1,
    device: torch.device | str = "cpu",
) -> LearnedMatcher:
    """LightGlue (Lindenberger et al., ICCV 2023) with weights from a file.

    Args:
        name: The detector whose points are matched; `sift` for those of `detect_features`.
        weights: The file of the network's parameters.
        min_score: Matches with a smaller probability are dropped.
        device: Where to run it.

    Returns:
        The matcher, ready to be called with the features of two images.

    Raises:
        ValueError: An unknown name, or a file that is missing, unreadable or of another network.

    Example:
        >>> import torch, torchsfm
        >>> from kornia.feature import LightGlue
        >>> torch.save(LightGlue(None, input_dim=128).state_dict(), "weights.pth")  # untrained; theirs come as a file
        >>> matcher = torchsfm.images.load_matcher("disk", "weights.pth", min_score=0.0)
        >>> x, one = torch.rand(20, 2, generator=torch.Generator().manual_seed(0)) * 100, torch.ones(20)
        >>> features = torchsfm.images.Features(x, one, 0 * one, one, torch.eye(20, 128))
        >>> matcher(features, features, (100, 100), (100, 100)).shape[1]
        2
    """
    from kornia.feature import LightGlue

    key = {"disk": "disk", "dedode-b": "dedodeb", "dedode-g": "dedodeg", "sift": "sift"}.get(name)
    if key is None:
        raise ValueError(f"name: wanted 'disk', 'dedode-b', 'dedode-g' or 'sift', got {name!r}")
    settings = {k: v for k, v in LightGlue.features[key].items() if k != "weights"}
    # With no kind of feature named the constructor builds the network and downloads nothing.
    network = LightGlue(features=None, filter_threshold=min_score, **settings)
    state = _read_weights(weights)
    # The authors' own files name the layers the other way round.
    state = {re.sub(r"^(self_attn|cross_attn)\.(\d+)\.", r"transformers.\2.\1.", key): value for key, value in state.items()}
    _fill(network, weights, state, f"LightGlue for {name}", optional=frozenset({"confidence_thresholds"}))
    return LearnedMatcher(name, network.to(device).eval())


def _detect(name: str, network: Any, pixels: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    if name == "disk":
        found = network(pixels, count, pad_if_not_divisible=True)[0]
        return found.keypoints, found.detection_scores, found.descriptors
    keypoints, scores, descriptors = network(pixels, min(count, pixels.shape[-1] * pixels.shape[-2]))
    return keypoints[0] - 0.5, scores[0], descriptors[0]  # there the centre of the first pixel is (0.5, 0.5)


def _read_weights(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ValueError(f"{os.fspath(path)}: no such file of weights") from None
    except (OSError, RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError) as error:
        reason = str(error).strip().split("\n")[0][:120] or type(error).__name__
        raise ValueError(f"{os.fspath(path)}: not a readable file of weights ({reason})") from None
    for key in ("extractor", "state_dict", "model"):
        if isinstance(state, dict) and isinstance(state.get(key), dict):
            state = state[key]
    if not isinstance(state, dict) or not state or not all(isinstance(v, Tensor) for v in state.values()):
        raise ValueError(f"{os.fspath(path)}: holds no named parameters of a network")
    return state


def _fill(
    network: torch.nn.Module,
    path: str | os.PathLike[str],
    state: dict[str, Tensor],
    name: str,
    optional: frozenset[str] = frozenset(),
) -> None:
    own = network.state_dict()
    wrong = [k for k in own if k not in optional and (k not in state or state[k].shape != own[k].shape)]
    if wrong:
        raise ValueError(f"{os.fspath(path)}: not the weights of {name} ({len(wrong)} of {len(own)} missing, first {wrong[0]})")
    network.load_state_dict(state, strict=False)
