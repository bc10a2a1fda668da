"""An exponential moving average of the weights, used for validation and stored in checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor

from hudepth.base.errors import ConfigError


class EMA(WeightAveraging):
    """Lightning's weight averaging with a low initial decay, so that the first steps are soon forgotten.

    Each step sets the average to ``d * average + (1 - d) * weights``, d = min(decay, (1 + n) / (10 + n)) after n
    earlier steps, starting from the weights of the first. Statistics of batch norm are averaged, too. Validation and
    pictures use the average, and ``best.ckpt`` holds it; ``last.ckpt`` holds the trained weights as well. ``decay`` is
    in [0, 1), else a ConfigError is raised; 0.998 averages over some 500 steps.
    """

    def __init__(self, *, decay: float = 0.998) -> None:
        if not 0 <= decay < 1:
            raise ConfigError(f"EMA.decay: {decay} is not in [0, 1). The usual values are 0.99 to 0.9999.")
        self.decay = decay
        super().__init__(multi_avg_fn=self._average)

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Copy the network to the device it will train on; Lightning moves the network itself later."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:
            self._average_model.n_averaged = self._average_model.n_averaged.cpu()  # read at every step

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Pair the tensors of both networks once: at every step, as Lightning does, it takes longer than averaging."""
        assert self._average_model is not None
        both = [[*net.parameters(), *net.buffers()] for net in (self._average_model.module, pl_module)]
        kinds = [[[x for x in tensors if x.is_floating_point() is kind] for tensors in both] for kind in (True, False)]
        self._pairs = [(averaged, current) for averaged, current in kinds if averaged]  # some networks have no counters

    @torch.no_grad()
    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Average after every step of the optimiser."""
        if trainer.global_step <= self._latest_update_step:
            return
        assert self._average_model is not None
        for averaged, current in self._pairs:
            if self._average_model.n_averaged == 0:
                torch._foreach_copy_(averaged, current)
            else:
                self._average(averaged, current, self._average_model.n_averaged)
        self._average_model.n_averaged += 1
        self._latest_update_step = trainer.global_step

    @torch.no_grad()
    def _average(self, averaged: Sequence[Tensor], current: Sequence[Tensor], count: Tensor | int) -> None:
        steps = self._latest_update_step  # not ``count``: reading it would wait for the device
        share = 1 - min(self.decay, (1 + steps) / (10 + steps))
        if averaged[0].is_floating_point():
            torch._foreach_lerp_(list(averaged), list(current), share)
        else:  # counters
            torch._foreach_copy_(list(averaged), list(current))


def averaged_state(trainer: Trainer | None, checkpoint: dict[str, Any]) -> dict[str, Tensor] | None:
    """Return the averaged weights for a checkpoint that lacks them, or None.

    Lightning passes checkpoints to the averaging callback unless they hold only weights, as ``best.ckpt`` does.
    """
    for callback in getattr(trainer, "callbacks", []):
        if isinstance(callback, EMA) and callback._average_model is not None:
            return None if "current_model_state" in checkpoint else dict(callback._average_model.module.state_dict())
    return None
