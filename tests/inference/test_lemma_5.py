"""Lemma 5: n_MLE and the error of the deviation's MAP estimate are uncorrelated, given the true deviations; and what
that is worth for the error of an image (3.22, 3.23)."""

import torch

from facerelight.inference.maximum_likelihood import MaximumLikelihood
from facerelight.model.covariance import deviation_covariance
from facerelight.model.light_terms import light_terms
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics import gaussian

COUNT = 4000


def correlation(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Of samples ``(S, ..., P)`` over S."""
    a, b = a - a.mean(0), b - b.mean(0)
    return (a * b).mean(0) / (a.square().mean(0) * b.square().mean(0)).sqrt()


def test_n_and_the_error_of_v_are_uncorrelated(statistics: FaceStatistics, lights: torch.Tensor) -> None:
    """Deviations of one person under five inputs and an output light are drawn from the model, at a few pixels, with n
    fixed; the package estimates n from each draw."""
    assert statistics.pixel is not None
    sources, target = lights[[0, 4, 9, 15, 20]], torch.nn.functional.normalize(lights[7:8] + 0.1 * lights[3:4], dim=1)
    terms = light_terms(statistics, statistics.pixel, torch.cat((target, sources)))
    joint = deviation_covariance(statistics, statistics.pixel, terms, terms)  # (P, 1 + K, 1 + K)
    average = (terms.weights @ statistics.v_mean.flatten(1)).double()  # (1 + K, P)
    pixels = torch.arange(0, joint.shape[0], 31)  # (p,)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(COUNT, len(pixels), 1 + len(sources), 1, generator=generator, dtype=torch.float64)
    v = (gaussian.safe_cholesky(joint[pixels]) @ drawn)[..., 0] + average[:, pixels].T  # (S, p, 1 + K)
    normal = statistics.n_mean.flatten(1).double()[:, pixels].T  # n, fixed, (p, 3)
    seen = v[..., 1:] + normal @ sources.double().T  # y, (S, p, K)

    # What the package makes of an image is affine in it: n_MLE and the image under the target, pixel by pixel.
    def estimated(y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """``n_MLE (p, 3)``, mean and variance ``(p,)`` for inputs ``y (p, K)``."""
        images = torch.zeros(len(sources), joint.shape[0], dtype=torch.float64)
        images[:, pixels] = y.T
        person = MaximumLikelihood(statistics, images.unflatten(1, statistics.size), sources)
        mean, variance = person.render(target[0])
        return person.normal[pixels, :, 0], mean[pixels], variance[pixels]

    zero = torch.zeros(len(pixels), len(sources), dtype=torch.float64)
    n_zero, mean_zero, promised = estimated(zero)
    slopes = [estimated(zero + unit) for unit in torch.eye(len(sources), dtype=torch.float64)]
    n_slope = torch.stack([n - n_zero for n, _, _ in slopes], 1)  # (p, K, 3)
    mean_slope = torch.stack([mean - mean_zero for _, mean, _ in slopes], 1)  # (p, K)
    n_mle = n_zero + torch.einsum("spk,pkc->spc", seen, n_slope)  # (S, p, 3)
    image = mean_zero + (seen * mean_slope).sum(-1)  # (S, p)

    # e = v - v_MAP, v_MAP from the true deviations under the inputs (3.18)
    given = gaussian.condition_gaussian(
        average[:1, pixels].T,
        average[1:, pixels].T,
        joint[pixels, :1, :1],
        joint[pixels, :1, 1:],
        joint[pixels, 1:, 1:],
        v[..., 1:],
    )
    error = v[..., 0] - given.mean[..., 0]  # (S, p)

    tolerance = 4.5 / COUNT**0.5
    assert (n_mle.mean(0) - normal).abs().max() < tolerance * n_mle.std(0).max()  # Lemma 4: no bias
    assert correlation(n_mle, error[..., None]).abs().max() < tolerance  # Lemma 5
    # The image is made with v_MAP from y - S n_MLE, and that error does depend on n_MLE: (3.23) adds variances that do
    # not simply add, the package's kriging form holds.
    known = normal @ target[0].double()
    actual = (image - (v[..., 0] + known)).square().mean(0)  # (p,)
    assert ((actual / promised) - 1).abs().max() < 6 / COUNT**0.5
    made = image - n_mle @ target[0].double()  # the deviation that the package renders
    assert correlation(n_mle, (v[..., 0] - made)[..., None]).abs().max() > 5 * tolerance
