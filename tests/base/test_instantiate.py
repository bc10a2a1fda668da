from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.instantiate import TRUSTED, instantiate
from hudepth.losses import BADCL
from hudepth.models import HybridUNet, TinyUNet

NAMED = ", ".join(prefix.rstrip(".") for prefix in TRUSTED)


def refused(config: object, **options: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        instantiate(config, **options)
    return str(caught.value)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "subprocess.Popen",
        "torch.hub.load",
        "torch.load",
        "torch.jit.load",
        "importlib.import_module",
        "pathlib.Path",
        "pickle.Unpickler",
        "eval",
        "",
        "torch.nnx.Linear",
        "hudepth_evil.Net",
        "lightning.pytorch.Trainer",
    ],
)
def test_outside_the_trusted_modules(target: str) -> None:
    assert refused({"_target_": target, "command": "echo x"}) == (
        f"_target_: '{target}' is not under a trusted module ({NAMED}). "
        f"If it is your own code, pass trust=[{target.split('.')[0]}]."
    )


@pytest.mark.parametrize(
    ("target", "why"),
    [
        ("hudepth.base.files.os.system", "No module named 'hudepth.base.files.os'"),
        ("hudepth.runs.run_dir.subprocess.Popen", "No module named 'hudepth.runs.run_dir.subprocess'"),
        ("hudepth.nothing.Net", "No module named 'hudepth.nothing'"),
        ("torch.nn.Module.__class__", "No module named 'torch.nn.Module'"),
        ("hudepth.models..TinyUNet", "No module named 'hudepth.models.'"),
    ],
)  # fmt: skip
def test_no_such_module(target: str, why: str) -> None:
    assert f"'{target}' cannot be imported ({why}" in refused({"_target_": target})


@pytest.mark.parametrize(
    "target",
    [
        "hudepth.base.files.os",  # a module that a trusted one imported
        "hudepth.base.files.Path",  # a class, but pathlib's
        "hudepth.models.resnet.Path",
        "hudepth.runs.run_dir.subprocess",
        "hudepth.base.files.write_text",  # hudepth's own, but a function
        "hudepth.runs.run_dir.create",
        "hudepth.base.instantiate.instantiate",
        "hudepth.cli.train",
        "hudepth.runs.checkpoint.TorchCheckpointIO",  # a class, but Lightning's
        "hudepth.models.options.T",
        "torch.nn.functional.relu",
        "torch.nn.init.kaiming_normal_",
        "torch.nn.modules.module.OrderedDict",
        "torch.nn.modules.module.warnings",
        "torch.nn.__class__",
        "torch.nn.",
        "torch.optim.lr_scheduler.partial",
    ],
)
def test_no_class_of_a_trusted_module(target: str) -> None:
    message = refused({"_target_": target, "path": "x", "text": "x"})
    assert (
        message.partition(" Did you mean")[0].partition(" If you")[0]
        == f"_target_: '{target}' is not a class of a trusted module."
    )


def test_misspelt_class() -> None:
    assert refused({"_target_": "hudepth.models.HybridUnet"}) == (
        "_target_: 'hudepth.models.HybridUnet' is not a class of a trusted module. Did you mean 'HybridUNet'?"
    )


@pytest.mark.slow
def test_every_function_and_module_of_hudepth_is_refused() -> None:
    """Whatever a module of hudepth imports, it is no way to anything but classes of the trusted modules."""
    import hudepth.training.callbacks
    import hudepth.training.command  # noqa: F401

    tried = 0
    for module_name, module in list(sys.modules.items()):
        if not module_name.startswith("hudepth."):
            continue
        for name, value in vars(module).items():
            own = isinstance(value, type) and f"{value.__module__}.".startswith(TRUSTED)
            if not own:
                tried += 1
                assert "is not a class of a trusted module" in refused({"_target_": f"{module_name}.{name}"})
    assert tried > 500


@pytest.mark.parametrize(
    "config",
    [
        {"_target_": "hudepth.models.TinyUNet", "channels": {"_target_": "os.getpid"}},
        {"a": [{"b": {"_target_": "os.getpid"}}]},
        [[{"_target_": "os.getpid"}]],
        {"_target_": "os.getpid", "net": {"_target_": "hudepth.models.TinyUNet"}},
    ],
)
def test_nested_targets_are_checked(config: object) -> None:
    assert refused(config).startswith("_target_: 'os.getpid' is not under a trusted module")


def test_inner_objects_are_built_first() -> None:
    built = instantiate({"nets": [{"_target_": "hudepth.models.TinyUNet", "channels": 2}, 3], "name": "x"})
    assert built["nets"][0].encode.out_channels == 2
    assert built["nets"][1:] == [3]
    assert built["name"] == "x"
    norm = instantiate({"_target_": "torch.nn.L1Loss", "reduction": "sum"})
    assert isinstance(norm, nn.Module)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    )
)
def test_plain_values_stay_as_they_are(value: object) -> None:
    assert instantiate(value) == value


def test_the_configuration_is_left_alone() -> None:
    config = {"_target_": "hudepth.models.TinyUNet", "channels": 4}
    instantiate(config)
    instantiate(config, channels=2)
    assert config == {"_target_": "hudepth.models.TinyUNet", "channels": 4}


def test_extra_arguments_win() -> None:
    assert instantiate({"_target_": "hudepth.models.TinyUNet", "channels": 4}, channels=2).encode.out_channels == 2


def test_positional_arguments_come_first() -> None:
    parameters = [nn.Parameter(torch.zeros(2))]
    optimizer = instantiate({"_target_": "torch.optim.AdamW", "lr": 0.25}, parameters)
    assert isinstance(optimizer, torch.optim.AdamW)
    assert optimizer.param_groups[0]["params"] == parameters
    assert optimizer.param_groups[0]["lr"] == 0.25
    schedule = instantiate({"_target_": "torch.optim.lr_scheduler.StepLR", "step_size": 3}, optimizer)
    assert schedule.optimizer is optimizer


def test_arguments_are_for_the_outermost_object_alone() -> None:
    message = refused(
        {"_target_": "torch.nn.Sequential", "inner": {"_target_": "torch.nn.ReLU"}}, inplace=True, trust=["torch.nn"]
    )
    assert message == ("torch.nn.Sequential: got an unexpected keyword argument 'inner'. It takes args.")


def test_misspelt_argument() -> None:
    assert refused({"_target_": "hudepth.models.HybridUNet", "attention_head": 4}) == (
        "hudepth.models.HybridUNet: got an unexpected keyword argument 'attention_head'. "
        "Did you mean 'attention_heads'?"
    )


def test_argument_like_no_other() -> None:
    assert refused({"_target_": "hudepth.models.TinyUNet", "zzz": 4}) == (
        "hudepth.models.TinyUNet: got an unexpected keyword argument 'zzz'. It takes channels."
    )


def test_missing_argument() -> None:
    assert refused({"_target_": "torch.nn.Linear", "in_features": 4}, trust=["torch.nn"]) == (
        "torch.nn.Linear: missing a required argument: 'out_features'."
    )


def test_bad_value_names_the_target() -> None:
    assert refused({"_target_": "torch.nn.GroupNorm", "num_groups": 3, "num_channels": 4}, trust=["torch.nn"]) == (
        "torch.nn.GroupNorm: num_channels (4) must be divisible by num_groups (3)"
    )


def test_errors_for_the_user_pass_through() -> None:
    with pytest.raises(CheckpointError, match=r"model\.weights: no file 'x\.pth'"):
        instantiate({"_target_": "hudepth.models.HybridUNet", "weights": "x.pth"})


def test_what_the_project_configures() -> None:
    assert isinstance(instantiate({"_target_": "hudepth.models.HybridUNet", "attention": "none"}), HybridUNet)
    assert isinstance(instantiate({"_target_": "hudepth.losses.BADCL"}), BADCL)


@pytest.fixture
def user_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two modules that somebody could have: ``mine`` and ``mine_too``."""
    for name in ("mine", "mine_too"):
        module = types.ModuleType(name)
        exec(
            "from pathlib import Path\nclass Net:\n    def __init__(self, *, width=1): self.width = width", vars(module)
        )
        monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.usefixtures("user_code")
def test_trust() -> None:
    config = {"_target_": "mine.Net", "width": 3}
    assert refused(config).endswith("If it is your own code, pass trust=[mine].")
    assert instantiate(config, trust=["mine"]).width == 3
    assert instantiate(config, trust=["mine."]).width == 3
    assert "is not under a trusted module" in refused({"_target_": "mine_too.Net"}, trust=["mine"])
    assert "is not a class of a trusted module" in refused({"_target_": "mine.Path"}, trust=["mine"])


@pytest.mark.usefixtures("user_code")
def test_trust_is_not_remembered() -> None:
    instantiate({"_target_": "mine.Net"}, trust=["mine"])
    assert "is not under a trusted module" in refused({"_target_": "mine.Net"})


def test_only_keeps_out_what_writes_files(tmp_path: Path) -> None:
    victim = tmp_path / "precious"
    victim.write_text("mine")
    writer = {"_target_": "hudepth.data.store.StoreWriter", "path": str(victim), "size": [1, 1], "native": False}
    for config in (writer, {"_target_": "hudepth.models.TinyUNet", "channels": writer}):
        assert refused(config, only=nn.Module) == (
            "_target_: 'hudepth.data.store.StoreWriter' is no Module, which is what belongs here."
        )
    assert victim.read_text() == "mine"
    assert isinstance(instantiate({"_target_": "hudepth.models.TinyUNet"}, only=nn.Module), TinyUNet)


@pytest.mark.parametrize("name", ["LSTM", "TransformerEncoder", "Sequential", "Linear", "modules.rnn.LSTM"])
def test_layers_of_torch_need_trust(name: str) -> None:
    """nn.LSTM(num_layers=10**8) would never be built."""
    message = refused({"_target_": f"torch.nn.{name}", "num_layers": 10**8})
    assert "not a class of a trusted module" in message
    assert "trust=[torch.nn" in message


def test_losses_of_torch_need_none() -> None:
    assert isinstance(instantiate({"_target_": "torch.nn.SmoothL1Loss", "beta": 0.5}, only=nn.Module), nn.SmoothL1Loss)


def test_sizes_that_torch_refuses() -> None:
    negative = {"_target_": "torch.nn.Linear", "in_features": 4, "out_features": -1}
    assert refused(negative, trust=["torch.nn"]).startswith("torch.nn.Linear: ")


@pytest.mark.parametrize(
    ("target", "name", "value", "what"),
    [
        ("torch.optim.AdamW", "lr", "abc", "a number of at least 0"),
        ("torch.optim.AdamW", "weight_decay", [{"a": 1}], "a number of at least 0"),
        ("torch.optim.SGD", "nesterov", "abc", "true or false"),
        ("torch.optim.lr_scheduler.StepLR", "step_size", 2.5, "a whole number"),
        ("torch.optim.lr_scheduler.CosineAnnealingLR", "eta_min", "abc", "a number"),
        ("hudepth.training.optim.GroupedAdamW", "fused", "abc", "true or false"),
        ("hudepth.models.tiny.TinyUNet", "channels", [{"a": 1}], "a whole number"),
    ],
)
def test_numbers_of_another_type(target: str, name: str, value: object, what: str) -> None:
    with pytest.raises(ConfigError, match=rf"^part\.{name}: .* is not {what}\.$"):
        instantiate({"_target_": target, name: value}, [], key="part")


def test_arguments_that_are_more_than_numbers_are_left_to_the_class() -> None:
    weights, schedulers = [nn.Parameter(torch.zeros(1))], torch.optim.lr_scheduler
    adam = {"_target_": "torch.optim.Adam", "lr": 1, "betas": [0.5, 0.9], "fused": None}
    assert instantiate(adam, weights, key="optim").defaults["betas"] == (0.5, 0.9)
    cycle = {"_target_": "torch.optim.lr_scheduler.OneCycleLR", "max_lr": [0.1], "total_steps": 3}
    built = instantiate(cycle, torch.optim.SGD(weights), key="schedule", anneal_strategy="linear")
    assert isinstance(built, schedulers.OneCycleLR)
