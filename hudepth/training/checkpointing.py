"""Which weights are kept, and when training stops early: judged at full image size only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint

from hudepth.runs.run import BEST, CHECKPOINTS, LAST


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
