"""times.csv: one row an epoch, which sums up and goes on after a resume."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from hudepth.base.errors import TrainingError
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses import BADCL
from hudepth.models import TinyUNet
from hudepth.training.checkpointing import AtomicCheckpointIO, checkpoint_callbacks
from hudepth.training.module import DepthModule
from hudepth.training.optim import GroupedAdamW
from hudepth.training.times import COLUMNS, Times, read_times

HEADER = "epoch,height,width,images,wall_s,cpu_s,lr\n"


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def fit(
    cache: Path, run: Path, extra: Sequence[Callback] = (), *, epochs: int = 4, resume: bool = False, **options: Any
) -> None:
    source = RoomsSource(scenes=6, frames_per_scene=2, size=(48, 64))
    data = DepthDataModule(
        source, size=(32, 48), split="official", batch_size=3, cache=cache, native=False, prepare_workers=1, **options
    )
    trainer = Trainer(
        accelerator="cpu", logger=False, max_epochs=epochs, num_sanity_val_steps=0, enable_model_summary=False,
        enable_progress_bar=False, plugins=[AtomicCheckpointIO()],
        callbacks=[Times(run / "times.csv"), *extra, *checkpoint_callbacks(run, monitor="val/abs_rel", mode="min")],
    )  # fmt: skip
    torch.manual_seed(0)
    module = DepthModule(
        TinyUNet(channels=4), BADCL(), max_depth_m=10.0,
        optimizer=partial(GroupedAdamW, lr=1e-2),
        scheduler=lambda optimizer, _: torch.optim.lr_scheduler.StepLR(optimizer, step_size=1, gamma=0.5),
    )  # fmt: skip
    last = run / "checkpoints" / "last.ckpt"
    trainer.fit(module, datamodule=data, ckpt_path=last if resume else None, weights_only=True)


class Slow(Callback):
    """Sleeps in an epoch, which takes time but no work."""

    def __init__(self, *, epoch: int, seconds: float) -> None:
        self.epoch, self.seconds = epoch, seconds

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.current_epoch + 1 == self.epoch:
            time.sleep(self.seconds)


class StopAt(Callback):
    """Ends a run in the middle of an epoch, as a kill does."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if trainer.current_epoch + 1 == self.epoch:
            raise TrainingError("killed")


@pytest.mark.slow
def test_a_row_an_epoch(cache: Path, tmp_path: Path) -> None:
    fit(cache, tmp_path, [Slow(epoch=3, seconds=0.3)], progressive=[{"size": [16, 32], "until": 0.5}])
    assert (tmp_path / "times.csv").read_text().startswith(HEADER)
    rows = read_times(tmp_path / "times.csv")
    assert [tuple(row) for row in rows] == [COLUMNS] * 4
    assert [row["epoch"] for row in rows] == ["1", "2", "3", "4"]
    assert [(row["height"], row["width"]) for row in rows] == [("16", "32")] * 2 + [("32", "48")] * 2
    assert [row["images"] for row in rows] == ["8", "16", "24", "32"]  # 8 training pairs in batches of 3, 3 and 2
    wall, cpu = ([float(row[name]) for row in rows] for name in ("wall_s", "cpu_s"))
    assert wall == sorted(wall)
    assert cpu == sorted(cpu)
    assert wall[2] - wall[1] >= 0.29
    assert cpu[2] - cpu[1] < wall[2] - wall[1]
    rates = [float(row["lr"]) for row in rows]
    assert [rate / rates[0] for rate in rates] == pytest.approx([1, 0.5, 0.25, 0.125])


@pytest.mark.slow
def test_a_resumed_run_adds_to_the_rows_of_the_epochs_that_are_done(cache: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="killed"):
        fit(cache, tmp_path, [StopAt(3)])
    file = tmp_path / "times.csv"
    before = read_times(file)
    assert [row["epoch"] for row in before] == ["1", "2"]
    # as of a run that was slow, and killed after epoch 3 was written here but not to its checkpoint
    file.write_text(HEADER + "1,32,48,8,100.00,50.00,0.01\n2,32,48,16,200.00,90.00,0.005\n3,32,48,24,300.00,140.00,0\n")
    fit(cache, tmp_path, resume=True)
    rows = read_times(file)
    assert [row["epoch"] for row in rows] == ["1", "2", "3", "4"]
    assert rows[1]["wall_s"] == "200.00"
    assert [row["images"] for row in rows] == ["8", "16", "24", "32"]
    assert 200 <= float(rows[2]["wall_s"]) <= float(rows[3]["wall_s"]) < 260
    assert 90 <= float(rows[2]["cpu_s"]) <= float(rows[3]["cpu_s"]) < 140


@pytest.mark.slow
def test_a_new_run_in_the_same_place_begins_anew(cache: Path, tmp_path: Path) -> None:
    (tmp_path / "times.csv").write_text(HEADER + "1,32,48,8,100.00,50.00,0.01\n")
    fit(cache, tmp_path, epochs=1)
    rows = read_times(tmp_path / "times.csv")
    assert [row["images"] for row in rows] == ["8"]
    assert float(rows[0]["wall_s"]) < 60


@pytest.mark.parametrize(
    ("text", "epochs"),
    [
        ("", []),
        ("rubbish", []),
        (f"{HEADER}{'1' * 200_000}\n", []),
        (HEADER, []),
        ("epoch,step\n1,2\n", []),
        (HEADER + "1,32,48,8,1.00,2.00,0.01\n2,32,48,16,1", ["1"]),
        ("lr,cpu_s,wall_s,images,width,height,epoch,more\n0.1,2,1,8,48,32,1,x\n", ["1"]),
    ],
    ids=["empty", "rubbish", "a long value", "no rows", "other columns", "a row that breaks off", "in another order"],
)
def test_what_is_read_of_a_file(tmp_path: Path, text: str, epochs: list[str]) -> None:
    (tmp_path / "times.csv").write_text(text)
    assert [row["epoch"] for row in read_times(tmp_path / "times.csv")] == epochs


def test_a_link_to_a_device_has_no_rows(tmp_path: Path) -> None:
    (tmp_path / "times.csv").symlink_to("/dev/zero")
    assert read_times(tmp_path / "times.csv") == []


def test_no_file_has_no_rows(tmp_path: Path) -> None:
    assert read_times(tmp_path / "times.csv") == []


@pytest.mark.parametrize("content", [HEADER.encode() + b"x,32,48,8,1.00,2.00,0.01\n", b"\xff\xfe\x00"])
def test_a_foreign_file_does_not_stop_training(cache: Path, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "times.csv").write_bytes(content)
    fit(cache, tmp_path, epochs=1)
    assert [row["epoch"] for row in read_times(tmp_path / "times.csv")] == ["1"]
