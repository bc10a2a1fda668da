"""The jobs of a sweep: configurations from comma-separated values and named variants, each with its key."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.runs.identity import INCIDENTAL, flat, run_key
from hudepth.runs.run import is_run, read_config
from hudepth.runs.status import FINISHED, read_state
from hudepth.runs.sweeps import folder_name

VARIANT = "variant"
SEED = "seed"


@dataclass(frozen=True, eq=False)
class Job:
    """One job of a sweep; jobs compare by object identity.

    ``labels`` are what was varied; ``config`` is resolved, None if it does not compose, for the reason in ``error``;
    ``folder`` names the run directory; ``finished`` means trained, and tested as configured.
    """

    overrides: tuple[str, ...]
    labels: Mapping[str, str]
    config: Mapping[str, Any] | None = None
    error: str = ""
    folder: str = ""
    finished: bool = False

    @property
    def name(self) -> str:
        """For people: ``l1 seed=1``."""
        return " ".join(value if key == VARIANT else f"{key}={value}" for key, value in self.labels.items()) or "job"

    @property
    def is_open(self) -> bool:
        """Whether it is still to be run."""
        return self.config is not None and not self.finished

    def record(self) -> dict[str, Any]:
        """Return its entry in sweep.yaml."""
        return {"labels": dict(self.labels), **({"error": self.error} if self.config is None else {"run": self.folder})}


def merge_overrides(typed: Sequence[Override], params: Sequence[Override]) -> list[Override]:
    """Return the overrides of the sweep's file that the command line does not replace, then those of the latter."""
    replaced = {_key(override) for override in typed}
    return [*(override for override in params if _key(override) not in replaced), *typed]


def combine(overrides: Sequence[Override], variants: Mapping[str, Sequence[str]]) -> list[Job]:
    """Return every combination of values and of ``variants``, which are lists of overrides by name.

    Seeds change last, so that a sweep that ends early has all variants of the first seeds. Raises ConfigError for an
    unknown variant, or values that cannot be enumerated.
    """
    names = list(variants)
    constants, choices = [], dict[str, list[str]]()
    for override in overrides:
        key = _key(override)
        if key == VARIANT and variants:
            swept = override.is_sweep_override()
            names = list(override.sweep_string_iterator()) if swept else [str(override.value())]
        elif not override.is_sweep_override():
            constants.append(str(override.input_line))
        elif override.is_discrete_sweep():
            choices[override.get_key_element()] = list(override.sweep_string_iterator())
        else:
            raise ConfigError(
                f"'{override.input_line}' cannot be enumerated. Pass some values, as in {key}=1,2,3; or search among "
                "them with hydra.sweeper.search.trials=20."
            )
    if unknown := [name for name in names if name not in variants]:
        raise ConfigError(
            f"variant: no '{unknown[0]}' in this sweep.{did_you_mean(unknown[0], variants)} "
            f"Pass some of {', '.join(variants)}."
        )
    choices |= {VARIANT: names} if variants else {}
    keys = sorted(choices, key=lambda key: (key != SEED, key != VARIANT))  # the last one changes fastest
    jobs = []
    for values in itertools.product(*(choices[key] for key in keys)):
        chosen = dict(zip(keys, values, strict=True))
        more = variants[chosen[VARIANT]] if variants else ()
        labels = {key.lstrip("+~"): chosen[key] for key in sorted(keys, key=lambda key: (key != VARIANT, key == SEED))}
        jobs.append(Job((*constants, *more, *(f"{key}={value}" for key, value in chosen.items())), labels))
    return jobs


def _key(override: Override) -> str:
    return str(override.key_or_group).lstrip("/")


def compose(
    jobs: Iterable[Job], compose_one: Callable[[list[str]], dict[str, Any]], word: Callable[[Exception], str]
) -> list[Job]:
    """Return the jobs with their configurations from ``compose_one``, or with the error in one line from ``word``.

    Raises ConfigError if a job would be distributed over processes, or two jobs are the same training.
    """
    composed: dict[str, Job] = {}
    for number, job in enumerate(jobs):
        try:
            config = compose_one(list(job.overrides))
        except Exception as error:  # whatever Hydra, OmegaConf or a resolver raises: the other jobs run
            composed[f"{number}"] = replace(job, error=word(error))
            continue
        _check_one_process(config)
        key = run_key(config)
        if key in composed:
            _check_same(composed[key], config, job)
            continue
        composed[key] = replace(job, config=config, folder=folder_name(job.labels, key))
    return list(composed.values())


def _check_one_process(config: Mapping[str, Any]) -> None:
    trainer = config["trainer"]
    devices, strategy = trainer.get("devices", 1), str(trainer.get("strategy", "auto"))
    alone = devices in (1, "1", "auto") or (isinstance(devices, list | tuple) and len(devices) == 1)
    if not alone or strategy not in ("auto", "None") or trainer.get("num_nodes", 1) != 1:
        raise ConfigError(
            f"trainer.devices={devices}, trainer.strategy={trainer.get('strategy')}: each job of a sweep has one "
            "process, since each process of a distributed run would start the sweep again. Leave trainer=default and "
            "run jobs in parallel with hydra/launcher=joblib, or run one at a time without -m."
        )


def _check_same(first: Job, config: Mapping[str, Any], job: Job) -> None:
    """Accept a combination that comes up twice, unless the values were meant to make two trainings."""
    before, after = flat(first.config or {}), flat(config)
    for key in job.labels:
        if key in INCIDENTAL and key not in (VARIANT, "name") and before.get(key) != after.get(key):
            raise ConfigError(
                f"{key}: its value does not change a training, so '{first.name}' and '{job.name}' would be one run. "
                "Run two sweeps, each with its own sweep_dir."
            )


def find_done(jobs: Iterable[Job], folder: Path) -> list[Job]:
    """Return composed jobs with the run directories they already have, found by configuration and not by name."""
    known: dict[str, tuple[Path, dict[str, Any]]] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        try:
            config = read_config(path) if is_run(path) else {}
            known.setdefault(run_key(config), (path, config))
        except Exception:  # a damaged folder, or one of another program
            continue
    found = []
    for job in jobs:
        if job.config is not None and (run := known.get(run_key(job.config))):
            (path, config), wanted = run, job.config
            tested = not wanted["test"] or (config.get("test") and config.get("protocol") == wanted["protocol"])
            job = replace(job, folder=path.name, finished=bool(read_state(path)[0] == FINISHED and tested))
        found.append(job)
    return found
