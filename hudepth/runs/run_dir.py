"""Writing a run directory; :mod:`hudepth.runs.run` reads it.

::

    runs/<name>/<date_time>/
      config.yaml        resolved, plain YAML           overrides.txt   the command-line overrides
      environment.json   versions, git state, device    split.json      ids of each subset
      status.json        running | finished | failed | interrupted
      train.log          metrics.csv  times.csv         checkpoints/best.ckpt, last.ckpt
      tensorboard/  csv/  wandb/  loggers.json          images/
      test/<protocol>/metrics.json, per_image.csv, panels.png
      scored.json        each evaluation on test images
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.files import read_json, read_text, write_json, write_text

SCORED = "scored.json"


def create(parent: str | Path, name: str) -> Path:
    """Make ``<parent>/<name>/<date_time>``, with a number appended if it exists. Raises ConfigError if it cannot."""
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    base = Path(parent).expanduser() / name
    for attempt in range(1, 1000):
        path = base / (stamp if attempt == 1 else f"{stamp}_{attempt}")
        try:
            path.mkdir(parents=True)
        except OSError as error:
            if isinstance(error, FileExistsError) and path.exists():  # a dangling link above it also "exists"
                continue
            fix = "Pass paths.runs=<a folder you can write to>."
            raise ConfigError(f"paths.runs: cannot make '{path}' ({error.strerror}). {fix}") from error
        return path.resolve()
    raise ConfigError(f"paths.runs: '{base}' has too many runs of this second. Start again.")


def write_start(
    run: Path, *, config: Mapping[str, Any], overrides: Sequence[str], environment: Mapping[str, Any]
) -> None:
    """Write config.yaml, overrides.txt and environment.json. Raises ConfigError if the folder cannot be written."""
    try:
        _write_config(run, config, overrides)
        write_json(run / "environment.json", dict(environment))
    except OSError as error:
        fix = "Pass paths.runs=<a folder you can write to>."
        raise ConfigError(f"'{run}' cannot be written ({error.strerror}). {fix}") from error


def write_resumed(run: Path, *, config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Write config.yaml again and append to overrides.txt. Raises ConfigError if the folder cannot be written."""
    file = run / "overrides.txt"
    try:
        earlier = read_text(file).splitlines() if file.is_file() else []
        _write_config(run, config, [*earlier, *overrides])
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"'{run}' cannot be written ({why}), so the run cannot be resumed.") from error


def _write_config(run: Path, config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    write_text(run / "config.yaml", yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
    lines = "".join(f"{line}\n" for line in overrides)  # of which paths may hold bytes that are not UTF-8
    write_text(run / "overrides.txt", lines.encode(errors="backslashreplace").decode())


class _LogFile(logging.FileHandler):
    """A log file that gives up at the first line it cannot write: on a full disk, say."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Warn once."""
        self.setLevel(logging.CRITICAL + 1)
        log.warning("'%s' cannot be written (%s)", self.baseFilename, sys.exception())

    def close(self) -> None:
        """Close the file, whether or not its last lines can be written."""
        with suppress(OSError):
            super().close()


@contextmanager
def log_to_file(path: Path) -> Iterator[None]:
    """Also write hudepth's and Lightning's log lines to a file during the block."""
    handler = _LogFile(path, encoding="utf-8")
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


def note_scored(run: Path, *, epoch: int, data: str, split: str, protocols: Sequence[str]) -> list[int]:
    """Record in scored.json that a run's network was evaluated on the test images of a split, given by its hash.

    Choosing among several results on test images makes the best one biased, so every evaluation is recorded. Returns
    the epochs of the run's other checkpoints that were evaluated on these images before. Raises OSError.
    """
    earlier = read_scored(run)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    entry = {"time": now, "epoch": epoch, "data": data, "split": split, "protocols": list(protocols)}
    write_json(run / SCORED, [*earlier, entry])
    return sorted({each["epoch"] for each in earlier if each["split"] == split and each["epoch"] != epoch})


def read_scored(run: Path) -> list[dict[str, Any]]:
    """Return the recorded evaluations of a run on test images; empty if scored.json is missing or damaged."""
    try:
        entries = read_json(run / SCORED)
    except (OSError, ValueError):
        return []
    keys = {"time", "epoch", "data", "split", "protocols"}
    whole = [e for e in entries if isinstance(e, dict) and keys <= e.keys()] if isinstance(entries, list) else []
    return [e for e in whole if isinstance(e["epoch"], int) and not isinstance(e["epoch"], bool)]
