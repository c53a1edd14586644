"""Registration: known deformations found again, people brought into step, and what it does to relighting."""

import pytest
import torch
from conftest import shaded_people

from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.registration import SPREAD, align_people, congeal, deform, register, undeform
from facerelight.model.statistics import FaceStatistics

KNOWN = torch.tensor([0.02, -0.015, 0.03, 0.02, -0.03, 0.02])


def faces(count: int, height: int = 96, width: int = 84, seed: int = 0) -> torch.Tensor:
    """Eyes, brows, nose and mouth as smooth dark spots on a shaded oval, a little different in each."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    spots = torch.tensor(
        [
            (-0.45, -0.35, 0.15),
            (0.45, -0.35, 0.15),
            (0.0, 0.15, 0.2),
            (0.0, 0.5, 0.25),
            (-0.45, -0.6, 0.2),
            (0.45, -0.6, 0.2),
        ]
    )
    depth = 0.25 + 0.05 * torch.randn(count, len(spots), generator=generator)
    image = 0.6 - 0.2 * x**2 - 0.1 * y**2
    marks = torch.stack([torch.exp(-((x - a) ** 2 + 4 * (y - b) ** 2) / (2 * s**2)) for a, b, s in spots.tolist()])
    return (image - torch.einsum("nk,kyx->nyx", depth, marks)).clamp_min(0.02)


def test_known_deformation_is_found() -> None:
    face = faces(1)
    moved = undeform(face, KNOWN)
    assert torch.allclose(register(moved, face, penalty=1e-4), KNOWN, atol=3e-3)
    shrunk = register(moved, face, penalty=0.05)
    assert (shrunk / torch.tensor(SPREAD)).norm() < (KNOWN / torch.tensor(SPREAD)).norm()  # the prior holds it back


def test_deform_and_undeform_are_inverse_inside() -> None:
    face = faces(1)
    there_and_back = deform(undeform(face, KNOWN), KNOWN)
    assert (there_and_back - face)[:, 8:-8, 8:-8].abs().max() < 0.01


def test_one_deformation_for_several_images_of_one_face() -> None:
    lit = torch.stack((faces(1)[0], 0.3 * faces(1)[0], faces(1)[0].square()))
    assert torch.allclose(register(undeform(lit, KNOWN), lit, penalty=1e-4), KNOWN, atol=3e-3)


@pytest.mark.parametrize("value", [0.0, 0.5])
def test_images_without_contrast_stay_where_they_are(value: float) -> None:
    assert torch.equal(register(torch.full((1, 48, 42), value), faces(1, 48, 42)), torch.zeros(6))


def test_unlike_images_stay_within_reach() -> None:
    noise = torch.rand(1, 96, 84, generator=torch.Generator().manual_seed(0))
    theta = register(noise, faces(1))
    assert torch.isfinite(theta).all()
    assert (theta.abs() <= 3.001 * torch.tensor(SPREAD)).all()


def test_congealing_brings_people_into_step() -> None:
    truth = 0.6 * torch.tensor(SPREAD) * torch.randn(10, 6, generator=torch.Generator().manual_seed(1))
    truth = truth - truth.mean(0)
    scattered = torch.stack([undeform(face[None], theta)[0] for face, theta in zip(faces(10), truth, strict=True)])
    found = congeal(scattered)
    assert found.mean(0).abs().max() < 1e-6
    left, before = (found - truth) / torch.tensor(SPREAD), truth / torch.tensor(SPREAD)
    assert left.square().mean() < 0.3 * before.square().mean()  # the prior shrinks what is left uncertain


def test_aligned_people_are_sharper_and_missing_images_do_no_harm() -> None:
    lights = torch.nn.functional.normalize(torch.tensor([[0.0, 0, 1], [0.3, 0, 1], [0, 0.3, 1], [2.0, 0, 1]]), dim=1)
    truth = 0.6 * torch.tensor(SPREAD) * torch.randn(8, 6, generator=torch.Generator().manual_seed(2))
    scattered = torch.stack([undeform(face[None], theta)[0] for face, theta in zip(faces(8), truth, strict=True)])
    images = scattered[:, None] * torch.tensor([0.5, 0.6, 0.7, 0.2])[None, :, None, None]
    valid = torch.ones(8, 4, dtype=torch.bool)
    valid[3, 1] = False
    images[3, 1] = 0
    aligned = align_people(images, lights, valid)
    assert aligned.shape == images.shape
    assert aligned[valid].std(0).mean() <= images[valid].std(0).mean()
    assert aligned[:, 0].std(0).mean() < 0.75 * images[:, 0].std(0).mean()
    valid[5, :3] = False
    with pytest.raises(ValueError, match="camera"):
        align_people(images, lights, valid)


def test_conditioning_with_registration_returns_the_image_in_its_own_place(
    statistics: FaceStatistics, lights: torch.Tensor
) -> None:
    """Consistency up to two interpolations; the black image still gives the prior mean."""
    person = shaded_people(1, lights, 5)
    for model in ("pixel", "face"):
        relighter = StatisticalRelighter(statistics, model)
        again = relighter.condition(person[:, 4:5], lights[4:5], register=True)
        assert (again.mean(lights[4:5])[0, 0] - person[0, 4])[3:-3, 3:-3].abs().max() < 0.02
        assert (again.variance(lights[:3]) >= 0).all()
        black = relighter.condition(torch.zeros(1, 1, 24, 21), torch.zeros(1, 3), register=True)
        plain = relighter.condition(torch.zeros(1, 1, 24, 21), torch.zeros(1, 3))
        assert torch.allclose(black.mean(lights[:2]), plain.mean(lights[:2]), atol=1e-4)


def test_registration_mends_a_shifted_input() -> None:
    """A held-out face photographed out of place: relit with registration it is nearer to the truth in that place."""
    generator = torch.Generator().manual_seed(3)
    lights = torch.nn.functional.normalize(torch.randn(8, 3, generator=generator) + torch.tensor([0, 0, 2.0]), dim=1)
    lit = faces(20, 48, 42)[:, None] * (0.4 + 0.6 * lights[:, 2].square())[None, :, None, None]
    x = torch.linspace(-1, 1, 42)
    lit = lit * (1 + 0.5 * lights[:, :1, None] * x)[None]
    statistics = FaceStatistics.fit(lit[:16], lights, rank=4, face_rank=6)
    relighter = StatisticalRelighter(statistics, "face")
    errors = {True: 0.0, False: 0.0}
    for person in lit[16:]:
        moved = undeform(person, KNOWN)
        for how in errors:
            relit = relighter.condition(moved[None, :1], lights[:1], register=how).mean(lights[1:])[0]
            errors[how] += float((relit - moved[1:])[:, 4:-4, 4:-4].square().mean())
    assert errors[True] < 0.5 * errors[False], errors
