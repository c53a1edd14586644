"""How much a reading of the inputs is believed: the tempered evidence, against quadrature over the code."""

import numpy as np
import pytest
import torch

from facerelight.model.subjects import face_operators
from facerelight.viewpoint.pose import ViewRelighter
from facerelight.viewpoint.views import ViewFields

PEOPLE, SIZE, LOCAL = 9, (2, 3), 4e-3


class Drawn:
    """People drawn once under views that are names, varied along one loading and by noise at each pixel."""

    size = SIZE

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        code = torch.randn(PEOPLE, 1, generator=generator)
        self.known = {
            view: 0.5
            + code * 0.1 * torch.randn(6, generator=generator)
            + step * torch.randn(PEOPLE, 6, generator=generator)
            for view, step in (("target", 0.02), ("one", 0.02), ("two", 0.05), ("three", 0.03), ("four", 0.02))
        }  # (N, P)

    def fields(self, views: list[str]) -> ViewFields:
        images = torch.stack([self.known[view] for view in views])
        same = torch.tensor([[float(a == b) for b in views] for a in views])
        mean = images.mean(1)
        return ViewFields(mean, (images - mean[:, None])[None], LOCAL * same[..., None].expand(-1, -1, 6))


def quadrature(source: Drawn, images: np.ndarray, views: list[str], temper: float) -> float:
    """``log`` of the integral over the code of the likelihood to the power of ``1 / temper``, times its prior, up to
    what all readings share."""
    known = source.fields(["target", *views])
    fields = known.fields[0].double().numpy()
    operators = face_operators(torch.from_numpy(np.einsum("vnp,vmp->nm", fields, fields)), 1)
    loading = np.einsum("n,vnp->vp", operators.loadings[0].double().numpy(), fields)[1:]  # (K, P)
    residual = np.einsum("mn,vnp->vmp", operators.residual.double().numpy(), fields)[1:]
    codes = np.linspace(-12, 12, 20_001)
    log = -0.5 * codes**2
    for p in range(images.shape[1]):
        covariance = residual[:, :, p] @ residual[:, :, p].T / PEOPLE + known.local[1:, 1:, p].double().numpy()
        off = images[:, p] - known.mean[1:, p].double().numpy() - codes[:, None] * loading[:, p]  # (C, K)
        misfit = (off @ np.linalg.inv(covariance) * off).sum(1)
        log = log - 0.5 * (misfit + np.log(np.linalg.det(covariance))) / temper
    return float(log.max() + np.log(np.exp(log - log.max()).sum()))


@pytest.mark.parametrize("temper", [1.0, 4.0])
@pytest.mark.parametrize("inputs", [1, 2])
def test_readings_weigh_as_quadrature_says(inputs: int, temper: float) -> None:
    source = Drawn()
    candidates = ["one", "two", "three"]
    images = torch.stack([source.known[view][3] for view in ("one", "four")][:inputs])
    images = (images + 0.05 * torch.randn(images.shape, generator=torch.Generator().manual_seed(1))).clamp_min(0)
    asked = [candidates, "four"][:inputs]
    out = ViewRelighter(source, 1, temper)(images.unflatten(1, SIZE)[None], asked, "target")  # type: ignore[arg-type]
    expected = torch.tensor(
        [quadrature(source, images.double().numpy(), [view, "four"][:inputs], temper) for view in candidates]
    )
    assert (out.weight[0] > 1e-3).sum() >= 2  # there is something to tell
    assert torch.allclose(out.weight[0], torch.softmax(expected, 0), atol=2e-3)


def test_readings_are_mixed() -> None:
    """Means by weight; variances, and how far the means lie apart."""
    source = Drawn()
    images = source.known["one"][2].unflatten(0, SIZE)[None, None] + 0.03
    relighter = ViewRelighter(source, 1, 4.0)  # type: ignore[arg-type]
    out = relighter(images, [["one", "two"]], "target")
    each = [relighter(images, [view], "target") for view in ("one", "two")]
    weight = out.weight[0]
    mean = weight[0] * each[0].mean + weight[1] * each[1].mean
    spread = sum(w * (e.variance + (e.mean - mean) ** 2) for w, e in zip(weight, each, strict=True))
    assert 0.05 < weight[0] < 0.95
    assert torch.allclose(out.mean, mean, atol=1e-6)
    assert torch.allclose(out.variance, spread, rtol=1e-4)
