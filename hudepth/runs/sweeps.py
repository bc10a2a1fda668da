"""A sweep: runs that belong together, in one folder, each known by what it is configured to do and not by a number.

::

    <sweep_dir>/
      sweep.yaml         which jobs each sweep that was run here consists of, and what was varied in them
      <label>-<key>/     a run directory for each job

Nothing here knows of Hydra: ``hudepth.sweep.sweeper`` makes sweeps, ``hudepth-report sweep`` reads them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from hudepth.base.errors import DataError, HudepthError, did_you_mean
from hudepth.base.files import read_yaml, write_text
from hudepth.runs import run_dir
from hudepth.runs.identity import run_key

SWEEP_FILE = "sweep.yaml"
SEEDS = ("seed", "data.seed")
"""Keys in which repetitions of one configuration differ. ``data.split_seed`` is not one: it makes another test set."""
FINISHED, FAILED, PRUNED, INTERRUPTED, RUNNING = "finished", "failed", "pruned", "interrupted", "running"


def folder_name(labels: Mapping[str, str], key: str) -> str:
    """Return a name for a job's folder that people can read and no shell or file system stumbles over."""
    words = [value if name == "variant" else f"{name.rpartition('.')[2]}-{value}" for name, value in labels.items()]
    text = re.sub(r"[^\w.+-]+", "-", "_".join(words)).strip("-._")
    return f"{text[:80]}-{key}" if text else key


@dataclass(frozen=True)
class SweepRun:
    """One run directory of a sweep."""

    path: Path
    config: dict[str, Any]
    """Nested, as in config.yaml."""
    state: str
    """``finished``, ``failed``, ``pruned``, ``interrupted`` (or killed) or ``running``."""
    error: str = ""
    """Of a failed run: the line that said why."""
    labels: dict[str, str] = field(default_factory=dict)
    """What was varied, as it was typed: ``{"variant": "l1", "seed": "1"}``; empty for a run that sweep.yaml does not
    know."""

    @property
    def key(self) -> str:
        """See :func:`hudepth.runs.identity.run_key`."""
        return run_key(self.config)


@dataclass(frozen=True)
class Sweep:
    """What a sweep's folder holds."""

    folder: Path
    runs: list[SweepRun]
    """In the order of sweep.yaml; runs it does not know last, by name."""
    uncomposed: list[tuple[dict[str, str], str]]
    """Jobs that never became a run, since their configuration could not be composed: labels and why."""
    notes: list[str]
    """One line for each thing in the folder that was left alone, and why."""


def read_sweep(folder: str | Path, *, name: str | None = None) -> Sweep:
    """Read what a sweep's folder holds; whatever is no run is noted and left alone.

    Any folder of run directories will do, also one without a sweep.yaml.

    Args:
        folder: the sweep's.
        name: of one of the sweeps that were run into it; default: all.

    Raises:
        DataError: if there is no such folder or no run in it, or if no sweep has this name.
    """
    root = Path(folder).expanduser()
    if not root.is_dir():
        raise DataError(
            f"dir: no folder '{root}'. Pass dir=<folder of a sweep>, for example sweeps/<name>/<date_time>."
        )
    notes: list[str] = []
    try:
        sweeps = read_jobs(root)
    except HudepthError as error:
        sweeps = {}
        notes.append(str(error))
    if name is not None and name not in sweeps:
        known = ", ".join(sweeps) or "none"
        raise DataError(f"name: no sweep '{name}' in '{root}'.{did_you_mean(name, sweeps)} It holds {known}.")
    jobs = [job for key, each in sweeps.items() if name in (None, key) for job in each]
    labels = {str(job["run"]): dict(job["labels"]) for job in reversed(jobs) if job.get("run")}
    order = list(dict.fromkeys(str(job["run"]) for job in jobs if job.get("run")))
    found = {path.name: path for path in sorted(root.iterdir()) if path.is_dir() and not path.name.startswith(".")}
    runs = []
    for run in [*order, *(other for other in found if other not in order and name is None)]:
        if run not in found:
            notes.append(f"'{run}' has not begun: {SWEEP_FILE} names it, and there is no such folder")
            continue
        try:
            runs.append(read_run(found[run], labels=labels.get(run, {})))
        except HudepthError as error:
            notes.append(f"left alone: {error}")
    uncomposed = [(dict(job["labels"]), str(job.get("error", ""))) for job in jobs if not job.get("run")]
    if not runs and not uncomposed:
        raise DataError(
            f"dir: '{root}' holds no run. Pass dir=<folder of a sweep>, whose folders are run directories"
            + (f" ({len(found)} other folders lie in it)." if found else ".")
        )
    return Sweep(root, runs, uncomposed, notes)


def read_run(path: Path, *, labels: Mapping[str, str] | None = None) -> SweepRun:
    """Read one run directory of a sweep.

    Raises:
        HudepthError: if it is none.
    """
    config = run_dir.read_config(path)
    lacking = [part for part in ("seed", "data", "model", "loss") if part not in config]
    if lacking:
        raise DataError(f"'{path}' is no run of hudepth-train: its config.yaml has no '{lacking[0]}'")
    state, error = run_dir.state(path)
    return SweepRun(path, config, state, error, dict(labels or {}))


Jobs = dict[str, list[dict[str, Any]]]
"""By sweep: for each job its ``labels`` and either the name of its ``run``'s folder or the ``error`` that kept it from
becoming one."""


def read_jobs(folder: Path) -> Jobs:
    """Read sweep.yaml; empty if there is none.

    Raises:
        DataError: if it is damaged.
    """
    path = folder / SWEEP_FILE
    if not path.is_file():
        return {}
    try:
        sweeps = read_yaml(path)["sweeps"]
        return {
            str(name): [{"labels": {str(k): str(v) for k, v in job["labels"].items()}, **_outcome(job)} for job in each]
            for name, each in sweeps.items()
        }
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        why = " ".join(str(error).split())
        raise DataError(
            f"'{path}' cannot be read ({type(error).__name__}: {why}); what was varied is not known"
        ) from error


def _outcome(job: Mapping[str, Any]) -> dict[str, str]:
    run = job.get("run")
    if run is None:
        return {"error": str(job.get("error", ""))}
    if Path(str(run)).name != str(run) or str(run).startswith("."):
        raise TypeError(f"'{run}' is no folder beside it")
    return {"run": str(run)}


def write_jobs(folder: Path, name: str, jobs: Sequence[Mapping[str, Any]]) -> None:
    """Add the jobs of a sweep to sweep.yaml; what it already knows stays, in its order.

    A job that could not be composed is replaced when it is tried again.

    Raises:
        OSError: if the file cannot be written.
    """
    try:
        sweeps = read_jobs(folder)
    except HudepthError:
        sweeps = {}
        (folder / SWEEP_FILE).rename(folder / f"{SWEEP_FILE}.damaged")  # nothing of the user's is deleted
    tried = [dict(job["labels"]) for job in jobs]
    kept = [job for job in sweeps.get(name, []) if "run" in job or job["labels"] not in tried]
    known = {job.get("run") for job in kept if "run" in job}
    sweeps[name] = [*kept, *(dict(job) for job in jobs if job.get("run") is None or job["run"] not in known)]
    write_text(folder / SWEEP_FILE, yaml.safe_dump({"sweeps": sweeps}, sort_keys=False, allow_unicode=True))
