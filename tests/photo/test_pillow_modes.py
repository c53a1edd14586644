"""Every mode of a Pillow picture: its values as Pillow itself has them in sRGB, and back in kind."""

import numpy as np
import pytest
from PIL import Image

from facerelight.photo.files.photograph import from_pillow, to_pillow

LEVELS = np.random.default_rng(0).integers(20, 230, (16, 12, 4)).astype(np.uint8)
DIRECT = {"1": "L", "L": "L", "LA": "LA", "La": "LA", "RGB": "RGB", "RGBA": "RGBA", "RGBa": "RGBA"}
CONVERTED = {"P": "RGB", "PA": "RGBA", "RGBX": "RGB", "YCbCr": "RGB", "HSV": "RGB", "LAB": "RGB", "CMYK": "CMYK"}


def picture(mode: str) -> Image.Image:
    whole = Image.fromarray(LEVELS, "RGBA")
    if mode in ("La", "RGBa"):
        return whole.convert({"La": "LA", "RGBa": "RGBA"}[mode]).convert(mode)
    if mode == "PA":
        return whole.convert("P").convert("PA")
    if mode == "LAB":
        return Image.frombytes("LAB", (12, 16), np.ascontiguousarray(LEVELS[..., :3]).tobytes())
    return whole.convert("RGB").convert(mode) if mode in CONVERTED else whole.convert(mode)


@pytest.mark.parametrize("mode", [*DIRECT, *CONVERTED])
def test_a_mode_is_seen_as_pillow_shows_it(mode: str) -> None:
    image = picture(mode)
    photo = from_pillow(image)
    kind = (DIRECT | CONVERTED)[mode]
    assert photo.mode == kind
    alpha = "A" in kind
    shown = np.asarray((image.convert("LA") if mode == "La" else image).convert("RGBA" if alpha else "RGB"))
    assert np.abs(photo.pixels.astype(int) - shown[..., :3]).max() <= (1 if mode == "CMYK" else 0)
    assert not alpha or np.array_equal(photo.stored_alpha, shown[..., 3])
    back = to_pillow(photo, photo.pixels)
    assert back.mode == kind
    assert np.array_equal(from_pillow(back).stored, photo.stored)


@pytest.mark.parametrize("mode", ["I;16", "I;16B", "I", "F"])
def test_deep_grey_keeps_its_depth(mode: str) -> None:
    deep = (LEVELS[..., 0].astype(np.uint16) * 257 + 3).clip(0, 65535)
    if mode == "F":
        image = Image.fromarray(deep.astype(np.float32) / 65535)
    elif mode == "I":
        image = Image.fromarray(deep.astype(np.int32))
    else:
        image = Image.frombytes(mode, (12, 16), deep.astype(">u2" if mode.endswith("B") else "<u2").tobytes())
    photo = from_pillow(image)
    assert photo.pixels.dtype == np.uint16
    assert np.abs(photo.pixels[..., 1].astype(int) - deep).max() <= 1
    back = to_pillow(photo, photo.pixels)
    assert back.mode in ("I;16", "F")
    assert np.array_equal(from_pillow(back).pixels, photo.pixels)


def test_a_palette_with_a_clear_colour_has_alpha() -> None:
    image = picture("P")
    image.info["transparency"] = int(np.asarray(image)[0, 0])
    photo = from_pillow(image)
    assert photo.mode == "RGBA"
    assert photo.stored_alpha is not None
    assert np.array_equal(photo.stored_alpha == 0, np.asarray(image) == np.asarray(image)[0, 0])
