"""Hydra's sweeper for hudepth: runs the jobs that are not finished, and survives those that fail.

Hydra's launchers (basic, joblib, submitit, ray) run the jobs; this module decides which there are, and reports.
"""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from hudepth.base.console import print_error
from hudepth.base.errors import ConfigError
from hudepth.base.machine import usable_cores
from hudepth.base.options import parse, plain
from hudepth.base.wording import one_line
from hudepth.runs.status import FAILED, FINISHED, LOCK, PRUNED, read_state
from hudepth.runs.sweeps import read_jobs, write_jobs
from hudepth.sweep.jobs import Job, combine, compose, find_done, merge_overrides
from hudepth.sweep.progress import Progress

Part = Mapping[str, Any] | None


class Sweep(Sweeper):
    """Runs the jobs of ``-m`` and of ``+sweep=<name>``.

    ``params`` map keys to comma-separated values, ``variants`` names to overrides; ``search`` replaces all combinations
    by a search, see :class:`hudepth.sweep.search.SearchOptions`.
    """

    def __init__(self, params: Part = None, variants: Part = None, search: Part = None) -> None:
        super().__init__()
        self.params, self.search = dict(params or {}), dict(search or {})
        self.variants = {str(name): list(map(str, each or ())) for name, each in (variants or {}).items()}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Store what Hydra provides."""
        self.context, self.task, self.master = hydra_context, task_function, config

    def sweep(self, arguments: list[str]) -> None:
        """Run all jobs that are not finished; raise HudepthError if none can, or at the end, if one failed."""
        from hudepth.sweep.search import SearchOptions, search  # imports torch, which trainings without -m do later

        self._check_slurm()
        folder = self._folder()
        parser = OverridesParser.create(config_loader=self.context.config_loader)
        typed = parser.parse_overrides(list(arguments))
        params = parser.parse_overrides([f"{key}={value}" for key, value in self.params.items()])
        overrides = merge_overrides(typed, params)
        options = parse(SearchOptions, self.search, prefix="hydra.sweeper.search.", strict=True)
        if options.trials is not None:
            with _lock_sweep(folder):
                search(
                    self.compose, lambda jobs, batch: self.run_batch(jobs, batch, folder), folder, overrides=overrides,
                    options=options, mode=self.master.mode, monitor=str(self.master.monitor),
                    at_once=max(1, int(self.master.hydra.launcher.get("n_jobs") or 1)),
                )  # fmt: skip
            return
        jobs = self.compose(combine(overrides, self.variants))
        if all(job.config is None for job in jobs):
            raise ConfigError(jobs[0].error + (f" (all {len(jobs)} jobs fail like this)" if len(jobs) > 1 else ""))
        with _lock_sweep(folder):
            self.run(jobs, folder)

    def compose(self, jobs: Sequence[Job]) -> list[Job]:
        """Return the jobs with their configurations, see :func:`hudepth.sweep.jobs.compose`."""

        def compose_one(overrides: list[str]) -> dict[str, Any]:
            config = self.context.config_loader.load_sweep_config(self.master, overrides)
            with open_dict(config):
                del config["hydra"]
            return plain(config)

        return compose(jobs, compose_one, lambda error: one_line(error, "train"))

    def run(self, jobs: Sequence[Job], folder: Path) -> None:
        """Run the jobs that are not finished; report the outcome; raise ConfigError if a job failed or did not end."""
        jobs = find_done(jobs, folder)
        done, left = sum(job.finished for job in jobs), sum(job.is_open for job in jobs)
        for job in jobs:
            if job.error:
                print_error(f"{job.name}: {job.error}")
        ready = f", {done} already finished" * bool(done)
        print_error(f"sweep {self.name}: {left} of {len(jobs)} jobs to run{ready}")
        try:
            self.run_batch(jobs, jobs, folder)
        except BaseException:
            self._report(jobs, folder)
            raise
        failed, unfinished = self._report(jobs, folder)
        if failed:
            more = f"; {len(failed) - 3} more" if len(failed) > 3 else ""
            errors = "; ".join(line.rstrip(".") for line in failed[:3])
            logs = f"{_format_path(folder)}/*/train.log"
            raise ConfigError(f"{len(failed)} of {len(jobs)} jobs failed: {errors}{more}. See {logs}.")
        if unfinished:
            raise ConfigError(f"{unfinished} of {len(jobs)} jobs did not end. Resume them with the command above.")

    def run_batch(self, jobs: Sequence[Job], batch: Sequence[Job], folder: Path) -> None:
        """Write all jobs to sweep.yaml, then launch those of a batch that are not finished.

        If a launcher gives up since one of its processes was killed, the jobs that had not begun are launched again.
        """
        write_jobs(folder, self.name, [job.record() for job in jobs])
        left = [job for job in batch if job.is_open]
        with open_dict(self.master):
            self.master.hydra.sweep.dir = str(folder)
        place = str(folder).replace("\\", "\\\\").replace("'", "\\'")
        while left:
            launcher, start = self._launcher(len(left)), time.time()
            folders = [[f"hydra.sweep.dir='{place}'", f"hydra.sweep.subdir={job.folder}"] for job in left]
            commands = [[*job.overrides, *own] for job, own in zip(left, folders, strict=True)]
            try:
                with Progress(left, folder, monitor=str(self.master.monitor)):
                    launcher.launch(commands, initial_job_idx=0)
                return
            except Exception as error:
                print_error(f"the launcher stopped: {one_line(error, 'train')}")
            status = {job: folder / job.folder / "status.json" for job in left}
            waiting = [job for job, file in status.items() if not file.is_file() or file.stat().st_mtime < start]
            if len(waiting) == len(left):
                return
            left = waiting

    def _launcher(self, jobs: int) -> Launcher:
        config, overrides = self.master, list(self.master.hydra.overrides.hydra)
        if config.hydra.launcher.get("n_jobs") is not None:
            with open_dict(config):
                if not any(each.lstrip("+").startswith("hydra.launcher.n_jobs=") for each in overrides):
                    config.hydra.launcher.n_jobs = usable_cores()
                if config.hydra.launcher.n_jobs > jobs:  # each job gets its share of the cores
                    config.hydra.launcher.n_jobs = jobs
        launcher: Launcher = Plugins.instance().instantiate_launcher(
            hydra_context=self.context, task_function=self.task, config=config
        )
        return launcher

    def _check_slurm(self) -> None:
        target = str(self.master.hydra.launcher._target_)
        if target.endswith("SlurmLauncher") and shutil.which("srun") is None:
            raise ConfigError(
                "hydra/launcher: there is no SLURM here (srun not found). Run this on a cluster's login node, "
                "or pass hydra/launcher=submitit_local or joblib."
            )

    def _report_command(self, folder: Path) -> str:
        protocols = [name for name, protocol in (self.master.protocol or {}).items() if protocol]
        words = ["hudepth-report", "sweep", f"dir={_format_path(folder)}"]
        words += [f"name={self.name}"] if len(read_jobs(folder)) > 1 else []
        words += [f"protocol={protocols[0]}"] if protocols and "eigen" not in protocols else []  # its default
        return shlex.join(words)

    @property
    def name(self) -> str:
        """The name from the command line, else that of the file in conf/sweep; ``name`` in a file names runs only."""
        chosen = self.master.hydra.runtime.choices.get("sweep")
        typed = any(str(each).startswith("name=") for each in self.master.hydra.overrides.task)
        return str(self.master.name if typed or not chosen else chosen)

    def _folder(self) -> Path:
        stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        folder = self.master.get("sweep_dir") or Path(str(self.master.paths.sweeps)) / self.name / stamp
        return Path(str(folder)).expanduser().resolve()

    def _report(self, jobs: Sequence[Job], folder: Path) -> tuple[list[str], int]:
        """Print the outcome and how to resume; return a line for each failed job, and how many did not end."""
        outcomes = [read_state(folder / job.folder) if job.config else (FAILED, job.error) for job in jobs]
        count = Counter(state for state, _ in outcomes)
        unfinished = len(jobs) - count[FINISHED] - count[FAILED] - count[PRUNED]
        words = [f"{count[state]} {state}" for state in (FINISHED, FAILED, PRUNED) if count[state] or state == FINISHED]
        words += [f"{unfinished} unfinished"] if unfinished else []
        print_error(f"sweep {self.name}: {', '.join(words)}; in {folder}")
        if self.master.test:
            print_error(f"table and plots: {self._report_command(folder)}")
        if unfinished or count[FAILED]:
            typed = [word for word in sys.argv[1:] if not word.startswith("sweep_dir=")]
            print_error("to resume: " + shlex.join(["hudepth-train", *typed, f"sweep_dir={_format_path(folder)}"]))
        failed = [f"{job.name}: {why}" for job, (state, why) in zip(jobs, outcomes, strict=True) if state == FAILED]
        return failed, unfinished


@contextmanager
def _lock_sweep(folder: Path) -> Iterator[None]:
    """Keep a second command from running the same sweep at the same time."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK)
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigError(
            f"sweep_dir: another process is running the sweep in '{folder}'. Wait for it, or end it."
        ) from None
    except OSError as error:
        raise ConfigError(
            f"sweep_dir: cannot write to '{folder}' ({error.strerror}). Pass sweep_dir=<a folder you can write to>."
        ) from error
    try:
        yield
    finally:
        lock.release()


def _format_path(path: Path) -> str:
    """Return a path relative to the current directory if it lies below it."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
