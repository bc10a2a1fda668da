"""The validation pairs are scored as the training's own log says, and differences are paired."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.validation import compare
from hudepth.base.errors import ConfigError
from hudepth.runs.checkpoint import load_checkpoint
from hudepth.runs.history import read_history
from tests.commands import TINY, Command


@pytest.mark.slow
def test_checkpoints_are_compared_on_the_validation_pairs(command: Command, tmp_path: Path) -> None:
    shared = [*TINY, "test=false", "logger=none", "data.split=scene", "data.fractions=[0.3,0.5,0.2]"]
    for name, more in (("a", []), ("b", ["seed=7"]), ("c", ["data.split_seed=1"])):
        assert command("train", *shared, f"name={name}", *more).code == 0
    runs = {name: next((tmp_path / "runs" / name).iterdir()) for name in "abc"}
    checkpoints = {name: load_checkpoint(str(run)) for name, run in runs.items()}
    lines = compare({name: checkpoints[name] for name in "ab"}, protocol="paper")
    for name, line in zip("ab", lines[2:], strict=False):
        best = min(row["val/abs_rel"] for row in read_history(runs[name] / "metrics.csv"))
        assert line.startswith(f"| {name} | {best:.3f} (")
    means = [float(line.split("|")[2].split()[0]) for line in lines[2:4]]
    change = lines[3].split("|")[-3]
    assert float(change.split()[0]) == pytest.approx(means[1] - means[0], abs=2e-3)
    assert "nan to" in change.replace("+", "")  # of three scenes there are no intervals
    assert lines[-1] == "6 validation images of 3 scenes, paper protocol."
    assert command("train", *shared, "name=d", "data.size=[32,64]").code == 0
    larger = {"a": checkpoints["a"], "d": load_checkpoint(str(next((tmp_path / "runs" / "d").iterdir())))}
    with pytest.raises(ConfigError, match=r"^d: another size, at which this protocol scores, than a\."):
        compare(larger, protocol="paper")
    larger["d"].config["protocol"]["paper"]["max_depth_m"] = 0.5  # the first one's counts
    assert len(compare({"a": checkpoints["a"], "b": checkpoints["b"]}, protocol="paper")) == len(lines)
    with pytest.raises(ConfigError, match=r"^c: another split"):
        compare({name: checkpoints[name] for name in "ac"}, protocol="paper")
    further = compare({name: checkpoints[name] for name in "ab"}, protocol="paper", also=["edge_f1_0.25", "log10"])
    assert further[0] == (
        "| | abs_rel | rmse | delta1 | scale_sd | abs_rel_aligned | edge_f1_0.25 | log10 "
        "| change of edge_f1_0.25 | change of log10 | change of abs_rel | change of delta1 |"
    )
    assert {row.count("|") for row in further[:4]} == {13}
    assert [row.split("|")[-3:] for row in further[2:4]] == [row.split("|")[-3:] for row in lines[2:4]]
    with pytest.raises(ConfigError, match=r"^--also edge: paper does not measure it\.$"):
        compare({"a": checkpoints["a"]}, protocol="paper", also=["edge"])
    with pytest.raises(ConfigError, match=r"^--protocol kitti: the first checkpoint was trained with paper"):
        compare({"a": checkpoints["a"]}, protocol="kitti")
