"""Protocols that do not fit a set: warned of once, and never for what the examples of the configuration say."""

from __future__ import annotations

import re

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from hudepth import cli
from hudepth.base import verbs
from hudepth.data.build import build_data
from hudepth.evaluation.protocols import build_protocols

FILES = sorted((verbs.conf_folder() / "data").glob("*.yaml"))
EXAMPLES = [
    (path.stem, task, re.sub(r"<[^>]*>", "x", words).split())
    for path in FILES
    for task, words in re.findall(r"^#   hudepth-(train|test) (.*)$", path.read_text(), re.MULTILINE)
]
OWN = {
    "diode": ["diode_indoors"], "eth3d": ["eth3d"], "ibims": ["ibims"], "kitti": ["kitti_eigen"],
    "scannet": ["scannet"], "sunrgbd": ["sunrgbd"], "tum": ["tum"],
}  # fmt: skip


def warnings(caplog: pytest.LogCaptureFixture, task: str, *words: str, times: int = 1) -> list[str]:
    caplog.clear()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(verbs.conf_folder()), version_base="1.3"):
        config = OmegaConf.to_container(compose(task, overrides=cli.rewrite(task, list(words))), resolve=True)
    assert isinstance(config, dict)
    datamodule = build_data(config["data"], trust=[])
    for _ in range(times):
        build_protocols(config["protocol"], datamodule=datamodule, trust=[])
    return [record.message for record in caplog.records]


@pytest.mark.parametrize(("name", "task", "words"), EXAMPLES, ids=lambda each: str(each))
def test_no_example_is_warned_of_and_each_set_names_its_protocol(
    name: str, task: str, words: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    assert [word for word in words if word.startswith("protocol=")] == [f"protocol={own}" for own in OWN.get(name, ())]
    assert warnings(caplog, task, *words) == []


@pytest.mark.parametrize(("name", "most"), [("kitti", 80), ("eth3d", 72)])
def test_a_cap_of_rooms_on_outdoor_depth_is_warned_of_once(
    name: str, most: int, caplog: pytest.LogCaptureFixture
) -> None:
    for task in ("train", "test"):
        assert warnings(caplog, task, f"data={name}", "data.root=x", times=2) == [
            f"protocol=eigen scores depths up to 10 m, but data.max_depth_m={most}. Pass the set's own, for "
            f"example protocol=kitti_eigen for KITTI, or protocol.eigen.max_depth_m={most}"
        ]
    assert warnings(caplog, "train", f"data={name}", "data.root=x", "protocol=paper") == []


def test_half_the_depth_is_no_reason(caplog: pytest.LogCaptureFixture) -> None:
    for most, count in ((20, 0), (20.1, 1)):
        assert len(warnings(caplog, "train", "data=rooms", f"data.max_depth_m={most}")) == count
