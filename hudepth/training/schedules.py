"""Learning-rate schedules over the whole training that change the rate after every step."""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import partial

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from hudepth.base.errors import ConfigError


class StepSchedule(LambdaLR):
    """Multiplies the learning rate of each group by a function of the finished share of the training.

    ``warmup``, in [0, 1), is the share of the training in which the factor rises linearly from 0 to 1. Raises
    ConfigError if it is out of range, or the training has no end.
    """

    def __init__(self, optimizer: Optimizer, *, total_steps: int, warmup: float = 0.0) -> None:
        if not 0 <= warmup < 1:
            raise ConfigError(f"schedule.warmup: {warmup} is not a share of the training, in [0, 1).")
        if total_steps < 1:
            raise ConfigError(
                "schedule: the length of the training is not set. Pass trainer.max_epochs or +trainer.max_steps, or "
                "schedule=constant."
            )
        self.total_steps, self.warmup = total_steps, warmup
        super().__init__(optimizer, partial(self._factor))

    def _factor(self, step: int) -> float:
        done = min(1.0, (step + 1) / max(1, self.total_steps))
        if done < self.warmup:
            return done / self.warmup
        return self.factor((done - self.warmup) / (1 - self.warmup))

    @abstractmethod
    def factor(self, done: float) -> float:
        """Return the factor at a share ``done``, in [0, 1], of what follows the warm-up."""


class WarmupCosine(StepSchedule):
    """Linear warm-up, then half a cosine down: one cycle (Smith 2018, with the cosine of Loshchilov and Hutter 2017).

    ``final`` is the rate at the end over the highest, in [0, 1]. Raises ConfigError if a share is out of range.
    """

    def __init__(self, optimizer: Optimizer, *, total_steps: int, warmup: float = 0.05, final: float = 0.01) -> None:
        if not 0 <= final <= 1:
            raise ConfigError(f"schedule.final: {final} is not in [0, 1].")
        self.final = final
        super().__init__(optimizer, total_steps=total_steps, warmup=warmup)

    def factor(self, done: float) -> float:
        """Return the cosine's value."""
        return self.final + (1 - self.final) * (1 + math.cos(math.pi * done)) / 2
