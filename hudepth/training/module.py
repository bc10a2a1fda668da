"""The LightningModule, which connects network, loss and metrics."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn
from torch.nn import functional
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from hudepth.base.errors import ConfigError, TrainingError
from hudepth.base.types import Batch
from hudepth.cuda import graphs
from hudepth.cuda.steps import StepGraphs
from hudepth.losses.auxiliary import AuxiliaryHeads
from hudepth.losses.distillation import Distillation
from hudepth.metrics.collection import validation_metrics
from hudepth.runs import checkpoint as ckpt
from hudepth.training.averaging import averaged_state
from hudepth.training.means import EpochMeans, Sums
from hudepth.training.optim import fit_state
from hudepth.training.schedules import StepSchedule

CHECK_EVERY = {"cpu": 1}
"""Steps between two checks of the loss, by kind of device; 50 on others, since each check waits for the device."""


def loss_name(stage: str, term: str = "total") -> str:
    """Return the name under which a term of the loss is logged, for example ``train/loss/total``."""
    return f"{stage}/loss/{term}"


class _Step(NamedTuple):
    """A training step whose loss was not checked yet; ``rows`` are the positions of its pairs in the depth store."""

    batch_idx: int
    rows: Tensor
    total: Tensor
    emptied: Tensor


class DepthModule(LightningModule):
    """Trains a depth network.

    Logged: ``train/loss/<term>`` and ``val/loss/<term>``, the total (``total``) and each raw term of the loss as means
    over the epoch; ``val/<metric>``, the metrics of section 3.5 in metres, and SSIM with ``max_depth_m`` as data range.

    Args:
        net: normalised image to unit depth.
        loss: called with prediction, unit depth, image and valid mask; returns :class:`hudepth.base.types.LossTerms`.
        max_depth_m: maximum depth [m]; the network predicts depth / max_depth_m.
        optimizer: makes an optimiser from named parameters.
        scheduler: makes a schedule from an optimiser and the total number of steps: a :class:`StepSchedule` advances
            after every step, others after every epoch. None for a constant rate.
        distill: distance from a teacher's depths, added to the loss of training batches that have them.
        auxiliary: heads that only training has; their losses are added to that of training batches.
        record: plain values stored in each checkpoint, for example ``config``.
        cuda_graph: replay steps on a GPU where they can be recorded; see :class:`hudepth.cuda.steps.StepGraphs`.
    """

    def __init__(
        self,
        net: nn.Module,
        loss: nn.Module,
        *,
        max_depth_m: float,
        optimizer: Callable[[Iterable[tuple[str, nn.Parameter]]], Optimizer],
        scheduler: Callable[[Optimizer, int], LRScheduler] | None = None,
        distill: Distillation | None = None,
        auxiliary: AuxiliaryHeads | None = None,
        record: dict[str, Any] | None = None,
        cuda_graph: bool = True,
    ) -> None:
        super().__init__()
        self.net, self.loss, self.distill, self.max_depth_m = net, loss, distill, max_depth_m
        self.auxiliary = auxiliary.attach(net) if auxiliary else None
        self.val_metrics = validation_metrics(max_depth_m=max_depth_m, prefix="val/")
        self._make_optimizer, self._make_scheduler = optimizer, scheduler
        self._record = record or {}
        self._unchecked: list[_Step] = []
        self._emptied: list[_Step] = []  # in this epoch
        self._losses = {"train": EpochMeans(), "val": EpochMeans()}
        self._graphs = StepGraphs(wanted=cuda_graph)
        self.after_check: Callable[[], None] = lambda: None  # called when a check has waited for the device

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Predict unit depth from normalised images."""
        prediction: Tensor = self.net(image)
        return prediction

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of a batch."""
        total = self._graphs.loss(partial(self._step, stage="train"), batch)
        if self._graphs.mode == "record":
            return total
        emptied = batch["emptied"] if "emptied" in batch else torch.zeros_like(total, dtype=torch.bool)
        self._unchecked.append(_Step(batch_idx, batch["index"], total.detach(), emptied))
        if len(self._unchecked) >= CHECK_EVERY.get(total.device.type, 50):
            self._check_losses()
        return total

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Remember the batch for ``optimizer_step``."""
        self._batch = batch

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        """Take a step as Lightning does, or replay one."""
        usual = partial(super().optimizer_step, epoch, batch_idx, optimizer, optimizer_closure)
        self._graphs.run(usual, optimizer_closure, self._batch)

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Compute the gradients, unless a replay did."""
        if self._graphs.mode != "replay":
            super().backward(loss, *args, **kwargs)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Log the loss of a batch and add it to the metrics."""
        self._step(batch, "val")

    def _step(self, batch: Batch, stage: str) -> Tensor:
        pred = self(batch.get("small_image", batch["image"]))
        if pred.shape != batch["unit_depth"].shape:  # the loss is computed at full size, whatever size it trains at
            pred = functional.interpolate(pred, batch["unit_depth"].shape[-2:], mode="bilinear", align_corners=False)
        loss = self.loss(pred, batch["unit_depth"], batch["image"], batch["valid"])
        total: Tensor = loss.total
        terms = dict(loss.terms)
        if self.distill is not None and "teacher" in batch:
            terms["distill"] = self.distill(pred, batch["teacher"])
            total = total + self.distill.weight * terms["distill"]
        if self.auxiliary is not None and stage == "train":
            further = self.auxiliary(batch["unit_depth"], batch["valid"])
            total, terms = total + further.total, {**terms, **further.terms}
        values = {loss_name(stage, term): value for term, value in {"total": total, **terms}.items()}
        self._losses[stage].add(values, images=len(pred))  # Lightning's log() would cost a tenth of a small step
        if stage == "val":
            depth_m = (x.float() * self.max_depth_m for x in (pred, batch["unit_depth"]))
            self.val_metrics.update(*depth_m, batch["valid"])
        return total

    def on_validation_epoch_end(self) -> None:
        """Log losses and metrics of the whole validation subset."""
        self.log_losses("val")
        self.log_dict({k: v.float() for k, v in self.val_metrics.compute().items()}, sync_dist=True)
        self.val_metrics.reset()

    def losses_so_far(self) -> Sums:
        """Return the sums of this epoch's training losses, on the device."""
        return self._losses["train"].so_far()

    def log_losses(self, stage: str) -> None:
        """Log the losses of an epoch, ``train`` or ``val``, unless it was done, as by the callback LogLosses."""
        means = self._losses[stage].take(partial(self.trainer.strategy.reduce, reduce_op="sum"))
        self.log_dict(means, sync_dist=True)

    def on_train_epoch_end(self) -> None:
        """Check the remaining losses and the weights, before anything is saved."""
        self.log_losses("train")
        self._check_losses()
        self._check_emptied()
        if not bool(torch.stack([each.detach().isfinite().all() for each in self.net.parameters()]).all()):
            raise TrainingError(
                f"weights are no longer finite after epoch {self.current_epoch + 1} (step {self.trainer.global_step}). "
                f"{self._last_good()} Lower optim.lr, or train with trainer.precision=32-true."
            )

    def _check_losses(self) -> None:
        """Check the losses of the steps that were not checked yet, with one transfer from the device if all is well."""
        pending, self._unchecked = self._unchecked, []
        odd = pending and bool(torch.stack([~step.total.isfinite() | step.emptied for step in pending]).any())
        self.after_check()
        if not odd:
            return
        if bad := next((step for step in pending if not bool(step.total.isfinite())), None):
            raise TrainingError(
                f"the loss is {bad.total.item()} {self._where(bad)}. {self._last_good()} "
                "Look at these pairs, lower optim.lr, or train with trainer.precision=32-true."
            )
        self._emptied += [step for step in pending if bool(step.emptied)]

    def _check_emptied(self) -> None:
        """Stop if augmentation leaves most batches without ground truth; single batches may lose it."""
        emptied, self._emptied, batches = self._emptied, [], int(self.trainer.num_training_batches)
        if 2 * len(emptied) > batches:
            raise TrainingError(
                f"augmentation left no measured pixel in {len(emptied)} of {batches} batches, first "
                f"{self._where(emptied[0])}. Lower augment.zoom, augment.rotate_deg or augment.border, or raise "
                "data.batch_size."
            )

    def _where(self, step: _Step) -> str:
        pairs = getattr(getattr(self.trainer, "datamodule", None), "training_pairs", None)
        names = ", ".join(map(getattr(pairs, "pair_id", str), step.rows.tolist()))
        number = self.current_epoch * int(self.trainer.num_training_batches) + step.batch_idx + 1
        return f"in epoch {self.current_epoch + 1}, batch {step.batch_idx} (step {number}), of the pairs {names}"

    def _last_good(self) -> str:
        """Name the last checkpoint, which was written before anything became NaN."""
        if paths := [path for c in self.trainer.checkpoint_callbacks if (path := getattr(c, "best_model_path", ""))]:
            return f"The last good checkpoint is '{paths[-1]}', of epoch {self.current_epoch}."
        return "No epoch was finished, so there is no checkpoint."

    def configure_optimizers(self) -> Any:
        """Return the optimiser and, if there is one, the schedule."""
        further = self.auxiliary.named_parameters(prefix="auxiliary") if self.auxiliary else ()
        optimizer = self._make_optimizer(chain(self.net.named_parameters(), further))
        if getattr(getattr(self._trainer, "precision_plugin", None), "scaler", None) is None:
            # Without a scaler fused updates unscale nothing, but Lightning would refuse to clip their gradients.
            optimizer._step_supports_amp_scaling = False  # type: ignore[attr-defined]
        if self._make_scheduler is None:
            return optimizer
        steps = self.trainer.estimated_stepping_batches  # infinite if the training has no end
        scheduler = self._make_scheduler(optimizer, int(steps) if math.isfinite(steps) else 0)
        interval = "step" if isinstance(scheduler, StepSchedule) else "epoch"
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": interval}}

    def on_train_start(self) -> None:
        """Check what was restored: the optimiser's state, and over how many steps the schedule was laid out."""
        for optimizer in self.trainer.optimizers:
            fit_state(optimizer)
        self._graphs.start(self.trainer)
        scheduler = self.lr_schedulers() if self._make_scheduler else None
        steps = self.trainer.estimated_stepping_batches
        if isinstance(scheduler, StepSchedule) and scheduler.total_steps != steps:
            raise ConfigError(
                f"resume: the learning-rate schedule of this run is laid out over {scheduler.total_steps} steps, and "
                f"now there would be {steps:g}. Leave trainer.accumulate_grad_batches, trainer.limit_train_batches and "
                "the number of devices as they were, or start a new run."
            )

    def on_fit_end(self) -> None:
        """Free the memory of recorded steps."""
        self._graphs.clear()
        graphs.forget()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the configuration and the split, and averaged weights in place of the trained ones if there are any."""
        if (averaged := averaged_state(self._trainer, checkpoint)) is not None:
            checkpoint["state_dict"] = averaged
        checkpoint[ckpt.KEY] = {"version": ckpt.VERSION, **self._record}
