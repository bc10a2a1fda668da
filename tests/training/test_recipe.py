"""The parts of a training recipe, through the console script."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hudepth.data.store import DepthStore
from hudepth.runs.checkpoint import load_checkpoint
from hudepth.training.initial import Training, network_before
from hudepth.training.options import parse_options
from tests.commands import TINY, Command, script

QUIET = (*TINY, "callbacks.panels=0", "logger=none")


def only_run(folder: Path, name: str) -> Path:
    (run,) = (folder / "runs" / name).iterdir()
    return run


def rows(run: Path, file: str) -> list[dict[str, str]]:
    with (run / file).open() as opened:
        return list(csv.DictReader(opened))


def last_line(text: str) -> str:
    return text.splitlines()[-1]


@pytest.mark.slow
def test_progressive_resolution_is_in_times_csv_and_only_its_last_part_can_be_best(
    command: Command, tmp_path: Path
) -> None:
    progressive = "data.progressive=[{size:[16,32],until:0.25},{size:[32,32],until:0.75}]"
    done = command("train", *QUIET, "name=small", "trainer.max_epochs=4", progressive, "test=false")
    assert done.code == 0, done.err
    run = only_run(tmp_path, "small")
    times = rows(run, "times.csv")
    assert [(row["height"], row["width"]) for row in times] == [("16", "32"), ("32", "32"), ("32", "32"), ("32", "48")]
    assert [row["images"] for row in times] == ["8", "16", "24", "32"]
    assert [float(row["cpu_s"]) for row in times] == sorted(float(row["cpu_s"]) for row in times)
    assert load_checkpoint(str(run)).epoch == 4
    assert all(float(row["val/abs_rel"]) > 0 for row in rows(run, "metrics.csv"))


@pytest.mark.parametrize(
    ("progressive", "message"),
    [
        (
            "[{size:[20,32],until:0.5}]",
            "data.progressive[0].size: images of 20 x 32 (height x width), but both sides must be multiples of 16. "
            "Pass data.progressive[0].size=[16,32] or [32,32].",
        ),
        (
            "[{size:[16,32],until:1.0}]",
            "data.progressive.until: 1.0 is not a number",
        ),
        (
            "[{size:[16],until:0.5}]",
            "data.progressive.size: [16] is not [height,width]",
        ),
    ],
)
def test_a_progressive_resolution_that_cannot_be(progressive: str, message: str, command: Command) -> None:
    done = command("train", *QUIET, f"data.progressive={progressive}")
    assert done.code == 1
    assert last_line(done.err).startswith(f"hudepth-train: {message}")


@pytest.mark.parametrize(
    ("option", "what"),
    [
        ("schedule=warmup_cosine", "the learning-rate schedule"),
        ("data.progressive=[{size:[16,32],until:0.5}]", "the progressive resolution"),
        ("callbacks.extra=[{_target_:hudepth.training.freezing.FreezeEncoder,until:0.5}]", "FreezeEncoder"),
    ],
)
@pytest.mark.slow
def test_what_is_laid_out_over_the_epochs_keeps_their_number(
    option: str, what: str, command: Command, tmp_path: Path
) -> None:
    network = ["model=hybrid_unet"] if "Freeze" in option else []
    assert command("train", *QUIET, *network, option, "name=fixed", "test=false").code == 0
    done = command("train", f"resume={only_run(tmp_path, 'fixed')}", "trainer.max_epochs=4")
    assert last_line(done.err) == (
        f"hudepth-train: resume: {what} of this run is laid out over 2 epochs, so trainer.max_epochs cannot change. "
        "Start a new run, or use schedule=constant and data.progressive=null from the start."
    )


def test_a_rate_that_diverges_stops_with_the_step_and_where_to_go_on(command: Command) -> None:
    done = command("train", *QUIET, "optim.lr=1e30", "test=false")
    assert done.code == 1
    line = last_line(done.err)
    assert re.search(r"the loss is nan in epoch 1, batch \d \(step \d\), of the pairs room_", line)
    assert "No epoch was finished, so there is no checkpoint." in line
    assert "lower optim.lr" in line


@pytest.mark.slow
def test_augmentation_that_leaves_nothing_stops_with_the_pairs(
    command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hudepth.data import augment

    def nothing(image: torch.Tensor, depth: torch.Tensor, *_: Any, **__: Any) -> tuple[torch.Tensor, torch.Tensor]:
        return image, torch.zeros_like(depth)

    monkeypatch.setattr(augment, "warp", nothing)
    done = command("train", *QUIET, "augment=flip", "test=false")
    assert done.code == 1
    line = last_line(done.err)
    assert line.startswith(
        "hudepth-train: augmentation left no measured pixel in 4 of 4 batches, first in epoch 1, batch 0 (step 1), of "
        "the pairs room_"
    )
    assert line.endswith("Lower augment.zoom, augment.rotate_deg or augment.border, or raise data.batch_size.")

    calls: list[int] = []

    def now_and_then(image: torch.Tensor, depth: torch.Tensor, *_: Any, **__: Any) -> tuple[torch.Tensor, torch.Tensor]:
        calls.append(len(calls))
        return image, torch.zeros_like(depth) if len(calls) % 4 == 0 else depth

    monkeypatch.setattr(augment, "warp", now_and_then)
    done = command("train", *QUIET, "augment=flip", "test=false", "loss=mixture", "name=some")
    assert done.code == 0, done.err
    assert len(calls) == 8


@pytest.mark.parametrize("schedule", ["step", "warmup_cosine"])
@pytest.mark.slow
def test_a_training_without_a_number_of_epochs(schedule: str, command: Command) -> None:
    done = command(
        "train", *QUIET, f"schedule={schedule}", "trainer.max_epochs=-1", "+trainer.max_steps=3", "test=false"
    )
    assert done.code == 0, done.err
    endless = ("trainer.max_epochs=-1", "+trainer.max_time={seconds:2}")
    done = command("train", *QUIET, f"schedule={schedule}", *endless, "test=false", "name=endless")
    if schedule == "step":
        assert done.code == 0, done.err
        return
    assert "schedule: the length of the training is not set. Pass trainer.max_epochs" in last_line(done.err)


@pytest.mark.slow
def test_a_schedule_is_not_stretched_when_a_run_goes_on(command: Command, tmp_path: Path) -> None:
    done = command("train", *QUIET, "schedule=warmup_cosine", "+trainer.max_steps=4", "test=false")
    assert done.code == 0, done.err
    run = only_run(tmp_path, "default")
    done = command("train", f"resume={run}", "+trainer.max_steps=6")
    assert done.code == 1
    assert last_line(done.err) == (
        "hudepth-train: resume: the learning-rate schedule of this run is laid out over 4 steps, and now there would "
        "be 6. Leave trainer.accumulate_grad_batches, trainer.limit_train_batches and the number of devices as they "
        "were, or start a new run."
    )


@pytest.mark.slow
def test_early_stopping_waits_for_the_full_size(command: Command, tmp_path: Path) -> None:
    options = ("data.progressive=[{size:[16,32],until:0.8}]", "callbacks=early_stopping", "optim.lr=1e-30")
    patience = ("callbacks.early_stopping.patience=1", "trainer.max_epochs=10")
    done = command("train", *QUIET, *options, *patience, "test=false")
    assert done.code == 0, done.err
    run = only_run(tmp_path, "default")
    assert (run / "checkpoints" / "best.ckpt").is_file()
    assert len(rows(run, "metrics.csv")) == 10


def test_recomputed_activations_cannot_be_compiled(command: Command) -> None:
    done = command("train", *QUIET, "compile=true", "model=hybrid_unet", "model.recompute=true")
    assert last_line(done.err).startswith("hudepth-train: compile: ")
    assert "model.recompute" in last_line(done.err)


@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a compiler")
@pytest.mark.slow
def test_a_compiled_network_trains_to_the_same_and_its_checkpoint_is_like_any_other(
    tmp_path: Path, cache: Path
) -> None:
    for name, compiled in (("eager", "false"), ("compiled", "true")):
        options = (*QUIET, f"name={name}", f"compile={compiled}", "callbacks=ema", "test=false")
        # a process of its own: the checks of shapes that run in this one cannot be traced
        done = subprocess.run(**script("train", *options, cwd=tmp_path, cache=cache), check=False, timeout=240)
        assert done.returncode == 0, done.stdout
        assert ("compile: the first step took " in done.stdout) is (compiled == "true")
    eager, compiled_run = (load_checkpoint(str(only_run(tmp_path, name))) for name in ("eager", "compiled"))
    assert eager.state.keys() == compiled_run.state.keys()
    for name, value in eager.state.items():
        torch.testing.assert_close(compiled_run.state[name], value, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_training_can_start_from_another_run(command: Command, tmp_path: Path) -> None:
    assert command("train", *QUIET, "name=first", "test=false").code == 0
    first = only_run(tmp_path, "first")
    done = command(
        "train", *QUIET, "name=second", f"init={first}", "optim.lr=1e-30", "optim.weight_decay=0", "data.source.seed=5"
    )
    assert done.code == 0, done.err
    assert f"init: weights of '{first / 'checkpoints' / 'best.ckpt'}', epoch" in done.err
    second = only_run(tmp_path, "second")
    begun, went_on = load_checkpoint(str(first)), load_checkpoint(str(second))
    assert torch.equal(begun.state["decode.weight"], went_on.state["decode.weight"])
    (before,) = went_on.data["before"]
    assert before["fingerprint"] == begun.data["fingerprint"] != went_on.data["fingerprint"]
    assert before["split"] == begun.split
    assert "in shares of" not in done.err


@pytest.mark.slow
def test_parts_that_init_skips_begin_anew_whatever_their_shapes(command: Command, tmp_path: Path) -> None:
    assert command("train", *QUIET, "name=first", "test=false").code == 0
    still = ("optim.lr=1e-30", "optim.weight_decay=0", "data.source.seed=5", "test=false", "trainer.max_epochs=1")
    begun = load_checkpoint(str(only_run(tmp_path, "first")))
    for name, skip in (("same", "[decode]"), ("all", "[]")):
        done = command("train", *QUIET, *still, f"name={name}", f"init={begun.path}", f"init_skip={skip}", "seed=3")
        assert done.code == 0, done.err
        assert (", but decode" in done.err) is (name == "same")
        state = load_checkpoint(str(only_run(tmp_path, name))).state
        assert state["encode.weight"].equal(begun.state["encode.weight"])
        assert state["decode.weight"].equal(begun.state["decode.weight"]) is (name == "all")
    wide = (*still, "name=wide", "model.channels=5", f"init={begun.path}")
    assert command("train", *QUIET, *wide, "init_skip=[encode,norm,decode]").code == 0
    for skip, line in (("[encode,norm]", "1 tensors do not fit"), ("[head]", "init_skip: TinyUNet has no part 'head'")):
        done = command("train", *QUIET, *wide, f"init_skip={skip}")
        assert done.code == 1
        assert line in last_line(done.err)
    done = command("train", *QUIET, *wide, "name=text", "init_skip=decode", "model.channels=3")
    assert "tensors do not fit" in last_line(done.err)  # of the other parts: one name needs no brackets


@pytest.mark.parametrize(("changes", "worse"), [(["optim.lr=3"], True), (["data.max_depth_m=20"], None)])
def test_the_network_before_training_is_scored_next_to_it(
    changes: list[str], worse: bool | None, command: Command, trained: Path, tmp_path: Path
) -> None:
    shared = (*TINY, f"init={trained}", "trainer.max_epochs=1", "protocol=eigen", "logger=none")
    done = command("train", *shared, *changes, "name=second")
    assert done.code == 0, done.err
    assert "before training" in done.out
    metrics = json.loads((only_run(tmp_path, "second") / "test/eigen/metrics.json").read_text())["metrics"]
    assert list(metrics)[:3] == ["model", "before_training", "nearest_frame"]
    expected = json.loads((trained / "test/eigen/metrics.json").read_text())["metrics"]["model"]
    for name, value in metrics["before_training"].items():  # edges are measured of the model alone
        assert value == pytest.approx(expected[name], rel=1e-5), name
    after, before = (metrics[name]["abs_rel"] for name in ("model", "before_training"))
    told = f"abs_rel {after:.3f} after training, {before:.3f} before"
    assert told in done.err
    assert ("eigen protocol: worse than the network it started from: " in done.err) == (after > before)
    assert worse is None or after > before


def test_a_start_that_is_gone_is_told(trained: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = {**load_checkpoint(str(trained)).config, "init": str(tmp_path / "gone")}
    training = Training(config, parse_options(config), tmp_path)
    assert network_before(training, size=(32, 48), max_depth_m=10.0) is None
    assert "the network before training is not scored: " in caplog.text
    training = Training({**config, "init": None}, parse_options({**config, "init": None}), tmp_path)
    assert network_before(training, size=(32, 48), max_depth_m=10.0) is None


@pytest.mark.slow
def test_a_start_with_another_largest_depth_is_named(command: Command, tmp_path: Path) -> None:
    assert command("train", *QUIET, "name=first", "test=false").code == 0
    done = command(
        "train", *QUIET, "name=second", f"init={only_run(tmp_path, 'first')}", "data.max_depth_m=20", "test=false"
    )
    assert done.code == 0, done.err
    assert re.search(r"init: .*10\.0 m.*\n?.*20", done.err)
    assert "data.max_depth_m=10.0" in done.err
    assert "Pass data.max_depth_m=10.0 to keep them." in done.err


@pytest.mark.slow
def test_a_start_that_has_seen_what_is_to_judge_it_is_refused(command: Command, tmp_path: Path) -> None:
    assert command("train", *QUIET, "name=first", "data.split=random", "test=false").code == 0
    first = only_run(tmp_path, "first")
    done = command("train", *QUIET, f"init={first}", "name=second")
    assert done.code == 1
    assert "pairs were trained on, under data.split=random." in done.err
    # nor is it forgotten by way of other data
    assert command("train", *QUIET, "name=third", f"init={first}", "data.source.seed=5", "test=false").code == 0
    third = only_run(tmp_path, "third")
    shutil.rmtree(first)
    done = command("train", *QUIET, f"init={third}", "name=fourth")
    assert "pairs were trained on, under data.split=random." in done.err


@pytest.mark.slow
def test_a_start_of_other_files_of_the_same_set_is_named(command: Command, tmp_path: Path) -> None:
    assert command("train", *QUIET, "name=first", "test=false", "paths.runs=elsewhere").code == 0
    done = command(
        "train", *QUIET, "init=last", "paths.runs=elsewhere", "name=second", "data.source.seed=5", "test=false"
    )
    assert done.code == 0, done.err
    assert re.search(r"was trained on .*rooms", done.err)


@pytest.mark.parametrize("damage", [{"before": "rooms"}, {"before": [1]}, {"split": {"kind": "random"}}])
@pytest.mark.slow
def test_a_start_that_does_not_say_what_it_was_trained_on(
    damage: dict[str, Any], command: Command, tmp_path: Path
) -> None:
    assert command("train", *QUIET, "name=first", "test=false").code == 0
    file = only_run(tmp_path, "first") / "checkpoints" / "best.ckpt"
    content = torch.load(file, weights_only=True)
    record = content["hudepth"]
    (record["data"] if "before" in damage else record).update(damage)
    torch.save(content, tmp_path / "alone.ckpt")
    done = command("train", *QUIET, f"init={tmp_path / 'alone.ckpt'}", "name=second")
    assert done.code == 1
    assert re.search(r"it was trained on", last_line(done.err))


@pytest.mark.slow
def test_a_start_of_another_network_is_refused(command: Command, tmp_path: Path) -> None:
    assert command("train", *QUIET, "name=first", "test=false").code == 0
    done = command("train", *QUIET, f"init={only_run(tmp_path, 'first')}", "model=hybrid_unet", "name=second")
    assert done.code == 1
    assert "is from another model" in last_line(done.err)


@pytest.mark.slow
def test_each_look_at_the_test_images_is_kept(command: Command, tmp_path: Path) -> None:
    assert command("train", *QUIET, "name=looked", "protocol=paper", "baselines=false").code == 0
    run = only_run(tmp_path, "looked")
    looks = json.loads((run / "scored.json").read_text())
    assert [(look["epoch"], look["data"], look["protocols"]) for look in looks] == [
        (load_checkpoint(str(run)).epoch, "rooms", ["paper"])
    ]
    done = command("train", f"resume={run}", "trainer.max_epochs=3")
    assert re.search(rf"tested after epoch {looks[0]['epoch']}", done.err)
    last = run / "checkpoints" / "last.ckpt"
    assert command("test", f"checkpoint={last}", "output=again", "protocol=paper", "baselines=false").code == 0
    metrics = json.loads((tmp_path / "again" / "paper" / "metrics.json").read_text())
    others = {look["epoch"] for look in json.loads((run / "scored.json").read_text())} - {3}
    assert metrics["checkpoint"]["scored_before"] == sorted(others)
    assert len(json.loads((run / "scored.json").read_text())) == 3


@pytest.mark.slow
def test_a_test_is_not_lost_because_it_cannot_be_noted(command: Command, tmp_path: Path) -> None:
    assert command("train", *QUIET, "test=false").code == 0
    run = only_run(tmp_path, "default")
    (run / "scored.json").mkdir()
    done = command("test", f"checkpoint={run}", "output=results", "protocol=paper", "baselines=false")
    assert done.code == 0, done.err
    assert f"'{run}' cannot record" in done.err
    metrics = json.loads((tmp_path / "results" / "paper" / "metrics.json").read_text())
    assert metrics["checkpoint"]["scored_before"] is None


@pytest.fixture
def teacher(command: Command, tmp_path: Path, cache: Path) -> Path:
    """The truth itself as a teacher, in files of the images' own size."""
    assert command("train", *QUIET, "name=prepare", "test=false", "trainer.max_epochs=1").code == 0
    folder = tmp_path / "teacher"
    stores = (DepthStore(path) for path in sorted(cache.glob("rooms-32x48-*.h5")))
    store = next(s for s in stores if s.has_native and len(s) == 12 and s.info["native_sizes"] == [[48, 64]])
    for index, record in enumerate(store.records):
        (folder / record.id).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"{record.id}.npy", store.read_native(index))
    return folder


@pytest.mark.slow
def test_a_teacher_that_is_the_truth_is_as_far_away_as_the_truth(
    teacher: Path, command: Command, tmp_path: Path
) -> None:
    done = command(
        "train", *QUIET, "name=taught", "distill=metric", f"distill.teacher={teacher}", "distill.weight=0.5",
        "augment=depth", "augment.rotate_deg=0", "test=false",
    )  # fmt: skip
    assert done.code == 0, done.err
    for row in rows(only_run(tmp_path, "taught"), "metrics.csv"):
        terms = {
            name: float(row[f"train/loss/{name}"]) for name in ("total", "boundary", "smoothness", "scaling", "distill")
        }
        assert terms["distill"] > 0.01
        whole = 3 * terms["boundary"] + 1.2 * terms["smoothness"] + terms["scaling"] + 0.5 * terms["distill"]
        assert terms["total"] == pytest.approx(whole, rel=1e-5)
        assert "val/loss/distill" not in row


@pytest.mark.slow
def test_a_teacher_that_lacks_depths_is_refused(teacher: Path, command: Command) -> None:
    for file in teacher.rglob("*.npy"):
        file.unlink()
    done = command("train", *QUIET, "distill=affine", f"distill.teacher={teacher}", "test=false")
    assert done.code == 1
    assert last_line(done.err).startswith("hudepth-train: distill.teacher: 8 of 8 training pairs have no depth in ")


def test_a_teacher_must_be_named(command: Command) -> None:
    done = command("train", *QUIET, "distill=metric", "test=false")
    assert done.code == 1
    assert "distill.teacher" in last_line(done.err)


@pytest.mark.slow
def test_auxiliary_heads_train_and_resume_and_are_no_part_of_the_network(command: Command, tmp_path: Path) -> None:
    options = (*QUIET, "model=lite", "model.weights=none", "data.size=[32,64]", "auxiliary=heads", "test=false")
    assert command("train", *options, "name=whole", "trainer.max_epochs=2").code == 0
    assert command("train", *options, "name=parts", "trainer.max_epochs=1").code == 0
    parts = only_run(tmp_path, "parts")
    resumed = command("train", f"resume={parts}", "trainer.max_epochs=2")
    assert resumed.code == 0, resumed.err
    whole = only_run(tmp_path, "whole")
    states = [torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"] for run in (whole, parts)]
    assert "auxiliary.heads.normals.weight" in states[0]
    assert states[0].keys() == states[1].keys()
    assert all(states[0][name].equal(states[1][name]) for name in states[0])
    for row in rows(whole, "metrics.csv"):
        terms = {name: float(row[f"train/loss/{name}"]) for name in ("boundary", "smoothness", "scaling")}
        heads = float(row["train/loss/normals"]) + float(row["train/loss/edges"])
        total = 3 * terms["boundary"] + 1.2 * terms["smoothness"] + terms["scaling"] + 0.5 * heads
        assert float(row["train/loss/total"]) == pytest.approx(total, rel=1e-5)
        assert "val/loss/normals" not in row
    net = load_checkpoint(str(whole)).build_net(trust=[])
    assert not [name for name, _ in net.named_parameters() if "heads" in name]


def test_auxiliary_heads_need_dense_depth(command: Command) -> None:
    done = command("train", "model=lite", "model.weights=none", "data=kitti", "data.root=.", "auxiliary=heads")
    assert done.code == 1
    assert last_line(done.err).startswith("hudepth-train: auxiliary: kitti measures few pixels")


def test_auxiliary_heads_need_a_decoder(command: Command) -> None:
    done = command("train", *QUIET, "auxiliary=heads", "test=false")
    assert done.code == 1
    assert last_line(done.err) == (
        "hudepth-train: auxiliary: TinyUNet has no decoder's map to use. Pass auxiliary=none."
    )
