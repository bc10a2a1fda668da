"""The contenders of a run, each in a process of its own, built and ready to be measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hudepth.bench.backends import BACKENDS, GRAPHS, ON_GPU, ONNX, PRODUCT, lacking
from hudepth.bench.images import images_file
from hudepth.bench.rows import Entry
from hudepth.bench.subject import Subject
from hudepth.bench.worker import ContenderError, Spec, Worker


@dataclass
class Contenders:
    """All contenders of a run, with files in ``folder``; use as a context manager, which ends all processes."""

    subject: Subject
    folder: Path
    threads: int
    device: str
    """Of those in PyTorch."""
    note: Callable[[str, str], None]
    """Takes a contender's name and a line about it for the notes."""
    entries: list[Entry] = field(default_factory=list)
    workers: list[Worker] = field(default_factory=list)
    """Those that were built."""
    started: list[tuple[Worker, Entry]] = field(default_factory=list)
    _graphs: dict[str, tuple[str, Subject]] = field(default_factory=dict)
    """What must be exported for a contender: the graph, and the network."""
    _stack: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Contenders:
        return self

    def __exit__(self, *_: object) -> None:
        for worker, _entry in self.started:  # all at once: libraries take seconds to shut down
            worker.dismiss()
        self._stack.close()

    def enter(self, backends: Sequence[str], *, rival: Subject | None = None) -> None:
        """Start the processes of :data:`hudepth.bench.backends.BACKENDS`; what is lacking is a note.

        They run a ``rival`` instead of the subject if one is given, whose file lies in a folder of its own.
        """
        subject = rival or self.subject
        for backend_name in backends:
            backend = BACKENDS[backend_name]
            name = f"{rival.name}, {backend_name}" if rival else backend_name
            if line := lacking(backend, self.device):
                self.note(name, line)
                continue
            options = {**self._network_options(subject), "precision": backend.precision, **backend.options}
            if backend.provider:
                options["provider"] = backend.provider
            if backend.graph is not None:
                options["graph"] = str(subject.state.parent / backend.graph)
                self._graphs[name] = (backend.graph, subject)
            yardstick: str | None = "float32"
            if self.device == "cuda":  # what runs on the CPU has none there
                yardstick = backend.precision if backend_name in ON_GPU else None
            entry = Entry(
                name, name, subject.size, backend.about, subject.parameters, subject.flops,
                kind="peer" if rival else "backend", precision=backend.precision, yardstick=yardstick,
            )  # fmt: skip
            self.start(entry, backend.factory, options)

    def start(self, entry: Entry, factory: str, options: dict[str, Any]) -> None:
        """Start the process of a contender; ``factory`` is the ``module:function`` of its Runner, with its options."""
        worker = self._worker(entry.name, factory, options, size=entry.size)
        self.started.append((self._stack.enter_context(worker), entry))

    def build(self) -> Iterator[None]:
        """Build one after the other; yield after each. What cannot be built is a note."""
        for worker, entry in self.started:
            try:
                if entry.name in self._graphs:
                    self._make_graph(*self._graphs[entry.name])
                described = worker.build()
            except ContenderError as error:
                worker.close()
                self.note(entry.name, f"cannot be built: {error}")
            else:
                self.workers.append(worker)
                self.entries.append(replace(entry, **described))
            yield

    def product(self) -> Worker:
        """Return a process that multiplies matrices; raises ContenderError if it cannot be built."""
        worker = self._stack.enter_context(self._worker("matrix product", PRODUCT, {"device": self.device}))
        worker.build()
        return worker

    def _make_graph(self, name: str, subject: Subject) -> Path:
        """Return a graph's file; it is made if it does not exist."""
        path = subject.state.parent / name
        if not path.exists():
            info = {"graph": str(path), "name": subject.name, "max_depth_m": subject.max_depth_m}
            options = {**self._network_options(subject), **info}
            if name != ONNX:
                options["onnx"] = str(self._make_graph(ONNX, subject))
            with self._worker(name, GRAPHS[name], options) as maker:
                maker.build()
        return path

    def _network_options(self, subject: Subject) -> dict[str, Any]:
        shared = {key: getattr(subject, key) for key in ("model", "trust", "size")}
        return {**shared, "state": str(subject.state), "device": self.device}

    def _worker(
        self, name: str, factory: str, options: dict[str, Any], *, size: tuple[int, int] | None = None
    ) -> Worker:
        images = images_file(self.folder, size or self.subject.size)
        return Worker(Spec(name, factory, images, self.threads, options), log=self.folder / "printed.log")
