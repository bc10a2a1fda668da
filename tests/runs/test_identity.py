from __future__ import annotations

import json
from typing import Any

import pytest

from hudepth.runs.identity import RESUMABLE, identity, is_below, part_bound_to_length, run_key

CONFIG: dict[str, Any] = {
    "name": "x", "seed": 1, "monitor": "val/abs_rel", "test": True, "variant": None, "protocol": {"paper": {}},
    "data": {"root": "a", "cache": "b", "size": [224, 224], "seed": 1, "batch_size": 8},
    "model": {"weights": "imagenet"}, "loss": {"_target_": "L1"}, "paths": {"runs": "runs"},
    "trainer": {"max_epochs": 4, "devices": 1, "accelerator": "cpu"}, "callbacks": {"panels": 6, "extra": []},
}  # fmt: skip


def changed(key: str, value: Any) -> dict[str, Any]:
    config = json.loads(json.dumps(CONFIG))
    part, _, name = key.rpartition(".")
    (config[part] if part else config)[name] = value
    return dict(config)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("name", "y"), ("test", False), ("baselines", False), ("variant", "l1"), ("protocol", {"eigen": {}}),
        ("sweep_dir", "s"), ("data.root", "/elsewhere"), ("data.cache", "/c"), ("data.num_workers", 4),
        ("paths.runs", "other"), ("trainer.devices", [1]), ("trainer.accelerator", "gpu"), ("callbacks.panels", 0),
    ],
)  # fmt: skip
def test_where_and_how_it_runs_does_not_make_another_training(key: str, value: Any) -> None:
    assert run_key(changed(key, value)) == run_key(CONFIG)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("seed", 2), ("data.seed", 2), ("data.size", [112, 112]), ("model.weights", "none"), ("loss._target_", "L2"),
        ("trainer.max_epochs", 5), ("callbacks.extra", [1]), ("data.split_seed", 1), ("monitor", "val/rmse"),
    ],
)  # fmt: skip
def test_what_is_trained_does(key: str, value: Any) -> None:
    assert run_key(changed(key, value)) != run_key(CONFIG)


def test_a_further_option_that_is_null_does_not_make_another_training() -> None:
    assert run_key(changed("auxiliary", {"_target_": None})) == run_key(CONFIG)
    assert run_key(changed("data.fov_deg", None)) == run_key(CONFIG)
    assert run_key(changed("auxiliary", {"_target_": "x"})) != run_key(CONFIG)


def test_one_is_one_however_it_is_written() -> None:
    assert run_key(changed("loss.boundary", 1)) == run_key(changed("loss.boundary", 1.0))
    assert run_key(changed("data.size", [224.0, 224])) == run_key(CONFIG)
    assert run_key(changed("loss.x", True)) != run_key(changed("loss.x", 1))
    assert run_key(changed("loss.x", "1")) != run_key(changed("loss.x", 1))


def test_identity_has_dotted_keys_in_order() -> None:
    keys = list(identity(CONFIG))
    assert keys == sorted(keys)
    assert "trainer.max_epochs" in keys
    assert not {"name", "data.root", "paths.runs"} & set(keys)


@pytest.mark.parametrize(
    ("key", "may"),
    [
        ("trainer.max_epochs", True), ("callbacks.panels", True), ("logger.tensorboard", True), ("data.root", True),
        ("test", True), ("protocol.eigen.factor", True), ("distill.teacher", True), ("seed", False), ("name", False),
        ("optim.lr", False), ("data.size", False), ("data.rooted", False), ("testing", False), ("loss", False),
    ],
)  # fmt: skip
def test_what_may_change_when_a_run_is_resumed(key: str, may: bool) -> None:
    assert is_below(key, RESUMABLE) is may


@pytest.mark.parametrize(
    ("key", "value", "part"),
    [
        ("schedule.T_max", 3, "schedule"), ("schedule._target_", "hudepth.training.schedules.WarmupCosine", "schedule"),
        ("data.progressive", [{"size": [8, 8], "until": 0.5}], "progressive"),
        ("callbacks.extra", [{"_target_": "hudepth.training.freezing.FreezeEncoder"}], "Freeze"), ("seed", 2, ""),
    ],
)  # fmt: skip
def test_the_part_that_depends_on_the_length_is_named(key: str, value: Any, part: str) -> None:
    config = {**CONFIG, "schedule": {"_target_": "torch.optim.lr_scheduler.StepLR"}}
    group, _, name = key.partition(".")
    config[group] = {**config[group], name: value} if name else value
    found = part_bound_to_length(config)
    assert part in found if part else not found
