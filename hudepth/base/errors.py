"""Errors meant for the person at the prompt: one line that says what, where, what was found, and what to do."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable


class HudepthError(Exception):
    """Base of all errors that the command line prints as one line, without a traceback."""


class ConfigError(HudepthError):
    """A configuration that cannot be run."""


class OptionError(ConfigError):
    """A value that does not fit its option; ``key`` is the option's name."""

    def __init__(self, message: str, key: str) -> None:
        super().__init__(message)
        self.key = key


class DataError(HudepthError):
    """A data set, a file in it, or a split that cannot be used."""


class CheckpointError(HudepthError):
    """A checkpoint that cannot be read, is not trusted, or does not fit."""


class TrainingError(HudepthError):
    """Training that cannot go on, for example because its loss is not finite."""


class Pruned(Exception):  # noqa: N818 - no error
    """A search ended this training early, since others were better at the same epoch.

    Args:
        message: for the log.
        value: of the monitored metric.
    """

    def __init__(self, message: str, value: float) -> None:
        super().__init__(message)
        self.value = value


def first_line(error: BaseException) -> str:
    """Return what a library's error says in its first line, in at most 200 characters, else the name of its class.

    Addresses in it lose their password.
    """
    text = re.sub(r"//[^/@\s]+@", "//", str(error))
    return next((line for line in text.splitlines() if line.strip()), type(error).__name__)[:200].strip()


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"`` for the choice closest to ``name``, or an empty string if none is close.

    Dotted names are compared as a whole and by their last part, so that ``model.headz`` finds
    ``model.attention_heads``' neighbours as well as keys that were moved to another group.
    """
    found = closest(name, choices)
    return f" Did you mean '{found}'?" if found else ""


def closest(name: str, choices: Iterable[str]) -> str:
    """Return the choice that :func:`did_you_mean` suggests; empty if none is close."""
    known = list(choices)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if not close:
        last = {choice.rsplit(".", 1)[-1]: choice for choice in known}
        close = [last[match] for match in difflib.get_close_matches(name.rsplit(".", 1)[-1], last, n=1, cutoff=0.6)]
    return close[0] if close else ""
