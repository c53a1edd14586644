"""A photograph taken apart: layers that give it back, normals that face the right way, a light that can be read again,
and the files of ``facerelight decompose``."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from test_session import MARKS

from facerelight.cli import main
from facerelight.geometry.environment import environment_light
from facerelight.geometry.lights import angular_distance, even_hemisphere, light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import PhotoRelighter
from facerelight.photo.colour import LUMA
from facerelight.photo.files.environment_map import read_environment
from facerelight.photo.layers.decomposition import Decomposition
from facerelight.photo.layers.face import take_apart
from facerelight.photo.layers.highlights import own_skin, without_highlights
from facerelight.photo.layers.lambert import LambertSphere
from facerelight.photo.layers.own_light import light_colours
from facerelight.photo.layers.pictures import DEGREES_WHITE, FILES, SHADING_WHITE

HALF = (MARKS + 0.5) / 2 - 0.5
FACE = slice(56, 68), slice(102, 122)
CHEEK_LEFT, CHEEK_RIGHT = (slice(57, 65), slice(99, 103)), (slice(57, 65), slice(119, 123))


def linear(coded: np.ndarray) -> np.ndarray:
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


@pytest.fixture(scope="module")
def half() -> np.ndarray:
    photo = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
    return cv2.resize(photo, (256, 256), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def session(half: np.ndarray, folder: Path) -> PhotoRelighter:
    return PhotoRelighter(half, HALF, StatisticalRelighter.from_pretrained(folder))


@pytest.fixture(scope="module")
def parts(session: PhotoRelighter) -> Decomposition:
    return session.decompose()


def test_layers_give_the_photograph_back(half: np.ndarray, parts: Decomposition) -> None:
    sure = parts.matte > 0.99
    again = parts.reflectance * parts.shading + parts.highlights
    assert sure[FACE].all()
    assert np.abs(again - linear(half / 255))[sure].max() < 1e-4  # a tenth of the least step of 8 bits
    assert (parts.reflectance >= 0).all()
    assert (parts.shading >= 0).all()
    assert (parts.highlights > -1e-6).all()


def test_beyond_the_person_there_is_nothing(parts: Decomposition) -> None:
    away = parts.matte == 0
    assert away[:40, :60].all()
    for layer in (parts.reflectance, parts.shading, parts.highlights, parts.normals):
        assert layer.shape == (256, 256, 3)
        assert not layer[away].any()
    for layer in (parts.normals_std, parts.reflectance_std):
        assert not layer[parts.face == 0].any()
        assert (layer[parts.face > 0.9] > 0).all()


def test_shading_is_one_on_average(parts: Decomposition) -> None:
    face = parts.face > 0.5
    assert abs(np.log((parts.shading @ LUMA)[face]).mean()) < 0.15


def test_light_from_a_side_is_in_the_shading(half: np.ndarray, session: PhotoRelighter, folder: Path) -> None:
    relighter = StatisticalRelighter.from_pretrained(folder)
    for azimuth in (60, -60):
        side = PhotoRelighter(session.render(azimuth, 10.0), HALF, relighter).decompose()
        left, right = ((side.shading @ LUMA)[cheek].mean() for cheek in (CHEEK_LEFT, CHEEK_RIGHT))
        before = [(linear(side.pixels / 255) @ LUMA)[cheek].mean() for cheek in (CHEEK_LEFT, CHEEK_RIGHT)]
        after = [(side.reflectance @ LUMA)[cheek].mean() for cheek in (CHEEK_LEFT, CHEEK_RIGHT)]
        assert (left > 1.3 * right) if azimuth > 0 else (right > 1.3 * left)
        assert abs(np.log(after[0] / after[1])) < 0.6 * abs(np.log(before[0] / before[1]))
        assert np.sign(-float(side.light.direction[0])) == np.sign(azimuth)


def test_normals_face_the_right_way(parts: Decomposition) -> None:
    normals = parts.normals
    there = parts.matte > 0
    assert np.linalg.norm(normals[there], axis=-1) == pytest.approx(1, abs=1e-4)
    assert normals[CHEEK_LEFT][..., 0].mean() < -0.2
    assert normals[CHEEK_RIGHT][..., 0].mean() > 0.2
    assert normals[FACE][..., 2].mean() > 0.6
    hair = normals[14:18, 105:115]
    assert hair[..., 1].mean() > 0.4


def test_grey_and_deep_photographs(half: np.ndarray, session: PhotoRelighter) -> None:
    deep = (half.astype(np.uint16) * 257)[..., 1]
    parts = PhotoRelighter(deep, HALF, session.relighter).decompose()
    sure = parts.matte > 0.99
    again = parts.reflectance * parts.shading + parts.highlights
    assert np.abs(again - linear(deep[..., None] / 65535))[sure].max() < 1e-4
    assert (parts.light.colours - 1).abs().max() < 1e-3


def test_a_black_photograph_has_no_light(session: PhotoRelighter) -> None:
    parts = PhotoRelighter(np.zeros((256, 256, 3), np.uint8), HALF, session.relighter).decompose()
    assert not parts.light.amounts.any()
    assert parts.light.report()["middle"] is None
    assert np.isfinite(parts.shading).all()
    assert not parts.reflectance.any()


# -- parts of it


@pytest.mark.parametrize("side_light", [0.0, 0.4])
def test_a_sphere_is_found_behind_its_shadows(side_light: float) -> None:
    lights, normals = even_hemisphere(64), even_hemisphere(80)
    lamp = 1 + side_light * (1 - lights[:, 2])
    images = 0.6 * (normals @ lights.T).clamp_min(0) * lamp  # (80, 64)
    n = torch.linalg.lstsq(lights.double(), images.T.double()).solution.float()
    normal, albedo = LambertSphere(lights, side_light).undo(n)
    away = angular_distance(normal.T, normals)
    before = angular_distance(n.T, normals)
    assert away.max() < 3.5
    assert away.mean() < 0.25 * before.mean()
    assert (albedo / 0.6 - 1).abs().max() < 0.08


def test_nothing_has_no_normal() -> None:
    normal, albedo = LambertSphere(even_hemisphere(20)).undo(torch.zeros(3, 2))
    assert not normal.any()
    assert not albedo.any()


def test_a_face_of_a_known_light_is_taken_apart(statistics, people: torch.Tensor) -> None:
    relighter = StatisticalRelighter(statistics, "face")
    image = people[13, 8]
    parts = take_apart(relighter, image, torch.ones_like(image), 0.01)
    assert float(angular_distance(parts.direction, statistics.lights[8])) < 25
    average = prior_brightness(relighter, parts.draws.amounts)
    assert average.std() < 1e-4 * average.mean()  # other likely lights are as bright
    assert 0 < parts.direction_std < 60
    assert (parts.normal_std > 0).all()
    assert torch.linalg.vector_norm(parts.normal, dim=0).sub(1).abs().max() < 1e-4


def prior_brightness(relighter: StatisticalRelighter, amounts: torch.Tensor) -> torch.Tensor:
    from facerelight.model.covariance import prior_mean

    statistics = relighter.statistics
    return amounts @ prior_mean(statistics, statistics.lights).clamp_min(0).sum(1)


def test_colours_of_two_lights_are_told_apart() -> None:
    generator = torch.Generator().manual_seed(2)
    directions = light_from_angles(torch.tensor([60.0, -60.0]), torch.zeros(2))
    normals = even_hemisphere(400)
    images = (directions @ normals.T).clamp_min(0) + 0.02
    given = torch.tensor([[1.15, 1.0, 0.8], [0.85, 1.0, 1.2]])
    skin = torch.tensor([1.3, 0.95, 0.7])[:, None] * (1 + 0.03 * torch.randn(3, 400, generator=generator))
    colour = skin * (given.T @ images)
    found = light_colours(colour.repeat(1, 20), images.repeat(1, 20), torch.ones(2), torch.ones(8000), directions)
    wanted = given / (given @ torch.tensor(LUMA))[:, None]
    assert (found / wanted - 1).abs().max() < 0.08
    assert torch.allclose(found @ torch.tensor(LUMA), torch.ones(2), atol=1e-5)
    plain = light_colours(skin.repeat(1, 20), images.repeat(1, 20), torch.ones(2), torch.ones(8000), directions)
    assert (plain - 1).abs().max() < 0.03


def test_a_highlight_goes_and_the_skin_stays() -> None:
    colour = np.array((1.35, 0.92, 0.65), np.float32)
    diffuse = np.broadcast_to(colour / (colour @ LUMA), (60, 60, 3)).astype(np.float32)
    y, x = np.mgrid[:60, :60]
    body = (0.3 + 0.05 * np.sin(x / 9))[..., None] * diffuse + np.float32(0.02)
    spot = 0.25 * np.exp(-((x - 30) ** 2 + (y - 30) ** 2) / 60)[..., None]
    scene = (body + spot).astype(np.float32)
    skin = own_skin(scene, np.ones((60, 60), np.float32), diffuse, 40)
    left = without_highlights(scene, skin)
    assert (left <= scene + 1e-6).all()
    assert np.abs(left - body).max() < 0.25 * spot.max()
    assert np.abs(left - body)[:15].max() < 0.02
    nowhere = own_skin(scene, np.zeros((60, 60), np.float32), diffuse, 40)
    assert np.array_equal(without_highlights(scene, nowhere), scene)


# -- files


@pytest.fixture(scope="module")
def written(half: np.ndarray, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("layers")
    Image.fromarray(half).save(place / "me.png")
    marks = ",".join(str(v) for v in HALF.ravel())
    command = ["decompose", str(place / "me.png"), "--statistics", str(folder), "--landmarks", marks]
    assert main([*command, "--output", str(place / "out")]) == 0
    return place / "out"


def read(path: Path) -> np.ndarray:
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return values if values.ndim == 2 else values[..., [2, 1, 0, *range(3, values.shape[2])]]


def test_every_file_is_there_and_says_what_it_holds(written: Path) -> None:
    assert {path.name for path in written.iterdir()} == set(FILES)
    report = json.loads((written / "decomposition.json").read_text())
    assert report["files"] == FILES
    assert report["size"] == [256, 256]
    first = report["light"]["lights"][0]
    assert set(first) == {"azimuth", "elevation", "amount", "std", "colour"}
    assert abs(first["azimuth"]) <= 180
    assert report["light"]["middle"]["std_degrees"] > 0


def test_files_multiply_to_the_photograph(half: np.ndarray, written: Path) -> None:
    reflectance, shading = read(written / "reflectance.png"), read(written / "shading.png")
    assert reflectance.dtype == np.uint16
    assert reflectance.shape == (256, 256, 4)
    sure = (reflectance[..., 3] > 0.99 * 65535) & (shading[..., :3].max(-1) < 65535)
    assert (reflectance[sure][:, :3] == 65535).any()  # above white, and so in the shading
    parts = [
        linear(read(written / name)[..., :3] / 65535) for name in ("reflectance.png", "shading.png", "highlights.png")
    ]
    again = parts[0] * parts[1] * SHADING_WHITE + parts[2]
    coded = np.where(again <= 0.0031308, 12.92 * again, 1.055 * again ** (1 / 2.4) - 0.055)
    assert sure.mean() > 0.2
    assert np.abs(coded * 255 - half)[sure].max() < 0.6


def test_normals_are_encoded_the_common_way(written: Path, parts: Decomposition) -> None:
    stored = read(written / "normals.png")
    assert np.abs(stored[parts.matte == 0][:, :3] / 65535 - (0.5, 0.5, 1)).max() < 1e-4
    there = parts.matte > 0
    assert np.abs(stored[there][:, :3] / 65535 * 2 - 1 - parts.normals[there]).max() < 0.02
    unsure = read(written / "normals_std.png")[..., 0] / 65535 * DEGREES_WHITE
    assert np.abs(unsure - parts.normals_std.clip(0, DEGREES_WHITE)).max() < 0.5


def test_the_map_is_the_light(written: Path, parts: Decomposition) -> None:
    exposure = json.loads((written / "decomposition.json").read_text())["light"]["exposure"]
    read_again, given = (
        environment_light(read_environment(written / "light.png"), exposure=exposure),
        parts.light.mixture,
    )
    facing = even_hemisphere(200)
    wanted, found = ((facing @ one.directions.T).clamp_min(0) @ one.weights for one in (given, read_again))
    assert (found - wanted).square().mean().sqrt() < 0.06 * wanted.square().mean().sqrt()
    assert (found.sum(0) / wanted.sum(0) - 1).abs().max() < 0.05
    middles = ((one.weights.mean(1) @ one.directions) for one in (given, read_again))
    assert float(angular_distance(*middles)) < 0.5


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["none.png"], 2, "none.png"),
        (["me.png", "--output", "me.png"], 2, "expected a folder, or none yet, got a file"),
        (["me.png", "--output", "out"], 2, "exists already; --force overwrites it"),
        (["plain.png"], 1, "found no face"),
    ],
)
def test_what_cannot_be_decomposed(
    arguments: list[str], code: int, said: str, tmp_path: Path, folder: Path, half: np.ndarray,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Image.fromarray(half).save("me.png")
    Image.new("RGB", (64, 64), (90, 90, 90)).save("plain.png")
    Path("out").mkdir()
    Path("out/light.png").touch()
    assert main(["decompose", *arguments, "--statistics", str(folder)]) == code
    assert said in capsys.readouterr().err
    assert not Path("plain_layers").exists()
