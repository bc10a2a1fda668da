"""What GitHub and pre-commit read says the same as the Makefile and constraints.txt."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


def workflow() -> dict[str, Any]:
    return dict(yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text()))


def test_the_workflow_runs_targets_that_exist() -> None:
    commands = [step["run"] for job in workflow()["jobs"].values() for step in job["steps"] if "run" in step]
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {"make lint", "make test", "make docs", "make test-all"} <= set(commands)
    assert {command.removeprefix("make ") for command in commands} <= targets


def test_the_workflow_tests_every_python() -> None:
    tested = workflow()["jobs"]["test"]["strategy"]["matrix"]["python-version"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    first, after = re.findall(r"3\.(\d+)", project["requires-python"])
    assert tested == [f"3.{minor}" for minor in range(int(first), int(after))]


def test_pre_commit_uses_the_tested_versions() -> None:
    (local,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    pinned = {each for hook in local["hooks"] for each in hook["additional_dependencies"]}
    assert all("==" in each for each in pinned)
    (ruff,) = [each for each in pinned if each.startswith("ruff==")]
    assert ruff in (ROOT / "constraints.txt").read_text().splitlines()


def test_the_lock_has_the_tested_versions_from_pypi() -> None:
    text = (ROOT / "uv.lock").read_text()
    assert set(re.findall(r"https?://[^/]+", text)) == {"https://pypi.org", "https://files.pythonhosted.org"}
    locked: dict[str, set[str]] = {}
    for package in tomllib.loads(text)["package"]:
        assert package["source"] in ({"registry": "https://pypi.org/simple"}, {"editable": "."})
        locked.setdefault(package["name"], set()).add(package.get("version", ""))
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if not line.startswith("#"):
            name, version = line.split("==")
            assert locked[canonicalize_name(name)] == {version}, f"{name}: run make lock"


def test_the_lock_fits_the_dependencies() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *(each for extra in project["optional-dependencies"].values() for each in extra)]
    (own,) = [each for each in tomllib.loads((ROOT / "uv.lock").read_text())["package"] if each["name"] == "hudepth"]
    noted = [Requirement(f"{each['name']}{each.get('specifier', '')}") for each in own["metadata"]["requires-dist"]]
    known = {(canonicalize_name(each.name), each.specifier) for each in noted}
    for requirement in map(Requirement, asked):
        name = canonicalize_name(requirement.name)
        assert name == "hudepth" or (name, requirement.specifier) in known, f"{requirement}: run make lock"
