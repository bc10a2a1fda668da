"""Training without the encoder's first stages while the rest has much to learn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.base.errors import ConfigError
from hudepth.models.encoder import Encoder, find_encoder


class FreezeEncoder(Callback):
    """Freezes the first stages of a pretrained encoder for a share of the epochs, and skips their gradients.

    Batch norm still updates its statistics; ``model.encoder_norm=frozen`` prevents that.

    Args:
        until: share of the epochs, in (0, 1]; 1 freezes them throughout. Raises ConfigError if out of range.
        stages: names of the encoder's first stages, without a gap: gradients must pass through what comes after.
            None freezes all of them.
    """

    def __init__(self, *, until: float = 0.3, stages: Sequence[str] | None = ("stem", "layer1")) -> None:
        if not 0 < until <= 1:
            raise ConfigError(f"FreezeEncoder.until: {until} is not a share of the epochs, in (0, 1].")
        self.until, self.stages = until, None if stages is None else list(stages)

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Freeze before a strategy looks for what it has to share among processes; raise ConfigError if it cannot."""
        if stage != "fit":
            return
        known = [stage.name for stage in _encoder(pl_module).stages]
        self.stages = known if self.stages is None else self.stages
        if not self.stages or self.stages != known[: len(self.stages)]:
            raise ConfigError(
                f"FreezeEncoder.stages: {self.stages} are not the first stages of the encoder. Pass the first few of "
                f"{known}."
            )
        if self.until < 1 and trainer.world_size > 1:
            raise ConfigError(
                "FreezeEncoder.until: stages that train later would not be shared among processes. Pass until=1, or "
                "trainer.devices=1."
            )
        if self.until < 1 and (trainer.max_epochs or -1) < 0:
            raise ConfigError("FreezeEncoder.until: a share of the epochs needs trainer.max_epochs; or pass until=1.")
        self._count = len(self.stages)
        _encoder(pl_module).freeze(self._count)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Freeze as in the epoch that is resumed: Lightning skips the hook below in the first one after a resume."""
        self.on_train_epoch_start(trainer, pl_module)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Train the stages again, if it is time."""
        if self.until < 1:
            frozen = trainer.current_epoch < round(self.until * (trainer.max_epochs or 0))
            _encoder(pl_module).freeze(self._count, frozen=frozen)


def _encoder(pl_module: Any) -> Encoder:
    encoder = find_encoder(pl_module.net)
    if encoder is None:
        raise ConfigError("FreezeEncoder: this network has no encoder. Leave it out of callbacks.extra.")
    return encoder
