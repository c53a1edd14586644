"""Make the README's picture of the viewer: its page in a browser, one lamp, the photo beside it.

facerelight viewer astronaut.png -o astronaut.html
python scripts/figures/viewer_image.py --page astronaut.html --output .github/images/viewer.jpg
"""

import io
import shutil
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from facerelight.evaluation.results import ScriptParser

SIZE = {"width": 1180, "height": 740}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--page", type=Path, required=True, help="written by facerelight viewer")
    parser.add_argument("--browser", default=next(filter(None, map(shutil.which, BROWSERS)), None))
    parser.add_argument("--preset", default="Rembrandt", help="the button to press")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=arguments.browser, args=["--no-sandbox"])
        page = browser.new_page(viewport=SIZE)
        page.goto(arguments.page.resolve().as_uri())
        page.get_by_role("button", name=arguments.preset).click(timeout=60_000)
        page.get_by_role("button", name="Compare").click()
        page.wait_for_timeout(5000)  # until the picture rests
        shot = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        browser.close()
    shot.save(arguments.output, quality=88, optimize=True)


if __name__ == "__main__":
    main()
