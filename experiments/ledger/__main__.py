"""What the paper claims, next to what is measured here and now: writes ledger.md and ledger.json, prints the table.

python -m experiments.ledger [--runs experiments/badcl_official ...] [--output FOLDER] [--no-throughput]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from experiments.ledger import rows_data, rows_model, rows_runs, rows_table2
from experiments.ledger.ledger import markdown, plain_ledger, terminal_table
from experiments.ledger.row import Row
from experiments.ledger.runs import Run, find_runs
from experiments.ledger.units import predictions, render_rooms, score_readings
from hudepth.base.console import log, track
from hudepth.base.errors import HudepthError
from hudepth.base.files import output_folder, write_json, write_text
from hudepth.base.options import Range, convert
from hudepth.runs.environment import environment

ROOMS, ROOM_SIDE_PX = 24, 112
"""Built-in rooms that the rows on units are measured on."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Check every claim of the paper.

    Raises:
        ConfigError: for values out of range, folders without a run, or an output folder that cannot be written.
    """
    options = _parser().parse_args(arguments)
    batches = convert("--batches", options.batches, list[Annotated[int, Range(1)]])
    seconds = convert("--seconds", options.seconds, Annotated[float, Range(0)])
    runs = find_runs(options.runs)
    output = output_folder(options.output, key="--output")
    for line in (line for run in runs for line in run.problems):
        log.warning("%s", line)
    words = sys.argv[1:] if arguments is None else arguments
    here = {
        **environment(seed=0, accelerator="auto", precision="32-true"),
        "command": ["python", "-m", "experiments.ledger", *words],
    }
    makers = _makers(runs, batches=batches if options.throughput else [], seconds=seconds, device=str(here["device"]))
    rows = [row for make in track(makers, total=len(makers), what="checking the paper") for row in make()]
    parts: dict[str, Any] = {"table_2": rows_table2.table_2_with_runs(runs), "runs": runs, "environment": here}
    write_json(output / "ledger.json", plain_ledger(rows, **parts))
    write_text(output / "ledger.md", markdown(rows, **parts))
    stdout = Console()
    (stdout if stdout.is_terminal else Console(width=120)).print(terminal_table(rows))
    print(f"{output / 'ledger.md'} has every row in full, {output / 'ledger.json'} the figures.")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m experiments.ledger", description="Check every claim of the paper.")
    parser.add_argument("--runs", nargs="+", default=[], metavar="DIR", help="run directories or study folders")
    parser.add_argument("--output", type=Path, default=Path("ledger"), help="folder to write to")
    parser.add_argument("--no-throughput", dest="throughput", action="store_false", help="do not measure speed")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 8, 16, 32], help="of the speed row")
    parser.add_argument("--seconds", type=float, default=3, help="of timed passes at each batch size")
    return parser


def _makers(
    runs: Sequence[Run], *, batches: Sequence[int], seconds: float, device: str
) -> list[Callable[[], list[Row]]]:
    """Return what makes the rows, in the ledger's order."""
    before: list[Callable[[], Row]] = [
        rows_model.parameters_row,
        rows_model.table_a1_row,
        rows_model.text_row,
        rows_model.cost_row,
        rows_model.torchinfo_row,
        partial(rows_model.speed_row, batches=batches, seconds=seconds, device_name=device),
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


if __name__ == "__main__":
    try:
        main()
    except HudepthError as error:
        sys.exit(f"ledger: {error}")
