"""Training without the trunk's first stages, as long as the rest has much to learn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.base.errors import ConfigError

STAGES = ("stem", "layer1", "layer2", "layer3")
"""Of the trunk, from the image on; the stem is its first convolution and batch norm."""


class FreezeTrunk(Callback):
    """Keeps the first stages of a pretrained trunk as they are until a share of the epochs is over.

    Their gradients are not computed, which is where the time is saved. Statistics of batch norm go on being gathered;
    ``model.trunk_norm=frozen`` is for that.

    Args:
        until: share of the epochs, in (0, 1]; 1 keeps them throughout.
        stages: the first of :data:`STAGES`, without a gap: gradients must pass through what comes after.

    Raises:
        ConfigError: for other stages or shares.
    """

    def __init__(self, *, until: float = 0.3, stages: Sequence[str] = ("stem", "layer1")) -> None:
        if not 0 < until <= 1:
            raise ConfigError(f"FreezeTrunk.until: {until} is not a share of the epochs, in (0, 1].")
        if not stages or tuple(stages) != STAGES[: len(stages)]:
            raise ConfigError(
                f"FreezeTrunk.stages: {list(stages)} are not the first stages of the trunk. Pass the first few of "
                f"{list(STAGES)}."
            )
        self.until, self.stages = until, tuple(stages)

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Freeze before a strategy looks for what it has to share among processes."""
        if stage != "fit":
            return
        if getattr(getattr(pl_module, "net", None), "trunk", None) is None:
            raise ConfigError("FreezeTrunk: this network has no trunk. Leave it out of callbacks.extra.")
        if self.until < 1 and trainer.world_size > 1:
            raise ConfigError(
                "FreezeTrunk.until: several processes would not share what is let go later. Pass until=1, or "
                "trainer.devices=1."
            )
        if self.until < 1 and (trainer.max_epochs or -1) < 0:
            raise ConfigError("FreezeTrunk.until: a share of the epochs needs trainer.max_epochs. Pass it, or until=1.")
        self._freeze(pl_module, frozen=True)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Let go, if it is time."""
        if self.until < 1:
            self._freeze(pl_module, frozen=trainer.current_epoch < round(self.until * (trainer.max_epochs or 0)))

    def _freeze(self, pl_module: LightningModule, *, frozen: bool) -> None:
        net: Any = pl_module.net
        names = [name for stage in self.stages for name in (("conv1", "bn1") if stage == "stem" else (stage,))]
        for name in names:
            getattr(net.trunk, name).requires_grad_(requires_grad=not frozen)
