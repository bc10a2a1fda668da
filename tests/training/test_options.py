from __future__ import annotations

import os
from typing import Any

import pytest
from hydra import compose, initialize_config_dir

from hudepth.base.errors import ConfigError
from hudepth.base.options import plain
from hudepth.base.verbs import conf_folder
from hudepth.training.options import parse_options


@pytest.fixture(scope="module")
def config() -> dict[str, Any]:
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        return plain(compose("train", overrides=["model=tiny", "trainer.accelerator=cpu"]))


def changed(config: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    group, _, name = key.partition(".")
    return {**config, group: {**config[group], name: value} if name else value}


def test_the_configuration_of_the_package_is_valid(config: dict[str, Any]) -> None:
    options = parse_options(config)
    assert (options.seed, options.mode, options.memory_format) == (42, "min", "auto")
    assert (options.trainer.max_epochs, options.callbacks.panels) == (30, 6)
    assert options.logger.chosen() == {"tensorboard": config["logger"]["tensorboard"]}


def test_options_that_old_runs_lack_have_defaults(config: dict[str, Any]) -> None:
    old = {key: value for key, value in config.items() if key not in ("memory_format", "compile", "baselines", "init")}
    assert parse_options(old) == parse_options(config)


def test_old_runs_have_a_switch_for_tensorboard(config: dict[str, Any]) -> None:
    for switch, chosen in ((True, {"tensorboard": {}}), (False, {})):
        old = {**config, "logger": {"tensorboard": switch, "extra": []}}
        assert parse_options(old).logger.chosen() == chosen


@pytest.mark.parametrize(
    ("key", "value", "word"),
    [
        ("seed", "abc", "whole number"), ("seed", -1, "at least 0"), ("seed", True, "whole number"),
        ("mode", "mni", "Did you mean 'min'"), ("memory_format", "channels_lst", "Did you mean 'channels_last'"),
        ("compile", "maybe", "true or false"), ("test", 1, "true or false"), ("name", "../x", "folder"),
        ("name", None, "not set"), ("callbacks.panels", -1, "at least 0"), ("callbacks.panels", 1.5, "whole number"),
        ("callbacks.panels_every_n_epochs", 0, "at least 1"), ("callbacks.extra", 3, "list"),
        ("logger.tensorboard", "no", "true or false"), ("logger.wandb", True, "mapping of options"),
        ("trainer.log_every_n_steps", -1, "at least 0"), ("trainer.accumulate_grad_batches", 0, "at least 1"),
        ("trainer.gradient_clip_val", -1, "at least 0"), ("trainer.precision", "bf16-true", "loses updates"),
        ("trainer.max_epochs", 2.5, "whole number"), ("trainer.limit_val_batches", "/", "number"),
        ("trainer.limit_train_batches", -1, "number"), ("trainer.limit_test_batches", 1.5, "number"),
    ],
)  # fmt: skip
def test_mistakes(config: dict[str, Any], key: str, value: Any, word: str) -> None:
    with pytest.raises(ConfigError, match=rf"^{key}:? .*{word}"):
        parse_options(changed(config, key, value))


@pytest.mark.parametrize(
    ("kind", "option", "value", "word"),
    [("wandb", "offline", "yes", "true or false"), ("mlflow", "tracking_uri", [1], "text")],
)
def test_mistakes_in_the_options_of_a_logger(
    config: dict[str, Any], kind: str, option: str, value: Any, word: str
) -> None:
    with pytest.raises(ConfigError, match=rf"^logger\.{kind}\.{option}: .*{word}"):
        parse_options(changed(config, f"logger.{kind}", {option: value}))


def test_what_cannot_be_combined(config: dict[str, Any]) -> None:
    model = {**config["model"], "recompute": True}
    with pytest.raises(ConfigError, match=r"^compile: .*recompute"):
        parse_options({**config, "compile": True, "model": model})


def test_one_trusted_package_is_a_list(config: dict[str, Any]) -> None:
    assert parse_options({**config, "trust": "my_package"}).trust == ["my_package"]


def test_a_path_that_a_run_could_not_record(config: dict[str, Any]) -> None:
    root = os.fsdecode(b"K\xfcche")
    with pytest.raises(ConfigError, match=r"^data\.root: 'K.*che' is not UTF-8\. Pass a link") as caught:
        parse_options({**config, "data": {"root": root}})
    str(caught.value).encode()
