"""Stand-ins for devices that the machine lacks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from hudepth.base import masked


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
