from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor, nn

from hudepth.base.errors import ConfigError, TrainingError
from hudepth.base.types import LossTerms
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses import BADCL
from hudepth.metrics.depth import METRIC_NAMES
from hudepth.models import TinyUNet
from hudepth.runs.checkpoint import KEY, VERSION
from hudepth.training.module import DepthModule
from hudepth.training.parts import logged_names

SECTION_3_5 = {"ssim", "mse", "rmse", "abs_rel", "log10", "delta1", "delta2", "delta3"}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def make_data(cache: Path, *, batch_size: int = 3) -> DepthDataModule:
    source = RoomsSource(scenes=6, frames_per_scene=2, size=(48, 64), holes=True)
    return DepthDataModule(
        source, size=(32, 48), split="official", batch_size=batch_size, cache=cache, native=False, prepare_workers=1
    )


def make_module(loss: nn.Module | None = None, *, lr: float = 1e-2, **options: Any) -> DepthModule:
    torch.manual_seed(0)
    options = {"optimizer": partial(torch.optim.SGD, lr=lr), "max_depth_m": 10.0, **options}
    return DepthModule(TinyUNet(), loss or BADCL(), **options)


def make_trainer(*callbacks: Callback, **options: Any) -> Trainer:
    return Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=any(isinstance(callback, ModelCheckpoint) for callback in callbacks),
        enable_model_summary=False,
        enable_progress_bar=False,
        num_sanity_val_steps=0,
        callbacks=list(callbacks),
        **{"max_epochs": 1, **options},
    )


def test_a_loss_of_another_kind_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"loss: L1Loss is not a loss of depth maps"):
        logged_names(nn.L1Loss())


def test_what_is_logged(cache: Path) -> None:
    module, trainer = make_module(), make_trainer()
    trainer.fit(module, datamodule=make_data(cache))
    losses = {f"{stage}/loss/{name}" for stage in ("train", "val") for name in ("total", *BADCL().weights)}
    assert set(trainer.callback_metrics) == losses | {f"val/{name}" for name in (*METRIC_NAMES, "ssim")}
    assert {*METRIC_NAMES, "ssim"} >= SECTION_3_5
    assert all(value.isfinite() for value in trainer.callback_metrics.values())


def numpy_metrics(pred_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    p, t = np.maximum(pred_m[valid], 1e-3), truth_m[valid]
    log = np.log(p) - np.log(t)
    worse = np.maximum(p / t, t / p)
    return {
        "abs_rel": np.mean(np.abs(p - t) / t),
        "rmse": np.sqrt(np.mean((p - t) ** 2)),
        "mse": np.mean((p - t) ** 2),
        "mae": np.mean(np.abs(p - t)),
        "log10": np.mean(np.abs(np.log10(p) - np.log10(t))),
        "silog": 100 * np.sqrt(np.mean(log**2) - np.mean(log) ** 2),
        **{f"delta{k}": np.mean(worse < 1.25**k) for k in (1, 2, 3)},
    }


@pytest.mark.parametrize("batch_size", [1, 2])
def test_validation_metrics_are_those_of_the_whole_subset(cache: Path, batch_size: int) -> None:
    data, module = make_data(cache, batch_size=batch_size), make_module()
    trainer = make_trainer()
    trainer.validate(module, datamodule=data, verbose=False)
    image, stored_depth = data.store.read(data.split.val)
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    normal = torch.from_numpy(((image / 255 - mean) / std).transpose(0, 3, 1, 2)).float()
    with torch.inference_mode():
        pred_m = module.net.eval()(normal).double().numpy()[:, 0] * 10
    truth_m = np.minimum(stored_depth / 1000, 10)
    assert (stored_depth == 0).any()
    each = [numpy_metrics(p, t, t > 0) for p, t in zip(pred_m, truth_m, strict=True)]
    for name in each[0]:
        expected = np.mean([one[name] for one in each])
        assert trainer.callback_metrics[f"val/{name}"].item() == pytest.approx(expected, rel=1e-6, abs=1e-6), name


def test_validation_starts_anew_each_epoch(cache: Path) -> None:
    data, module, trainer = make_data(cache), make_module(lr=0.5), make_trainer(max_epochs=3)
    trainer.fit(module, datamodule=data)
    in_training = {name: value.item() for name, value in trainer.callback_metrics.items() if name.startswith("val/")}
    afterwards = make_trainer().validate(module, datamodule=data, verbose=False)[0]
    assert afterwards == pytest.approx(in_training, rel=1e-6)


class Spy(Callback):
    """Keeps what the module's loss returned for each training batch and the learning rate of each epoch."""

    def __init__(self) -> None:
        self.totals: list[float] = []
        self.rates: list[float] = []

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: Any) -> None:
        self.totals.append(outputs["loss"].item())


def test_training_loss_is_the_mean_over_images(cache: Path) -> None:
    """With 8 pairs in batches of 3 the last batch counts less, in proportion to its images."""
    data, spy = make_data(cache, batch_size=3), Spy()
    trainer = make_trainer(spy)
    trainer.fit(make_module(), datamodule=data)
    n = len(data.split.train)
    sizes = [min(3, n - start) for start in range(0, n, 3)]
    assert len(set(sizes)) == 2
    expected = sum(total * size for total, size in zip(spy.totals, sizes, strict=True)) / n
    assert trainer.callback_metrics["train/loss/total"].item() == pytest.approx(expected, rel=1e-6)


def test_raw_terms_are_logged_apart_from_their_weights(cache: Path) -> None:
    loss = BADCL()
    trainer = make_trainer()
    trainer.fit(make_module(loss), datamodule=make_data(cache))
    for stage in ("train", "val"):
        parts = sum(w * trainer.callback_metrics[f"{stage}/loss/{name}"].item() for name, w in loss.weights.items())
        assert trainer.callback_metrics[f"{stage}/loss/total"].item() == pytest.approx(parts, rel=1e-5)


def test_schedule_steps_once_an_epoch(cache: Path) -> None:
    spy = Spy()
    module = make_module(
        lr=0.8, scheduler=lambda optimizer, _: torch.optim.lr_scheduler.StepLR(optimizer, step_size=1, gamma=0.5)
    )
    make_trainer(spy, max_epochs=4).fit(module, datamodule=make_data(cache))
    assert spy.rates == pytest.approx([0.8, 0.4, 0.2, 0.1])


def test_without_a_schedule_the_rate_is_constant(cache: Path) -> None:
    spy = Spy()
    make_trainer(spy, max_epochs=3).fit(make_module(lr=0.3), datamodule=make_data(cache))
    assert spy.rates == [0.3] * 3


def test_training_lowers_the_loss(cache: Path) -> None:
    spy = Spy()
    make_trainer(spy, max_epochs=5).fit(make_module(lr=0.1), datamodule=make_data(cache, batch_size=8))
    assert spy.totals[-1] < 0.9 * spy.totals[0]


class PoisonedLoss(nn.Module):
    """A loss that is not finite from some call on."""

    def __init__(self, *, good_calls: int, value: float) -> None:
        super().__init__()
        self.left, self.value = good_calls, value

    def forward(self, pred: Tensor, target: Tensor, image: Tensor, valid: Tensor) -> LossTerms:
        self.left -= 1
        total = pred.mean() if self.left >= 0 else pred.mean() * self.value
        return LossTerms(total, {"one": total})


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_before_the_step(cache: Path, value: float) -> None:
    data = make_data(cache)
    batches: list[tuple[list[int], dict[str, Tensor]]] = []

    class Watch(Callback):
        def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, *_: Any) -> None:
            batches.append((batch["index"].tolist(), {k: v.clone() for k, v in pl_module.net.state_dict().items()}))

    module = make_module(PoisonedLoss(good_calls=1, value=value))
    with pytest.raises(TrainingError) as caught:
        make_trainer(Watch()).fit(module, datamodule=data)
    assert len(batches) == 2
    index, before = batches[-1]
    pairs = ", ".join(data.store.records[i].id for i in index)
    assert str(caught.value) == (
        f"the loss is {value} in epoch 1, batch 1 (step 2), of the pairs {pairs}. "
        "No epoch was finished, so there is no checkpoint. "
        "Look at these pairs, lower optim.lr, or train with trainer.precision=32-true."
    )
    for name, parameter in module.net.named_parameters():
        assert torch.equal(parameter, before[name])


def test_a_poisoned_weight_is_found_at_the_first_batch(cache: Path) -> None:
    module = make_module()
    nn.init.constant_(module.net.decode.bias, float("nan"))  # type: ignore[arg-type]
    with pytest.raises(TrainingError, match=r"the loss is nan in epoch 1, batch 0 \(step 1\), of the pairs room_"):
        make_trainer().fit(module, datamodule=make_data(cache))


def test_losses_not_yet_looked_at_are_checked_before_an_epoch_is_saved(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU losses are looked at in lots; here the lot never gets full, as in a short epoch."""
    monkeypatch.setattr("hudepth.training.module.CHECK_EVERY", {"cpu": 50})
    keeper = ModelCheckpoint(tmp_path, "last", save_on_train_epoch_end=True, enable_version_counter=False)
    trainer = make_trainer(keeper, max_epochs=3)
    module = make_module(PoisonedLoss(good_calls=6, value=float("nan")))  # epoch 1: 3 training and 1 validation batch
    with pytest.raises(
        TrainingError, match=r"the loss is nan in epoch 2, batch 2 \(step 6\), of the pairs room_"
    ) as caught:
        trainer.fit(module, datamodule=make_data(cache))
    assert f"The last good checkpoint is '{tmp_path / 'last.ckpt'}', of epoch 1." in str(caught.value)
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["epoch"] == 0


def test_weights_spoilt_by_the_last_step_of_an_epoch_are_found_before_it_is_saved(cache: Path, tmp_path: Path) -> None:
    class Spoil(Callback):
        def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            if trainer.current_epoch == 1 and trainer.is_last_batch:
                nn.init.constant_(pl_module.net.decode.bias, float("nan"))  # type: ignore[arg-type]

    keeper = ModelCheckpoint(tmp_path, "last", save_on_train_epoch_end=True, enable_version_counter=False)
    with pytest.raises(TrainingError) as caught:
        make_trainer(keeper, Spoil(), max_epochs=3).fit(make_module(), datamodule=make_data(cache))
    assert str(caught.value) == (
        f"weights are no longer finite after epoch 2 (step 6). The last good checkpoint is '{tmp_path / 'last.ckpt'}', "
        "of epoch 1. Lower optim.lr, or train with trainer.precision=32-true."
    )


def test_a_bad_validation_loss_does_not_stop_training(cache: Path) -> None:
    module = make_module(PoisonedLoss(good_calls=3, value=float("inf")))  # 3 batches of training, then validation
    trainer = make_trainer()
    trainer.fit(module, datamodule=make_data(cache))
    assert trainer.callback_metrics["val/loss/total"].item() == float("inf")


def test_bf16_mixed(cache: Path) -> None:
    trainer, exact = make_trainer(precision="bf16-mixed"), make_trainer()
    trainer.fit(make_module(), datamodule=make_data(cache))
    exact.fit(make_module(), datamodule=make_data(cache))
    for name, value in exact.callback_metrics.items():
        assert trainer.callback_metrics[name].item() == pytest.approx(value.item(), rel=0.05, abs=0.02), name
    assert trainer.callback_metrics["val/rmse"] != exact.callback_metrics["val/rmse"]


def test_optimizer_gets_the_networks_parameters() -> None:
    seen: list[list[tuple[str, nn.Parameter]]] = []

    def optimizer(parameters: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        named = list(parameters)
        seen.append(named)
        return torch.optim.AdamW(named)

    module = make_module(optimizer=optimizer)
    assert isinstance(module.configure_optimizers(), torch.optim.AdamW)
    assert [(n, id(p)) for n, p in seen[0]] == [(n, id(p)) for n, p in module.net.named_parameters()]


def test_checkpoints_carry_the_record() -> None:
    record = {"config": {"model": {}}, "split": {"sha256": "0"}}
    make: Callable[..., DepthModule] = make_module
    checkpoint: dict[str, Any] = {}
    make(record=record).on_save_checkpoint(checkpoint)
    assert checkpoint == {KEY: {"version": VERSION, **record}}
