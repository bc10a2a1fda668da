"""Services that are missing, unreachable, or go away; runs that continue, and jobs of sweeps."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml

from hudepth.base.errors import ConfigError
from hudepth.training.loggers import kinds
from hudepth.training.loggers.run import open_loggers
from tests.commands import TINY, Command
from tests.training.loggers.readers import read_comet, read_csv, read_mlflow, read_tensorboard, read_wandb
from tests.training.loggers.servers import mlflow_of_a_faster_job, mlflow_until_metrics, serving, wandb_until_values
from tests.training.loggers.test_run import OFFLINE, ids, train

QUICK = (*TINY, "test=false", "trainer.log_every_n_steps=2")


def last_line(text: str) -> str:
    return text.splitlines()[-1].removeprefix("hudepth-train: ")


@pytest.mark.parametrize("kind", ["wandb", "mlflow", "comet"])
def test_a_package_that_is_missing(kind: str, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    find = kinds.importlib.util.find_spec
    monkeypatch.setattr(
        kinds.importlib.util, "find_spec", lambda name: None if name in ("wandb", "mlflow", "comet_ml") else find(name)
    )
    done = command("train", *QUICK, f"logger=[tensorboard,{kind}]")
    assert done.code == 1
    assert last_line(done.err) == (f"logger={kind}: its package is not installed. Run pip install 'hudepth[{kind}]'.")
    assert not Path("runs").exists()


@pytest.mark.slow
def test_nothing_is_imported_that_was_not_chosen(tmp_path: Path, cache: Path) -> None:
    code = "import sys; from hudepth import cli; assert cli.train() == 0; print(*sorted(sys.modules))"
    words = [sys.executable, "-c", code, *QUICK, "logger=[tensorboard,csv]"]
    environment = {**os.environ, "HUDEPTH_CACHE": str(cache)}
    done = subprocess.run(words, cwd=tmp_path, env=environment, text=True, capture_output=True, check=True)
    imported = set(done.stdout.splitlines()[-1].split())
    assert "lightning.pytorch.loggers.wandb" in imported
    assert not {"wandb", "mlflow", "comet_ml"} & imported


@pytest.mark.parametrize("choice", ["wandbb", "[csv,wandbb]"])
def test_an_unknown_logger(choice: str, command: Command) -> None:
    done = command("train", *QUICK, f"logger={choice}")
    assert last_line(done.err).startswith("logger: no 'wandbb'. Did you mean 'wandb'? Pass one of comet, csv, mlflow,")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name"), [("wandb", "Weights & Biases"), ("comet", "Comet")])
def test_no_key_ends_the_run_at_its_start(kind: str, name: str, tmp_path: Path, cache: Path) -> None:
    out = train(*QUICK, f"logger={kind}", folder=tmp_path, cache=cache, code=1)
    fix = f"Run {kind} login, or pass logger.{kind}.offline=true."
    assert last_line(out) == f"logger={kind}: there is no key for {name}. {fix}"
    assert len(out.splitlines()) == 2  # the other one names the run directory


@pytest.mark.slow
def test_a_wandb_server_that_does_not_answer(tmp_path: Path, cache: Path) -> None:
    place = {"WANDB_BASE_URL": "http://127.0.0.1:1", "WANDB_API_KEY": "a" * 40}
    out = train(*QUICK, "logger=wandb", folder=tmp_path, cache=cache, code=1, **place)
    assert last_line(out).startswith("logger=wandb: it cannot be opened (Failed to authenticate with http://127.0.0.1")
    assert last_line(out).endswith("Pass logger.wandb.offline=true to write to the run directory alone.")
    assert len(out.splitlines()) == 2


def test_an_mlflow_server_that_does_not_answer(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://me:secret@127.0.0.1:1")
    done = command("train", *QUICK, "logger=mlflow")
    assert done.code == 1
    assert last_line(done.err) == (
        "logger=mlflow: no server answers at 'http://127.0.0.1:1'. Start the server, or pass "
        "logger.mlflow.tracking_uri=<another>."
    )
    (run,) = Path("runs/default").iterdir()
    assert not any("secret" in path.read_text() for path in run.rglob("*") if path.is_file())


def test_an_mlflow_server_that_goes_away_is_dropped(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    with serving(mlflow_until_metrics) as address:
        uri = address.replace("//", "//me:secret@")
        done = command("train", *QUICK, "logger=[mlflow,csv]", f"logger.mlflow.tracking_uri={uri}")
    assert done.code == 0, done.err
    assert f"mlflow: {address}/#/experiments/7, run abc" in done.err
    (warning,) = [line for line in done.err.splitlines() if "dropped" in line]
    assert warning.startswith("MLFlowLogger failed and is dropped (API request to http://127.0.0.1")
    assert warning.endswith("the training goes on without it")
    assert "secret" not in done.err
    assert "Retrying" not in done.err + done.out
    (run,) = Path("runs/default").iterdir()
    assert json.loads((run / "status.json").read_text())["state"] == "finished"
    assert sorted(read_csv(run).curves["train/loss/total_step"]) == [2, 4, 6, 8]


@pytest.mark.slow
def test_a_wandb_server_that_goes_away_leaves_the_rest_on_disk(tmp_path: Path, cache: Path) -> None:
    with serving(wandb_until_values) as address:
        place = {"WANDB_BASE_URL": address, "WANDB_API_KEY": "a" * 40, "WANDB_FINISH_TIMEOUT": "3"}
        out = train(*QUICK, "logger=wandb", folder=tmp_path, cache=cache, **place)
    (run,) = (tmp_path / "runs" / "default").iterdir()
    (rest,) = (run / "wandb").glob("run-*")
    assert list(rest.glob("*.wandb"))
    assert f"wandb: {address}/me/hudepth/runs/{ids(run)['wandb']}" in out.splitlines()
    assert last_line(out).startswith("wandb: not all was uploaded (")
    assert last_line(out).endswith(f"Run wandb sync {rest}")
    assert len([line for line in out.splitlines() if line.startswith("wandb")]) == 2


@pytest.mark.slow
def test_a_resumed_run_continues_where_the_services_have_it(tmp_path: Path, cache: Path) -> None:
    loggers = "logger=[tensorboard,csv,wandb,mlflow,comet]"
    train(*QUICK, *OFFLINE, loggers, "trainer.max_epochs=1", "name=a/b", folder=tmp_path, cache=cache)
    (run,) = (tmp_path / "runs" / "a" / "b").iterdir()
    before, elsewhere = ids(run), tmp_path / "elsewhere"
    elsewhere.mkdir()
    train(f"resume={run}", "trainer.max_epochs=2", folder=elsewhere, cache=cache)
    assert ids(run) == before
    uri = f"sqlite:///{tmp_path}/runs/mlflow.db"
    assert read_wandb(run).about["runs"] == [before["wandb"]] * 2
    assert read_comet(run).about["offline_id"] == before["comet"]
    mlflow = read_mlflow(uri, before["mlflow"])
    assert mlflow.about["status"] == "FINISHED"
    assert mlflow.parameters["trainer.max_epochs"] == "1"  # MLflow keeps what a run began with
    for found in (read_tensorboard(run), read_csv(run), read_wandb(run), mlflow, read_comet(run)):
        assert sorted(found.curves["train/loss/total_step"]) == [2, 4, 6, 8]
        assert len(found.curves["val/abs_rel"]) == 2


@pytest.mark.slow
def test_a_run_of_an_earlier_version_resumes(trained: Path, command: Command) -> None:
    config = yaml.safe_load((trained / "config.yaml").read_text())
    del config["trainer"]["log_every_n_steps"]
    old = {**config, "logger": {"tensorboard": True, "extra": []}}
    (trained / "config.yaml").write_text(yaml.safe_dump(old))
    done = command("train", f"resume={trained}", "trainer.max_epochs=3")
    assert done.code == 0, done.err
    assert len(read_tensorboard(trained).curves["val/abs_rel"]) == 3


@pytest.mark.slow
def test_jobs_of_a_sweep_are_runs_of_their_own(tmp_path: Path, cache: Path) -> None:
    """Three in two processes: two make MLflow's data base at once, and the third is not taken for the one before it."""
    train(
        "-m", *QUICK, *OFFLINE, "logger=[wandb,mlflow,comet]", "seed=1,2,3", "name=pair", "trainer.max_epochs=1",
        "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", folder=tmp_path, cache=cache,
    )  # fmt: skip
    (sweep,) = (tmp_path / "sweeps" / "pair").iterdir()
    jobs = [path for path in sweep.iterdir() if path.is_dir()]
    assert len({ids(job)[kind] for job in jobs for kind in ("wandb", "mlflow", "comet")}) == 9
    for job in jobs:
        wandb, comet = read_wandb(job), read_comet(job)
        mlflow = read_mlflow(f"sqlite:///{tmp_path}/runs/mlflow.db", ids(job)["mlflow"])
        assert (wandb.about["group"], wandb.about["name"]) == (f"pair/{sweep.name}", job.name)
        assert (mlflow.about["sweep"], mlflow.about["mlflow.runName"]) == (f"pair/{sweep.name}", job.name)
        assert comet.about["tags"] == [f"pair/{sweep.name}"]
        seed = yaml.safe_load((job / "config.yaml").read_text())["seed"]
        assert wandb.parameters["seed"] == int(mlflow.parameters["seed"]) == seed


@pytest.mark.slow
def test_of_two_processes_the_first_logs(tmp_path: Path, cache: Path) -> None:
    two = ("trainer.devices=2", "trainer.strategy=ddp", "data.fractions=[0.6,0.2,0.2]")
    loggers = "logger=[tensorboard,csv,wandb,mlflow,comet]"
    train(*QUICK, *OFFLINE, *two, loggers, folder=tmp_path, cache=cache)
    (run,) = (tmp_path / "runs" / "default").iterdir()
    assert len(list((run / "tensorboard").glob("events*"))) == 1
    assert len(list((run / "wandb").glob("offline-run-*"))) == len(list(run.glob("*.zip"))) == 1
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{tmp_path}/runs/mlflow.db")
    (only,) = client.search_runs([each.experiment_id for each in client.search_experiments()])
    assert only.info.run_id == ids(run)["mlflow"]
    for found in (read_tensorboard(run), read_csv(run), read_wandb(run), read_comet(run)):
        assert found.curves["train/loss/total_step"]


def configuration(folder: Path) -> dict[str, Any]:
    where = {"runs": str(folder), "sweeps": str(folder / "sweeps")}
    return {"name": "a", "monitor": "val/abs_rel", "logger": {}, "trust": [], "paths": where, "optim": {"lr": 0.5}}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of runs, with a data base that takes seconds to make."""
    return tmp_path_factory.mktemp("runs")


@pytest.fixture
def run(runs: Path, tmp_path: Path) -> Path:
    run = runs / "a" / tmp_path.name
    run.mkdir(parents=True)
    return run


@pytest.mark.parametrize(
    ("error", "status"), [(None, "FINISHED"), (KeyboardInterrupt, "KILLED"), (ValueError, "FAILED")]
)
def test_mlflow_knows_how_a_run_ended(error: type[BaseException] | None, status: str, runs: Path, run: Path) -> None:
    with (
        suppress(KeyboardInterrupt, ValueError),
        open_loggers({"mlflow": {}}, run, configuration(runs), in_sweep=False, resumed=False),
    ):
        if error:
            raise error
    found = read_mlflow(f"sqlite:///{runs}/mlflow.db", ids(run)["mlflow"])
    assert found.about["status"] == status
    assert found.parameters["optim.lr"] == "0.5"


@pytest.mark.parametrize("written", ["../../x", "", "a" * 65, "a\n"])
def test_a_name_that_could_be_a_path_is_not_believed(written: str, runs: Path, run: Path) -> None:
    (run / "loggers.json").write_text(json.dumps({"mlflow": written}))
    with open_loggers({"mlflow": {}}, run, configuration(runs), in_sweep=False, resumed=True):
        pass
    assert len(ids(run)["mlflow"]) == 32


@pytest.mark.parametrize("written", ["[1]", "{", '{"mlflow": 3}'])
def test_a_damaged_file_of_names_begins_another_run(written: str, runs: Path, run: Path) -> None:
    (run / "loggers.json").write_text(written)
    with open_loggers({"mlflow": {}}, run, configuration(runs), in_sweep=False, resumed=True):
        pass
    assert len(ids(run)["mlflow"]) == 32


def test_an_experiment_that_another_job_made_meanwhile(runs: Path, run: Path) -> None:
    with serving(mlflow_of_a_faster_job()) as address:
        options = {"mlflow": {"tracking_uri": address}}
        with open_loggers(options, run, configuration(runs), in_sweep=False, resumed=False):
            pass
    assert ids(run)["mlflow"] == "abc"


def test_a_run_that_the_service_has_lost_says_how_to_begin_another(runs: Path, run: Path) -> None:
    (run / "loggers.json").write_text('{"mlflow": "0123456789abcdef"}')
    expected = r"^logger=mlflow: .*0123456789abcdef.* delete '.*/loggers\.json' to begin another"
    with (
        pytest.raises(ConfigError, match=expected),
        open_loggers({"mlflow": {}}, run, configuration(runs), in_sweep=False, resumed=True),
    ):
        pass
