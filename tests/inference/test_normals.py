"""The posterior of n, beside dense Gaussian algebra over the whole face."""

import numpy as np
import pytest
import torch

from facerelight.geometry.lights import even_hemisphere
from facerelight.geometry.sums import LightSum
from facerelight.inference.posterior import Posterior
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.covariance import image_covariance
from facerelight.model.light_terms import light_terms, loadings_at
from facerelight.model.statistics import FaceStatistics

NOISE = 3 / 255


@pytest.fixture(scope="module")
def small() -> FaceStatistics:
    generator = torch.Generator().manual_seed(3)
    lights = even_hemisphere(9)
    normal = torch.nn.functional.normalize(
        torch.randn(12, 3, 8, 8, generator=generator) + torch.tensor([0, 0, 2.0]).view(3, 1, 1), dim=1
    )
    images = torch.einsum("ncyx,jc->njyx", normal, lights).clamp_min(0) * (
        0.5 + 0.2 * torch.rand(12, 1, 8, 8, generator=generator)
    )
    return FaceStatistics.fit(images, lights, rank=3, face_rank=3, temper=1.0, basis=5)


def dense(
    statistics: FaceStatistics, images: torch.Tensor, lights: LightSum, covariance: str
) -> tuple[np.ndarray, np.ndarray]:
    """Mean ``(3, P)`` and covariance ``(3, 3, P)`` of n, from the joint covariance of n and images at all pixels."""
    face = statistics.face if covariance == "face" else None
    pixel = statistics.pixel if face is None else face.residual
    terms = light_terms(statistics, pixel, lights, face)
    count, pixels = len(images), images[0].numel()
    root = pixel.n_factor.flatten(2).double().numpy()
    own = np.einsum("dcp,ecp->dep", root, root)
    facing = terms.light.double().numpy()
    seen = image_covariance(statistics, pixel, terms, terms).double().numpy()  # (P, K, K)
    of_n, of_y = np.zeros((3, pixels, 3, pixels)), np.zeros((count, pixels, count, pixels))
    cross = np.zeros((3, pixels, count, pixels))
    for p in range(pixels):
        of_n[:, p, :, p] = own[..., p]
        of_y[:, p, :, p] = seen[p] + NOISE**2 * np.eye(count)
        cross[:, p, :, p] = own[..., p] @ facing.T
    if face is not None:
        loads_n = face.n.flatten(2).double().numpy()  # (k, 3, P)
        loads_y = loadings_at(face, terms).double().numpy()  # (K, k, P)
        of_n += np.einsum("kdp,keq->dpeq", loads_n, loads_n)
        of_y += np.einsum("akp,bkq->apbq", loads_y, loads_y)
        cross += np.einsum("kdp,bkq->dpbq", loads_n, loads_y)
    of_n, of_y = of_n.reshape(3 * pixels, -1), of_y.reshape(count * pixels, -1)
    cross = cross.reshape(3 * pixels, -1)
    away = (images.flatten(1) - terms.mean).double().numpy().ravel()
    mean = statistics.n_mean.flatten().double().numpy() + cross @ np.linalg.solve(of_y, away)
    left = (of_n - cross @ np.linalg.solve(of_y, cross.T)).reshape(3, pixels, 3, pixels)
    return mean.reshape(3, pixels), np.stack([left[:, p, :, p] for p in range(pixels)], -1)


@pytest.mark.parametrize("covariance", ["pixel", "face"])
@pytest.mark.parametrize("inputs", [1, 2])
def test_n_is_what_the_joint_gaussian_says(small: FaceStatistics, covariance: str, inputs: int) -> None:
    images = 0.5 * torch.rand(inputs, 8, 8, generator=torch.Generator().manual_seed(inputs))
    lights = LightSum(small.lights, torch.rand(inputs, 9, generator=torch.Generator().manual_seed(7)) / 4)
    noise = torch.full((1, inputs), NOISE)
    found = StatisticalRelighter(small, covariance).condition(images[None], lights, noise=noise).normals()
    mean, left = dense(small, images, lights, covariance)
    assert np.abs(found.mean[0].flatten(1).numpy() - mean).max() < 2e-4
    assert np.abs(found.covariance[0].flatten(2).numpy() - left).max() < 2e-5
    assert not found.shared.any()  # statistics whose people are of one brightness


def test_a_mean_of_n_renders_the_lambertian_part(small: FaceStatistics) -> None:
    image = 0.5 * torch.rand(1, 1, 8, 8, generator=torch.Generator().manual_seed(4))
    posterior = StatisticalRelighter(small, "face").condition(image, small.lights[:1])
    assert torch.allclose(posterior.normals().mean[0].flatten(1).float(), posterior.people[0].n_map, atol=1e-5)


def test_hypotheses_mix(small: FaceStatistics) -> None:
    image = 0.5 * torch.rand(1, 1, 8, 8, generator=torch.Generator().manual_seed(5))
    relighter, two = StatisticalRelighter(small, "face"), small.lights[:2]
    one, other = (relighter.condition(image, light[None]).normals() for light in two)
    both = relighter.condition(image, two[None, :, None]).normals()
    mean = (one.mean + other.mean) / 2
    spread = sum(
        part.covariance + (part.mean - mean)[:, :, None] * (part.mean - mean)[:, None] for part in (one, other)
    )
    assert torch.allclose(both.mean, mean, atol=1e-9)
    assert torch.allclose(both.covariance, spread / 2, atol=1e-9)


def test_nothing_seen_leaves_the_prior(small: FaceStatistics) -> None:
    found = StatisticalRelighter(small, "pixel").condition(torch.zeros(1, 1, 8, 8), torch.zeros(1, 3)).normals()
    root = small.pixel.n_factor.double()
    assert torch.allclose(found.mean[0].float(), small.n_mean)
    assert torch.allclose(found.covariance[0], torch.einsum("dchw,echw->dehw", root, root), atol=1e-9)


def test_an_unknown_brightness_moves_all_of_n(people: torch.Tensor, lights: torch.Tensor) -> None:
    statistics = FaceStatistics.fit(people[:12], lights, rank=4, face_rank=3, brightness=True, temper=10.0, basis=8)
    relighter = StatisticalRelighter(statistics, "face")
    found = relighter.condition(people[13:14, :1], lights[:1]).normals()
    twice = relighter.condition(2 * people[13:14, :1], lights[:1], noise=torch.full((1, 1), 2 / 255)).normals()
    size = found.mean.norm(dim=1).median()
    assert 1e-3 * size < found.shared.norm(dim=1).median() < 0.5 * size
    ratio = (twice.mean.norm(dim=1) / found.mean.norm(dim=1)).median()
    assert 1.4 < ratio <= 2.01  # a brighter picture is a brighter person, as far as people's spread allows


def test_nobody_has_no_normals() -> None:
    with pytest.raises(ValueError, match="normals: expected one person or more"):
        Posterior([], (8, 8)).normals()
