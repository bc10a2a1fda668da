"""Training losses and the learning rate between two epochs."""

from __future__ import annotations

from typing import Any, NamedTuple

from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.training.means import Sums, means


class _Row(NamedTuple):
    """What is logged of some steps; their losses are still on the device."""

    step: int
    epoch: int
    sums: Sums
    rates: dict[str, float]


class LogSteps(Callback):
    """Logs, every ``trainer.log_every_n_steps`` steps, the mean losses since the last time, and the learning rate.

    Losses are ``<name>_step``, of the first process's share of the batches; the rate of the step is ``lr``, or
    ``lr/<group>`` where an optimiser has several groups. Sums are read when the module has waited for the device
    anyway, to check the losses, or at the end of the epoch.
    """

    def __init__(self) -> None:
        self._rows: list[_Row] = []
        self._before: Sums = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Ask to be called when the losses are checked."""
        if trainer.is_global_zero and trainer.loggers and self._interval(trainer):
            pl_module.after_check = lambda: self._write(trainer)  # type: ignore[assignment]

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Note the learning rate of a step that will be logged: schedules change it before the step's end."""
        if self._is_due(trainer, trainer.global_step + 1):
            self._rates = learning_rates(trainer)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Note the losses, if it is time."""
        step = trainer.global_step
        if not self._is_due(trainer, step) or (self._rows and self._rows[-1].step == step):
            return
        sums: Sums = pl_module.losses_so_far()  # type: ignore[operator]
        since = {
            names: total - self._before[names] if names in self._before else total for names, total in sums.items()
        }
        self._before = sums
        self._rows.append(_Row(step, trainer.current_epoch, since, self._rates))

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the rest, and begin anew, as the module's sums do."""
        self._write(trainer)
        self._before = {}

    def _interval(self, trainer: Trainer) -> int:
        return int(trainer.log_every_n_steps)  # type: ignore[attr-defined]

    def _is_due(self, trainer: Trainer, step: int) -> bool:
        every = self._interval(trainer)
        return bool(every and step and step % every == 0 and trainer.is_global_zero and trainer.loggers)

    def _write(self, trainer: Trainer) -> None:
        rows, self._rows = self._rows, []
        for row in rows:
            losses = {f"{name}_step": float(value) for name, value in means(row.sums).items()}
            for logger in trainer.loggers:
                logger.log_metrics({**losses, **row.rates, "epoch": row.epoch}, row.step)
                logger.save()


def learning_rates(trainer: Trainer) -> dict[str, float]:
    """Return the learning rates of the first optimiser's groups, by the name they are logged under."""
    groups = trainer.optimizers[0].param_groups
    if len(groups) == 1:
        return {"lr": float(groups[0]["lr"])}
    return {f"lr/{group.get('name', number)}": float(group["lr"]) for number, group in enumerate(groups)}
