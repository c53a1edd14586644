import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from facerelight.inference.detail import SCALE, keep_detail
from facerelight.numerics.blur import gaussian_blur
from facerelight.numerics.luminance import NOISE_FLOOR


def patterns(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, 48, 42, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.3])
def test_blur_equals_scipys(sigma: float) -> None:
    images = patterns(3)
    reach = int(3 * sigma + 0.5)
    expected = np.stack(
        [gaussian_filter(image.double().numpy(), sigma, mode="nearest", radius=reach) for image in images]
    )
    assert np.abs(gaussian_blur(images, sigma).numpy() - expected).max() < 1e-5


def test_detail_is_exchanged_as_the_docstring_says() -> None:
    """Against base and detail layers written out in float64, one image at a time."""
    relit, photo = patterns(2, 3), patterns(2, seed=1)
    sigma = SCALE * 42

    def layers(image: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        lifted = image.double().numpy() + NOISE_FLOOR
        base = gaussian_filter(lifted, sigma, mode="nearest", radius=int(3 * sigma + 0.5))
        return base, lifted / base

    for strength in (0.0, 0.3, 1.0):
        kept = keep_detail(relit, photo, strength)
        for person in range(2):
            for light in range(3):
                base, detail = layers(relit[person, light])
                expected = base * detail ** (1 - strength) * layers(photo[person])[1] ** strength - NOISE_FLOOR
                assert np.abs(kept[person, light].numpy() - expected.clip(0)).max() < 1e-5


def test_an_image_relit_to_its_own_light_stays() -> None:
    photo = patterns()
    assert torch.allclose(keep_detail(photo[None], photo, 1.0)[0], photo, atol=1e-6)


def test_dark_and_negative_images_stay_finite_and_not_negative() -> None:
    photo = torch.zeros(48, 42)
    kept = keep_detail(torch.stack((photo, photo - 0.1, photo + 1)), photo, 1.0)
    assert torch.isfinite(kept).all()
    assert (kept >= 0).all()
    assert torch.allclose(kept[2], torch.ones(48, 42), atol=1e-5)


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match="photo: expected"):
        keep_detail(patterns(2, 3), patterns(3))
    with pytest.raises(ValueError, match="strength"):
        keep_detail(patterns(2), patterns(), 1.5)
