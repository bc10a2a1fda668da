from __future__ import annotations

from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from hudepth.base.machine import usable_cores
from hudepth.sweep import job


def shared(
    monkeypatch: pytest.MonkeyPatch, *, n_jobs: int | None, number: int = 0, gpus: int = 0, accelerator: str = "auto"
) -> tuple[Any, int]:
    """Return devices and threads of a job among ``n_jobs`` on a machine with 8 cores."""
    launcher = {"_target_": "x"} if n_jobs is None else {"_target_": "x", "n_jobs": n_jobs}
    hydra = OmegaConf.create({"launcher": launcher, "job": {"num": number}})
    threads = [8]
    monkeypatch.setattr(job.HydraConfig, "get", lambda: hydra)
    monkeypatch.setattr(job, "usable_cores", lambda: 8)
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    cfg = OmegaConf.create({"trainer": {"accelerator": accelerator, "devices": 1}})
    job._share_machine(cfg)
    return OmegaConf.to_container(cfg)["trainer"]["devices"], threads[-1]  # type: ignore[call-overload,index]


@pytest.mark.parametrize(("n_jobs", "threads"), [(None, 8), (1, 8), (2, 4), (3, 2), (8, 1), (20, 1), (-1, 1)])
def test_jobs_side_by_side_divide_the_cores(n_jobs: int | None, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    assert shared(monkeypatch, n_jobs=n_jobs) == (1, threads)


@pytest.mark.parametrize(("number", "device"), [(0, 0), (1, 1), (2, 2), (3, 0), (7, 1)])
def test_gpus_are_dealt_out_in_turn(number: int, device: int, monkeypatch: pytest.MonkeyPatch) -> None:
    assert shared(monkeypatch, n_jobs=3, number=number, gpus=3)[0] == [device]


@pytest.mark.parametrize(("n_jobs", "gpus", "accelerator"), [(1, 3, "auto"), (2, 1, "auto"), (2, 3, "cpu")])
def test_else_the_devices_stay(n_jobs: int, gpus: int, accelerator: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert shared(monkeypatch, n_jobs=n_jobs, number=1, gpus=gpus, accelerator=accelerator)[0] == 1


def test_there_is_a_core() -> None:
    assert usable_cores() >= 1
