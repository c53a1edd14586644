"""Statistics of coarser images are those that coarse images teach."""

import pytest
import torch

from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.pooling import pooled_statistics
from facerelight.model.statistics import FaceStatistics

OPTIONS = {"rank": 5, "face_rank": 4, "basis": 8}


def enlarged(images: torch.Tensor) -> torch.Tensor:
    """Every pixel as a block of two by two."""
    return images.repeat_interleave(2, -1).repeat_interleave(2, -2)


@pytest.fixture(scope="module")
def learned(people, lights):
    """Of images in which blocks are of one value, pooled; and of the small images themselves."""
    fine = FaceStatistics.fit(enlarged(people[:12]), lights, temper=40.0, **OPTIONS)
    return pooled_statistics(fine, 2), FaceStatistics.fit(people[:12], lights, temper=10.0, **OPTIONS), fine


def test_maps_are_those_of_small_images(learned):
    pooled, small, _ = learned
    assert pooled.size == small.size
    assert torch.allclose(pooled.n_mean, small.n_mean, atol=1e-5)
    assert torch.allclose(pooled.mean_images(), small.mean_images(), atol=1e-5)
    for part in ("n_factor", "v_std", "v_factor"):
        of_all, of_rest = (getattr(place, part) for place in (pooled.pixel, pooled.face.residual))
        assert torch.isfinite(of_all).all()
        assert of_rest.shape == getattr(small.face.residual, part).shape
    assert float(pooled.face.temper) == float(small.face.temper)


def test_a_coarse_image_says_what_the_fine_one_says(learned, people, lights):
    pooled, _, fine = learned
    image = people[13:14, 3:4]
    coarse = StatisticalRelighter(pooled, "face").condition(image, lights[3:4]).mean(lights)
    sharp = StatisticalRelighter(fine, "face").condition(enlarged(image), lights[3:4]).mean(lights)
    assert (enlarged(coarse) - sharp).abs().max() < 1e-3


@pytest.mark.parametrize("block", [0, 5, 1.5])
def test_a_block_divides_the_size(learned, block):
    with pytest.raises(ValueError, match="block: expected a divisor of 48 and of 42"):
        pooled_statistics(learned[2], block)


def test_a_block_of_one_is_a_copy(learned):
    same = pooled_statistics(learned[2], 1)
    assert torch.equal(same.n_mean, learned[2].n_mean)
    assert same.n_mean is not learned[2].n_mean
