"""times.csv of a run directory: the time each epoch took."""

from __future__ import annotations

import csv
import io
import time
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.base.files import read_text, write_text
from hudepth.base.types import Batch

COLUMNS = ("epoch", "height", "width", "images", "wall_s", "cpu_s", "lr")


class Times(Callback):
    """Writes times.csv: one row per epoch, sums since training began.

    Columns: ``epoch`` from 1; ``height`` and ``width`` of training images [pixels]; ``images``, training images so far
    in all processes; ``wall_s``, time since the start with validation, pictures and checkpoints [s]; ``cpu_s``, time of
    all cores in this process without loader processes [s]; ``lr``, learning rate of the optimiser's last group.

    Times differ from run to run, so checkpoints do not hold them: a resumed run appends to the rows it finds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, str]] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clocks, after the rows of finished epochs if the run is resumed."""
        self.rows = [row for row in read_times(self.path) if int(row["epoch"]) <= trainer.current_epoch]
        last = self.rows[-1] if self.rows else {"wall_s": "0", "cpu_s": "0", "images": "0"}
        self._images = int(last["images"])
        self._wall = time.monotonic() - float(last["wall_s"])
        self._cpu = time.process_time() - float(last["cpu_s"])

    def on_train_batch_end(self, trainer: Trainer, module: Any, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """Count the images."""
        self._images += len(batch["index"]) * trainer.world_size

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the epoch's row."""
        if not trainer.is_global_zero:
            return
        height, width = getattr(trainer, "datamodule", None).train_size  # type: ignore[union-attr]
        values = (
            trainer.current_epoch + 1, height, width, self._images,
            f"{time.monotonic() - self._wall:.2f}", f"{time.process_time() - self._cpu:.2f}",
            f"{trainer.optimizers[0].param_groups[-1]['lr']:.6g}",
        )  # fmt: skip
        self.rows.append({name: str(value) for name, value in zip(COLUMNS, values, strict=True)})
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        write_text(self.path, text.getvalue())


def read_times(path: Path) -> list[dict[str, str]]:
    """Return the complete rows of a times.csv; none if it is missing or damaged."""
    try:
        return [row for row in csv.DictReader(io.StringIO(read_text(path))) if _is_complete(row)]
    except (OSError, ValueError, csv.Error):
        return []


def _is_complete(row: dict[str, str]) -> bool:
    try:
        _ = [float(row[name]) for name in COLUMNS], int(row["epoch"]), int(row["images"])
    except (ValueError, KeyError, TypeError):
        return False
    return True
