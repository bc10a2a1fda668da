"""The part of a search that runs inside a training: it tells how each epoch went, and may stop it."""

from __future__ import annotations

from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.callbacks import epoch_metrics
from hudepth.errors import Pruned
from hudepth.tasks.search import open_study


class TrialPruner(Callback):
    """Reports the monitored metric of each epoch to an optuna study, and ends the training if the study says so.

    Args:
        trial: the value of :data:`hudepth.tasks.search.TRIAL_ENV`.
        monitor: the metric.
    """

    def __init__(self, trial: str, *, monitor: str) -> None:
        import optuna

        number, _, file = trial.partition(":")
        study = open_study(file)
        trial_id = next(each for each in study.get_trials(deepcopy=False) if each.number == int(number))._trial_id
        self._trial = optuna.trial.Trial(study, trial_id)
        self._reported = set(study.get_trials(deepcopy=False)[int(number)].intermediate_values)
        self.monitor = monitor

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Report, and stop if others were better at this epoch.

        Raises:
            Pruned: to stop.
        """
        value = epoch_metrics(trainer).get(self.monitor)
        epoch = trainer.current_epoch + 1
        if value is None or not trainer.is_global_zero:
            return
        if epoch not in self._reported:  # a resumed run may come through an epoch again
            self._trial.report(value, epoch)
        if self._trial.should_prune():
            raise Pruned(f"pruned after epoch {epoch}: {self.monitor} {value:.4f} is worse than others' then", value)
