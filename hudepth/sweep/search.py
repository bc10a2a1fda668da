"""A search over configurations with optuna: each trial is a run of the sweep, and the study a file beside the runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.base.options import whole_number
from hudepth.runs.status import FINISHED, PRUNED, read_state, read_status
from hudepth.sweep.jobs import Job, find_done
from hudepth.sweep.progress import say
from hudepth.training.study import TRIAL_ENV, import_optuna, open_study

if TYPE_CHECKING:
    import optuna


STUDY_FILE = "study.log"
OPTIONS = ("trials", "sampler", "seed", "startup_trials", "prune", "warmup_epochs")
"""Keys of ``hydra.sweeper.search``; conf/hydra/sweeper/hudepth.yaml says what they are."""


def search(
    compose: Callable[[Sequence[Job]], list[Job]],
    run_jobs: Callable[[Sequence[Job], Sequence[Job]], None],
    folder: Path,
    *,
    typed: Sequence[Override],
    params: Sequence[Override],
    options: Mapping[str, Any],
    mode: str,
    monitor: str,
    at_once: int,
) -> None:
    """Run trials until there are as many as asked for; trials that were killed go on first.

    Args:
        compose: returns jobs with their configurations.
        run_jobs: records all jobs so far, then runs the unfinished ones of the second argument.
        folder: of the sweep; the study lies in it.
        typed: overrides on the command line.
        params: overrides of the sweep's file.
        options: see :data:`OPTIONS`.
        mode: ``min`` or ``max``: which way ``monitor`` is better.
        monitor: the metric searched by.
        at_once: trials to run side by side.

    Raises:
        ConfigError: if optuna is not installed, an option is unknown, nothing is searched over, or all trials failed.
    """
    check_options(options)
    mine = {override.key_or_group for override in typed}
    every = [*(override for override in params if override.key_or_group not in mine), *typed]
    constants = [str(override.input_line) for override in every if not override.is_sweep_override()]
    space = {override.get_key_element(): distribution(override) for override in every if override.is_sweep_override()}
    if not space:
        raise ConfigError("search: nothing to search over. Give a key a range, as in 'loss.boundary=interval(0.3,30)'.")
    direction = "minimize" if mode == "min" else "maximize"
    study = open_study(str(folder / STUDY_FILE), options, direction=direction)
    jobs: list[Job] = []
    while trials := _next_trials(study, space, at_once, int(options["trials"])):
        batch = [_job(trial, constants, folder) for trial in trials]
        batch = find_done(compose(batch), folder)
        if all(job.config is None for job in batch) and not jobs:
            raise ConfigError(batch[0].error)
        run_jobs([*jobs, *batch], batch)
        open_ = [job.name for job in batch if not _tell(study, job, folder)]
        if open_:  # a launcher lost its process; to try again at once could go on for ever
            raise ConfigError(f"search: {open_[0]} did not end. Give sweep_dir={folder} again to go on with it.")
        jobs += batch
    _say_best(study, folder, monitor=monitor)


def check_options(options: Mapping[str, Any]) -> None:
    """Check the options of a search.

    Raises:
        ConfigError: for an unknown key or a value out of range.
    """
    for key in options:
        if key not in OPTIONS:
            raise ConfigError(
                f"hydra.sweeper.search: no '{key}'.{did_you_mean(key, OPTIONS)} It takes {', '.join(OPTIONS)}."
            )
    for key, least in (("trials", 1), ("seed", 0), ("startup_trials", 0), ("warmup_epochs", 0)):
        whole_number(options, key, default=least, least=least)
    if options["sampler"] not in ("tpe", "random"):
        raise ConfigError(f"hydra.sweeper.search.sampler: no '{options['sampler']}'. Pass tpe or random.")


def distribution(override: Override) -> Any:
    """Return the optuna distribution for an override like ``loss.boundary=tag(log,interval(0.3,30))``.

    Raises:
        ConfigError: if it is no range that optuna knows.
    """
    optuna_ = import_optuna()
    value = override.value()
    log = "log" in getattr(value, "tags", ())
    try:
        if isinstance(value, IntervalSweep):
            low, high = float(value.start or 0), float(value.end or 0)
            return optuna_.distributions.FloatDistribution(low, high, log=log)
        if isinstance(value, RangeSweep):
            start, stop, step = value.start or 0, value.stop or 0, value.step  # which, like Python's, ends before stop
            if isinstance(start, int) and isinstance(stop, int) and isinstance(step, int):
                last = stop - 1 - (stop - 1 - start) % step
                return optuna_.distributions.IntDistribution(start, last, step=1 if log else step, log=log)
            steps = math.ceil((stop - start) / step) - 1
            return optuna_.distributions.FloatDistribution(float(start), start + steps * step, step=float(step))
        if isinstance(value, ChoiceSweep):
            return optuna_.distributions.CategoricalDistribution(list(override.sweep_string_iterator()))
    except ValueError as error:
        raise ConfigError(f"'{override.input_line}': {error}") from error
    raise ConfigError(f"'{override.input_line}': pass interval(low,high), range(first,end,step) or choice(a,b).")


def _next_trials(
    study: optuna.study.Study, space: Mapping[str, Any], at_once: int, wanted: int
) -> list[optuna.trial.Trial]:
    """Return the trials to run now: those that were killed, or new ones while there are fewer than wanted."""
    optuna_ = import_optuna()
    every = study.get_trials(deepcopy=False)
    killed = [each for each in every if each.state == optuna_.trial.TrialState.RUNNING]
    if killed:
        return [optuna_.trial.Trial(study, each._trial_id) for each in killed]
    return [study.ask(dict(space)) for _ in range(min(at_once, wanted - len(every)))]


def _job(trial: optuna.trial.Trial, constants: Sequence[str], folder: Path) -> Job:
    labels = {key.lstrip("+~"): _spelt(value) for key, value in trial.params.items()}
    overrides = [*constants, *(f"{key}={_spelt(value)}" for key, value in trial.params.items())]
    env = f"'{trial.number}:{folder / STUDY_FILE}'"
    return Job((*overrides, f"+hydra.job.env_set.{TRIAL_ENV}={env}"), {"trial": str(trial.number), **labels})


def _spelt(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _tell(study: optuna.study.Study, job: Job, folder: Path) -> bool:
    """Tell the study what came of a trial, and return whether anything did; one that was interrupted stays open."""
    optuna_ = import_optuna()
    state = read_state(folder / job.folder)[0] if job.config is not None else "failed"
    number, best = int(job.labels["trial"]), read_status(folder / job.folder).get("best")
    if state == FINISHED and isinstance(best, int | float):
        study.tell(number, float(best))
    elif state == PRUNED:
        study.tell(number, state=optuna_.trial.TrialState.PRUNED)
    elif state in ("failed", FINISHED):  # finished with a metric that is not finite
        study.tell(number, state=optuna_.trial.TrialState.FAIL)
    else:
        return False
    return True


def _say_best(study: optuna.study.Study, folder: Path, *, monitor: str) -> None:
    """Say which trials were best.

    Raises:
        ConfigError: if none finished.
    """
    states = import_optuna().trial.TrialState
    trials = study.get_trials(deepcopy=False)
    done = [trial for trial in trials if trial.state == states.COMPLETE]
    if not done:
        raise ConfigError(f"search: none of {len(trials)} trials finished. See {folder}/<job>/train.log.")
    sign = 1 if study.direction.name == "MINIMIZE" else -1
    done.sort(key=lambda trial: sign * float(trial.value or 0))
    pruned = sum(trial.state == states.PRUNED for trial in trials)
    say(f"search: {len(done)} trials finished, {pruned} pruned, {len(trials) - len(done) - pruned} failed; in {folder}")
    for place, trial in enumerate(done[:5], start=1):
        values = " ".join(f"{key}={_spelt(value)}" for key, value in trial.params.items())
        say(f"  {place}. {monitor} {float(trial.value or 0):.4f}: {values} (trial {trial.number})")
