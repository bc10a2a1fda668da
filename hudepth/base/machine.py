"""The machine: usable cores, devices, and the hardware that timings depend on."""

from __future__ import annotations

import ctypes
import math
import os
import platform
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hudepth.base.errors import ConfigError

if TYPE_CHECKING:
    import torch

CGROUP_LIMIT = Path("/sys/fs/cgroup/cpu.max")
"""Linux's limit of a container's processor time: quota and period, or ``max``."""
CPUINFO = Path("/proc/cpuinfo")
INSTRUCTION_SETS = (
    "avx2", "fma", "avx512f", "avx512_vnni", "avx_vnni", "avx512_bf16", "avx512_fp16", "amx_tile", "amx_bf16",
    "amx_int8", "asimd", "asimddp", "sve", "bf16", "i8mm",
)  # fmt: skip
"""Those that decide how fast networks run on a processor."""
PACKAGES = ("torch", "onnxruntime", "openvino", "nncf", "transformers")
"""The runtimes and compressors of networks."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Options of mallopt, from malloc.h of the GNU C library."""


def usable_cores() -> int:
    """Return how many cores this process may use: those it may run on, at most what its container is allowed."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = CGROUP_LIMIT.read_text(encoding="ascii").split()
        return max(1, min(allowed, math.ceil(int(quota) / int(period))))
    except (OSError, ValueError):  # another system, or no limit
        return allowed


def torch_device(name: str, *, among: Sequence[str] = ("cuda", "mps", "cpu")) -> torch.device:
    """Return a device by name; ``auto`` is the first of ``among`` that this machine has.

    Raises:
        ConfigError: if this machine has no such device.
    """
    import torch

    available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    here = [kind for kind in among if available[kind]]
    if name != "auto" and name not in here:
        raise ConfigError(f"device: no '{name}' here. Pass device={' or '.join(reversed(here))}.")
    return torch.device(here[0] if name == "auto" else name)


def uses_cuda(accelerator: str) -> bool:
    """Return whether a Trainer with this ``accelerator`` computes on an NVIDIA GPU."""
    import torch

    return accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()


def copy_to(x: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Copy a tensor of the CPU to a device, without waiting for what the device still computes."""
    return (x.pin_memory() if device.type == "cuda" else x).to(device, non_blocking=True)


class Arithmetic(NamedTuple):
    """How a training computes: ``precision`` of Lightning's Trainer, and whether float32 products use TF32."""

    precision: str
    tf32: bool = False


def resolve_precision(precision: str, accelerator: str) -> Arithmetic:
    """Return what ``trainer.precision`` means on a device.

    ``tf32``: float32, with matrix products and convolutions in TF32 on NVIDIA GPUs. ``fast``: bf16-mixed on those that
    have it, else the same. Lightning's names keep their meaning; 32-true is float32 without TF32.
    """
    import torch

    on_cuda = uses_cuda(accelerator)
    if precision == "fast" and on_cuda and torch.cuda.is_bf16_supported(including_emulation=False):
        return Arithmetic("bf16-mixed", tf32=True)
    return Arithmetic("32-true", tf32=on_cuda) if precision in ("fast", "tf32") else Arithmetic(precision)


def set_float32_products(*, tf32: bool) -> None:
    """Compute products of float32 matrices, and convolutions, in TF32 on NVIDIA GPUs, or not, from now on."""
    import torch

    torch.set_float32_matmul_precision("high" if tf32 else "highest")
    torch.backends.cudnn.allow_tf32 = tf32


@contextmanager
def float32_products(*, tf32: bool) -> Iterator[None]:
    """The same for a while."""
    import torch

    before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    try:
        set_float32_products(tf32=tf32)
        yield
    finally:
        torch.set_float32_matmul_precision(before[0])
        torch.backends.cudnn.allow_tf32 = before[1]


def hardware() -> dict[str, Any]:
    """Describe the machine and its runtimes, for readers of timings.

    Returns:
        ``processor``, ``cores``, ``usable_cores``, ``memory_gb`` (None where it is not known), ``instruction_sets``
        (of :data:`INSTRUCTION_SETS`, as Linux names them), ``system``, ``python`` and ``packages`` (versions, None if
        not installed).
    """
    lines = CPUINFO.read_text(encoding="utf-8").splitlines() if CPUINFO.is_file() else []
    known = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    flags = known.get("flags", known.get("Features", "")).split()  # x86, ARM
    return {
        "processor": known.get("model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count() or 1,
        "usable_cores": usable_cores(),
        "memory_gb": _memory_gb(),
        "instruction_sets": [name for name in INSTRUCTION_SETS if name in flags],
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
    }


def _memory_gb() -> float | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, ValueError, OSError):  # another system
        return None


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def keep_freed_memory() -> bool:
    """Let the C library keep freed memory instead of returning it to the system.

    A training step allocates the same large tensors over and over. By default each gets new pages, which the system
    clears one by one: a sixth of the time of a step at 224 x 224 in float32, a twelfth in bfloat16
    (``experiments/speed``). The process keeps its peak memory until it ends.

    Returns:
        Whether it worked: the GNU C library only.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # macOS and musl have none; Windows has no library of this name
        return False
    never = 2**31 - 1
    return bool(mallopt(M_MMAP_THRESHOLD, 2**30) and mallopt(M_TRIM_THRESHOLD, never))


def largest_file() -> float:
    """Return how many bytes a file of this process may have; infinity without a limit."""
    try:
        import resource
    except ImportError:  # not a Unix
        return math.inf
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return math.inf if limit == resource.RLIM_INFINITY else limit
