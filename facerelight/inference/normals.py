"""What is known of n, the normal times the albedo, once a person's images are seen: the exact posterior of the same
joint Gaussian that relit images come from."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.inference.person import PersonPosterior

__all__ = ["NormalPosterior", "normal_posterior"]


class NormalPosterior(NamedTuple):
    """n at P pixels, radiance under a light of strength 1 that falls on it straight.

    ``mean (3, P)``; ``covariance (3, 3, P)`` at the most probable brightness of the person; ``shared (3, P)``: by how
    much one standard deviation of that brightness moves n, everywhere at once. The whole covariance is
    ``covariance + shared shared^T``. Float64.
    """

    mean: Tensor
    covariance: Tensor
    shared: Tensor


def normal_posterior(person: PersonPosterior) -> NormalPosterior:
    """The posterior of n given the images that ``person`` was conditioned on, over all hypotheses about their lights.

    With n ~ N(n_0, C) at a pixel, inputs ``y = S n + v + noise`` and ``R`` their covariance, the mean is
    ``n_0 + C S^T R^-1 (y - mu_y)`` and the covariance ``C - C S^T R^-1 S C`` (3.8); the whole-face code adds
    ``D Cov(c) D^T``, ``D = Lambda_n - C S^T R^-1 Lambda_y``. Several hypotheses: the moments of their mixture.
    """
    prior = person.statistics.n_mean.flatten(1).double()  # (3, P)
    root = person.pixel.n_factor.flatten(2).double()
    own = torch.einsum("dcp,ecp->dep", root, root)  # C, (3, 3, P)
    loadings = None if person.face is None else person.face.n.flatten(2).double()  # (k, 3, P)
    means, covariances, moved = [], [], []
    for index, evidence in enumerate(person.evidence):
        facing = evidence.terms.light.double()  # S, (K, 3)
        cross = torch.einsum("kd,dep->pke", facing, own)  # S C, (P, K, 3)
        whitened = torch.linalg.solve_triangular(evidence.cholesky, cross, upper=False)
        covariance = own - torch.einsum("pkd,pke->dep", whitened, whitened)
        mean = prior + torch.einsum("pkd,kp->dp", cross, evidence.solved)
        black = prior + torch.einsum("pkd,kp->dp", cross, evidence.solved_black)
        if loadings is not None and evidence.inputs is not None and evidence.code_black is not None:
            code, spread = person.codes[index]
            left = loadings.permute(2, 1, 0) - whitened.mT @ evidence.inputs  # D, (P, 3, k)
            unsure = left @ spread  # spread spread^T = Cov(c)
            covariance = covariance + torch.einsum("pdk,pek->dep", unsure, unsure)
            mean = mean + torch.einsum("kdp,k->dp", loadings, code[:, 0])
            black = black + torch.einsum("kdp,k->dp", loadings, evidence.code_black)
        gain = evidence.gain
        means.append(gain.value * mean)
        covariances.append(gain.value**2 * covariance)
        moved.append(gain.value * gain.spread * black)
    weight = [(1 - person.prior_share) / len(means)] * len(means) if means else []
    if person.prior_share > 0:
        means.append(prior)
        covariances.append(own if loadings is None else own + torch.einsum("kdp,kep->dep", loadings, loadings))
        moved.append(float(person.statistics.gain_spread) * prior)
        weight.append(person.prior_share)
    share = torch.tensor(weight, dtype=torch.float64, device=prior.device)
    mean = torch.einsum("m,mdp->dp", share, torch.stack(means))
    covariance = torch.einsum("m,mdep->dep", share, torch.stack(covariances))
    for part, one in zip(weight, means, strict=True):
        away = one - mean
        covariance = covariance + part * away[:, None] * away[None]
    return NormalPosterior(mean, covariance, torch.einsum("m,mdp->dp", share, torch.stack(moved)))
