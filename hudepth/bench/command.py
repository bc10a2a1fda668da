"""hudepth-bench: speed and memory of a model on this machine, in every backend, beside other networks."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig

from hudepth.base.console import log, track
from hudepth.base.errors import ConfigError
from hudepth.base.options import plain
from hudepth.bench.field import Field, Subject
from hudepth.bench.output import Measured, write
from hudepth.bench.plan import Plan, make_plan
from hudepth.bench.rounds import Session
from hudepth.bench.subject import make_subject
from hudepth.bench.worker import ContenderError


def bench(cfg: DictConfig) -> None:
    """Measure, print the table, write bench.json, bench.csv, bench.md and bench.png.

    Args:
        cfg: what conf/bench.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user; a backend that is missing or fails is none, but a note.
    """
    config = plain(cfg)
    plan, trained = make_plan(config), config["checkpoint"] is not None
    torch.set_num_threads(plan.threads)
    with tempfile.TemporaryDirectory(prefix="hudepth-bench-") as made:
        subject = make_subject(config, Path(made))
        log.info(
            "%s of %s parameters, %d x %d, %s; %s; each in a process of its own, threads: %d",
            subject.name, f"{subject.parameters:,}", *subject.size, "trained" if trained else "random weights",
            ", ".join(plan.backends), plan.threads,
        )  # fmt: skip
        measured = _measure(plan, subject, Path(made), trained=trained)
    if not measured.session.samples:
        raise ConfigError(f"nothing could be measured. {' '.join(measured.notes)}")
    try:
        write(measured)
    except OSError as error:
        raise ConfigError(
            f"output: cannot write to '{plan.output}' ({error.strerror or error}). Make space."
        ) from error


def _measure(plan: Plan, subject: Subject, folder: Path, *, trained: bool) -> Measured:
    """Build all contenders, then go round."""
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
    return Measured(plan, subject, trained, field.entries, session, rates)


def _peers() -> Sequence[str]:
    from hudepth.bench.peers import PEERS

    return list(PEERS)


def _product(field: Field, session: Session, rates: list[float]) -> Callable[[], None]:
    """Return what adds the rate of a matrix product to ``rates``; once it fails, the table does without."""
    workers = []
    try:
        workers.append(field.product())
    except ContenderError as error:
        session.note("matrix product", f"not measured: {error}")

    def measure() -> None:
        for worker in list(workers):
            try:
                rates.append(worker.matmul_gflop_per_s())
            except ContenderError as error:
                workers.remove(worker)
                session.note("matrix product", f"not measured any more: {error}")

    return measure
