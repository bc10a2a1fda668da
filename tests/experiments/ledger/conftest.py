"""Run directories made up of the files a run leaves."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

CONFIG: dict[str, Any] = {
    "name": "badcl",
    "seed": 42,
    "data": {"split": "official", "encoding": "uint8_10m", "root": "a"},
    "model": {"weights": "imagenet", "upsample": "nearest"},
    "loss": {"_target_": "hudepth.losses.badcl.BADCL", "boundary": 3.0},
    "trainer": {"max_epochs": 10},
}

MakeRun = Callable[..., Path]


def merged(config: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``config`` with dotted ``changes``; None takes a key away."""
    result = json.loads(json.dumps(config))
    for dotted, value in changes.items():
        *groups, key = dotted.split(".")
        inner = result
        for group in groups:
            inner = inner.setdefault(group, {})
        if value is None:
            inner.pop(key, None)
        else:
            inner[key] = value
    return dict(result)


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Make a run directory of the given name, configuration, tests and history; return it."""

    def make(
        name: str,
        *,
        config: Mapping[str, Any] | None = None,
        tests: Mapping[str, Mapping[str, float]] | None = None,
        intervals: Mapping[str, Sequence[float]] | None = None,
        history: Sequence[Mapping[str, float]] = ({"epoch": 1, "val/abs_rel": 0.3},),
        source: str = "nyu_labeled",
    ) -> Path:
        path = tmp_path / name
        path.mkdir(parents=True)
        whole = merged(CONFIG, config or {})
        (path / "config.yaml").write_text(yaml.safe_dump(whole))
        header = list(history[0])
        lines = [",".join(header), *(",".join(str(row.get(key, "")) for key in header) for row in history)]
        (path / "metrics.csv").write_text("\n".join(lines) + "\n")
        for protocol, metrics in (tests or {}).items():
            result = {
                "metrics": {"model": dict(metrics), "mean_depth": {"abs_rel": 0.5}},
                "images": 654,
                "protocol": {"name": protocol, "resolution": "network", "crop": None, "valid": "measured"},
                "data": {"source": source, "encoding": whole["data"]["encoding"]},
                "split": {"kind": whole["data"]["split"], "counts": {"train": 698}},
                "intervals": {"model": {key: list(ends) for key, ends in (intervals or {}).items()}},
            }
            (path / "test" / protocol).mkdir(parents=True)
            (path / "test" / protocol / "metrics.json").write_text(json.dumps(result))
        return path

    return make
