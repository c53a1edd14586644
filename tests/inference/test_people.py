"""Several people at once are what they are one by one."""

import pytest
import torch

from facerelight.inference.people import FEW_TARGETS, PeoplePosterior
from facerelight.inference.posterior import Posterior
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics


@pytest.fixture(scope="module", params=["pixel", "face", "face, brightness"])
def relighter(request, people, lights) -> StatisticalRelighter:
    covariance, _, brightness = request.param.partition(", ")
    learned = FaceStatistics.fit(
        people[:12], lights, rank=6, face_rank=5, temper=10.0, basis=12, brightness=bool(brightness)
    )
    return StatisticalRelighter(learned, covariance)


def both(relighter: StatisticalRelighter, images, lights, **options) -> tuple[Posterior, Posterior]:
    """The posterior at once, and the same one by one."""
    together = relighter.condition(images, lights, **options)
    assert isinstance(together, PeoplePosterior)
    return together, together.separately()


def towards(count: int, seed: int) -> torch.Tensor:
    drawn = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(torch.cat((drawn[:, :2], drawn[:, 2:].abs() + 0.2), 1), dim=1)


@pytest.mark.parametrize("options", ["plain", "mask", "noise"])
def test_means_are_those_of_single_people(relighter, people, lights, options):
    images, sources = people[12:, 5:6] * torch.tensor([0.6, 1.0, 1.5, 0.9])[:, None, None, None], towards(4, 0)
    given = {}
    if options == "mask":
        given["mask"] = (torch.rand(4, 24, 21, generator=torch.Generator().manual_seed(1)) > 0.4).float()
    if options == "noise":
        given["noise"] = 0.05 * torch.rand(4, 1, 24, 21, generator=torch.Generator().manual_seed(2))
    together, single = both(relighter, images, sources[:, None], **given)
    near = sources + 0.02 * towards(4, 3)
    for targets in (towards(3, 4), torch.stack((near, towards(4, 5)), 1), lights, sources[:, None]):
        assert (together.mean(targets) - single.mean(targets)).abs().max() < 1e-4
    if relighter.covariance == "face":
        assert torch.allclose(together.code(), single.code(), atol=1e-4)
    else:
        with pytest.raises(RuntimeError, match="covariance='face'"):
            together.code()


def test_what_is_not_worked_out_together_is_one_by_one(relighter, people):
    images, sources = people[12:, 5:6], towards(4, 0)
    together, single = both(relighter, images, sources[:, None])
    many = towards(4 * (FEW_TARGETS + 1), 6).unflatten(0, (4, -1))
    assert torch.equal(together.variance(sources[:, None]), single.variance(sources[:, None]))
    assert torch.equal(together.mean(many), single.mean(many))
    assert len(together.people) == 4
    with pytest.raises(ValueError, match=r"expected \(Q, 3\) or \(4, Q, 3\)"):
        relighter.condition(images, sources[:, None]).mean(torch.rand(3, 1, 3))
    assert relighter.condition(images, sources[:, None]).mean(torch.zeros(4, 0, 3)).shape == (4, 0, 24, 21)


def test_noiseless_inputs_are_returned(people):
    learned = FaceStatistics.fit(people[:12], towards(30, 9), rank=6, face_rank=5, brightness=False)
    relighter = StatisticalRelighter(learned, "face", noise=0.0)
    images, sources = people[12:, 5:6], towards(4, 0)
    assert (relighter.condition(images, sources[:, None]).mean(sources[:, None]) - images).abs().max() < 1e-4


def test_slopes_are_kept(relighter, people):
    images = people[12:, 5:6].clone().requires_grad_()
    relighter.condition(images, towards(4, 0)[:, None]).mean(towards(2, 1)).sum().backward()
    assert images.grad.abs().sum() > 0
