"""Callbacks of every training: history, a log line per epoch, pictures, and a clean end on Ctrl-C."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.base.console import duration, log
from hudepth.base.devices import spell_epoch
from hudepth.data.order import epoch_seed
from hudepth.data.store import DepthStore
from hudepth.evaluation.pictures import make_panels
from hudepth.runs.history import write_history
from hudepth.training.checkpointing import has_validated
from hudepth.training.loggers.run import log_picture
from hudepth.training.module import loss_name
from hudepth.viz.panels import draw_panels, save_panels


def epoch_metrics(trainer: Trainer) -> dict[str, float]:
    """Return what was logged for the epoch that ends now, by name."""
    validated = has_validated(trainer)
    metrics = sorted(trainer.callback_metrics.items())
    return {name: value.item() for name, value in metrics if validated or not name.startswith("val/")}


class LogLosses(Callback):
    """Logs the epoch's training losses before other callbacks read them: the module's own hook comes after theirs."""

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log them."""
        pl_module.log_losses("train")  # type: ignore[operator]


class History(Callback):
    """Writes metrics.csv, one row per epoch, and keeps the rows in every checkpoint.

    A resumed run rewrites the file from its checkpoint, so the history continues exactly where the weights do.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, float]] = []

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Add the epoch's row. Checkpoints are saved after this, so that they hold it."""
        row = {"epoch": float(trainer.current_epoch + 1), "step": float(trainer.global_step), **epoch_metrics(trainer)}
        self.rows.append(row)
        self.on_train_start(trainer, pl_module)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the rows of the checkpoint."""
        if self.rows and trainer.is_global_zero:
            write_history(self.path, self.rows)

    def state_dict(self) -> dict[str, Any]:
        """Return the rows, for the checkpoint."""
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the rows from a checkpoint."""
        self.rows = [dict(row) for row in state_dict["rows"]]


class EpochSeed(Callback):
    """Seeds PyTorch each epoch: a network with dropout goes on after a resume as if it had never stopped."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Seed at the first batch, each process differently; Lightning skips the epoch's own hook after a resume."""
        if batch_idx == 0:
            torch.manual_seed(epoch_seed("train", self.seed, trainer.current_epoch, trainer.global_rank))


class CompileTime(Callback):
    """Says that torch.compile is at work, which makes the first step of each size take long, and how long it took."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Announce the wait."""
        log.info("compile: the first step of each image size builds its kernels, which takes a minute or more")
        self._start: float | None = time.monotonic()

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Log the time of the first step."""
        if self._start is not None:
            log.info("compile: the first step took %s", duration(time.monotonic() - self._start))
            self._start = None


class EpochLine(Callback):
    """Logs one line per epoch: losses, the metric ``monitor``, other metrics, time taken and time left."""

    LOSSES, SHOWN = (loss_name("train"), loss_name("val")), ("val/abs_rel", "val/rmse", "val/delta1")

    def __init__(self, monitor: str) -> None:
        self.shown = tuple(dict.fromkeys((*self.LOSSES, monitor, *self.SHOWN)))

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remember when training began or was resumed."""
        self._start, self._first = time.monotonic(), trainer.current_epoch

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the line."""
        if not trainer.is_global_zero:
            return
        metrics, epoch = epoch_metrics(trainer), trainer.current_epoch + 1
        each = (time.monotonic() - self._start) / (epoch - self._first)
        left = max(0, (trainer.max_epochs or 0) - epoch)
        values = [f"{name} {metrics[name]:.4f}" for name in self.shown if name in metrics]
        ending = f"{duration(each)} per epoch" + (f", {duration(each * left)} left" if left else "")
        log.info("%s: %s (%s)", spell_epoch(trainer), ", ".join(values), ending)


class Interrupt(Callback):
    """Lets Ctrl-C, or SIGTERM, end a run between two batches; a second one ends it at once.

    A KeyboardInterrupt raised at an arbitrary place can be lost: in the callback of a weak reference, of which drawing
    has many, it is printed and ignored, and training continues. Lightning ignores SIGTERM, with which clusters and
    containers ask. A worker of a launcher that was killed ends in the same way, so that another process can resume the
    sweep.
    """

    asked = False
    """Whether to stop."""

    def __init__(self) -> None:
        self._before: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Install the handler, in the main thread only: after Lightning, which restores what it found."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_train_end(self, *_: Any, **__: Any) -> None:
        """Restore the handlers that were there before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    on_exception = on_train_end

    def _ask(self, number: int, frame: Any) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        log.warning("stopping after this batch; Ctrl-C again stops at once")

    def on_train_batch_end(self, *_: Any, **__: Any) -> None:
        """Stop if asked to, or if the parent of this worker is gone."""
        parent = multiprocessing.parent_process()  # set for a worker of a pool, not for a shell's child
        if self.asked or (parent is not None and os.getppid() != parent.pid):
            raise KeyboardInterrupt

    on_validation_batch_end = on_train_batch_end


class PanelPictures(Callback):
    """Draws RGB, ground truth, prediction and error of the same validation pairs to ``folder/epoch_<n>.png``.

    ``indices`` are those of the pairs in the store. The last epoch is always drawn.
    """

    def __init__(
        self, folder: Path, store: DepthStore, indices: Sequence[int], *, every_n_epochs: int, max_depth_m: float
    ) -> None:
        self.folder, self.store, self.indices = folder, store, list(indices)
        self.every_n_epochs, self.max_depth_m = every_n_epochs, max_depth_m

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw, if it is time: here, averaged weights are still in place of the trained ones."""
        epoch = trainer.current_epoch + 1
        due = epoch % self.every_n_epochs == 0 or epoch == trainer.max_epochs
        if trainer.sanity_checking or not trainer.is_global_zero or not due:
            return
        panels = make_panels(pl_module, self.store, self.indices, max_depth_m=self.max_depth_m)
        save_panels(self.folder / f"epoch_{epoch:03d}.png", panels)
        if trainer.loggers:
            log_picture(trainer.loggers, "val/panels", draw_panels(panels), trainer.global_step)
