"""The jobs of a sweep: from comma-separated values and named variants to configurations, each known by its key."""

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
    """One job of a sweep, equal to no other."""

    overrides: tuple[str, ...]
    """As they would be typed to run it alone."""
    labels: Mapping[str, str]
    """What was varied, as typed."""
    config: Mapping[str, Any] | None = None
    """Resolved; None if it does not compose."""
    error: str = ""
    """Why it does not compose."""
    folder: str = ""
    """Of its run directory, in that of the sweep."""
    finished: bool = False
    """Whether that has all that is asked for."""

    @property
    def name(self) -> str:
        """What people read: ``l1 seed=1``."""
        return " ".join(value if key == VARIANT else f"{key}={value}" for key, value in self.labels.items()) or "job"


def combine(typed: Sequence[Override], params: Sequence[Override], variants: Mapping[str, Sequence[str]]) -> list[Job]:
    """Return every combination of values and variants; what is typed stands above the sweep's own values.

    Seeds change last, so that a sweep that ends early has all variants of the first seeds.

    Args:
        typed: overrides on the command line.
        params: overrides of the sweep's file.
        variants: overrides by the name of a variant.

    Raises:
        ConfigError: for an unknown variant, or values that cannot be enumerated.
    """
    mine = {_key(override) for override in typed}
    constants, choices = [], dict[str, list[str]]()
    for override in [*(each for each in params if _key(each) not in mine), *typed]:
        key = _key(override)
        if key == VARIANT and variants:
            continue
        if not override.is_sweep_override():
            constants.append(str(override.input_line))
        elif override.is_discrete_sweep():
            choices[override.get_key_element()] = list(override.sweep_string_iterator())
        else:
            raise ConfigError(
                f"'{override.input_line}' has no end of values. Pass some, as in {key}=1,2,3; or search among them "
                "with hydra.sweeper.search.trials=20."
            )
    names = _chosen_variants(typed, variants)
    seeds = [key for key in choices if key == SEED]
    keys = [*seeds, *([VARIANT] if variants else []), *(key for key in choices if key not in seeds)]
    choices |= {VARIANT: names} if variants else {}
    jobs = []
    for values in itertools.product(*(choices[key] for key in keys)):
        chosen = dict(zip(keys, values, strict=True))
        more = variants[chosen[VARIANT]] if variants else ()
        labels = {key.lstrip("+~"): chosen[key] for key in sorted(keys, key=lambda key: (key != VARIANT, key == SEED))}
        jobs.append(Job((*constants, *more, *(f"{key}={value}" for key, value in chosen.items())), labels))
    return jobs


def _key(override: Override) -> str:
    return str(override.key_or_group).lstrip("/")


def _chosen_variants(typed: Sequence[Override], variants: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the names typed as ``variant=a,b``, else all."""
    names = list(variants)
    for override in typed:
        if _key(override) == VARIANT and variants:
            names = list(override.sweep_string_iterator()) if override.is_sweep_override() else [str(override.value())]
    for name in names:
        if name not in variants:
            raise ConfigError(
                f"variant: no '{name}' in this sweep.{did_you_mean(name, variants)} Pass some of {', '.join(variants)}."
            )
    return names


def compose(
    jobs: Iterable[Job], how: Callable[[list[str]], dict[str, Any]], say: Callable[[Exception], str]
) -> list[Job]:
    """Return the jobs with their configurations; one that does not compose keeps the line that says why.

    Args:
        jobs: to compose.
        how: turns overrides into a resolved configuration.
        say: words its errors in one line.

    Raises:
        ConfigError: if a job would be distributed over processes, or two jobs differ in nothing that tells runs apart.
    """
    composed: dict[str, Job] = {}
    for number, job in enumerate(jobs):
        try:
            config = how(list(job.overrides))
        except Exception as error:  # whatever Hydra, OmegaConf or a resolver raises: the other jobs go on
            composed[f"{number}"] = replace(job, error=say(error))
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
    alone = trainer.get("devices", 1) in (1, "1", "auto") or _is_one_device(trainer.get("devices"))
    distributed = str(trainer.get("strategy", "auto")) not in ("auto", "None") or trainer.get("num_nodes", 1) != 1
    if distributed or not alone:
        raise ConfigError(
            f"trainer.devices={trainer.get('devices')}, trainer.strategy={trainer.get('strategy')}: the jobs of a "
            "sweep have one process each, since the processes of a distributed run would each start the sweep again. "
            "Leave trainer=default and run jobs side by side with hydra/launcher=joblib, or one at a time without -m."
        )


def _is_one_device(devices: Any) -> bool:
    return isinstance(devices, list | tuple) and len(devices) == 1


def _check_same(first: Job, config: Mapping[str, Any], job: Job) -> None:
    """Let a combination that came up twice run once, unless somebody thinks that these are two."""
    before, after = flat(first.config or {}), flat(config)
    differing = [
        key
        for key in job.labels
        if key not in (VARIANT, "name") and before.get(key) != after.get(key) and key in INCIDENTAL
    ]
    if differing:
        raise ConfigError(
            f"{differing[0]}: its values do not tell one training from another, so '{first.name}' and '{job.name}' "
            "would "
            f"be one run. Make two sweeps of it, each with a sweep_dir of its own."
        )


def find_done(jobs: Iterable[Job], folder: Path) -> list[Job]:
    """Return the jobs with the run directories they already have, known by their configuration and not by their name.

    Args:
        jobs: composed.
        folder: of the sweep; it need not exist.
    """
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    known: dict[str, tuple[Path, dict[str, Any]]] = {}
    for path in paths:
        try:
            config = read_config(path) if is_run(path) else {}
            known.setdefault(run_key(config), (path, config))
        except Exception:  # a damaged or foreign folder is nobody's run
            continue
    found = []
    for job in jobs:
        had = known.get(run_key(job.config)) if job.config is not None else None
        if had is not None:
            job = replace(job, folder=had[0].name, finished=_has_all(*had, job.config or {}))
        found.append(job)
    return found


def _has_all(path: Path, had: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Whether a run is finished, and tested as it is wanted now."""
    tested = not wanted["test"] or (had.get("test") and had.get("protocol") == wanted["protocol"])
    return bool(read_state(path)[0] == FINISHED and tested)
