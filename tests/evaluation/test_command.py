from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hudepth.base.errors import DataError
from hudepth.evaluation.lineage import refuse_training_pairs
from hudepth.evaluation.test_data import open_data
from hudepth.metrics.alignment import ALIGNMENTS, align
from hudepth.runs.checkpoint import KEY, load_checkpoint, read_plain
from tests.commands import TINY, Command
from tests.devices import deterministic


def metrics(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A copy of the trained run, for tests that write to it."""
    copy = tmp_path / "runs" / "tiny" / trained.name
    shutil.copytree(trained, copy)
    return copy


@pytest.mark.parametrize(
    "spec", [pytest.param("file", marks=pytest.mark.slow), "run", pytest.param("last", marks=pytest.mark.slow)]
)
def test_a_checkpoint_needs_nothing_else(spec: str, command: Command, run: Path, trained: Path) -> None:
    shutil.rmtree(run / "test")
    checkpoint = {"file": run / "checkpoints" / "best.ckpt", "run": run, "last": "last"}[spec]
    done = command("test", f"checkpoint={checkpoint}")
    assert done.code == 0, done.err
    for protocol in ("paper", "eigen"):
        assert metrics(run / "test" / protocol) == metrics(trained / "test" / protocol)  # what training printed
        assert (run / "test" / protocol / "panels.png").stat().st_size > 10_000
    assert "mean depth map" in done.out
    assert done.out.splitlines()[0] == "2 test images of rooms"
    assert done.out.count("mean depth map") == 2  # one table, a part for each protocol


def test_a_gpu_scores_with_deterministic_operations_alone(command: Command, run: Path, trained: Path) -> None:
    shutil.rmtree(run / "test")
    with deterministic():
        done = command("test", f"checkpoint={run}", "trainer.accelerator=cpu")
        depths = 1 + torch.rand(2, 1, 8, 8), 1 + torch.rand(2, 1, 8, 8), torch.rand(2, 1, 8, 8) > 0.2
        for kind in ALIGNMENTS:
            align(*depths, kind=kind)
    assert done.code == 0, done.err
    assert metrics(run / "test" / "eigen") == metrics(trained / "test" / "eigen")


def test_the_metric_file_states_its_protocol(trained: Path) -> None:
    stated = metrics(trained / "test" / "eigen")
    assert stated["protocol"]["crop"] == [45, 471, 41, 601]
    assert stated["protocol"]["clamp_m"] == [1e-3, 10.0]
    assert stated["protocol"]["valid"] == "measured, 0.001 m < truth < 10 m"
    assert stated["protocol"]["averaging"] == "image"
    assert stated["protocol"]["ssim"]["window"] == 11
    assert stated["protocol"]["units"]["rmse"] == "m"
    assert stated["split"]["kind"] == "official"
    assert len(stated["split"]["sha256"]) == len(stated["data"]["fingerprint"]) == 64
    assert stated["network_size"] == [32, 48]
    assert stated["images"] == 2


def test_the_table_is_the_mean_of_the_images(trained: Path) -> None:
    with (trained / "test" / "eigen" / "per_image.csv").open() as file:
        rows = list(csv.DictReader(file))
    table = metrics(trained / "test" / "eigen")["metrics"]["model"]
    assert [row["scene"] for row in rows] == ["room_0005"] * 2
    of_the_set = {"rmse_pooled", "scale_sd"}
    for name, value in ((name, value) for name, value in table.items() if name not in of_the_set):
        assert np.mean([float(row[name]) for row in rows]) == pytest.approx(value, rel=1e-5)


def test_one_protocol_and_an_output_folder(command: Command, trained: Path, tmp_path: Path) -> None:
    done = command("test", f"checkpoint={trained}", "protocol=paper", "output=scores", "baselines=false", "panels=0")
    assert done.code == 0, done.err
    assert [path.name for path in (tmp_path / "scores").iterdir()] == ["paper"]
    assert list(metrics(tmp_path / "scores" / "paper")["metrics"]) == ["model"]


@pytest.mark.slow
def test_a_moved_file_is_tested_on_its_own_split(command: Command, trained: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved.ckpt"
    shutil.copy(trained / "checkpoints" / "best.ckpt", moved)
    assert command("test", f"checkpoint={moved}").code == 0
    assert metrics(tmp_path / "test_moved" / "eigen") == {
        **metrics(trained / "test" / "eigen"),
        # a file that lies alone does not know of earlier looks at the test images
        "checkpoint": {
            **metrics(trained / "test" / "eigen")["checkpoint"],
            "file": "moved.ckpt",
            "scored_before": None,
        },
    }


@pytest.mark.slow
def test_other_data(command: Command, run: Path) -> None:
    done = command(
        "test", f"checkpoint={run}", "data=rooms", *(a for a in TINY if a.startswith("data")), "data.source.seed=5"
    )
    assert done.code == 0, done.err
    ours, other = metrics(run / "test" / "paper"), metrics(run / "test_rooms" / "paper")
    assert ours["data"]["fingerprint"] != other["data"]["fingerprint"]
    assert ours["metrics"]["model"] != other["metrics"]["model"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["data.rooot=x"], "data.rooot: the checkpoint's data has no such key."),
        (["data.source.scenes=7"], "the split of rooms is not the one it was trained with"),
        (["protocol=eigne"], "protocol: no 'eigne'. Did you mean 'eigen'? Pass one of densedepth, diode_indoors, "),
    ],
)  # fmt: skip
def test_mistakes(arguments: list[str], message: str, command: Command, trained: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved.ckpt"
    shutil.copy(trained / "checkpoints" / "best.ckpt", moved)
    done = command("test", f"checkpoint={moved}", *arguments)
    assert done.code == 1
    assert message in done.err.splitlines()[-1]
    assert "Traceback" not in done.err


def test_a_checkpoint_with_code_is_refused_and_not_run(command: Command, tmp_path: Path) -> None:
    marker = tmp_path / "ran"

    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (marker,)

    torch.save({"state_dict": {}, KEY: Evil()}, tmp_path / "evil.ckpt")
    done = command("test", "checkpoint=evil.ckpt")
    assert done.code == 1
    assert "'evil.ckpt' is refused: it holds more than tensors and plain values" in done.err
    assert not marker.exists()


def test_a_checkpoint_whose_configuration_names_code_is_refused(
    command: Command, trained: Path, tmp_path: Path
) -> None:
    content = read_plain(trained / "checkpoints" / "best.ckpt")
    content[KEY]["config"]["model"] = {"_target_": "os.system", "command": f"touch {tmp_path / 'ran'}"}
    torch.save(content, tmp_path / "evil.ckpt")
    done = command("test", "checkpoint=evil.ckpt")
    assert done.code == 1
    assert "_target_: 'os.system' is not under a trusted module" in done.err
    assert not (tmp_path / "ran").exists()


def test_a_checkpoint_of_another_model_is_refused(command: Command, trained: Path, tmp_path: Path) -> None:
    content = read_plain(trained / "checkpoints" / "best.ckpt")
    content[KEY]["config"]["model"]["channels"] = 16
    torch.save(content, tmp_path / "other.ckpt")
    done = command("test", "checkpoint=other.ckpt")
    assert done.code == 1
    assert "'other.ckpt' is from another model: " in done.err.splitlines()[-1]


@pytest.mark.slow
def test_a_checkpoint_does_not_say_where_to_write(command: Command, trained: Path, tmp_path: Path) -> None:
    content = read_plain(trained / "checkpoints" / "best.ckpt")
    content[KEY]["config"]["data"]["cache"] = str(tmp_path / "elsewhere")
    torch.save(content, tmp_path / "stranger.ckpt")
    assert command("test", "checkpoint=stranger.ckpt").code == 0
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.slow
def test_other_data_keeps_the_networks_size_and_scale(command: Command, trained: Path, tmp_path: Path) -> None:
    source = [a for a in TINY if a.startswith("data.source")]
    done = command("test", f"checkpoint={trained}", "data=rooms", *source, "data.source.seed=5", "output=scores")
    assert done.code == 0, done.err
    assert metrics(tmp_path / "scores" / "paper")["network_size"] == [32, 48]
    done = command("test", f"checkpoint={trained}", "data.max_depth_m=5")
    assert done.code == 1
    assert "data.max_depth_m: the network was trained for 10.0 m" in done.err.splitlines()[-1]


def test_training_pairs_are_not_tested_on(command: Command, trained: Path) -> None:
    done = command("test", f"checkpoint={trained}", "data.split=random", "output=scores")
    assert done.code == 1
    assert "test pairs were trained on, under data.split=official." in done.err.splitlines()[-1]


def test_pairs_that_chose_the_best_epoch_are_not_tested_on(trained: Path) -> None:
    checkpoint = load_checkpoint(str(trained))
    datamodule, _ = open_data(checkpoint, {}, trust=[])
    split = datamodule.split
    datamodule.split = replace(split, val=split.test, test=split.val)
    with pytest.raises(DataError, match=r"test pairs were validated on, under data\.split=official\."):
        refuse_training_pairs(checkpoint, datamodule, subsets=("test",))
    refuse_training_pairs(checkpoint, datamodule, subsets=("val",))


def test_pictures_are_told_of_where_they_were_not_compared(trained: Path, caplog: pytest.LogCaptureFixture) -> None:
    checkpoint = load_checkpoint(str(trained))
    datamodule, _ = open_data(checkpoint, {}, trust=[])
    for fingerprint, told in ((checkpoint.data["fingerprint"], False), ("another", True)):
        past = {**checkpoint.data, "fingerprint": fingerprint, "source": "folder", "pictures": 7}
        refuse_training_pairs(replace(checkpoint, data=past), datamodule, subsets=("test",))
        assert ("also learned from 7 pictures, which were not compared with this data" in caplog.text) is told


def test_an_output_in_the_way_is_found_before_the_work(command: Command, trained: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    done = command("test", f"checkpoint={trained}", "output=taken")
    assert done.code == 1
    assert "output: cannot write to 'taken' (File exists)." in done.err.splitlines()[-1]


@pytest.mark.slow
def test_a_protocol_that_scores_nothing_does_not_lose_the_others(
    command: Command, trained: Path, tmp_path: Path
) -> None:
    done = command(
        "test", f"checkpoint={trained}", "protocol=[eigen,paper]", f"output={tmp_path / 'out'}", "panels=1",
        "protocol.eigen.crop=[0,9000,0,9000]", "protocol.eigen.crop_size=null",
    )  # fmt: skip
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith("hudepth-test: protocol=eigen: no pixel of ")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["paper"]
    assert {"metrics.json", "per_image.csv", "panels.png"} <= {p.name for p in (tmp_path / "out" / "paper").iterdir()}


def test_a_protocol_of_your_own_is_named_and_stated(command: Command, trained: Path, tmp_path: Path) -> None:
    own = (
        "protocol=eigen",
        "protocol.eigen.alignment=median",
        "protocol.eigen.name=mine",
        "protocol.eigen.strata=false",
    )
    done = command("test", f"checkpoint={trained}", *own, "output=out", "panels=0", "baselines=false")
    assert done.code == 0, done.err
    assert "mine protocol, " in done.out
    assert "each prediction aligned to its ground truth (median)" in done.out
    assert sorted(path.name for path in (tmp_path / "out" / "mine").iterdir()) == ["metrics.json", "per_image.csv"]
    document = json.loads((tmp_path / "out" / "mine" / "metrics.json").read_text())
    assert document["protocol"]["alignment"] == "median"
    assert list(document["metrics"]) == list(document["intervals"]) == ["model"]
    assert document["left_out"] == []
    assert document["uncertainty"]["scenes"] == 1
