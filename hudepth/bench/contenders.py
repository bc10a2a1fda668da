"""The contenders of a run, each in a process of its own, built and ready to be measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hudepth.bench.backends import BACKENDS, GRAPHS, ONNX, PRODUCT, missing
from hudepth.bench.images import images_file
from hudepth.bench.rows import Entry
from hudepth.bench.subject import Subject
from hudepth.bench.worker import ContenderError, Spec, Worker


@dataclass
class Contenders:
    """All contenders of a run; use as a context manager, which ends all processes."""

    subject: Subject
    folder: Path
    """For files that last as long as the run."""
    threads: int
    """Of each contender."""
    device: str
    """Of those in PyTorch."""
    note: Callable[[str, str], None]
    """Takes a line about a contender for the notes under the table: its name, the line."""
    entries: list[Entry] = field(default_factory=list)
    workers: list[Worker] = field(default_factory=list)
    """Those that were built."""
    started: list[tuple[Worker, Entry]] = field(default_factory=list)

    def __enter__(self) -> Contenders:
        self._stack = ExitStack()
        return self

    def __exit__(self, *_: object) -> None:
        for worker, _entry in self.started:  # all at once: libraries take seconds to shut down
            worker.dismiss()
        self._stack.close()

    def enter(self, backends: Sequence[str]) -> None:
        """Start the processes of :data:`hudepth.bench.backends.BACKENDS`; a backend that is not installed is a note."""
        subject = self.subject
        for name in backends:
            backend = BACKENDS[name]
            if line := missing(backend.packages, backend.extras):
                self.note(name, line)
                continue
            options = {**self._network_options(), **backend.options}
            if backend.graph is not None:
                options["graph"] = str(self.folder / backend.graph)
            entry = Entry(name, name, subject.size, backend.about, subject.parameters, subject.flops)
            self.start(entry, backend.factory, options)

    def start(self, entry: Entry, factory: str, options: dict[str, Any]) -> None:
        """Start the process of a contender, which imports what it needs meanwhile.

        Args:
            entry: names it and the size of its images.
            factory: ``module:function`` that returns its :class:`hudepth.bench.worker.Runner`.
            options: of the factory.
        """
        spec = Spec(entry.name, factory, images_file(self.folder, entry.size), self.threads, options)
        self.started.append((self._stack.enter_context(self._worker(spec)), entry))

    def build(self) -> Iterator[None]:
        """Build one after the other; yield after each. What cannot be built is a note."""
        for worker, entry in self.started:
            try:
                if entry.name in BACKENDS and (graph := BACKENDS[entry.name].graph):
                    self._make_graph(graph)
                described = worker.build()
            except ContenderError as error:
                worker.close()
                self.note(entry.name, f"cannot be built: {error}")
            else:
                self.workers.append(worker)
                self.entries.append(replace(entry, **described))
            yield

    def product(self) -> Worker:
        """Return a process that multiplies matrices, which is not a contender.

        Raises:
            ContenderError: if it cannot be built.
        """
        images = images_file(self.folder, self.subject.size)
        spec = Spec("matrix product", PRODUCT, images, self.threads, {"device": self.device})
        worker = self._stack.enter_context(self._worker(spec))
        worker.build()
        return worker

    def _make_graph(self, name: str) -> Path:
        """Return a graph's file; it is made if it does not exist."""
        path, subject = self.folder / name, self.subject
        if not path.exists():
            options = {
                **self._network_options(), "graph": str(path), "name": subject.name, "max_depth_m": subject.max_depth_m
            }  # fmt: skip
            if name != ONNX:
                options["onnx"] = str(self._make_graph(ONNX))
            spec = Spec(name, GRAPHS[name], images_file(self.folder, subject.size), self.threads, options)
            with self._worker(spec) as maker:
                maker.build()
        return path

    def _network_options(self) -> dict[str, Any]:
        subject = self.subject
        return {
            "model": subject.model, "trust": subject.trust, "state": str(subject.state), "size": subject.size,
            "device": self.device,
        }  # fmt: skip

    def _worker(self, spec: Spec) -> Worker:
        return Worker(spec, log=self.folder / "printed.log")
