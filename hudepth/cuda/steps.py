"""The training steps of a LightningModule as CUDA graphs: loss, gradients, clipping and update in one launch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import Any, Literal, NamedTuple

import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.strategies import SingleDeviceStrategy
from lightning.pytorch.utilities.model_helpers import is_overridden
from torch import Tensor
from torch.optim import Optimizer

from hudepth.base.console import log
from hudepth.base.errors import first_line
from hudepth.cuda import graphs

_UNSEEN = ("on_before_zero_grad", "on_before_backward", "on_after_backward", "on_before_optimizer_step")
"""Hooks that would not be called in a replayed step, or would find no gradients."""
_READ_LATER = ("index", "emptied")
"""Parts of a batch that a step does not compute from."""

MOST_MEMORY = 0.45
"""Share of the device's memory that a step may take to be recorded: other batches need as much beside it."""


class _Step(NamedTuple):
    """A recorded step: where it reads its batch, and the settings of the optimiser that are part of it."""

    inputs: dict[str, Tensor]
    recording: graphs.Recording
    settings: list[dict[str, Any]]


class StepGraphs:
    """Records the steps of a training, one for each shape of the batch, and replays them.

    Recorded is what Lightning itself does in a step, from the module's loss to the optimiser's update. Only the
    learning rate may change afterwards. Steps that cannot be recorded run as usual, after one line in the log.

    A module passes its ``optimizer_step`` through :meth:`run` and its loss through :meth:`loss`, and has nothing to do
    in ``backward`` while :attr:`mode` is "replay".

    Args:
        wanted: False never records.
    """

    def __init__(self, *, wanted: bool = True) -> None:
        self.wanted = self._asked = wanted
        self.mode: Literal["usual", "record", "replay"] = "usual"  #: how the next step is run
        self.clear()

    def start(self, trainer: Trainer) -> None:
        """Find out whether the steps of this training can be recorded; log why if a GPU's cannot."""
        self.clear()
        self._trainer = trainer
        self.wanted = self._asked and graphs.has_graphs(trainer.strategy.root_device)
        if self.wanted and (why := _obstacle(trainer)):
            self._give_up(why)

    def clear(self) -> None:
        """Forget all steps, and free their memory: another training has other weights in other places."""
        self._steps: dict[Any, _Step] = {}
        self._seen: Counter[Any] = Counter()
        self._rates: list[Tensor] = []
        self._rates_there: list[float] = []
        self._pool: Any = None

    def loss(self, compute: Callable[[Mapping[str, Any]], Tensor], batch: Mapping[str, Any]) -> Tensor:
        """Return the loss of a batch; a replay computes all that follows from it, too."""
        if self.mode == "replay":
            self._step.recording.replay()
            loss: Tensor = self._step.recording.results.clone()  # the next replay overwrites it
            return loss
        if self.mode == "usual":
            return compute(batch)
        total = compute({**batch, **self._inputs})
        self._recorded_loss = total.detach()
        return total

    def run(self, step: Callable[[], Any], closure: Callable[[], Any], batch: Mapping[str, Any]) -> None:
        """Take a step: ``step`` is Lightning's own, and ``closure`` the part of it that computes loss and gradients."""
        if not self.wanted or self._trainer.accumulate_grad_batches != 1:  # callbacks may change the latter
            step()
            return
        optimizer = self._trainer.optimizers[0]
        tensors = {name: x for name, x in batch.items() if isinstance(x, Tensor) and name not in _READ_LATER}
        with self._rates_on_device(optimizer):
            recorded = self._find(step, tensors, optimizer)
            if recorded is None:
                with graphs.beside() if self.wanted else nullcontext():
                    step()
                return
            torch._foreach_copy_(list(recorded.inputs.values()), list(tensors.values()))
            self.mode, self._step = "replay", recorded
            try:
                closure()
            finally:
                self.mode = "usual"

    def _find(self, step: Callable[[], Any], tensors: dict[str, Tensor], optimizer: Optimizer) -> _Step | None:
        """Return the recorded step for these shapes; record it if enough steps like it ran as usual."""
        shapes = tuple((name, x.shape, x.dtype) for name, x in tensors.items())
        key = shapes, tuple(x.requires_grad for group in optimizer.param_groups for x in group["params"])
        settings = _settings(optimizer)
        if (known := self._steps.get(key)) and known.settings != settings:
            self._give_up("a schedule changes more than the learning rate")
            return None
        if known:
            return known
        self._seen[key] += 1
        if self._seen[key] <= graphs.WARM_UPS:
            return None
        if not self._steps and graphs.used_share(self._trainer.strategy.root_device) > MOST_MEMORY:
            self._give_up("a recorded step holds its memory for itself, and there is too little for two")
            return None
        try:
            self._steps[key] = self._record(step, tensors, optimizer)
        except Exception as error:  # networks, losses and callbacks may do anything, and training goes on without
            optimizer.zero_grad()
            self._give_up(first_line(error))
            return None
        sizes = ", ".join(f"{name} {' x '.join(map(str, x.shape))}" for name, x in tensors.items())
        log.info("training steps of %s are replayed as a CUDA graph", sizes)
        return self._steps[key]

    def _record(self, step: Callable[[], Any], tensors: dict[str, Tensor], optimizer: Optimizer) -> _Step:
        self._inputs = {name: torch.empty_like(x) for name, x in tensors.items()}
        settings = _settings(optimizer)
        self.mode = "record"
        for group in optimizer.param_groups:
            group["capturable"] = True  # nothing else: a fused update always is
        try:
            recording = graphs.record(step, pool=self._pool)
        finally:
            self.mode = "usual"
            for group in optimizer.param_groups:
                group["capturable"] = False
        self._pool = recording.pool
        return _Step(self._inputs, recording._replace(results=self._recorded_loss), settings)

    @contextmanager
    def _rates_on_device(self, optimizer: Optimizer) -> Iterator[None]:
        """Let the optimiser read its rates from the device: numbers would be part of a recording."""
        rates = [float(group["lr"]) for group in optimizer.param_groups]
        if rates != self._rates_there:
            device = self._trainer.strategy.root_device
            self._rates = self._rates or [torch.zeros((), device=device) for _ in rates]
            for tensor, rate in zip(self._rates, rates, strict=True):
                tensor.fill_(rate)
            self._rates_there = rates
        for group, tensor in zip(optimizer.param_groups, self._rates, strict=True):
            group["lr"] = tensor
        try:
            yield
        finally:
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate

    def _give_up(self, why: str) -> None:
        log.info("training steps are not replayed as a CUDA graph, and slower: %s", why)
        self.wanted = False
        self._steps.clear()


def _settings(optimizer: Optimizer) -> list[dict[str, Any]]:
    left_out = ("params", "lr", "initial_lr")
    return [{key: x for key, x in group.items() if key not in left_out} for group in optimizer.param_groups]


def _obstacle(trainer: Trainer) -> str:
    """Return why the steps of a training cannot be recorded; empty if they can."""
    if not isinstance(trainer.strategy, SingleDeviceStrategy):
        return f"{type(trainer.strategy).__name__} shares gradients among processes"
    if trainer.accumulate_grad_batches != 1:
        return f"trainer.accumulate_grad_batches={trainer.accumulate_grad_batches} adds up gradients"
    if getattr(trainer.precision_plugin, "scaler", None) is not None:
        return f"trainer.precision={trainer.precision} scales gradients"
    if trainer._detect_anomaly:
        return "trainer.detect_anomaly looks at every operation"
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if any(is_overridden(hook, callback, Callback) for hook in _UNSEEN):
            return f"{type(callback).__name__} looks at gradients"
    for optimizer in trainer.optimizers:
        if not all(group.get("fused") and group.get("capturable") is False for group in optimizer.param_groups):
            return f"{type(optimizer).__name__} is not a fused Adam or AdamW"
    return ""
