"""Sweeps: Hydra's sweeper that runs what is not finished yet, says how it goes, and loses nothing when a job fails.

Hydra parses and composes, its launchers (basic, joblib, submitit, ray) run the jobs; this says which jobs there are,
where each belongs, and what came of them.
"""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from hudepth.base.errors import ConfigError
from hudepth.base.machine import usable_cores
from hudepth.base.options import plain
from hudepth.base.wording import one_line
from hudepth.runs.status import FAILED, FINISHED, LOCK, PRUNED, read_state
from hudepth.runs.sweeps import read_jobs, write_jobs
from hudepth.sweep.jobs import Job, combine, compose, find_done
from hudepth.sweep.progress import Progress, say


class Sweep(Sweeper):
    """Runs the jobs of ``-m`` and of ``+sweep=<name>``.

    Args:
        params: key: comma-separated values.
        variants: name: overrides.
        search: how to search instead of trying all, if it has ``trials``; see :mod:`hudepth.sweep.search`.
    """

    def __init__(
        self,
        params: Mapping[str, Any] | None = None,
        variants: Mapping[str, Any] | None = None,
        search: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.params, self.search = dict(params or {}), plain_options(search or {})
        self.variants = {
            str(name): [str(each) for each in overrides or ()] for name, overrides in (variants or {}).items()
        }

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Take what Hydra gives."""
        self.context, self.task, self.master = hydra_context, task_function, config

    def sweep(self, arguments: list[str]) -> None:
        """Run all jobs that are not finished.

        Args:
            arguments: overrides as typed.

        Raises:
            HudepthError: if nothing can run, or after all, if a job failed.
        """
        self._check_slurm()
        folder = self._folder()
        parser = OverridesParser.create(config_loader=self.context.config_loader)
        typed = parser.parse_overrides(list(arguments))
        params = parser.parse_overrides([f"{key}={value}" for key, value in self.params.items()])
        if self.search.get("trials") is not None:
            from hudepth.sweep.search import search

            def run_jobs(jobs: Sequence[Job], batch: Sequence[Job]) -> None:
                self.record(jobs, folder)
                self.launch([job for job in batch if job.config is not None and not job.finished], folder)

            with _held(folder):
                search(
                    self.compose, run_jobs, folder, typed=typed, params=params, options=self.search,
                    mode=self.master.mode, monitor=str(self.master.monitor),
                    at_once=max(1, int(self.master.hydra.launcher.get("n_jobs") or 1)),
                )  # fmt: skip
            return
        jobs = self.compose(combine(typed, params, self.variants))
        if all(job.config is None for job in jobs):
            raise ConfigError(jobs[0].error + (f" (so with all {len(jobs)} jobs)" if len(jobs) > 1 else ""))
        with _held(folder):
            self.run(jobs, folder)

    def compose(self, jobs: Sequence[Job]) -> list[Job]:
        """Return the jobs with their configurations, see :func:`hudepth.sweep.jobs.compose`."""

        def how(overrides: list[str]) -> dict[str, Any]:
            config = self.context.config_loader.load_sweep_config(self.master, overrides)
            with open_dict(config):
                del config["hydra"]
            return plain(config)

        return compose(jobs, how, lambda error: one_line(error, "train"))

    def run(self, jobs: Sequence[Job], folder: Path) -> list[Job]:
        """Run those of the jobs that are not finished; say what came of them.

        Returns:
            The jobs, with their folders.

        Raises:
            ConfigError: after all, if a job failed, did not compose or did not end.
        """
        jobs = find_done(jobs, folder)
        left = [job for job in jobs if job.config is not None and not job.finished]
        self.record(jobs, folder)
        for job in jobs:
            if job.error:
                say(f"{job.name}: {job.error}")
        done = sum(job.finished for job in jobs)
        say(f"sweep {self.name}: {len(left)} of {len(jobs)} jobs to run" + (f", {done} finished before" * bool(done)))
        try:
            self.launch(left, folder)
        except BaseException:
            self._say_outcome(jobs, folder)
            raise
        failed, unfinished = self._say_outcome(jobs, folder)
        if failed:
            more = f"; {len(failed) - 3} more" if len(failed) > 3 else ""
            words = "; ".join(line.rstrip(".") for line in failed[:3])
            raise ConfigError(
                f"{len(failed)} of {len(jobs)} jobs failed: {words}{more}. See {_shown(folder)}/*/train.log."
            )
        if unfinished:
            raise ConfigError(
                f"{unfinished} of {len(jobs)} jobs did not end. Type the command above to go on with them."
            )
        return jobs

    def record(self, jobs: Sequence[Job], folder: Path) -> None:
        """Write the jobs to sweep.yaml."""
        write_jobs(folder, self.name, [_record(job) for job in jobs])

    def launch(self, jobs: Sequence[Job], folder: Path) -> None:
        """Launch jobs. Where a launcher gives up since one of its processes was killed, the rest is launched anew."""
        left, where = list(jobs), _quoted(folder)
        while left:
            with open_dict(self.master):
                self.master.hydra.sweep.dir = str(folder)
            launcher = self._launcher(len(left))
            start = time.time()
            commands = [
                [*job.overrides, f"hydra.sweep.dir={where}", f"hydra.sweep.subdir={job.folder}"] for job in left
            ]
            try:
                with Progress(left, folder, monitor=str(self.master.monitor)):
                    launcher.launch(commands, initial_job_idx=0)
                return
            except Exception as error:
                say(f"the launcher stopped: {one_line(error, 'train')}")
            begun = [job for job in left if _began(folder / job.folder, after=start)]
            if not begun:
                return
            left = [job for job in left if job not in begun]

    def _launcher(self, jobs: int) -> Launcher:
        from hydra.core.plugins import Plugins

        config, typed = self.master, list(self.master.hydra.overrides.hydra)
        if config.hydra.launcher.get("n_jobs") is not None:
            with open_dict(config):
                if not any(each.lstrip("+").startswith("hydra.launcher.n_jobs=") for each in typed):
                    config.hydra.launcher.n_jobs = usable_cores()
                if config.hydra.launcher.n_jobs > jobs:  # a core is not kept for a job that there is not
                    config.hydra.launcher.n_jobs = jobs
        launcher: Launcher = Plugins.instance().instantiate_launcher(
            hydra_context=self.context, task_function=self.task, config=config
        )
        return launcher

    def _check_slurm(self) -> None:
        target = str(self.master.hydra.launcher._target_)
        if target.endswith("SlurmLauncher") and shutil.which("srun") is None:
            raise ConfigError(
                "hydra/launcher: there is no SLURM here (no srun on the path). Run it on a cluster's login node, "
                "or pass hydra/launcher=submitit_local or joblib."
            )

    def _report_command(self, folder: Path) -> str:
        protocols = [name for name, protocol in (self.master.protocol or {}).items() if protocol]
        words = ["hudepth-report", "sweep", f"dir={_shown(folder)}"]
        words += [f"name={self.name}"] if len(read_jobs(folder)) > 1 else []
        words += [f"protocol={protocols[0]}"] if protocols and "eigen" not in protocols else []  # its default
        return shlex.join(words)

    @property
    def name(self) -> str:
        """As it was typed, else as its file in conf/sweep is called: an experiment beside it names the runs."""
        chosen = self.master.hydra.runtime.choices.get("sweep")
        typed = any(str(each).startswith("name=") for each in self.master.hydra.overrides.task)
        return str(self.master.name if typed or not chosen else chosen)

    def _folder(self) -> Path:
        typed = self.master.get("sweep_dir")
        stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        folder = Path(str(typed)) if typed else Path(str(self.master.paths.sweeps)) / self.name / stamp
        return folder.expanduser().resolve()

    def _say_outcome(self, jobs: Sequence[Job], folder: Path) -> tuple[list[str], int]:
        """Say what came of the jobs, and how to go on; return a line for each that failed, and how many did not end."""
        outcomes = [read_state(folder / job.folder) if job.config else (FAILED, job.error) for job in jobs]
        states = [state for state, _ in outcomes]
        count = {state: states.count(state) for state in (FINISHED, FAILED, PRUNED)}
        unfinished = len(jobs) - sum(count.values())
        words = [f"{number} {state}" for state, number in count.items() if number or state == FINISHED]
        words += [f"{unfinished} unfinished"] if unfinished else []
        say(f"sweep {self.name}: {', '.join(words)}; in {folder}")
        if self.master.test:
            say(f"table and plots: {self._report_command(folder)}")
        if unfinished or count[FAILED]:
            say(f"to go on: {_command(folder)}")
        failed = [f"{job.name}: {why}" for job, (state, why) in zip(jobs, outcomes, strict=True) if state == FAILED]
        return failed, unfinished


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a part of Hydra's configuration as plain Python."""
    return dict(OmegaConf.to_container(options, resolve=True) if OmegaConf.is_config(options) else options)  # type: ignore[arg-type]


def _record(job: Job) -> dict[str, Any]:
    return {"labels": dict(job.labels), **({"run": job.folder} if job.config is not None else {"error": job.error})}


def _began(run: Path, *, after: float) -> bool:
    status = run / "status.json"
    return status.is_file() and status.stat().st_mtime >= after


@contextmanager
def _held(folder: Path) -> Iterator[None]:
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


def _quoted(path: Path) -> str:
    """Return a path as a quoted value of an override."""
    text = str(path).replace("\\", "\\\\").replace("'", "\\'")
    return f"'{text}'"


def _shown(path: Path) -> str:
    """Return a path relative to here, if it lies here."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def _command(folder: Path) -> str:
    """Return the command that was typed, with the sweep's folder."""
    typed = [word for word in sys.argv[1:] if not word.startswith("sweep_dir=")]
    return shlex.join(["hudepth-train", *typed, f"sweep_dir={_shown(folder)}"])
