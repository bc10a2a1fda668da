"""The run directory: everything a run leaves behind, and the one way to find and read it.

::

    runs/<name>/<date_time>/
      config.yaml        resolved, plain YAML           overrides.txt   what was typed
      environment.json   versions, git state, device    split.json      ids of each subset
      status.json        running | finished | failed | interrupted
      train.log          metrics.csv  times.csv         checkpoints/best.ckpt, last.ckpt
      tensorboard/       images/                        test/<protocol>/metrics.json, per_image.csv, panels.png
      scored.json        each time that test images were looked at
"""

from __future__ import annotations

import json
import logging
import math
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.files import read_yaml, write_json, write_text

SCORED = "scored.json"
CHECKPOINTS = "checkpoints"
BEST, LAST = "best.ckpt", "last.ckpt"
PACKAGES = ("hudepth", "torch", "lightning", "torchmetrics", "hydra-core", "h5py", "numpy", "opencv-python-headless")


def create(parent: str | Path, name: str) -> Path:
    """Make ``<parent>/<name>/<date_time>``; a second run within the same second gets a number behind it.

    Raises:
        ConfigError: if the folder cannot be made.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    base = Path(parent).expanduser() / name
    for attempt in range(1, 1000):
        path = base / (stamp if attempt == 1 else f"{stamp}_{attempt}")
        try:
            path.mkdir(parents=True)
        except OSError as error:
            if isinstance(error, FileExistsError) and path.exists():  # a dangling link above it also "exists"
                continue
            raise ConfigError(
                f"paths.runs: cannot make '{path}' ({error.strerror}). Pass paths.runs=<a folder you can write to>."
            ) from error
        return path.resolve()
    raise ConfigError(f"paths.runs: '{base}' holds too many runs of this second.")


def note_scored(path: Path, *, epoch: int, data: str, split: str, protocols: Sequence[str]) -> list[int]:
    """Note that a run's network was scored on test images, and say how often that had happened before.

    A number that was chosen among several by looking at test images is no test any more, so each look is kept.

    Args:
        path: the run directory.
        epoch: of the checkpoint.
        data: name of the set.
        split: hash of the split.
        protocols: what it was scored by.

    Returns:
        The epochs of the other checkpoints of this run that were scored on the same test images before.

    Raises:
        OSError: if the note cannot be written.
    """
    looks = scored(path)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    write_json(
        path / SCORED,
        [*looks, {"time": now, "epoch": epoch, "data": data, "split": split, "protocols": list(protocols)}],
    )
    return sorted({look["epoch"] for look in looks if look["split"] == split and look["epoch"] != epoch})


def scored(path: Path) -> list[dict[str, Any]]:
    """Return each time that a run's network was scored on test images; none if nothing readable says so."""
    try:
        looks = json.loads((path / SCORED).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    keys = {"time", "epoch", "data", "split", "protocols"}
    return [look for look in looks if isinstance(look, dict) and keys <= look.keys()] if isinstance(looks, list) else []


def write_start(
    path: Path, *, config: Mapping[str, Any], overrides: Sequence[str], environment: Mapping[str, Any]
) -> None:
    """Write what is known before a run begins: config.yaml, overrides.txt, environment.json.

    Raises:
        ConfigError: if the folder cannot be written.
    """
    try:
        write_text(path / "config.yaml", yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
        write_text(path / "overrides.txt", "".join(f"{line}\n" for line in overrides))
        write_json(path / "environment.json", dict(environment))
    except OSError as error:
        raise ConfigError(
            f"'{path}' cannot be written ({error.strerror}). Pass paths.runs=<a folder you can write to>."
        ) from error


def write_resumed(path: Path, *, config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Write what a resumed run goes on with: config.yaml anew, overrides.txt with what was typed now below it.

    Raises:
        ConfigError: if the folder cannot be written.
    """
    try:
        typed = path / "overrides.txt"
        earlier = typed.read_text(encoding="utf-8") if typed.is_file() else ""
        write_text(path / "config.yaml", yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
        write_text(typed, earlier + "".join(f"{line}\n" for line in overrides))
    except OSError as error:
        raise ConfigError(f"'{path}' cannot be written ({error.strerror}), so the run cannot go on.") from error


def read_config(path: Path) -> dict[str, Any]:
    """Read a run's config.yaml as plain Python.

    Raises:
        CheckpointError: if there is none or it is damaged.
    """
    try:
        config = read_yaml(path / "config.yaml")
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        why = " ".join(str(error).split())
        raise CheckpointError(f"'{path}' is no run directory: its config.yaml cannot be read ({why}).") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"'{path}' is no run directory: its config.yaml holds no mapping.")
    return config


def write_status(path: Path, state: str, **more: Any) -> None:
    """Write status.json: ``running``, ``finished``, ``failed`` or ``interrupted``, with the time and whatever else.

    A number that is not finite becomes null, which JSON has a word for.
    """
    more = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in more.items()}
    now = datetime.now(UTC).isoformat(timespec="seconds")
    write_json(path / "status.json", {"state": state, "time": now, "pid": os.getpid(), **more})


class HeldError(ConfigError):
    """Another process works in a run directory."""


STATES = ("running", "finished", "failed", "interrupted", "pruned")
LOCK = ".lock"


@contextmanager
def held(path: Path, *, timeout_s: float = 0) -> Iterator[None]:
    """Keep every other process from working in a run directory while the block runs; a kill lets go of it.

    Args:
        path: the run directory.
        timeout_s: how long to wait for a process that is already at it.

    Raises:
        HeldError: if one still is.
        ConfigError: if the folder cannot be written.
    """
    lock = FileLock(path / LOCK)
    try:
        try:
            lock.acquire(timeout=min(timeout_s, 1))
        except Timeout:
            if timeout_s <= 1:
                raise
            log.info("waiting for process %s to leave '%s'", read_status(path).get("pid"), path)
            lock.acquire(timeout=timeout_s)
    except Timeout:
        by = read_status(path).get("pid", "unknown")
        raise HeldError(
            f"'{path}' is being worked on by another process (number {by}). Wait for it, or end it."
        ) from None
    except OSError as error:
        raise ConfigError(f"'{path}' cannot be written ({error.strerror}). Pass a folder you can write to.") from error
    try:
        yield
    finally:
        lock.release()


def state(path: Path) -> tuple[str, str]:
    """Return how a run stands, and the line of the error if it failed.

    Returns:
        One of :data:`STATES`; a run that says it is running but is held by no process was killed: ``interrupted``.
    """
    status = read_status(path)
    found = str(status.get("state"))
    if found not in STATES:
        return "interrupted", ""
    if found == "running":
        if not (path / LOCK).exists():  # nobody ever held it; a look should leave nothing behind
            return "interrupted", ""
        try:
            with held(path):
                return "interrupted", ""
        except (ConfigError, OSError):
            return "running", ""
    return found, str(status.get("error") or "")


def read_status(path: Path) -> dict[str, Any]:
    """Read status.json as it stands; empty if there is none or it is damaged."""
    try:
        status = json.loads((path / "status.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return status if isinstance(status, dict) else {}


@contextmanager
def logged_to(path: Path) -> Iterator[None]:
    """Also write hudepth's and Lightning's log lines to this file while the block runs."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    loggers = [log, logging.getLogger("lightning.pytorch")]
    for logger in loggers:
        logger.addHandler(handler)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
        handler.close()


def environment(*, seed: int, accelerator: str) -> dict[str, Any]:
    """Return what a reader needs to repeat a run: versions, git state, device, threads, seed."""
    import torch

    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        # torch says itself which build it is (+cpu, +cu130); its package's version need not
        "packages": {**{name: _version(name) for name in PACKAGES}, "torch": str(torch.__version__)},
        "git": _git(),
        "accelerator": accelerator,
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else _processor(),
        "threads": torch.get_num_threads(),
        "seed": seed,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None  # another build of it, for example opencv-python, or a source tree that was never installed


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")  # Linux names the model here only
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _git() -> dict[str, Any] | None:
    """Commit and dirty flag of the checkout this code runs from, None for an installed wheel."""
    here = Path(__file__).parent

    def ask(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(here), *words], capture_output=True, text=True, timeout=10, check=True
        ).stdout.strip()

    try:
        if not ask("ls-files", Path(__file__).name):
            return None  # a wheel inside somebody else's repository
        return {"commit": ask("rev-parse", "HEAD"), "dirty": bool(ask("status", "--porcelain"))}
    except (OSError, subprocess.SubprocessError):
        return None


def is_run(path: Path) -> bool:
    """Tell whether ``path`` is a run directory."""
    return (path / "config.yaml").is_file()


def newest_run(runs: str | Path) -> Path:
    """Return the run below ``runs`` that was written to last and has a checkpoint.

    Raises:
        CheckpointError: if there is none.
    """
    root = Path(runs).expanduser()
    found = [c.parent.parent for name in (BEST, LAST) for c in root.glob(f"*/*/{CHECKPOINTS}/{name}")]
    if not found:
        raise CheckpointError(
            f"checkpoint=last: no run with a checkpoint below '{root}'. Train one with hudepth-train, "
            "or pass checkpoint=<file or run directory>."
        )
    return max(found, key=lambda run: (run / CHECKPOINTS).stat().st_mtime_ns)


def run_of(checkpoint: Path) -> Path | None:
    """Return the run directory a checkpoint file lies in, or None for a file that was moved elsewhere."""
    run = checkpoint.parent.parent
    return run if checkpoint.parent.name == CHECKPOINTS and is_run(run) else None
