"""Errors as one line for the person at the prompt: those of Hydra and OmegaConf are translated."""

from __future__ import annotations

import errno
import json
import os
import re
import sys
import traceback
from collections.abc import Iterator
from typing import Any

from hudepth.base.errors import HudepthError, OptionError, did_you_mean
from hudepth.base.verbs import conf_folder, options_of

LAUNCHERS = {
    "joblib": "joblib", "submitit_local": "slurm", "submitit_slurm": "slurm", "submitit": "slurm", "ray": "ray",
}  # fmt: skip
"""Ways to run the jobs of a sweep, and the extra of this package that installs each."""

_ROOM = {
    errno.ENOSPC: "Free some space",
    errno.EDQUOT: "Free some of your quota",
    errno.EFBIG: "Raise the limit of file sizes (ulimit -f)",
}
_FOLDER = "Pass a folder that you can write to."
_FIXES = {
    **{code: f"{fix}, or pass a folder on another disk." for code, fix in _ROOM.items()},
    errno.EROFS: _FOLDER, errno.EACCES: _FOLDER, errno.EPERM: _FOLDER, errno.ENOTDIR: _FOLDER,
    errno.EIO: "Check the disk.",
    errno.EISDIR: "Remove the folder of that name, or pass another.",
    errno.ENAMETOOLONG: "Pass a shorter name.", errno.ELOOP: "Remove the link.",
}  # fmt: skip
"""What to do about a file that could not be written, by the system's number of the error."""

_FULL = ("CUDA error: out of memory", "CUBLAS_STATUS_ALLOC_FAILED", "CUDNN_STATUS_ALLOC_FAILED")
_LESS = {
    "train": "a smaller data.batch_size=, data.on_device=false or trainer.accelerator=cpu",
    "test": "a smaller data.batch_size= or trainer.accelerator=cpu",
    "predict": "a smaller batch_size= or size=, or device=cpu",
    "demo": "device=cpu", "bench": "smaller batches= or device=cpu",
}  # fmt: skip
"""What takes less of a GPU's memory, by command."""
_ON_CPU = {"train": "trainer.accelerator=cpu", "test": "trainer.accelerator=cpu"}


def one_line(error: BaseException, task: str) -> str:
    """Return an error as one line that suggests a fix.

    Args:
        error: whatever was raised.
        task: whose configuration names are suggested.
    """
    chain = list(_chain(error))
    for cause in chain:
        if isinstance(cause, HudepthError):
            return " ".join(str(cause).split()) + (_default(cause, task) if isinstance(cause, OptionError) else "")
    for cause in chain:
        if line := gpu_line(cause, task) or _config_line(cause, task):
            return line
    for cause in chain:
        if isinstance(cause, OSError) and (line := unwritten(cause)):
            return line
    message = " ".join(str(error).split()) or type(error).__name__
    return f"{type(error).__name__}: {message} (debug=true shows the traceback)"


def more_room(error: OSError) -> str:
    """Return how to get room for what could not be written."""
    return _ROOM.get(error.errno or 0, _ROOM[errno.ENOSPC])


def unwritten(error: OSError) -> str:
    """Return the line of a file that could not be written; empty for other errors."""
    if error.errno not in _FIXES:
        return ""
    name = f"'{error.filename}'" if error.filename else "a file"
    return f"{name} cannot be written ({os.strerror(error.errno)}). {_FIXES[error.errno]}"


def gpu_line(error: BaseException, task: str) -> str:
    """Return the line of a GPU that is full or taken; empty for other errors."""
    text = str(error)  # PyTorch's own class is not imported for it: that takes seconds
    if type(error).__name__ == "OutOfMemoryError" or any(each in text for each in _FULL):
        wanted = re.search(r"Tried to allocate ([\d.]+ \w+)", text)
        free = re.search(r"of which ([\d.]+ \w+) is free", text)
        found = ", ".join([*([f"{wanted[1]} more needed"] if wanted else []), *([f"{free[1]} free"] if free else [])])
        fix = f"Pass {_LESS.get(task, 'device=cpu')}, or end what else uses the GPU (nvidia-smi lists it)."
        return f"the GPU has too little memory{f' ({found})' if found else ''}. {fix}"
    if "busy or unavailable" in text:
        return f"the GPU is taken by another program (nvidia-smi lists it). Pass {_ON_CPU.get(task, 'device=cpu')}."
    return ""


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    seen: set[int] = set()  # an error that is raised again and again can be part of its own context
    while error is not None and id(error) not in seen:
        yield error
        seen.add(id(error))
        error = error.__cause__ or error.__context__


def _config_line(error: BaseException, task: str) -> str | None:
    """Word the errors of Hydra and OmegaConf, with suggestions."""
    module = type(error).__module__.partition(".")[0]
    if module == "builtins" and (frames := list(traceback.walk_tb(error.__traceback__))):  # a ValueError of Hydra's
        module = str(frames[-1][0].f_globals.get("__name__")).partition(".")[0]
    if module not in ("hydra", "omegaconf", "antlr4"):
        return None
    text = str(error)
    if found := re.search(r"Could not (?:find|load) '([^']+)'", text):
        group, _, name = found[1].rpartition("/")
        options = options_of(group)
        if options:
            options += [each for each in (*LAUNCHERS, "basic") if group == "hydra/launcher" and each not in options]
            return f"{group}: no '{name}'.{did_you_mean(name, options)} Pass one of {', '.join(options)}."
    if found := re.search(r"Could not override '([^']+)'|Key '([^']+)' is not in struct", text):
        key = found[1] or getattr(error, "full_key", None) or found[2]
        plus = (
            f" Further arguments of lightning.Trainer take a plus: +{key}=<value>."
            if key.startswith("trainer.")
            else ""
        )
        known = known_keys(task)
        hint = "" if key in known else did_you_mean(key, known)  # a group, but of another task
        return f"no key '{key}'.{hint} See hudepth-{task} --cfg job for all keys.{plus}"
    if "Override" in type(error).__name__ or module == "antlr4" or "NoViableAlt" in text:
        typed = str(getattr(error, "override", None) or text.split(": ", 1)[-1])[:200]
        return f"cannot read '{typed}': write key=value, and quote values with special characters: 'key=\"a, b\"'."
    return " ".join(text.split())


def _default(error: OptionError, task: str) -> str:
    """Return what an option is if nobody sets it, as a sentence; empty if the line has a fix, or it is no option."""
    if "Leave " in str(error) or "Did you mean" in str(error):
        return ""
    value: Any = _composed(task)
    for part in error.key.split("."):
        value = value.get(part, "???") if isinstance(value, dict) else "???"
    if value is None or isinstance(value, dict) or any(mark in str(value) for mark in ("???", "${")):
        return ""
    return f" The default is {json.dumps(value)}."


def known_keys(task: str) -> list[str]:
    """Return all dotted keys and groups of the task's configuration, with the groups chosen on the command line."""
    keys = list(_dotted(_composed(task)))
    return [*keys, *(path.name for path in conf_folder().iterdir() if path.is_dir() and not path.name.startswith("_"))]


def _composed(task: str) -> Any:
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        try:
            config = compose(task, overrides=_chosen_groups())
        except Exception:  # a group chosen that this task does not have, which may be the very mistake
            config = compose(task)
    return OmegaConf.to_container(config, resolve=False)


def _chosen_groups() -> list[str]:
    pairs = [argument.partition("=") for argument in sys.argv[1:]]
    return [f"{group}={name}" for group, _, name in pairs if name in options_of(group.lstrip("+"))]


def _dotted(config: Any, prefix: str = "") -> Iterator[str]:
    for key, value in config.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _dotted(value, f"{prefix}{key}.")
