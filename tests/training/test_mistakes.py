"""Values that hudepth-train refuses: in one line that names the key and the fix, before anything is written."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from tests.commands import TINY

MISTAKES = [
    ("trainer.max_epochs=abc", "trainer.max_epochs: 'abc' is not a whole number of at least 1. The default is 30."),
    ("trainer.max_epochs=-1", "trainer.max_epochs: -1 trains for ever, unless +trainer.max_steps is set. Pass a "),
    ("trainer.max_epochs=0", "trainer.max_epochs: 0 trains nothing. Pass a whole number of at least 1."),
    ("+trainer.max_epoch=3", "trainer.max_epoch: lightning.Trainer has no such argument. Did you"),
    ("+trainer.max_steps=abc", "trainer.max_steps: 'abc' is not a whole number of at least -1."),
    ("trainer.gradient_clip_val=-1", "trainer.gradient_clip_val: -1 is not a number of at least 0."),
    ("trainer.limit_train_batches=2.5", "trainer.limit_train_batches: 2.5 is not a whole number of at least 0"),
    ("trainer.overfit_batches=abc", "trainer.overfit_batches: 'abc' is not a whole number of at least 0"),
    ("trainer.devices=abc", "trainer.devices: 'abc' is not a whole number of at least 1 or one of auto, -1."),
    ("trainer.devices=0", "trainer.devices: 0 is not a whole number of at least 1"),
    ("trainer.strategy=dpp", "trainer.strategy: 'dpp' is not a strategy, as auto or ddp. Did you mean 'ddp'?"),
    ("trainer.precision=tf23", "trainer.precision: 'tf23' is not a precision, as tf32, fast, 32-true"),
    ("trainer.accelerator=gpuu", "trainer.accelerator: 'gpuu' is not one of auto, gpu, cpu, cuda, mps, tpu. Did"),
    ("trainer.deterministic=maybe", "trainer.deterministic: 'maybe' is not true or false or warn. The default is"),
    ("optim.lr=abc", "optim.lr: 'abc' is not a number of at least 0. The default is 0.0001."),
    ("optim.lr=-1", "optim.lr: -1 is not a number of at least 0. The default is 0.0001."),
    ("optim=sgd optim.momentum=-1", "optim.momentum: -1 is not a number of at least 0. The default is 0.9."),
    ("optim=adamm", "optim: no 'adamm'. Did you mean 'adamw'? Pass one of"),
    ("schedule=step schedule.gamma=abc", "schedule.gamma: 'abc' is not a number."),
    ("schedule=warmup_cosine schedule.warmup=2", "schedule.warmup: 2 is not a share of the training, in [0, 1)."),
    ("loss.smoothness=abc", "loss.smoothness: 'abc' is not a number of at least 0. The default is "),
    ("loss.scale_mode=allign", "loss.scale_mode: 'allign' is not one of weight, align. Did you mean 'align'?"),
    ("loss=mixture loss.weights.badcl=-1", "loss.weights.badcl: -1 is not a number of at least 0."),
    ("loss=badcll", "loss: no 'badcll'. Did you mean 'badcl'? Pass one of"),
    ("data=room", "data: no 'room'. Did you mean 'rooms'? Pass one of"),
    ("data.batch_size=abc", "data.batch_size: 'abc' is not a whole number of at least 1. The default is 8."),
    ("data.max_depth_m=-1", "data.max_depth_m: -1 is not a number above 0. The default is 10.0."),
    ("data.split=randm", "data.split: no 'randm'. Did you mean 'random'? Pass one of "),
    ("data.source.scenes=abc", "data.source.scenes: 'abc' is not a whole number of at least 1."),
    ("augment=depth augment.flip=2", "augment.flip: 2 is not a number of at least 0 and at most 1."),
    ("model=tinny", "model: no 'tinny'. Did you mean 'tiny'? Pass one of"),
    ("model.channels=0", "model.channels: 0 is not a whole number of at least 1. The default is 8."),
    ("model=hybrid_unet model.attention_heads=5", "model.attention_heads: 5 heads do not divide 128 channels."),
    ("monitor=val/absrel", "monitor: no 'val/absrel'. Did you mean 'val/abs_rel'? Pass one of val/abs_rel,"),
    ("monitor=abs_rel", "monitor: no 'abs_rel'. Did you mean 'val/abs_rel'? Pass one of val/abs_rel,"),
    ("mode=mni", "mode: 'mni' is not one of min, max. Did you mean 'min'?"),
    ("init=nuy", "init: no file or run directory 'nuy'. Did you mean 'nyu'? Pass a file"),
    ("init_skip=[head]", "init_skip: there is no init= of which parts could be left out. Pass init=<run>."),
    ("model=lite model.widths=[8,8,8]", "model.widths: [8,8,8] is not a list of 4 whole numbers of at least 1."),
    ("protocol=[eigen,papper]", "protocol: no 'papper'. Did you mean 'paper'? Pass one of"),
    ("protocol.eigen.max_depth_m=abc", "protocol.eigen.max_depth_m: 'abc' is not a number"),
    ("callbacks=early_stopping callbacks.early_stopping.patience=abc", "callbacks.early_stopping.patience: 'abc'"),
    ("callbacks.panels=abc", "callbacks.panels: 'abc' is not a whole number of at least 0."),
    ("seed=1.5", "seed: 1.5 is not a whole number of at least 0 and at most 4294967295. The default is 42."),
    ("distill=metric", "distill.teacher is not set. Pass distill.teacher=<value>."),
]  # fmt: skip

DRIVER = """
import contextlib, io, json, os, sys
from hydra.core.global_hydra import GlobalHydra
from hudepth import cli

for arguments in json.load(sys.stdin):
    GlobalHydra.instance().clear()
    sys.argv[:] = ["hudepth-train", *arguments]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as printed:
        code = cli.train()
    print(json.dumps([code, printed.getvalue().splitlines(), os.listdir()]))
"""
"""Runs the console script's function with each list of arguments, without the checks of types that tests have."""


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """Exit code, lines and files of each mistake."""
    typed = [each.split() for each, _ in MISTAKES]
    keys = [{each.partition("=")[0] for each in arguments} for arguments in typed]
    tiny = [[each for each in TINY if each.partition("=")[0] not in own] for own in keys]
    asked = json.dumps([[*few, *arguments] for few, arguments in zip(tiny, typed, strict=True)])
    done = subprocess.run(
        [sys.executable, "-c", DRIVER], cwd=tmp_path_factory.mktemp("mistakes"), input=asked, text=True,
        capture_output=True, check=True,
    )  # fmt: skip
    found = [json.loads(line) for line in done.stdout.splitlines()]
    return {each: answer for (each, _), answer in zip(MISTAKES, found, strict=True)}


@pytest.mark.slow
@pytest.mark.parametrize(("typed", "message"), MISTAKES, ids=[typed for typed, _ in MISTAKES])
def test_a_mistake_costs_one_line(typed: str, message: str, answers: dict[str, list[Any]]) -> None:
    code, lines, files = answers[typed]
    assert code == 1
    assert len(lines) == 1
    assert lines[0].startswith(f"hudepth-train: {message}")
    assert files == []
