"""Stand-ins for devices that the machine lacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from hudepth.base import masked
from hudepth.cuda import graphs

_WAITING = {
    torch.ops.aten._local_scalar_dense.default, torch.ops.aten.nonzero.default, torch.ops.aten.masked_select.default,
    torch.ops.aten.is_nonzero.default, torch.ops.aten.equal.default,
    torch.ops.aten.item.default,  # under inference_mode it comes as one operation
}  # fmt: skip
"""Operations for whose result the host waits."""


class _NoFloat64(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for x in tree_leaves(result):
            assert not (isinstance(x, Tensor) and x.dtype == torch.float64), func
        return result


@contextmanager
def without_float64() -> Iterator[None]:
    """Treat the CPU as a device without float64, as MPS is: fail where an operation returns it."""
    with mock.patch.object(masked, "WITHOUT_FLOAT64", {"cpu"}), _NoFloat64():
        yield


class _Recorder(TorchDispatchMode):
    """Notes every operation with the tensors it reads and writes, and what those held that it overwrites."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[tuple[Any, Any, Any, Any]] = []
        self.overwritten: dict[int, tuple[Any, Any]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in _WAITING:
            raise RuntimeError(f"{func}: operation not permitted when stream is capturing")
        args, kwargs = tree_map(lambda x: x, (args, kwargs or {}))  # callers reuse their lists
        for argument, value in zip(func._schema.arguments, args, strict=False):
            written = argument.alias_info is not None and argument.alias_info.is_write
            if written or argument.name in ("running_mean", "running_var"):  # which batch norm does not declare
                for x in tree_leaves(value):
                    storage = x.untyped_storage()
                    self.overwritten.setdefault(storage.data_ptr(), (storage, storage.clone()))
        result = func(*args, **kwargs)
        self.operations.append((func, args, kwargs, result))
        return result


def _record(function: Callable[[], Any], *, pool: Any = None) -> graphs.Recording:
    """Record a function on the CPU as a CUDA graph does: nothing has happened until the first replay."""
    random = torch.get_rng_state()
    try:
        with (recorder := _Recorder()):
            results = function()
    finally:
        torch.set_rng_state(random)
        for storage, before in recorder.overwritten.values():
            storage.copy_(before)

    inference = torch.is_inference_mode_enabled()

    @torch.no_grad()
    def replay() -> None:
        with torch.inference_mode() if inference else nullcontext():
            for func, args, kwargs, result in recorder.operations:
                for old, new in zip(tree_leaves(result), tree_leaves(func(*args, **kwargs)), strict=True):
                    if isinstance(old, Tensor) and old.untyped_storage().data_ptr() != new.untyped_storage().data_ptr():
                        old.copy_(new)

    return graphs.Recording(replay, results, None)


@contextmanager
def with_graphs() -> Iterator[None]:
    """Treat the CPU as a device that records CUDA graphs: numbers are part of a recording, memory is not."""
    with (
        mock.patch.object(graphs, "has_graphs", return_value=True),
        mock.patch.object(graphs, "beside", nullcontext),
        mock.patch.object(graphs, "record", _record),
        mock.patch.object(graphs, "host_memory", torch.empty_like),
        mock.patch.object(graphs, "wait"),
    ):
        yield


class _StayingThere(TorchDispatchMode):
    def __init__(self, device: str) -> None:
        super().__init__()
        self.device = device

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for x in tree_leaves(result):
            assert not isinstance(x, Tensor) or x.device.type == self.device, f"{func} on {x.device}"
        return result


def staying_on(device: str) -> TorchDispatchMode:
    """Fail where an operation returns a tensor elsewhere: copying it to the device later would wait for the device."""
    return _StayingThere(device)


_GUESSING = {
    "adaptive_max_pool2d_backward", "_adaptive_avg_pool2d_backward", "avg_pool3d_backward", "grid_sampler_2d_backward",
    "histc", "kthvalue", "nll_loss2d_forward", "put", "put_", "reflection_pad2d_backward", "replication_pad1d_backward",
    "upsample_bicubic2d_backward", "upsample_bilinear2d_backward", "upsample_linear1d_backward",
}  # fmt: skip
"""Operations without a deterministic version on GPUs; see torch.use_deterministic_algorithms."""


class _Deterministic(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        assert name not in _GUESSING, func
        weights = kwargs.get("weights", args[1] if len(args) > 1 else None)
        assert not (name == "bincount" and weights is not None), func
        assert not (name == "median" and func._overloadname == "dim"), func
        result = func(*args, **kwargs)
        assert not (name in ("cumsum", "cumsum_") and result.is_floating_point()), func
        return result


def deterministic() -> TorchDispatchMode:
    """Fail where an operation would have no deterministic version on a GPU."""
    return _Deterministic()
