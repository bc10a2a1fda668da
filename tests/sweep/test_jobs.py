from __future__ import annotations

import itertools

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from hudepth.sweep.jobs import Job, combine, merge_overrides

VARIANTS = {"paper": [], "l1": ["loss=l1"], "l2": ["loss=l2", "seed=5"]}


def jobs(*typed: str, params: tuple[str, ...] = (), variants: dict[str, list[str]] | None = None) -> list[Job]:
    parse = OverridesParser.create().parse_overrides
    return combine(merge_overrides(parse(list(typed)), parse(list(params))), variants or {})


def test_every_combination_once_seeds_last() -> None:
    found = [dict(job.labels) for job in jobs("seed=1,2", "loss=l1,l2", "optim.lr=1e-3")]
    assert found == [{"loss": loss, "seed": seed} for seed in "12" for loss in ("l1", "l2")]
    assert jobs("seed=1,2", "loss=l1,l2", "optim.lr=1e-3")[1].overrides == ("optim.lr=1e-3", "seed=1", "loss=l2")


def test_what_is_typed_replaces_the_sweeps_own_values() -> None:
    assert [job.labels["seed"] for job in jobs("seed=7,8", params=("seed=1,2,3",))] == ["7", "8"]
    (one,) = jobs("seed=7", params=("seed=1,2,3",))
    assert (one.overrides, dict(one.labels)) == (("seed=7",), {})
    assert len(jobs("loss=l1,l2", params=("seed=1,2,3",))) == 6


def test_a_variant_is_its_overrides_and_its_name() -> None:
    found = jobs("seed=1,2", "optim.lr=1", variants=VARIANTS)
    assert [job.name for job in found[:3]] == ["paper seed=1", "l1 seed=1", "l2 seed=1"]
    assert found[1].overrides == ("optim.lr=1", "loss=l1", "seed=1", "variant=l1")
    assert [job.labels["variant"] for job in jobs("variant=l2", variants=VARIANTS)] == ["l2"]
    assert [job.labels["variant"] for job in jobs("variant=l2,paper", variants=VARIANTS)] == ["l2", "paper"]


def test_groups_are_added_and_keys_deleted_as_typed() -> None:
    (job,) = jobs("+experiment=badcl", "~callbacks.extra", "++trainer.x=1")
    assert job.overrides == ("+experiment=badcl", "~callbacks.extra", "++trainer.x=1")
    assert job.name == "job"
    assert [dict(job.labels) for job in jobs("+trainer.x=1,2")] == [{"trainer.x": "1"}, {"trainer.x": "2"}]


@pytest.mark.parametrize(
    ("typed", "expected"),
    [("x=range(1,4)", ["1", "2", "3"]), ("x=choice(a,b)", ["a", "b"]), ("x='a,b',c", ["'a,b'", "c"])],
)
def test_hydras_own_ways_to_write_values(typed: str, expected: list[str]) -> None:
    assert [job.labels["x"] for job in jobs(typed)] == expected


@given(st.lists(st.integers(2, 4), max_size=3), st.booleans())
def test_as_many_jobs_as_combinations(sizes: list[int], named: bool) -> None:
    typed = [f"k{number}={','.join(map(str, range(size)))}" for number, size in enumerate(sizes)]
    found = jobs(*typed, variants=VARIANTS if named else {})
    expected = list(itertools.product(*(map(str, range(size)) for size in sizes), VARIANTS if named else ("",)))
    assert len({tuple(job.labels.items()) for job in found}) == len(found) == len(expected)
