"""How a sweep goes: a line whenever a job has finished an epoch, ended or failed, whatever runs the jobs.

It reads what runs leave in their directories, so it works for jobs in this process, in others and on other machines.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from hudepth.base.console import duration
from hudepth.base.errors import HudepthError
from hudepth.runs.history import read_history
from hudepth.runs.status import FAILED, FINISHED, PRUNED, read_status
from hudepth.sweep.jobs import Job

EVERY_S = 0.5
"""How often the directories are looked at."""


def say(line: str) -> None:
    """Print a line of the sweep; not to the log, which may be a job's."""
    print(line, file=sys.stderr, flush=True)


class Progress:
    """Watches jobs while they run.

    Args:
        jobs: that are launched now.
        folder: of the sweep.
        monitor: the metric to show.
    """

    def __init__(self, jobs: Sequence[Job], folder: Path, *, monitor: str) -> None:
        self._jobs = {job: _Watched(folder / job.folder, job, monitor) for job in jobs}
        self._start = time.monotonic()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Progress:
        """Begin to watch."""
        self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        """Look a last time, and stop."""
        self._stop.set()
        self._thread.join()
        self._look()

    def _watch(self) -> None:
        while not self._stop.wait(EVERY_S):
            self._look()

    def _look(self) -> None:
        for number, (job, watched) in enumerate(self._jobs.items(), start=1):
            while news := watched.news():
                say(f"[{number}/{len(self._jobs)}] {job.name}: {news}{self._left()}")

    def _left(self) -> str:
        """Estimate the time that all jobs still need, from the epochs they have finished since the start."""
        each = list(self._jobs.values())
        done, left = sum(job.done for job in each), sum(job.left for job in each)
        if not done or not left:
            return ""
        return f"; sweep: {duration((time.monotonic() - self._start) / done * left)} left"


class _Watched:
    """One job: what was last seen of it."""

    def __init__(self, path: Path, job: Job, monitor: str) -> None:
        self.path, self.monitor = path, monitor
        config: Any = job.config
        self.epochs = int(config["trainer"].get("max_epochs") or 0)
        self._stamps = {name: self._stamp(name) for name in ("metrics.csv", "status.json")}
        self._seen, self._metric = self._last_epoch()
        self._first = self._seen
        self._began: float | None = None
        self._ended = False

    @property
    def done(self) -> int:
        """Epochs since the start."""
        return (self.epochs if self._ended else self._seen) - self._first

    @property
    def left(self) -> int:
        """Epochs to go."""
        return 0 if self._ended else max(0, self.epochs - self._seen)

    def news(self) -> str:
        """Return what happened since the last look, or nothing."""
        if self._changed("metrics.csv"):
            epoch, metric = self._last_epoch()
            if epoch != self._seen:
                self._seen, self._metric = epoch, metric
                self._began = self._began or time.monotonic()
                return f"epoch {epoch} of {self.epochs}{metric}{self._time_left()}"
        if self._changed("status.json"):
            status = read_status(self.path)
            self._ended = status.get("state") in (FINISHED, FAILED, PRUNED)
            if self._ended:
                took = f" in {duration(time.monotonic() - self._began)}" if self._began else ""
                return f"{status['state']}{took}" + (f": {status['error']}" if status.get("error") else self._metric)
            self._began = self._began or time.monotonic()
        return ""

    def _time_left(self) -> str:
        done = self._seen - self._first
        if self._began is None or done < 1 or not self.left:
            return ""
        return f", {duration((time.monotonic() - self._began) / done * self.left)} left"

    def _changed(self, name: str) -> bool:
        before, self._stamps[name] = self._stamps[name], self._stamp(name)
        return self._stamps[name] != before

    def _stamp(self, name: str) -> int:
        try:
            return (self.path / name).stat().st_mtime_ns
        except OSError:
            return 0

    def _last_epoch(self) -> tuple[int, str]:
        """Return the last epoch of metrics.csv and the words for its metric."""
        try:
            row = read_history(self.path / "metrics.csv")[-1]
        except HudepthError:
            return 0, ""
        metric = f", {self.monitor} {row[self.monitor]:.4f}" if self.monitor in row else ""
        return int(row["epoch"]), metric
