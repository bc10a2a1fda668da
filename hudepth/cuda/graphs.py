"""Record what a function launches on a GPU, and launch it all at once from then on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import torch

WARM_UPS = 3
"""How often a function runs as usual before it is recorded: libraries choose algorithms and allocate memory then."""


class Recording(NamedTuple):
    """A CUDA graph; ``replay`` computes, into the memory of ``results`` and whatever else the function changes."""

    replay: Callable[[], None]
    results: Any
    pool: Any
    """Memory that further recordings may share, as long as nobody reads the results of one after another ran."""


def has_graphs(device: torch.device) -> bool:
    """Return whether this kind of device can record."""
    return device.type == "cuda"


_streams: dict[int, torch.cuda.Stream] = {}
_generation = 0


def generation() -> int:
    """Return a number that is part of every recording's key: recordings of an earlier one are not replayed."""
    return _generation


def forget() -> None:
    """Make all recordings so far void: Lightning frees memory of libraries that they use when a Trainer ends."""
    global _generation
    _generation += 1


@contextmanager
def beside() -> Iterator[torch.cuda.Stream]:
    """Run on the stream that records: what a library or autograd sets up for a stream then exists there."""
    device = torch.cuda.current_device()
    if device not in _streams:
        _streams[device] = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream = _streams[device]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        yield stream
    torch.cuda.current_stream().wait_stream(stream)


def record(function: Callable[[], Any], *, pool: Any = None) -> Recording:
    """Record a function that ran :data:`WARM_UPS` times in :func:`beside`; nothing is computed yet.

    Everything it reads must stay where it is. Raises RuntimeError if the function waits for the device, as ``.item()``
    does, or takes more memory than there is; whatever else it raises, too.
    """
    graph, pool = torch.cuda.CUDAGraph(), pool or torch.cuda.graph_pool_handle()
    try:
        with beside() as stream, torch.cuda.graph(graph, pool=pool, stream=stream, capture_error_mode="thread_local"):
            results = function()
    except Exception as error:
        _close(pool)
        hidden = (
            error.__context__ if "captur" in str(error).lower() else None
        )  # the end of a failed recording fails, too
        raise (hidden if isinstance(hidden, Exception) else error) from None
    return Recording(graph.replay, results, pool)


def _close(pool: Any) -> None:
    """Tell the allocator that a recording ended: torch does not if it failed, and nothing would be freed any more."""
    device = torch.cuda.current_device()
    for name in ("_cuda_endAllocateToPool", "_cuda_releasePool"):
        with suppress(AttributeError, RuntimeError):  # ended after all, or another version of torch
            getattr(torch._C, name)(device, pool)


def used_share(device: torch.device) -> float:
    """Return the most memory that tensors took so far, over what the device has."""
    if device.type != "cuda":
        return 0.0
    return torch.cuda.max_memory_allocated(device) / torch.cuda.mem_get_info(device)[1]


def host_memory(like: torch.Tensor) -> torch.Tensor:
    """Return memory of the host that is page-locked, without which a copy from or to it cannot be recorded."""
    return torch.empty(like.shape, dtype=like.dtype, pin_memory=True)


def wait() -> None:
    """Wait for the device to finish what this thread launched."""
    torch.cuda.current_stream().synchronize()
