"""Colour: the camera's curve, highlights, shade and white, against formulas and synthetic mixtures."""

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from facerelight.geometry.alignment import CropFrame, fit_similarity
from facerelight.photo.bust.frame import Window, working_window
from facerelight.photo.colour import CAST, LUMA, WARM, SkinColour, part_highlight, relit_radiance, to_display, to_scene
from facerelight.photo.compose import Changes, change_pixels
from facerelight.photo.skin import skin_colour

SKIN = np.array((1.45, 0.92, 0.6), np.float32)  # a skin's colour
SKIN = SKIN / float(SKIN @ LUMA)


def whole_window(height: int, width: int) -> Window:
    """A window that is its whole photograph."""
    crop = CropFrame(48, 42, 0.25)
    middle = torch.tensor((width / 2, height / 2))
    marks = middle + torch.tensor(((-0.1, -0.05), (0.1, -0.05), (0.0, 0.15))) * width
    window = working_window((height, width), fit_similarity(marks.double(), crop.landmarks).numpy(), crop)
    assert window.size == (height, width)
    return window


def colour_of(size: tuple[int, int], **maps: np.ndarray) -> SkinColour:
    """By default no skin anywhere and no cast; what there is of skin is of its own colour."""
    nothing = np.zeros(size, np.float32)
    made = {
        "skin": nothing,
        "lit": nothing,
        "pigment": nothing,
        "typical": SKIN,
        "cast": np.ones((*size, 3), np.float32),
    }
    made["diffuse"] = np.broadcast_to(SKIN, (*size, 3)).copy()
    return SkinColour(**{**made, **maps})


def changed(
    pixels: np.ndarray,
    log_ratio: float,
    strength: float = 1.0,
    change: float = 0.0,
    cover: np.ndarray | None = None,
    **maps,
) -> np.ndarray:
    """Pixels under one log ratio."""
    size = pixels.shape[:2]
    cover = np.ones(size, np.float32) if cover is None else cover
    ratio = np.full((*size, 1), log_ratio, np.float32)
    ground = to_scene(
        pixels.astype(np.float32)
        / {"f": 1.0, "u": np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1.0}[pixels.dtype.kind]
    )
    return change_pixels(
        pixels, whole_window(*size), Changes(ratio, colour_of(size, **maps), cover, ground, change, strength)
    )


def relit(scene: np.ndarray, log_ratio: np.ndarray, change: float = 0.0, **maps: np.ndarray) -> np.ndarray:
    return relit_radiance(scene, log_ratio, colour_of(scene.shape[:2], **maps), change)


def test_curve_against_its_formula() -> None:
    """y = 1.5 e^1.25 / (1 + 0.5 e^1.25) of linear display values y, solved for e by bisection."""
    for code in (0.0, 0.02, 0.1, 0.35, 0.5, 0.8, 0.97, 1.0):
        linear = code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4
        scene = brentq(lambda e, y=linear: 1.5 * e**1.25 / (1 + 0.5 * e**1.25) - y, 0, 1.5, xtol=1e-14)
        assert float(to_scene(np.array(code))) == pytest.approx(scene, abs=2e-6)
        assert float(to_display(np.full(3, scene))[0]) == pytest.approx(code, abs=2e-6)


def test_there_and_back() -> None:
    codes = np.random.default_rng(0).random((2000, 3)).astype(np.float32)
    assert np.abs(to_display(to_scene(codes)) - codes).max() < 3e-6
    assert np.abs(to_display(to_scene(codes), to_scene(codes)) - codes).max() < 3e-6
    ends = np.array(((0, 0, 0), (1, 1, 1)), np.float32)
    assert np.allclose(to_scene(ends), ends, atol=1e-6)
    assert (np.diff(to_scene(np.linspace(0, 1, 1001))) > 0).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_ratio_of_one_changes_nothing(dtype: type) -> None:
    """Exactly, in integers of any depth, for any colour and any map of skin; in floats to a millionth."""
    generator = np.random.default_rng(0)
    white = 1 if dtype is np.float32 else np.iinfo(dtype).max
    pixels = (generator.random((300, 300, 3)) * (white + (dtype is not np.float32))).astype(dtype)
    pixels[:2, :256] = np.arange(256)[:, None] * (white / 255)  # greys
    pixels[2:4] = generator.choice(np.array((0, white), dtype), (2, 300, 3))  # corners of the cube
    maps = {name: generator.random((300, 300)).astype(np.float32) for name in ("skin", "lit", "cover")}
    maps["diffuse"] = generator.uniform(0.2, 2, (300, 300, 3)).astype(np.float32)
    maps["cast"] = generator.uniform(0.7, 1.4, (300, 300, 3)).astype(np.float32)
    same = changed(pixels, 0.0, **maps)
    if dtype is np.float32:
        assert np.abs(same - pixels).max() < 5e-6
    else:
        assert np.array_equal(same, pixels)
    assert np.array_equal(changed(pixels, -1.0, strength=0.0, **maps), pixels)


def test_brightening_never_clips() -> None:
    """What was below white stays below it; what grows never shrinks; three channels go together."""
    generator = np.random.default_rng(1)
    pixels = generator.integers(0, 255, (300, 300, 3), dtype=np.uint8)
    for log_ratio in (0.05, 0.4, 1.1, 2.0):
        out = changed(pixels, log_ratio)
        assert out.max() < 255
        assert (out.max(-1) >= pixels.max(-1)).all()
        assert out.mean() > pixels.mean()
    assert (changed(np.full((300, 300, 3), 255, np.uint8), 1.0) == 255).all()


@pytest.mark.parametrize("log_ratio", [-3.5, -1.0, -0.2, 0.2, 0.8, 1.5])
def test_order_of_greys_is_kept(log_ratio: float) -> None:
    pixels = np.repeat(np.linspace(0, 1, 300, dtype=np.float32)[None, :, None], 300, 0).repeat(3, 2)
    out = changed(pixels, log_ratio)
    assert (np.diff(out[..., 0], axis=1) >= -1e-6).all()
    assert out[0, 0, 0] == 0
    assert out[0, 5:-5].mean() < pixels[0, 5:-5].mean() if log_ratio < 0 else out.mean() > pixels.mean()
    assert np.ptp(out, axis=-1).max() < 1e-6  # grey stays grey where there is no skin


def test_without_skin_radiance_is_scaled() -> None:
    generator = np.random.default_rng(2)
    scene = generator.random((20, 20, 3)).astype(np.float32)
    for log_ratio in (-2.0, -0.5, 0.7):
        per_channel = (log_ratio + np.array((0.2, 0, -0.3))).astype(np.float32)
        for ratio in (np.full((20, 20, 1), log_ratio, np.float32), np.broadcast_to(per_channel, (20, 20, 3))):
            assert np.allclose(relit(scene, ratio, change=1.0), scene * np.exp(ratio), rtol=1e-5)


def test_shaded_skin_is_warmer() -> None:
    """Without highlights, red falls by less than the ratio, blue by more: ``R ** (1 - 0.03)`` and ``R ** 1.03``."""
    scene = np.broadcast_to(0.3 * SKIN, (4, 4, 3)).astype(np.float32)
    ones = np.ones((4, 4), np.float32)
    out = relit(scene, np.full((4, 4, 1), -1.0, np.float32), skin=ones)[0, 0]
    missing = np.exp(-1) * scene[0, 0] @ LUMA - scene[0, 0] * np.exp(-1 - WARM * np.array((-1, 0.25, 1))) @ LUMA
    wanted = scene[0, 0] * np.exp(-1 - WARM * np.array((-1, 0.25, 1))) + 0.6 * max(missing, 0) * SKIN
    assert np.allclose(out, wanted, rtol=1e-3)
    assert 0.02 < WARM < 0.05
    assert out[0] / out[2] > scene[0, 0, 0] / scene[0, 0, 2]
    assert float(out @ LUMA) == pytest.approx(np.exp(-1) * float(scene[0, 0] @ LUMA), rel=0.02)


def test_synthetic_highlights_are_found() -> None:
    """``d diffuse + s white`` for random skins; exact while s is below 9 tenths of the least channel."""
    generator = np.random.default_rng(3)
    diffuse = generator.uniform(0.4, 1, (40, 40, 3)).astype(np.float32) * SKIN
    amount = generator.uniform(0.05, 1, (40, 40)).astype(np.float32)
    highlight = generator.uniform(0, 0.8, (40, 40)).astype(np.float32)
    highlight = np.minimum(highlight, 7 * amount * diffuse.min(-1))
    found = part_highlight(amount[..., None] * diffuse + highlight[..., None], diffuse)
    sure = np.ptp(diffuse / (diffuse @ LUMA)[..., None], axis=-1) > 0.3  # a grey skin has no highlights to tell apart
    assert sure.mean() > 0.8
    assert np.abs(found[0] - amount)[sure].max() < 2e-3
    assert np.abs(found[1] - highlight)[sure].max() < 2e-3
    nothing = part_highlight(amount[..., None] * diffuse, diffuse)[1]
    assert np.abs(nothing)[sure].max() < 2e-3


def test_highlights_die_faster_in_shade_and_grow_slower_in_light() -> None:
    ones = np.ones((2, 2), np.float32)
    diffuse = np.broadcast_to(SKIN, (2, 2, 3))
    scene = (0.3 * diffuse + 0.1).astype(np.float32)

    def share(image: np.ndarray) -> float:
        amount, highlight = part_highlight(image, diffuse)
        return float(highlight[0, 0] / amount[0, 0])

    before = share(scene)
    for log_ratio, sign in ((-1.0, -1), (0.8, -1)):
        out = relit(scene, np.full((2, 2, 1), log_ratio, np.float32), skin=ones)
        assert sign * (share(out) - before) > 0.02
        assert float(out[0, 0] @ LUMA / (scene[0, 0] @ LUMA)) == pytest.approx(np.exp(log_ratio), rel=0.12)


def test_dimmed_highlights_leave_skin() -> None:
    """Six tenths of the luminance that a dying highlight takes away goes back as the skin's own colour."""
    body, highlight = 0.3 * SKIN, np.full(3, 0.1, np.float32)
    scene = np.broadcast_to(body + highlight, (2, 2, 3)).astype(np.float32)
    ones = np.ones((2, 2), np.float32)
    out = relit(scene, np.full((2, 2, 1), -1.0, np.float32), skin=ones)[0, 0]
    bare = np.exp(-1 - WARM * np.array((-1, 0.25, 1))) * body + np.exp(-1.6) * highlight
    missing = float((np.exp(-1) * scene[0, 0] - bare) @ LUMA)
    assert missing > 0.01
    assert np.allclose(out, bare + 0.6 * missing * SKIN, rtol=2e-3)


def test_lifted_shade_takes_the_lamps_white() -> None:
    """Bluish shade on skin goes to the skin's own colour; its luminance grows by the ratio all the same."""
    shade = 0.05 * SKIN * np.array((0.75, 1.0, 1.3), np.float32)
    scene = np.broadcast_to(shade, (2, 2, 3)).astype(np.float32)
    ones = np.ones((2, 2), np.float32)
    ratio = np.full((2, 2, 1), 1.1, np.float32)
    gaps = []
    for lit in (0 * ones, ones):
        out = relit(scene, ratio, lit=lit)[0, 0]
        assert float(out @ LUMA) == pytest.approx(np.exp(1.1) * float(shade @ LUMA), rel=1e-3)
        gaps.append(np.abs(out / (out @ LUMA) - SKIN).max())
    assert gaps[1] < 0.5 * gaps[0]
    assert np.allclose(relit(scene, -ratio, lit=ones), relit(scene, -ratio))


def test_colour_casts_go_with_the_old_light() -> None:
    """Seven tenths of one, in log, where it is lit as skin and as surely as the light is another; luminance stays."""
    cast = np.broadcast_to(np.array((0.8, 1.0, 1.3), np.float32), (2, 2, 3))
    scene = (0.3 * SKIN * cast).astype(np.float32)
    nothing, ones = np.zeros((2, 2, 1), np.float32), np.ones((2, 2), np.float32)
    for change, lit in ((1.0, 1.0), (0.5, 1.0), (1.0, 0.4), (0.0, 1.0), (1.0, 0.0)):
        out = relit(scene, nothing, change, lit=lit * ones, cast=cast)[0, 0]
        assert float(out @ LUMA) == pytest.approx(float(scene[0, 0] @ LUMA), rel=1e-5)
        left = np.log(out / scene[0, 0] * cast[0, 0])
        wanted = (1 - 0.7 * change * lit) * np.log(cast[0, 0])
        assert np.allclose(left - left[1], wanted - wanted[1], atol=1e-5)
    assert pytest.approx(0.7) == CAST


def test_cover_and_strength_mix_radiance() -> None:
    """Half the cover or half the strength is half the radiance's change; nothing where the cover is 0."""
    pixels = np.full((300, 300, 3), 0.5, np.float32)
    cover = np.zeros((300, 300), np.float32)
    cover[:, 100:200] = 0.5
    cover[:, 200:] = 1
    out = changed(pixels, -1.0, cover=cover)
    scene = float(to_scene(np.array(0.5)))
    for column, share in ((50, 0.0), (150, 0.5), (250, 1.0)):
        wanted = scene * (1 + share * (np.exp(-1) - 1))
        assert float(to_scene(out[150, column, 0])) == pytest.approx(wanted, rel=1e-4)
    half = changed(pixels, -1.0, strength=0.5)
    assert np.allclose(half[150, 150], out[150, 150], atol=1e-6)
    noise = np.random.default_rng(0).integers(0, 256, (300, 300, 3), dtype=np.uint8)
    kept = changed(noise, -1.0, cover=cover)
    assert np.array_equal(kept[:, :99], noise[:, :99])
    assert (kept != noise)[:, 101:].any(-1).mean() > 0.9
    floats = (noise / 255).astype(np.float32)
    assert np.array_equal(changed(floats, -1.0, cover=cover)[:, :99], floats[:, :99])


def test_outline_mixes_a_relit_person_with_the_ground() -> None:
    """A pixel half person and half ground becomes half the relit person and the same ground."""
    cover = np.linspace(0, 1, 60, dtype=np.float32)[None].repeat(40, 0)
    person, ground = np.array((0.5, 0.4, 0.3), np.float32), np.full((40, 60, 3), 0.8, np.float32)
    scene = cover[..., None] * person + (1 - cover[..., None]) * ground
    pixels = to_display(scene)
    changes = Changes(np.full((40, 60, 1), -1.0, np.float32), colour_of((40, 60)), cover, ground, 0.0, 1.0)
    out = to_scene(change_pixels(pixels, whole_window(40, 60), changes))
    truth = cover[..., None] * person * np.exp(-1) + (1 - cover[..., None]) * ground
    assert np.abs(out - truth).max() < 2e-3


def test_blown_skin_takes_the_typical_colour_in_shade() -> None:
    """What a camera clipped has lost its colour; darkened it is skin again, as surely as the light changed."""
    scene = np.full((4, 4, 3), (1.0, 0.97, 0.7), np.float32)
    typical, sure = np.array((1.3, 0.92, 0.72), np.float32), np.ones((4, 4), np.float32)
    dark = relit(scene, np.full((4, 4, 1), -1.0, np.float32), change=1.0, lit=sure, typical=typical)[0, 0]
    assert np.allclose(dark / (dark @ LUMA), typical / (typical @ LUMA), atol=0.02)
    for log_ratio, change in ((-1.0, 0.0), (0.0, 1.0)):
        kept = relit(scene, np.full((4, 4, 1), log_ratio, np.float32), change=change, lit=sure, typical=typical)[0, 0]
        assert np.allclose(kept / kept[0], scene[0, 0] / scene[0, 0, 0], atol=0.02)


def test_strips_join_without_seams() -> None:
    """A large photograph is worked on in strips of its own size, from small maps: a ramp stays one."""
    height, width = 900, 1200
    pixels = np.full((height, width, 3), 0.5, np.float32)
    window = whole_window(60, 80)
    large = working_window((height, width), window.to_crop * 1.0, window.crop)
    ramp = np.linspace(-1, 0, 60, dtype=np.float32)[:, None, None] * np.ones((1, 80, 1), np.float32)
    nothing = np.zeros((60, 80), np.float32)
    large = large.__class__(
        slice(0, height), slice(0, width), (60, 80), window.to_bust, window.to_crop, 1.0, window.crop
    )
    out = change_pixels(
        pixels, large, Changes(ramp, colour_of((60, 80)), nothing + 1, np.zeros((60, 80, 3), np.float32), 0.0, 1.0)
    )
    log_ratio = np.log(to_scene(out[:, 5, 0]) / to_scene(np.array(0.5)))
    wanted = np.interp((np.arange(height) + 0.5) / 15 - 0.5, np.arange(60), ramp[:, 0, 0])
    assert np.abs(log_ratio - wanted).max() < 1e-3
    assert np.ptp(out, axis=1).max() < 1e-6


def disc_face(tone: float, grey: bool = False) -> tuple[np.ndarray, ...]:
    """A lit disc of skin with a highlight before a blue ground, and its maps."""
    window = whole_window(300, 300)
    x, y = window.places()
    oval = np.hypot(x, (y + 0.42) / 1.42).astype(np.float32)
    face = np.clip((1 - oval) / 0.1, 0, 1).astype(np.float32)
    shading = (0.35 + 0.15 * x.clip(-1, 1)).astype(np.float32)
    colour = np.ones(3, np.float32) if grey else SKIN
    skin = tone * (shading[..., None] * colour + 0.2 * np.exp(-40 * ((x - 0.3) ** 2 + y**2))[..., None])
    scene = np.where(face[..., None] > 0, skin, np.array((0.05, 0.1, 0.5), np.float32)).astype(np.float32)
    return scene, face, oval, np.zeros_like(face), np.ones_like(face), window


@pytest.mark.parametrize("tone", [1.0, 0.35, 0.12])
def test_skins_own_colour_without_its_highlight(tone: float) -> None:
    """Fair or dark, the disc's colour is found within 4%, the ground is none of it."""
    scene, face, *rest = disc_face(tone)
    found = skin_colour(scene, face, *rest)
    inside = face > 0.9
    assert np.abs(found.diffuse[inside] / SKIN - 1).max() < 0.04
    assert np.abs(found.typical / SKIN - 1).max() < 0.05
    assert float(found.typical @ LUMA) == pytest.approx(1, abs=1e-3)
    assert found.skin[inside].min() > 0.85
    assert found.skin[face == 0].mean() < 0.05
    assert found.pigment[inside].max() < 0.2


def test_wide_highlights_do_not_wash_skin_out() -> None:
    """Half of the face's places, evenly spread, shine: the others lead, within 6%; a plain mean is 10% off and more."""
    scene, face, *rest = disc_face(1.0)
    x, y = rest[-1].places()
    shines = (np.sin(20 * x) * np.sin(20 * y) > 0)[..., None] & (face[..., None] > 0)
    scene = np.where(shines, scene + 0.25, scene).astype(np.float32)
    inside = (face > 0.9) & (np.hypot(x, y + 0.4) < 0.8)
    assert np.abs(scene[inside].mean(0) / (scene[inside].mean(0) @ LUMA) / SKIN - 1).max() > 0.1
    found = skin_colour(scene, face, *rest)
    assert np.abs(found.diffuse[inside].mean(0) / SKIN - 1).max() < 0.06


def test_dark_hair_on_a_face_is_pigment() -> None:
    scene, face, oval, features, matte, window = disc_face(0.8)
    _, y = window.places()
    beard = (oval < 0.9) & (y < -1.2)
    scene[beard] = 0.02  # grey, a tenth as bright as the skin
    face = face * ~beard
    found = skin_colour(scene, face, oval, features, matte, window)
    assert found.pigment[beard & (oval < 0.8)].mean() > 0.7
    assert found.pigment[(oval < 0.8) & (y > -0.9)].max() < 0.1
    assert found.skin[beard].mean() < 0.3


def test_neck_is_skin_and_a_shirt_is_not() -> None:
    scene, face, oval, features, matte, window = disc_face(0.9)
    x, y = window.places()
    neck, shirt = (
        (np.abs(x) < 0.5) & (y < -2.0) & (y > -2.35),
        (np.abs(x) > 1.4) & (np.abs(x) < 2.2) & (np.abs(y) < 0.5),
    )
    scene[neck] = 0.25 * SKIN + 0.03
    scene[shirt] = (0.1, 0.4, 0.15)
    found = skin_colour(scene, face, oval, features, matte, window)
    inner = (np.abs(x) < 0.3) & (y < -2.1) & (y > -2.25)
    assert found.skin[inner].mean() > 0.6
    assert found.skin[shirt].max() < 0.1
    hidden = skin_colour(scene, face, oval, features, matte * (oval < 1.0), window)
    assert hidden.skin[inner].max() < 0.1


def test_no_skin_at_all_is_finite() -> None:
    scene, face, oval, features, matte, window = disc_face(1.0)
    for image in (scene, 0 * scene, 0 * scene + 1):
        found = skin_colour(image, 0 * face, oval, features, matte, window)
        assert all(np.isfinite(part).all() for part in found)
        assert np.allclose(found.typical, 1)


def test_scaled_skin_has_the_same_maps() -> None:
    """Dark skin and fair skin differ by a scale alone: colour, pigment and where the face's skin is are the same."""
    fair, dark = (skin_colour(*disc_face(tone)) for tone in (0.9, 0.25))
    inside = disc_face(1.0)[1] > 0.9
    assert np.abs(fair.diffuse - dark.diffuse)[inside].max() < 0.02
    assert np.abs(fair.typical - dark.typical).max() < 0.05
    assert np.abs(fair.pigment - dark.pigment)[inside].max() < 0.05
    assert np.abs(fair.skin - dark.skin)[inside].max() < 0.1
