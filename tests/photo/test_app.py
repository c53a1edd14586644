"""The app: what it refuses, and, where Gradio and a browser are there, a photo from the upload to the saved picture."""

import io
import os
import signal
import socket
import subprocess
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_viewer import SOFTWARE, browsers

from facerelight.cli import main
from facerelight.photo.app.server import asked_from_here
from facerelight.photo.app.upload import check_upload, photo_page


def test_large_files_and_bombs_are_refused_undecoded(tmp_path: Path) -> None:
    heavy = tmp_path / "heavy.png"
    with heavy.open("wb") as file:
        file.truncate(60_000_000)  # takes no room on the disk
    with pytest.raises(ValueError, match=r"heavy\.png: expected at most 50 MB, got 60\.0"):
        check_upload(heavy)
    coded = io.BytesIO()
    Image.new("1", (8, 8)).save(coded, "PNG")
    for side, said in ((9000, "got 9000 x 9000"), (60000, "40 megapixels, got")):
        head = bytearray(coded.getvalue())
        head[16:24] = side.to_bytes(4, "big") * 2
        bomb = tmp_path / "bomb.png"
        head[29:33] = zlib.crc32(head[12:29]).to_bytes(4, "big")
        bomb.write_bytes(head)
        with pytest.raises(ValueError, match=said):
            check_upload(bomb)


@pytest.mark.parametrize(
    ("host", "origin", "answered"),
    [
        ("127.0.0.1:7860", None, True),
        ("localhost:7860", "http://localhost:7860", True),
        ("127.0.0.1:7860", "http://127.0.0.1:7860", True),
        ("evil.example", None, False),
        ("127.0.0.1.evil.example:7860", None, False),
        ("127.0.0.1:7860", "http://evil.example", False),
        ("127.0.0.1:7860", "null", False),
        (None, None, False),
    ],
)
def test_only_pages_of_this_machine_are_answered(host: str | None, origin: str | None, answered: bool) -> None:
    given = ((b"host", host), (b"Origin", origin))
    assert asked_from_here([(name, value.encode()) for name, value in given if value is not None]) is answered


def test_no_photo_is_said_without_the_place_it_lies_in(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("no picture")
    with pytest.raises(ValueError, match=r"^a\.png: expected a photo"):
        photo_page(tmp_path / "a.png", 500, lambda: pytest.fail("nothing to load"))


@pytest.mark.parametrize("words", [["--port", "80"], ["--side", "5"]])
def test_bad_options_are_said(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["app", *words]) == 2
    assert "expected" in capsys.readouterr().err


def test_without_gradio_it_is_said_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "environ", dict(os.environ))
    monkeypatch.setitem(sys.modules, "gradio", None)
    assert main(["app"]) == 3
    assert 'the app needs Gradio; pip install "facerelight[app]"' in capsys.readouterr().err


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The app in a process of its own, and its address."""
    pytest.importorskip("gradio", reason="the extra app is not installed")
    if not browsers():
        pytest.skip("no Chromium here; install one, or name it in FACERELIGHT_BROWSER")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "facerelight.cli", "app", "--port", str(port), "--side", "320"]
    there = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=there) as running:
        try:
            assert running.stdout is not None
            line = running.stdout.readline().strip()
            assert line == f"http://127.0.0.1:{port}", line + running.stdout.read()
            yield running, line
        finally:
            running.kill()


def test_a_photo_goes_in_and_a_relit_one_comes_out(served: tuple[Any, str], tmp_path: Path) -> None:
    astronaut = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
    driver = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    photo, text = tmp_path / "me.png", tmp_path / "notes.txt"
    Image.fromarray(np.ascontiguousarray(astronaut[:320, 60:380])).save(photo)
    text.write_text("no picture")
    running, address = served
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browsers()[0], args=["--no-sandbox", *SOFTWARE])
        page = browser.new_page()
        page.set_default_timeout(120_000)
        asked: list[str] = []
        page.on("requestfinished", lambda one: asked.append(one.url))
        page.goto(address)
        page.locator("input[type=file]").first.set_input_files(str(text))
        page.get_by_role("alert").filter(has_text="notes.txt: expected a photo").wait_for()
        page.get_by_label("Clear").first.click()
        page.locator("input[type=file]").first.set_input_files(str(photo))
        page.locator("iframe").wait_for()
        frame = page.frame_locator("iframe")
        frame.get_by_role("button", name="Save PNG").wait_for()
        inside = page.frames[-1]
        for _ in range(600):  # waiting inside the page is forbidden to it, as it should be
            if inside.evaluate("Boolean(window.facerelight)"):
                break
            page.wait_for_timeout(100)
        with page.expect_download() as download:
            frame.get_by_role("button", name="Save PNG").click()
        download.value.save_as(tmp_path / "saved.png")
        browser.close()
    saved = np.asarray(Image.open(tmp_path / "saved.png").convert("RGB")).astype(int)
    assert saved.shape == (320, 320, 3)
    assert np.abs(saved - astronaut[:320, 60:380]).mean() > 1
    assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []
    assert not [
        path for path in tmp_path.rglob("*") if path.name in ("me.png", "notes.txt") and path.parent != tmp_path
    ]
    running.send_signal(signal.SIGINT)
    assert running.wait(60) == 0
    assert not list(tmp_path.glob("facerelight*"))
