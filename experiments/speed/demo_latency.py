"""How long does a visitor of hudepth-demo wait for a picture's depth?

    python -m experiments.speed.demo_latency [folder of images] [--pictures 40] [--page README.md]

A headless Chromium uploads pictures to the demo, one after the other, to each model in turns. Timed is what a visitor
waits: from choosing the file to the depth map on the page, which includes the upload, decoding, prediction, sending the
depth and drawing it. Prints a Markdown table; --page writes it between the page's ``demo`` marks.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from hudepth.base.files import write_between
from hudepth.base.tables import Table

MODELS = ("nyu", "nyu_lite")
UNTIMED = 2
"""First pictures of each model, which also load code and fill caches."""


@contextmanager
def demo(model: str, folder: str) -> Iterator[str]:
    """Serve a model's demo, with its temporary files in a folder, and return the page's address."""
    command = [str(Path(sys.executable).parent / "hudepth-demo"), f"checkpoint={model}", "port=0"]
    process = subprocess.Popen(
        command, cwd=folder, env={**os.environ, "TMPDIR": folder}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if found := re.search(r"open (http://\S+)", line):
                yield found[1]
                return
        sys.exit(f"demo_latency: hudepth-demo checkpoint={model} did not start.")
    finally:
        process.terminate()
        process.wait()


def waited(tab: Any, picture: Path, name: str) -> float:
    """Upload a picture under a name that the page has not shown yet, and return the time until it shows it [s]."""
    file = {"name": name, "mimeType": "image/jpeg", "buffer": picture.read_bytes()}
    start = time.perf_counter()
    tab.set_input_files("#picture input[type=file]", file)
    tab.locator(".hd-caption", has_text=name).wait_for(timeout=60_000)
    return time.perf_counter() - start


def row(model: str, seconds: Sequence[float]) -> list[str]:
    """Return a model's row of the table, in milliseconds."""
    ms = [1000 * each for each in seconds]
    tenths = statistics.quantiles(ms, n=20)
    return [model, str(len(ms)), *(f"{value:.0f}" for value in (statistics.median(ms), tenths[0], tenths[-1]))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("HUDEPTH_NYU_ROOT", "../shared/data/nyu_labeled"))
    parser.add_argument("folder", type=Path, nargs="?", default=default, help="of JPEG images")
    parser.add_argument("--pictures", type=int, default=40, help="that are timed, of each model")
    parser.add_argument("--page", type=Path, help="file to write the table to")
    options = parser.parse_args()
    from playwright.sync_api import sync_playwright

    pictures = sorted(options.folder.glob("*.jpg"))[: UNTIMED + options.pictures]
    times: dict[str, list[float]] = {model: [] for model in MODELS}
    with ExitStack() as stack:
        browser = stack.enter_context(sync_playwright()).chromium.launch(
            executable_path=shutil.which("chromium") or shutil.which("google-chrome"), args=["--no-sandbox"]
        )
        tabs = {}
        for model in MODELS:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            tabs[model] = browser.new_page(viewport={"width": 1280, "height": 800})
            tabs[model].goto(stack.enter_context(demo(model, folder)))
            tabs[model].wait_for_selector(".hd-empty")
        for number, picture in enumerate(pictures):
            for model, tab in tabs.items():
                times[model].append(waited(tab, picture, f"picture_{number}.jpg"))
                time.sleep(1)  # the files to download are written after the depth was shown
        browser.close()
    table = Table(["checkpoint", "pictures", "median [ms]", "5 % below", "95 % below"])
    for model, seconds in times.items():
        table.add(*row(model, seconds[UNTIMED:]))
    print(table.to_markdown())
    if options.page:
        write_between(options.page, "demo", table.to_markdown())


if __name__ == "__main__":
    main()
