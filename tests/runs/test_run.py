from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from hudepth.base.errors import CheckpointError, DataError
from hudepth.runs.run import Run, find_run, read_config
from hudepth.runs.status import write_status

CONFIG = {"seed": 1, "data": {"split": "scene"}, "model": {}, "loss": {}}


def test_a_run_is_read(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    (tmp_path / "metrics.csv").write_text("epoch,val/abs_rel\n1,0.5\n")
    (tmp_path / "checkpoints").mkdir()
    write_status(tmp_path, "finished", best=0.5)
    run = Run.read(tmp_path, labels={"variant": "a"})
    assert (run.state, run.error, run.split, run.labels, run.checkpoint) == (
        "finished", "", "scene", {"variant": "a"}, None
    )  # fmt: skip
    assert run.history() == [{"epoch": 1, "val/abs_rel": 0.5}]
    for name in ("last.ckpt", "best.ckpt"):
        (tmp_path / "checkpoints" / name).touch()
        assert run.checkpoint == tmp_path / "checkpoints" / name
    with pytest.raises(DataError, match="eigen"):
        run.result("eigen")


def test_a_folder_with_another_config_is_not_a_run(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("a: 1")
    with pytest.raises(CheckpointError, match="'seed'"):
        Run.read(tmp_path)


@pytest.mark.parametrize(("content", "why"), [(None, "No such file"), (b"- 1\n", "mapping"), (b"", "mapping")])
def test_no_run_directory(tmp_path: Path, content: bytes | None, why: str) -> None:
    if content is not None:
        (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(CheckpointError, match=rf"^'{tmp_path}' is not a run directory: .*{why}"):
        read_config(tmp_path)


@pytest.mark.parametrize(
    "content", [b"a: [1, 2\nb: 3\n", b"\xff\xfe\x00\x81", b"a: !!python/object/apply:os.getpid []\n"]
)
def test_damaged_config_is_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        read_config(tmp_path)
    assert str(caught.value).startswith(f"'{tmp_path}' is not a run directory: its config.yaml")
    assert "\n" not in str(caught.value)


def test_code_in_a_config_is_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    (tmp_path / "config.yaml").write_text(f"a: !!python/object/apply:os.system ['touch {marker}']\n")
    with pytest.raises(CheckpointError, match="could not determine a constructor"):
        read_config(tmp_path)
    assert not marker.exists()


def test_the_run_of_a_checkpoint(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    assert find_run(run / "checkpoints" / "best.ckpt") is None  # no config.yaml: not one of ours
    (run / "config.yaml").touch()
    assert find_run(run / "checkpoints" / "best.ckpt") == run
    assert find_run(run / "elsewhere" / "best.ckpt") is None
    assert find_run(run / "best.ckpt") is None
