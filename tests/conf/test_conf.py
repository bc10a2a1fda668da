from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from hudepth import cli
from hudepth.base import verbs
from hudepth.sweep.jobs import Job, combine, merge_overrides
from hudepth.sweep.jobs import compose as compose_jobs

CONF = verbs.conf_folder()
FILES = sorted(CONF.rglob("*.yaml"))
SMALL = (
    "data.size=[32,48]", "data.source.scenes=6", "data.source.frames_per_scene=2", "data.source.size=[48,64]",
    "data.batch_size=2", "callbacks.panels=1", "trainer.accelerator=cpu", "trainer.max_epochs=1",
    "data.fractions=[0.6,0.2,0.2]",
)  # fmt: skip


def names(group: str) -> list[str]:
    return [path.stem for path in FILES if path.parent.name == group]


def composed(*overrides: str, task: str = "train") -> dict[str, object]:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(verbs.conf_folder()), version_base="1.3"):
        config = OmegaConf.to_container(compose(task, overrides=list(overrides)), resolve=True)
    assert isinstance(config, dict)
    return {str(key): value for key, value in config.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "group",
    [
        "data",
        "model",
        "augment",
        "loss",
        "distill",
        "auxiliary",
        "optim",
        "schedule",
        "trainer",
        "callbacks",
        "logger",
        "protocol",
    ],
)
def test_every_choice_of_every_group_composes(group: str) -> None:
    for name in set(names(group)) - {"base"}:
        assert composed(f"{group}={name}")[group]


@pytest.mark.slow
@pytest.mark.parametrize("choice", [f"{group}={name}" for group in ("experiment", "debug") for name in names(group)])
def test_every_experiment_changes_something_and_runs_a_step(
    choice: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    added = choice if choice.startswith("debug") else f"+{choice}"
    assert composed(added) != composed()
    GlobalHydra.instance().clear()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HUDEPTH_CACHE", str(tmp_path_factory.getbasetemp() / "conf_cache"))
    steps = ["trainer.limit_train_batches=1", "trainer.limit_val_batches=1"]
    weights = ["model.weights=none"] if choice.startswith("experiment=") else []
    size = ["data.size=[64,64]"] if choice == "experiment=lite" else []
    sys_argv = ["hudepth-train", choice, *SMALL, *size, *steps, *weights, "test=false"]
    monkeypatch.setattr(sys, "argv", sys_argv)
    assert cli.train() == 0
    assert list(tmp_path.glob("runs/*/*/status.json"))


@pytest.mark.slow
@pytest.mark.parametrize("model", names("model"))
def test_every_model_trains_a_step_and_is_tested(
    model: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    GlobalHydra.instance().clear()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HUDEPTH_CACHE", str(tmp_path_factory.getbasetemp() / "conf_cache"))
    steps = ["trainer.limit_train_batches=1", "trainer.limit_val_batches=1"]
    # 64: a multiple of what each model asks for, and more than one position of the deepest map for its batch norm
    monkeypatch.setattr(sys, "argv", ["hudepth-train", f"model={model}", *SMALL, "data.size=[64,64]", *steps])
    assert cli.train() == 0
    assert list(tmp_path.glob("runs/*/*/test/eigen/metrics.json"))


def jobs_of(name: str, *typed: str) -> list[Job]:
    """The jobs of a sweep's file, composed."""
    sweeper = yaml.safe_load((CONF / "sweep" / f"{name}.yaml").read_text())["hydra"]["sweeper"]
    parser = OverridesParser.create()
    params = parser.parse_overrides([f"{key}={values}" for key, values in sweeper.get("params", {}).items()])
    jobs = combine(merge_overrides(parser.parse_overrides(list(typed)), params), sweeper.get("variants", {}))
    return compose_jobs(jobs, lambda overrides: composed(f"+sweep={name}", *overrides), str)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("loss_terms", 33),
        ("badcl_reading", 21),
        ("attention", 18),
        ("architecture", 9),
        ("seeds", 5),
        ("lambda_grid", 27),
        ("recipe", 26),
    ],
)
def test_the_jobs_of_every_sweep_compose_and_differ(name: str, count: int) -> None:
    jobs = jobs_of(name, *(["init=pretrained"] if name == "recipe" else []))
    assert [job.error for job in jobs] == [""] * count
    assert len({job.folder for job in jobs}) == count
    text = (CONF / "sweep" / f"{name}.yaml").read_text()
    assert f"{count} runs" in text


@pytest.mark.slow
def test_examples_name_the_nyu_that_can_be_downloaded() -> None:
    told = [path.stem for path in FILES if re.search(r"^#.* data=nyu_labeled\b", path.read_text(), re.MULTILINE)]
    assert told == ["nyu_labeled"]


def test_the_recipe_without_pretraining_is_the_recipe_where_there_is_none() -> None:
    labels = [job.labels["variant"] for job in jobs_of("recipe", "seed=1")]
    assert len(labels) == 12
    assert "no_pretraining" not in labels


@pytest.mark.slow
def test_the_subsets_of_badcls_terms_are_all_seven() -> None:
    weights = [job.config["loss"] for job in jobs_of("loss_terms", "seed=1") if job.config]
    subsets = {
        tuple(bool(loss[term]) for term in ("boundary", "smoothness", "scaling"))
        for loss in weights
        if "boundary" in loss
    }
    assert len(subsets) == 7
    assert len(weights) == 7 + 4


def test_a_reading_of_badcl_changes_one_choice_at_a_time() -> None:
    losses = [job.config["loss"] for job in jobs_of("badcl_reading", "seed=1") if job.config]
    paper = losses[0]
    assert [sum(loss[key] != paper[key] for key in paper) for loss in losses] == [0, 1, 1, 1, 1, 1, 1]


@pytest.mark.slow
@pytest.mark.parametrize("name", names("sweep"))
def test_every_sweep_runs(
    name: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    more = {
        "recipe": ["seed=1", "model.weights=none"],
        "attention": ["seed=1"], "architecture": ["seed=1", "data.size=[64,64]"], "seeds": ["seed=1,2", "model=tiny"],
        "lambda_grid": ["loss.boundary=3.0", "loss.smoothness=0.6,1.2", "loss.scaling=1", "model=tiny"],
        "lambda_search": ["hydra.sweeper.search.trials=2", "model=tiny"],
    }.get(name, ["seed=1", "model=tiny"])  # fmt: skip
    GlobalHydra.instance().clear()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HUDEPTH_CACHE", str(tmp_path_factory.getbasetemp() / "conf_cache"))
    steps = ["trainer.limit_train_batches=1", "trainer.limit_val_batches=1", "test=false", "logger=none"]
    monkeypatch.setattr(sys, "argv", ["hudepth-train", f"+sweep={name}", *SMALL, *steps, *more])
    assert cli.train() == 0
    states = [yaml.safe_load(file.read_text())["state"] for file in tmp_path.glob("sweeps/*/*/*/status.json")]
    assert len(states) >= 2
    assert set(states) == {"finished"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(CONF)))
def test_every_file_opens_with_a_comment_and_experiments_with_their_command(path: Path) -> None:
    text = path.read_text()
    assert text.startswith("#")
    if path.parent.name in ("experiment", "sweep", "debug"):
        assert text.startswith("# @package _global_\n")
        command = re.search(r"^#   hudepth-train (.*)$", text, re.MULTILINE)
        assert command, "says the command that runs it"
        assert f"{path.parent.name}={path.stem}" in command[1]


@pytest.mark.parametrize("task", ["train", "test", "data"])
def test_every_task_composes(task: str) -> None:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(verbs.conf_folder()), version_base="1.3"):
        assert compose(task)
