from __future__ import annotations

import itertools
import logging
import math
import os
import signal
import sys
import weakref
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hudepth.base.console import log
from hudepth.base.errors import TrainingError
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.evaluation.pictures import evenly_spaced, make_panels
from hudepth.losses import BADCL
from hudepth.models import TinyUNet
from hudepth.runs.checkpoint import read_plain
from hudepth.runs.history import read_history
from hudepth.training import callbacks
from hudepth.training.callbacks import EpochLine, EpochSeed, History, Interrupt, LogLosses, PanelPictures
from hudepth.training.checkpointing import AtomicCheckpointIO, checkpoint_callbacks
from hudepth.training.module import DepthModule
from hudepth.viz.panels import Panel


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def data(cache: Path) -> DepthDataModule:
    source = RoomsSource(scenes=6, frames_per_scene=2, size=(48, 64), holes=True)
    return DepthDataModule(
        source, size=(32, 48), split="official", batch_size=3, cache=cache, native=False, prepare_workers=1
    )


def make_module(seed: int = 0) -> DepthModule:
    torch.manual_seed(seed)
    return DepthModule(
        TinyUNet(channels=4), BADCL(), max_depth_m=10.0, optimizer=partial(torch.optim.AdamW, lr=1e-2)
    )  # fmt: skip


def fit(
    data: DepthDataModule, run: Path, extra: Sequence[Callback] = (), *, resume: bool = False, **options: Any
) -> Trainer:
    trainer = Trainer(
        accelerator="cpu",
        enable_model_summary=False,
        enable_progress_bar=False,
        num_sanity_val_steps=0,
        callbacks=[
            LogLosses(),
            History(run / "metrics.csv"), *extra, *checkpoint_callbacks(run, monitor="val/abs_rel", mode="min")
        ],
        plugins=[AtomicCheckpointIO()],
        **{"max_epochs": 2, "logger": False, **options},
    )  # fmt: skip
    last = run / "checkpoints" / "last.ckpt"
    trainer.fit(make_module(), datamodule=data, ckpt_path=last if resume else None, weights_only=True)
    return trainer


class StopAt(Callback):
    """Ends a run in the middle of an epoch, as a kill does."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if trainer.current_epoch + 1 == self.epoch:
            raise TrainingError("killed")


# --- history ----------------------------------------------------------------------------------------------------


def test_history_has_one_row_an_epoch(data: DepthDataModule, tmp_path: Path) -> None:
    trainer = fit(data, tmp_path, max_epochs=3)
    rows = read_history(tmp_path / "metrics.csv")
    assert [row["epoch"] for row in rows] == [1, 2, 3]
    assert [row["step"] for row in rows] == [3, 6, 9]  # 8 training pairs in batches of 3
    assert {"train/loss/total", "val/loss/total", "val/abs_rel", "val/ssim"} <= set(rows[0])
    assert all(set(row) == set(rows[0]) for row in rows)
    for name, value in trainer.callback_metrics.items():
        assert rows[-1][name] == value.item()  # written with all digits


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_history_survives_a_resume(workers: int, data: DepthDataModule, tmp_path: Path) -> None:
    data.num_workers = workers
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    fit(data, whole, max_epochs=4)
    with pytest.raises(TrainingError, match="killed"):
        fit(data, broken, [StopAt(3)], max_epochs=4)
    with (broken / "metrics.csv").open("a") as file:
        file.write("3,9,0.1\n4,")  # what a run killed later, without a checkpoint, could leave
    fit(data, broken, resume=True, max_epochs=4)
    assert (broken / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    ours, theirs = (read_plain(run / "checkpoints" / "last.ckpt")["state_dict"] for run in (broken, whole))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_pairs_on_the_device_train_the_same(data: DepthDataModule, tmp_path: Path) -> None:
    fit(data, tmp_path / "disk", max_epochs=2)
    data.on_device = "true"
    fit(data, tmp_path / "device", max_epochs=2)
    assert (tmp_path / "device" / "metrics.csv").read_bytes() == (tmp_path / "disk" / "metrics.csv").read_bytes()


class Dropped(TinyUNet):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return super().forward(torch.nn.functional.dropout2d(image, 0.3, self.training))


def test_a_network_with_dropout_resumes_as_if_it_had_never_stopped(
    data: DepthDataModule, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "TinyUNet", Dropped)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    fit(data, whole, [EpochSeed(1)], max_epochs=3)
    torch.manual_seed(99)
    fit(data, broken, [EpochSeed(1)], max_epochs=2)
    fit(data, broken, [EpochSeed(1)], max_epochs=3, resume=True)
    assert (broken / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()


def test_history_of_a_resumed_run_is_mended_before_it_goes_on(data: DepthDataModule, tmp_path: Path) -> None:
    fit(data, tmp_path, max_epochs=2)
    (tmp_path / "metrics.csv").write_text("rubbish")
    with pytest.raises(TrainingError, match="killed"):
        fit(data, tmp_path, [StopAt(3)], resume=True, max_epochs=4)
    assert [row["epoch"] for row in read_history(tmp_path / "metrics.csv")] == [1, 2]


def test_history_is_written_whole(tmp_path: Path, data: DepthDataModule, monkeypatch: pytest.MonkeyPatch) -> None:
    fit(data, tmp_path, max_epochs=1)
    before = (tmp_path / "metrics.csv").read_bytes()

    def half(self: Path, text: str, **_: Any) -> int:
        self.write_bytes(text.encode()[:20])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(OSError, match="No space left"):
        fit(data, tmp_path, resume=True, max_epochs=2)
    assert (tmp_path / "metrics.csv").read_bytes() == before
    assert not list(tmp_path.glob(".*"))


def test_an_epoch_without_validation_has_no_validation_metrics(data: DepthDataModule, tmp_path: Path) -> None:
    fit(data, tmp_path, max_epochs=4, check_val_every_n_epoch=2)
    rows = read_history(tmp_path / "metrics.csv")
    assert ["val/abs_rel" in row for row in rows] == [False, True, False, True]
    assert all("train/loss/total" in row for row in rows)
    assert rows[1]["val/abs_rel"] != rows[3]["val/abs_rel"]


# --- one line per epoch ------------------------------------------------------------------------------------------


def test_epoch_line(
    data: DepthDataModule, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks = itertools.count(start=100.0, step=7.0)  # read at the start and after each epoch
    monkeypatch.setattr(callbacks, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
    propagate = log.propagate
    log.propagate = True
    try:
        with caplog.at_level(logging.INFO, logger="hudepth"):
            fit(data, tmp_path, [EpochLine("val/silog")], max_epochs=2)
    finally:
        log.propagate = propagate
    lines = [record.message for record in caplog.records if record.message.startswith("epoch")]
    rows = read_history(tmp_path / "metrics.csv")
    shown = ("train/loss/total", "val/loss/total", "val/silog", "val/abs_rel", "val/rmse", "val/delta1")
    for number, (line, row) in enumerate(zip(lines, rows, strict=True), start=1):
        values = ", ".join(f"{name} {row[name]:.4f}" for name in shown)
        ending = "7 s per epoch, 7 s left" if number == 1 else "7 s per epoch"
        assert line == f"epoch {number} of 2: {values} ({ending})"


def test_the_monitored_metric_is_shown_once() -> None:
    assert EpochLine("val/rmse").shown == (
        "train/loss/total",
        "val/loss/total",
        "val/rmse",
        "val/abs_rel",
        "val/delta1",
    )
    assert EpochLine("train/loss/total").shown == (
        "train/loss/total",
        "val/loss/total",
        "val/abs_rel",
        "val/rmse",
        "val/delta1",
    )


# --- Ctrl-C ---


class PressesCtrlC(Callback):
    """Sends the signal where a KeyboardInterrupt would be lost, and counts what goes on after it."""

    def __init__(self, number: int) -> None:
        self.batches, self.number = 0, number

    def on_train_batch_start(self, *_: object) -> None:
        self.batches += 1
        dying = {object.__new__(type("Dying", (), {}))}
        reference = weakref.ref(next(iter(dying)), lambda _: os.kill(os.getpid(), self.number))
        dying.clear()
        assert reference() is None


BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


@BOTH
def test_ctrl_c_is_as_it_was_after_training(number: int, data: DepthDataModule, tmp_path: Path) -> None:
    before = signal.getsignal(number)
    fit(data, tmp_path, [Interrupt()], max_epochs=1)
    assert signal.getsignal(number) == before


@BOTH
def test_ctrl_c_ends_training_wherever_it_hits(number: int, data: DepthDataModule, tmp_path: Path) -> None:
    before = signal.getsignal(number)
    presses = PressesCtrlC(number)
    try:
        with pytest.raises(SystemExit):
            fit(data, tmp_path, [Interrupt(), presses], max_epochs=2)
        assert presses.batches == 1
        assert signal.getsignal(number) == before
    finally:
        signal.signal(number, before)


# --- pictures ---------------------------------------------------------------------------------------------------


class Drawn:
    """Stands in for the drawing, which has tests of its own, and keeps what was to be drawn."""

    def __init__(self) -> None:
        self.pictures: dict[str, list[Panel]] = {}

    def __call__(self, path: Path, panels: list[Panel]) -> None:
        self.pictures[path.name] = panels


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Drawn:
    drawn = Drawn()
    monkeypatch.setattr(callbacks, "save_panels", drawn)
    return drawn


def pictures(data: DepthDataModule, run: Path, *, every: int = 1, count: int = 2) -> PanelPictures:
    indices = evenly_spaced(sorted(data.split.val), count)
    return PanelPictures(run / "images", data.store, indices, every_n_epochs=every, max_depth_m=10.0)


def test_the_same_pairs_are_drawn_each_time(data: DepthDataModule, tmp_path: Path, drawn: Drawn) -> None:
    fit(data, tmp_path, [pictures(data, tmp_path)], max_epochs=3)
    assert list(drawn.pictures) == ["epoch_001.png", "epoch_002.png", "epoch_003.png"]
    first, *others = drawn.pictures.values()
    assert len(first) == 2
    for panels in others:
        for ours, theirs in zip(panels, first, strict=True):
            assert ours.title == theirs.title
            assert np.array_equal(ours.image, theirs.image)
            assert np.array_equal(ours.truth_m, theirs.truth_m)
            assert not np.array_equal(ours.pred_m, theirs.pred_m)  # the network has learnt something


def test_how_often_and_the_last_epoch_always(data: DepthDataModule, tmp_path: Path, drawn: Drawn) -> None:
    fit(data, tmp_path, [pictures(data, tmp_path, every=2)], max_epochs=5)
    assert list(drawn.pictures) == ["epoch_002.png", "epoch_004.png", "epoch_005.png"]


def test_no_picture_of_the_sanity_check(data: DepthDataModule, tmp_path: Path, drawn: Drawn) -> None:
    module = make_module()
    Trainer(
        accelerator="cpu", max_epochs=0, logger=False, enable_checkpointing=False, enable_model_summary=False,
        enable_progress_bar=False, num_sanity_val_steps=1, callbacks=[pictures(data, tmp_path)],
    ).fit(module, datamodule=data)  # fmt: skip
    assert drawn.pictures == {}


def test_pictures_do_not_change_training(data: DepthDataModule, tmp_path: Path, drawn: Drawn) -> None:
    """Neither the training mode nor the random numbers: a run with pictures ends where one without them does."""

    class Draws(Callback):
        def __init__(self) -> None:
            self.seen: list[tuple[bool, float]] = []

        def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
            training = all(module.training for module in pl_module.net.modules())  # type: ignore[union-attr]
            self.seen.append((training, torch.rand(()).item()))

    without, with_pictures = Draws(), Draws()
    fit(data, tmp_path / "a", [without])
    fit(data, tmp_path / "b", [with_pictures, pictures(data, tmp_path)])
    assert without.seen == with_pictures.seen
    assert all(training for training, _ in without.seen)
    assert len(drawn.pictures) == 2
    assert (tmp_path / "a" / "metrics.csv").read_bytes() == (tmp_path / "b" / "metrics.csv").read_bytes()


def test_pictures_are_files_and_go_to_tensorboard(data: DepthDataModule, tmp_path: Path) -> None:
    logger = TensorBoardLogger(tmp_path, name="tensorboard", version="")
    fit(data, tmp_path, [pictures(data, tmp_path, count=1)], max_epochs=1, logger=logger)
    assert [file.name for file in (tmp_path / "images").iterdir()] == ["epoch_001.png"]
    assert (tmp_path / "images" / "epoch_001.png").read_bytes().startswith(b"\x89PNG")
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert events.Tags()["images"] == ["val/panels"]


@pytest.mark.parametrize("training", [True, False])
def test_panels_show_what_the_network_predicts(data: DepthDataModule, training: bool) -> None:
    net = TinyUNet(channels=4).train(training)
    indices = [3, 0]
    panels = make_panels(net, data.store, indices, max_depth_m=4.0)
    assert net.training is training
    image, stored_depth = data.store.read(indices)
    assert (stored_depth == 0).any()
    assert (stored_depth > 4000).any()
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    normal = torch.from_numpy(((image / 255 - mean) / std).transpose(0, 3, 1, 2)).float()
    with torch.inference_mode():
        pred_m = net.eval()(normal)[:, 0] * 4
    for row, panel in enumerate(panels):
        assert panel.title == data.store.records[indices[row]].id
        assert np.array_equal(panel.image, image[row])
        np.testing.assert_allclose(panel.truth_m, np.minimum(stored_depth[row] / 1000, 4), rtol=1e-6)
        np.testing.assert_allclose(panel.pred_m, pred_m[row], rtol=1e-5, atol=1e-6)


@given(st.lists(st.integers(), unique=True, max_size=40), st.integers(0, 50))
def test_evenly_spaced(indices: list[int], count: int) -> None:
    picked = evenly_spaced(indices, count)
    assert len(picked) == min(count, len(indices))
    assert len(set(picked)) == len(picked)
    positions = [indices.index(index) for index in picked]
    steps = [b - a for a, b in itertools.pairwise(positions)]
    assert all(step >= 1 for step in steps)
    assert not steps or max(steps) - min(steps) <= 1
    assert not positions or positions[0] == 0
    assert picked == evenly_spaced(indices, count)


def test_evenly_spaced_examples() -> None:
    assert evenly_spaced(range(10), 5) == [0, 2, 4, 6, 8]
    assert evenly_spaced([7, 8, 9], 10) == [7, 8, 9]
    assert evenly_spaced([], 3) == []


# --- checkpoints ------------------------------------------------------------------------------------------------


def test_best_is_weights_alone_and_last_is_all(data: DepthDataModule, tmp_path: Path) -> None:
    fit(data, tmp_path, max_epochs=3)
    folder = tmp_path / "checkpoints"
    assert {file.name for file in folder.iterdir()} == {"best.ckpt", "last.ckpt"}
    best, last = read_plain(folder / "best.ckpt"), read_plain(folder / "last.ckpt")
    assert not {"optimizer_states", "lr_schedulers", "callbacks"} & set(best)
    assert {"optimizer_states", "lr_schedulers", "callbacks", "loops"} <= set(last)
    assert len(last["optimizer_states"][0]["state"]) == 6  # a pair of moments for each parameter
    assert last["epoch"] == 2
    assert set(best["state_dict"]) == set(last["state_dict"])
    assert all(name.startswith("net.") for name in last["state_dict"])
    history = next(state for name, state in last["callbacks"].items() if name.startswith("History"))
    assert [row["epoch"] for row in history["rows"]] == [1, 2, 3]


class Scores(Callback):
    """Replaces the monitored metric of each epoch."""

    def __init__(self, scores: Sequence[float]) -> None:
        self.scores = scores

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        trainer.callback_metrics["val/abs_rel"].fill_(self.scores[trainer.current_epoch])


@pytest.mark.parametrize(
    ("scores", "best_epoch"),
    [((0.3, 0.1, 0.2), 2), ((0.1, 0.2, 0.3), 1), ((0.3, 0.2, 0.1), 3), ((math.nan, 0.5, 0.6), 2)],
)
def test_best_is_the_epoch_with_the_best_score(
    data: DepthDataModule, tmp_path: Path, scores: Sequence[float], best_epoch: int
) -> None:
    trainer = fit(data, tmp_path, [Scores(scores)], max_epochs=3)
    folder = tmp_path / "checkpoints"
    assert read_plain(folder / "best.ckpt")["epoch"] == best_epoch - 1
    last = read_plain(folder / "last.ckpt")
    assert last["epoch"] == 2
    kept = [state["best_model_score"] for name, state in last["callbacks"].items() if "val/abs_rel" in name]
    assert kept[0].item() == pytest.approx(min(score for score in scores if not math.isnan(score)))
    assert trainer.checkpoint_callbacks[0].best_model_path == str(folder / "best.ckpt")


def test_best_is_remembered_over_a_resume(data: DepthDataModule, tmp_path: Path) -> None:
    fit(data, tmp_path, [Scores((0.1, 0.3))], max_epochs=2)
    fit(data, tmp_path, [Scores((0.1, 0.3, 0.2))], max_epochs=3, resume=True)
    assert read_plain(tmp_path / "checkpoints" / "best.ckpt")["epoch"] == 0
    assert {file.name for file in (tmp_path / "checkpoints").iterdir()} == {"best.ckpt", "last.ckpt"}


def test_scores_are_restored_and_paths_are_those_of_the_run_now(data: DepthDataModule, tmp_path: Path) -> None:
    fit(data, tmp_path / "before", [Scores((0.1, 0.3))], max_epochs=2)
    callbacks = read_plain(tmp_path / "before" / "checkpoints" / "last.ckpt")["callbacks"]
    (state,) = (state for name, state in callbacks.items() if "val/abs_rel" in name)
    best = checkpoint_callbacks(tmp_path / "after", monitor="val/abs_rel", mode="min")[0]
    best.load_state_dict(state)
    scores = best.state_dict()["current_score"], best.state_dict()["best_model_score"]
    assert [score.item() for score in scores] == pytest.approx([0.1, 0.1])
    assert best.best_model_path == str(tmp_path / "after" / "checkpoints" / "best.ckpt")
