from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from PIL import Image

from tests.commands import TINY

ROOT = Path(__file__).parents[1]
SHIPPED = (
    "hudepth/", "conf/", "experiments/strong_official/nyu/", "experiments/lite_official/nyu_lite/", "pyproject",
    "README", "LICENSE",
)  # fmt: skip
UNTESTED = ("ray",)
"""Extras that no test installs."""
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of the sources and unpacked as pip would."""
    folder = tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, text=True, capture_output=True, check=False).stdout.split()
    for name in listed or [str(p.relative_to(ROOT)) for p in ROOT.rglob("*") if ".venv" not in p.parts and p.is_file()]:
        if name.startswith(SHIPPED) and (ROOT / name).is_file():
            (folder / "src" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "src" / name).write_bytes((ROOT / name).read_bytes())
    build = "from hatchling import build; print(build.build_wheel('.'))"
    subprocess.run([sys.executable, "-c", build], cwd=folder / "src", capture_output=True, check=True)
    (wheel,) = (folder / "src").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


@pytest.mark.slow
def test_the_wheel_holds_every_module_and_configuration(site: Path) -> None:
    for folder, inside in ((ROOT / "hudepth", "hudepth"), (ROOT / "conf", "hudepth/conf")):
        for path in folder.rglob("*"):
            if path.is_file() and path.suffix != ".pyc":
                place = site / inside / path.relative_to(folder)
                assert place.is_file(), path


def test_the_wheel_brings_a_model(site: Path) -> None:
    held = {str(path.relative_to(site / "hudepth/pretrained")) for path in (site / "hudepth/pretrained").rglob("*.*")}
    for name in ("nyu", "nyu_lite"):
        assert {
            f"{name}/{file}" for file in ("config.json", "model.safetensors", "README.md", "metrics/eigen.json")
        } < held
        assert (site / "hudepth" / "pretrained" / name / "model.safetensors").stat().st_size < 10_000_000


def wheel_commands(site: Path, *commands: Sequence[str], cwd: Path) -> subprocess.Popen[str]:
    """Start console scripts of the unpacked wheel, which are not those of this repository, one after another."""
    lines = ["import sys", "from hydra.core.global_hydra import GlobalHydra", "from hudepth import cli"]
    lines.append(f"assert {str(site)!r} in cli.__file__")
    for task, *words in commands:
        lines += ["GlobalHydra.instance().clear()", f"sys.argv[1:] = {words}", f"assert cli.{task}() == 0"]
    environment = {**os.environ, "PYTHONPATH": str(site), "HUDEPTH_CACHE": str(cwd / "cache"), "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen([sys.executable, "-c", "\n".join(lines)], cwd=cwd, env=environment, **pipes)


def run_wheel(site: Path, *commands: Sequence[str], cwd: Path) -> str:
    process = wheel_commands(site, *commands, cwd=cwd)
    output, _ = process.communicate(timeout=240)
    assert process.returncode == 0, output
    return output


def test_the_wheel_composes_from_anywhere(site: Path, tmp_path: Path) -> None:
    assert "max_epochs: 100" in run_wheel(site, ("train", "experiment=badcl", "--cfg", "job"), cwd=tmp_path)


@pytest.mark.slow
def test_the_wheel_trains_predicts_and_reports_from_anywhere(site: Path, tmp_path: Path) -> None:
    Image.new("RGB", (64, 48), (200, 120, 40)).save(tmp_path / "photo.png")
    predict = ("predict", "input=photo.png")
    said = run_wheel(
        site, ("train", "experiment=demo", *TINY), (*predict, "checkpoint=nyu", "output=nyu"),
        (*predict, "checkpoint=last", "output=last"), ("report", "figures", "run=last"), cwd=tmp_path,
    )  # fmt: skip
    assert said.count("1 predicted") == 2
    for output in ("nyu", "last"):
        assert np.load(tmp_path / output / "photo_depth.npy").shape == (48, 64)
    assert len(list(tmp_path.glob("runs/demo/*/figures/*.png"))) == 2


@pytest.mark.slow
def test_the_wheel_serves_the_page_from_anywhere(site: Path, tmp_path: Path) -> None:
    pytest.importorskip("gradio", reason="gradio is not installed")
    process = wheel_commands(site, ("demo", "port=0"), cwd=tmp_path)
    assert process.stdout is not None
    try:
        address = next(found[0] for line in process.stdout if (found := re.search(r"http://127\.0\.0\.1:\d+", line)))
        with urlopen(address, timeout=30) as page:
            assert b"hudepth" in page.read()
    finally:
        process.kill()
        process.communicate()


def test_every_dependency_has_a_lower_bound_with_its_reason_and_a_tested_version() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    tested = (ROOT / "constraints.txt").read_text()
    optional = PROJECT["project"]["optional-dependencies"]
    extras = [each for name, group in optional.items() if name not in UNTESTED for each in group]
    for requirement in PROJECT["project"]["dependencies"]:
        name = re.split(r"[><=]", requirement)[0]
        assert ">=" in requirement
        assert re.search(rf'^    "{re.escape(requirement)}",\s+# \S', text, re.MULTILINE), requirement
        assert f"\n{name}==" in tested.lower(), name
    for requirement in extras:
        if requirement.startswith("hudepth["):
            continue
        assert f"\n{re.split(r'[><=[]', requirement)[0].lower()}==" in tested.lower(), requirement


@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        ("import hudepth.data.prepare, hudepth.data.sources.rooms, hudepth.data.sources.densedepth", "torch"),
        ("import hudepth; hudepth.load('nyu'); hudepth.load('nyu_lite')", "torch._dynamo"),
    ],
    ids=["worker", "predict"],
)
def test_processes_import_only_what_they_need(code: str, heavy: str, tmp_path: Path) -> None:
    code += f"; import sys; print({{'{heavy}', 'lightning', 'hydra', 'matplotlib'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, text=True, capture_output=True, check=True)
    assert done.stdout.strip() == "set()"
