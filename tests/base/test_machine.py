from __future__ import annotations

import json
import platform
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from hudepth.base import machine

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


FAULTS = """
import resource, sys
import numpy as np
from hudepth.base.machine import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory()
counts = []
for _ in range(6):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(50_000_000, np.uint8)  # touched, then freed
    counts.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(min(counts[2:]))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="an option of the GNU C library")
def test_freed_memory_is_kept() -> None:
    def faults(how: str) -> int:
        done = subprocess.run([sys.executable, "-c", FAULTS, how], capture_output=True, text=True, check=True)
        return int(done.stdout)

    assert faults("keep") < 0.05 * faults("give back")


def test_freed_memory_is_not_kept_where_nothing_knows_how(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.ctypes, "CDLL", lambda _: object())
    assert not machine.keep_freed_memory()


@pytest.mark.parametrize(
    ("precision", "accelerator", "cuda", "bfloat16", "expected"),
    [
        ("tf32", "auto", True, True, ("32-true", True)),
        ("tf32", "cpu", True, True, ("32-true", False)),
        ("fast", "gpu", True, True, ("bf16-mixed", True)),
        ("fast", "gpu", True, False, ("32-true", True)),
        ("fast", "auto", False, False, ("32-true", False)),
        ("fast", "mps", True, True, ("32-true", False)),
        ("32-true", "gpu", True, True, ("32-true", False)),
        ("16-mixed", "gpu", True, True, ("16-mixed", False)),
    ],
)
def test_what_a_precision_means_on_a_device(
    precision: str, accelerator: str, cuda: bool, bfloat16: bool, expected: tuple[str, bool],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: bfloat16)
    assert machine.resolve_precision(precision, accelerator) == expected


def test_products_in_tf32_end_with_the_block() -> None:
    def state() -> tuple[str, bool]:
        return torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32

    before = state()
    with machine.float32_products(tf32=True):
        assert state() == ("high", True)
        with suppress(KeyError), machine.float32_products(tf32=False):
            assert state() == ("highest", False)
            raise KeyError
        assert state() == ("high", True)
    assert state() == before
