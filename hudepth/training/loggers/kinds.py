"""The kinds of loggers that ``logger=`` names: Lightning's own classes, opened before anything is prepared."""

from __future__ import annotations

import importlib.util
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock
from lightning.pytorch.loggers import CometLogger, CSVLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger

from hudepth.base.console import log
from hudepth.base.errors import ConfigError

STORE = "mlflow.db"
"""MLflow's data base in the folder of runs, unless it has a server."""
FINISH_TIMEOUT_S = 120
"""How long Weights & Biases may take to upload what is left when a run ends, unless WANDB_FINISH_TIMEOUT is set."""

Options = dict[str, Any]


@dataclass(frozen=True)
class Place:
    """What a logger is told about the run it logs."""

    path: Path
    """The run directory."""
    runs: Path
    """The folder of all runs."""
    name: str
    """Shown in lists of runs."""
    sweep: str | None = None
    """Name of the sweep that the run is a job of."""
    known: str | None = None
    """By which a service knows the run, if it is resumed."""


@dataclass(frozen=True)
class Known:
    """Options of loggers whose type is checked here; others go to Lightning's class as they are."""

    project: str | None = None
    entity: str | None = None
    experiment_name: str | None = None
    tracking_uri: str | None = None
    offline: bool = False


def check_installed(kind: str) -> None:
    """Raise ConfigError if the package of a kind is missing."""
    module = {"wandb": "wandb", "mlflow": "mlflow", "comet": "comet_ml"}.get(kind)
    if module and importlib.util.find_spec(module) is None:
        raise ConfigError(f"logger={kind}: its package is not installed. Run pip install 'hudepth[{kind}]'.")


def _tensorboard(options: Options, place: Place) -> Logger:
    return TensorBoardLogger(place.path, name="tensorboard", version="", default_hp_metric=False, **options)


def _csv(options: Options, place: Place) -> Logger:
    return CSVLogger(place.path, name="csv", **options)  # a resumed run makes the next version_<n>: it deletes none


def _wandb(options: Options, place: Place) -> Logger:
    import wandb

    wait = float(os.environ.get("WANDB_FINISH_TIMEOUT") or FINISH_TIMEOUT_S)
    # console: no progress bar survives being wrapped
    quiet = wandb.Settings(silent=True, console="off", finish_timeout=wait, finish_timeout_raises=True)
    mode = wandb.setup(quiet).settings.mode  # of WANDB_MODE, else online
    if options.pop("offline", False):
        mode = "offline"
    if mode in ("online", "run", "shared") and not wandb.login(prompt=False, verify=True):
        raise ConfigError(
            "logger=wandb: there is no key for Weights & Biases. Run wandb login, or pass logger.wandb.offline=true."
        )
    about: Options = {"name": place.name, "group": place.sweep}
    if place.known:  # as resume= may start a sweep's job alone
        about = {"id": place.known}
    logger = WandbLogger(save_dir=place.path, mode=mode, **{**about, **options})
    run = logger.experiment
    log.info("wandb: %s", run.url or f"upload with wandb sync {Path(run.settings.sync_dir)}")
    return logger


def _mlflow(options: Options, place: Place) -> Logger:
    import mlflow  # sets levels of its own

    _silence("mlflow", "alembic", "urllib3.connectionpool", "lightning.pytorch.loggers.mlflow")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")  # by default, a server that is gone is tried for
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")  # minutes each time, and the training waits
    default = f"sqlite:///{(place.runs / STORE).as_posix()}"
    uri = options.pop("tracking_uri", None) or os.environ.get("MLFLOW_TRACKING_URI") or default
    local = Path(uri.removeprefix("sqlite:///")).absolute() if uri.startswith("sqlite:///") else None
    pictures = {} if local is None else {"artifact_location": (local.parent / "mlartifacts").as_uri()}
    about = {"run_name": place.name, "tags": {"sweep": place.sweep} if place.sweep else None, "run_id": place.known}
    page = re.sub("//[^/]*@", "//", uri)  # without a password
    try:
        with _locked(local), _environment():  # MLflow leaves its address there, for other runs of this process
            logger = MLFlowLogger(**{**about, **pictures, **options}, tracking_uri=uri)
            client, run = _begin(logger), logger.run_id
    except mlflow.MlflowException as error:
        if "Max retries" not in str(error):
            raise
        fix = "Start the server, or pass logger.mlflow.tracking_uri=<another>."
        raise ConfigError(f"logger=mlflow: no server answers at '{page}'. {fix}") from None
    if place.known:
        client.update_run(run, status="RUNNING")
    where = f"mlflow ui --backend-store-uri {uri}" if local else f"{page}/#/experiments/{logger.experiment_id}"
    log.info("mlflow: %s, run %s", where, run)
    return logger


@contextmanager
def _locked(store: Path | None) -> Iterator[None]:
    """Let the jobs of a sweep open a data base one after another: MLflow cannot make its tables twice at once."""
    if store is None:
        yield
        return
    store.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(store.with_name(f".{store.name}.lock")):
        yield


def _begin(logger: MLFlowLogger) -> Any:
    """Begin a run, in an experiment that is made unless there is one; return the client."""
    from mlflow import MlflowException

    try:
        return logger.experiment
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
        return logger.experiment  # another job of the sweep was faster


def _comet(options: Options, place: Place) -> Logger:
    _silence("urllib3.connectionpool")
    quiet = {"COMET_LOGGING_CONSOLE": "ERROR", "COMET_ERROR_TRACKING_ENABLE": "false"}
    with _environment(COMET_DISABLE_AUTO_LOGGING="1", **quiet):  # read when it is imported
        import comet_ml

    offline = options.pop("offline", False)
    if not (offline or options.get("api_key") or comet_ml.get_config("comet.api_key")):  # type: ignore[attr-defined]
        raise ConfigError(
            "logger=comet: there is no key for Comet. Run comet login, or pass logger.comet.offline=true."
        )
    defaults = {
        "auto_output_logging": False, "log_graph": False, "log_code": False, "parse_args": False,
        "display_summary_level": 0,
    }  # fmt: skip
    about: Options = {"name": place.name, "tags": [place.sweep] if place.sweep else None, "mode": "create"}
    if place.known:
        about = {"experiment_key": place.known, "mode": "get"}
    with _environment(**({"COMET_START_ONLINE": "0"} if offline else {})):  # Lightning's online=False logs nothing
        logger = CometLogger(**{"offline_directory": str(place.path), **defaults, **about, **options})
    experiment = logger.experiment
    if not (offline or experiment.alive):
        raise ConfigError("logger=comet: its server does not answer. Pass logger.comet.offline=true, or try again.")
    log.info("comet: %s", f"upload with comet upload {place.path}/{logger.version}*.zip" if offline else experiment.url)
    return logger


KINDS: Mapping[str, Callable[[Options, Place], Logger]] = {
    "tensorboard": _tensorboard, "csv": _csv, "wandb": _wandb, "mlflow": _mlflow, "comet": _comet,
}  # fmt: skip
"""How each logger is opened."""


def _silence(*names: str) -> None:
    for name in names:
        logging.getLogger(name).setLevel(logging.ERROR)


@contextmanager
def _environment(**values: str) -> Iterator[None]:
    """Set variables of the environment during the block, and undo any other change to it."""
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)
