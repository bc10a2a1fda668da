"""Loggers that cannot end a training: one that fails is dropped."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any

from lightning.pytorch.loggers import Logger

from hudepth.base.console import log
from hudepth.base.errors import first_line

_METHODS = ("log_metrics", "log_hyperparams", "log_graph", "save", "finalize", "after_save_checkpoint")


def drop_on_failure(logger: Logger) -> Logger:
    """Change a logger so that its first failure, a full disk for example, drops it with a warning; return it."""
    for name in _METHODS:
        setattr(logger, name, guarded(logger, getattr(logger, name)))
    threading.excepthook = _except_hook
    return logger


def guarded(logger: Logger, method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that does the same until the logger is dropped, and drops it instead of raising."""

    @wraps(method)
    def call(*args: Any, **options: Any) -> Any:
        if is_dropped(logger):
            return None
        try:
            return method(*args, **options)
        except Exception as error:  # a logger may fail in any way, and the training is worth more than its curves
            logger._hudepth_dropped = True  # type: ignore[attr-defined]
            text = "%s failed and is dropped (%s); the training goes on without it"
            log.warning(text, type(logger).__name__, first_line(error))

    return call


def is_dropped(logger: Logger) -> bool:
    """Return whether a logger has failed."""
    return bool(getattr(logger, "_hudepth_dropped", False))


def _except_hook(failed: threading.ExceptHookArgs, /) -> None:
    """Keep quiet about TensorBoard's writing thread: it raises the same error in the training."""
    if not type(failed.thread).__module__.startswith("tensorboard."):
        threading.__excepthook__(failed)
