import warnings

import pytest
import torch

from facerelight.numerics.gaussian import (
    NotPositiveDefiniteError,
    NumericalWarning,
    condition_gaussian,
    correlation_factor,
    positive_root,
    safe_cholesky,
)
from facerelight.numerics.kernels import kernel_weights, neighbour_widths


def test_jitter_goes_to_the_failing_member_alone() -> None:
    good, singular = torch.eye(3), torch.ones(3, 3)
    with pytest.warns(NumericalWarning, match="1 of 2"):
        factor = safe_cholesky(torch.stack((good, singular)))
    assert torch.equal(factor[0], torch.eye(3, dtype=torch.float64))
    assert torch.allclose(factor[1] @ factor[1].T, singular.double(), atol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        safe_cholesky(good)


def test_refuses_what_is_no_covariance() -> None:
    with pytest.raises(NotPositiveDefiniteError, match="semidefinite"):
        safe_cholesky(torch.diag(torch.tensor([1.0, -1.0])))
    with pytest.raises(NotPositiveDefiniteError, match="NaN"):
        safe_cholesky(torch.full((2, 2), torch.nan))


def test_conditioning_against_samples() -> None:
    """Regression on a million samples of the joint Gaussian gives the same conditional."""
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    joint = root @ root.T
    samples = torch.randn(400_000, 4, generator=generator, dtype=torch.float64) @ root.T
    y = torch.tensor([0.3, -0.2], dtype=torch.float64)
    mean = torch.zeros(2, dtype=torch.float64)
    out = condition_gaussian(mean, mean, joint[:2, :2], joint[:2, 2:], joint[2:, 2:], y)
    slope = torch.linalg.lstsq(samples[:, 2:], samples[:, :2]).solution
    assert torch.allclose(out.mean, slope.T @ y, atol=0.02)
    left = samples[:, :2] - samples[:, 2:] @ slope
    assert torch.allclose(out.covariance, left.T @ left / len(left), rtol=0.05, atol=0.02)


def test_correlation_factor_keeps_a_unit_diagonal() -> None:
    samples = torch.randn(5, 20, 8, generator=torch.Generator().manual_seed(0))
    unit = samples / samples.norm(dim=1, keepdim=True)
    full = correlation_factor(unit, 8)
    assert torch.allclose(full @ full.mT, unit.mT @ unit, atol=1e-5)
    for rank in (1, 3, 12):
        factor = correlation_factor(unit, rank)
        assert factor.shape == (5, 8, rank)
        assert (factor.square().sum(-1) <= 1 + 1e-6).all()


def test_correlation_factor_tells_small_directions_from_rounding() -> None:
    # 64 lights that nearly agree, as those of a pixel in the middle of a forehead: in float32 the Gram matrix's small
    # eigenvalues are rounding, and LAPACK has given up on such matrices
    generator = torch.Generator().manual_seed(0)
    basis, _ = torch.linalg.qr(torch.randn(80, 3, generator=generator, dtype=torch.float64))
    loads = torch.randn(3, 64, generator=generator, dtype=torch.float64) * torch.tensor([[1.0], [1e-5], [1e-6]])
    unit = basis @ loads
    unit = unit / unit.norm(dim=0)
    factor = correlation_factor(unit, 3)
    assert torch.allclose(factor @ factor.T, unit.T @ unit, atol=1e-14)
    rounded = correlation_factor(unit.float(), 2)
    assert rounded.dtype == torch.float32
    _, _, vectors = torch.linalg.svd(unit)
    share = (vectors[:2] @ torch.nn.functional.normalize(rounded[:, 1].double(), dim=0)).norm()
    assert share > 0.999  # five decades down is still a direction of the data


def test_kernel_weights_survive_underflow() -> None:
    weights = kernel_weights(torch.tensor([[1e8, 1e8 + 1e4, 2e8]]), 0.01)
    assert torch.allclose(weights, torch.tensor([[1.0, 0.0, 0.0]]))
    assert torch.allclose(kernel_weights(torch.zeros(1, 4), 0.1), torch.full((1, 4), 0.25))


def test_neighbour_widths() -> None:
    points = torch.tensor([[0.0], [1.0], [3.0]])
    assert neighbour_widths(torch.cdist(points, points), 1).tolist() == [1.0, 1.0, 2.0]
    assert neighbour_widths(torch.zeros(1, 1), 3).item() == 1.0
    with pytest.raises(ValueError, match="at least 1"):
        neighbour_widths(torch.zeros(2, 2), 0)


def test_the_root_of_nothing_has_no_slope() -> None:
    values = torch.tensor([4.0, 0.0, -1e-9], requires_grad=True)
    root = positive_root(values)
    root.sum().backward()
    assert root.tolist() == [2.0, 0.0, 0.0]
    assert values.grad is not None
    assert values.grad.tolist() == [0.25, 0.0, 0.0]
