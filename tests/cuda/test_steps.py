"""Replayed training steps: on a stand-in for a GPU, they are the usual ones to the last bit, whatever else is on."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import CSVLogger
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from hudepth.base.errors import TrainingError
from hudepth.cuda import graphs
from hudepth.cuda.steps import StepGraphs
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses import BADCL
from hudepth.models import TinyUNet
from hudepth.training.averaging import EMA
from hudepth.training.callbacks import History, LogLosses
from hudepth.training.loggers.steps import LogSteps
from hudepth.training.module import DepthModule
from hudepth.training.schedules import StepSchedule
from tests.devices import with_graphs

RATE = 2**-7  # a number that float32 holds: the update then computes the same from a number and from a tensor
FUSED = partial(torch.optim.AdamW, fused=True)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


class Rates(Callback):
    """Keeps the learning rates that other callbacks see, the losses they get, and counts replays."""

    def __init__(self) -> None:
        self.rates: list[Any] = []
        self.losses: list[float] = []

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])
        self.losses.append(outputs["loss"].item())


def train(
    cache: Path, *callbacks: Callback, loss: nn.Module | None = None, scheduler: Any = None, progressive: Any = None,
    frames: int = 4, optimizer: Callable[..., Any] = FUSED, graph: bool = True,
    **options: Any,
) -> tuple[DepthModule, Trainer, Rates, History]:  # fmt: skip
    torch.manual_seed(0)
    source = RoomsSource(scenes=6, frames_per_scene=frames, size=(48, 64), holes=True)
    data = DepthDataModule(
        source, size=(32, 48), split="official", batch_size=2, cache=cache, native=False, prepare_workers=1,
        progressive=progressive,
    )  # fmt: skip
    module = DepthModule(
        TinyUNet(channels=4), loss or BADCL(), max_depth_m=10.0, optimizer=partial(optimizer, lr=RATE),
        scheduler=scheduler, cuda_graph=graph,
    )  # fmt: skip
    rates, history = Rates(), History(cache / "metrics.csv")
    trainer = Trainer(
        accelerator="cpu", enable_model_summary=False, enable_progress_bar=False, num_sanity_val_steps=0,
        enable_checkpointing=False, callbacks=[LogLosses(), history, rates, *callbacks],
        **{"max_epochs": 2, "logger": False, **options},
    )  # fmt: skip
    trainer.fit(module, datamodule=data)
    return module, trainer, rates, history


@pytest.fixture
def replays(monkeypatch: pytest.MonkeyPatch) -> list[None]:
    """One entry per replay."""
    seen: list[None] = []
    loss = StepGraphs.loss

    def counting(self: StepGraphs, *arguments: Any) -> Tensor:
        if self.mode == "replay":
            seen.append(None)
        return loss(self, *arguments)

    monkeypatch.setattr(StepGraphs, "loss", counting)
    return seen


def assert_same(one: DepthModule, other: DepthModule) -> None:
    for (name, a), b in zip(one.state_dict().items(), other.state_dict().values(), strict=True):
        assert a.equal(b), name


def halved(optimizer: Any, total_steps: int) -> LambdaLR:
    return LambdaLR(optimizer, lambda epoch: 0.5**epoch)


def strong(steps: int) -> dict[str, Any]:
    return {"scheduler": halved, "gradient_clip_val": 0.5, "max_epochs": steps}


@pytest.mark.parametrize(
    ("options", "make_callbacks"),
    [
        ({}, list),
        (strong(3), lambda: [EMA(decay=0.9)]),
        ({"progressive": [{"size": [16, 32], "until": 0.5}], "max_epochs": 4}, list),
        ({"precision": "bf16-mixed"}, list),
        ({"precision": "bf16-mixed", "gradient_clip_val": 0.5}, list),
    ],
    ids=["plain", "clipped-scheduled-averaged", "progressive", "bf16", "bf16-clipped"],
)
def test_replayed_steps_are_the_usual_ones(
    cache: Path, replays: list[None], options: dict[str, Any], make_callbacks: Any
) -> None:
    usual, _, seen, history = train(cache, *make_callbacks(), **options)
    assert not replays
    with with_graphs():
        replayed, trainer, also_seen, other_history = train(cache, *make_callbacks(), **options)
    # four or five steps an epoch: at each size, and without its last smaller batch, all but the first three
    sizes = 1 + ("progressive" in options)
    assert len(replays) >= trainer.global_step - sizes * graphs.WARM_UPS - trainer.max_epochs > 0
    assert_same(usual, replayed)
    assert also_seen.rates == seen.rates
    assert all(type(rate) is float for rate in also_seen.rates)
    assert also_seen.losses == seen.losses
    assert other_history.rows == history.rows


def test_losses_of_replayed_steps_are_logged(cache: Path, tmp_path: Path, replays: list[None]) -> None:
    options: dict[str, Any] = {"log_every_n_steps": 2, "scheduler": halved}
    train(cache, LogSteps(), logger=CSVLogger(tmp_path, name="usual", version=""), **options)
    with with_graphs():
        train(cache, LogSteps(), logger=CSVLogger(tmp_path, name="replayed", version=""), **options)
    assert replays
    usual, replayed = ((tmp_path / name / "metrics.csv").read_text() for name in ("usual", "replayed"))
    assert replayed == usual
    assert "train/loss/total_step" in usual


def test_the_schedule_reaches_replayed_steps(cache: Path, replays: list[None]) -> None:
    """A rate that were part of the recording would stay what it was in the fourth step."""
    with with_graphs():
        constant, *_ = train(cache, max_epochs=3)
        falling, *_ = train(cache, max_epochs=3, scheduler=lambda o, _: LambdaLR(o, lambda epoch: float(epoch < 1)))
    assert replays
    first, *_ = train(cache, max_epochs=1)
    for (name, a), b in zip(falling.net.named_parameters(), first.net.parameters(), strict=True):
        assert a.equal(b), name
    assert any(not a.equal(b) for a, b in zip(constant.net.parameters(), first.net.parameters(), strict=True))


class Halving(StepSchedule):
    """A rate that falls from step to step, by powers of two: float32 holds them."""

    def factor(self, done: float) -> float:
        return 2.0 ** -round(10 * done)


def halving(optimizer: Any, total_steps: int) -> StepSchedule:
    return Halving(optimizer, total_steps=total_steps)


def test_a_rate_for_each_step(cache: Path, replays: list[None]) -> None:
    usual, *_ = train(cache, scheduler=halving, max_epochs=3)
    with with_graphs():
        replayed, *_ = train(cache, scheduler=halving, max_epochs=3)
    assert replays
    assert_same(usual, replayed)


class Reads(BADCL):
    """A loss that waits for the device."""

    def forward(self, *arguments: Any) -> Any:
        result = super().forward(*arguments)
        assert result.total.item() >= 0
        return result


class LooksAtGradients(Callback):
    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert all(each.grad is not None for each in pl_module.parameters())


class LessDecay(LambdaLR):
    """A schedule that changes something else, too, as OneCycleLR does."""

    def step(self, *arguments: Any) -> None:
        super().step(*arguments)
        self.optimizer.param_groups[0]["weight_decay"] *= 0.5


def less_decay(optimizer: Any, total_steps: int) -> LambdaLR:
    return LessDecay(optimizer, lambda epoch: 1.0)


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: {"loss": Reads()}, "_local_scalar_dense"),
        (lambda: {"callbacks": [LooksAtGradients()]}, "LooksAtGradients looks at gradients"),
        (lambda: {"optimizer": torch.optim.AdamW}, "AdamW is not a fused Adam or AdamW"),
        (lambda: {"optimizer": torch.optim.SGD}, "SGD is not a fused Adam or AdamW"),
        (lambda: {"scheduler": less_decay, "max_epochs": 3}, "a schedule changes more than the learning rate"),
        (lambda: {"detect_anomaly": True}, "trainer.detect_anomaly"),
    ],
    ids=["loss", "callback", "not-fused", "sgd", "more-than-the-rate", "anomaly"],
)
def test_what_cannot_be_recorded_runs_as_usual_after_one_line(
    cache: Path, caplog: pytest.LogCaptureFixture, make: Any, why: str
) -> None:
    options = make()
    usual, *_ = train(cache, *options.pop("callbacks", []), **options)
    options = make()
    with caplog.at_level(logging.INFO, "hudepth"), with_graphs():
        tried, *_ = train(cache, *options.pop("callbacks", []), **options)
    assert_same(usual, tried)
    lines = [line for line in caplog.messages if "not replayed as a CUDA graph" in line]
    assert len(lines) == 1
    assert why in lines[0]


def test_accumulated_gradients_run_as_usual(cache: Path, replays: list[None]) -> None:
    usual, *_ = train(cache, accumulate_grad_batches=2, max_epochs=4)
    with with_graphs():
        tried, *_ = train(cache, accumulate_grad_batches=2, max_epochs=4)
    assert not replays
    assert_same(usual, tried)


def test_it_can_be_switched_off(cache: Path, replays: list[None]) -> None:
    with with_graphs():
        train(cache, graph=False)
    assert not replays


class Poison(Callback):
    """Makes the image of one batch NaN."""

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        if trainer.global_step == 5:
            batch["image"][0, 0, 0, 0] = float("nan")


def test_a_replayed_step_whose_loss_is_not_finite_is_named(cache: Path, replays: list[None]) -> None:
    messages = []
    for context in (torch.enable_grad(), with_graphs()):
        with context, pytest.raises(TrainingError, match=r"the loss is nan .*step 6.*of the pairs") as error:  # type: ignore[attr-defined]
            train(cache, Poison(), max_epochs=3)
        messages.append(str(error.value))
    assert replays
    assert messages[0] == messages[1]


def test_a_step_that_takes_much_of_the_memory_is_not_recorded(
    cache: Path, replays: list[None], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graphs, "used_share", lambda _: 0.6)
    with caplog.at_level(logging.INFO, "hudepth"), with_graphs():
        train(cache)
    assert not replays
    assert any("too little for two" in line for line in caplog.messages)


def test_another_training_of_the_same_module_records_its_own_steps(cache: Path, replays: list[None]) -> None:
    """Its weights may lie elsewhere: Lightning moves them to the CPU and back."""
    with with_graphs():
        module, trainer, *_ = train(cache)
        assert len(replays) > 0
        for each in module.net.parameters():
            each.data = each.data.clone()
        before = [each.clone() for each in module.net.parameters()]
        replays.clear()
        again = Trainer(
            accelerator="cpu", max_epochs=1, enable_progress_bar=False, logger=False, enable_checkpointing=False,
            enable_model_summary=False, callbacks=[LogLosses()], num_sanity_val_steps=0, limit_train_batches=5,
        )  # fmt: skip
        again.fit(module, datamodule=trainer.datamodule)  # type: ignore[attr-defined]
    assert len(replays) == 5 - graphs.WARM_UPS
    assert all(not a.equal(b) for a, b in zip(before, module.net.parameters(), strict=True))


class Device:
    """Stands in for torch.cuda while a recording fails as it does there: its end raises another error."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: list[tuple[str, Any]] = []
        for name in ("_cuda_endAllocateToPool", "_cuda_releasePool"):
            monkeypatch.setattr(
                torch._C, name, lambda *given, name=name: self.calls.append((name, given)), raising=False
            )
        monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: None)
        monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 7))
        monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
        monkeypatch.setattr(torch.cuda, "graph", self.graph)
        monkeypatch.setattr(graphs, "beside", nullcontext)

    @contextmanager
    def graph(self, *_: Any, **__: Any) -> Iterator[None]:
        try:
            yield
        except Exception:
            raise RuntimeError("CUDA error: operation failed due to a previous error during capture")  # noqa: B904


def test_a_failed_recording_tells_its_cause_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    device = Device(monkeypatch)

    def fails() -> None:
        raise ValueError("the cause")

    with pytest.raises(ValueError, match="the cause"):
        graphs.record(fails)
    assert device.calls == [("_cuda_endAllocateToPool", (0, (0, 7))), ("_cuda_releasePool", (0, (0, 7)))]
