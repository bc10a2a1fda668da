"""hudepth-report figures: loss curves and predictions of one run (figures 5 and 6 of the paper)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from hudepth.base.console import log
from hudepth.base.errors import ConfigError, HudepthError
from hudepth.base.files import output_folder
from hudepth.base.options import Range
from hudepth.evaluation.pictures import evenly_spaced, run_panels
from hudepth.report.curves import draw_curves
from hudepth.runs.history import read_history
from hudepth.runs.run import is_run, newest_run
from hudepth.viz.panels import save_figure, save_panels


@dataclass(frozen=True)
class FiguresOptions:
    """Options of ``hudepth-report figures``; conf/report.yaml explains them."""

    paths: Mapping[str, Any]
    run: Annotated[Path, "a run directory or last"] = Path("last")
    panels: Annotated[int, Range(0)] = 6
    output: Path | None = None
    data: Mapping[str, Any] = field(default_factory=dict)
    trust: list[str] = field(default_factory=list)


def draw_figures(options: FiguresOptions) -> None:
    """Draw the curves of the loss and its terms, and panels of RGB, ground truth, prediction and error.

    Without the run's checkpoint or data there are only curves. Raises HudepthError if there is no run or no history.
    """
    run = newest_run(options.paths["runs"]) if options.run == Path("last") else options.run
    if not is_run(run):
        raise ConfigError(f"run: '{run}' is not a run directory. Pass run=<runs/name/date_time>, or run=last.")
    history = read_history(run / "metrics.csv")
    output = output_folder(options.output or run / "figures", within=None if options.output else run)
    name = os.fsencode(run.parent.name).decode(errors="backslashreplace")
    save_figure(output / "curves.png", draw_curves(history, title=f"{name}: loss and raw terms"))
    log.info("total loss and its terms by epoch: %s", (output / "curves.png").resolve())
    if not options.panels:
        return
    count = options.panels
    try:
        panels = run_panels(run, lambda data: evenly_spaced(sorted(data.split.test), count), config=vars(options))
    except HudepthError as error:
        log.warning("no panels: %s", error)
        return
    save_panels(output / "panels.png", panels)
    log.info("RGB, ground truth, prediction and error of %d test images: %s", len(panels), output / "panels.png")
