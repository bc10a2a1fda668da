"""A search over configurations with optuna: each trial is a run of the sweep, and the study a file next to the runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep

from hudepth.base.console import print_error
from hudepth.base.errors import ConfigError
from hudepth.base.options import Range
from hudepth.runs.status import FAILED, FINISHED, PRUNED, read_state, read_status
from hudepth.sweep.jobs import Job, find_done
from hudepth.training.study import TRIAL_ENV, import_optuna, open_study

STUDY_FILE = "study.log"


@dataclass(frozen=True)
class SearchOptions:
    """The group ``hydra.sweeper.search``; conf/hydra/sweeper/hudepth.yaml explains each option."""

    trials: Annotated[int, Range(1)] | None = None
    sampler: Literal["tpe", "random"] = "tpe"
    seed: Annotated[int, Range(0)] = 0
    startup_trials: Annotated[int, Range(0)] = 8
    prune: bool = True
    warmup_epochs: Annotated[int, Range(0)] = 2


def search(
    compose: Callable[[Sequence[Job]], list[Job]],
    run_jobs: Callable[[Sequence[Job], Sequence[Job]], None],
    folder: Path,
    *,
    overrides: Sequence[Override],
    options: SearchOptions,
    mode: str,
    monitor: str,
    at_once: int,
) -> None:
    """Run trials until there are as many as asked for; trials that were killed are resumed first.

    ``compose`` returns jobs with their configurations; ``run_jobs`` records all jobs so far, then runs the unfinished
    ones of its second argument. The study lies in ``folder``. Overrides with a range of values are searched over.
    ``mode`` is ``min`` or ``max``: which way ``monitor`` is better; ``at_once`` trials run in parallel. Raises
    ConfigError if optuna is not installed, nothing is searched over, or all trials failed.
    """
    constants = [str(override.input_line) for override in overrides if not override.is_sweep_override()]
    space = {each.get_key_element(): distribution(each) for each in overrides if each.is_sweep_override()}
    if not space:
        raise ConfigError("search: nothing to search over. Give a key a range, as in 'loss.boundary=interval(0.3,30)'.")
    direction = "minimize" if mode == "min" else "maximize"
    study = open_study(str(folder / STUDY_FILE), asdict(options), direction=direction)
    jobs: list[Job] = []
    while trials := _next_trials(study, space, at_once, options.trials or 0):
        batch = find_done(compose([_job(trial, constants, folder) for trial in trials]), folder)
        if all(job.config is None for job in batch) and not jobs:
            raise ConfigError(batch[0].error)
        run_jobs([*jobs, *batch], batch)
        unfinished = [job.name for job in batch if not _tell(study, job, folder)]
        if unfinished:  # a launcher lost its process; trying again at once might never end
            raise ConfigError(f"search: {unfinished[0]} did not end. Resume with sweep_dir={folder}.")
        jobs += batch
    _say_best(study, folder, monitor=monitor)


def distribution(override: Override) -> Any:
    """Return the optuna distribution for an override like ``loss.boundary=tag(log,interval(0.3,30))``.

    Raises ConfigError if it is not a range that optuna supports.
    """
    distributions = import_optuna().distributions
    value = override.value()
    log = "log" in getattr(value, "tags", ())
    try:
        if isinstance(value, IntervalSweep):
            return distributions.FloatDistribution(float(value.start or 0), float(value.end or 0), log=log)
        if isinstance(value, RangeSweep):
            start, stop, step = value.start or 0, value.stop or 0, value.step  # like Python's, without stop
            if isinstance(start, int) and isinstance(stop, int) and isinstance(step, int):
                last = stop - 1 - (stop - 1 - start) % step
                return distributions.IntDistribution(start, last, step=1 if log else step, log=log)
            steps = math.ceil((stop - start) / step) - 1
            return distributions.FloatDistribution(float(start), start + steps * step, step=float(step))
        if isinstance(value, ChoiceSweep):
            return distributions.CategoricalDistribution(list(override.sweep_string_iterator()))
    except ValueError as error:
        raise ConfigError(f"'{override.input_line}': {error}") from error
    raise ConfigError(f"'{override.input_line}': pass interval(low,high), range(first,end,step) or choice(a,b).")


def _next_trials(study: Any, space: Mapping[str, Any], at_once: int, wanted: int) -> list[Any]:
    """Return the trials that were killed, or new ones while there are fewer than wanted."""
    trial = import_optuna().trial
    every = study.get_trials(deepcopy=False)
    if killed := [each for each in every if each.state == trial.TrialState.RUNNING]:
        return [trial.Trial(study, each._trial_id) for each in killed]
    return [study.ask(dict(space)) for _ in range(min(at_once, wanted - len(every)))]


def _job(trial: Any, constants: Sequence[str], folder: Path) -> Job:
    values = {key: _format_value(value) for key, value in trial.params.items()}
    env = f"+hydra.job.env_set.{TRIAL_ENV}='{trial.number}:{folder / STUDY_FILE}'"
    labels = {"trial": str(trial.number), **{key.lstrip("+~"): value for key, value in values.items()}}
    return Job((*constants, *(f"{key}={value}" for key, value in values.items()), env), labels)


def _format_value(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _tell(study: Any, job: Job, folder: Path) -> bool:
    """Report a trial's end to the study, and return whether it has ended; one that was interrupted stays open."""
    states = import_optuna().trial.TrialState
    state = read_state(folder / job.folder)[0] if job.config is not None else FAILED
    number, best = int(job.labels["trial"]), read_status(folder / job.folder).get("best")
    if state == FINISHED and isinstance(best, int | float):
        study.tell(number, float(best))
    elif state in (PRUNED, FAILED, FINISHED):  # finished with a metric that is not finite
        study.tell(number, state=states.PRUNED if state == PRUNED else states.FAIL)
    else:
        return False
    return True


def _say_best(study: Any, folder: Path, *, monitor: str) -> None:
    """Print the best trials; at least one must have finished."""
    states = import_optuna().trial.TrialState
    trials = study.get_trials(deepcopy=False)
    done = [trial for trial in trials if trial.state == states.COMPLETE]
    if not done:
        raise ConfigError(f"search: none of {len(trials)} trials finished. See {folder}/<job>/train.log.")
    sign = 1 if study.direction.name == "MINIMIZE" else -1
    done.sort(key=lambda trial: sign * float(trial.value or 0))
    pruned = sum(trial.state == states.PRUNED for trial in trials)
    failed = len(trials) - len(done) - pruned
    print_error(f"search: {len(done)} trials finished, {pruned} pruned, {failed} failed; in {folder}")
    for place, trial in enumerate(done[:5], start=1):
        values = " ".join(f"{key}={_format_value(value)}" for key, value in trial.params.items())
        print_error(f"  {place}. {monitor} {float(trial.value or 0):.4f}: {values} (trial {trial.number})")
