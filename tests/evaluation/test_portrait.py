"""Protocol portrait-A: its measures on pictures whose errors are known, its truth on a ball, the scan where at hand."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from skimage.color import deltaE_ciede2000, rgb2lab

from facerelight.evaluation import portrait, scan
from facerelight.evaluation.portrait import Case, PortraitTruth, Regions, edge_errors, film, fit_gain, portrait_errors
from facerelight.evaluation.scan import ScannedHead, decode_srgb, encode_srgb, lamp_points
from facerelight.geometry.sources import Lamp

SIZE = (120, 100)
UNIT = 30.0


def coded(linear: np.ndarray) -> np.ndarray:
    return (encode_srgb(linear) * 255).round().astype(np.uint8)


@pytest.fixture(scope="module")
def linear() -> tuple[np.ndarray, np.ndarray]:
    """Radiance of a photo, ``(H, W, 3)``, and how much a lamp from the left changes it, ``(H, W)``: a sharp edge."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    texture = 1 + 0.2 * np.sin(x / 5) * np.cos(y / 7)
    photo = texture[..., None] * np.array([0.45, 0.30, 0.22])
    return photo, np.where(x < 50, 1.2, 0.25)


@pytest.fixture(scope="module")
def regions() -> Regions:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    radius = np.hypot((x - 50) / 30, (y - 60) / 40)
    person, face = radius < 1.3, radius < 0.95
    return Regions(person, face, person & ~face, np.abs(radius - 1) < 0.18, radius > 1.5, UNIT)


@pytest.fixture(scope="module")
def case(linear: tuple[np.ndarray, np.ndarray], regions: Regions) -> Case:
    photo, ratio = linear
    truth = np.where(regions.background[..., None], photo, photo * ratio[..., None])
    edges = np.zeros(SIZE, bool)
    edges[:, 48:52] = True
    return Case(coded(photo), coded(truth), edges & regions.face)


def relit(linear: tuple[np.ndarray, np.ndarray], ratio: np.ndarray, regions: Regions) -> np.ndarray:
    photo = linear[0]
    return coded(np.where(regions.background[..., None], photo, photo * ratio.reshape(*SIZE, -1)))


def test_the_truth_has_no_error(case: Case, regions: Regions) -> None:
    errors = portrait_errors(case.truth, case, regions) | edge_errors(case.truth, case, regions)
    assert set(errors) == set(portrait.MEASURES)
    assert errors.pop("ssim") == pytest.approx(1, abs=1e-6)
    assert errors.pop("edge99") == pytest.approx(1, abs=1e-4)
    assert errors == pytest.approx(dict.fromkeys(errors, 0), abs=1e-4)


def test_exposure_does_not_count(case: Case, regions: Regions) -> None:
    darker = coded(0.6 * decode_srgb(case.truth / 255))
    errors = portrait_errors(darker, case, regions) | edge_errors(darker, case, regions)
    assert errors["person"] < 0.6  # rounding to 8 bits
    assert abs(errors["shade_log"]) < 0.02
    assert errors["edge99"] == pytest.approx(1, abs=0.03)
    assert errors["background"] > 5  # but nothing may change around the person
    np.testing.assert_allclose(fit_gain(darker, case.truth, regions.person), case.truth / 255, atol=0.01)


def test_background_is_exactly_zero_where_nothing_changes(case: Case, regions: Regions) -> None:
    output = case.truth.copy()
    output[regions.person] //= 2
    assert portrait_errors(output, case, regions)["background"] == 0
    output[0, 0] += 9
    assert portrait_errors(output, case, regions)["background"] > 0


def test_colour_error_is_ciede2000(case: Case, regions: Regions) -> None:
    pair = np.array([[50.0, 2.6772, -79.7751]]), np.array([[50.0, 0.0, -82.7485]])
    assert deltaE_ciede2000(*pair)[0] == pytest.approx(2.0425, abs=1e-4)  # Sharma, Wu and Dalal 2005, first pair
    errors = portrait_errors(case.photo, case, regions)
    fitted = fit_gain(case.photo, case.truth, regions.person)
    wanted = deltaE_ciede2000(rgb2lab(fitted), rgb2lab(case.truth / 255))
    for name in ("person", "face", "rest"):
        assert errors[name] == pytest.approx(wanted[getattr(regions, name)].mean(), rel=1e-5)


@pytest.mark.parametrize(("level", "sign"), [(0.40, 1), (0.15, -1)])
def test_shade_that_is_too_light_is_positive(level: float, sign: int, linear, case: Case, regions: Regions) -> None:
    x = np.mgrid[: SIZE[0], : SIZE[1]][1]
    output = relit(linear, np.where(x < 55, linear[1], np.where(linear[1] < 1, level, 1.2)), regions)
    error = portrait_errors(output, case, regions)["shade_log"]
    assert np.sign(error) == sign
    assert 0.2 < abs(error) < abs(np.log(level / 0.25)) + 0.01


def test_grey_shade_is_negative(linear, case: Case, regions: Regions) -> None:
    photo, ratio = linear
    grey = (photo @ np.array([0.2126, 0.7152, 0.0722]))[..., None].repeat(3, -1)
    light = np.where(ratio[..., None] < 1, 0.5 * photo + 0.5 * grey, photo) * ratio[..., None]
    errors = portrait_errors(coded(np.where(regions.background[..., None], photo, light)), case, regions)
    assert errors["shade_dC"] < -2
    assert errors["shade_C"] == pytest.approx(-errors["shade_dC"], rel=0.05)
    assert abs(errors["shade_log"]) < 0.02


def test_a_soft_edge_is_less_sharp_and_noise_does_not_serve(linear, case: Case, regions: Regions) -> None:
    ratio = linear[1].astype(np.float32)
    soft = edge_errors(relit(linear, cv2.GaussianBlur(ratio, (0, 0), 4), regions), case, regions)
    noise = 1 + 0.4 * np.random.default_rng(0).uniform(-1, 1, SIZE).astype(np.float32)
    noisy = edge_errors(relit(linear, cv2.GaussianBlur(ratio, (0, 0), 4) * noise, regions), case, regions)
    truth_with_noise = edge_errors(relit(linear, ratio * noise, regions), case, regions)
    assert soft["edge99"] < 0.5
    assert noisy["edge99"] > 1.2 * soft["edge99"]
    assert noisy["edge_log"] > 0.95 * soft["edge_log"] > 0.3
    assert truth_with_noise["edge_log"] > 0.15


def test_a_join_shows_in_the_seam(linear, case: Case, regions: Regions) -> None:
    broken = np.where(regions.face, linear[1], 0.6 * linear[1])
    errors = portrait_errors(relit(linear, broken, regions), case, regions)
    assert errors["seam"] > 0.5


def test_film() -> None:
    levels = film(np.linspace(0, 3, 200)[:, None].repeat(3, 1))
    assert levels[0].tolist() == [0, 0, 0]
    assert levels[-1].tolist() == [255, 255, 255]
    assert (np.diff(levels[:, 0].astype(int)) >= 0).all()


@pytest.mark.parametrize(("size", "count"), [(1.0, 1), (5.0, 7), (12.0, 13), (40.0, 24)])
def test_lamp_points(size: float, count: int) -> None:
    points = lamp_points(Lamp(60, 20, size))
    assert points.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-6)
    middle = lamp_points(Lamp(60, 20, 0))[0]
    angles = np.rad2deg(np.arccos((points @ middle).clip(-1, 1)))
    assert angles.max() <= size + 1e-3
    assert points[:, 0].mean() < 0 < points[:, 1].mean()  # image-left, above


# -- the ray-traced truth -------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grey ball in the place of the scanned head."""
    pytest.importorskip("embreex")
    import trimesh

    folder = tmp_path_factory.mktemp("ball")
    mesh = trimesh.creation.icosphere(4, 2.2)
    vertices = np.asarray(mesh.vertices) + np.array([0, 0.5, 0])
    np.savez(folder / "lps_head.npz", vertices=vertices, triangles=mesh.faces, uv=np.full((len(vertices), 2), 0.5))
    Image.fromarray(np.full((1024, 1024, 3), 128, np.uint8)).save(folder / "color.jpg")
    return folder


def test_a_ball_is_lit_from_where_the_lamp_stands(ball: Path, tmp_path: Path, monkeypatch) -> None:
    head = ScannedHead(ball, cache=tmp_path)
    skin = (head.hair < 0.01) & (head.shirt < 0.01)
    left = head.lamp(Lamp(60, 0, 1))
    x = head.place[:, 0]
    assert left.irradiance[skin & (x < -1)].mean() > 3 * left.irradiance[skin & (x > 1)].mean()
    expected = (head.normal @ lamp_points(Lamp(60, 0, 1))[0]).clip(0)
    lit = skin & (expected > 0.3)
    np.testing.assert_allclose(left.irradiance[lit, 2], expected[lit], atol=0.02)  # Lambert's law; no shadows on a ball
    albedo = head.albedo("fair")
    both = head.radiance(albedo, [Lamp(60, 0, 1), Lamp(0, 55, 1, power=0.5)], 0.1)
    parts = head.radiance(albedo, [Lamp(60, 0, 1)], 0) * 0.9 + head.radiance(albedo, [Lamp(0, 55, 1)], 0) * 0.45
    np.testing.assert_allclose(both, parts + 0.1 * head.picture(np.asarray(_dome(head, albedo))), atol=2e-6)
    monkeypatch.setattr(ScannedHead, "_trace", lambda *_: pytest.fail("traced again"))
    again = ScannedHead(ball, cache=tmp_path).lamp(Lamp(60, 0, 1))
    np.testing.assert_array_equal(again.irradiance, left.irradiance)
    np.testing.assert_array_equal(again.lit, left.lit)


def _dome(head: ScannedHead, albedo: np.ndarray) -> np.ndarray:
    dome = head.dome()
    return albedo * dome.irradiance + dome.highlight[:, None]


def test_a_case_on_the_ball(ball: Path, tmp_path: Path) -> None:
    truth = PortraitTruth(ScannedHead(ball, cache=tmp_path), "tan")
    case = truth.case("front", Lamp(60, 0, 1))
    np.testing.assert_allclose(truth.landmarks, scan.EYES_AND_MOUTH, atol=1e-6)
    assert case.photo.shape == case.truth.shape == (*truth.regions.person.shape, 3)
    assert (case.photo == case.truth)[truth.regions.background].all()
    assert not (truth.regions.face & truth.regions.rest).any()
    errors = portrait_errors(case.truth, case, truth.regions)
    assert errors["person"] == pytest.approx(0, abs=1e-4)
    turned = ScannedHead(ball, yaw=20, cache=tmp_path)
    assert turned.landmarks[2, 0] > scan.EYES_AND_MOUTH[2, 0] + 10  # to image-right


def test_errors_say_what_to_do(ball: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"expected the scan's .* got no lps_head.npz"):
        ScannedHead(tmp_path)
    with pytest.raises(ValueError, match="tone: expected one of fair, tan, deep, got 'blue'"):
        ScannedHead(ball, cache=tmp_path).albedo("blue")


def test_the_scan() -> None:
    folder = os.environ.get("FACERELIGHT_LPS", "")
    if not folder:
        pytest.skip("the scan is not at hand; set FACERELIGHT_LPS to the folder of lps_head.npz and color.jpg")
    head = ScannedHead(folder)
    truths = [PortraitTruth(head, tone) for tone in ("fair", "deep")]
    cases = portrait.run_portraits(truths, {"copy": lambda photo, landmarks: lambda lamps, fill: photo})
    means = portrait.mean_scores(cases["copy"])
    assert len(cases["copy"]) == 2 * 3 * (4 + 3)
    assert means["person"] == pytest.approx(10.825, abs=0.01)
    assert means["face"] == pytest.approx(13.205, abs=0.01)
    assert means["rest"] == pytest.approx(10.124, abs=0.01)
    assert means["ssim"] == pytest.approx(0.760, abs=0.001)
    assert means["seam"] == pytest.approx(2.633, abs=0.01)
    assert means["background"] == 0
