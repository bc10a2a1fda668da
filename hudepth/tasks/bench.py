"""hudepth-bench: speed and memory of a model on this machine, in every backend, beside other networks."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console

from hudepth import __version__
from hudepth.bench.backends import BACKENDS, check_backends
from hudepth.bench.field import Field, Subject
from hudepth.bench.plot import save_bench
from hudepth.bench.rounds import Session
from hudepth.bench.rows import Row, comparisons, efficiency, make_rows, plain
from hudepth.bench.tables import LEGEND, csv_text, markdown, terminal_table
from hudepth.bench.worker import ContenderError
from hudepth.console import log, track
from hudepth.errors import ConfigError
from hudepth.files import write_json, write_text
from hudepth.machine import hardware, usable_cores
from hudepth.tasks.bench_subject import make_subject
from hudepth.tasks.config import plain as resolved
from hudepth.tasks.config import whole_number


@dataclass(frozen=True)
class Plan:
    """What is to be measured, and how."""

    backends: list[str]
    batches: list[int]
    peers: bool
    peer_batches: list[int]
    repeats: int
    seconds: float
    longest_pass: float
    threads: int
    device: str
    output: Path


def bench(cfg: DictConfig) -> None:
    """Measure, print the table, write bench.json, bench.csv, bench.md and bench.png.

    Args:
        cfg: what conf/bench.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user; a backend that is missing or fails is none, but a note.
    """
    config = resolved(cfg)
    plan = _plan(config)
    torch.set_num_threads(plan.threads)
    with tempfile.TemporaryDirectory(prefix="hudepth-bench-") as made:
        subject = make_subject(config, Path(made))
        log.info(
            "%s of %s parameters, %d x %d, %s; each of %s in a process of its own with %d threads",
            subject.name, f"{subject.parameters:,}", *subject.size,
            "random weights" if config["checkpoint"] is None else "trained", ", ".join(plan.backends), plan.threads,
        )  # fmt: skip
        session, rows, rates = _measure(plan, subject, Path(made))
    if not rows:
        raise ConfigError(f"nothing could be measured. {' '.join(_notes(session))}")
    _write(plan, subject, session, rows, rates, trained=config["checkpoint"] is not None)


def _measure(plan: Plan, subject: Subject, folder: Path) -> tuple[Session, list[Row], list[float]]:
    """Build all contenders, then go round; the rates are those of matrix products, one a round."""
    session = Session([], plan.batches, plan.repeats, plan.seconds, plan.longest_pass)
    rates: list[float] = []
    with Field(subject, folder, plan.threads, plan.device, session.note) as field:
        count = field.enter(plan.backends, _peers() if plan.peers else ())
        for _ in track(field.build(), total=count, what="building"):
            pass
        session.enter(field.workers)
        session.only = {entry.name: plan.peer_batches for entry in field.entries if entry.peer}
        session.before_round = _product(field, session, rates)
        for _ in track(session.run(), total=session.steps, what="measuring"):
            pass
        entries = field.entries
    peak = max(rates, default=None)
    return session, make_rows(session.samples, entries, peak_gflop_per_s=peak, max_depth_m=subject.max_depth_m), rates


def _peers() -> Sequence[str]:
    from hudepth.bench.peers import PEERS

    return list(PEERS)


def _product(field: Field, session: Session, rates: list[float]) -> Callable[[], None]:
    """Return what adds the rate of a matrix product to ``rates``; where it fails, the table does without."""
    try:
        worker = field.product()
    except ContenderError as error:
        session.note("matrix product", f"not measured: {error}")
        return lambda: None

    def measure() -> None:
        try:
            rates.append(worker.matmul_gflop_per_s())
        except ContenderError as error:
            session.note("matrix product", f"not measured: {error}")

    return measure


def _write(
    plan: Plan, subject: Subject, session: Session, rows: list[Row], rates: list[float], *, trained: bool
) -> None:
    machine = hardware()
    if plan.device == "cuda":
        machine["gpu"] = torch.cuda.get_device_name()
    title = f"{subject.name}, {subject.size[0]} x {subject.size[1]}, {plan.threads} threads"
    peak = max(rates, default=None)
    sentences = [
        line for line in (efficiency(rows, peak_gflop_per_s=peak, merged_flops=subject.merged_flops),
                          *comparisons(rows, size=subject.size)) if line
    ]  # fmt: skip
    notes = [*_about(plan, subject, trained=trained), *_notes(session)]
    model = {key: value for key, value in asdict(subject).items() if key not in ("state", "trust")}
    times = {(sample.batch, sample.name): sample.rounds for sample in session.samples}
    content = {
        "hudepth": __version__,
        "machine": machine,
        "model": {**model, "trained": trained},
        "settings": {key: value for key, value in asdict(plan).items() if key != "output"},
        "matmul_gflop_per_s": {"best": peak, "of_each_round": rates},
        "rows": [plain(row) for row in rows],
        "sentences": sentences,
        "notes": notes,
        "times_s": [{"contender": name, "batch": batch, "rounds": own} for (batch, name), own in times.items()],
    }
    write_json(plan.output / "bench.json", content)
    write_text(plan.output / "bench.csv", csv_text(rows))
    page = markdown(rows, title=title, machine=machine, sentences=sentences, notes=notes)
    write_text(plan.output / "bench.md", page)
    save_bench(plan.output / "bench.png", rows, title=f"{title} on {machine['processor']}")
    stdout = Console()
    stdout = stdout if stdout.is_terminal else Console(width=140)
    stdout.print(terminal_table(rows, title=title))
    for line in (LEGEND, *sentences, *notes):
        stdout.print(line, markup=False, highlight=False)
    print(f"{plan.output / 'bench.md'} has the table, bench.csv its figures, bench.json every time, bench.png a plot.")


def _about(plan: Plan, subject: Subject, *, trained: bool) -> list[str]:
    """Say what was measured."""
    lines = [
        f"{subject.parameters:,} parameters; an image takes {subject.flops / 1e9:.2f} GFLOP as the network was "
        f"trained (nominal), {subject.merged_flops / 1e9:.2f} as it is merged.",
        "Network alone: normalised float images in, unit depth out; decoding and resizing are not part of it.",
    ]
    if not trained:
        lines.append("Random weights: they leave the speed as it is; the depth means nothing.")
    if plan.device == "cuda":
        lines.append(
            "Backends and peers in PyTorch ran on the GPU, MB is what their tensors took there; all others on the CPU. "
            "PyTorch lets convolutions, but not matrix products, use TF32 on GPUs that have it."
        )
    return lines + [f"{name}: {BACKENDS[name].what}." for name in plan.backends]


def _notes(session: Session) -> list[str]:
    return [f"{name}: {line}" for name, lines in session.notes.items() for line in lines]


def _plan(config: dict[str, Any]) -> Plan:
    """Check every option, and that the output folder can be written, before anything is built."""
    threads = usable_cores() if config["threads"] is None else whole_number(
        config, "threads", default=usable_cores(), least=1
    )  # fmt: skip
    return Plan(
        backends=check_backends(config["backends"]),
        batches=_batches(config["batches"]),
        peers=bool(config["peers"]),
        peer_batches=_peer_batches(config),
        repeats=whole_number(config, "repeats", default=5, least=1),
        seconds=_seconds(config, "seconds", default=1, zero=True),
        longest_pass=_seconds(config, "longest_pass", default=10, zero=False),
        threads=threads,
        device=_device(str(config["device"])),
        output=_made(Path(str(config["output"])).expanduser()),
    )


def _batches(value: Any, *, key: str = "batches") -> list[int]:
    batches = value if isinstance(value, list) else [value]
    if not batches or not all(type(batch) is int and batch > 0 for batch in batches):
        raise ConfigError(f"{key}: {value} is no list of positive whole numbers. Pass {key}=[1,4].")
    return sorted(set(batches))


def _peer_batches(config: dict[str, Any]) -> list[int]:
    batches, wanted = _batches(config["batches"]), _batches(config["peer_batches"], key="peer_batches")
    chosen = [batch for batch in wanted if batch in batches]
    if config["peers"] and not chosen:
        raise ConfigError(
            f"peer_batches: none of {wanted} is among batches={batches}. Pass peer_batches=[{batches[0]}]."
        )
    return chosen


def _seconds(config: dict[str, Any], key: str, *, default: float, zero: bool) -> float:
    value = config[key]
    good = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < float("inf")
    if not good or (value == 0 and not zero):
        raise ConfigError(f"{key}: {value} is no number of seconds. Leave it out for {default}.")
    return float(value)


def _device(name: str) -> str:
    there = {"cpu": True, "cuda": torch.cuda.is_available()}
    if name == "auto":
        return "cuda" if there["cuda"] else "cpu"
    if not there.get(name):
        raise ConfigError(
            f"device: no '{name}' here. Pass device={' or '.join(k for k, here in there.items() if here)}."
        )
    return name


def _made(output: Path) -> Path:
    try:
        output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=output):
            return output
    except OSError as error:
        raise ConfigError(f"output: cannot write to '{output}' ({error.strerror}). Pass output=<a folder>.") from error
