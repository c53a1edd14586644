"""Exemplars: pictures of a person under lights nobody photographed (6.1, 6.3), and the subspace they span without
making them (6.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from facerelight.geometry.lights import angle_grid, even_hemisphere, hemisphere_quadrature
from facerelight.inference.person import PersonPosterior
from facerelight.inference.posterior import Posterior
from facerelight.recognition.subspaces import Subspace

__all__ = ["direct_subspace", "exemplar_lights", "light_moments", "synthesize"]


def exemplar_lights(kind: str = "dome") -> tuple[Tensor, Tensor]:
    """Lights ``(Q, 3)`` and weights ``(Q,)`` to synthesise under.

    "grid": 30 x 30 angles of equal weight (6.3); "hemisphere": uniform, by quadrature (6.1); "dome": 80 even lights;
    "cap": 60 even lights within 66 degrees of the camera, where relit faces are not mostly shadow.
    """
    if kind == "dome":
        return even_hemisphere(80), torch.full((80,), 1 / 80)
    if kind == "cap":
        lights = even_hemisphere(100)[:60]
        return lights, torch.full((60,), 1 / 60)
    if kind == "grid":
        lights = angle_grid(30)
        return lights, torch.full((len(lights),), 1 / len(lights))
    if kind == "hemisphere":
        return hemisphere_quadrature(12)
    raise ValueError(f"lights: expected 'grid', 'hemisphere', 'dome' or 'cap', got {kind!r}")


def synthesize(posterior: Posterior, lights: Tensor) -> Tensor:
    """Each person of ``posterior`` under every light: ``(B, Q, H, W)``, clamped to radiance 0..1 as a camera would."""
    return posterior.mean(lights).clamp(0, 1)


def light_moments(posterior: Posterior, lights: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The person-independent half of (6.1): mean ``(L,)`` of the features ``h(s) = (s, w(s), sigma-free w(s))`` and a
    root of their covariance.

    The posterior mean is ``i(s) = A h(s)`` with ``h = (s, w(s))`` and ``A = (n_MAP, v_map)`` plus ``sigma(s) w(s).b``;
    with the deviation's std taken as fixed per bootstrap light (covariance interpolation),
    ``A = (n_MAP, v_map + sigma b)`` and nothing else depends on s.

    Returns:
        ``mean (L,)`` and ``root (L, r)`` with ``root root^T`` the weighted covariance of h, L = 3 + J.
    """
    statistics = posterior.people[0].statistics
    lights, weights = lights.to(statistics.lights), weights.to(statistics.lights)
    features = torch.cat((lights, statistics.weights(lights)), -1).double()  # (Q, L)
    share = (weights / weights.sum()).double()
    mean = share @ features
    centred = (features - mean) * share.sqrt()[:, None]
    values, vectors = torch.linalg.eigh(centred.T @ centred)
    kept = values > 1e-12 * values[-1]
    return mean.to(lights), (vectors[:, kept] * values[kept].sqrt()).to(lights)


def direct_subspace(person: PersonPosterior, moments: tuple[Tensor, Tensor], dimension: int) -> Subspace:
    """The individual subspace straight from the posterior, not one image synthesised (6.2, eq. 6.1).

    The covariance of all of a person's images is ``A Sigma_h A^T``; its leading eigenvectors are the left singular
    vectors of ``A root``.
    """
    mean, root = moments
    maps = torch.cat((person.n_map, person.v_map + person.pixel.v_std.flatten(1) * person.pull))  # A^T, (L, P)
    design = maps.T.double() @ root.double()  # (P, r)
    values, vectors = torch.linalg.eigh(design.T @ design)
    values, vectors = values.flip(0)[:dimension].clamp_min(1e-30), vectors.flip(1)[:, :dimension]
    basis = design @ (vectors / values.sqrt())
    return Subspace(mean @ maps, basis.to(maps), values.sqrt().to(maps))
