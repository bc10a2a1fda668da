"""hudepth-report paper: what the paper claims beside what is measured here and now."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.ledger import rows_data, rows_model, rows_runs, rows_table2
from experiments.ledger.ledger import markdown, plain_ledger, terminal_table
from experiments.ledger.row import Row
from experiments.ledger.runs import Run, find_runs
from experiments.ledger.units import predictions, render_rooms, score_readings
from hudepth.base.console import log, track
from hudepth.base.errors import ConfigError
from hudepth.base.files import write_json, write_text
from hudepth.runs.run_dir import environment

DEFAULT_OUTPUT = "paper_ledger"
ROOMS, ROOM_SIDE_PX = 24, 112
"""Built-in rooms that the rows on units are measured on."""


def paper(config: dict[str, Any]) -> None:
    """Measure every claim, write ledger.md and ledger.json, print the table.

    Args:
        config: ``runs`` (run directories or studies, may be empty), ``output`` (folder; default ``./paper_ledger``),
            ``throughput`` (whether to measure speed), ``batches`` (sizes at which), ``seconds`` (for each).

    Raises:
        ConfigError: for values out of range, folders that hold no run, or an output folder that cannot be made.
    """
    batches, seconds = _speed_options(config)
    output = Path(config.get("output") or DEFAULT_OUTPUT).expanduser()
    runs = find_runs(config.get("runs") or [])
    _make_folder(output)
    for line in (line for run in runs for line in run.problems):
        log.warning("%s", line)
    here = environment(seed=0, accelerator="auto")
    makers = _makers(runs, batches=batches, seconds=seconds, device_name=str(here["device"]))
    rows = [row for make in track(makers, total=len(makers), what="checking the paper") for row in make()]
    parts: dict[str, Any] = {"table_2": rows_table2.table_2_with_runs(runs), "runs": runs, "environment": here}
    write_json(output / "ledger.json", plain_ledger(rows, **parts))
    write_text(output / "ledger.md", markdown(rows, **parts))
    stdout = Console()
    (stdout if stdout.is_terminal else Console(width=120)).print(terminal_table(rows))
    print(f"{output / 'ledger.md'} has each row in full, {output / 'ledger.json'} the figures.")


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"output: cannot make '{path}' ({error.strerror}). Pass output=<a folder you can write to>."
        ) from error


def _makers(
    runs: Sequence[Run], *, batches: Sequence[int], seconds: float, device_name: str
) -> list[Callable[[], list[Row]]]:
    """Return what makes the rows, in the ledger's order."""
    before: list[Callable[[], Row]] = [
        rows_model.parameters_row,
        rows_model.table_a1_row,
        rows_model.text_row,
        rows_model.cost_row,
        rows_model.torchinfo_row,
        partial(rows_model.speed_row, batches=batches, seconds=seconds, device_name=device_name),
        rows_model.table_3_row,
        rows_data.split_row,
        rows_data.leakage_row,
        partial(rows_runs.split_effect_row, runs),
    ]
    after: list[Callable[[], Row]] = [
        partial(rows_runs.units_of_runs_row, runs),
        partial(rows_runs.epochs_row, runs),
        partial(rows_runs.accuracy_row, runs),
        partial(rows_runs.edges_row, runs),
        rows_table2.best_row,
        rows_table2.deltas_row,
        rows_table2.bounds_row,
        partial(rows_table2.protocol_row, runs),
    ]
    return [*map(_as_list, before), _rows_on_rooms, *map(_as_list, after)]


def _as_list(make: Callable[[], Row]) -> Callable[[], list[Row]]:
    return lambda: [make()]


def _rows_on_rooms() -> list[Row]:
    rooms = render_rooms(frames=ROOMS, side_px=ROOM_SIDE_PX)
    made = predictions(rooms)
    scores = score_readings(rooms, made)
    return [
        rows_data.ssim_and_loss_row(rooms, scores),
        rows_data.rmse_row(scores),
        rows_data.eps_row(rooms, made["smooth error"]),
    ]


def _speed_options(config: dict[str, Any]) -> tuple[list[int], float]:
    batches, seconds = config.get("batches") or [], config.get("seconds", 3)
    if not isinstance(batches, list) or not all(type(batch) is int and batch > 0 for batch in batches):
        raise ConfigError(f"batches: {batches} is no list of positive whole numbers. Pass batches=[1,4,8,16,32].")
    if not isinstance(seconds, (int, float)) or not 0 <= seconds < float("inf"):
        raise ConfigError(f"seconds: {seconds} is no time. Pass the seconds for each batch size, as seconds=3.")
    return (batches if config.get("throughput", True) else []), float(seconds)
