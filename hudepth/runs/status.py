"""The state of a run, and the lock that keeps two processes from working in one run directory."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.files import read_json, remove_leftovers, write_json

FINISHED, FAILED, PRUNED, INTERRUPTED, RUNNING = "finished", "failed", "pruned", "interrupted", "running"
LOCK = ".lock"


class LockedError(ConfigError):
    """Another process works in the run directory."""


def write_status(run: Path, state: str, **more: Any) -> None:
    """Write status.json: a state such as ``finished``, the time, and ``more``; numbers that are not finite as null."""
    more = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in more.items()}
    now = datetime.now(UTC).isoformat(timespec="seconds")
    status = {"state": state, "time": now, "pid": os.getpid(), **more}
    file = run / "status.json"
    try:
        write_json(file, status)
    except OSError:
        if not file.is_file():
            raise
        with file.open("r+", encoding="utf-8") as old:  # a full disk has no room for a new file, but that of the old
            old.write(json.dumps(status))
            old.truncate()


def read_status(run: Path) -> dict[str, Any]:
    """Read status.json as it is; empty if it is missing or damaged."""
    try:
        status = read_json(run / "status.json")
    except (OSError, ValueError):
        return {}
    return status if isinstance(status, dict) else {}


def read_state(run: Path) -> tuple[str, str]:
    """Return the state of a run, and its error message; one that is ``running`` but not locked is ``interrupted``."""
    status = read_status(run)
    state = str(status.get("state"))
    if state == RUNNING and _is_locked(run):
        return RUNNING, ""
    if state not in (FINISHED, FAILED, PRUNED):
        return INTERRUPTED, ""
    return state, str(status.get("error") or "")


def _is_locked(run: Path) -> bool:
    if not (run / LOCK).exists():  # never locked; looking must not leave a file behind
        return False
    try:
        with lock_run(run):
            return False
    except (ConfigError, OSError):
        return True


@contextmanager
def lock_run(run: Path, *, timeout_s: float = 0) -> Iterator[None]:
    """Keep other processes from working in a run directory during the block; a killed process releases its lock.

    Raises LockedError if another process holds it after ``timeout_s``; ConfigError if the folder cannot be written.
    """
    lock = FileLock(run / LOCK)
    try:
        try:
            lock.acquire(timeout=min(timeout_s, 1))
        except Timeout:
            if timeout_s <= 1:
                raise
            log.info("waiting for process %s to leave '%s'", read_status(run).get("pid"), run)
            lock.acquire(timeout=timeout_s)
    except Timeout:
        pid = read_status(run).get("pid", "unknown")
        raise LockedError(f"'{run}' is in use by another process (pid {pid}). Wait for it, or end it.") from None
    except OSError as error:
        raise ConfigError(f"'{run}' cannot be written ({error.strerror}). Pass a folder you can write to.") from error
    try:
        remove_leftovers(run)
        yield
    finally:
        lock.release()
