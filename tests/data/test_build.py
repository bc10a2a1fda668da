"""From a configuration to a data module, also with a data set from outside the package."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hudepth.base.errors import ConfigError
from hudepth.data.build import build_data

OUTSIDE = """
import numpy as np
from hudepth.data.sources.base import RawPair, Record, Source

class Stripes(Source):
    name = "stripes"
    licence = "cc0-1.0"
    terms = "Stripes, in the public domain."
    encoding = "float_m"

    def __init__(self, *, pairs=10):
        self.pairs = pairs

    def records(self):
        return [Record(f"{i:02d}", f"scene{i}", 0) for i in range(self.pairs)]

    def read(self, record):
        depth = np.full((8, 8), 1 + int(record.id), np.float32)
        return RawPair(np.full((8, 8, 3), int(record.id), np.uint8), depth)
"""


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "my_stripes.py").write_text(OUTSIDE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_stripes", raising=False)
    return "my_stripes"


def test_a_data_set_from_outside_the_package(outside: str, tmp_path: Path) -> None:
    config = {
        "_target_": "hudepth.data.datamodule.DepthDataModule",
        "source": {"_target_": f"{outside}.Stripes", "pairs": 20},
        "size": 8,
        "cache": tmp_path,
    }
    data = build_data(config, trust=[outside])
    assert len(data.store) == 20
    assert next(iter(data.train_dataloader()))["image"].shape == (8, 8, 8, 3)
    with pytest.raises(ConfigError, match=r"trust=\[my_stripes\]"):
        build_data(config, trust=[])


def test_a_source_is_required() -> None:
    with pytest.raises(ConfigError, match=r"data\.source"):
        build_data({"_target_": "hudepth.data.datamodule.DepthDataModule"}, trust=[])
