"""What happens beside training: history, one line an epoch, pictures, checkpoints."""

from __future__ import annotations

import csv
import io
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger

from hudepth.base.console import duration, log
from hudepth.base.files import write_text
from hudepth.data.store import DepthStore
from hudepth.evaluation.pictures import make_panels
from hudepth.runs.run import BEST, CHECKPOINTS, LAST
from hudepth.viz.panels import draw_panels, save_panels


def epoch_metrics(trainer: Trainer) -> dict[str, float]:
    """Return what was logged for the epoch that ends now, by name.

    Lightning keeps the values of the last validation, which in an epoch without one are not this epoch's.
    """
    validated = (trainer.current_epoch + 1) % (trainer.check_val_every_n_epoch or 1) == 0
    metrics = sorted(trainer.callback_metrics.items())
    return {name: value.item() for name, value in metrics if validated or not name.startswith("val/")}


class History(Callback):
    """Writes metrics.csv, one row an epoch, and keeps the rows in every checkpoint.

    A resumed run writes the file anew from its checkpoint, so the history goes on exactly where the weights do,
    whatever a killed run left in the file.

    Args:
        path: the file to write.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, float]] = []

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Add the epoch's row. Checkpoints are saved after this, so that they hold it."""
        row = {"epoch": float(trainer.current_epoch + 1), "step": float(trainer.global_step), **epoch_metrics(trainer)}
        self.rows.append(row)
        if trainer.is_global_zero:
            self._write()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the rows a checkpoint brought."""
        if self.rows and trainer.is_global_zero:
            self._write()

    def state_dict(self) -> dict[str, Any]:
        """Return the rows, for the checkpoint."""
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the rows from a checkpoint."""
        self.rows = [dict(row) for row in state_dict["rows"]]

    def _write(self) -> None:
        text = io.StringIO()
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
        writer.writeheader()
        for row in self.rows:
            writer.writerow({name: int(v) if name in ("epoch", "step") else repr(v) for name, v in row.items()})
        write_text(self.path, text.getvalue())


class EpochLine(Callback):
    """Logs one line an epoch: losses, metrics, time taken and time left.

    Args:
        monitor: the metric that decides which checkpoint is best, shown after the losses.
    """

    LOSSES, SHOWN = ("train/total", "val/total"), ("val/abs_rel", "val/rmse", "val/delta1")

    def __init__(self, monitor: str) -> None:
        self.shown = tuple(dict.fromkeys((*self.LOSSES, monitor, *self.SHOWN)))
        self._start = 0.0
        self._first = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remember when training began, or went on."""
        self._start, self._first = time.monotonic(), trainer.current_epoch

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the line."""
        if not trainer.is_global_zero:
            return
        metrics = epoch_metrics(trainer)
        done = trainer.current_epoch + 1 - self._first
        each = (time.monotonic() - self._start) / done
        left = max(0, (trainer.max_epochs or 0) - trainer.current_epoch - 1)
        values = [f"{name} {metrics[name]:.4f}" for name in self.shown if name in metrics]
        ending = f"{duration(each)} an epoch" + (f", {duration(each * left)} left" if left else "")
        log.info("epoch %d of %s: %s (%s)", trainer.current_epoch + 1, trainer.max_epochs, ", ".join(values), ending)


class Interrupt(Callback):
    """Lets Ctrl-C end a run between two batches; pressed again, at once.

    Raised wherever Python happens to be, a KeyboardInterrupt can be lost: in the callback of a weak reference, of which
    drawing has many, it is printed and ignored, and training goes on.

    A worker of a launcher that was killed ends in the same way, so that the sweep can go on in another process.
    """

    def __init__(self) -> None:
        self._asked = False
        self._before: Any = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the signal, where a thread may: later than Lightning, which gives back what it found."""
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._ask)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Give it back."""
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
            self._before = None

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Give it back."""
        self.on_train_end(trainer, pl_module)

    def _ask(self, number: int, frame: Any) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True
        log.warning("stopping after this batch; Ctrl-C again stops at once")

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Stop here, if asked to."""
        if self._asked or _orphaned():
            raise KeyboardInterrupt

    def on_validation_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Stop here, if asked to."""
        self.on_train_batch_end(trainer, pl_module)


def _orphaned() -> bool:
    """Whether this is a worker process whose parent is gone."""
    parent = multiprocessing.parent_process()  # of a process of a pool; a shell's child has none
    return parent is not None and os.getppid() != parent.pid


class PanelPictures(Callback):
    """Draws RGB, truth, prediction and error of the same validation pairs each time.

    Args:
        folder: where ``epoch_<n>.png`` goes.
        store: holds the pairs.
        indices: which of them, as positions in the store.
        every_n_epochs: how often; the last epoch is always drawn.
        max_depth_m: what unit depth 1 stands for.
    """

    def __init__(
        self, folder: Path, store: DepthStore, indices: Sequence[int], *, every_n_epochs: int, max_depth_m: float
    ) -> None:
        self.folder, self.store, self.indices = folder, store, list(indices)
        self.every_n_epochs, self.max_depth_m = every_n_epochs, max_depth_m

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw, if it is time: while averaged weights, if there are, are still in their place."""
        epoch = trainer.current_epoch + 1
        due = epoch % self.every_n_epochs == 0 or epoch == trainer.max_epochs
        if trainer.sanity_checking or not trainer.is_global_zero or not due:
            return
        panels = make_panels(pl_module, self.store, self.indices, max_depth_m=self.max_depth_m)
        save_panels(self.folder / f"epoch_{epoch:03d}.png", panels)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                picture = draw_panels(panels)
                logger.experiment.add_image("val/panels", picture, trainer.global_step, dataformats="HWC")


def at_full_size(trainer: Trainer) -> bool:
    """Tell whether the network trains at the size it will be used at, and not at a smaller one to begin with."""
    data = getattr(trainer, "datamodule", None)
    return data is None or bool(data.train_size == data.size)


class FullSizeEarlyStopping(EarlyStopping):
    """An EarlyStopping that counts the epochs at full size only."""

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Count, and stop if it is time."""
        if at_full_size(trainer):
            super().on_train_epoch_end(trainer, pl_module)


class KeptCheckpoint(ModelCheckpoint):
    """A ModelCheckpoint that still knows the best so far when the run directory was moved before it went on.

    What is judged by a metric is judged only once the network trains at the size it will be used at.
    """

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save, if it is time."""
        if self.monitor is None or at_full_size(trainer):
            super().on_train_epoch_end(trainer, pl_module)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the state from a checkpoint, with the paths of where the run lies now."""

        def here(path: str) -> str:
            return str(Path(str(self.dirpath)) / Path(path).name) if path else path

        moved = {key: here(state_dict[key]) for key in ("best_model_path", "kth_best_model_path", "last_model_path")}
        best = {here(path): score for path, score in state_dict["best_k_models"].items()}
        super().load_state_dict({**state_dict, **moved, "best_k_models": best, "dirpath": self.dirpath})


def checkpoint_callbacks(run: Path, *, monitor: str, mode: str) -> list[ModelCheckpoint]:
    """Return the callbacks that keep the best weights and the last state.

    ``best.ckpt`` holds weights only; ``last.ckpt`` all that resuming needs. The last is saved last, so that it knows
    of the best.

    Args:
        run: the run directory.
        monitor: what the best is judged by.
        mode: ``min`` or ``max``.
    """
    folder = run / CHECKPOINTS
    best = KeptCheckpoint(
        folder, filename=Path(BEST).stem, monitor=monitor, mode=mode, save_weights_only=True,
        save_on_train_epoch_end=True, enable_version_counter=False, auto_insert_metric_name=False,
    )  # fmt: skip
    last = KeptCheckpoint(folder, filename=Path(LAST).stem, save_on_train_epoch_end=True, enable_version_counter=False)
    return [best, last]
