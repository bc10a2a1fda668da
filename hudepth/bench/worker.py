"""A contender in a process of its own: own threads, own memory, silent until it is asked."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hudepth.bench.memory import peak_mb, reset_peak

LIMIT_S = 900
"""How long an answer may take; compiling a large network for a batch size takes a minute or two."""


class ContenderError(Exception):
    """A contender could not go on; its message says why, for a note under the table."""


@dataclass(frozen=True)
class Spec:
    """What a process is to run."""

    name: str
    factory: str
    """``module:function`` that takes this specification and returns a :class:`Runner`."""
    images: Path
    """A .npy file of normalised images, float32 [n, 3, h, w]; a batch is the first of them, over and over."""
    threads: int
    options: dict[str, Any] = field(default_factory=dict)
    """What else the factory wants."""


class Runner(Protocol):
    """What a contender computes with."""

    def describe(self) -> dict[str, Any]:
        """Return what only the process knows: of peers ``parameters``, ``flops`` and ``layout``."""
        ...

    def load(self, images: NDArray[np.float32]) -> None:
        """Take the batch [b, 3, h, w] that all passes from now on are of, in whatever layout suits."""
        ...

    def run(self) -> None:
        """Compute a pass; it is over when this returns."""
        ...

    def result(self) -> NDArray[np.float32]:
        """Return what the last pass gave."""
        ...


@dataclass(frozen=True)
class Begun:
    """What the first pass at a batch size told."""

    first_pass_s: float
    """Compiling and allocating included."""
    result: NDArray[np.float32]


class Worker:
    """The parent's end of a process; use as a context manager.

    Args:
        spec: what it runs. It starts to import what that needs at once; all else waits for a command.
        log: file for whatever its libraries print.
    """

    def __init__(self, spec: Spec, *, log: Path) -> None:
        self.spec, self.name = spec, spec.name
        context = multiprocessing.get_context("spawn")  # forked threads of torch would hang
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, spec, log), daemon=True)
        self._process.start()
        theirs.close()  # so that its end is noticed

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def build(self) -> dict[str, Any]:
        """Build the runner; return what it says of itself.

        Raises:
            ContenderError: if it fails, as with all commands.
        """
        described: dict[str, Any] = self._ask("build")
        return described

    def begin(self, batch: int) -> Begun:
        """Turn to a batch size: two untimed passes, and memory is counted anew."""
        begun: Begun = self._ask("begin", batch)
        return begun

    def turn(self, seconds: float) -> list[float]:
        """Return times [s] of passes: one untimed, then as many as fit into ``seconds``, at least one."""
        times: list[float] = self._ask("turn", seconds)
        return times

    def peak_mb(self) -> float:
        """Return the most memory [MB] held since the last :meth:`begin`."""
        peak: float = self._ask("peak_mb")
        return peak

    def matmul_gflop_per_s(self) -> float:
        """Return the best rate of several products of matrices, where that is what the process is for."""
        rate: float = self._ask("matmul_gflop_per_s")
        return rate

    def dismiss(self) -> None:
        """Let the process end after what it is doing, without waiting for it."""
        with suppress(OSError):
            self._pipe.send(("close",))

    def close(self) -> None:
        """End the process, whatever it is doing; a second time does nothing."""
        self.dismiss()
        self._process.join(2)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()

    def _ask(self, command: str, *arguments: Any) -> Any:
        try:
            self._pipe.send((command, *arguments))
            if not self._pipe.poll(LIMIT_S):
                raise ContenderError(f"no answer for {LIMIT_S} s")
            good, value = self._pipe.recv()
        except (EOFError, OSError) as error:
            self._process.join(5)
            raise ContenderError(_end(self._process.exitcode)) from error
        if not good:
            raise ContenderError(value)
        return value


def _end(code: int | None) -> str:
    if code is not None and code < 0:
        with suppress(ValueError):
            killed = signal.Signals(-code).name
            return f"its process was ended by {killed}" + (" (memory?)" if killed == "SIGKILL" else "")
    return f"its process ended with code {code}"


def serve(pipe: Connection, spec: Spec, log: Path) -> None:
    """Answer commands until the parent says ``close`` or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent sees to its workers
    _silence(log)
    server = _Server(spec)
    with suppress(EOFError, OSError):
        while (message := pipe.recv())[0] != "close":
            try:
                answer: Callable[..., Any] = getattr(server, message[0])
                pipe.send((True, answer(*message[1:])))
            except Exception as error:
                pipe.send((False, said(error)))


def said(error: BaseException) -> str:
    """Return an error in one line of moderate length."""
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {first}"[:200] if first else type(error).__name__


def _silence(log: Path) -> None:
    """Send what is printed, by libraries in other languages, too, to a file."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.close(descriptor)


class _Server:
    """The commands, in the worker."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        module, _, self.function = spec.factory.partition(":")
        os.environ["OMP_NUM_THREADS"] = str(spec.threads)  # read when the libraries are imported
        self.failed: Exception | None = None
        try:
            self.module = importlib.import_module(module)
        except Exception as error:  # told when the first command asks for it
            self.failed = error

    def build(self) -> dict[str, Any]:
        if self.failed is not None:
            raise self.failed
        self.runner: Runner = getattr(self.module, self.function)(self.spec)
        self.images = np.load(self.spec.images)
        described: dict[str, Any] = self.runner.describe()
        return described

    def begin(self, batch: int) -> Begun:
        images = self.images[np.arange(batch) % len(self.images)]
        reset_peak()
        getattr(self.runner, "reset_peak", lambda: None)()
        self.runner.load(images)
        first = self._timed()
        self.runner.run()
        return Begun(first, self.runner.result())

    def turn(self, seconds: float) -> list[float]:
        self.runner.run()
        times = [self._timed()]
        while sum(times) < seconds:
            times.append(self._timed())
        return times

    def peak_mb(self) -> float:
        own = getattr(self.runner, "peak_mb", None)  # of a GPU
        return float((own and own()) or peak_mb())

    def matmul_gflop_per_s(self) -> float:
        return float(self.runner.matmul_gflop_per_s())  # type: ignore[attr-defined]

    def _timed(self) -> float:
        start = time.perf_counter()
        self.runner.run()
        return time.perf_counter() - start
