"""Which weights are kept, how they are written, and when training stops early: judged at full image size only."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint

from hudepth.base.errors import TrainingError, first_line
from hudepth.base.files import written_whole
from hudepth.runs.run import BEST, CHECKPOINTS, LAST


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes to a temporary file, then renames it: a full disk or a kill never costs the previous checkpoint."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint. Raises TrainingError if that is not possible; the previous one is intact."""
        folder, why = Path(path).parent, "the disk is full, or a file may not be so large"
        try:
            with written_whole(Path(path)) as part:
                torch.save(checkpoint, part)
        except (OSError, RuntimeError) as error:
            if not re.search(r"unexpected pos|iostream|file write failed", str(error)):  # torch's for a full disk
                why = getattr(error, "strerror", None) or first_line(error)
            last = f"The previous one is intact: free some space, then resume with hudepth-train resume={folder.parent}"
            if not (folder / LAST).is_file():
                last = "It is the first one: free some space, then train again."
            raise TrainingError(f"the checkpoint '{path}' could not be saved ({why}). {last}") from error


def at_full_size(trainer: Trainer) -> bool:
    """Return whether the network trains at its final image size, not at a smaller one of an early stage."""
    data = getattr(trainer, "datamodule", None)
    return data is None or bool(data.train_size == data.size)


def has_validated(trainer: Trainer) -> bool:
    """Return whether the epoch that ends now was validated; if not, Lightning still has an earlier one's values."""
    return (trainer.current_epoch + 1) % (trainer.check_val_every_n_epoch or 1) == 0


class FullSizeEarlyStopping(EarlyStopping):
    """An EarlyStopping that counts epochs at full size only, and those with a new value of what it monitors."""

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Count, and stop if it is time."""
        if at_full_size(trainer) and (has_validated(trainer) or not self.monitor.startswith("val/")):
            super().on_train_epoch_end(trainer, pl_module)


class KeptCheckpoint(ModelCheckpoint):
    """A ModelCheckpoint that compares epochs at full size only, and finds its files after a run directory was moved."""

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save, if it is time."""
        if self.monitor is None or at_full_size(trainer):
            super().on_train_epoch_end(trainer, pl_module)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state with the paths of the run directory as it is now."""

        def here(path: str) -> str:
            return str(Path(str(self.dirpath)) / Path(path).name) if path else path

        moved = {key: here(state_dict[key]) for key in ("best_model_path", "kth_best_model_path", "last_model_path")}
        best = {here(path): score for path, score in state_dict["best_k_models"].items()}
        super().load_state_dict({**state_dict, **moved, "best_k_models": best, "dirpath": self.dirpath})
        self.current_score = state_dict.get("current_score")  # Lightning saves it, but does not restore it


def checkpoint_callbacks(run: Path, *, monitor: str, mode: str) -> list[ModelCheckpoint]:
    """Return the callbacks for best.ckpt, the weights of the best epoch, and last.ckpt, all that resuming needs.

    The last is saved last, so that it records the best.
    """
    folder = run / CHECKPOINTS
    best = KeptCheckpoint(
        folder, filename=Path(BEST).stem, monitor=monitor, mode=mode, save_weights_only=True,
        save_on_train_epoch_end=True, enable_version_counter=False, auto_insert_metric_name=False,
    )  # fmt: skip
    last = KeptCheckpoint(folder, filename=Path(LAST).stem, save_on_train_epoch_end=True, enable_version_counter=False)
    return [best, last]
