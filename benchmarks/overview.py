"""Pictures of the live page during `shearloop demo`, as the pages show them.

    python -m benchmarks.overview --out docs/images [--folder .]

Runs the demo, opens its page in Debian's chromium, and takes a picture a second. Writes overview.gif, which plays the
whole demo in sixty seconds, and live-view.png from the hold.
"""

import io
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from benchmarks.common import parser_of

OVERVIEW_S = 60.0
INTERVAL_S = 1.0
WIDTH_PX, HEIGHT_PX, GIF_WIDTH_PX, COLOURS = 1400, 860, 840, 128
# The page's summary of the experiment, at the end.
SUMMARY_PICTURES = 4
# In the hold, as a fraction of the demo's time.
HOLD = 0.82
_ADDRESS = re.compile(r"http://\S+#token=\S+")


def pictures(page: Page, demo: "subprocess.Popen[str]") -> list[bytes]:
    """Return a picture of the page a second while the demo runs."""
    taken: list[bytes] = []
    due_s = time.monotonic()
    while demo.poll() is None:
        taken.append(page.screenshot())
        due_s += INTERVAL_S
        page.wait_for_timeout(max(0.0, due_s - time.monotonic()) * 1000)
    return [*taken, *[page.screenshot()] * SUMMARY_PICTURES]


def write_gif(taken: list[bytes], path: Path) -> None:
    """Write the pictures as a small animation of sixty seconds."""
    size = (GIF_WIDTH_PX, GIF_WIDTH_PX * HEIGHT_PX // WIDTH_PX)
    images = [Image.open(io.BytesIO(one)).convert("RGB").resize(size, Image.Resampling.LANCZOS) for one in taken]
    # One palette, of the hold and of the end, without dithering: an unchanged pixel costs nothing.
    both = Image.new("RGB", (size[0], 2 * size[1]))
    both.paste(images[int(HOLD * len(images))])
    both.paste(images[-1], (0, size[1]))
    palette = both.quantize(COLOURS)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration_ms = int(OVERVIEW_S * 1000 / len(frames))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=duration_ms, loop=0, optimize=True)


def main() -> None:
    """Run the demo and write the pictures."""
    parser = parser_of(__doc__)
    parser.add_argument("--folder", type=Path, default=Path(), metavar="DIR", help="the demo's folder (default: .)")
    args = parser.parse_args()
    command = [sys.executable, "-m", "shearloop", "demo", "--folder", str(args.folder)]
    with (
        tempfile.NamedTemporaryFile("r") as log,
        subprocess.Popen(command, stdout=log.fileno(), text=True) as demo,
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"]) as browser,
    ):
        while not (address := _ADDRESS.search(Path(log.name).read_text())):
            time.sleep(0.1)
        page = browser.new_page(viewport={"width": WIDTH_PX, "height": HEIGHT_PX})
        page.goto(address[0])
        taken = pictures(page, demo)
        page.close()
    args.out.mkdir(parents=True, exist_ok=True)
    write_gif(taken, args.out / "overview.gif")
    (args.out / "live-view.png").write_bytes(taken[int(HOLD * len(taken))])
    print(f"{len(taken)} pictures; the demo ended with status {demo.returncode}")


if __name__ == "__main__":
    main()
