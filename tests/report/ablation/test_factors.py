from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.report.ablation.factors import (
    config_differences,
    find_factors,
    format_value,
    seed_of,
    variant,
    variant_key,
)
from hudepth.runs.identity import canonical

BADCL = {"_target_": "hudepth.losses.badcl.BADCL", "boundary": 3.0, "scaling": 1, "eps": 1e-8}
SILOG = {"_target_": "hudepth.losses.baselines.SILog", "factor": 10.0}


def config(*, seed: int = 1, loss: Any = None, **more: Any) -> dict[str, Any]:
    return {
        "name": f"run {seed}",
        "seed": seed,
        "data": {"_target_": "x.Data", "seed": seed, "size": [112, 112], "root": f"/data/{seed}"},
        "model": {"_target_": "x.Net", "weights": None},
        "loss": loss or BADCL,
        "optim": {"lr": 1e-4},
        **more,
    }


def factors(*configs: dict[str, Any]) -> dict[str, list[str]]:
    return {factor.name: factor.shown for factor in find_factors([variant(each) for each in configs])}


def test_seeds_names_and_places_are_no_factors() -> None:
    assert factors(config(seed=1), config(seed=2)) == {}
    assert variant_key(config(seed=1)) == variant_key(config(seed=2))
    assert variant_key(config()) != variant_key(config(optim={"lr": 2e-4}))


def test_options_of_a_class_that_differs_do_not_flood_the_table() -> None:
    assert factors(config(), config(loss=SILOG)) == {"loss": ["BADCL", "SILog"]}


def test_an_option_that_differs_within_a_class_is_a_factor() -> None:
    found = factors(config(), config(loss={**BADCL, "boundary": 0}), config(loss=SILOG))
    assert found == {"loss": ["BADCL", "BADCL", "SILog"], "boundary": ["3", "0", "-"]}


def test_whole_and_broken_numbers_are_the_same_but_truth_is_no_number() -> None:
    assert factors(config(loss={**BADCL, "scaling": 1}), config(loss={**BADCL, "scaling": 1.0})) == {}
    assert factors(config(optim={"lr": 1}), config(optim={"lr": True})) == {"lr": ["1", "true"]}


def test_names_that_would_be_two_are_written_out() -> None:
    found = factors(config(optim={"lr": 1, "eps": 1}), config(optim={"lr": 2, "eps": 2}, loss={**BADCL, "eps": 1.0}))
    assert list(found) == ["loss.eps", "optim.eps", "lr"]


def test_null_beside_a_class_is_one_column() -> None:
    stopping = {"_target_": "x.EarlyStopping", "patience": 5}
    found = factors(config(callbacks={"early": None}), config(callbacks={"early": stopping}))
    assert found == {"early": ["none", "EarlyStopping"]}


def test_a_key_that_a_row_lacks() -> None:
    assert factors(config(optim={"lr": 1, "momentum": 0.9}), config(optim={"lr": 1})) == {"momentum": ["0.9", "-"]}


def test_differences_are_complete() -> None:
    assert config_differences(variant(config()), variant(config(loss=SILOG))) == [
        ("loss._target_", BADCL["_target_"], SILOG["_target_"]),
        ("loss.boundary", "3", "-"),
        ("loss.eps", "1e-08", "-"),
        ("loss.scaling", "1", "-"),
        ("loss.factor", "-", "10"),
    ]
    assert config_differences(variant(config(seed=1)), variant(config(seed=2))) == []


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "none"),
        (0.1 + 0.2, "0.30000000000000004"),
        ([112, 112], "[112, 112]"),
        ("/x/resnet.pth", "resnet.pth"),
        (True, "true"),
        ("x" * 50, "x" * 39 + "…"),
        ("end/", "end/"),
    ],
)
def test_values_in_letters(value: Any, text: str) -> None:
    assert format_value(value) == text


@pytest.mark.parametrize(("seeds", "text"), [((1, 1), "1"), ((1, 2), "1/2"), ((None, None), "-"), ((0, None), "0")])
def test_the_seed_of_a_run(seeds: tuple[Any, Any], text: str) -> None:
    assert seed_of({"seed": seeds[0], "data": {"seed": seeds[1]}}) == text
    assert seed_of({"seed": 3, "data": None}) == "3"


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.text(max_size=3), lambda x: st.lists(x, max_size=2)
)


@given(a=VALUES, b=VALUES)
def test_equal_values_are_spelt_equally(a: Any, b: Any) -> None:
    def typed(value: Any) -> Any:
        return [typed(x) for x in value] if isinstance(value, list) else (type(value), value)

    assert (canonical(a) == canonical(b)) == (typed(a) == typed(b))


@given(order=st.permutations(range(4)))
def test_the_order_of_rows_changes_nothing_but_the_order_of_values(order: list[int]) -> None:
    rows = [config(loss={**BADCL, "boundary": b, "scaling": s}) for b in (0, 3) for s in (0, 1)]
    found, again = factors(*rows), factors(*(rows[i] for i in order))
    assert set(found) == set(again)
    for name, values in found.items():
        assert again[name] == [values[i] for i in order]
