from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import ConfigError
from hudepth.base.files import output_folder
from hudepth.base.options import Choice, Range, Size, check, convert, parse


@dataclass(frozen=True)
class Inner:
    panels: Annotated[int, Range(0)] = 6


@dataclass(frozen=True)
class Options:
    input: str
    count: Annotated[int, Range(1, 9)] = 3
    share: Annotated[float, Range(0, 1, below=True)] = 0.0
    size: Size | None = None
    mode: Literal["min", "max"] = "min"
    formats: list[Annotated[str, Choice(("png16", "npy"))]] | None = None
    camera: tuple[float, float, float, float] | None = None
    batches: list[Annotated[int, Range(1)]] = field(default_factory=lambda: [1])
    flip: bool = False
    place: Path = Path("runs")
    inner: Inner = field(default_factory=Inner)
    extra: dict[str, Any] = field(default_factory=dict)


@pytest.mark.parametrize(
    ("key", "typed", "value"),
    [
        ("input", 20240501, "20240501"),  # Hydra reads a folder of digits as a number
        ("size", 224, (224, 224)),
        ("size", [120, 160], (120, 160)),
        ("formats", "npy", ["npy"]),
        ("formats", ["npy", "png16", "npy"], ["npy", "png16"]),
        ("camera", [500, 500, 320, 240], (500.0, 500.0, 320.0, 240.0)),
        ("batches", 4, [4]),
        ("share", 0, 0.0),
        ("place", "a b", Path("a b")),
        ("inner", {"panels": 0}, Inner(0)),
        ("extra", {"a": 1}, {"a": 1}),
    ],
)
def test_what_is_taken(key: str, typed: object, value: object) -> None:
    assert getattr(parse(Options, {"input": "x", key: typed}), key) == value


@pytest.mark.parametrize(
    ("key", "typed", "words"),
    [
        ("count", 0, "0 is not a whole number of at least 1 and at most 9. Leave count out for 3."),
        ("count", 10, "at most 9"),
        ("count", True, "true is not a whole number"),
        ("count", 2.5, "2.5 is not a whole number"),
        ("share", 1, "1 is not a number of at least 0 and below 1"),
        ("share", float("nan"), "nan is not a number"),
        ("share", "half", "'half' is not a number"),
        ("size", [224], r"[224] is not [height,width]"),
        ("size", [0, 4], r"[0,4] is not [height,width]"),
        ("mode", "mni", "'mni' is not one of min, max. Did you mean 'min'?"),
        ("formats", ["npz"], "[npz] is not a list of some of png16, npy. Did you mean 'npy'?"),
        ("formats", [], "[] is not"),
        ("camera", [1, 2, 3], "[1,2,3] is not a list of 4 numbers"),
        ("camera", 1, "1 is not a list of 4 numbers"),
        ("flip", 1, "1 is not true or false"),
        ("inner", 3, "3 is not a mapping of options"),
        ("inner", {"panels": -1}, "inner.panels: -1 is not a whole number of at least 0"),
        ("extra", [1], "[1] is not a mapping of options"),
        ("input", None, "input is not set"),
        ("input", ["a"], "[a] is not text"),
    ],
)
def test_what_is_refused(key: str, typed: object, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse(Options, {"input": "x", key: typed})
    assert words in str(error.value)
    assert str(error.value).startswith(key)


def test_unknown_keys_are_refused_where_that_is_asked_for() -> None:
    assert parse(Options, {"input": "x", "other": 1}).input == "x"
    with pytest.raises(ConfigError, match=r"search.cuont: .* Did you mean 'count'"):
        parse(Options, {"input": "x", "cuont": 1}, prefix="search.", strict=True)


def test_a_missing_option_names_its_key() -> None:
    with pytest.raises(ConfigError, match="input is not set"):
        parse(Options, {})


def test_check_converts_the_fields_of_an_instance() -> None:
    options = Options("x", size=64)  # type: ignore[arg-type]
    check(options, prefix="data.")
    assert options.size == (64, 64)
    with pytest.raises(ConfigError, match=r"data.count"):
        check(Options("x", count=0), prefix="data.")


json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda each: st.lists(each) | st.dictionaries(st.text(), each),
)


@given(st.sampled_from([name for name in Options.__dataclass_fields__ if name != "input"]), json)
def test_any_value_is_taken_or_refused_by_its_key(key: str, typed: object) -> None:
    try:
        options = parse(Options, {"input": "x", key: typed})
    except ConfigError as error:
        assert str(error).startswith(key)  # noqa: PT017 - some values are taken
    else:
        assert parse(Options, {"input": "x", key: getattr(options, key)}) == options


@given(st.integers(), st.integers())
def test_bounds(low: int, value: int) -> None:
    assert Range(low).holds(value) == (value >= low)
    assert Range(low, above=True).holds(value) == (value > low)
    assert Range(max=low).holds(value) == (value <= low)
    assert Range(max=low, below=True).holds(value) == (value < low)


def test_a_union_takes_the_first_that_fits() -> None:
    assert convert("batch_size", "auto", int | Literal["auto"]) == "auto"
    with pytest.raises(ConfigError, match="a whole number or auto"):
        convert("batch_size", [], int | Literal["auto"])


def test_an_output_folder_must_be_writable(tmp_path: Path) -> None:
    assert output_folder(tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="output: cannot write"):
        output_folder(tmp_path / "file" / "b")


def test_a_long_value_is_shown_in_part() -> None:
    for value in ("x" * 5000, list(range(3000))):
        with pytest.raises(ConfigError) as caught:
            convert("key", value, int)
        assert len(str(caught.value)) < 300
