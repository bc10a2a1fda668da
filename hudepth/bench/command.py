"""hudepth-bench: speed and memory of a model on this machine, in every backend."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from hudepth.base.console import log, track
from hudepth.base.errors import ConfigError
from hudepth.base.files import output_folder
from hudepth.base.wording import more_room
from hudepth.bench.contenders import Contenders
from hudepth.bench.plan import Plan, make_plan
from hudepth.bench.report import Measured, write_report
from hudepth.bench.rounds import Session
from hudepth.bench.subject import make_subject
from hudepth.bench.worker import ContenderError


def bench(config: dict[str, Any]) -> None:
    """Measure, print the table, write bench.json, bench.csv, bench.md and bench.png.

    Raises HudepthError with one line for the user; a backend that is missing or fails is a note instead.
    """
    plan = make_plan(config)
    measured = measure(plan, runs=config["paths"]["runs"])
    try:
        write_report(measured)
    except OSError as error:
        raise ConfigError(
            f"output: cannot write to '{plan.output}' ({error.strerror or error}). {more_room(error)}."
        ) from error


def measure(plan: Plan, *, runs: str, more: Callable[[Contenders], Any] = lambda _: None) -> Measured:
    """Build all contenders and those that ``more`` starts, then measure them in turns.

    Raises HudepthError if the network cannot be built, the output folder cannot be made, or nothing could be measured.
    """
    assert plan.threads
    assert plan.backends
    torch.set_num_threads(plan.threads)
    session = Session(plan.batches, plan.repeats, plan.seconds, plan.longest_pass)
    rates: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory(prefix="hudepth-bench-") as made:
        subject = make_subject(plan, Path(made), runs=runs)
        output_folder(plan.output)  # before minutes of work
        log.info(
            "%s of %s parameters, %d x %d, %s; %s; each in a process of its own, threads: %d",
            subject.name, f"{subject.parameters:,}", *subject.size,
            "random weights" if plan.checkpoint is None else "trained", ", ".join(plan.backends), plan.threads,
        )  # fmt: skip
        with Contenders(subject, Path(made), plan.threads, plan.device, session.note) as contenders:
            contenders.enter(plan.backends)
            more(contenders)
            for _ in track(contenders.build(), total=len(contenders.started), what="building"):
                pass
            session.contenders = contenders.workers
            session.before_round = _measure_product(contenders, session, rates)
            for _ in track(session.run(), total=session.steps, what="measuring"):
                pass
    measured = Measured(plan, subject, contenders.entries, session, rates)
    if not session.samples:
        raise ConfigError(f"nothing could be measured. {' '.join(session.notes)}")
    return measured


def _measure_product(contenders: Contenders, session: Session, rates: dict[str, list[float]]) -> Callable[[], None]:
    """Return a function that adds the rates of matrix products to ``rates``, by precision, until that fails."""
    precisions = dict.fromkeys(entry.yardstick for entry in contenders.entries if entry.yardstick)
    workers = []
    try:
        workers.append(contenders.product())
    except ContenderError as error:
        session.note("matrix product", f"not measured: {error}")

    def measure_rate() -> None:
        for worker in list(workers):
            try:
                for precision in precisions:
                    rates.setdefault(precision, []).append(worker.matmul_gflop_per_s(precision))
            except ContenderError as error:
                workers.remove(worker)
                session.note("matrix product", f"no longer measured: {error}")

    return measure_rate
