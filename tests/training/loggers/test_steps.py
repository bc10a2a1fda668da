"""Values between two epochs: the right steps, and nothing that waits for a device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import CSVLogger
from torch.utils._python_dispatch import TorchDispatchMode

from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses import BADCL
from hudepth.models import TinyUNet
from hudepth.training import module as training
from hudepth.training.callbacks import LogLosses
from hudepth.training.loggers.steps import LogSteps
from hudepth.training.module import DepthModule
from tests.training.loggers.readers import Logged, read_csv


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> DepthDataModule:
    source = RoomsSource(scenes=6, frames_per_scene=2, size=(48, 64))
    cache = tmp_path_factory.mktemp("cache")
    return DepthDataModule(
        source, size=(32, 48), split="official", batch_size=1, cache=cache, native=False, prepare_workers=1
    )


def fit(data: DepthDataModule, run: Path, *extra: Callback, groups: int = 1, **options: Any) -> Logged:
    """Train for two epochs of eight batches."""

    def optimizer(parameters: Any) -> torch.optim.Optimizer:
        members = list(parameters)
        parts = [members] if groups == 1 else [members[:2], members[2:]]
        return torch.optim.SGD([{"params": part, "lr": 0.1 * (i + 1)} for i, part in enumerate(parts)])

    torch.manual_seed(0)
    module = DepthModule(
        TinyUNet(channels=4), BADCL(), max_depth_m=10.0, optimizer=optimizer,
        scheduler=lambda optimizer, _: torch.optim.lr_scheduler.StepLR(optimizer, 1, gamma=0.5),
    )  # fmt: skip
    trainer = Trainer(
        accelerator="cpu", enable_model_summary=False, enable_progress_bar=False, enable_checkpointing=False,
        callbacks=[LogLosses(), LogSteps(), *extra], max_epochs=2, logger=CSVLogger(run, name="csv"),
        limit_val_batches=0, **options,
    )  # fmt: skip
    trainer.fit(module, datamodule=data)
    logged = read_csv(run)
    logged.about["losses"] = trainer.callback_metrics
    return logged


def test_steps_are_those_of_the_optimiser(data: DepthDataModule, tmp_path: Path) -> None:
    found = fit(data, tmp_path, log_every_n_steps=3, accumulate_grad_batches=2).curves
    assert sorted(found["train/loss/total_step"]) == [3, 6]  # four steps an epoch
    assert found["lr"] == {3: 0.1, 6: 0.05}  # halved after each epoch


def test_the_last_steps_of_an_epoch_do_not_reach_into_the_next(data: DepthDataModule, tmp_path: Path) -> None:
    """Every third of eight steps an epoch: the value at 9 is that of one batch, which each step has in turn."""
    third = fit(data, tmp_path / "3", log_every_n_steps=3).curves["train/loss/total_step"]
    each = fit(data, tmp_path / "1", log_every_n_steps=1).curves["train/loss/total_step"]
    assert sorted(third) == [3, 6, 9, 12, 15]
    assert third[9] == pytest.approx(each[9], rel=1e-6)
    assert third[12] == pytest.approx(sum(each[step] for step in (10, 11, 12)) / 3, rel=1e-6)


def test_no_interval_logs_no_steps(data: DepthDataModule, tmp_path: Path) -> None:
    found = fit(data, tmp_path, log_every_n_steps=0).curves
    assert "train/loss/total" in found
    assert not {"train/loss/total_step", "lr"} & found.keys()


def test_groups_of_parameters_have_rates_of_their_own(data: DepthDataModule, tmp_path: Path) -> None:
    found = fit(data, tmp_path, groups=2, log_every_n_steps=8).curves
    assert found["lr/0"] == {8: 0.1, 16: 0.05}
    assert found["lr/1"] == {8: 0.2, 16: 0.1}


class Waits(TorchDispatchMode, Callback):
    """Counts, in training batches, what would wait for a device: numbers read from tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.inside, self.count = False, 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += self.inside and func is torch.ops.aten._local_scalar_dense.default
        return func(*args, **(kwargs or {}))

    def on_train_batch_start(self, *_: Any) -> None:
        self.inside = True

    def on_train_batch_end(self, *_: Any) -> None:
        self.inside = False


@contextmanager
def checked_every(steps: int) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "CHECK_EVERY", {"cpu": steps})
        yield


def test_values_are_read_when_the_losses_are_checked(data: DepthDataModule, tmp_path: Path) -> None:
    """As on a GPU, where the check of the losses waits for the device every so often."""
    counts, curves = {}, {}
    for every, checks in ((0, 50), (2, 50), (2, 4), (0, 4)):
        waits = Waits()
        with checked_every(checks), waits:
            logged = fit(data, tmp_path / f"{every}-{checks}", waits, log_every_n_steps=every)
        counts[every, checks], curves[every, checks] = waits.count, logged.curves
    assert counts[2, 50] == counts[0, 50] == 0  # all is read at the end of the epoch
    assert counts[0, 4] == 4  # one for each check, in sixteen steps
    assert counts[2, 4] > counts[0, 4]
    assert curves[2, 50]["train/loss/total_step"] == curves[2, 4]["train/loss/total_step"]
    assert sorted(curves[2, 4]["train/loss/total_step"]) == [2, 4, 6, 8, 10, 12, 14, 16]
