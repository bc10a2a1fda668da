"""Checkpoints: plain tensors, numbers, strings, lists and dicts, written whole and read without running code."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hudepth.base.errors import CheckpointError, did_you_mean, first_line
from hudepth.models.build import build_network
from hudepth.runs import bundles, hub
from hudepth.runs.run import best_checkpoint, find_run, is_run, newest_run
from hudepth.runs.sections import check_config

KEY = "hudepth"
"""Where a Lightning checkpoint keeps what hudepth adds: format version, configuration, split."""
VERSION = 2
"""1: before the encoder and the head were renamed."""
NET_PREFIX = "net."
SUFFIXES = (".ckpt", ".pt", ".pth")


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint, read and checked; no network is built yet."""

    path: Path
    run: Path | None
    """Its run directory, None if it was moved elsewhere."""
    config: dict[str, Any]
    split: dict[str, Any]
    """Summary of the split it was trained on."""
    data: dict[str, Any]
    """Source, fingerprint, encoding and number of pairs of the data it was trained on."""
    epoch: int
    """Finished epochs."""
    state: dict[str, Tensor]
    size_bytes: int
    """Of the file that the tensors were read from: no valid network is larger."""

    def build_net(self, *, trust: list[str]) -> nn.Module:
        """Return the network in evaluation mode; its configuration may name classes of the modules in ``trust``.

        It is first built on the meta device and compared with the checkpoint's tensors, so that a configuration that
        asks for more than the file holds cannot exhaust memory. Trusted code is built once, without this check. Raises
        CheckpointError if the tensors do not fit; ConfigError if the class is untrusted or not a network.
        """
        model = dict(self.config["model"])
        if "weights" in model:
            model["weights"] = None  # no longer needed
        if not trust:
            if sum(tensor.nbytes for tensor in self.state.values()) > self.size_bytes:
                raise CheckpointError(f"'{self.path}' is refused: its tensors claim more memory than the file holds.")
            with torch.device("meta"):
                self._check_fits(build_network(model).state_dict(), self.state)
        net = build_network(model, trust=trust)
        self.fill(net)
        return net.eval()

    def fill(self, net: nn.Module, *, skip: Sequence[str] = ()) -> None:
        """Load the tensors into a network, but not into the parts named in ``skip``, whatever shapes these have.

        Raises CheckpointError if they do not fit, or neither network nor checkpoint has such a part.
        """
        own = net.state_dict()
        for part in skip:
            if not any(_is_of(name, [part]) for name in {**own, **self.state}):
                parts = ", ".join(dict.fromkeys(name.partition(".")[0] for name in own))
                raise CheckpointError(f"init_skip: {type(net).__name__} has no part '{part}'. It has {parts}.")
        state = {name: tensor for name, tensor in self.state.items() if not _is_of(name, skip)}
        state |= {name: tensor for name, tensor in own.items() if _is_of(name, skip)}
        self._check_fits(own, state)
        net.load_state_dict(state)

    def _check_fits(self, own: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> None:
        names = {**own, **given}
        misfits = [n for n in names if n not in own or n not in given or own[n].shape != given[n].shape]
        if misfits:
            raise CheckpointError(
                f"'{self.path}' is from another model: {len(misfits)} tensors do not fit "
                f"{self.config['model'].get('_target_')}, the first is '{misfits[0]}'. "
                "Pass a checkpoint whose configuration matches its weights."
            )


def _is_of(name: str, parts: Sequence[str]) -> bool:
    """Return whether a tensor belongs to one of a network's parts."""
    return any(name.startswith(f"{part}.") for part in parts)


def find_checkpoint(spec: str, *, runs: str | Path, key: str = "checkpoint") -> Path:
    """Return the file or folder that ``spec``, the value of ``key``, means. Raises CheckpointError if there is none.

    ``spec`` is a file; a run directory (its best checkpoint, else its last); a bundle; ``last`` (the newest run below
    ``runs``); one of :data:`hudepth.runs.bundles.PRETRAINED`; or ``hf:owner/name``, a bundle on the Hugging Face Hub.
    """
    if spec.startswith(hub.PREFIX):
        return hub.download(spec, key=key)
    if spec in bundles.PRETRAINED:
        return bundles.pretrained(spec)
    path = newest_run(runs) if spec == "last" else Path(spec).expanduser()
    if bundles.is_bundle(path):
        return path
    if path.is_dir():
        if file := best_checkpoint(path):
            return file
        if not is_run(path):
            raise CheckpointError(f"{key}: '{path}' is not a run directory. Pass a file, a run, or last.")
        raise CheckpointError(f"{key}: the run '{path}' has no checkpoint: no epoch was finished. Resume it.")
    if not path.is_file():
        hint = did_you_mean(spec, (*bundles.PRETRAINED, "last"))
        raise CheckpointError(f"{key}: no file or run directory '{path}'.{hint} Pass a file, a run directory, or last.")
    return path


def read_plain(path: Path) -> dict[str, Any]:
    """Read a file of plain types. Raises CheckpointError, without running code, for anything else."""
    _check_archive(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        why = "it holds more than tensors and plain values, so loading it could run code"
        raise CheckpointError(f"'{path}' is refused: {why}. Use a checkpoint written by hudepth-train.") from error
    except Exception as error:
        raise _damaged(path, error) from error
    if not isinstance(content, dict):
        raise CheckpointError(f"'{path}' is not a checkpoint: it holds a {type(content).__name__}. Pass another file.")
    return content


def _check_archive(path: Path) -> None:
    """Refuse a damaged file before any of it is unpickled, and one that unpacks to more than its size."""
    if not zipfile.is_zipfile(path) and path.suffix.lower() not in SUFFIXES:
        raise CheckpointError(f"'{path}' is no checkpoint. Pass a run directory, checkpoint or bundle.")
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
            fits = unpacked <= path.stat().st_size  # torch.save does not compress
            broken = archive.testzip() if fits else None
    except Exception as error:  # zipfile raises many kinds
        raise _damaged(path, error) from error
    if not fits:
        why = "it unpacks to more than its own size"
        raise CheckpointError(f"'{path}' is refused: {why}. Use a checkpoint written by hudepth-train.")
    if broken:
        raise _damaged(path, zipfile.BadZipFile(f"'{broken}' has a wrong checksum"))


def _damaged(path: Path, error: Exception) -> CheckpointError:
    return CheckpointError(f"'{path}' cannot be read as a checkpoint; it is damaged or cut off ({first_line(error)}).")


def load_checkpoint(spec: str, *, runs: str | Path = "runs", key: str = "checkpoint") -> Checkpoint:
    """Read what :func:`find_checkpoint` finds. Raises CheckpointError if it is damaged, unsafe, or not hudepth's."""
    path = find_checkpoint(spec, runs=runs, key=key)
    if bundles.is_bundle(path):
        own, tensors, size_bytes = bundles.read_bundle(path)
        epoch, run = own.get("epoch"), None
    else:
        content = read_plain(path)
        if not isinstance(content.get(KEY), dict) or "state_dict" not in content:
            raise CheckpointError(f"'{path}' was not written by hudepth-train: it has no '{KEY}' entry.")
        own, size_bytes = content[KEY], path.stat().st_size
        tensors, run = content["state_dict"], find_run(path.resolve())
        epoch = content["epoch"] + 1 if isinstance(content.get("epoch"), int) else None
    if own.get("version") != VERSION:
        fix = (
            "It was written by a pre-release of hudepth 0.1: train or export again with this version."
            if own.get("version") == 1
            else "Use the version of hudepth that wrote it, or train again with this one."
        )
        raise CheckpointError(f"'{path}' has format version {own.get('version')}, this hudepth reads {VERSION}. {fix}")
    parts: list[Any] = [own.get(key) for key in ("config", "split", "data")]
    config, split, data = parts
    mappings = all(isinstance(part, dict) for part in parts) and isinstance(config.get("model"), dict)
    if not (mappings and isinstance(epoch, int) and _is_state(tensors)):
        raise CheckpointError(f"'{path}' is incomplete: configuration, split, data, epoch or tensors are missing.")
    check_config(config, where=path)
    state = {n.removeprefix(NET_PREFIX): v for n, v in tensors.items() if n.startswith(NET_PREFIX)}
    return Checkpoint(path, run, config, split, data, epoch, state, size_bytes)


def _is_state(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(n, str) and _is_plain(v) for n, v in value.items())


def _is_plain(value: object) -> bool:
    """Tell whether a value is a tensor with real numbers in memory: neither sparse, quantised, nor without any."""
    if not isinstance(value, Tensor):
        return False
    dense = value.layout == torch.strided and value.device.type == "cpu"
    return dense and not (value.is_quantized or value.is_complex())
