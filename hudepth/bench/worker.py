"""A contender in a process of its own: own threads, own memory, idle until it gets a command."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import time
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hudepth.bench.memory import peak_mb, reset_peak

LIMIT_S = 900
"""The longest wait for an answer; compiling a large network for a batch size takes a minute or two."""


class ContenderError(Exception):
    """A contender failed; the message says why, for a note under the table."""


@dataclass(frozen=True)
class Spec:
    """What a process runs."""

    name: str
    factory: str
    """``module:function`` that takes this specification and returns a :class:`Runner`."""
    images: Path
    """A .npy file of normalised images, float32 [n, 3, h, w]; a batch repeats them as often as it needs."""
    threads: int
    options: dict[str, Any] = field(default_factory=dict)
    """Further arguments of the factory."""


class Runner:
    """What a contender computes with."""

    def describe(self) -> dict[str, Any]:
        """Return what only the process knows."""
        return {}

    def load(self, images: NDArray[np.float32]) -> None:
        """Set the batch [b, 3, h, w] of all following passes, in whatever layout suits."""
        raise NotImplementedError

    def run(self) -> None:
        """Compute one pass; it is finished when this returns."""
        raise NotImplementedError

    def result(self) -> NDArray[np.float32]:
        """Return the output of the last pass."""
        raise NotImplementedError

    def reset_peak(self) -> None:
        """Restart the peak of the memory."""
        reset_peak()

    def peak_mb(self) -> float:
        """Return the peak memory [MB]."""
        return peak_mb()


class Begun(NamedTuple):
    """The result of the first pass at a batch size, and its time, compiling and allocating included."""

    first_pass_s: float
    result: NDArray[np.float32]


class Worker(AbstractContextManager["Worker"]):
    """The parent's end of a process, which imports at once and then waits for commands; it prints to the file ``log``.

    Every command raises ContenderError if it fails.
    """

    def __init__(self, spec: Spec, *, log: Path) -> None:
        self.spec, self.name = spec, spec.name
        context = multiprocessing.get_context("spawn")  # forked threads of torch would hang
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, spec, log), daemon=True)
        self._process.start()
        theirs.close()  # so that the end of the process closes the pipe

    def __exit__(self, *_: object) -> None:
        self.close()

    def build(self) -> dict[str, Any]:
        """Build the runner; return its description."""
        return dict(self._ask("build"))

    def begin(self, batch: int) -> Begun:
        """Switch to a batch size: two untimed passes; the peak memory restarts."""
        return Begun(*self._ask("begin", batch))

    def turn(self, seconds: float) -> list[float]:
        """Return the times [s] of passes: one untimed, then as many as fit into ``seconds``, at least one."""
        return list(self._ask("turn", seconds))

    def peak_mb(self) -> float:
        """Return the peak memory [MB] since the last :meth:`begin`."""
        return float(self._ask("peak_mb"))

    def matmul_gflop_per_s(self, precision: str) -> float:
        """Return the best rate of several matrix products; only for :data:`hudepth.bench.backends.PRODUCT`."""
        return float(self._ask("matmul_gflop_per_s", precision))

    def dismiss(self) -> None:
        """Let the process end after its current command, without waiting for it."""
        with suppress(OSError):
            self._pipe.send(("close",))

    def close(self) -> None:
        """End the process, whatever it is doing; calling it again does nothing."""
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
            raise ContenderError(_describe_exit(self._process.exitcode)) from error
        if not good:
            raise ContenderError(value)
        return value


def _describe_exit(code: int | None) -> str:
    if code is not None and code < 0:
        with suppress(ValueError):
            killed = signal.Signals(-code).name
            return f"its process was ended by {killed}" + (" (memory?)" if killed == "SIGKILL" else "")
    return f"its process ended with code {code}"


def serve(pipe: Connection, spec: Spec, log: Path) -> None:
    """Answer commands until the parent sends ``close`` or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its workers
    _silence(log)
    server = _Server(spec)
    with suppress(EOFError, OSError):
        while (message := pipe.recv())[0] != "close":
            try:
                pipe.send((True, getattr(server, message[0])(*message[1:])))
            except Exception as error:
                pipe.send((False, summarise_error(error)))


def summarise_error(error: BaseException) -> str:
    """Return an error as one line of at most 200 characters."""
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {first}"[:200] if first else type(error).__name__


def _silence(log: Path) -> None:
    """Redirect whatever is printed to a file, by libraries in other languages too."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        stream.flush()
        os.dup2(descriptor, number)
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
        except Exception as error:  # reported by build
            self.failed = error

    def build(self) -> dict[str, Any]:
        if self.failed is not None:
            raise self.failed
        self.runner: Runner = getattr(self.module, self.function)(self.spec)
        self.images = np.load(self.spec.images)
        return dict(self.runner.describe())

    def begin(self, batch: int) -> Begun:
        self.runner.reset_peak()
        self.runner.load(self.images[np.arange(batch) % len(self.images)])
        first = self._time_pass()
        self.runner.run()
        return Begun(first, self.runner.result())

    def turn(self, seconds: float) -> list[float]:
        self.runner.run()
        times = [self._time_pass()]
        while sum(times) < seconds:
            times.append(self._time_pass())
        return times

    def __getattr__(self, command: str) -> Any:
        return getattr(self.__dict__.get("runner"), command)

    def _time_pass(self) -> float:
        start = time.perf_counter()
        self.runner.run()
        return time.perf_counter() - start
