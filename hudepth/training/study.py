"""The optuna study of a search, and the callback that reports each epoch to it and may prune the training."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.base.errors import ConfigError, Pruned
from hudepth.training.callbacks import epoch_metrics

STUDY = "hudepth"
TRIAL_ENV = "HUDEPTH_TRIAL"
"""``<number>:<study file>``, in the environment of a job that is a trial."""


class TrialPruner(Callback):
    """Reports the monitored metric of each epoch to an optuna study, and stops the training if the study prunes it.

    ``trial`` is the value of :data:`TRIAL_ENV`.
    """

    def __init__(self, trial: str, *, monitor: str) -> None:
        optuna = import_optuna()
        number, _, file = trial.partition(":")
        study = open_study(file)
        trial_id = next(each for each in study.get_trials(deepcopy=False) if each.number == int(number))._trial_id
        self._trial = optuna.trial.Trial(study, trial_id)
        self._reported = set(study.get_trials(deepcopy=False)[int(number)].intermediate_values)
        self.monitor = monitor

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Report, and raise :class:`hudepth.base.errors.Pruned` if other trials were better at this epoch."""
        value, epoch = epoch_metrics(trainer).get(self.monitor), trainer.current_epoch + 1
        if value is None or not trainer.is_global_zero:
            return
        if epoch not in self._reported:  # a resumed run may repeat an epoch
            self._trial.report(value, epoch)
        if self._trial.should_prune():
            raise Pruned(f"pruned after epoch {epoch}: {self.monitor} {value:.4f} is worse than in other trials", value)


def open_study(file: str, options: Mapping[str, Any] | None = None, *, direction: str = "minimize") -> Any:
    """Open or create a study in a journal file, which many processes may write to and a kill cannot damage.

    ``options`` of the search are stored in the study; None uses the stored ones. ``direction`` is ``minimize`` or
    ``maximize``. Raises ConfigError if optuna is not installed, or the file is not a study.
    """
    optuna = import_optuna()
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

    logging.getLogger("optuna").setLevel(logging.WARNING)
    try:
        if Path(file).is_file():  # optuna would append to any file
            with Path(file).open(encoding="utf-8") as lines:
                json.loads(next(lines, "{}"))
        storage = JournalStorage(JournalFileBackend(file, lock_obj=JournalFileOpenLock(file)))
        study = optuna.create_study(storage=storage, study_name=STUDY, load_if_exists=True, direction=direction)
        if options is not None:
            study.set_user_attr("options", dict(options))
        chosen = study.user_attrs["options"]
        # another seed after each trial: a resumed study should not repeat its first draws
        seed = int(chosen["seed"]) + len(study.get_trials(deepcopy=False))
    except Exception as error:
        why = " ".join(str(error).split())
        raise ConfigError(f"search: '{file}' cannot be resumed as a study ({why}). Pass another sweep_dir.") from error
    pruners, samplers = optuna.pruners, optuna.samplers
    startup, warmup = chosen["startup_trials"], chosen["warmup_epochs"]
    study.pruner = pruners.MedianPruner(startup, warmup) if chosen["prune"] else pruners.NopPruner()
    tpe = samplers.TPESampler(seed=seed, n_startup_trials=startup, constant_liar=True)
    study.sampler = samplers.RandomSampler(seed=seed) if chosen["sampler"] == "random" else tpe
    return study


def import_optuna() -> Any:
    """Return the optuna package, or raise a ConfigError that suggests how to install it."""
    try:
        import optuna
    except ImportError:
        raise ConfigError("search: optuna is not installed. Run pip install 'hudepth[search]'.") from None
    return optuna
