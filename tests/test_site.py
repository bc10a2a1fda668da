"""What the documentation site is built from: docs/api, conf/ as tables, links, the notebook."""

from __future__ import annotations

import doctest
import importlib
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
API = sorted((DOCS / "api").glob("*.rst"))
NAMES = set(re.findall(r"^\.\. auto\w+:: ([\w.]+)", "\n".join(page.read_text() for page in API), re.MULTILINE))
INTERNAL = {"hudepth.base.images"}
"""Packages whose ``__all__`` is for hudepth itself."""


def extension(name: str) -> ModuleType:
    """An extension of the site."""
    spec = importlib.util.spec_from_file_location(name, DOCS / "_site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_public_name_has_an_entry() -> None:
    packages = [
        ".".join(path.parent.relative_to(ROOT).parts)
        for path in sorted((ROOT / "hudepth").rglob("__init__.py"))
        if "\n__all__" in path.read_text()
    ]
    assert {"hudepth", "hudepth.models", "hudepth.losses", "hudepth.metrics", "hudepth.data"} <= set(packages)
    public = {f"{name}.{each}" for name in set(packages) - INTERNAL for each in importlib.import_module(name).__all__}
    assert not public - NAMES


def test_every_class_that_conf_names_has_an_entry() -> None:
    files = sorted((ROOT / "conf").rglob("*.yaml"))
    named = {found for file in files for found in re.findall(r"_target_: (hudepth\.[\w.]+)", file.read_text())}
    public = {f"{found.__module__}.{found.__qualname__}" for found in map(imported, NAMES) if isinstance(found, type)}
    assert len(named) > 25
    assert not named - public


def imported(name: str) -> Any:
    """What a dotted name is."""
    for split in range(len(name.split(".")), 0, -1):
        module, *rest = ".".join(name.split(".")[:split]), *name.split(".")[split:]
        try:
            found: Any = importlib.import_module(module)
        except ImportError:
            continue
        for each in rest:
            found = getattr(found, each)
        return found
    raise AssertionError(name)


@pytest.mark.parametrize("page", API, ids=lambda page: page.stem)
def test_the_examples_of_the_api(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")  # whose runs are read
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))  # of the cache
    found = doctest.testfile(str(page), module_relative=False, optionflags=doctest.ELLIPSIS)
    assert not found.failed


def leaves(mapping: dict[str, Any], outer: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """The keys of a configuration that have values, dotted."""
    for key, value in mapping.items():
        if key not in ("defaults", "_target_"):
            inner = (
                leaves(value, (*outer, key))
                if isinstance(value, dict) and value
                else [(".".join((*outer, key)), value)]
            )
            yield from inner


def test_the_option_tables_hold_every_key_with_its_value() -> None:
    tables = extension("option_tables")
    listed = dict(tables.groups())
    files = {file for files in listed.values() for file in files}
    assert files == {file for file in (ROOT / "conf").rglob("*.yaml") if file.parent.name != "hydra"}
    for group in set(listed) - set(tables.COMPOSITIONS):
        for file in listed[group]:
            told = {option.key: option for option in tables.read(file).options}
            for key, value in leaves(yaml.safe_load(file.read_text()) or {}):
                if isinstance(value, list) and value and isinstance(value[0], dict):
                    continue  # callbacks: each has keys of its own
                assert yaml.safe_load(told[key].value or "null") == value, f"{file}: {key}"


def test_keys_are_named_as_on_the_command_line() -> None:
    tables = extension("option_tables")
    conf = ROOT / "conf"
    shown = {file: tables.prefix(conf / file) for file in ("train.yaml", "data/folder.yaml", "protocol/eigen.yaml")}
    assert list(shown.values()) == ["", "data.", "protocol.eigen."]
    assert tables.prefix(conf / "hydra" / "sweeper" / "hudepth.yaml") == "hydra.sweeper."
    sizes = {option.key: option.comment for option in tables.read(conf / "bench.yaml").options}
    assert sizes["backends"].startswith("default: on a CPU")  # from the lines above the key


def test_every_key_of_a_command_is_explained() -> None:
    tables = extension("option_tables")
    for group, files in tables.groups():
        known = tables.known_comments([*files, ROOT / "conf" / "base" / "protocol.yaml"])
        for file in [] if group in tables.COMPOSITIONS else files:
            for option in tables.read(file).options:
                assert option.comment or known.get(option.key) or not option.value, f"{file}: {option.key}"


@pytest.mark.parametrize("address", ["", "https://example.org/depth/blob/main"])
def test_links_to_files_lead_to_the_repository_or_are_paths(address: str, tmp_path: Path) -> None:
    (tmp_path / "training.md").write_text("# Other\n\n## The camera\n")
    (tmp_path / "page.md").write_text(
        "# Page\n\nA [study](../experiments/units), the file ([ledger](../experiments/ledger/ledger.md)), "
        "[CITATION.cff](CITATION.cff), [here](training.md#the-camera), [there](docs/training.md).\n"
    )
    conf = ["extensions = ['myst_parser', 'repository_links']", "myst_heading_anchors = 3", "root_doc = 'page'"]
    conf += [f"import sys; sys.path.insert(0, {str(DOCS / '_site')!r})", "import repository_links"]
    conf += [f"repository_links.repository = lambda: {address!r}", "exclude_patterns = ['out']"]
    (tmp_path / "conf.py").write_text("\n".join(conf))
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "html", str(tmp_path), str(tmp_path / "out")]
    done = subprocess.run(command, text=True, capture_output=True, check=True)
    assert "xref_missing" not in done.stderr
    text = (tmp_path / "out" / "page.html").read_text()
    plain = re.sub(r"<[^>]+>", "", text)
    assert 'href="training.html#the-camera"' in text
    assert 'href="training.html"' in text
    if address:
        for path in ("experiments/units", "experiments/ledger/ledger.md", "CITATION.cff"):
            assert f'href="{address}/{path}"' in text
        assert "A study, the file (ledger), CITATION.cff, here" in plain
    else:
        assert (
            "A study (experiments/units), the file (ledger, experiments/ledger/ledger.md), CITATION.cff, here" in plain
        )


def test_links_that_lead_nowhere_are_found(tmp_path: Path) -> None:
    check = extension("link_check")
    (tmp_path / "a.html").write_text(
        '<a href="b.html#x"></a><a href="#y"></a><p id="y"><a href="https://x.org/no"></a>'
    )
    (tmp_path / "b.html").write_text('<p id="x"><img src="c.png"><a href="a.html#z"></a><a href="a.html"></a>')
    assert sorted(check.broken_links(tmp_path)) == ["b.html: a.html#z", "b.html: c.png"]
    (tmp_path / "c.png").touch()
    assert check.broken_links(tmp_path) == ["b.html: a.html#z"]


def test_the_notebook_is_stored_without_results() -> None:
    cells = json.loads((DOCS / "first_steps.ipynb").read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)


def test_the_verdicts_are_those_of_the_ledger() -> None:
    rows = json.loads((ROOT / "experiments" / "ledger" / "ledger.json").read_text())["rows"]
    said = re.findall(r"^\| (\d+) \| (.*) \| (.*) \|$", (DOCS / "paper.md").read_text(), re.MULTILINE)
    assert said == [(str(i), row["claim"], row["verdict"]) for i, row in enumerate(rows, start=1)]


def test_one_set_of_predictions_under_several_protocols() -> None:
    study = ROOT / "experiments" / "protocols"
    tables = [
        re.search(r"<!-- (?:table|protocols) -->\n(.*?)\n<!--", page.read_text(), re.DOTALL)
        for page in (study / "README.md", DOCS / "faq.md")
    ]
    assert tables[0] is not None
    assert tables[1] is not None
    assert tables[0][1] == tables[1][1]
    for row in tables[0][1].splitlines()[2:]:
        name, *said = [cell.strip() for cell in row.strip("|").split("|")]
        folder = "eigen_aligned" if "median" in name else name
        metrics = json.loads((study / "test" / folder / "metrics.json").read_text())["metrics"]["model"]
        *others, delta1 = [metrics[key] for key in ("abs_rel", "rmse", "log10", "silog", "delta1")]
        assert said == [*(f"{value:.3f}" if value < 1 else f"{value:.1f}" for value in others), f"{delta1:.3f}"]
