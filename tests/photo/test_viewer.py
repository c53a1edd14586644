"""The page in which a portrait is lit by hand: what it holds, and in a real browser what it shows and how it is
used."""

import base64
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from facerelight.cli import main
from facerelight.geometry.lights import even_hemisphere
from facerelight.geometry.sources import Lamp
from facerelight.photo import PhotoRelighter
from facerelight.photo.viewer.dome import compress_dome, dome_directions
from facerelight.photo.viewer.packing import Packed, pack, unpack
from facerelight.photo.viewer.page import SCRIPTS, viewer_page

MOST_BYTES = 3_000_000
NINE = (
    (0, 0, 5), (50, 20, 5), (-70, 10, 5), (30, 45, 8), (-40, -10, 10), (85, 0, 15), (-20, 60, 20), (60, 30, 30),
    (-110, 15, 12),
)  # fmt: skip
SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
Open = Callable[..., Any]


# -- what the page holds


def test_arrays_come_back_within_half_a_step() -> None:
    generator = np.random.default_rng(0)
    arrays = {
        "share": Packed(generator.random((3, 5)), 1 / 255),
        "height": Packed(generator.normal(size=(2, 4, 3)), 2**-12),
    }
    found, facts = unpack(pack(arrays, {"pose": [1.5, None]}))
    assert facts == {"pose": [1.5, None]}
    for name, (values, step) in arrays.items():
        assert np.abs(found[name] - values).max() <= step / 2 + 1e-6
    with pytest.raises(ValueError, match="height: expected finite values"):
        pack({"height": Packed(np.full((2, 2), np.nan), 0.1)}, {})
    with pytest.raises(ValueError, match="expected finite values within"):
        pack({"height": Packed(np.full((2, 2), 1e6), 0.1)}, {})


def test_a_dome_keeps_its_bound_with_few_maps() -> None:
    normals = even_hemisphere(30).numpy().reshape(5, 6, 3)

    def lambert(lights: np.ndarray) -> np.ndarray:
        return np.einsum("hwc,qc->qhw", normals, lights).clip(0)

    dome = compress_dome(lambert, 19, 48, 0.01)
    lights = even_hemisphere(61).numpy()
    errors = np.stack([dome.at(light) for light in lights]) - lambert(lights)
    assert len(dome.basis) < 25
    assert np.sqrt(np.square(errors).mean()) < 0.015
    assert np.abs(dome.table).max() <= 1
    assert len(compress_dome(lambert, 19, 48, 0.1).basis) < len(dome.basis)
    assert np.linalg.norm(dome_directions(4, 8), axis=-1) == pytest.approx(1)


def test_every_script_is_in_the_page() -> None:
    import facerelight.photo.viewer.page as page

    files = Path(page.__file__).parent.joinpath("web").glob("*.js")
    assert sorted(file.stem for file in files) == sorted(SCRIPTS)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a.png", "-o", "a.png"], "ends in .html"),
        (["a.png", "--side", "10"], "side: expected 64 to 4000"),
        (["none.png"], "none.png: expected a readable photo"),
        (["a.png", "--landmarks", "1,2"], "expected six numbers"),
        (["a.png", "-o", "there.html"], "there.html: exists already"),
    ],
)
def test_bad_input_is_said_before_the_work(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (64, 64)).save("a.png")
    Path("there.html").touch()
    assert main(["viewer", *arguments]) == 2
    assert said in capsys.readouterr().err


# -- in a browser


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    """800 x 1,000 pixels."""
    photo = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
    return np.ascontiguousarray(cv2.resize(photo, (1024, 1024), interpolation=cv2.INTER_CUBIC)[:1000, 100:900])


@pytest.fixture(scope="module")
def session(portrait: np.ndarray) -> PhotoRelighter:
    return PhotoRelighter(portrait)


@pytest.fixture(scope="module")
def file(session: PhotoRelighter, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("viewer") / "portrait.html"
    path.write_text(viewer_page(session, "me & <you>.jpg"), "utf-8")
    return path


def browsers() -> list[str]:
    """Browsers of this machine, one named by the environment first."""
    names = (os.environ.get("FACERELIGHT_BROWSER", ""), "chromium", "chromium-browser", "google-chrome")
    return [found for found in map(shutil.which, filter(None, names)) if found]


@pytest.fixture(scope="module", params=["WebGL2", "canvas"])
def opened(request: pytest.FixtureRequest, file: Path) -> Iterator[Open]:
    """Opens the page in a browser with WebGL, or without; whatever it asks for or complains of is remembered."""
    driver = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    if not browsers():
        pytest.skip("no Chromium here; install one, or name it in FACERELIGHT_BROWSER")
    flags = SOFTWARE if request.param == "WebGL2" else ("--disable-3d-apis",)
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browsers()[0], args=["--no-sandbox", *flags])

        def open_page(**options: Any) -> Any:
            page = browser.new_context(**options).new_page()
            page.set_default_timeout(90_000)
            page.said = []
            page.on("request", lambda asked: page.said.append(asked.url))
            page.on("console", lambda message: page.said.append(message.text))
            page.on("pageerror", lambda error: page.said.append(str(error)))
            page.goto(file.as_uri())
            for _ in range(600):
                if page.evaluate("Boolean(window.facerelight)"):
                    break
                page.wait_for_timeout(100)
            assert page.evaluate("facerelight.painter") == request.param
            return page

        yield open_page
        browser.close()


def scene(page: Any) -> dict[str, Any]:
    return page.evaluate("facerelight.scene")


def aimed(page: Any) -> tuple[float, float]:
    lamp = scene(page)["lamps"][0]
    return lamp["azimuth"], lamp["elevation"]


def picture(page: Any) -> np.ndarray:
    coded = page.evaluate("facerelight.picture()").split(",")[1]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(coded))).convert("RGB")).astype(int)


def shown(page: Any, lamps: list[dict[str, Any]], fill: float) -> np.ndarray:
    page.evaluate("wanted => facerelight.set(wanted)", {"lamps": lamps, "fill": fill, "strength": 1})
    return picture(page)


def lamp(azimuth: float, elevation: float, size: float, colour: str = "#ffffff") -> dict[str, Any]:
    return {"azimuth": azimuth, "elevation": elevation, "size": size, "power": 1, "colour": colour}


def test_the_page_is_small_and_asks_for_nothing(file: Path, opened: Open) -> None:
    assert file.stat().st_size < MOST_BYTES
    page = opened(viewport={"width": 1280, "height": 800})
    assert page.title() == "me & <you>: light"
    assert page.said == [file.as_uri()]


def test_it_shows_what_python_renders(session: PhotoRelighter, opened: Open) -> None:
    page = opened()
    person = session.matte > 0
    for azimuth, elevation, size in NINE:
        wanted = session.render([Lamp(azimuth, elevation, size)], fill=0.1).astype(int)
        apart = np.abs(shown(page, [lamp(azimuth, elevation, size)], 0.1) - wanted)
        assert apart.mean() < 1, (azimuth, elevation, size)
        assert np.quantile(apart, 0.999) < 4, (azimuth, elevation, size)
        assert apart[person].mean() < 1
        assert not apart[~person].any()
    amber = (1.0, 0.3325, 0.107)  # linear of ff9d5c
    wanted = session.render([Lamp(65, 10, 10, colour=amber), Lamp(-65, 10, 40)], fill=0.05).astype(int)
    apart = np.abs(shown(page, [lamp(65, 10, 10, "#ff9d5c"), lamp(-65, 10, 40)], 0.05) - wanted)
    assert apart.mean() < 1
    assert np.quantile(apart, 0.999) < 4
    assert len(page.said) == 1


def test_the_lamp_follows_mouse_touch_and_keys(opened: Open) -> None:
    page = opened(viewport={"width": 1280, "height": 800}, has_touch=True)
    box = page.locator("#ball").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] - 40, middle[1] - 30, steps=3)
    page.mouse.up()
    azimuth, elevation = aimed(page)
    assert azimuth > 20
    assert elevation > 20
    page.mouse.wheel(0, -100)
    page.wait_for_timeout(300)
    assert scene(page)["lamps"][0]["size"] == 9
    page.focus("#ball")
    for key in ("ArrowRight", "ArrowDown", "Shift+ArrowDown", "+"):
        page.keyboard.press(key)
    assert aimed(page) == (azimuth - 3, elevation - 18)
    assert scene(page)["lamps"][0]["size"] == 10
    assert "Lamp 1 of 1" in page.locator("#live").text_content()
    page.focus("#azimuth")
    page.keyboard.press("ArrowRight")  # a slider moves the lamp its own way
    assert aimed(page)[0] == azimuth - 4
    frame = page.locator("#frame").bounding_box()
    before = picture(page)
    touch = page.context.new_cdp_session(page)
    for kind, across in (("touchStart", 0.3), ("touchMove", 0.8), ("touchEnd", None)):
        point = {"x": frame["x"] + (across or 0) * frame["width"], "y": frame["y"] + 0.2 * frame["height"]}
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [] if across is None else [point]})
    assert aimed(page)[0] < -20
    page.wait_for_timeout(3000)
    assert np.abs(picture(page) - before).mean() > 1
    assert len(page.said) == 1


def test_three_lamps_compared_doubted_and_saved(opened: Open, portrait: np.ndarray, tmp_path: Path) -> None:
    page = opened(viewport={"width": 1280, "height": 800})
    for _ in range(2):
        page.get_by_role("button", name="Add a lamp").click()
    assert len(scene(page)["lamps"]) == 3
    assert page.get_by_role("button", name="Add a lamp").count() == 0
    page.get_by_role("button", name="Remove this lamp").click()
    page.get_by_role("button", name="Two colours").click()
    assert "--light 65,10,size=10,colour=ff9d5c --light -65,10" in page.locator("#command").text_content()
    page.get_by_role("button", name="Compare").click()
    frame, wiped = page.locator("#frame").bounding_box(), float(page.locator("#wipe").input_value())
    assert 0.3 < wiped < 0.6  # through the face
    places = [(frame["x"] + share * frame["width"], frame["y"] + 0.7 * frame["height"]) for share in (wiped, 0.2)]
    page.mouse.move(*places[0])
    page.mouse.down()
    page.mouse.move(*places[1], steps=3)
    page.mouse.up()
    assert float(page.locator("#wipe").input_value()) == pytest.approx(0.2, abs=0.03)
    page.get_by_role("button", name="How unsure").click()
    assert "standard deviation" in page.locator("#doubt-note").text_content()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save PNG").click()
    download.value.save_as(tmp_path / "saved.png")
    saved = Image.open(tmp_path / "saved.png").convert("RGB")
    assert saved.size == portrait.shape[1::-1]
    assert np.abs(np.asarray(saved).astype(int) - picture(page)).max() == 0
    assert len([line for line in page.said if not line.startswith("blob:")]) == 1


def test_it_fits_a_telephone_and_has_names_for_readers(opened: Open) -> None:
    page = opened(viewport={"width": 360, "height": 740}, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    unnamed = """[...document.querySelectorAll("button, input, [tabindex]")].filter((one) =>
        !(one.getAttribute("aria-label") || one.textContent.trim() || (one.labels && one.labels.length))).length"""
    assert page.evaluate(unnamed) == 0
    assert page.evaluate("document.getElementById('size').getAttribute('aria-valuetext')") == "8°, reflector"


def test_frames_a_second_are_reported(opened: Open, record_property: Callable[[str, object], None]) -> None:
    page = opened(viewport={"width": 1280, "height": 1000})
    move = "azimuth => facerelight.draft({lamps: [{azimuth, elevation: 20, size: 5, power: 1, colour: '#ffffff'}]})"
    for azimuth in range(-60, 60, 8):
        page.evaluate(move, azimuth)
    seconds = page.evaluate("facerelight.seconds")[-10:]
    print(json.dumps({"painter": page.evaluate("facerelight.painter"), "frames a second": 10 / sum(seconds)}))
    record_property("frames_a_second", 10 / sum(seconds))
    assert 10 / sum(seconds) > 0.5
