"""Freezing the encoder's first stages: for how long, how much of it, and what goes on meanwhile."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses import L1
from hudepth.models import TinyUNet
from hudepth.models.resnet import ResNet18Encoder
from hudepth.training.freezing import FreezeEncoder
from hudepth.training.module import DepthModule

STAGES = ("stem", "layer1", "layer2", "layer3")


class Net(nn.Module):
    """The real encoder and next to nothing after it."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = ResNet18Encoder()
        self.head = nn.ConvTranspose2d(256, 1, 16, stride=16)

    def forward(self, image: Tensor) -> Tensor:
        return torch.sigmoid(self.head(self.encoder(image)[-1]))


class Watch(Callback):
    """Keeps the network's state before each epoch, and which parameters got a gradient in it."""

    def __init__(self) -> None:
        self.states: list[dict[str, Tensor]] = []
        self.learning: list[set[str]] = []

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._keep(pl_module)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        self.learning.append({name for name, p in pl_module.net.named_parameters() if p.grad is not None})  # type: ignore[union-attr]

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._keep(pl_module)

    def _keep(self, pl_module: LightningModule) -> None:
        self.states.append({name: value.clone() for name, value in pl_module.net.state_dict().items()})  # type: ignore[union-attr]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def fit(cache: Path, freeze: FreezeEncoder, net: nn.Module, *, epochs: int) -> Watch:
    data = DepthDataModule(
        RoomsSource(scenes=6, frames_per_scene=2, size=(32, 32)), size=(32, 32), split="official", batch_size=2,
        cache=cache, native=False, prepare_workers=1,
    )  # fmt: skip
    watch = Watch()
    optimizer = partial(
        torch.optim.AdamW, lr=1e-3, weight_decay=0.1
    )  # which would move what has no gradient of its own
    Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_model_summary=False, max_epochs=epochs,
        enable_progress_bar=False, num_sanity_val_steps=0, limit_train_batches=1, limit_val_batches=0,
        callbacks=[freeze, watch],
    ).fit(DepthModule(net, L1(), max_depth_m=10.0, optimizer=optimizer), datamodule=data)  # fmt: skip
    return watch


def stage_of(name: str) -> str:
    part = name.removeprefix("encoder.").split(".")[0]
    return {"conv1": "stem", "bn1": "stem"}.get(part, part)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("until", "stages", "epochs", "frozen"),
    [
        (0.5, ("stem", "layer1"), 4, 2),
        (0.3, ("stem",), 3, 1),
        (1.0, STAGES, 2, 2),
        (1.0, None, 2, 2),
        (0.1, ("stem", "layer1", "layer2"), 2, 0),  # a share that rounds to no epoch
    ],
)
def test_first_stages_stay_as_they_are_until_their_share_is_over(
    cache: Path, until: float, stages: Sequence[str] | None, epochs: int, frozen: int
) -> None:
    torch.manual_seed(0)
    net = Net()
    watch = fit(cache, FreezeEncoder(until=until, stages=stages), net, epochs=epochs)
    names = [name for name, _ in net.named_parameters()]
    kept = {name for name in names if stage_of(name) in (stages or STAGES)}
    assert any(name.startswith("encoder.bn1") for name in kept)
    for epoch, (before, after) in enumerate(zip(watch.states, watch.states[1:], strict=False)):
        still = kept if epoch < frozen else set()
        assert watch.learning[epoch] == set(names) - still
        assert {name for name in names if after[name].equal(before[name])} == still
        for name in before:
            if name.endswith("running_mean"):
                assert not after[name].equal(before[name])  # statistics go on being gathered
    assert all(p.requires_grad == (name not in kept or frozen < epochs) for name, p in net.named_parameters())


@pytest.mark.parametrize(("epoch", "learns"), [(1, False), (2, True)])
def test_a_resumed_run_freezes_as_its_epoch_does(epoch: int, learns: bool) -> None:
    """Lightning skips ``on_train_epoch_start`` in the first epoch after a resume."""
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, max_epochs=4)
    trainer.fit_loop.epoch_progress.current.completed = epoch
    net = Net()
    module = DepthModule(net, L1(), max_depth_m=10.0, optimizer=torch.optim.AdamW)
    freeze = FreezeEncoder(until=0.5, stages=["stem"])
    freeze.setup(trainer, module, "fit")
    freeze.on_train_start(trainer, module)
    assert net.encoder.conv1.weight.requires_grad == learns


def test_frozen_statistics_and_frozen_stages_leave_nothing_to_change(cache: Path) -> None:
    torch.manual_seed(0)
    net = Net()
    net.encoder = ResNet18Encoder(norm="frozen").train()
    watch = fit(cache, FreezeEncoder(until=1.0, stages=("stem", "layer1")), net, epochs=2)
    first, last = watch.states[0], watch.states[-1]
    same = {name for name in first if first[name].equal(last[name])}
    assert {name for name in first if stage_of(name) in ("stem", "layer1")} <= same
    assert "encoder.layer2.0.conv1.weight" not in same


def test_a_share_of_an_endless_training(cache: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        fit(cache, FreezeEncoder(until=0.3), Net(), epochs=-1)
    assert "trainer.max_epochs" in str(caught.value)


def test_several_processes_share_only_what_they_knew_from_the_start() -> None:
    net = Net()
    module = DepthModule(net, L1(), max_depth_m=10.0, optimizer=partial(torch.optim.AdamW, lr=1e-3))
    trainer = Trainer(accelerator="cpu", devices=2, logger=False, enable_checkpointing=False, strategy="ddp")
    with pytest.raises(ConfigError, match=r"^FreezeEncoder\.until: .* processes"):
        FreezeEncoder(until=0.5).setup(trainer, module, "fit")
    FreezeEncoder(until=1, stages=STAGES).setup(trainer, module, "fit")  # before the strategy wraps the module
    assert not any(parameter.requires_grad for parameter in module.net.encoder.parameters())  # type: ignore[union-attr]


def test_a_network_without_a_encoder(cache: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        fit(cache, FreezeEncoder(), TinyUNet(), epochs=1)
    assert "no encoder" in str(caught.value)


@pytest.mark.parametrize("until", [0.0, -0.3, 1.1, math.nan])
def test_a_share_that_is_none(until: float) -> None:
    with pytest.raises(ConfigError) as caught:
        FreezeEncoder(until=until)
    assert str(caught.value).startswith(f"FreezeEncoder.until: {until} ")


@pytest.mark.slow
@pytest.mark.parametrize(
    "stages", [[], ["layer1"], ["stem", "layer2"], ["layer1", "stem"], [*STAGES, "layer4"], ["conv1"]]
)
def test_stages_with_a_gap(cache: Path, stages: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"FreezeEncoder\.stages: .*stem.*layer1.*layer2.*layer3"):
        fit(cache, FreezeEncoder(stages=stages), Net(), epochs=1)
