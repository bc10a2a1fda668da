from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.ledger.runs import find_runs, flat, pairs, read_run, same_but
from hudepth.base.errors import ConfigError

MakeRun = Callable[..., Path]


def test_nested_keys_become_dotted() -> None:
    assert dict(flat({"a": {"b": {"c": 1}, "d": [2]}, "e": None})) == {"a.b.c": 1, "a.d": [2], "e": None}


def test_a_run_is_read(make_run: MakeRun) -> None:
    history = [{"epoch": 1, "val/ssim": 0.5}, {"epoch": 2, "val/ssim": 0.6}]
    path = make_run("one", tests={"eigen": {"abs_rel": 0.2}}, intervals={"abs_rel": [0.19, 0.21]}, history=history)
    run = read_run(path)
    assert run.problems == []
    assert (run.name, run.split, run.loss, run.misread) == ("badcl (one)", "official", "BADCL", False)
    assert (run.tested_source("eigen"), run.tested_split("eigen"), run.training_images) == (
        "nyu_labeled",
        "official",
        698,
    )
    assert (run.metric("eigen", "abs_rel"), run.interval("eigen", "abs_rel")) == (0.2, (0.19, 0.21))
    assert run.metric("eigen", "rmse") is run.metric("paper", "abs_rel") is run.interval("eigen", "rmse") is None
    assert (run.last_epoch, run.at_epoch(2, "val/ssim"), run.at_epoch(3, "val/ssim")) == (2, 0.6, None)


def test_runs_are_found_below_a_folder_once(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("runs/a/1"), make_run("runs/b/2")
    found = find_runs([tmp_path / "runs", tmp_path / "runs" / "a" / "1"])
    assert [run.path.name for run in found] == ["1", "2"]


def test_folders_without_a_run_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        find_runs([tmp_path / "none"])
    assert str(error.value) == (
        f"runs: no folder '{tmp_path}/none'. Pass run directories, as --runs experiments/badcl_official."
    )
    with pytest.raises(ConfigError) as error:
        find_runs([tmp_path])
    assert (
        str(error.value)
        == f"runs: '{tmp_path}' is not a run and contains none: there is no config.yaml at or below it."
    )


def test_what_is_missing_or_damaged_is_said_and_the_rest_kept(make_run: MakeRun) -> None:
    path = make_run("one", tests={"eigen": {"abs_rel": 0.2}, "paper": {"abs_rel": 0.3}})
    (path / "test" / "paper" / "metrics.json").write_text("{")
    (path / "metrics.csv").unlink()
    run = read_run(path)
    assert list(run.tests) == ["eigen"]
    assert len(run.problems) == 2
    assert run.problems[0].startswith(f"'{path}/metrics.csv' cannot be read as a history of epochs")
    assert run.problems[1].startswith(f"'{path}/test/paper/metrics.json' cannot be read (")


def test_a_run_without_results_says_what_to_run(make_run: MakeRun) -> None:
    path = make_run("one")
    assert read_run(path).problems == [
        f"'{path}' holds no readable test result. Run hudepth-test checkpoint={path} first."
    ]


def test_a_damaged_configuration_matches_nothing(make_run: MakeRun) -> None:
    a, b = make_run("a"), make_run("b")
    for path in (a, b):
        (path / "config.yaml").write_text("- 1\n")
    run = read_run(a)
    assert run.problems[0].startswith(f"'{a}' is not a run directory: its config.yaml")
    assert not same_but(run, read_run(b))


@pytest.mark.parametrize("value", ["0.2", True, None, float("nan")])
def test_what_is_no_number_is_no_metric(make_run: MakeRun, value: object) -> None:
    run = read_run(make_run("one", tests={"eigen": {"abs_rel": value}}, intervals={"abs_rel": [0.1]}))
    assert run.metric("eigen", "abs_rel") is None
    assert run.interval("eigen", "abs_rel") is None


def test_places_and_length_do_not_make_another_recipe(make_run: MakeRun) -> None:
    a = read_run(make_run("a"))
    b = read_run(make_run("b", config={"data.root": "b", "trainer.max_epochs": 99, "model.weights": "/some/file.pth"}))
    assert same_but(a, b)


@pytest.mark.parametrize(("key", "value"), [("seed", 1), ("loss.boundary", 1.0), ("model.weights", "none")])
def test_recipes_are_told_apart(make_run: MakeRun, key: str, value: object) -> None:
    a, b = read_run(make_run("a")), read_run(make_run("b", config={key: value}))
    assert not same_but(a, b)
    assert same_but(a, b, key) is (key != "model.weights")


def test_pairs_differ_in_the_first_key(make_run: MakeRun) -> None:
    a = read_run(make_run("a"))
    b = read_run(make_run("b", config={"data.split": "random", "data.split_seed": 7}))
    c = read_run(make_run("c", config={"data.split": "random", "seed": 1}))
    assert pairs([a, b, c], "data.split", "data.split_seed") == [(a, b)]
    assert pairs([a, b, c], "data.split") == []


@pytest.mark.parametrize(
    "damage",
    [
        {"checkpoint": {"trained_on": "x"}},
        {"checkpoint": {"trained_on": {"split": [1]}}},
        {"checkpoint": {"trained_on": {"split": {"counts": 3}}}},
        {"intervals": {"model": "x"}},
        {"intervals": {"model": None}},
    ],
)
def test_parts_of_another_shape_count_as_missing(make_run: MakeRun, damage: dict[str, object]) -> None:
    path = make_run("one", tests={"eigen": {"abs_rel": 0.2}})
    file = path / "test" / "eigen" / "metrics.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "split": {}, **damage}))
    run = read_run(path)
    assert run.training_images is run.interval("eigen", "abs_rel") is None
    assert run.metric("eigen", "abs_rel") == 0.2
