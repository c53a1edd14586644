"""Algebra over the bootstrap's subjects: Gram matrices, filling in missing images, and cross-validated loadings and
residuals.

Every statistic is a linear function of the subjects' images, so what to do with N subjects is decided on N x N
matrices, once, and then applied to blocks of pixels as *subject operators*.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.model.image_store import ImageStore
from facerelight.numerics.gaussian import safe_cholesky
from facerelight.numerics.kernels import kernel_weights

__all__ = [
    "Brightness",
    "FaceOperators",
    "Grams",
    "face_operators",
    "fill_missing",
    "fill_operators",
    "gather_grams",
    "interpolation_error",
    "measure_brightness",
]

GROUPS = 160  # of subjects left out in turn; up to so many subjects, each is left out alone


class Grams(NamedTuple):
    """Inner products over all pixels, float64.

    ``subjects (J, N, N)`` of the images under each light (missing ones count as zero), summed to ``(1, N, N)`` where
    none is missing; ``missing (N, J)``; ``deviation (J, J)`` of the fields v, summed over subjects;
    ``deviation_spread (J, J)`` of v less its mean over subjects.
    """

    subjects: Tensor
    missing: Tensor
    deviation: Tensor
    deviation_spread: Tensor


class Brightness(NamedTuple):
    """``gain (N,)`` of each subject about 1; ``spread ()``, its standard deviation in logarithm; ``noise (J,)``, by
    light, that of the gain read off a single image."""

    gain: Tensor
    spread: Tensor
    noise: Tensor


class FaceOperators(NamedTuple):
    """``loadings (k, N)`` and ``residual (N, N)``: rows of weights over the subjects' fields."""

    loadings: Tensor
    residual: Tensor


def gather_grams(store: ImageStore, lights: Tensor, block: int) -> Grams:
    """One pass over the images of ``store``, block by block."""
    pixels = math.prod(store.shape[1:])
    count, light_count = len(store), len(lights)
    missing = torch.stack([torch.from_numpy(array[:, 0, 0].copy()).isnan() for array in store])
    if missing.all(0).any():
        raise ValueError(
            f"images: expected every light to have one at least, got none for {int(missing.all(0).sum())} lights"
        )
    by_light = bool(missing.any())  # filling in needs every light's own; without it memory must not grow with J N^2
    subjects = torch.zeros(light_count if by_light else 1, count, count, dtype=torch.float64)
    deviation = torch.zeros(light_count, light_count, dtype=torch.float64)
    mean_part = torch.zeros_like(deviation)
    off_lambert = (
        torch.eye(light_count, dtype=torch.float64) - lights.double() @ torch.linalg.pinv(lights.double())
    ).float()
    present = (~missing).float()
    for start in range(0, pixels, block):
        images = store.block(start, min(start + block, pixels)).nan_to_num(0.0)  # (N, J, P)
        if by_light:
            subjects += torch.einsum("njp,mjp->jnm", images, images).double()
        else:
            rows = images.flatten(1)  # (N, J P)
            subjects[0] += (rows @ rows.T).double()
        mean = images.sum(0) / present.sum(0)[:, None]  # (J, P)
        filled = torch.where(missing[..., None], mean, images) if missing.any() else images
        v = off_lambert @ filled  # (J, J) @ (N, J, P)
        deviation += torch.einsum("njp,nkp->jk", v, v).double()
        mean_v = off_lambert @ mean
        mean_part += (mean_v @ mean_v.T).double()
    return Grams(subjects, missing, deviation, deviation - count * mean_part)


def fill_operators(grams: Grams, ridge: float = 0.1) -> dict[int, Tensor]:
    """For each light with missing images, ``(N, N)`` weights that predict every subject's image from the subjects that
    have one.

    A missing image is the regression of its subject on the others over the lights that the subject has (one step of EM,
    started from the mean face), so what is filled in keeps the person's own brightness and shape.
    """
    count = len(grams.missing)
    fill = {}
    for light in grams.missing.any(0).nonzero()[:, 0].tolist():
        gone = grams.missing[:, light]
        operator = torch.eye(count, dtype=torch.float64)
        operator[gone] = (~gone).double() / (~gone).sum()
        for subject in gone.nonzero()[:, 0].tolist():
            others = (~gone).nonzero()[:, 0]  # (O,)
            seen = (~grams.missing[subject]) & (~grams.missing[others]).all(0)
            if not seen.any():
                continue
            gram = grams.subjects[seen].sum(0)  # (N, N)
            centring = torch.eye(len(others), dtype=torch.float64) - 1 / len(others)
            spread = centring @ gram[others][:, others] @ centring  # (O, O)
            mean = gram[others].mean(0)
            cross = centring @ (gram[others, subject] - mean[others])  # (O,)
            penalty = ridge * spread.diagonal().mean() + 1e-12
            factor = safe_cholesky(spread + penalty * torch.eye(len(others), dtype=torch.float64))
            weights = torch.cholesky_solve(cross[:, None], factor)[:, 0]
            operator[subject] = 0
            operator[subject, others] = centring @ weights + 1 / len(others)
        fill[light] = operator
    return fill


def fill_missing(images: Tensor, fill: dict[int, Tensor]) -> Tensor:
    """``images (N, J, P)`` with the missing (NaN) ones replaced."""
    if not fill:
        return images
    images = images.nan_to_num(0.0)
    for light, operator in fill.items():
        images[:, light] = operator.to(images) @ images[:, light]
    return images


def total_gram(grams: Grams, fill: dict[int, Tensor]) -> Tensor:
    """``(N, N)`` inner products of the subjects over all lights, missing images filled in."""
    total = torch.zeros_like(grams.subjects[0])
    for light, inner in enumerate(grams.subjects):
        operator = fill.get(light)
        total += inner if operator is None else operator @ inner @ operator.T
    return total


def measure_brightness(store: ImageStore, total: Tensor, fill: dict[int, Tensor], block: int) -> Brightness:
    """How bright each subject is next to the average face, by least squares over all images, and how well one image
    tells; one more pass.

    ``total (N, N)`` is :func:`total_gram`.
    """
    gain = torch.ones(len(total), dtype=torch.float64)
    for _ in range(5):
        average = total @ (1 / gain)  # (N,), inner products with N times the average face
        gain = average / ((1 / gain) @ average) * len(gain)
        gain = gain / gain.log().mean().exp()
    light_count, pixels = store.shape[0], math.prod(store.shape[1:])
    read = torch.zeros(len(gain), light_count, dtype=torch.float64)  # inner products with the average face, by light
    for start in range(0, pixels, block):
        images = fill_missing(store.block(start, min(start + block, pixels)), fill) / gain.float()[:, None, None]
        read += torch.einsum("njp,jp->nj", images, images.mean(0)).double()
    noise = (read / read.mean(0)).clamp_min(1e-3).log().std(0)
    return Brightness(gain.float(), gain.log().std().clamp_min(1e-3).float(), noise.clamp_min(1e-3).float())


def face_operators(gram: Tensor, rank: int) -> FaceOperators:
    """Loadings of rank ``rank`` and cross-validated residuals, as weights over subjects.

    Principal components of a small bootstrap flatter the people they came from, so each subject in turn is left out (in
    a large bootstrap each of ``GROUPS`` groups): its residual is what the others' components leave of it, and each
    loading is scaled by the spread of the left-out subjects' scores. At rank 0 the residual is exactly the per-pixel
    model's centred field.
    """
    count = len(gram)
    groups = [torch.arange(first, count, GROUPS) for first in range(min(count, GROUPS))]
    fewest = count - len(groups[0])  # learned from when a group is left out
    rank = min(rank, fewest - 1)
    residual = torch.empty(count, count, dtype=torch.float64)
    scores = torch.empty(count, rank, dtype=torch.float64)
    for group in groups:
        others = torch.ones(count, dtype=torch.float64)
        others[group] = 0
        mean = others / others.sum()
        components, values = _components(gram, mean, rank)
        offset = torch.eye(count, dtype=torch.float64)[group] - mean  # (G, N), of the subjects left out
        score = offset @ gram @ components.T  # (G, rank)
        residual[group] = offset - score @ components
        scores[group] = score / (values / (others.sum() - 1)).sqrt()
    shrink = fewest / (fewest + 1)  # makes rank 0 the sample variance with N - 1 degrees of freedom
    mean = torch.full((count,), 1 / count, dtype=torch.float64)
    components, values = _components(gram, mean, rank)
    scale = scores.square().mean(0) * shrink
    loadings = components * (scale * values / (count - 1)).sqrt()[:, None]  # (rank, N)
    return FaceOperators(loadings.float(), (residual * shrink**0.5).float())


def _components(gram: Tensor, mean: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """Leading principal fields about the weighted mean: unit-norm, as weights ``(rank, N)`` over subjects, and their
    sums of squares."""
    members = mean > 0
    centring = torch.diag(members.double()) - torch.outer(members.double(), mean)
    values, vectors = torch.linalg.eigh(centring @ gram @ centring.T)  # (N,), (N, N)
    values, vectors = values.flip(0)[:rank].clamp_min(1e-12 * gram.diagonal().mean()), vectors.flip(1)[:, :rank]
    return (vectors.T @ centring) / values.sqrt()[:, None], values


def interpolation_error(deviation: Tensor, distance: Tensor, widths: Tensor) -> float:
    """Squared error of predicting v at each bootstrap light from the others by kernel regression, over all subjects and
    pixels."""
    squared = distance.square().clone()
    squared.fill_diagonal_(torch.inf)
    error = torch.eye(len(distance), dtype=torch.float64) - kernel_weights(squared, widths)
    return float(torch.einsum("aj,jk,ak->", error, deviation, error))
