"""The results of hudepth-bench: a table on standard output, bench.json, bench.csv, bench.md and bench.png."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from hudepth import __version__
from hudepth.base.files import write_json, write_text
from hudepth.base.machine import hardware
from hudepth.base.tables import Table, say
from hudepth.bench.paper import describe_paper
from hudepth.bench.plan import SETTINGS, Plan
from hudepth.bench.plot import draw_bench
from hudepth.bench.rounds import Session
from hudepth.bench.rows import Entry, Row, describe_efficiency, make_rows
from hudepth.bench.subject import Subject
from hudepth.viz.panels import save_figure

LEGEND = (
    "ms/image and images/s are those of the median pass; p50, p25-p75 and p95 are quantiles of a pass [ms]; x eager is "
    "images/s relative to this model in eager mode, the median over rounds in which both ran; MB is the peak memory of "
    "the process, libraries included; GFLOP/s and % peak count the operations of the network as trained (nominal), "
    "% peak relative to the best matrix product of the same run, in single precision or, on a GPU, in the contender's: "
    "a yardstick and not a bound, since operations that merging saves are counted; diff is the largest difference from "
    "eager at any pixel."
)


@dataclass(frozen=True)
class Measured:
    """A finished run; ``rates`` [GFLOP/s] of matrix products are one per round and precision."""

    plan: Plan
    subject: Subject
    entries: list[Entry]
    session: Session
    rates: dict[str, list[float]]

    @property
    def peaks(self) -> dict[str, float]:
        """The best rates, by precision."""
        return {precision: max(rates) for precision, rates in self.rates.items()}

    def rows(self) -> list[Row]:
        """Return the rows of the table."""
        max_depth_m = self.subject.max_depth_m
        return make_rows(self.session.samples, self.entries, peaks=self.peaks, max_depth_m=max_depth_m)


def write_report(measured: Measured, *, sentences: Sequence[str] = ()) -> None:
    """Write all files, print table, notes and further ``sentences``; raises OSError if the folder is full or gone."""
    plan, subject, rows = measured.plan, measured.subject, measured.rows()
    peak = measured.peaks.get("float32")
    best = describe_efficiency(rows, peak_gflop_per_s=peak, merged_flops=subject.merged_flops)
    lines = [*([best] if best else []), *sentences]
    notes = [*_about(measured), *measured.session.notes]
    machine = hardware()
    if plan.device == "cuda":
        machine["gpu"] = torch.cuda.get_device_name()
        lines += describe_paper(rows, name=subject.name, gpu=machine["gpu"])
    height, width = subject.size
    table = bench_table(rows, f"{subject.name}, {height} x {width}, threads: {plan.threads}")
    content = {**_content(measured), "machine": machine, "sentences": lines, "notes": notes}
    write_json(plan.output / "bench.json", {**content, "rows": [asdict(row) for row in rows]})
    write_text(plan.output / "bench.csv", to_csv(rows))
    write_text(plan.output / "bench.md", to_page(table, machine=machine, lines=[*lines, *notes]))
    save_figure(
        plan.output / "bench.png",
        draw_bench(rows, title=f"{table.title}, on {machine.get('gpu', machine['processor'])}"),
    )
    table.show()
    for line in (LEGEND, *lines, *notes):
        say(line)
    say(f"{plan.output / 'bench.md'} has the table, bench.csv its figures, bench.json every time, bench.png a plot.")


def bench_table(rows: Sequence[Row], title: str) -> Table:
    """Return the rows as they are shown."""
    columns = (
        "batch", "contender", "ms/image", "images/s", "x eager", "p50 [ms]", "p25-p75", "p95", "MB", "GFLOP/s",
        "% peak", "diff [mm]",
    )  # fmt: skip
    rank = ("ms/image", "images/s", "x eager", "diff [mm]", "MB", "p50 [ms]", "p95", "p25-p75", "GFLOP/s", "% peak")
    table = Table(columns, title=title, left=2, rank=rank, rest="bench.md")
    for row in rows:
        table.add(
            str(row.batch), row.contender, format_figure(row.ms_per_image), format_figure(row.images_per_s),
            "" if row.times_eager is None else f"{row.times_eager:.2f}", format_figure(row.p50_ms),
            f"{format_figure(row.p25_ms)}-{format_figure(row.p75_ms)}", format_figure(row.p95_ms),
            f"{row.peak_mb:.0f}", "" if row.gflop_per_s is None else format_figure(row.gflop_per_s),
            "" if row.share_of_peak is None else f"{100 * row.share_of_peak:.0f}",
            "" if row.difference_mm is None else f"{row.difference_mm:.2g}",
        )  # fmt: skip
    return table


def to_csv(rows: Sequence[Row]) -> str:
    """Return all columns; what is not known is empty."""
    cells = [["" if value is None else str(value) for value in asdict(row).values()] for row in rows]
    return Table(list(Row.__dataclass_fields__), [*cells]).to_csv()


def to_page(table: Table, *, machine: Mapping[str, Any], lines: Sequence[str]) -> str:
    """Return a Markdown page: the machine, the table, the legend, and results and notes as a list."""
    listed = "\n".join(f"- {line}" for line in lines)
    return f"# {table.title}\n\nOn {describe_machine(machine)}.\n\n{table.to_markdown()}\n{LEGEND}\n\n{listed}\n"


def describe_machine(machine: Mapping[str, Any]) -> str:
    """Return where something was measured, in one line."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["packages"].items() if version)
    memory = f"{machine['memory_gb']:.0f} GB, " if machine["memory_gb"] else ""
    sets = " ".join(machine["instruction_sets"]) or "instruction sets unknown"
    gpu = f"{machine['gpu']}; " if machine.get("gpu") else ""
    return gpu + (
        f"{machine['processor']}, {machine['cores']} cores of which {machine['usable_cores']} may be used, {memory}"
        f"{sets}; {machine['system']}, Python {machine['python']}, {versions}"
    )


def format_figure(value: float) -> str:
    """Write a positive number with three digits, or all its whole ones."""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _content(measured: Measured) -> dict[str, Any]:
    """Return what only bench.json holds."""
    settings, model = asdict(measured.plan), asdict(measured.subject)
    del model["state"], model["trust"]
    return {
        "hudepth": __version__,
        "model": {**model, "trained": measured.plan.checkpoint is not None},
        "settings": {key: settings[key] for key in SETTINGS},
        "matmul_gflop_per_s": {
            precision: {"best": max(rates), "of_each_round": rates} for precision, rates in measured.rates.items()
        },
        "times_s": [
            {"contender": sample.name, "batch": sample.batch, "rounds": sample.rounds}
            for sample in measured.session.samples
        ],
    }


def _about(measured: Measured) -> list[str]:
    """Say what was measured."""
    subject = measured.subject
    lines = [
        f"{subject.parameters:,} parameters; an image takes {subject.flops / 1e9:.2f} GFLOP in the network as trained "
        f"(nominal), {subject.merged_flops / 1e9:.2f} when it is merged.",
        "Network alone: normalised float images in, unit depth out; decoding and resizing are not included.",
    ]
    if measured.plan.checkpoint is None:
        lines.append("Random weights: they do not change the speed; the depth means nothing.")
    if measured.plan.device == "cuda":
        lines.append(
            "PyTorch, onnxruntime_cuda and tensorrt ran on the GPU, where images and depth stay; all others ran on the "
            "CPU. For PyTorch, MB is the peak memory of its tensors. float32 is without TF32."
        )
        peaks = ", ".join(f"{name} {rate / 1000:.1f}" for name, rate in measured.peaks.items())
        lines.append(f"Matrix products here [TFLOP/s]: {peaks}.")
    return lines + [f"{entry.name}: {entry.about}." for entry in measured.entries]
