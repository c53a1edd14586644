"""A photograph relit, whole: what stays, what changes and to which side, hard inputs, every kind of array."""

import warnings

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from facerelight.geometry.sources import Lamp, fill_light, scene_light
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import PhotoRelighter, relight
from facerelight.photo import person as person_module
from facerelight.photo.bust import matte as matte_module
from facerelight.photo.face_model import FaceModel
from facerelight.photo.files.pixels import as_rgb, like

MARKS = np.array(((202.0, 101.0), (247.0, 103.0), (221.0, 144.0)))
HALF = (MARKS + 0.5) / 2 - 0.5
CHEEK_LEFT, CHEEK_RIGHT = (slice(115, 130), slice(198, 208)), (slice(115, 130), slice(236, 246))
SKIN = slice(110, 135), slice(200, 245)
CLOSE = slice(98, 148), slice(202, 248)  # from the eyes to the mouth: nothing but the face
CLOSE_MARKS = np.array(((-0.4, -0.4), (45.4, -0.4), (22.5, 49.4)))


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()


@pytest.fixture(scope="module")
def half(astronaut: np.ndarray) -> np.ndarray:
    return cv2.resize(astronaut, (256, 256), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def relighter(folder) -> StatisticalRelighter:
    return StatisticalRelighter.from_pretrained(folder)


@pytest.fixture(scope="module")
def session(astronaut: np.ndarray, relighter: StatisticalRelighter) -> PhotoRelighter:
    return PhotoRelighter(astronaut, MARKS, relighter)


@pytest.fixture(scope="module")
def exhaustive(astronaut: np.ndarray, relighter: StatisticalRelighter) -> PhotoRelighter:
    return PhotoRelighter(astronaut, MARKS, relighter, stages="all")


@pytest.fixture(scope="module")
def relit_half(half: np.ndarray, relighter: StatisticalRelighter) -> np.ndarray:
    return relight(half, 50, 10, HALF, relighter)


def grey(image: np.ndarray) -> np.ndarray:
    return image.astype(float).mean(-1)


def gap(one: np.ndarray, two: np.ndarray) -> float:
    """In codes."""
    return float(np.abs(one.astype(float) - two.astype(float)).max())


# -- what stays


def test_own_light_gives_the_photo_back(
    session: PhotoRelighter, exhaustive: PhotoRelighter, astronaut: np.ndarray
) -> None:
    assert gap(session.render(session.light, fill=0), astronaut) <= 1
    assert gap(exhaustive.render(exhaustive.light, fill=0), astronaut) <= 1


@pytest.mark.parametrize("kind", ["dark", "grey", "close", "second photo"])
def test_own_light_gives_any_photo_back(
    kind: str, half: np.ndarray, astronaut: np.ndarray, relighter: StatisticalRelighter
) -> None:
    photo, marks, more = half, HALF, ()
    if kind == "dark":
        photo = (half * 0.15).astype(np.uint8)
    elif kind == "grey":
        photo = half[..., 1].astype(np.uint16) * 257
    elif kind == "close":
        photo, marks = np.ascontiguousarray(astronaut[CLOSE]), CLOSE_MARKS
    else:
        more = (np.ascontiguousarray(astronaut[:, ::-1]),)
    made = PhotoRelighter(photo, marks, relighter, more=more)
    assert gap(made.render(made.light, fill=0), photo) <= (257 if photo.dtype == np.uint16 else 1)


def test_strength(session: PhotoRelighter, astronaut: np.ndarray) -> None:
    """0 is the photo to the bit, 1 the picture, a half lies between them, and the order is kept."""
    whole = session.render(60, 10).astype(int)
    assert np.array_equal(session.render(60, 10, strength=0), astronaut)
    assert np.array_equal(session.render(60, 10, strength=1), whole)
    some, much = (session.render(60, 10, strength=share).astype(int) for share in (0.5, 0.8))
    before = astronaut.astype(int)
    low, high = np.minimum(before, whole), np.maximum(before, whole)
    for mixed in (some, much):
        assert (mixed >= low - 1).all()
        assert (mixed <= high + 1).all()
    assert np.abs(some - before).mean() < 0.9 * np.abs(much - before).mean() < 0.9 * np.abs(whole - before).mean()
    assert np.abs(some - before).mean() > 0.2 * np.abs(whole - before).mean()


def test_same_input_same_bytes(session: PhotoRelighter, astronaut: np.ndarray, relighter: StatisticalRelighter) -> None:
    """Again, from a new session after other lights, and with the photo left alone."""
    before = astronaut.copy()
    first = session.render([Lamp(40, 20), Lamp(-60, 0, 30)], fill=0.2)
    session.render(-70, 0)
    assert np.array_equal(session.render([Lamp(40, 20), Lamp(-60, 0, 30)], fill=0.2), first)
    other = PhotoRelighter(astronaut, MARKS, relighter).render([Lamp(40, 20), Lamp(-60, 0, 30)], fill=0.2)
    assert np.array_equal(other, first)
    assert np.array_equal(before, astronaut)


def test_threads_do_not_matter(half: np.ndarray, relighter: StatisticalRelighter) -> None:
    threads = torch.get_num_threads()
    try:
        pictures = []
        for count in (1, 2):
            torch.set_num_threads(count)
            pictures.append(PhotoRelighter(half, HALF, relighter).render(50, 10))
    finally:
        torch.set_num_threads(threads)
    assert gap(*pictures) <= 1


def test_background_stays_byte_for_byte(session: PhotoRelighter, astronaut: np.ndarray) -> None:
    background = session.matte == 0
    assert background.mean() > 0.3
    for lights in (Lamp(60, 0), Lamp(-40, 30, 40, colour=(1, 0.5, 0.2)), Lamp(180)):
        relit = session.render(lights)
        assert np.array_equal(relit[background], astronaut[background])
        assert (relit != astronaut).any(-1)[(session.matte > 0.9) & (astronaut.max(-1) > 40)].mean() > 0.9


def test_matte_is_the_photos_size(session: PhotoRelighter) -> None:
    matte = session.matte
    assert matte.shape == session.photo.shape[:2]
    assert matte.dtype == np.float32
    assert matte.min() == 0
    assert matte.max() <= 1
    assert matte[SKIN].min() > 0.99
    assert matte[:100, :100].max() == 0  # the flag
    assert 0.05 < matte[500:, 150:250].mean() < 0.6  # the light fades out over the body


# -- what changes


@pytest.mark.parametrize("azimuth", [60, -60])
def test_lamp_lights_its_own_side(session: PhotoRelighter, azimuth: float) -> None:
    """+60 stands at image-left: the cheek, the hair and the shoulder there are bright, the others dark."""
    relit = grey(session.render(azimuth, 0))
    toward, away = (CHEEK_LEFT, CHEEK_RIGHT) if azimuth > 0 else (CHEEK_RIGHT, CHEEK_LEFT)
    assert relit[toward].mean() > 1.5 * relit[away].mean()
    other, person = grey(session.render(-azimuth, 0)), session.matte > 0.9
    change = np.sign(azimuth) * (relit - other)
    for part in (
        (slice(240, 330), slice(60, 150)),
        (slice(60, 120), slice(165, 185)),
    ):  # shoulder and hair at image-left
        assert change[part][person[part]].mean() > 15
    for part in ((slice(240, 330), slice(310, 400)), (slice(60, 120), slice(265, 285))):
        assert change[part][person[part]].mean() < -15


def test_elevation(session: PhotoRelighter) -> None:
    """From above the forehead is bright beside the chin's underside, from below the other way round."""
    above, below = (grey(session.render(0, elevation)) for elevation in (60, -60))
    forehead, neck = (slice(72, 82), slice(212, 236)), (slice(172, 182), slice(212, 236))
    assert above[forehead].mean() - below[forehead].mean() > 15
    assert above[neck].mean() - below[neck].mean() < -15


def test_two_lamps_are_two_sources(session: PhotoRelighter) -> None:
    """At +-45 both cheeks are as bright as in the photo, and no shadow of one lamp is left as dark as by it alone."""
    both = [Lamp(45, 0), Lamp(-45, 0)]
    relit = grey(session.render(both, fill=0))
    left, right = relit[CHEEK_LEFT].mean(), relit[CHEEK_RIGHT].mean()
    assert 0.8 < left / right < 1.25
    alone = [grey(session.render(lamp, fill=0)) for lamp in both]
    assert right > 2 * alone[0][CHEEK_RIGHT].mean()
    assert left > 1.2 * alone[1][CHEEK_LEFT].mean()
    ratio = session._ratio
    face, bust = ratio._maps(scene_light(both))
    for k, total in ((0, face), (1, bust)):
        apart = sum(ratio._maps(scene_light([lamp]))[k] for lamp in both)
        assert np.abs(total - apart).max() < 1e-4 * total.max()


def test_coloured_lamps_tint(session: PhotoRelighter) -> None:
    white = session.render(Lamp(30, 10))[SKIN].reshape(-1, 3).mean(0)
    red = session.render(Lamp(30, 10, colour=(1, 0.4, 0.3)))[SKIN].reshape(-1, 3).mean(0)
    blue = session.render(Lamp(30, 10, colour=(0.4, 0.6, 1)))[SKIN].reshape(-1, 3).mean(0)
    assert red[0] / red[2] > 1.2 * white[0] / white[2]
    assert blue[0] / blue[2] < 0.85 * white[0] / white[2]
    two = session.render([Lamp(60, 0, colour=(1, 0.3, 0.3)), Lamp(-60, 0, colour=(0.3, 0.4, 1))], fill=0)
    tint = two[..., 0].astype(float) / two[..., 2].clip(1)
    assert tint[CHEEK_LEFT].mean() > 1.3 * tint[CHEEK_RIGHT].mean()


def test_power(session: PhotoRelighter) -> None:
    """No light is dark; beyond what exposure evens out, more is brighter; a fill alone does not care for lamps."""
    means = [session.render(Lamp(30, 10, power=power), fill=0)[SKIN].mean() for power in (0, 0.2, 1, 4)]
    assert means[0] < 0.4 * means[1]
    assert means[1] < means[2] + 1
    assert means[2] < means[3]
    only = [session.render(Lamp(30, 10, power=power), fill=1) for power in (0, 5)]
    assert np.array_equal(*only)
    assert gap(only[0], session.render(fill_light(1.0), fill=0)) <= 1
    # power before exposure: log 2 more light is log 2 more, where the ratio is not at its limits
    ratio = session._ratio
    one, two = (ratio(scene_light([Lamp(20, 0, 30, power)]))[..., 0] for power in (0.5, 1.0))
    lit = (ratio.trust > 0.7) & (one > -1) & (two < 1.2)
    assert np.abs((two - one)[lit] - np.log(2)).max() < 0.15
    assert (two - one)[lit].mean() == pytest.approx(np.log(2), abs=0.08)


def test_larger_lamps_are_softer(session: PhotoRelighter) -> None:
    """The steepest changes on the face flatten from a bare bulb to a window."""
    ratio = session._ratio
    slopes = []
    for size in (1, 15, 40, 80):
        log_ratio = ratio(scene_light([Lamp(60, 20, size)]))[..., 0]
        slopes.append(np.quantile(np.hypot(*np.gradient(log_ratio))[ratio.trust > 0.5], 0.99))
    assert slopes[0] > slopes[1] > slopes[2] > slopes[3]
    assert slopes[0] > 3 * slopes[2]


def test_fill_lifts_shadows(session: PhotoRelighter) -> None:
    deep, soft = (grey(session.render(70, 0, fill=fill)) for fill in (0.02, 0.4))
    contrast = [one[CHEEK_LEFT].mean() / one[CHEEK_RIGHT].mean() for one in (deep, soft)]
    assert contrast[0] > 1.5 * contrast[1] > 1.5


def test_lit_side_keeps_its_brightness(session: PhotoRelighter, astronaut: np.ndarray) -> None:
    """A new lamp is exposed for: the brighter skin is neither burnt nor dull."""
    before = np.quantile(grey(astronaut)[SKIN], 0.85)
    for azimuth in (0, 40, -70):
        relit = grey(session.render(azimuth, 10))[SKIN]
        assert np.quantile(relit, 0.85) == pytest.approx(before, rel=0.2)


# -- only what a scene calls for


def random_scene(generator: np.random.Generator) -> tuple[list[Lamp], float]:
    """One to three lamps anywhere in front, of any size, some at the camera; a fill."""
    lamps = []
    for _ in range(int(generator.integers(1, 4))):
        power, colour = float(generator.uniform(0.2, 1.5)), (1.0, 1.0, 1.0)
        if generator.random() < 0.3:
            colour = tuple(generator.uniform(0.3, 1, 3).tolist())
        if generator.random() < 0.25:
            lamps.append(Lamp(0, 0, float(generator.choice((0, 1, 30, 60))), power, colour))
        else:
            turn, rise = (float(v) for v in generator.uniform((20, -40), (150, 60)))
            lamps.append(
                Lamp(turn * float(generator.choice((-1, 1))), rise, float(generator.uniform(0, 60)), power, colour)
            )
    return lamps, float(generator.choice((0.0, 0.1, 0.3)))


@pytest.mark.parametrize("seed", range(14))
def test_auto_is_all(session: PhotoRelighter, exhaustive: PhotoRelighter, seed: int) -> None:
    lamps, fill = random_scene(np.random.default_rng(seed))
    assert gap(session.render(lamps, fill=fill), exhaustive.render(lamps, fill=fill)) <= 1


@pytest.mark.parametrize("kind", ["close", "two photos"])
def test_auto_is_all_for_other_photos(
    kind: str, astronaut: np.ndarray, half: np.ndarray, relighter: StatisticalRelighter
) -> None:
    if kind == "close":
        photo, marks, more = np.ascontiguousarray(astronaut[CLOSE]), CLOSE_MARKS, ()
    else:
        photo, marks, more = half, HALF, (np.ascontiguousarray(astronaut[:, ::-1]),)
    auto, every = (PhotoRelighter(photo, marks, relighter, more=more, stages=s) for s in ("auto", "all"))
    for seed in range(20, 23):
        lamps, fill = random_scene(np.random.default_rng(seed))
        assert gap(auto.render(lamps, fill=fill), every.render(lamps, fill=fill)) <= 1


def test_stages_say_what_ran(astronaut: np.ndarray, relighter: StatisticalRelighter) -> None:
    made = PhotoRelighter(astronaut, MARKS, relighter)
    assert [stage.name for stage in made.stages] == ["face", "model"]
    made.render(Lamp(0, 0, 1), fill=0)
    names = [stage.name for stage in made.stages]
    assert {"matte", "bust", "source", "skin", "light", "pixels"} <= set(names)
    assert [stage.ran for stage in made.stages if stage.name == "shadows"] == [False]  # the camera sees none of them
    assert all(stage.reason for stage in made.stages)
    assert all(stage.seconds >= 0 for stage in made.stages)
    known = len(made.stages) - 3
    made.render(Lamp(50, 0, 5), fill=0)
    assert [stage.name for stage in made.stages[known:]] == ["light", "pixels"]  # shadows are part of the light
    made.render(Lamp(50, 0, 5), fill=0)
    assert [(stage.name, stage.ran) for stage in made.stages[known:]] == [
        ("light", True),
        ("shadows", False),
        ("pixels", True),
    ]
    assert made.stages is not made.stages


def test_face_that_fills_the_picture_needs_no_matte(astronaut: np.ndarray, relighter: StatisticalRelighter) -> None:
    close = np.ascontiguousarray(astronaut[CLOSE])
    for stages, ran in (("auto", False), ("all", True)):
        made = PhotoRelighter(close, CLOSE_MARKS, relighter, stages=stages)
        relit = made.render(60, 0)
        assert [stage.ran for stage in made.stages if stage.name == "matte"] == [ran]
        assert relit.shape == close.shape
    with pytest.raises(ValueError, match="stages: expected 'auto' or 'all'"):
        PhotoRelighter(close, CLOSE_MARKS, relighter, stages="some")


# -- kinds of pictures


@pytest.mark.parametrize("kind", ["grey", "rgba uint8", "rgba uint16", "float64"])
def test_arrays_come_back_in_kind(
    kind: str, half: np.ndarray, relit_half: np.ndarray, relighter: StatisticalRelighter
) -> None:
    alpha = np.random.default_rng(0).integers(0, 256, (256, 256, 1), dtype=np.uint8)
    photo = {
        "grey": half[..., 1],
        "rgba uint8": np.concatenate((half, alpha), 2).repeat(2, 0)[::2],
        "rgba uint16": np.concatenate((half, alpha), 2).astype(np.uint16) * 257,
        "float64": half / 255,
    }[kind]
    relit = relight(photo, 50, 10, HALF, relighter)
    assert relit.dtype == photo.dtype
    assert relit.shape == photo.shape
    scale = {"u": float(np.iinfo(photo.dtype).max) if photo.dtype.kind == "u" else 1, "f": 1}[photo.dtype.kind]
    if "rgba" in kind:
        assert np.array_equal(relit[..., 3], photo[..., 3])
        relit = relit[..., :3]
    if "grey" not in kind:
        assert np.abs(relit / scale - relit_half / 255).max() < 0.006
    assert (
        np.abs(relit / scale - photo.reshape(*photo.shape[:2], -1)[..., :3].reshape(relit.shape) / scale).mean() > 0.01
    )


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "I;16"])
def test_pillow_images_come_back_in_kind(
    mode: str, half: np.ndarray, relit_half: np.ndarray, relighter: StatisticalRelighter
) -> None:
    if mode == "I;16":
        image = Image.fromarray(half[..., 1].astype(np.uint16) * 257)
    else:
        image = Image.fromarray(half).convert(mode)
    if mode in ("LA", "RGBA"):
        image.putalpha(Image.fromarray(np.random.default_rng(0).integers(0, 256, (256, 256), dtype=np.uint8)))
    relit = relight(image, 50, 10, HALF, relighter)
    assert relit.mode == image.mode == mode
    assert relit.size == image.size
    if mode in ("LA", "RGBA"):
        assert np.array_equal(np.asarray(relit)[..., -1], np.asarray(image)[..., -1])
    if mode == "RGB":
        assert np.array_equal(np.asarray(relit), relit_half)
    assert not np.array_equal(np.asarray(relit), np.asarray(image))


def test_numbers_and_lamps_mean_the_same(session: PhotoRelighter) -> None:
    plain = session.render(35, -10, size=12)
    for same in (Lamp(35, -10, 12), [Lamp(35, -10, 12)], Lamp(35, -10, 12).light()):
        assert np.array_equal(session.render(same), plain)
    with pytest.raises(ValueError, match="elevation: expected with an azimuth"):
        session.render(Lamp(35), 10)


# -- hard cases


def blue_face(photo: np.ndarray) -> np.ndarray:
    return photo // np.array((8, 3, 1), np.uint8)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(np.zeros_like, id="black"),
        pytest.param(lambda photo: np.full_like(photo, 255), id="white"),
        pytest.param(lambda photo: np.zeros_like(photo) + np.array((200, 150, 120), np.uint8), id="flat skin"),
        pytest.param(blue_face, id="blue"),
        pytest.param(lambda photo: np.random.default_rng(0).integers(0, 256, photo.shape, dtype=np.uint8), id="noise"),
    ],
)
def test_any_photograph(make, half: np.ndarray, relighter: StatisticalRelighter) -> None:
    """Whatever it shows the picture comes out whole, and its background as it was."""
    photo = make(half)
    made = PhotoRelighter(photo.astype(np.float32) / 255, HALF, relighter)
    for lights in (Lamp(50, 10), Lamp(-60, 0, 30, colour=(1, 0.5, 0.3))):
        relit = made.render(lights)
        assert np.isfinite(relit).all()
        assert relit.min() >= 0
        assert relit.max() <= 1
        assert np.array_equal(relit[made.matte == 0], made.photo[made.matte == 0])
    assert np.isfinite(made.std(30, 0)).all()
    assert all(np.isfinite(angle) for angle in made.source_angles)
    if photo.max() == 0:
        assert relit.max() == 0
        assert made.source_angles == (0.0, 0.0)


@pytest.mark.parametrize(
    "lamps",
    [
        [Lamp(power=0)],
        [Lamp(30, power=1e6)],
        [Lamp(30, size=0)],
        [Lamp(30, size=90)],
        [Lamp(180)],
        [Lamp(-180, size=90)],
        [Lamp(0, 90)],
        [Lamp(0, -90)],
        [Lamp(135, 20)],
        [Lamp(10 * k, 5, 1, 0.2) for k in range(4)],
    ],
    ids=lambda lamps: str(lamps[0])[:48],
)
def test_any_light(session: PhotoRelighter, astronaut: np.ndarray, lamps: list[Lamp]) -> None:
    """Light from behind or of no power leaves a dark face, never a broken one."""
    relit = session.render(lamps, fill=0)
    assert relit.dtype == np.uint8
    assert np.array_equal(relit[session.matte == 0], astronaut[session.matte == 0])
    if lamps in ([Lamp(power=0)], [Lamp(180)]):
        assert relit[SKIN].mean() < 0.75 * astronaut[SKIN].mean()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"azimuth": np.nan}, "azimuth: expected degrees"),
        ({"azimuth": np.inf}, "azimuth: expected degrees"),
        ({"azimuth": 181.0}, "azimuth: expected degrees"),
        ({"elevation": np.nan}, "elevation: expected degrees"),
        ({"elevation": -91.0}, "elevation: expected degrees"),
        ({"size": 91.0}, "size: expected an angular radius"),
        ({"size": -1.0}, "size: expected an angular radius"),
        ({"fill": -0.1}, "fill: expected a share"),
        ({"fill": 1.1}, "fill: expected a share"),
        ({"fill": np.nan}, "fill: expected a share"),
        ({"strength": -0.1}, "strength: expected a share"),
        ({"strength": 1.5}, "strength: expected a share"),
        ({"strength": np.nan}, "strength: expected a share"),
        ({"lights": []}, "lights: expected at least one Lamp"),
    ],
)
def test_bad_lights_are_refused_before_the_work(arguments: dict, words: str, half: np.ndarray) -> None:
    """No face is looked for and no statistics are read first."""
    with pytest.raises(ValueError, match=words):
        relight(np.zeros((4, 4)), **arguments)


def test_bad_lights_are_refused_by_a_session(session: PhotoRelighter) -> None:
    for arguments, words in (
        ({"lights": np.nan}, "azimuth: expected"),
        ({"lights": []}, "lights: expected at least one"),
        ({"fill": 2}, "fill: expected"),
        ({"strength": 2}, "strength: expected"),
        ({"size": -1}, "size: expected"),
    ):
        with pytest.raises(ValueError, match=words):
            session.render(**arguments)


@pytest.mark.parametrize(
    ("marks", "words"),
    [
        (((124, 50), (100, 50), (110, 72)), "are the eyes swapped"),
        (((100, 72), (124, 72), (110, 50)), "mouth below them"),
        (((100, 50), (110, 50), (120, 50)), "collinear"),
        (((100, 50), (300, 50), (110, 70)), "inside the 256 x 256 photo"),
        (((-1, 50), (110, 50), (110, 70)), "inside the 256 x 256 photo"),
        (((100, 50), (100, 50), (110, 70)), "two different eyes"),
        (((100, 50), (124, 50), (112, 250)), "mouth in its place"),
        (((100, 50), (np.nan, 50), (110, 70)), "finite"),
        (((1, 2), (3, 4)), "three"),
    ],
)
def test_bad_landmarks_are_refused(marks, words: str, half: np.ndarray, relighter: StatisticalRelighter) -> None:
    with pytest.raises(ValueError, match=words):
        relight(half, landmarks=marks, relighter=relighter)


@pytest.mark.parametrize(
    "photo",
    [
        np.zeros((7, 9, 3), np.uint8),
        np.zeros((64, 64, 5), np.uint8),
        np.zeros((64, 64, 3), np.int32),
        np.zeros((64, 64, 3), bool),
        np.full((64, 64, 3), np.nan),
        np.full((64, 64, 3), 1.5),
        np.full((64, 64, 3), -0.1),
        np.zeros(64),
    ],
    ids=lambda photo: f"{photo.shape} {photo.dtype} {photo.flat[0]}",
)
def test_bad_photos_are_refused(photo: np.ndarray, relighter: StatisticalRelighter) -> None:
    with pytest.raises(ValueError, match="photo: expected"):
        relight(photo, landmarks=((24, 28), (40, 28), (32, 46)), relighter=relighter)


@pytest.mark.parametrize(
    ("name", "marks"),
    [
        ("smallest photo", ((2, 3), (5, 3), (3.5, 6))),
        ("border", HALF - (90, 30)),
        ("two pixels between the eyes", ((100, 50), (102, 50), (101, 52))),
        ("larger than the photo", ((-0.5, -0.5), (255, -0.5), (128, 255))),
        ("upside down", 255 - HALF),
    ],
)
def test_faces_of_any_size_and_place(name: str, marks, half: np.ndarray, relighter: StatisticalRelighter) -> None:
    photo = {
        "smallest photo": half[::32, ::32],
        "border": half[30:, 90:],
        "upside down": half[::-1, ::-1],
    }.get(name, half)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # turned, or cut by the border
        relit = relight(photo, 40, 10, marks, relighter)
    assert relit.shape == photo.shape
    assert (relit != photo).any()
    if name == "upside down":  # lit from its own other side, in the picture's own terms too
        left, right = grey(relit)[125:141, 132:137].mean(), grey(relit)[125:141, 151:157].mean()
        assert left > 0
        assert right > 0


def test_one_pixel_of_skin(relighter: StatisticalRelighter) -> None:
    """Finite, or said what is wrong."""
    photo = np.zeros((64, 64, 3), np.uint8)
    photo[30, 32] = (200, 150, 120)
    try:
        relit = relight(photo, 30, 0, ((24, 28), (40, 28), (32, 46)), relighter)
    except (ValueError, RuntimeError):
        return
    assert relit.shape == photo.shape


def test_transparent_everywhere(half: np.ndarray, relit_half: np.ndarray, relighter: StatisticalRelighter) -> None:
    photo = np.dstack((half, np.zeros((256, 256), np.uint8)))
    relit = relight(photo, 50, 10, HALF, relighter)
    assert not relit[..., 3].any()
    assert np.array_equal(relit[..., :3], relit_half)


def test_empty_matte_changes_nothing(
    half: np.ndarray, relighter: StatisticalRelighter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(person_module, "person_matte", lambda image, window: np.zeros(window.size, np.float32))
    made = PhotoRelighter(half, HALF, relighter)
    assert np.array_equal(made.render(60, 0), half)
    assert made.matte.max() == 0


def test_missing_network_is_no_obstacle(
    half: np.ndarray, relighter: StatisticalRelighter, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> None:
        raise RuntimeError(f"{name}: expected a network of the package, got none")

    matte_module._network.cache_clear()
    monkeypatch.setattr(matte_module, "network_path", missing)
    try:
        made = PhotoRelighter(half, HALF, relighter)
        relit = grey(made.render(60, 0))
    finally:
        matte_module._network.cache_clear()
    assert made.matte[52:68, 100:122].min() > 0.9
    assert relit[57:65, 99:104].mean() > 1.3 * relit[57:65, 118:123].mean()


def test_no_face_is_said(relighter: StatisticalRelighter) -> None:
    with pytest.raises(RuntimeError, match="landmarks: found no face"):
        relight(np.full((64, 64, 3), 90, np.uint8), relighter=relighter)


def test_warnings(astronaut: np.ndarray, relighter: StatisticalRelighter) -> None:
    assert PhotoRelighter(astronaut, MARKS, relighter).warnings == []
    cut = PhotoRelighter(np.ascontiguousarray(astronaut[:, 215:]), MARKS - (215, 0) + (14, 0), relighter)
    assert any("border cuts it" in said for said in cut.warnings)


# -- what the model knows


def test_dark_and_fair_faces_have_the_same_light(session: PhotoRelighter, relighter: StatisticalRelighter) -> None:
    """Reflectance scales a photograph: light and strength stay, exposure scales."""
    crop = session.window.onto_crop(session.person.scene).transpose(2, 0, 1)
    crop = torch.from_numpy(np.ascontiguousarray(crop))
    fair, dark = FaceModel(relighter, [crop]), FaceModel(relighter, [0.3 * crop])
    assert float(fair.source_light @ dark.source_light) > 0.999
    assert dark.exposure == pytest.approx(0.3 * fair.exposure, rel=0.02)
    assert float(dark.light.weights.sum()) == pytest.approx(float(fair.light.weights.sum()), rel=0.02)
    features = session.window.onto_crop(session.person.features.not_skin)
    assert np.abs(fair.trust(features) - dark.trust(features)).mean() < 0.02


def test_trust(session: PhotoRelighter) -> None:
    """On skin, not on eyes and mouth, nowhere outside the face."""
    crop = session.model.trust(session.window.onto_crop(session.person.features.not_skin))
    on_photo = session.window.from_crop(crop, outside=0.0)
    x, y = session.window.places()
    assert on_photo[(np.hypot(x + 0.55, y + 0.6) < 0.12)].mean() > 0.6
    assert on_photo[np.hypot(x, (y + 0.42) / 1.42) > 1.35].max() < 0.05
    for side in (-0.5, 0.5):
        assert on_photo[np.hypot(x - side, y) < 0.08].mean() < 0.3
    nothing = session.model.trust(np.ones_like(crop))
    assert nothing.max() < 1e-6


def test_std_is_of_the_face_alone(session: PhotoRelighter) -> None:
    spread = session.std(30, 10)
    assert spread.shape == session.photo.shape[:2]
    assert spread[SKIN].mean() > 0
    assert spread[:40].max() == 0
    assert spread[:, :150].max() == 0


def test_kinds_without_a_render(half: np.ndarray) -> None:
    """What an array becomes, and what comes back of it, for the kinds that no other test renders."""
    for photo in (half[..., 1:2], half[..., 1], (half / 255).astype(np.float16), half.astype(np.uint16)[..., :1] * 257):
        rgb = as_rgb(photo)
        assert rgb.shape == (256, 256, 3)
        assert rgb.dtype == (np.float32 if photo.dtype.kind == "f" else photo.dtype)
        back = like(photo, rgb)
        assert back.shape == photo.shape
        assert back.dtype == photo.dtype
        assert np.array_equal(back, photo)


def test_python_says_what_the_command_line_says(astronaut: np.ndarray, relighter: StatisticalRelighter) -> None:
    with pytest.warns(UserWarning, match="azimuth 120: the lamp stands behind the face"):
        relight(astronaut, 120, 0, MARKS, relighter)
    two = np.concatenate((astronaut[:, :350], astronaut[:, :350]), 1)
    with pytest.warns(UserWarning, match="face: the largest whole one of 2"):
        relight(two, 20, 0, relighter=relighter)
    with pytest.raises(ValueError, match="lights: expected them or azimuth"):
        relight(astronaut, 60, 0, MARKS, relighter, lights=[Lamp(-60, 0)])
    with pytest.raises(ValueError, match=r"PIL.Image.open"):
        relight("me.jpg", relighter=relighter)  # type: ignore[type-var]
