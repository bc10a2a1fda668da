"""The averaged weights: the formula, that they are what is judged and kept, and that training does not notice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from hudepth.base.errors import ConfigError, TrainingError
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses import BADCL
from hudepth.models import TinyUNet
from hudepth.runs.checkpoint import read_plain
from hudepth.runs.history import read_history
from hudepth.training.averaging import EMA, averaged_state
from hudepth.training.callbacks import History, LogLosses
from hudepth.training.checkpointing import AtomicCheckpointIO, checkpoint_callbacks
from hudepth.training.module import DepthModule


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def make_data(cache: Path) -> DepthDataModule:
    source = RoomsSource(scenes=6, frames_per_scene=2, size=(48, 64), holes=True)
    return DepthDataModule(
        source, size=(32, 48), split="official", batch_size=3, cache=cache, native=False, prepare_workers=1
    )


def make_module() -> DepthModule:
    torch.manual_seed(0)
    return DepthModule(
        TinyUNet(channels=4), BADCL(), max_depth_m=10.0, optimizer=partial(torch.optim.AdamW, lr=1e-2)
    )  # fmt: skip


def fit(cache: Path, run: Path, callbacks: Sequence[Callback], *, resume: bool = False, epochs: int = 3) -> DepthModule:
    trainer = Trainer(
        accelerator="cpu", enable_model_summary=False, enable_progress_bar=False, num_sanity_val_steps=0,
        callbacks=[
            LogLosses(),
            History(run / "metrics.csv"), *callbacks, *checkpoint_callbacks(run, monitor="val/abs_rel", mode="min")
        ],
        plugins=[AtomicCheckpointIO()], max_epochs=epochs, logger=False,
    )  # fmt: skip
    module = make_module()
    last = run / "checkpoints" / "last.ckpt"
    trainer.fit(module, datamodule=make_data(cache), ckpt_path=last if resume else None, weights_only=True)
    return module


class Watch(Callback):
    """Keeps the network's state after each step, and the state that each validation sees."""

    def __init__(self) -> None:
        self.steps: list[dict[str, Tensor]] = []
        self.validated: list[dict[str, Tensor]] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        self.steps.append({name: value.clone() for name, value in pl_module.state_dict().items()})

    def on_validation_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        self.validated.append({name: value.clone() for name, value in pl_module.state_dict().items()})


class StopAt(Callback):
    """Ends a run in the middle of an epoch, as a kill does."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if trainer.current_epoch + 1 == self.epoch:
            raise TrainingError("killed")


def average(states: Sequence[dict[str, Tensor]], *, decay: float) -> dict[str, np.ndarray]:
    """The recurrence in numpy: the first state as it is, then what the decay leaves of the average so far."""
    mean = {name: value.double().numpy() for name, value in states[0].items()}
    for n, state in enumerate(states[1:], start=1):
        d = min(decay, (1 + n) / (10 + n))
        for name, value in state.items():
            now = value.double().numpy()
            mean[name] = d * mean[name] + (1 - d) * now if value.is_floating_point() else now
    return mean


def assert_close(state: dict[str, Tensor], expected: dict[str, np.ndarray]) -> None:
    assert set(state) == set(expected)
    for name, value in state.items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-5, atol=1e-6, err_msg=name)


def equal(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return set(one) == set(other) and all(value.equal(other[name]) for name, value in one.items())


# --- the formula ------------------------------------------------------------------------------------------------


@given(steps=st.integers(1, 10_000), decay=st.floats(0, 0.9999), seed=st.integers(0, 100))
def test_one_step_of_the_average(steps: int, decay: float, seed: int) -> None:
    torch.manual_seed(seed)
    ema = EMA(decay=decay)
    ema._latest_update_step = steps
    means, now = [torch.randn(3, 2), torch.randn(4)], [torch.randn(3, 2), torch.randn(4)]
    d = min(decay, (1 + steps) / (10 + steps))
    expected = [d * mean.double() + (1 - d) * x.double() for mean, x in zip(means, now, strict=True)]
    before = [x.clone() for x in now]
    ema._average(means, now, torch.tensor(steps))
    for mean, value in zip(means, expected, strict=True):
        torch.testing.assert_close(mean.double(), value, rtol=1e-5, atol=1e-6)
    assert all(a.equal(b) for a, b in zip(now, before, strict=True))


@pytest.mark.parametrize(
    ("steps", "share"), [(1, 9 / 11), (2, 9 / 12), (8, 0.5), (80, 0.1), (430, 9 / 440), (440, 0.02), (10_000, 0.02)]
)
def test_how_much_the_new_weights_count(steps: int, share: float) -> None:
    """Much at first, so that an early average is not that of the first step; by 0.98, two hundredths in the end."""
    ema = EMA(decay=0.98)
    ema._latest_update_step = steps
    mean = [torch.zeros(1, dtype=torch.float64)]
    ema._average(mean, [torch.ones(1, dtype=torch.float64)], torch.tensor(steps))
    assert mean[0].item() == pytest.approx(share)


def test_counters_are_copied_and_statistics_averaged() -> None:
    torch.manual_seed(0)
    ema, net = EMA(decay=0.5), torch.nn.BatchNorm1d(2)
    model = AveragedModel(net, multi_avg_fn=ema._average, use_buffers=True)
    states = []
    for step in range(1, 4):
        net(torch.randn(8, 2) + 3)
        model.update_parameters(net)
        ema._latest_update_step = step
        states.append({name: value.clone() for name, value in net.state_dict().items()})
    found = dict(model.module.state_dict())
    assert found["num_batches_tracked"].item() == 3
    assert_close(found, average(states, decay=0.5))


def test_a_network_without_counters() -> None:
    ema, net, trainer = EMA(decay=0.5), LightningModule(), Mock(Trainer)
    net.weight = torch.nn.Parameter(torch.zeros(2, 2))
    ema._average_model = AveragedModel(net, use_buffers=True)
    ema.on_train_start(trainer, net)
    states = []
    for step in (1, 2, 3):
        torch.nn.init.normal_(net.get_parameter("weight"))
        trainer.global_step = step
        ema.on_train_batch_end(trainer, net)
        states.append({name: value.clone() for name, value in net.state_dict().items()})
    assert_close(dict(ema._average_model.module.state_dict()), average(states, decay=0.5))


@pytest.mark.parametrize("decay", [1.0, -0.1, 2, math.nan])
def test_a_decay_that_is_none(decay: float) -> None:
    with pytest.raises(ConfigError) as caught:
        EMA(decay=decay)
    assert str(caught.value) == f"EMA.decay: {decay} is not in [0, 1). The usual values are 0.99 to 0.9999."


# --- in a training ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_average_validates_and_is_kept_and_training_does_not_notice(cache: Path, tmp_path: Path) -> None:
    plain, watch = Watch(), Watch()
    fit(cache, tmp_path / "plain", [plain])
    every = ModelCheckpoint(
        tmp_path / "every", "{epoch}", save_top_k=-1, save_weights_only=True, save_on_train_epoch_end=True
    )
    module = fit(cache, tmp_path / "ema", [EMA(decay=0.7), watch, every])
    steps = len(watch.steps)
    assert steps == 9
    assert all(equal(a, b) for a, b in zip(plain.steps, watch.steps, strict=True))
    for epoch in range(3):
        expected = average(watch.steps[: 3 * (epoch + 1)], decay=0.7)
        assert_close(watch.validated[epoch], expected)
        saved = read_plain(tmp_path / "every" / f"epoch={epoch}.ckpt")
        assert "current_model_state" not in saved
        assert equal(saved["state_dict"], watch.validated[epoch])
        assert not equal(saved["state_dict"], watch.steps[3 * epoch + 2])
    assert equal(dict(module.state_dict()), watch.validated[-1])  # what is left in memory


@pytest.mark.slow
def test_best_holds_the_average_alone_and_last_the_weights_beside_it(cache: Path, tmp_path: Path) -> None:
    watch = Watch()
    fit(cache, tmp_path, [EMA(decay=0.7), watch])
    best, last = (read_plain(tmp_path / "checkpoints" / f"{name}.ckpt") for name in ("best", "last"))
    assert "current_model_state" not in best
    assert equal(best["state_dict"], watch.validated[best["epoch"]])
    assert equal(last["state_dict"], watch.validated[-1])
    assert equal(last["current_model_state"], watch.steps[-1])
    assert last["averaging_state"]["n_averaged"].item() == 9


@pytest.mark.slow
def test_the_metrics_of_an_epoch_are_those_of_the_average(cache: Path, tmp_path: Path) -> None:
    fit(cache, tmp_path, [EMA(decay=0.7)])
    last = read_plain(tmp_path / "checkpoints" / "last.ckpt")
    row = read_history(tmp_path / "metrics.csv")[-1]
    scores = {}
    for key in ("state_dict", "current_model_state"):
        module = make_module()
        module.load_state_dict(last[key])
        trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)
        scores[key] = trainer.validate(module, datamodule=make_data(cache), verbose=False)[0]["val/abs_rel"]
    assert row["val/abs_rel"] == pytest.approx(scores["state_dict"], rel=1e-6)
    assert row["val/abs_rel"] != pytest.approx(scores["current_model_state"], rel=1e-4)


def test_a_resumed_run_averages_as_if_it_had_never_stopped(cache: Path, tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    fit(cache, whole, [EMA(decay=0.9)])
    with pytest.raises(TrainingError, match="killed"):
        fit(cache, broken, [EMA(decay=0.9), StopAt(3)])
    fit(cache, broken, [EMA(decay=0.9)], resume=True)
    ours, theirs = (read_plain(run / "checkpoints" / "last.ckpt") for run in (broken, whole))
    for key in ("state_dict", "current_model_state", "averaging_state"):
        assert equal(ours[key], theirs[key])
    assert (broken / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()


def test_without_an_average_checkpoints_are_left_as_they_are() -> None:
    assert averaged_state(None, {}) is None
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, callbacks=[EMA()])
    assert averaged_state(trainer, {}) is None  # it has not begun
