from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hudepth.base.errors import HudepthError
from hudepth.export.comparison_images import find_images
from hudepth.runs.checkpoint import load_checkpoint


def test_rooms_replace_missing_data(
    tiny: Path, cache: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = load_checkpoint(str(tiny))
    source = {"_target_": "hudepth.data.sources.folder.FolderSource"}
    gone = replace(checkpoint, config={**checkpoint.config, "data": {**checkpoint.config["data"], "source": source}})
    asked: dict[str, Any] = {"folder": None, "size": (32, 48), "compared": 3, "calibration": 9, "trust": []}
    monkeypatch.setattr(logging.getLogger("hudepth"), "propagate", True)
    images = find_images(gone, **asked, data={"cache": str(cache)})
    assert (images.origin, images.datamodule) == ("synthetic rooms", None)
    assert (images.compared.shape, images.calibration.shape) == ((3, 32, 48, 3), (9, 32, 48, 3))
    assert "synthetic rooms replace it" in caplog.text
    with pytest.raises(HudepthError):  # data that the user names must be there
        find_images(gone, **asked, data={"root": "nowhere"})


def test_images_of_a_folder(tiny: Path, tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    for number in range(5):
        Image.fromarray(image // (number + 1)).save(tmp_path / f"{number}.png")
    images = find_images(
        load_checkpoint(str(tiny)), folder=str(tmp_path), size=(32, 48), compared=2, calibration=5, data={}, trust=[]
    )
    assert len(images.compared) == 2
    assert len(images.calibration) == 5
    assert images.origin == f"images of '{tmp_path.name}'"
