"""The viewer in a notebook: the light's state in Python, and in a page with a stand-in for the notebook."""

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from test_viewer import SOFTWARE, browsers

import facerelight.photo.viewer.page
from facerelight import Lamp
from facerelight.photo import PhotoRelighter

pytest.importorskip("anywidget", reason="the extra notebook is not installed")


@pytest.fixture(scope="module")
def widget():
    from facerelight.photo.viewer.widget import Widget

    astronaut = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
    return Widget(np.ascontiguousarray(astronaut[:320, 60:380]), side=256)


def test_the_light_is_one_in_python_and_in_the_page(widget) -> None:
    assert widget.lamps == [Lamp(40, 30, size=8)]
    heard = []
    widget.observe(lambda change: heard.append(change["new"]), "scene")
    widget.lamps = [Lamp(60, 20), Lamp(-60, 10, size=20, power=0.3, colour=(1.0, 0.337, 0.107))]
    widget.fill = 0.3
    assert [one["colour"] for one in heard[-1]["lamps"]] == ["#ffffff", "#ff9d5c"]
    assert heard[-1]["fill"] == 0.3
    lamp = {"azimuth": -20, "elevation": 5, "size": 12, "power": 0.5, "colour": "#ff9d5c"}
    widget.set_state({"scene": {"lamps": [lamp], "fill": 0.2, "strength": 0.5}})  # as the page says it
    assert (widget.fill, widget.strength, len(widget.lamps)) == (0.2, 0.5, 1)
    assert (widget.lamps[0].azimuth, widget.lamps[0].size) == (-20, 12)
    assert widget.lamps[0].colour == pytest.approx((1.0, 0.337, 0.107), abs=1e-3)


def test_it_renders_the_photo_at_its_own_size(widget) -> None:
    widget.lamps, widget.fill, widget.strength = [Lamp(-50, 10)], 0.1, 1.0
    wanted = PhotoRelighter(widget._photo).render([Lamp(-50, 10)], fill=0.1)
    assert np.array_equal(widget.render(), wanted)


def test_what_the_page_could_not_show_is_refused(widget) -> None:
    for lamps in ([], [Lamp()] * 4, [Lamp(size=80)], [3]):
        with pytest.raises(ValueError, match="lamps: expected"):
            widget.lamps = lamps
    with pytest.raises(ValueError, match="fill: expected a share"):
        widget.fill = 2


def test_both_sides_hear_each_other(widget, tmp_path: Path) -> None:
    driver = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    if not browsers():
        pytest.skip("no Chromium here; install one, or name it in FACERELIGHT_BROWSER")
    web = Path(facerelight.photo.viewer.page.__file__).parent / "web"
    script = base64.b64encode((web / "widget.mjs").read_bytes()).decode()
    lamp = {"azimuth": -33, "elevation": 12, "size": 5, "power": 1, "colour": "#ffffff"}
    state = {"page": widget.page, "height": 640, "scene": {"lamps": [lamp], "fill": 0.25, "strength": 1}}
    notebook = f"""<!DOCTYPE html><meta charset="utf-8"><div id="cell"></div><script type="module">
    const state = {json.dumps(state).replace("<", chr(92) + "u003c")}, heard = [];
    const model = {{
      get: (name) => state[name], set: (name, value) => {{ state[name] = value; }},
      save_changes() {{ model.saved += 1; }},
      on: (name, call) => heard.push(call), off() {{}}, saved: 0,
      say(scene) {{ state.scene = scene; heard.forEach((call) => call()); }},
    }};
    window.model = model;
    const widget = await import("data:text/javascript;base64,{script}");
    widget.default.render({{ model, el: document.getElementById("cell") }});
    </script>"""
    (tmp_path / "notebook.html").write_text(notebook, "utf-8")
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browsers()[0], args=["--no-sandbox", *SOFTWARE])
        page = browser.new_page(viewport={"width": 1100, "height": 700})
        page.set_default_timeout(60_000)
        page.goto((tmp_path / "notebook.html").as_uri())
        page.locator("iframe").wait_for()
        inside = page.frames[-1]

        def shown() -> dict:
            return inside.evaluate("window.facerelight ? facerelight.scene : null")

        for _ in range(600):
            if (shown() or {"fill": 0})["fill"] == 0.25:
                break
            page.wait_for_timeout(100)
        assert shown()["lamps"] == [lamp]
        page.evaluate("model.say({...model.get('scene'), fill: 0.4})")
        assert shown()["fill"] == 0.4
        assert page.evaluate("model.saved") == 0
        page.frame_locator("iframe").get_by_role("button", name="Two colours").click()
        for _ in range(100):
            if page.evaluate("model.saved"):
                break
            page.wait_for_timeout(100)
        assert [one["azimuth"] for one in page.evaluate("model.get('scene').lamps")] == [65, -65]
        browser.close()
