"""Amounts that must be right and not merely of the right sign: of shrinkage, and of what a tempered code believes."""

import numpy as np
import torch

from facerelight.numerics.gaussian import low_rank_code
from facerelight.numerics.shrinkage import block_shrinkage


def test_block_shrinkage_is_schaefer_and_strimmer() -> None:
    """Entry by entry: the sum of the unbiased variances of the products' means over the sum of the squared means,
    between owners alone; never beyond 1."""
    generator = np.random.default_rng(0)
    owner = np.array([0, 1, 2, 0, 1, 2])
    mix = np.eye(6) + generator.standard_normal((6, 6))
    amounts = []
    for count in (20, 100, 1000):
        x = generator.standard_normal((count, 6)) @ mix
        above, below = 0.0, 0.0
        for i in range(6):
            for j in range(6):
                if owner[i] != owner[j]:
                    products = x[:, i] * x[:, j]
                    above += products.var(ddof=1) / count
                    below += products.mean() ** 2
        expected = x.T @ x / count
        amount = min(1.0, above / below)
        expected[owner[:, None] != owner] *= 1 - amount
        found = block_shrinkage(torch.from_numpy(x), torch.from_numpy(owner))
        assert np.allclose(found.numpy(), expected, atol=1e-10)
        amounts.append(amount)
    assert 0.1 < amounts[0] < 0.9
    assert amounts[0] > 3 * amounts[1] > 9 * amounts[2]  # about one in so many people
    alone = np.kron(generator.standard_normal((12, 1)), np.ones((1, 2))) * np.array([[1.0, 1.0]])
    apart = np.concatenate(
        (alone, generator.permutation(alone)), 1
    )  # two owners who have nothing to do with each other
    found = block_shrinkage(torch.from_numpy(apart), torch.tensor([0, 0, 1, 1])).numpy()
    assert np.allclose(found[:2, :2], apart[:, :2].T @ apart[:, :2] / 12)
    assert np.abs(found[:2, 2:]).max() < 0.02 * found.max()


def test_a_tempered_code_counts_each_pixel_as_a_part_of_one() -> None:
    """As the posterior of ``y = A c + e`` with ``temper / weight`` times the noise, written out; and as one observation
    of everything said temper times over."""
    generator = np.random.default_rng(0)
    design, y, weight = generator.standard_normal((20, 2, 3)), generator.standard_normal((20, 2, 4)), np.ones(20)
    weight[:5], weight[5:8] = 0, 0.3
    for temper, counted in ((1.0, None), (6.0, None), (6.0, weight)):
        kept = np.repeat(np.ones(20) if counted is None else counted, 2)
        a, right = design.reshape(40, 3), y.reshape(40, 4)
        noise = np.diag(temper / np.maximum(kept, 1e-12))
        gain = a.T @ np.linalg.inv(a @ a.T + noise)
        mean, factor = low_rank_code(
            torch.from_numpy(design),
            torch.from_numpy(y),
            temper,
            None if counted is None else torch.from_numpy(counted),
        )
        assert np.allclose(mean.numpy(), gain @ right, atol=1e-8)
        assert np.allclose((factor @ factor.T).numpy(), np.eye(3) - gain @ a, atol=1e-8)
    thrice = low_rank_code(*(torch.from_numpy(np.tile(x, (3, 1, 1))) for x in (design, y)), 3.0)
    once = low_rank_code(torch.from_numpy(design), torch.from_numpy(y), 1.0)
    assert torch.allclose(thrice[0], once[0])
    assert torch.allclose(thrice[1] @ thrice[1].T, once[1] @ once[1].T)
