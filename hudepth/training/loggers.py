"""Loggers that cannot end a training: one that fails is dropped."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any

from lightning.pytorch.loggers import Logger

from hudepth.base.console import log

_METHODS = ("log_metrics", "log_hyperparams", "log_graph", "save", "finalize", "after_save_checkpoint")


def drop_on_failure(logger: Logger) -> Logger:
    """Change a logger so that its first failure, a full disk for example, drops it with a warning; return it."""

    def guard(method: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(method)
        def guarded(*args: Any, **options: Any) -> Any:
            if is_dropped(logger):
                return None
            try:
                return method(*args, **options)
            except Exception as error:  # a logger may fail in any way, and the training is worth more than its curves
                drop(logger, error)

        return guarded

    for name in _METHODS:
        setattr(logger, name, guard(getattr(logger, name)))
    threading.excepthook = _except_hook
    return logger


def is_dropped(logger: Logger) -> bool:
    """Return whether a logger has failed."""
    return bool(getattr(logger, "_hudepth_dropped", False))


def drop(logger: Logger, error: Exception) -> None:
    """Use a logger no more."""
    logger._hudepth_dropped = True  # type: ignore[attr-defined]
    why = " ".join(str(error).split()) or type(error).__name__
    log.warning("%s failed and is dropped (%s); the training goes on without it", type(logger).__name__, why)


def _except_hook(failed: threading.ExceptHookArgs, /) -> None:
    """Keep quiet about TensorBoard's writing thread: it raises the same error in the training."""
    if not type(failed.thread).__module__.startswith("tensorboard."):
        threading.__excepthook__(failed)
