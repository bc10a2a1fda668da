"""A row of the ledger: what the paper says, what is measured, how, and what follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

VERDICTS = {
    "holds": "measured here, and it agrees with the paper",
    "contradicted": "measured here, and it disagrees with the paper",
    "cannot be": "no data and no model could give these figures together",
    "not reached": "nothing measured so far comes near; that is no disproof",
    "another device": "measured, but on other hardware than the paper's, so neither agrees nor disagrees",
    "measured": "a figure that the paper does not give, or with nothing to compare it with",
    "not measured": "needs what this command was not given; the row says what",
}
"""The verdicts and their meanings."""


@dataclass(frozen=True)
class Sheet:
    """A small table that belongs to a row."""

    title: str
    header: Sequence[str]
    cells: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Row:
    """One claim or contradiction."""

    key: str
    """A stable name, for programs."""
    claim: str
    """What it is about, in a few words."""
    says: str
    """What the paper says, and where."""
    measured: str
    """What was found; every figure in it was computed by this command or read from a run."""
    how: str
    """How, so that a reader can repeat it."""
    verdict: str
    """One of :data:`VERDICTS`."""
    values: dict[str, Any] = field(default_factory=dict)
    """The figures behind it, plain types."""
    sheets: Sequence[Sheet] = ()

    def __post_init__(self) -> None:
        assert self.verdict in VERDICTS, self.verdict


def not_measured(key: str, claim: str, says: str, *, why: str, how: str) -> Row:
    """Make the row of something that needs what the command was not given.

    Args:
        key: a stable name.
        claim: what it is about.
        says: what the paper says.
        why: what is missing, and what to pass.
        how: how it would be measured.
    """
    return Row(key, claim, says, f"not measured: {why}", how, "not measured")
