from __future__ import annotations

import json
from pathlib import Path

import pytest

from hudepth import machine

X86 = """processor\t: 0
model name\t: Some CPU @ 2 GHz
flags\t\t: fpu avx2 fma avx512_vnni sse

processor\t: 1
model name\t: Some CPU @ 2 GHz
flags\t\t: fpu avx2 fma avx512_vnni sse
"""
ARM = "processor\t: 0\nFeatures\t: fp asimd asimddp\n"


def test_the_stamp_of_this_machine_is_plain() -> None:
    stamp = machine.hardware()
    assert json.loads(json.dumps(stamp)) == stamp
    assert 1 <= stamp["usable_cores"] <= stamp["cores"]
    assert stamp["packages"]["torch"]
    assert stamp["memory_gb"] > 0.1


@pytest.mark.parametrize(
    ("text", "sets", "name"),
    [(X86, ["avx2", "fma", "avx512_vnni"], "Some CPU @ 2 GHz"), (ARM, ["asimd", "asimddp"], None)],
)
def test_what_linux_says_of_processors(
    text: str, sets: list[str], name: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cpuinfo").write_text(text)
    monkeypatch.setattr(machine, "CPUINFO", tmp_path / "cpuinfo")
    stamp = machine.hardware()
    assert stamp["instruction_sets"] == sets
    assert stamp["processor"] == name or name is None


def test_other_systems_have_no_such_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "CPUINFO", tmp_path / "absent")
    monkeypatch.setattr(machine, "_version", lambda _package: None)
    monkeypatch.delattr("os.sysconf", raising=False)
    stamp = machine.hardware()
    assert stamp["processor"]
    assert (stamp["instruction_sets"], stamp["memory_gb"]) == ([], None)
