from __future__ import annotations

import re
import subprocess
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import optuna
import pytest
import torch
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from lightning.pytorch import LightningModule, Trainer
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import TrialState

from hudepth.base.errors import ConfigError, Pruned
from hudepth.base.options import parse
from hudepth.base.verbs import conf_folder
from hudepth.sweep.search import SearchOptions, distribution
from hudepth.training.study import TrialPruner, open_study
from tests.commands import Command, script

from .test_kill import start, wait_for
from .test_sweeper import FAST, runs, states

OPTIONS = yaml.safe_load((conf_folder() / "hydra/sweeper/hudepth.yaml").read_text())["search"]
SPACE = "loss.boundary=tag(log,interval(0.3,30))"


def override(text: str) -> Any:
    return OverridesParser.create().parse_override(text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x=interval(0.5,2)", FloatDistribution(0.5, 2.0)),
        ("x=tag(log,interval(0.1,10))", FloatDistribution(0.1, 10.0, log=True)),
        ("x=range(1,5)", IntDistribution(1, 4)),
        ("x=range(1,10,3)", IntDistribution(1, 7, step=3)),
        ("x=range(0.0,1.0,0.25)", FloatDistribution(0.0, 0.75, step=0.25)),
        ("x=choice(a,b)", CategoricalDistribution(["a", "b"])),
        ("x=1,2", CategoricalDistribution(["1", "2"])),
    ],
)
def test_what_hydra_writes_is_what_optuna_draws_from(text: str, expected: Any) -> None:
    assert distribution(override(text)) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x=glob(a*)", "'x=glob(a*)': pass interval(low,high), range(first,end,step) or choice(a,b)."),
        ("x=tag(log,interval(0,1))", "'x=tag(log,interval(0,1))': `low > 0` must hold for `log=True`"),
    ],
)
def test_what_cannot_be_drawn_from(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        distribution(override(text))
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("options", "key", "word"),
    [
        ({"trial": 3}, "trial", "'trials'"),
        ({"trials": 0}, "trials", "at least 1"),
        ({"sampler": "grid"}, "sampler", "tpe"),
    ],
)
def test_options_are_checked(options: dict[str, Any], key: str, word: str) -> None:
    with pytest.raises(ConfigError, match=rf"^hydra\.sweeper\.search\.{key}: .*{word}"):
        parse(SearchOptions, {**OPTIONS, **options}, prefix="hydra.sweeper.search.", strict=True)


def test_the_defaults_are_those_of_the_configuration() -> None:
    assert asdict(SearchOptions()) == OPTIONS


def ended(epoch: int, value: float) -> Any:
    """As much of a Trainer as a callback that ends an epoch looks at."""
    trainer = create_autospec(Trainer, instance=True)
    trainer.is_global_zero, trainer.check_val_every_n_epoch, trainer.current_epoch = True, 1, epoch
    trainer.callback_metrics = {"val/abs_rel": torch.tensor(value)}
    return trainer


def test_a_trial_worse_than_the_median_of_the_others_is_ended(tmp_path: Path) -> None:
    file = str(tmp_path / "study.log")
    module = create_autospec(LightningModule, instance=True)
    study = open_study(file, {**OPTIONS, "startup_trials": 2, "warmup_epochs": 0})
    for value in (0.2, 0.3):
        trial = study.ask()
        trial.report(value, 1)
        study.tell(trial, value)
    good, bad = (TrialPruner(f"{study.ask().number}:{file}", monitor="val/abs_rel") for _ in range(2))
    good.on_train_epoch_end(ended(0, 0.21), module)
    with pytest.raises(
        Pruned, match=r"^pruned after epoch 1: val/abs_rel 0\.9000 is worse than in other trials$"
    ) as caught:
        bad.on_train_epoch_end(ended(0, 0.9), module)
    assert caught.value.value == pytest.approx(0.9)


def searched(command: Command, *arguments: str) -> Any:
    options = (
        "hydra.sweeper.search.startup_trials=1",
        "hydra.sweeper.search.warmup_epochs=0",
        "sweep_dir=s",
        "test=false",
    )
    return command("train", "-m", *FAST, *options, *arguments)


def trials(folder: Path) -> list[optuna.trial.FrozenTrial]:
    return open_study(str(folder / "study.log")).trials


@pytest.mark.slow
def test_a_search_ends_with_its_best_trials_and_can_be_given_more(command: Command, tmp_path: Path) -> None:
    arguments = (SPACE, "optim.lr=choice(1e-3,1e-30)", "trainer.max_epochs=3")
    done = searched(command, *arguments, "hydra.sweeper.search.trials=4")
    assert done.code == 0, done.err
    assert re.search(r"^search: \d trials finished, \d pruned, 0 failed; in ", done.err, re.MULTILINE)
    assert re.search(
        r"^  1\. val/abs_rel 0\.\d{4}: loss\.boundary=[\d.]+ optim\.lr=[\de.-]+ \(trial \d\)$", done.err, re.MULTILINE
    )
    first = trials(tmp_path / "s")
    assert len(first) == 4
    assert {trial.state for trial in first} <= {TrialState.COMPLETE, TrialState.PRUNED}
    stood = list(states(tmp_path / "s").values())
    assert stood.count("pruned") == sum(trial.state == TrialState.PRUNED for trial in first)
    assert searched(command, *arguments, "hydra.sweeper.search.trials=5").code == 0
    again = trials(tmp_path / "s")
    assert [trial.params for trial in again[:4]] == [trial.params for trial in first]
    assert len(again) == 5
    assert len({str(trial.params) for trial in again}) > 2  # it does not draw the same again


@pytest.mark.slow
def test_a_trial_that_fails_is_told_and_the_search_goes_on(command: Command, tmp_path: Path) -> None:
    done = searched(
        command, "optim.lr=choice(-1,1e-3)", "hydra.sweeper.search.trials=6", "hydra.sweeper.search.sampler=random"
    )
    assert done.code == 0, done.err
    states_ = [trial.state for trial in trials(tmp_path / "s")]
    assert set(states_) >= {TrialState.COMPLETE, TrialState.FAIL}
    assert f"{states_.count(TrialState.FAIL)} failed; in " in done.err


@pytest.mark.slow
def test_mistakes_in_a_search_give_one_line(command: Command, tmp_path: Path) -> None:
    trials = "hydra.sweeper.search.trials=1"
    cases = {
        ("loss=l1", trials): "search: nothing to search over. Give a key a range, as in ",
        (SPACE, trials, "+hydra.sweeper.search.trails=2"): "hydra.sweeper.search.trails: no such option.",
        ("optim.lr=choice(-1,-2)", trials): "search: none of 1 trials finished. See ",
    }  # fmt: skip
    for number, (arguments, message) in enumerate(cases.items()):
        done = searched(command, *arguments, f"sweep_dir=s{number}")
        assert done.code == 1
        assert done.err.splitlines()[-1].startswith(f"hudepth-train: {message}"), done.err
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "study.log").write_text("no study\n")
    done = searched(command, SPACE, "hydra.sweeper.search.trials=1", "sweep_dir=odd")
    assert re.search(r"hudepth-train: search: '.*/odd/study\.log' cannot be resumed", done.err)
    assert (tmp_path / "odd" / "study.log").read_text() == "no study\n"


@pytest.mark.slow
def test_a_search_that_is_killed_goes_on_with_the_trial_it_was_at(tmp_path: Path, cache: Path) -> None:
    arguments = (
        "-m",
        *FAST,
        SPACE,
        "sweep_dir=s",
        "test=false",
        "hydra.sweeper.search.trials=2",
        "trainer.max_epochs=60",
    )
    process = start(tmp_path, cache, *arguments)
    wait_for(lambda: list(tmp_path.glob("s/*/metrics.csv")))
    process.kill()
    process.wait()
    (killed,) = trials(tmp_path / "s")
    assert killed.state == TrialState.RUNNING
    done = subprocess.run(**script("train", *arguments, cwd=tmp_path, cache=cache), check=False)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stdout
    first, second = trials(tmp_path / "s")
    assert first.params == killed.params
    assert (first.state, second.state) == (TrialState.COMPLETE, TrialState.COMPLETE)
    assert len(runs(tmp_path / "s")) == 2
