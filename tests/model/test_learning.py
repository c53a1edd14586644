"""What is learned, against populations whose truth is known and against slow NumPy: loadings, gains, kernel widths, the
floor of the deviation, and their scales."""

import numpy as np
import pytest
import torch

from facerelight.geometry.lights import even_hemisphere
from facerelight.model.image_store import ImageStore
from facerelight.model.learning import GAP_SHRINK, WIDTH_FACTORS
from facerelight.model.statistics import FaceStatistics
from facerelight.model.subjects import face_operators, measure_brightness

SHAPE = (6, 5)


def population(people: int, lights: torch.Tensor, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Images ``(N, J, H, W)`` of people who differ by two loadings, of n alone, and by white noise of n at every pixel;
    and the loadings ``(2, 3, H, W)``, as these people's codes have them."""
    generator = torch.Generator().manual_seed(seed)
    loadings = torch.randn(2, 3, *SHAPE, generator=generator) * torch.tensor([0.08, 0.05])[:, None, None, None]
    code = torch.randn(people, 2, generator=generator)
    code = (code - code.mean(0)) @ torch.linalg.inv(torch.linalg.cholesky(code.T.cov())).T  # of unit covariance
    n = torch.tensor([0.0, 0.1, 1.5])[:, None, None] + torch.tensordot(code, loadings, 1)
    n = n + 0.02 * torch.randn(people, 3, *SHAPE, generator=generator)
    return torch.einsum("nchw,jc->njhw", n, lights), loadings


def test_loadings_hold_what_the_code_of_a_population_does() -> None:
    """Of 150 people: the covariance over the whole face within 6 % of the truth, in size as well as in shape, the
    residual's variance within 6 % of the noise's."""
    lights = even_hemisphere(10)
    images, truth = population(150, lights, 0)
    statistics = FaceStatistics.fit(images + 0.5, lights, rank=2, face_rank=2)
    assert statistics.face is not None
    learned, true = (part.flatten(1).double() for part in (statistics.face.n, truth))
    off = (learned.T @ learned - true.T @ true).norm() / (true.T @ true).norm()
    assert off < 0.06
    assert float(learned.square().sum() / true.square().sum()) == pytest.approx(1, abs=0.03)
    left = statistics.face.residual.n_factor.square().sum(1).mean()  # variance of a component
    assert float(left) == pytest.approx(0.02**2, rel=0.06)


def test_loadings_and_residuals_equal_people_left_out_one_by_one() -> None:
    """By singular value decompositions of the fields themselves, everybody left out in turn."""
    generator = np.random.default_rng(0)
    count, rank = 9, 3
    fields = generator.standard_normal((count, 40)) @ np.diag(np.linspace(3, 0.3, 40))
    operators = face_operators(torch.from_numpy(fields @ fields.T), rank)

    def components(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _, size, vectors = np.linalg.svd(rows - rows.mean(0), full_matrices=False)
        return vectors[:rank], size[:rank]

    squares, residual = np.zeros(rank), np.empty_like(fields)
    for out in range(count):
        others = np.delete(fields, out, 0)
        vectors, size = components(others)
        offset = fields[out] - others.mean(0)
        score = vectors @ offset
        residual[out] = offset - score @ vectors
        squares += (score / (size / np.sqrt(count - 2))) ** 2 / count
    shrink = (count - 1) / count
    vectors, size = components(fields)
    expected = vectors * (np.sqrt(squares * shrink / (count - 1)) * size)[:, None]
    made = operators.loadings.double().numpy() @ fields
    signs = np.sign((made * expected).sum(1))[:, None]
    assert np.allclose(made, signs * expected, atol=1e-5)
    assert np.allclose(operators.residual.double().numpy() @ fields, residual * np.sqrt(shrink), atol=1e-5)


def test_gains_of_a_population_are_measured() -> None:
    """Everybody's own, their spread, and by light how well one image tells: factors of people whose images each err by
    a factor of their own."""
    generator = torch.Generator().manual_seed(1)
    people, lights, spread = 300, 6, 0.3
    face = 0.3 + 0.4 * torch.rand(lights, *SHAPE, generator=generator)
    errs = torch.tensor([0.02, 0.05, 0.1, 0.02, 0.05, 0.1])
    gains = (spread * torch.randn(people, generator=generator)).exp()
    own = (errs * torch.randn(people, lights, generator=generator)).exp()
    images = 0.5 * gains[:, None, None, None] * own[..., None, None] * face
    store = ImageStore()
    for person in images:
        store.add(person)
    rows = images.flatten(1).double()
    measured = measure_brightness(store, rows @ rows.T, {}, 7)
    relative = measured.gain.log() - gains.log()
    assert relative.std() < 0.05  # what averaging six images leaves
    assert float(measured.spread) == pytest.approx(float(gains.log().std()), rel=0.03)
    # the gain of all six images goes with each of them: a sixth of an image's own error, and of the others'
    share = 1 / 6 * face.flatten(1).square().sum(1) / face.flatten(1).square().sum(1).mean()
    left = own.log() - (share * own.log()).sum(1, keepdim=True)
    assert torch.allclose(measured.noise, left.std(0), rtol=0.05)


def left_out(images: np.ndarray, lights: np.ndarray, factor: float, spacing: np.ndarray) -> float:
    """Squared error of predicting v at each light from the others (4.5), light by light."""
    error = 0.0
    v = images - np.einsum("jc,nc...->nj...", lights, np.einsum("cj,nj...->nc...", np.linalg.pinv(lights), images))
    for j in range(len(lights)):
        others = np.delete(np.arange(len(lights)), j)
        distance = ((lights[j] - lights[others]) ** 2).sum(1)
        kernel = np.exp(-0.5 * distance / (factor * spacing[others]) ** 2)
        made = np.einsum("j,nj...->n...", kernel / kernel.sum(), v[:, others])
        error += ((made - v[:, j]) ** 2).sum()
    return error


def test_the_kernel_is_as_wide_as_predicts_lights_left_out_best(people: torch.Tensor, lights: torch.Tensor) -> None:
    images, s = people[:8].double().numpy(), lights.double().numpy()
    distance = np.sqrt(((s[:, None] - s[None]) ** 2).sum(2))
    spacing = np.sort(distance, 1)[:, 3]  # the third neighbour's
    best = min(WIDTH_FACTORS, key=lambda factor: left_out(images, s, factor, spacing))
    fitted = FaceStatistics.fit(people[:8], lights, rank=2)
    assert np.allclose(fitted.light_widths, GAP_SHRINK * best * spacing, rtol=1e-4)
    assert float(fitted.nugget_width) == pytest.approx(0.35 * float(np.median(np.sort(distance, 1)[:, 3])), rel=0.02)
    given = FaceStatistics.fit(people[:8], lights, rank=2, kernel_width=0.6, nugget_width=0.2)
    assert np.allclose(given.light_widths, 0.6 * spacing, rtol=1e-4)
    assert float(given.nugget_width / fitted.nugget_width) == pytest.approx(0.2 / 0.35, rel=1e-3)


def test_a_pixel_that_hardly_varies_has_the_floor_alone(people: torch.Tensor, lights: torch.Tensor) -> None:
    """In radiance: below it no correlation is learned, at it and above everything is."""
    floor = 0.01
    fitted = FaceStatistics.fit(people[:12], lights, rank=11, floor=floor)
    plain = FaceStatistics.fit(people[:12], lights, rank=11, floor=1e-5)
    assert fitted.pixel is not None
    assert plain.pixel is not None
    low = plain.pixel.v_std < floor
    assert 0.05 < low.float().mean() < 0.95
    assert torch.allclose(fitted.pixel.v_std, plain.pixel.v_std.clamp_min(floor), rtol=1e-4)
    learned = fitted.pixel.v_factor.square().sum(1)
    assert learned[low].abs().max() == 0
    assert learned[~low].min() > 0.99


def test_temper_is_the_option(people: torch.Tensor, lights: torch.Tensor) -> None:
    fitted = FaceStatistics.fit(people[:6], lights, rank=2, face_rank=2, temper=37.0)
    assert fitted.face is not None
    assert float(fitted.face.temper) == 37.0
