"""What only a GPU shows: make test-gpu runs these tests, in under two minutes on one. No other test sees a GPU."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import hudepth
from hudepth.base.wording import one_line
from hudepth.inference.model import DepthModel
from hudepth.metrics.scale import scale_errors
from hudepth.runs.checkpoint import read_plain
from tests.commands import Command, Result
from tests.networks import write_tiny_checkpoint

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU to be seen")]

GPU = "cuda"
SMALL = (
    "data=rooms", "data.size=[64,64]", "data.source.scenes=12", "data.source.frames_per_scene=4",
    "data.source.size=[96,128]", "data.batch_size=4", "model.weights=none", "logger=none", "callbacks.panels=0",
    "trainer.accelerator=gpu", "trainer.max_epochs=3", "trainer.deterministic=true", "test=false",
)  # fmt: skip
REPLAYED = "are replayed as a CUDA graph"


def train(command: Command, *options: str) -> tuple[Path, Result]:
    """Return the run directory of a training, and what it printed."""
    name = f"run{len(list(Path('runs').glob('*')))}"
    done = command("train", *SMALL, f"name={name}", *options)
    assert done.code == 0, done.err
    (run,) = Path("runs", name).iterdir()
    return run, done


def assert_same(run: Path, other: Path) -> None:
    """Compare histories and last weights to the last bit."""
    assert (run / "metrics.csv").read_text() == (other / "metrics.csv").read_text()
    ours, theirs = (read_plain(each / "checkpoints" / "last.ckpt")["state_dict"] for each in (run, other))
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)


@pytest.mark.parametrize(
    "recipe",
    [
        ["+experiment=badcl", "optim.lr=0.0001220703125"],  # rates that float32 holds: a replayed step reads it as such
        ["+experiment=strong", "optim.lr=0.0009765625", "optim.encoder_lr_factor=0.125", "schedule=constant"],
    ],
    ids=["badcl", "strong"],
)
def test_replayed_steps_are_the_usual_ones(recipe: list[str], command: Command) -> None:
    replayed, done = train(command, *recipe)
    usual, silent = train(command, *recipe, "cuda_graph=false")
    assert REPLAYED in done.err
    assert REPLAYED not in silent.err
    assert_same(replayed, usual)


def test_where_the_training_pairs_lie_does_not_matter(command: Command) -> None:
    there, _ = train(command, "+experiment=badcl", "data.on_device=true")
    here, _ = train(command, "+experiment=badcl", "data.on_device=false")
    assert_same(there, here)


def test_a_resumed_run_equals_the_unbroken_one(command: Command) -> None:
    unbroken, _ = train(command, "+experiment=badcl")
    resumed, _ = train(command, "+experiment=badcl", "trainer.max_epochs=2")
    done = command("train", f"resume={resumed}", "trainer.max_epochs=3")
    assert done.code == 0, done.err
    assert_same(resumed, unbroken)


def test_a_deterministic_training_ends_in_the_same_test(command: Command) -> None:
    runs = [train(command, "+experiment=strong", "test=true")[0] for _ in range(2)]
    for protocol in ("paper", "eigen"):
        metrics = [(run / "test" / protocol / "per_image.csv").read_text() for run in runs]
        assert metrics[0] == metrics[1]


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return list(np.random.default_rng(0).integers(0, 256, (7, 120, 160, 3), np.uint8))


def predicted(model: DepthModel, pictures: list[np.ndarray]) -> np.ndarray:
    """Depth [m] of the last of several rounds, in batches of four and three: by then the network is replayed."""
    for _ in range(5):
        depths = model.predict_many(pictures, batch_size=4)
    return np.stack([depth.metres for depth in depths])


def test_a_replayed_network_predicts_what_it_did(pictures: list[np.ndarray]) -> None:
    model = hudepth.load("nyu", device=GPU)
    backend: Any = model.backend
    replayed = predicted(model, pictures)
    assert len(backend._replayed._known) == 2
    again = predicted(model, pictures[::-1])[::-1]  # the memory of a recording is used again and again
    np.testing.assert_allclose(again, replayed, atol=1e-4)
    backend._replayed.wanted = False
    backend._replayed._known.clear()
    np.testing.assert_allclose(replayed, predicted(model, pictures), atol=1e-4)
    assert not backend._replayed._known
    np.testing.assert_allclose(replayed, predicted(hudepth.load("nyu", device="cpu"), pictures), atol=1e-3)


@pytest.mark.parametrize(("precision", "mean_mm", "most_mm"), [("float16", 3, 30), ("bfloat16", 12, 120)])
def test_half_precision_costs_millimetres(
    precision: str, mean_mm: float, most_mm: float, pictures: list[np.ndarray]
) -> None:
    exact = predicted(hudepth.load("nyu", device=GPU), pictures)
    half = predicted(hudepth.load("nyu", device=GPU, precision=precision), pictures)
    error_mm = 1000 * np.abs(half - exact)
    assert 0 < error_mm.mean() < mean_mm
    assert error_mm.max() < most_mm


def test_a_batch_that_does_not_fit_is_one_line() -> None:
    with pytest.raises(torch.OutOfMemoryError) as error:
        torch.empty(2**46, dtype=torch.uint8, device=GPU)
    assert "batch_size" in one_line(error.value, "predict")


def test_every_way_to_run_it_is_measured(command: Command, tmp_path: Path) -> None:
    checkpoint = write_tiny_checkpoint(tmp_path / "tiny.ckpt")
    names = ["eager", "default", "cuda_graph", "tf32", "fp16", "bf16"]
    options = (f"backends=[{','.join(names)}]", "batches=[1,2]", "repeats=1", "seconds=0", f"device={GPU}")
    done = command("bench", f"checkpoint={checkpoint}", *options)
    assert done.code == 0, done.err
    content = json.loads((tmp_path / "bench" / "bench.json").read_text())
    assert [row["contender"] for row in content["rows"]] == 2 * names
    for row in content["rows"]:
        assert row["difference_mm"] < (100 if row["contender"] in ("fp16", "bf16") else 5)
        assert row["share_of_peak"] is not None


def test_scales_of_images_are_those_of_a_cpu() -> None:
    truth = torch.rand(3, 1, 31, 40) + 0.5
    pred, valid = truth * torch.tensor([0.5, 1.0, 3.0])[:, None, None, None] + 0.1 * torch.rand_like(truth), truth > 0.7
    found = scale_errors(pred.to(GPU), truth.to(GPU), valid.to(GPU)).cpu()
    torch.testing.assert_close(found, scale_errors(pred, truth, valid), rtol=1e-5, atol=1e-6)
