"""Averages of checkpoints: the mean of each tensor, and no worse on validation than the best of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from experiments.soup import average, greedy, make_soup
from hudepth.base.errors import ConfigError
from hudepth.evaluation.lineage import lineage
from hudepth.runs.checkpoint import KEY, load_checkpoint, read_plain
from tests.commands import TINY, Command


def test_the_average_is_the_mean_of_each_tensor() -> None:
    states = [{"w": torch.tensor([value, 2.0]), "count": torch.tensor(int(value))} for value in (1.0, 3.0, 8.0)]
    mean = average(states)
    torch.testing.assert_close(mean["w"], torch.tensor([4.0, 2.0]))
    assert mean["count"].item() == 1
    assert mean["w"].dtype == torch.float32


def test_a_soup_takes_what_helps_from_good_to_bad() -> None:
    """Distance from 0: with 1 and -2 it is nearer than with 1 alone, and neither 1.5 nor 5 is worth adding."""
    values = {"a": -2.0, "b": 1.0, "c": 5.0, "d": 1.5}
    states = {name: {"w": torch.tensor(value)} for name, value in values.items()}
    distances = {name: abs(value) for name, value in values.items()}
    assert greedy(states, distances, lambda state: abs(float(state["w"]))) == ["b", "a"]
    assert greedy({"a": states["a"]}, {"a": 2.0}, lambda _: 0.0) == ["a"]


@pytest.mark.slow
def test_the_soup_is_no_worse_on_validation_and_can_be_tested(command: Command, tmp_path: Path) -> None:
    shared = [*TINY, "test=false", "logger=none", "data.split=scene", "data.fractions=[0.3,0.5,0.2]"]
    for name in "abc":
        more = [] if name == "a" else [f"init={next((tmp_path / 'runs' / 'a').iterdir())}"]
        assert command("train", *shared, f"name={name}", f"seed={ord(name)}", *more).code == 0
    runs = [str(next((tmp_path / "runs" / name).iterdir())) for name in "abc"]
    lines = make_soup(tmp_path / "soup.ckpt", runs, protocol="paper", metric="abs_rel")
    scores = [float(line.split()[1]) for line in lines]
    assert scores[-1] <= min(scores[:-1])
    soup = load_checkpoint(str(tmp_path / "soup.ckpt"))
    made_of = read_plain(tmp_path / "soup.ckpt")[KEY]["soup"]
    expected = average([load_checkpoint(path).state for path in made_of])
    assert all(torch.equal(soup.state[name], tensor) for name, tensor in expected.items())
    assert command("test", f"checkpoint={tmp_path / 'soup.ckpt'}", "protocol=paper").code == 0
    past = [each["split"]["sha256"] for path in made_of for each in lineage(load_checkpoint(path))]
    assert [each["split"]["sha256"] for each in lineage(soup)] == past
    with pytest.raises(ConfigError, match=r"^'.*/nyu' is of another network than '.*'\."):
        make_soup(tmp_path / "other.ckpt", [runs[0], "nyu"], protocol="paper", metric="abs_rel")
    with pytest.raises(ConfigError, match=r"^'.*/nyu' is a bundle\."):
        make_soup(tmp_path / "other.ckpt", ["nyu"], protocol="paper", metric="abs_rel")
    with pytest.raises(ConfigError, match=r"^no folder '.*nowhere' to write"):
        make_soup(tmp_path / "nowhere/soup.ckpt", runs, protocol="paper", metric="abs_rel")
