"""What hudepth-bench leaves: a table on standard output, bench.json, bench.csv, bench.md and bench.png."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from rich.console import Console

from hudepth import __version__
from hudepth.base.files import write_json, write_text
from hudepth.base.machine import hardware
from hudepth.bench.field import Subject
from hudepth.bench.plan import Plan
from hudepth.bench.plot import save_bench
from hudepth.bench.rounds import Session
from hudepth.bench.rows import Entry, comparisons, efficiency, make_rows, plain
from hudepth.bench.tables import LEGEND, csv_text, markdown, terminal_table


@dataclass(frozen=True)
class Measured:
    """A run that is over."""

    plan: Plan
    subject: Subject
    trained: bool
    """Whether its weights are those of a checkpoint."""
    entries: list[Entry]
    session: Session
    rates: list[float]
    """Of matrix products [GFLOP/s], one a round."""

    @property
    def notes(self) -> list[str]:
        """What was left out, and why."""
        return [f"{name}: {line}" for name, lines in self.session.notes.items() for line in lines]


def write(measured: Measured) -> None:
    """Write all files, print table and notes.

    Args:
        measured: with at least one sample.

    Raises:
        OSError: if the output folder is full or gone.
    """
    plan, subject = measured.plan, measured.subject
    peak = max(measured.rates, default=None)
    rows = make_rows(measured.session.samples, measured.entries, peak_gflop_per_s=peak, max_depth_m=subject.max_depth_m)
    best = efficiency(rows, peak_gflop_per_s=peak, merged_flops=subject.merged_flops)
    sentences = [line for line in (best, *comparisons(rows, size=subject.size)) if line]
    notes = [*_about(measured), *measured.notes]
    machine = hardware()
    if plan.device == "cuda":
        machine["gpu"] = torch.cuda.get_device_name()
    title = f"{subject.name}, {subject.size[0]} x {subject.size[1]}, threads: {plan.threads}"
    stated: dict[str, Any] = {"machine": machine, "sentences": sentences, "notes": notes}
    content = {**_content(measured), **stated, "rows": [plain(row) for row in rows]}
    write_json(plan.output / "bench.json", content)
    write_text(plan.output / "bench.csv", csv_text(rows))
    write_text(plan.output / "bench.md", markdown(rows, title=title, **stated))
    save_bench(plan.output / "bench.png", rows, title=f"{title}, on {machine['processor']}")
    stdout = Console()
    stdout = stdout if stdout.is_terminal else Console(width=140)
    stdout.print(terminal_table(rows, title=title))
    for line in (LEGEND, *sentences, *notes):
        stdout.print(line, markup=False, highlight=False)
    print(f"{plan.output / 'bench.md'} has the table, bench.csv its figures, bench.json every time, bench.png a plot.")


def _content(measured: Measured) -> dict[str, Any]:
    """Return what bench.json holds beside what the page says."""
    subject, session = asdict(measured.subject), measured.session
    return {
        "hudepth": __version__,
        "model": {
            **{key: subject[key] for key in subject if key not in ("state", "trust")},
            "trained": measured.trained,
        },
        "settings": {key: value for key, value in asdict(measured.plan).items() if key != "output"},
        "matmul_gflop_per_s": {"best": max(measured.rates, default=None), "of_each_round": measured.rates},
        "times_s": [
            {"contender": sample.name, "batch": sample.batch, "rounds": sample.rounds} for sample in session.samples
        ],
    }


def _about(measured: Measured) -> list[str]:
    """Say what was measured."""
    subject = measured.subject
    lines = [
        f"{subject.parameters:,} parameters; an image takes {subject.flops / 1e9:.2f} GFLOP as the network was "
        f"trained (nominal), {subject.merged_flops / 1e9:.2f} as it is merged.",
        "Network alone: normalised float images in, unit depth out; decoding and resizing are not part of it.",
    ]
    if not measured.trained:
        lines.append("Random weights: they leave the speed as it is; the depth means nothing.")
    if measured.plan.device == "cuda":
        lines.append(
            "Backends and peers in PyTorch ran on the GPU, MB is what their tensors took there; all others on the CPU. "
            "PyTorch lets convolutions, but not matrix products, use TF32 on GPUs that have it."
        )
    return lines + [f"{entry.name}: {entry.about}." for entry in measured.entries]
