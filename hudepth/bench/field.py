"""The contenders of a run, each in its process, built and ready to be measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from hudepth.bench.backends import BACKENDS, GRAPHS, PRODUCT, missing
from hudepth.bench.images import images_file
from hudepth.bench.rows import Entry
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
        self._stack = ExitStack()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def enter_backend(self, name: str) -> None:
        """Add a backend; one that is not installed or cannot be built is a note.

        Args:
            name: of :data:`hudepth.bench.backends.BACKENDS`.
        """
        backend = BACKENDS[name]
        if not self._is_here(name, backend.packages, backend.extras):
            return
        options = {**self._of_network(), **backend.options}
        if backend.graph is not None:
            try:
                options["graph"] = str(self._graph(backend.graph))
            except ContenderError as error:
                self.note(name, f"left out, since its graph cannot be made: {error}")
                return
        subject = self.subject
        entry = Entry(name, name, subject.size, False, subject.parameters, subject.flops)
        self._enter(Spec(name, backend.factory, self._images(), self.threads, options), entry)

    def enter_peer(self, label: str) -> None:
        """Add another network, at the size nearest to this one's and at its own.

        Args:
            label: of :data:`hudepth.bench.peers.PEERS`.
        """
        from hudepth.bench.peers import PEERS

        peer = PEERS[label]
        if not self._is_here(label, (peer.package,) if peer.package else (), "peers"):
            return
        for size in dict.fromkeys((peer.nearest(self.subject.size), peer.native)):
            name = f"{label}, {size[0]} x {size[1]}"
            options = {"peer": label, "size": size, "device": self.device}
            spec = Spec(name, "hudepth.bench.peers:PeerRunner", self._images(size), self.threads, options)
            self._enter(spec, Entry(name, label, size, True, None, None))

    def product(self) -> Worker:
        """Return a process that multiplies matrices, which is no contender.

        Raises:
            ContenderError: if it cannot be made.
        """
        spec = Spec("matrix product", PRODUCT, self._images(), self.threads, {"device": self.device})
        worker = self._stack.enter_context(self._worker(spec))
        worker.build()
        return worker

    def _enter(self, spec: Spec, entry: Entry) -> None:
        worker = self._stack.enter_context(self._worker(spec))
        try:
            described = worker.build()
        except ContenderError as error:
            worker.close()
            self.note(entry.name, f"cannot be built: {error}")
            return
        if entry.peer:
            entry = replace(entry, parameters=described["parameters"], flops=described["flops"])
            self.note(entry.name, f"random weights, eager, {described['layout']}")
        self.workers.append(worker)
        self.entries.append(entry)

    def _graph(self, name: str) -> Path:
        """Return a graph's file; it is made if it is not there."""
        path = self.folder / name
        if not path.exists():
            options = {
                **self._of_network(), "graph": str(path), "name": self.subject.name,
                "max_depth_m": self.subject.max_depth_m,
            }  # fmt: skip
            if name != "model.onnx":
                options["onnx"] = str(self._graph("model.onnx"))
            with self._worker(Spec(name, GRAPHS[name], self._images(), self.threads, options)) as maker:
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
