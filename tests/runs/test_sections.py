from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hudepth.base.errors import CheckpointError
from hudepth.runs.sections import check_config, check_resumable

CONFIG: dict[str, Any] = {"seed": 1, "model": {}, "data": {"size": [32, 48], "source": {}}, "loss": {}, "trainer": {}}
LAST: dict[str, Any] = {
    "epoch": 1, "global_step": 8, "state_dict": {}, "callbacks": {}, "optimizer_states": [{}], "lr_schedulers": [],
    "loops": {"fit_loop": {"epoch_loop.batch_progress": {"total": {"ready": 8}, "is_last_batch": True}}},
}  # fmt: skip


@pytest.mark.parametrize(
    ("key", "value"),
    [("seed", -1), ("seed", "x"), ("trainer", None), ("model", [1]), ("data", 3), ("loss", "l1"), ("monitor", {}),
     ("data", {"size": True}), ("data", {"size": [0, 1]}), ("data", {"size": [8192, 8192]}),
     ("data", {"source": None}), ("callbacks", "x"),
     ("callbacks", {"extra": "x"}), ("logger", {"extra": [3]}), ("loss", None), ("optim", None)],
)  # fmt: skip
def test_a_part_of_another_type(key: str, value: Any) -> None:
    check_config(CONFIG, where=Path("config.yaml"))
    with pytest.raises(CheckpointError, match=rf"config\.yaml.*{key}"):
        check_config({**CONFIG, key: value}, where=Path("config.yaml"))


@pytest.mark.parametrize(
    ("key", "value"),
    [("epoch", -1), ("global_step", None), ("state_dict", 1), ("optimizer_states", [1]), ("optimizer_states", None),
     ("loops", {"fit_loop": {"total": "x"}}), ("loops", {"fit_loop": {"total": -5}}), ("lr_schedulers", [3])],
)  # fmt: skip
def test_a_checkpoint_that_cannot_be_resumed_from(key: str, value: Any) -> None:
    check_resumable(LAST, where=Path("last.ckpt"))
    with pytest.raises(CheckpointError, match=rf"last\.ckpt.*{key}"):
        check_resumable({**LAST, key: value}, where=Path("last.ckpt"))
