"""The whole-face model over any views: a low-rank code shared by all pixels and all views, and a residual at each
pixel."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.model.subjects import face_operators
from facerelight.numerics import gaussian
from facerelight.viewpoint.views import ViewFields

__all__ = ["FaceOfViews", "Seen", "face_of_views"]


class FaceOfViews(NamedTuple):
    """``mean (V, P)``, ``loadings (P, V, k)`` and ``covariance (P, V, V)`` of what they leave, float64."""

    mean: Tensor
    loadings: Tensor
    covariance: Tensor


class Seen(NamedTuple):
    """What K images say of one person: the factor ``L (P, K, K)`` of the images' residual covariance, whitened loadings
    ``inputs (P, K, k)``, whitened residuals ``white (P, K, 2)`` of the images and of black ones, the ``code (k, 2)`` of
    both with its ``spread (k, k)``, and the tempered log ``evidence ()``."""

    factor: Tensor
    inputs: Tensor
    white: Tensor
    code: Tensor
    spread: Tensor
    evidence: Tensor

    @classmethod
    def of(cls, face: FaceOfViews, images: Tensor, gain: Tensor, noise: float, temper: float) -> Seen:
        """One person's ``images (K, P)`` under the last K views of ``face``, as bright as ``gain ()`` says; ``noise``
        in radiance."""
        views = slice(face.mean.shape[0] - len(images), None)
        own = torch.eye(len(images)).to(face.covariance) * (noise / gain).square()  # (K, K)
        factor = gaussian.safe_cholesky(face.covariance[:, views, views] + own)
        inputs = gaussian.solve_lower(factor, face.loadings[:, views])
        mean = face.mean[views].T  # (P, K)
        residual = torch.stack((images.double().T / gain - mean, -mean), -1)  # (P, K, 2)
        white = gaussian.solve_lower(factor, residual)
        code, spread = gaussian.low_rank_code(inputs, white, temper)
        volume = 2 * factor.diagonal(dim1=1, dim2=2).log().sum() + 2 * images.numel() * gain.log()
        missed = (white - inputs @ code)[..., 0].square().sum() + temper * code[:, 0].square().sum()
        evidence = -0.5 * (missed + volume - 2 * temper * spread.diagonal().log().sum()) / temper
        return cls(factor, inputs, white, code, spread, evidence)


def face_of_views(known: ViewFields, rank: int) -> FaceOfViews:
    """Loadings of rank ``rank`` and cross-validated residuals of the people's fields under V views."""
    fields = known.fields.sum(0).double()  # (V, N, P)
    people = fields.shape[1]
    operators = face_operators(torch.einsum("vnp,vmp->nm", fields, fields), min(rank, people - 2))
    loadings = torch.einsum("kn,vnp->pvk", operators.loadings.double(), fields)
    residual = torch.einsum("mn,vnp->pvm", operators.residual.double(), fields)
    covariance = residual @ residual.mT / people + known.local.permute(2, 0, 1).double()  # (P, V, V)
    return FaceOfViews(known.mean.double(), loadings, covariance)
