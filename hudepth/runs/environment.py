"""environment.json of a run: what it takes to repeat it."""

from __future__ import annotations

import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from hudepth.base.machine import resolve_precision, uses_cuda

PACKAGES = ("hudepth", "torch", "lightning", "torchmetrics", "hydra-core", "h5py", "numpy", "opencv-python-headless")


def environment(*, seed: int, accelerator: str, precision: str) -> dict[str, Any]:
    """Return what it takes to repeat a run: versions, git state, device, arithmetic, threads, seed, command."""
    import torch

    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        # torch.__version__ names the build (+cpu, +cu130); the package's metadata may not
        "packages": {**{name: _version(name) for name in PACKAGES}, "torch": str(torch.__version__)},
        "git": _git(),
        "accelerator": accelerator,
        "device": torch.cuda.get_device_name() if uses_cuda(accelerator) else _processor(),
        **resolve_precision(precision, accelerator)._asdict(),
        "threads": torch.get_num_threads(),
        "seed": seed,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None  # another build, for example opencv-python, or a source tree that was never installed


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")  # the only place where Linux states the model
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _git() -> dict[str, Any] | None:
    """Return commit and dirty flag of the checkout this code runs from, None for an installed wheel."""
    here = Path(__file__).parent

    def ask(*words: str) -> str:
        command = ["git", "-C", str(here), *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()

    try:
        if not ask("ls-files", Path(__file__).name):
            return None  # a wheel installed inside another repository
        return {"commit": ask("rev-parse", "HEAD"), "dirty": bool(ask("status", "--porcelain"))}
    except (OSError, subprocess.SubprocessError):
        return None
