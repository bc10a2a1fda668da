"""The progress of a sweep: a line whenever a job has finished an epoch, ended or failed.

It reads the run directories, so it works for jobs in this process, in others and on other machines.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from hudepth.base.console import duration, print_error
from hudepth.base.errors import DataError
from hudepth.runs import history
from hudepth.runs.status import FAILED, FINISHED, PRUNED, read_status
from hudepth.sweep.jobs import Job

EVERY_S = 0.5
"""How often the directories are read."""


class Progress:
    """Watches jobs in the folder of a sweep while they run, and shows the metric ``monitor``."""

    def __init__(self, jobs: Sequence[Job], folder: Path, *, monitor: str) -> None:
        self._jobs = {job: _Watched(folder / job.folder, job, monitor) for job in jobs}
        self._start = time.monotonic()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Progress:
        """Start watching."""
        self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        """Print what is new, and stop."""
        self._stop.set()
        self._thread.join()
        self._print_news()

    def _watch(self) -> None:
        while not self._stop.wait(EVERY_S):
            self._print_news()

    def _print_news(self) -> None:
        every = self._jobs.values()
        for number, (job, watched) in enumerate(self._jobs.items(), start=1):
            while news := watched.news():
                left = _left("; sweep: ", self._start, sum(e.done for e in every), sum(e.left for e in every))
                print_error(f"[{number}/{len(self._jobs)}] {job.name}: {news}{left}")


def _left(words: str, start: float, done: int, left: int) -> str:
    """Estimate the time that is left from the epochs since the start; empty if there are none."""
    each = (time.monotonic() - start) / done if done > 0 else 0
    return f"{words}{duration(each * left)} left" if done > 0 and left else ""


class _Watched:
    """What was last seen of a job."""

    def __init__(self, path: Path, job: Job, monitor: str) -> None:
        self.path, self.monitor = path, monitor
        config: Any = job.config
        self.epochs = int(config["trainer"].get("max_epochs") or 0)
        self._seen, self._metric = self._last_epoch()
        self._first, self._status = self._seen, read_status(path)
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
        """Return what happened since the last call, or an empty string."""
        epoch, metric = self._last_epoch()
        if epoch != self._seen:
            self._seen, self._metric = epoch, metric
            self._began = self._began or time.monotonic()
            return f"epoch {epoch} of {self.epochs}{metric}" + _left(", ", self._began, self.done, self.left)
        status = read_status(self.path)
        if status == self._status:
            return ""
        self._status, self._ended = status, status.get("state") in (FINISHED, FAILED, PRUNED)
        if self._ended:
            took = f" in {duration(time.monotonic() - self._began)}" if self._began else ""
            return f"{status['state']}{took}" + (f": {status['error']}" if status.get("error") else self._metric)
        self._began = self._began or time.monotonic()
        return ""

    def _last_epoch(self) -> tuple[int, str]:
        """Return the last epoch of metrics.csv and the words for its metric."""
        try:
            row = history.read_history(self.path / history.FILE)[-1]
        except DataError:
            return 0, ""
        return int(row["epoch"]), f", {self.monitor} {row[self.monitor]:.4f}" if self.monitor in row else ""
