"""Measure other networks next to this model: Depth Anything V2 small, DPT-hybrid, GLPN and a MobileNet UNet.

    python -m experiments.speed.measure_peers --checkpoint nyu [--backends eager default openvino] [--output FOLDER]

Each peer has random weights and runs in eager PyTorch, at the size nearest to this model's and at its own. Writes what
hudepth-bench writes, and peers.png. Needs the package transformers.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from experiments.speed.peers import PEERS
from hudepth.base.errors import HudepthError
from hudepth.bench.backends import ON_CPU, REFERENCE, missing
from hudepth.bench.command import measure
from hudepth.bench.contenders import Contenders
from hudepth.bench.plan import make_plan
from hudepth.bench.report import format_figure, write_report
from hudepth.bench.rows import Entry, Row
from hudepth.viz.panels import save_figure
from hudepth.viz.style import COLOURS


def start_peers(contenders: Contenders, *, names: Sequence[str] = tuple(PEERS)) -> None:
    """Start each peer at the size nearest to this model's and at its own; one that cannot be built is a note."""
    for name in names:
        peer = PEERS[name]
        if peer.package and (line := missing((peer.package,), "dev")):
            contenders.note(name, line)
            continue
        for size in dict.fromkeys((peer.nearest(contenders.subject.size), peer.native)):
            label = f"{name}, {format_size(size)}"
            options = {"peer": name, "size": size, "device": contenders.device}
            entry = Entry(label, label, size, kind="peer")
            contenders.start(entry, "experiments.speed.peers:PeerRunner", options)


def select(rows: Sequence[Row]) -> list[Row]:
    """Return the peers and, at the same batch size, this model as it would be used; empty if there are no peers.

    The batch is the smallest at which both were measured.
    """
    both = {row.batch for row in rows if row.kind == "peer"} & {row.batch for row in rows if row.contender == REFERENCE}
    here = [row for row in rows if both and row.batch == min(both)]
    exact = [row for row in here if row.exact]
    shown = {REFERENCE, "default", *(max(exact, key=lambda row: row.speed).contender for _ in exact[:1])}
    return [row for row in here if row.kind == "peer" or row.contender in shown]


def compare(rows: Sequence[Row], *, size: tuple[int, int]) -> list[str]:
    """Say how fast each peer is relative to this model in PyTorch, then which of them are faster than what."""
    here = select(rows)
    peers = [row for row in here if row.kind == "peer"]
    ours = [row for row in here if row.kind == "backend"]
    if not peers:
        return []
    in_torch = [row for row in ours if row.contender in (REFERENCE, "default")]
    lines = [f"Images/s at batch {here[0].batch} relative to this model at {format_size(size)}:"]
    near = []
    for name in dict.fromkeys(row.contender.rpartition(",")[0] for row in peers):
        own = [row for row in peers if row.contender.rpartition(",")[0] == name]
        parts = []
        for row in own:
            ratios = " and ".join(f"{row.speed / other.speed:.2f} x {other.contender}" for other in in_torch)
            parts.append(f"at {format_size((row.height, row.width))} {ratios}")
        lines.append(f"{name} (random weights, eager): {'; '.join(parts)}.")
        near.append((name, min(own, key=lambda row: abs(row.height * row.width - size[0] * size[1]))))
    faster = []
    for own_row in ours:
        names = [name for name, row in near if row.speed > own_row.speed]
        verb = "are" if len(names) > 1 else "is"
        faster.append(f"{' and '.join(names) or 'none'} {verb} faster than {own_row.contender}")
    return [*lines, f"Of the peers, at the size nearest to this model's: {'; '.join(faster)}."]


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the times at one batch size, the fastest at the top; lines are p25 to p75."""
    ordered = sorted(rows, key=lambda row: row.ms_per_image)
    figure = Figure(figsize=(8.2, 4.8), dpi=130, layout="constrained")
    axis = figure.subplots()
    for place, row in enumerate(ordered):
        colour = COLOURS[1] if row.kind == "backend" else "0.45"
        axis.plot([row.p25_ms / row.batch, row.p75_ms / row.batch], [place, place], color=colour, linewidth=2)
        axis.plot(row.ms_per_image, place, "o", color=colour, markersize=7)
        end = max(row.ms_per_image, row.p75_ms / row.batch)
        axis.annotate(f"   {format_figure(row.ms_per_image)}", (end, place), va="center", fontsize=8)
    names = [f"this model, {row.contender}" if row.kind == "backend" else row.contender for row in ordered]
    axis.set_yticks(range(len(ordered)), names)
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_xlim(0.5 * ordered[0].ms_per_image, 2.5 * ordered[-1].ms_per_image)
    axis.set_xlabel("ms/image", fontsize=9)
    axis.set_title(f"other networks (random weights, eager PyTorch), batch {ordered[0].batch}", fontsize=9, loc="left")
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def format_size(size: tuple[int, int]) -> str:
    """Write (height, width), a square as one number."""
    return str(size[0]) if size[0] == size[1] else f"{size[0]} x {size[1]}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", default="nyu", help="a checkpoint, run directory or bundle")
    parser.add_argument("--runs", default="runs", help="the folder that --checkpoint last searches")
    parser.add_argument("--backends", nargs="+", default=ON_CPU, help="of this model")
    parser.add_argument("--batches", type=int, nargs="+", default=[1], help="images per pass; peers are slow on a CPU")
    parser.add_argument("--repeats", type=int, default=3, help="rounds")
    parser.add_argument("--seconds", type=float, default=0.7, help="of timed passes per turn")
    parser.add_argument("--output", type=Path, default=Path("peers"), help="folder to write to")
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=list(PEERS), help="networks to compare with")
    options = vars(parser.parse_args(arguments))
    names, runs = options.pop("peers"), options.pop("runs")
    plan = make_plan(options)
    measured = measure(plan, runs=runs, more=partial(start_peers, names=names))
    rows = measured.rows()
    write_report(measured, sentences=compare(rows, size=measured.subject.size))
    if chosen := select(rows):
        save_figure(plan.output / "peers.png", draw(chosen))


if __name__ == "__main__":
    try:
        main()
    except HudepthError as error:
        sys.exit(f"measure_peers: {error}")
