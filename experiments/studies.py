"""What the scripts of the studies share: copying a run's results, hiding paths, shrinking pictures."""

from __future__ import annotations

import base64
import io
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

from PIL import Image

from hudepth.base.files import write_text

TEXTS = (".json", ".yaml", ".html", ".csv", ".md", ".tex", ".txt")
WIDTH_PX = 1600
"""Pictures are at most as wide as a screen."""


def copy_run(run: Path, target: Path, *, tables: Iterable[str] = ()) -> None:
    """Copy a run's results, not its weights and pictures.

    Args:
        run: a run directory.
        target: folder of the copy.
        tables: protocols whose per-image table is copied too, for comparisons image by image.
    """
    per_image = [f"test/{protocol}/per_image.csv" for protocol in tables]
    for pattern in ("*.yaml", "*.json", "*.csv", "*.txt", "test/*/metrics.json", *per_image):
        for file in run.glob(pattern):
            (target / file.relative_to(run)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, target / file.relative_to(run))


def hide(study: Path, texts: list[str]) -> None:
    """Cut texts, paths for example, from all files of a study."""
    for file in study.rglob("*"):
        if file.suffix in TEXTS:
            content = before = file.read_text(encoding="utf-8")
            for text in texts:
                content = content.replace(text, "")
            if content != before:
                write_text(file, content)


def shrink(folder: Path) -> None:
    """Replace PNG pictures by WebP, in files and within pages."""
    for picture in folder.rglob("*.png"):
        picture.with_suffix(".webp").write_bytes(to_webp(picture.read_bytes()))
        picture.unlink()
    for page in folder.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        write_text(page, re.sub(r"data:image/png;base64,([A-Za-z0-9+/=]+)", _embed, text))


def to_webp(png: bytes) -> bytes:
    """Encode a picture for the screen: lossless where that is smaller, as for most plots."""
    image = Image.open(io.BytesIO(png)).convert("RGB")
    if image.width > WIDTH_PX:
        image = image.resize((WIDTH_PX, round(image.height * WIDTH_PX / image.width)), Image.Resampling.LANCZOS)
    encoded = []
    for lossless, quality in ((True, 80), (False, 82)):
        file = io.BytesIO()
        image.save(file, "webp", lossless=lossless, quality=quality, method=6)
        encoded.append(file.getvalue())
    return min(encoded, key=len)


def _embed(found: re.Match[str]) -> str:
    return f"data:image/webp;base64,{base64.b64encode(to_webp(base64.b64decode(found[1]))).decode()}"
