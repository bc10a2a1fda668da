"""hudepth-report figures: the paper's figures 5 and 6 of any run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import ConfigError, HudepthError
from hudepth.base.options import whole_number
from hudepth.evaluation.pictures import evenly_spaced, run_panels
from hudepth.report.curves import save_curves
from hudepth.runs.history import read_history
from hudepth.runs.run_dir import is_run, newest_run
from hudepth.viz.panels import save_panels


def figures(config: dict[str, Any]) -> None:
    """Draw the curves of the total loss and of each term, and panels of RGB, truth, prediction and error.

    The panels need the run's checkpoint and its data. Where one is missing, the curves are drawn all the same.

    Args:
        config: with ``run``, ``panels``, ``data``, ``output``, ``paths`` and ``trust``.

    Raises:
        HudepthError: if there is no run or no history of it.
    """
    run = newest_run(config["paths"]["runs"]) if config["run"] == "last" else Path(str(config["run"])).expanduser()
    if not is_run(run):
        raise ConfigError(f"run: '{run}' is no run directory. Pass run=<runs/name/date_time>, or run=last.")
    output = Path(config["output"]).expanduser() if config["output"] else run / "figures"
    count = whole_number(config, "panels", default=6)
    history = read_history(run / "metrics.csv")
    try:
        save_curves(output / "curves.png", history, title=f"{run.parent.name}: loss and raw terms")
    except OSError as error:
        raise ConfigError(f"output: cannot write '{output}' ({error.strerror}). Pass output=<a folder>.") from error
    log.info("total loss and each term, by epoch: %s", (output / "curves.png").resolve())
    if not count:
        return
    try:
        panels = run_panels(run, lambda datamodule: evenly_spaced(sorted(datamodule.split.test), count), config=config)
    except HudepthError as error:
        log.warning("no panels: %s", error)
        return
    save_panels(output / "panels.png", panels)
    log.info("RGB, truth, prediction and error of %d test images: %s", len(panels), (output / "panels.png").resolve())
