"""Nothing in a training step copies from the CPU or waits for a device: on the device "meta", either is impossible."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from hudepth.base.instantiate import instantiate
from hudepth.base.types import Batch
from hudepth.base.verbs import conf_folder
from hudepth.data.augment import Augmentation
from hudepth.losses.distillation import Distillation
from hudepth.training.module import DepthModule
from tests.data.test_augment import EVERYTHING
from tests.devices import deterministic, staying_on

LOSSES = ("badcl", "berhu", "gradient", "l1", "l2", "mixture", "silog")


def config_of(*overrides: str) -> dict[str, Any]:
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        config: Any = OmegaConf.to_container(compose("train", list(overrides)), resolve=True)
    return dict(config)


@pytest.mark.parametrize(
    "overrides",
    [
        *([f"+experiment={name}", "model.weights=none"] for name in ("badcl", "strong", "pretrain", "demo")),
        *([f"loss={name}", "model=tiny"] for name in LOSSES),
        ["loss=badcl", "loss.scale_per=batch", "loss.scale_mode=align", "model=tiny"],
        ["model=hybrid_unet_text"],
        ["model=hybrid_unet", "model.attention_positions=sine"],
        ["model=resnet18_unet", "model.weights=none"],
    ],
    ids=lambda overrides: ",".join(overrides),
)
def test_a_step_stays_on_its_device(overrides: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # which "meta" does not have
    config = config_of(*overrides)
    distill = Distillation() if "loss=l1" in overrides else None
    module = DepthModule(
        instantiate(config["model"]), instantiate(config["loss"]), max_depth_m=10.0, optimizer=torch.optim.AdamW,
        distill=distill,
    ).to("meta")  # fmt: skip
    depth = torch.rand(2, 1, 64, 64, device="meta")
    batch = Batch(
        image=torch.rand(2, 3, 64, 64, device="meta"), unit_depth=depth, valid=depth > 0,
        index=torch.zeros(2, dtype=torch.int64, device="meta"),
    )  # fmt: skip
    if distill:
        batch["teacher"] = depth
    with staying_on("meta"), deterministic():
        module._step(batch, "train").backward()
    assert all(each.grad is not None for each in module.net.parameters())


def test_augmentation_stays_on_its_device() -> None:
    image, depth = torch.rand(2, 3, 24, 32, device="meta"), torch.rand(2, 2, 24, 32, device="meta")
    draws = {"numbers": torch.rand(21, 2, device="meta"), "noise": torch.randn(2, 3, 24, 32, device="meta")}
    with staying_on("meta"):
        Augmentation(**EVERYTHING).apply(image, depth, size=(24, 32), aspect=4 / 3, draws=draws)
