"""The contenders of a run, each in its process, built and ready to be measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from hudepth.bench.backends import BACKENDS, GRAPHS, ONNX, PRODUCT, missing
from hudepth.bench.images import images_file
from hudepth.bench.rows import Entry, spelt
from hudepth.bench.worker import ContenderError, Spec, Worker


@dataclass(frozen=True)
class Subject:
    """The network that is measured."""

    name: str
    """Class of the network."""
    model: dict[str, Any]
    """Its configuration."""
    trust: list[str]
    state: Path
    """File of its tensors."""
    size: tuple[int, int]
    """(height, width) of its images."""
    max_depth_m: float
    parameters: int
    flops: int
    """Of an image, of the network as it was trained."""
    merged_flops: int
    """Of an image, of the form that predicting and testing use."""


@dataclass
class Field:
    """Who takes part in a run; use as a context manager, which ends all processes."""

    subject: Subject
    folder: Path
    """For files that last as long as the run."""
    threads: int
    """Of each contender."""
    device: str
    """Of those in PyTorch."""
    note: Callable[[str, str], None]
    """Takes what must be said under the table: name of a contender, line."""
    entries: list[Entry] = field(default_factory=list)
    workers: list[Worker] = field(default_factory=list)

    def __enter__(self) -> Field:
        self._stack, self._started = ExitStack(), list[tuple[Worker, Entry]]()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker, _ in self._started:  # all at once: libraries take seconds to tidy up
            worker.dismiss()
        self._stack.close()

    def enter(self, backends: Sequence[str], peers: Sequence[str] = ()) -> int:
        """Start all processes, which import side by side; what is not installed is a note.

        Args:
            backends: of :data:`hudepth.bench.backends.BACKENDS`.
            peers: of :data:`hudepth.bench.peers.PEERS`, each at the size nearest to this network's and at its own.

        Returns:
            How many :meth:`build` builds.
        """
        for name in backends:
            if self._is_here(name, BACKENDS[name].packages, BACKENDS[name].extras):
                self._start_backend(name)
        for label in peers:
            self._start_peer(label)
        return len(self._started)

    def build(self) -> Iterator[None]:
        """Build one after the other; yield after each. What cannot be built is a note."""
        for worker, entry in self._started:
            try:
                graph = BACKENDS[entry.name].graph if not entry.peer else None
                if graph is not None:
                    self._make(graph)
                described = worker.build()
            except ContenderError as error:
                worker.close()
                self.note(entry.name, f"cannot be built: {error}")
            else:
                self._take(worker, entry, described)
            yield

    def product(self) -> Worker:
        """Return a process that multiplies matrices, which is no contender.

        Raises:
            ContenderError: if it cannot be made.
        """
        spec = Spec("matrix product", PRODUCT, self._images(), self.threads, {"device": self.device})
        worker = self._stack.enter_context(self._worker(spec))
        worker.build()
        return worker

    def _start_backend(self, name: str) -> None:
        backend, subject = BACKENDS[name], self.subject
        options = {**self._of_network(), **backend.options}
        if backend.graph is not None:
            options["graph"] = str(self.folder / backend.graph)
        entry = Entry(name, name, subject.size, False, subject.parameters, subject.flops, backend.what)
        self._start(Spec(name, backend.factory, self._images(), self.threads, options), entry)

    def _start_peer(self, label: str) -> None:
        from hudepth.bench.peers import PEERS

        peer = PEERS[label]
        if not self._is_here(label, (peer.package,) if peer.package else (), "peers"):
            return
        for size in dict.fromkeys((peer.nearest(self.subject.size), peer.native)):
            name = f"{label}, {spelt(size)}"
            options = {"peer": label, "size": size, "device": self.device}
            spec = Spec(name, "hudepth.bench.peers:PeerRunner", self._images(size), self.threads, options)
            self._start(spec, Entry(name, label, size, True, None, None, ""))

    def _start(self, spec: Spec, entry: Entry) -> None:
        self._started.append((self._stack.enter_context(self._worker(spec)), entry))

    def _take(self, worker: Worker, entry: Entry, described: dict[str, Any]) -> None:
        if entry.peer:
            count, flops = described["parameters"], described["flops"]
            about = (
                f"random weights, eager, {described['layout']}; {count:,} parameters, {flops / 1e9:.2f} GFLOP an image"
            )
            entry = replace(entry, parameters=count, flops=flops, about=about)
        self.workers.append(worker)
        self.entries.append(entry)

    def _make(self, graph: str) -> Path:
        """Return a graph's file; it is made if it is not there.

        Raises:
            ContenderError: if it cannot be made.
        """
        path = self.folder / graph
        if not path.exists():
            options = {
                **self._of_network(), "graph": str(path), "name": self.subject.name,
                "max_depth_m": self.subject.max_depth_m,
            }  # fmt: skip
            if graph != ONNX:
                options["onnx"] = str(self._make(ONNX))
            with self._worker(Spec(graph, GRAPHS[graph], self._images(), self.threads, options)) as maker:
                maker.build()
        return path

    def _of_network(self) -> dict[str, Any]:
        subject = self.subject
        return {
            "model": subject.model, "trust": subject.trust, "state": str(subject.state), "size": subject.size,
            "device": self.device,
        }  # fmt: skip

    def _worker(self, spec: Spec) -> Worker:
        return Worker(spec, log=self.folder / "printed.log")

    def _images(self, size: tuple[int, int] | None = None) -> Path:
        return images_file(self.folder, size or self.subject.size)

    def _is_here(self, name: str, packages: Sequence[str], extras: str) -> bool:
        line = missing(packages, extras)
        if line:
            self.note(name, line)
        return not line
