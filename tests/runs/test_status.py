from __future__ import annotations

import json
import math
import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from hudepth.runs import status
from hudepth.runs.status import LockedError, lock_run, read_state, read_status, write_status


def test_status(tmp_path: Path) -> None:
    for state, more in (("running", {}), ("failed", {"error": "the loss is nan"}), ("finished", {"best": 0.125})):
        before = datetime.now(UTC).replace(microsecond=0)
        write_status(tmp_path, state, **more)
        status = json.loads((tmp_path / "status.json").read_text())
        time = datetime.fromisoformat(status.pop("time"))
        assert before <= time <= datetime.now(UTC)
        assert status == {"state": state, "pid": os.getpid(), **more}
    assert [file.name for file in tmp_path.iterdir()] == ["status.json"]


@pytest.mark.parametrize("best", [math.nan, math.inf, -math.inf])
def test_a_best_that_is_not_finite_is_null(tmp_path: Path, best: float) -> None:
    write_status(tmp_path, "finished", best=best)
    assert json.loads((tmp_path / "status.json").read_text())["best"] is None


def test_a_locked_run_is_running_and_a_killed_one_interrupted(tmp_path: Path) -> None:
    write_status(tmp_path, "running")
    with lock_run(tmp_path):
        assert read_state(tmp_path) == ("running", "")
        with pytest.raises(LockedError, match=r"in use .*pid \d+"):
            lock_run(tmp_path).__enter__()
    assert read_state(tmp_path) == ("interrupted", "")


@pytest.mark.parametrize("text", ["{", "[]", '{"state": "odd"}', "[" * 100_000])
def test_a_damaged_status_is_an_interrupted_run(tmp_path: Path, text: str) -> None:
    (tmp_path / "status.json").write_text(text)
    assert read_state(tmp_path) == ("interrupted", "")
    assert read_status(tmp_path).get("best") is None


def test_the_error_of_a_failed_run(tmp_path: Path) -> None:
    write_status(tmp_path, "failed", error="no memory")
    assert read_state(tmp_path) == ("failed", "no memory")
    assert [file.name for file in tmp_path.iterdir()] == ["status.json"]  # looking leaves nothing behind


def test_the_status_of_a_run_on_a_full_disk_is_written_over_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_status(tmp_path, "running", note="long enough to be longer than what follows")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(status, "write_json", full)
    write_status(tmp_path, "failed")
    assert read_status(tmp_path)["state"] == "failed"
    with pytest.raises(OSError, match="No space"):
        write_status(tmp_path / "new", "running")
