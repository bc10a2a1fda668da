"""Activations that are computed twice instead of kept: less memory for more time (Chen et al. 2016)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

from torch import nn
from torch.utils.checkpoint import checkpoint


def recomputed(module: nn.Module, *inputs: Any) -> Any:
    """Return ``module(*inputs)``, and keep of it only what the gradients cannot be computed without.

    The second pass leaves the statistics of batch norm alone, so that training goes exactly as it would have gone.
    """

    def contexts() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
        return nullcontext(), _statistics_kept(module)

    random = any(isinstance(each, nn.modules.dropout._DropoutNd) for each in module.modules())
    # Keeping the generators' state would wait for a GPU, and could not be part of a CUDA graph.
    return checkpoint(module, *inputs, use_reentrant=False, context_fn=contexts, preserve_rng_state=random)


@contextmanager
def _statistics_kept(module: nn.Module) -> Iterator[None]:
    norms = [norm for norm in module.modules() if isinstance(norm, nn.modules.batchnorm._BatchNorm)]
    kept = [(norm, norm.momentum, norm.num_batches_tracked) for norm in norms]
    for norm, _, count in kept:
        norm.momentum = 0.0
        norm.num_batches_tracked = None if count is None else count.clone()
    try:
        yield
    finally:
        for norm, momentum, count in kept:
            norm.momentum, norm.num_batches_tracked = momentum, count
