from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch.accelerators import CUDAAccelerator, MPSAccelerator

from hudepth.base.devices import build_trainer, check_devices, check_shares
from hudepth.base.errors import ConfigError
from tests.commands import TINY, Command

SILENT = {"logger": False, "enable_checkpointing": False, "enable_model_summary": False, "enable_progress_bar": False}


@pytest.fixture
def _no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in (CUDAAccelerator, MPSAccelerator):
        monkeypatch.setattr(kind, "is_available", staticmethod(lambda: False))


@pytest.fixture
def _cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CUDAAccelerator, "is_available", staticmethod(lambda: True))
    monkeypatch.setattr(MPSAccelerator, "is_available", staticmethod(lambda: False))


@pytest.mark.usefixtures("_no_gpu")
def test_all_gpus_where_there_is_none(command: Command, tmp_path: Path) -> None:
    done = command("train", *(option for option in TINY if "accelerator" not in option), "trainer=ddp")
    assert done.code == 1
    assert done.err.splitlines() == [
        "hudepth-train: trainer.accelerator=gpu: no GPU here. Pass trainer.accelerator=cpu trainer.devices=2, or as "
        "many as there are cores."
    ]
    assert not (tmp_path / "runs").exists()


@pytest.mark.usefixtures("_no_gpu")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"accelerator": "cuda"}, "trainer.accelerator=cuda: no GPU here. Pass trainer.accelerator=cpu."),
        (
            {"accelerator": "mps", "devices": 1},
            "trainer.accelerator=mps: no GPU here. Pass trainer.accelerator=cpu.",
        ),
        *(
            (
                {"accelerator": accelerator, "devices": 2, "sync_batchnorm": True},
                "trainer.sync_batchnorm: PyTorch supports it on GPUs only. Pass trainer.sync_batchnorm=false; then "
                "each process normalises by its own share of a batch.",
            )
            for accelerator in ("cpu", "auto")
        ),
    ],
)
def test_what_is_not_there(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        check_devices(options)
    assert str(caught.value) == message


@pytest.mark.usefixtures("_cuda")
@pytest.mark.parametrize("accelerator", ["gpu", "cuda", "auto", "cpu"])
def test_what_is_there(accelerator: str) -> None:
    check_devices({"accelerator": accelerator, "devices": "auto"})
    if accelerator != "cpu":
        check_devices({"accelerator": accelerator, "sync_batchnorm": True})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"accelerator": "cpu", "devises": 1}, r"^trainer\.devises: .*Did you mean 'devices'\?"),
        ({"accelerator": "abacus"}, r"^trainer\.accelerator: .*abacus"),
        ({"accelerator": "cpu", "devices": 0}, r"^trainer\.devices: 0"),
        ({"accelerator": "cpu", "precision": "8-bits"}, r"^trainer\.precision: .*8-bits"),
        ({"accelerator": "cpu", "strategy": "dpp"}, r"^trainer\.strategy: .*Did you mean 'ddp'\?"),
        ({"accelerator": "cpu", "val_check_interval": "abc"}, r"^trainer: .*val_check_interval"),
    ],
)
def test_what_lightning_refuses_is_a_mistake_in_the_configuration(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_trainer(options, **SILENT)


@pytest.mark.parametrize(("processes", "pairs", "fits"), [(1, 1, True), (2, 2, True), (2, 3, True), (3, 2, False)])
def test_shares(processes: int, pairs: int, fits: bool) -> None:
    trainer = build_trainer({"accelerator": "cpu", "devices": processes}, **SILENT)
    if fits:
        check_shares(trainer, subset="test", pairs=pairs)
        return
    with pytest.raises(ConfigError) as caught:
        check_shares(trainer, subset="test", pairs=pairs)
    assert str(caught.value) == (
        f"trainer.devices: the test subset has {pairs} pairs for {processes} processes, each of which needs one. "
        f"Pass trainer.devices={pairs}."
    )
