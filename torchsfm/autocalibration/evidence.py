"""How likely an assumption of the intrinsics is, given what it leads to, and what several leave open together.

The evidence of an assumption is the probability of the data under it, whatever its unknowns: Laplace's integral about the best
ones, with the scale of the noise as one more unknown, because what no assumption explains (mismatches, lenses) scales the
misfit of all. More unknowns must pay for what they could have been and were not (Occam's factor). An answer is then uncertain
by its own covariance and by how far the other assumptions, as likely as they are, would have it elsewhere (Bayesian model
averaging; Hoeting, Madigan, Raftery & Volinsky, Statistical Science 1999).
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.autocalibration.intrinsics_model import Assumption
from torchsfm.linalg import eigvalsh

_VARIATION = (0.2, 0.02, 0.02, 0.02, 0.02)
"""Standard deviations among views of what varies from view to view, in the order of `intrinsic_labels`."""
_ODDS = 20.0
"""How many times as likely an assumption is as the one after it, before any image was seen."""
_NOISE_KNOWN = 6.0
"""With how many observations' weight the scale of the noise is known beforehand."""


def expected_variation(
    assumption: Assumption, precision: Float[Tensor, "b q"], present: Float[Tensor, "b v"]
) -> tuple[Float[Tensor, "b q q"], Float[Tensor, "b"]]:
    """What is expected of the unknowns: its information, and the logarithm of its density where they are as expected.

    Args:
        assumption: What is free, and what of it varies.
        precision: One over the standard deviations expected of single unknowns; 0 where nothing is. Those that vary and of
            which nothing is expected lie around what they have in common.
        present: 1 for views that take part.
    """
    information = torch.diag_embed(precision.square())
    log_density = (torch.where(precision > 0, precision / math.sqrt(2 * math.pi), 1.0)).log().sum(-1)
    columns = assumption.columns(present.shape[-1])
    number = present.sum(-1).clamp_min(1)
    for parameter in {p for p, view in columns if view is not None}:
        here = torch.tensor([p == parameter for p, _ in columns], device=present.device)
        member = here * torch.stack([present[:, 0 if view is None else view] for _, view in columns], -1)
        if bool((precision[:, here] * present > 0).any()):
            continue
        centred = torch.diag_embed(member) - member[:, :, None] * member[:, None] / number[:, None, None]
        variation = _VARIATION[parameter]
        information = information + centred / variation**2
        log_density = log_density - (number - 1) * math.log(variation * math.sqrt(2 * math.pi)) - 0.5 * number.log()
    return information, log_density


def log_evidence(
    chi2: Float[Tensor, "b"],
    redundancy: Float[Tensor, "b"],
    information: Float[Tensor, "b u u"],
    surprise: Float[Tensor, "b"],
    log_density: Float[Tensor, "b"],
    free: Float[Tensor, "b"],
) -> Float[Tensor, "b"]:
    """The logarithm of the evidence, up to what all assumptions have in common.

    Args:
        chi2: Misfit in units of the noise.
        redundancy: Observations less unknowns.
        information: Of the data and of what is expected, on all unknowns.
        surprise: Squared distance of the unknowns from what is expected.
        log_density: As from `expected_variation`.
        free: Number of unknowns.
    """
    half = 0.5 * (_NOISE_KNOWN + redundancy.clamp_min(0))
    scale = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300)
    root = scale.rsqrt()
    values, _ = eigvalsh(root[:, :, None] * information * root[:, None])
    log_determinant = values.clamp_min(1e-13).log().sum(-1) + scale.log().sum(-1)
    misfit: Tensor = torch.lgamma(half) - half * (0.5 * (_NOISE_KNOWN + chi2)).log()
    return misfit + log_density - 0.5 * surprise + 0.5 * math.log(2 * math.pi) * free - 0.5 * log_determinant


def weigh_assumptions(evidence: Float[Tensor, "k b"], eligible: Bool[Tensor, "k b"]) -> Float[Tensor, "k b"]:
    """The probability of each of several assumptions, those named first being likelier beforehand.

    Where none is eligible the first has it all.
    """
    order = torch.arange(len(evidence), dtype=evidence.dtype, device=evidence.device)[:, None]
    log_weight = torch.where(eligible, evidence - order * math.log(_ODDS), -torch.inf)
    none = ~eligible.any(0)
    log_weight[0] = torch.where(none, 0.0, log_weight[0])
    return log_weight.softmax(0)
