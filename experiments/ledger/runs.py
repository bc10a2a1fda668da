"""Runs as evidence: what each trained with, how it went, and how it tested."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hudepth.base.errors import ConfigError, HudepthError
from hudepth.runs.history import read_history
from hudepth.runs.identity import INCIDENTAL, flat
from hudepth.runs.results import MODEL, read_metrics
from hudepth.runs.run import is_run, read_config

NOT_RECIPE = (
    *INCIDENTAL, "monitor", "mode", "callbacks", "data.native", "data.on_error", "trainer.deterministic",
    "trainer.max_epochs", "model.weights",
)  # fmt: skip
"""Keys in which two runs of one recipe may differ: places, hardware, and how long it ran. Of ``model.weights`` only
matters whether there are any."""


@dataclass(frozen=True)
class Run:
    """One run directory, or a study's copy of one."""

    path: Path
    config: Mapping[str, Any]
    """Flat: dotted keys."""
    history: list[dict[str, float]]
    """One row per epoch; empty where metrics.csv cannot be read."""
    tests: dict[str, dict[str, Any]] = field(default_factory=dict)
    """metrics.json by protocol."""
    problems: list[str] = field(default_factory=list)
    """One line for each file that is missing or damaged."""

    @property
    def name(self) -> str:
        """Its name, with the folder where that differs."""
        folder = self.path.resolve().name
        name = str(self.config.get("name", folder))
        return name if name == folder else f"{name} ({folder})"

    @property
    def split(self) -> str:
        """random, scene or official, of the training."""
        return str(self.config.get("data.split", "unknown"))

    @property
    def misread(self) -> bool:
        """Whether it read 8-bit depth as millimetres."""
        return self.config.get("data.encoding") == "paper_literal"

    @property
    def loss(self) -> str:
        """The loss's class, for example ``BADCL``."""
        return str(self.config.get("loss._target_", "unknown")).rpartition(".")[2]

    @property
    def training_images(self) -> int | None:
        """Size of the training subset, None where no test result states it."""
        for test in self.tests.values():
            trained_on = _at(test, "checkpoint", "trained_on", "split") or test.get("split")
            count = _at(trained_on, "counts", "train")
            if isinstance(count, int):
                return count
        return None

    def tested_source(self, protocol: str) -> str:
        """Return the data set a test was about."""
        return str(self.tests[protocol].get("data", {}).get("source", "?"))

    def tested_split(self, protocol: str) -> str:
        """Return the kind of split a test was about."""
        return str(self.tests[protocol].get("split", {}).get("kind", "?"))

    def metric(self, protocol: str, name: str) -> float | None:
        """Return a test metric of the trained network, None if there is none."""
        value = _at(self.tests, protocol, "metrics", MODEL, name)
        return float(value) if _is_number(value) else None

    def interval(self, protocol: str, name: str) -> tuple[float, float] | None:
        """Return the interval of a test metric [low, high], None where the result states none."""
        ends = _at(self.tests, protocol, "intervals", MODEL, name)
        if isinstance(ends, list) and len(ends) == 2 and all(map(_is_number, ends)):
            return float(ends[0]), float(ends[1])
        return None

    def at_epoch(self, epoch: int, key: str) -> float | None:
        """Return a value of the history at an epoch, None if there is none."""
        return next((row[key] for row in self.history if row["epoch"] == epoch and key in row), None)

    @property
    def last_epoch(self) -> int:
        """0 without a history."""
        return int(max((row["epoch"] for row in self.history), default=0))


def find_runs(paths: Sequence[str | Path]) -> list[Run]:
    """Read the runs at and below some folders.

    Args:
        paths: run directories, studies, or folders with several of them up to three levels down.

    Raises:
        ConfigError: if a folder does not exist or holds no run: a slip of the keyboard, found before any work.
    """
    folders: dict[Path, Path] = {}  # each once, however it is spelled
    for given in paths:
        path = Path(given).expanduser()
        if not path.is_dir():
            raise ConfigError(f"runs: no folder '{path}'. Pass run directories, as --runs experiments/badcl_official.")
        found = (
            [path]
            if is_run(path)
            else sorted(p.parent for level in range(1, 4) for p in path.glob(f"{'*/' * level}config.yaml"))
        )
        if not found:
            raise ConfigError(f"runs: '{path}' is not a run and contains none: there is no config.yaml at or below it.")
        folders |= {folder.resolve(): folder for folder in found if folder.resolve() not in folders}
    return [read_run(folder) for folder in folders.values()]


def read_run(path: Path) -> Run:
    """Read one run directory; what cannot be read becomes a line in ``problems``."""
    problems: list[str] = []
    config: dict[str, Any] = {}
    history: list[dict[str, float]] = []
    try:
        config = flat(read_config(path))
    except HudepthError as error:
        problems.append(str(error))
    try:
        history = read_history(path / "metrics.csv")
    except HudepthError as error:
        problems.append(str(error))
    tests: dict[str, dict[str, Any]] = {}
    for file in sorted((path / "test").glob("*/metrics.json")):
        try:
            tests[file.parent.name] = read_metrics(file)
        except HudepthError as error:
            problems.append(str(error))
    if not tests:
        problems.append(f"'{path}' holds no readable test result. Run hudepth-test checkpoint={path} first.")
    return Run(path, config, history, tests, problems)


def same_but(a: Run, b: Run, *keys: str) -> bool:
    """Tell whether two runs follow one recipe except in ``keys`` and what lies below them.

    Keys in :data:`NOT_RECIPE` may differ too. Runs whose configuration is unknown match nothing.
    """
    ignored = (*NOT_RECIPE, *keys)

    def recipe(run: Run) -> dict[str, Any]:
        kept = {k: v for k, v in run.config.items() if not any(k == i or k.startswith(f"{i}.") for i in ignored)}
        return {**kept, "pretrained": run.config.get("model.weights") not in (None, "none")}

    return bool(a.config) and bool(b.config) and recipe(a) == recipe(b)


def pairs(runs: Sequence[Run], *keys: str) -> list[tuple[Run, Run]]:
    """Return every two runs that are :func:`same_but` for ``keys`` and differ in the first of them."""
    return [
        (a, b)
        for a, b in itertools.combinations(runs, 2)
        if a.config.get(keys[0]) != b.config.get(keys[0]) and same_but(a, b, *keys)
    ]


def _at(value: object, *keys: str) -> Any:
    """Look a nested value up, None if there is none."""
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
