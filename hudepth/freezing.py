"""Training without the trunk's first stages, as long as the rest has much to learn."""

from __future__ import annotations

from collections.abc import Sequence

from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.errors import ConfigError

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

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Freeze, or let go."""
        trunk = getattr(getattr(pl_module, "net", None), "trunk", None)
        if trunk is None:
            raise ConfigError("FreezeTrunk: this network has no trunk. Leave it out of callbacks.extra.")
        frozen = trainer.current_epoch < round(self.until * (trainer.max_epochs or 0))
        names = [name for stage in self.stages for name in (("conv1", "bn1") if stage == "stem" else (stage,))]
        for name in names:
            getattr(trunk, name).requires_grad_(requires_grad=not frozen)
