"""The folder of a sweep: runs that belong together, each identified by its configuration rather than by a number.

::

    <sweep_dir>/
      sweep.yaml         the jobs of each sweep that was run here, and what it varied
      <label>-<key>/     a run directory per job
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from hudepth.base.errors import DataError, HudepthError, did_you_mean
from hudepth.base.files import read_yaml, write_text
from hudepth.runs.run import Run

SWEEP_FILE = "sweep.yaml"
Jobs = dict[str, list[dict[str, Any]]]
"""Jobs by sweep: the ``labels`` of each, and either ``run`` (the name of its folder) or ``error`` (why it has none)."""


def folder_name(labels: Mapping[str, str], key: str) -> str:
    """Return a readable folder name for a job that is safe in shells and file systems."""
    words = [value if name == "variant" else f"{name.rpartition('.')[2]}-{value}" for name, value in labels.items()]
    text = re.sub(r"[^\w.+-]+", "-", "_".join(words)).strip("-._")
    return f"{text[:80]}-{key}" if text else key


@dataclass(frozen=True)
class Sweep:
    """The contents of a sweep's folder."""

    folder: Path
    runs: list[Run]
    """In the order of sweep.yaml; runs that it does not list last, by name."""
    uncomposed: list[tuple[dict[str, str], str]]
    """Jobs whose configuration could not be composed: labels and error."""
    notes: list[str]
    """One line for each folder that was skipped, with the reason."""


def read_sweep(folder: str | Path, *, name: str | None = None) -> Sweep:
    """Read a folder of sweeps, or the sweep ``name`` in it; folders that are not runs are skipped, with a note.

    Raises DataError if there is no such folder, run or sweep.
    """
    root = Path(folder).expanduser()
    if not root.is_dir():
        example = "sweeps/<name>/<date_time>"
        raise DataError(f"dir: no folder '{root}'. Pass dir=<folder of a sweep>, for example {example}.")
    notes: list[str] = []
    jobs = _select_jobs(root, name, notes)
    labels = {str(job["run"]): dict(job["labels"]) for job in reversed(jobs) if job.get("run")}
    order = list(dict.fromkeys(str(job["run"]) for job in jobs if job.get("run")))
    found = {path.name: path for path in sorted(root.iterdir()) if path.is_dir() and not path.name.startswith(".")}
    runs = []
    for run in [*order, *(other for other in found if other not in order and name is None)]:
        if run not in found:
            notes.append(f"'{run}' has not started: {SWEEP_FILE} lists it, but there is no such folder")
            continue
        try:
            runs.append(Run.read(found[run], labels=labels.get(run)))
        except HudepthError as error:
            notes.append(f"skipped: {error}")
    uncomposed = [(dict(job["labels"]), str(job.get("error", ""))) for job in jobs if not job.get("run")]
    if not runs and not uncomposed:
        others = f" ({len(found)} other folders lie in it)" if found else ""
        fix = f"Pass dir=<folder of a sweep>, whose folders are run directories{others}."
        raise DataError(f"dir: '{root}' holds no run. {fix}")
    return Sweep(root, runs, uncomposed, notes)


def _select_jobs(root: Path, name: str | None, notes: list[str]) -> list[dict[str, Any]]:
    """Return the jobs of one sweep, or of all; a damaged sweep.yaml becomes a note."""
    try:
        sweeps = read_jobs(root)
    except HudepthError as error:
        sweeps = {}
        notes.append(str(error))
    if name is not None and name not in sweeps:
        known = ", ".join(sweeps) or "none"
        raise DataError(f"name: no sweep '{name}' in '{root}'.{did_you_mean(name, sweeps)} It holds {known}.")
    return [job for key, each in sweeps.items() if name in (None, key) for job in each]


def read_jobs(folder: Path) -> Jobs:
    """Read sweep.yaml; empty if there is none. Raises DataError if it is damaged."""
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
        raise DataError(f"'{path}' cannot be read ({type(error).__name__}: {why}); labels are unknown") from error


def _outcome(job: Mapping[str, Any]) -> dict[str, str]:
    run = job.get("run")
    if run is None:
        return {"error": str(job.get("error", ""))}
    if Path(str(run)).name != str(run) or str(run).startswith("."):
        raise TypeError(f"'{run}' is not the name of a folder next to it")
    return {"run": str(run)}


def write_jobs(folder: Path, name: str, jobs: Sequence[Mapping[str, Any]]) -> None:
    """Add the jobs of a sweep to sweep.yaml; those listed stay, in their order, except failed ones tried again.

    Raises OSError if the file cannot be written.
    """
    try:
        sweeps = read_jobs(folder)
    except HudepthError:
        sweeps = {}
        (folder / SWEEP_FILE).rename(folder / f"{SWEEP_FILE}.damaged")  # never delete a user's file
    tried = [dict(job["labels"]) for job in jobs]
    kept = [job for job in sweeps.get(name, []) if "run" in job or job["labels"] not in tried]
    known = {job.get("run") for job in kept if "run" in job}
    sweeps[name] = [*kept, *(dict(job) for job in jobs if job.get("run") is None or job["run"] not in known)]
    write_text(folder / SWEEP_FILE, yaml.safe_dump({"sweeps": sweeps}, sort_keys=False, allow_unicode=True))
