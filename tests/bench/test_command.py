from __future__ import annotations

import csv
import json
import re
import subprocess
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from PIL import Image

from hudepth.base.errors import ConfigError
from hudepth.base.options import plain
from hudepth.base.verbs import conf_folder
from hudepth.bench import backends
from hudepth.bench.backends import ON_CPU, ON_GPU
from hudepth.bench.plan import make_plan
from hudepth.bench.rows import Row
from tests.commands import Command, script

TINY = ("model=tiny", "size=[32,32]", "batches=[2,1]", "repeats=2", "seconds=0")


@pytest.mark.slow
def test_the_installed_script_measures_from_any_folder(tmp_path: Path, cache: Path) -> None:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    arguments = (*TINY, "backends=[onnxruntime,default]", "output=there/bench", "threads=1")
    done = subprocess.run(**script("bench", *arguments, cwd=tmp_path, cache=cache), check=False)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stdout
    for text in ("TinyUNet, 32 x 32, threads: 1", "Fastest exact backend at batch 1: ", "Random weights:", "8,217"):
        assert text in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there"]
    folder = tmp_path / "there" / "bench"
    assert sorted(path.name for path in folder.iterdir()) == ["bench.csv", "bench.json", "bench.md", "bench.png"]
    content = json.loads((folder / "bench.json").read_text())
    check_rows(content["rows"], folder / "bench.csv")
    assert content["model"]["parameters"] == 8217
    assert content["settings"]["batches"] == [1, 2]
    assert content["machine"]["packages"]["onnxruntime"]
    (product,) = content["matmul_gflop_per_s"].items()
    assert product[0] == "float32"
    assert len(product[1]["of_each_round"]) == 4
    assert product[1]["best"] == max(product[1]["of_each_round"])
    assert {len(entry["rounds"]) for entry in content["times_s"]} == {2}
    page = (folder / "bench.md").read_text()
    assert all(line in page for line in (*content["sentences"], *content["notes"]))
    assert Image.open(folder / "bench.png").width > 500


def check_rows(rows: list[dict[str, object]], table: Path) -> None:
    names = [(row["batch"], row["contender"]) for row in rows]
    assert names == [(batch, name) for batch in (1, 2) for name in ("eager", "default", "onnxruntime")]
    with table.open(newline="") as file:
        read = list(csv.DictReader(file))
    assert [{key: str(value) for key, value in row.items()} for row in rows] == read
    assert list(read[0]) == list(Row.__dataclass_fields__)
    for row in rows:
        assert isinstance(row["difference_mm"], float)
        assert row["difference_mm"] < 0.1
        assert row["peak_mb"] > 20  # type: ignore[operator]
        assert row["passes"] == 2


@pytest.mark.slow
def test_a_checkpoint_is_measured_whatever_fails_beside_it(
    trained: Path, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = backends.Backend("hudepth.bench.torch_runners:absent", "broken")
    gone = backends.Backend("hudepth.bench.graphs:onnxruntime", "gone", packages=("absent",), extras="onnx")
    monkeypatch.setitem(backends.BACKENDS, "compile", broken)
    monkeypatch.setitem(backends.BACKENDS, "onnxruntime", gone)
    arguments = ("backends=[compile,onnxruntime]", "batches=1", "repeats=1", "seconds=0")
    done = command("bench", f"checkpoint={trained}", *arguments)
    assert done.code == 0, done.err
    content = json.loads((tmp_path / "bench" / "bench.json").read_text())
    model = content["model"]
    assert (model["trained"], model["size"], model["max_depth_m"]) == (True, [32, 48], 10.0)
    assert [row["contender"] for row in content["rows"]] == ["eager"]
    installed, built = content["notes"][-2:]
    assert installed == "onnxruntime: left out, since absent cannot be imported. Run pip install 'hudepth[onnx]'."
    assert built.startswith("compile: cannot be built: AttributeError")
    assert installed in " ".join(done.out.split())


@pytest.mark.parametrize(("device", "backends"), [("cpu", ON_CPU), ("cuda", ON_GPU)])
def test_what_is_measured_depends_on_the_device(
    device: str, backends: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hudepth.bench.plan.torch_device", lambda *_, **__: torch.device(device))
    with initialize_config_dir(str(conf_folder()), version_base=None):
        config = plain(compose("bench", [*TINY, f"output={tmp_path / 'bench'}"]))
    assert make_plan(config).backends == backends
    comment = (conf_folder() / "bench.yaml").read_text()
    assert f"[{', '.join(backends)}]" in comment
    assert make_plan({**config, "backends": ["bf16"]}).backends == ["eager", "bf16"]


MISTAKES = [
    (("backends=[eger]",), r"backends: .*eger.* Did you mean 'eager'\?"),
    (("batches=[0]",), r"batches: \[0\] is not"),
    (("batches=[]",), "batches: .*empty"),
    (("repeats=0",), "repeats: 0 is not"),
    (("seconds=-1",), "seconds: -1 is not"),
    (("longest_pass=0",), "longest_pass: 0 is not"),
    (("threads=0",), "threads: 0 is not"),
    (("size=[32]",), r"size: \[32\] is not"),
    (("device=tpu",), "device: 'tpu' is not"),
    (("checkpoint=last",), "checkpoint, model: both are set"),
]


@pytest.mark.parametrize(("arguments", "line"), MISTAKES)
def test_bad_options_are_one_line(arguments: tuple[str, ...], line: str, tmp_path: Path) -> None:
    words = [*TINY, f"output={tmp_path / 'bench'}", *arguments]
    with initialize_config_dir(str(conf_folder()), version_base=None):
        config = plain(compose("bench", words))
    with pytest.raises(ConfigError, match=f"^{line}"):
        make_plan(config)


@pytest.mark.parametrize(
    ("argument", "line"),
    [
        ("size=[30,32]", "multiple"),
        ("model.channels=x", ""),
        ("output=/dev/null/x", "output: cannot write to"),
        ("bakends=[eager]", "no key 'bakends'. Did you mean"),
    ],
)
def test_what_cannot_be_built_is_one_line(argument: str, line: str, command: Command) -> None:
    done = command("bench", *TINY, argument)
    assert done.code == 1
    (printed,) = done.err.splitlines()
    assert printed.startswith("hudepth-bench: ")
    assert line in printed


def test_something_must_be_measured(command: Command) -> None:
    done = command("bench")
    assert "checkpoint, model: neither is set." in done.err
    done = command("bench", "checkpoint=model.onnx")
    assert "checkpoint: exported files" in done.err


def test_help_shows_how(command: Command) -> None:
    done = command("bench", "--help")
    assert done.code == 0
    assert "hudepth-bench checkpoint=<model> | model=NAME" in done.out
    assert re.search(r"^  model +hybrid_unet", done.out, re.MULTILINE)
