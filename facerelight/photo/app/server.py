"""The app: one process on this machine's own address, which keeps nothing and asks for nothing elsewhere."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from facerelight.photo.app.upload import MOST_BYTES, photo_page

if TYPE_CHECKING:
    from facerelight.inference.relighter import StatisticalRelighter

__all__ = ["HOST", "asked_from_here", "make_app", "serve"]

HOST = "127.0.0.1"
HERE = (HOST, "localhost")  # by which pages of this machine are asked for
NEEDED = 'the app needs Gradio; pip install "facerelight[app]"'
# Gradio's page names a script of cdnjs.cloudflare.com and fonts of Google; with this the browser asks for neither.
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self'; frame-src 'self' data: blob:"
)
QUIET = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1", "GRADIO_SSR_MODE": "False"}


def make_app(load: Callable[[], StatisticalRelighter], side: int = 1000) -> Any:
    """The page, a ``gradio.Blocks``: a photo from a file or the camera, and below it the viewer.

    Args:
        load: gives the relighter.
        side: pixels of the photo's longer side in the viewer.

    Raises:
        RuntimeError: Gradio is not installed.
    """
    gradio = _gradio()

    def show(given: str | None) -> str:
        if not given:
            return ""
        path = Path(given)
        try:
            return photo_page(path, side, load)
        except (ValueError, RuntimeError) as error:
            return f'<p role="alert">{escape(str(error).replace(str(path.parent) + os.sep, ""))}</p>'
        finally:
            path.unlink(missing_ok=True)

    with gradio.Blocks(analytics_enabled=False, title="facerelight", fill_width=True) as app:
        with gradio.Tab("Photo"):
            file = gradio.File(label="A photo of a person; it stays on this machine", height=140)
        with gradio.Tab("Camera"):
            camera = gradio.Image(sources=["webcam"], type="filepath", format="png", label="Take a picture")
        page = gradio.HTML()
        file.upload(show, file, page, api_visibility="private")
        camera.input(show, camera, page, api_visibility="private")
        file.clear(lambda: "", None, page, api_visibility="private")
    return app


def serve(load: Callable[[], StatisticalRelighter], port: int, side: int, browser: bool) -> None:
    """Serve the app until it is interrupted.

    Raises:
        RuntimeError: Gradio is not installed.
        ValueError: a port that is taken.
    """
    os.environ.update(QUIET)  # read when Gradio is imported
    with tempfile.TemporaryDirectory(prefix="facerelight") as place:
        os.environ["GRADIO_TEMP_DIR"] = place  # uploads lie here until they are read
        app = make_app(load, side)
        try:
            app.launch(
                server_name=HOST,
                server_port=port,
                share=False,
                inbrowser=browser,
                max_file_size=MOST_BYTES,
                app_kwargs={"middleware": [_policy()]},
                footer_links=[],
                theme=_theme(),
                quiet=True,
                prevent_thread_lock=True,
            )
        except OSError as error:
            raise ValueError(f"port: expected a free one, got {port}; --port takes another") from error
        print(f"http://{HOST}:{port}", flush=True)
        try:
            app.block_thread()
        finally:
            app.close(verbose=False)


def _theme() -> Any:
    """Gradio's own, with the machine's fonts."""
    themes = _gradio().themes
    return themes.Default(font=["system-ui", "sans-serif"], font_mono=["monospace"])


def asked_from_here(headers: Iterable[tuple[bytes, bytes]]) -> bool:
    """Whether a request names this machine, and comes from one of its own pages or from none: another site's page may
    not send photos here, nor a name that has been made to point here.

    Example:
        >>> asked_from_here([(b"host", b"127.0.0.1:7860")]), asked_from_here([(b"host", b"example.org")])
        (True, False)
    """
    named = {name.lower(): value.decode("latin-1") for name, value in headers}
    host, origin = urlsplit(f"//{named.get(b'host', '')}"), urlsplit(named.get(b"origin", ""))
    return host.hostname in HERE and (b"origin" not in named or origin.hostname in HERE)


def _policy() -> Any:
    from starlette.middleware import Middleware
    from starlette.responses import PlainTextResponse

    class Policy:
        """Says to the browser what a page may ask for, and answers no pages of other places."""

        def __init__(self, app: Any) -> None:
            self.app = app

        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            if scope["type"] in ("http", "websocket") and not asked_from_here(scope["headers"]):
                await PlainTextResponse("asked from another place", 403)(scope, receive, send)
                return

            async def say(message: Any) -> None:
                if message["type"] == "http.response.start":
                    message["headers"].append((b"content-security-policy", POLICY.encode()))
                await send(message)

            await self.app(scope, receive, say if scope["type"] == "http" else send)

    return Middleware(Policy)


def _gradio() -> Any:
    try:
        import gradio
    except ModuleNotFoundError as error:
        raise RuntimeError(NEEDED) from error
    return gradio
