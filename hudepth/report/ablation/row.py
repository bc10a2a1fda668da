"""A row of a sweep's table, and the one that the others are held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hudepth.base.errors import ConfigError, DataError, did_you_mean
from hudepth.report.ablation.estimates import Contrast, Estimate
from hudepth.report.ablation.runs import Repetition, Variant


@dataclass
class Row:
    """A row of the table."""

    variant: Variant
    is_reference: bool = False
    differs: list[str] = field(default_factory=list)
    """In what its protocol, data or split differ from those of the reference."""
    estimates: dict[str, Estimate] = field(default_factory=dict)
    contrasts: dict[str, Contrast] = field(default_factory=dict)
    """Empty for the reference and for rows that cannot be paired with it."""
    best: set[str] = field(default_factory=set)
    """Metrics in which no comparable row is better."""

    @property
    def label(self) -> str:
        """What the row is called."""
        return self.variant.label

    @property
    def runs(self) -> dict[str, Repetition]:
        """Runs that count, by seed."""
        return self.variant.runs

    @property
    def counted(self) -> str:
        """``3`` if all seeds that were tried count, else ``2 of 3``."""
        done, tried = len(self.runs), len(self.variant.seeds)
        return str(done) if done == tried else f"{done} of {tried}"


def choose_reference(table: Sequence[Row], name: str | None, *, protocol: str) -> Row:
    """Return the row that the others are held against.

    Args:
        table: all rows.
        name: a row's label, or that of its ``variant``; default: the first row that has a result.
        protocol: of the results, for the message.

    Raises:
        ConfigError: if there is no such row.
        DataError: if no row has a result.
    """
    usable = [row for row in table if row.runs]
    if not usable:
        raise DataError(
            f"no run of the sweep has finished with a test result of protocol '{protocol}'. "
            "Wait for one, or pass protocol=<name>."
        )
    if name is None:
        return usable[0]
    found = [row for row in table if row.label == name] or [
        row for row in table if name in (row.variant.named, *row.variant.named.split(" / "))
    ]
    if not found:
        labels = [row.label for row in table]
        known = ", ".join(f"'{label}'" for label in labels[:8]) + (f" and {len(labels) - 8} more" * (len(labels) > 8))
        raise ConfigError(f"reference: no row '{name}'.{did_you_mean(name, labels)} There are {known}.")
    if len(found) > 1:
        raise ConfigError(
            f"reference: '{name}' is {len(found)} rows. Pass one, as in reference='\"{found[0].label}\"'."
        )
    if not found[0].runs:
        raise ConfigError(
            f"reference: '{name}' has no finished run with a test result of protocol '{protocol}'. "
            f"Pass another, as in reference='\"{usable[0].label}\"'."
        )
    return found[0]
