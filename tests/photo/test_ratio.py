"""The ratio of new light to old, on a ball of which everything is known; the model's trust, on a photograph."""

import numpy as np
import pytest
import torch

from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.sources import Lamp, LightMixture, fill_light, scene_light
from facerelight.photo.bust.frame import BUST, FINE, crop_to_bust
from facerelight.photo.bust.shading import BustShading
from facerelight.photo.bust.surface import BELOW, Bust
from facerelight.photo.ratio import BRIGHTEST, BUST_BRIGHTEST, DARKEST, LEAK, FaceEvidence, LightRatio

CROP = CropFrame(48, 42, 0.25)
CENTRE, RADIUS = (0.0, -0.4), 2.3
SOURCE = scene_light([Lamp(-25, 20, 30)])


def ball(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height and normal; the person is all of the picture."""
    across, up = (x - CENTRE[0]) / RADIUS, (y - CENTRE[1]) / RADIUS
    z = np.sqrt(np.clip(1 - across**2 - up**2, 0, None))
    normal = np.stack((across, up, z), -1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1)
    return np.where(z > 0, RADIUS * z, BELOW / 4).astype(np.float32), normal.astype(np.float32)


def crop_places() -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.indices((CROP.height, CROP.width))
    matrix = crop_to_bust(CROP)
    return matrix[0, 0] * columns + matrix[0, 2], matrix[1, 1] * rows + matrix[1, 2]


def lambert(normal: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return np.clip(np.tensordot(directions, normal, (1, 2)), 0, None).astype(np.float32)


def evidence(tone: float = 1.0, new: float = 1.0, trust: float | np.ndarray = 1.0) -> FaceEvidence:
    """A ball of some reflectance under SOURCE; from other directions the model expects ``new`` times as much."""
    normal = ball(*crop_places())[1]
    own = SOURCE.directions.numpy()

    def radiance(directions: np.ndarray) -> np.ndarray:
        same = np.array([np.abs(own - one).sum(1).min() < 1e-6 for one in directions])
        return tone * lambert(normal, directions) * np.where(same, 1, new)[:, None, None].astype(np.float32)

    luminance = np.tensordot(SOURCE.weights[:, 0].numpy(), radiance(own), 1)
    mask = (CROP.oval().numpy() < 0.9).astype(np.float32)
    return FaceEvidence(luminance, mask, (mask * trust).astype(np.float32), radiance)


@pytest.fixture(scope="module")
def shading() -> BustShading:
    height, normal = ball(*BUST.places())
    fine, fine_normal = ball(*FINE.places())
    ones = np.ones(BUST.size, np.float32)
    return BustShading(Bust(normal, height, ones, fine, fine_normal))


@pytest.fixture(scope="module")
def ratio(shading: BustShading) -> LightRatio:
    return LightRatio(evidence(), CROP, shading, SOURCE)


def inner(limit: float = 0.75) -> np.ndarray:
    x, y = FINE.places()
    return np.hypot(x, (y + 0.42) / 1.42) < limit


def test_own_light_changes_nothing(ratio: LightRatio) -> None:
    found = ratio(SOURCE)
    assert found.shape == (*FINE.size, 1)
    assert np.abs(found).max() < 1e-5


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (40, 10), (-50, 20), (0, 50)])
def test_soft_lamps_on_a_ball(ratio: LightRatio, azimuth: float, elevation: float) -> None:
    """Model and bust agree there, and so the log ratio is Lambert's own, within 0.12 and 0.04 in the mean."""
    light = scene_light([Lamp(azimuth, elevation, 30)])
    normal = ball(*FINE.places())[1]
    new, old = (
        np.tensordot(one.weights[:, 0].numpy(), lambert(normal, one.directions.numpy()), 1) for one in (light, SOURCE)
    )
    wanted = np.log((new + ratio.dark) / (old + ratio.dark))
    gap = np.abs(ratio(light)[..., 0] - wanted)[inner() & (new > 0.15) & (old > 0.15)]
    assert gap.max() < 0.12
    assert gap.mean() < 0.04


def test_twice_the_power_is_twice_the_light(ratio: LightRatio) -> None:
    """log 2 more inside the face, where it is lit and no limit is reached; nowhere less."""
    light = scene_light([Lamp(40, 0, 30, 0.5)])
    one, two = ratio(light)[..., 0], ratio(light._replace(weights=2 * light.weights))[..., 0]
    lit = inner() & (one > -1) & (two < BRIGHTEST - 0.1)
    assert lit.sum() > 1000
    assert np.abs((two - one)[lit] - np.log(2)).max() < 0.06
    assert (two - one).min() > -1e-4


def test_light_adds_up(ratio: LightRatio) -> None:
    """Radiance and irradiance under several sources are the sums of theirs under each; for edges, too."""
    parts = [Lamp(40, 10, 5), Lamp(-50, 0, 1, 0.7), Lamp(0, 40, 15), fill_light(0.3)]
    together = ratio._maps(scene_light(parts))
    apart = [ratio._maps(scene_light([part])) for part in parts]
    for k in range(2):
        assert np.abs(together[k] - sum(one[k] for one in apart)).max() < 2e-5
    again = ratio._maps(scene_light(parts))  # the fill is remembered now
    assert all(np.array_equal(a, b) for a, b in zip(together, again, strict=True))


def test_fill_is_worked_out_once(shading: BustShading) -> None:
    """But not mistaken for another one: strength scales, other directions are new."""
    calls = []
    face = evidence()

    def counted(directions: np.ndarray) -> np.ndarray:
        calls.append(len(directions))
        return face.radiance(directions)

    ratio = LightRatio(face._replace(radiance=counted), CROP, shading, SOURCE)
    weak, first = ratio._maps(fill_light(0.2)), len(calls)
    strong = ratio._maps(fill_light(0.4))
    assert len(calls) == first
    for a, b in zip(weak, strong, strict=True):
        assert np.allclose(2 * a, b, rtol=1e-4, atol=1e-6)
    half = fill_light(0.2)
    half = half._replace(weights=half.weights * (half.directions[:, :1] < 0))
    assert np.abs(ratio._maps(half)[0] - weak[0]).max() > 0.02
    assert len(calls) == first + 1


def test_colours_are_channels_of_their_own(ratio: LightRatio) -> None:
    """Each as under white light of its strength."""
    light = scene_light([Lamp(35, 10, 5, colour=(1.0, 0.6, 0.3)), Lamp(-40, 0, 30, colour=(0.2, 0.5, 1.0))], 0.1)
    found = ratio(light)
    assert found.shape[-1] == 3
    for c in range(3):
        white = light._replace(weights=light.weights[:, c : c + 1].expand(-1, 3))
        assert np.abs(found[..., c] - ratio(white)[..., 0]).max() < 1e-3


def test_small_lamps_are_deepened(ratio: LightRatio) -> None:
    """Where most people are in shadow a lamp leaves less: ``q (1 + f) / (q + f)``; a soft light is left alone."""
    direction = np.array(((-0.8, 0.0, 0.6),), np.float32)
    weight = np.ones((1, 1), np.float32)
    plain, deep = (ratio._face_light(direction, weight, size)[..., 0] for size in (20.0, 5.0))
    front = ratio._face_light(np.array(((0, 0, 1.0),), np.float32), weight, 20.0)[..., 0]
    place = inner(0.6)
    share = plain[place] / front[place]
    wanted = plain[place] * share * (1 + LEAK) / (share + LEAK)
    assert np.abs(deep[place] / np.maximum(wanted, 0.02) - 1)[wanted > 0.05].mean() < 0.05
    assert (deep < plain + 1e-6)[place & (plain < front)].all()
    assert 0.15 < LEAK < 0.4


def test_bust_meets_the_face(shading: BustShading) -> None:
    """Where model and bust disagree by a factor, the bust goes to the model's side, without an edge between them."""
    ratio = LightRatio(evidence(new=1.5), CROP, shading, SOURCE)
    plain = LightRatio(evidence(), CROP, shading, SOURCE)
    light = scene_light([Lamp(20, 10, 30, 0.5)])
    gap = (ratio(light) - plain(light))[..., 0]
    x, y = FINE.places()
    oval = np.hypot(x, (y + 0.42) / 1.42)
    for low, high in ((0.0, 0.6), (0.75, 0.85), (0.95, 1.05), (1.1, 1.25)):
        assert gap[(oval > low) & (oval < high)].mean() == pytest.approx(np.log(1.5), abs=0.1)
    slope = np.hypot(*np.gradient(ratio(light)[..., 0])) * FINE.density  # log a unit
    assert slope[(oval > 0.7) & (oval < 1.2) & (oval > 0)].max() < 2


def test_bust_meets_the_face_on_either_side(shading: BustShading) -> None:
    """A factor that grows across the face pulls the bust beside it the same way, by a part of it."""
    across = np.exp(0.4 * crop_places()[0]).astype(np.float32)
    face = evidence()
    own = SOURCE.directions.numpy()

    def radiance(directions: np.ndarray) -> np.ndarray:
        same = np.array([np.abs(own - one).sum(1).min() < 1e-6 for one in directions])
        return face.radiance(directions) * np.where(same[:, None, None], 1, across)

    light = scene_light([Lamp(20, 10, 30)])
    tilted, plain = (LightRatio(one, CROP, shading, SOURCE)(light) for one in (face._replace(radiance=radiance), face))
    x, y = FINE.places()
    rim = (np.hypot(x, (y + 0.42) / 1.42) > 1.02) & (np.hypot(x, (y + 0.42) / 1.42) < 1.12) & (np.abs(y + 0.42) < 0.5)
    left, right = ((tilted - plain)[..., 0][rim & side].mean() for side in (x < 0, x > 0))
    assert 0.15 < right - left < 0.4 * 2


def test_what_is_unsure_follows_its_surroundings(shading: BustShading) -> None:
    """A patch where the model is far off and not trusted is no patch in the ratio."""
    x, y = crop_places()
    patch = np.hypot(x, y + 0.5) < 0.12
    trust = np.where(patch, 0.0, 1.0)
    face = evidence(trust=trust)

    def broken(directions: np.ndarray) -> np.ndarray:
        same = np.array([np.abs(SOURCE.directions.numpy() - one).sum(1).min() < 1e-6 for one in directions])
        return face.radiance(directions) * np.where(patch, np.where(same, 1, 0.1)[:, None, None], 1).astype(np.float32)

    light = scene_light([Lamp(0, 0, 30)])
    fx, fy = FINE.places()
    here = np.hypot(fx, fy + 0.5) < 0.07
    plain = LightRatio(evidence(), CROP, shading, SOURCE)(light)[..., 0]
    held = LightRatio(face._replace(radiance=broken), CROP, shading, SOURCE)(light)[..., 0]
    believed = LightRatio(evidence()._replace(radiance=broken), CROP, shading, SOURCE)(light)[..., 0]
    held_gap, believed_gap = (np.abs(one - plain)[here].mean() for one in (held, believed))
    assert believed_gap > 0.1
    assert held_gap < 0.5 * believed_gap


@pytest.mark.parametrize("tone", [0.5, 0.1, 0.03])
def test_dark_skin_has_the_ratios_of_fair_skin(ratio: LightRatio, shading: BustShading, tone: float) -> None:
    dark = LightRatio(evidence(tone), CROP, shading, SOURCE)
    for light in (scene_light([Lamp(50, 10, 5)], 0.1), scene_light([Lamp(-60, 0, 1)])):
        assert np.abs(dark(light) - ratio(light)).max() < 2e-3


def test_lamps_side(ratio: LightRatio) -> None:
    """A lamp at +60 stands at image-left, one above above."""
    x, y = FINE.places()
    near = np.abs(y + 0.4) < 0.4
    for azimuth, sign in ((60, 1), (-60, -1)):
        found = ratio(scene_light([Lamp(azimuth, 0, 5)]))[..., 0]
        assert sign * (found[near & (x < -0.6) & (x > -1)].mean() - found[near & (x > 0.6) & (x < 1)].mean()) > 0.5
        outside = np.abs(x) > 1.5
        left, right = near & outside & (x < 0) & (x > -2), near & outside & (x > 0) & (x < 2)
        assert sign * (found[left].mean() - found[right].mean()) > 0.5
    found = ratio(scene_light([Lamp(0, 60, 5)]))[..., 0]
    middle = np.abs(x) < 0.4
    assert found[middle & (y > 0.4) & (y < 1)].mean() > found[middle & (y < -1.4) & (y > -1.8)].mean() + 0.5


@pytest.mark.parametrize(
    "lamp",
    [Lamp(power=0), Lamp(power=1e6), Lamp(180), Lamp(0, 90), Lamp(0, -90), Lamp(100, 0, 0), Lamp(0, 0, 90)],
    ids=str,
)
def test_any_lamp_stays_within_limits(ratio: LightRatio, lamp: Lamp) -> None:
    found = ratio(scene_light([lamp]))
    assert np.isfinite(found).all()
    assert found.min() >= DARKEST - 1e-4
    assert found.max() <= BRIGHTEST + 1e-4
    assert found[ratio.weight == 0].max() <= BUST_BRIGHTEST + 1e-4


def test_sources_of_one_number_are_one(ratio: LightRatio) -> None:
    """Points of one lamp share a shadow; the same points as lamps of their own do not."""
    lamp = LightMixture(*(part[:3] for part in Lamp(60, 10, 5).light()))
    apart = lamp._replace(source=torch.arange(len(lamp.source)))
    marches = ratio.shading.marches
    ratio(lamp)
    once = ratio.shading.marches - marches
    assert isinstance(ratio(apart), np.ndarray)
    assert once <= 1
    assert ratio.shading.marches - marches - once >= 2


def test_what_the_own_light_leaves_unexplained_goes_with_it(shading: BustShading, ratio: LightRatio) -> None:
    """A patch that the photograph shows darker than its fitted light explains is lifted by as much under another
    light."""
    known, (x, y) = evidence(), crop_places()
    patch = np.hypot(x + 0.25, y + 0.5) < 0.3
    spotted = LightRatio(
        known._replace(luminance=np.where(patch, 0.7, 1).astype(np.float32) * known.luminance), CROP, shading, SOURCE
    )
    fx, fy = FINE.places()
    middle, elsewhere = np.hypot(fx + 0.25, fy + 0.5) < 0.1, inner(0.5) & (np.hypot(fx + 0.25, fy + 0.5) > 0.6)
    light = scene_light([Lamp(45, 10, 30)])
    lifted = (spotted(light) - ratio(light))[..., 0]
    assert lifted[middle].mean() == pytest.approx(-np.log(0.7), abs=0.06)
    assert np.abs(lifted[elsewhere]).max() < 0.03
    assert np.abs(spotted(SOURCE)[middle]).max() < 1e-4
