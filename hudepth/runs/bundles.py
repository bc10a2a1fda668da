"""Bundles: a model as a folder or zip to share, in the layout of model hubs, with weights that cannot hold code.

====================  ===============================================================================
README.md             the model card
config.json           model, data and split as in a checkpoint, without paths of the machine it was made on
model.safetensors     the network's tensors
model.onnx            RGB bytes in, metres out
metrics/              test results, one file per protocol
samples/              pictures
====================  ===============================================================================
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from hudepth.base.errors import CheckpointError
from hudepth.base.verbs import shipped

CONFIG, WEIGHTS, ONNX, CARD = "config.json", "model.safetensors", "model.onnx", "README.md"
KIND = "hudepth-bundle"
PRETRAINED = {"nyu": "strong_official", "nyu_lite": "lite_official"}
"""The bundled pretrained models by their names for ``checkpoint=``, each with the folder of ``experiments`` it is from:
``nyu``, the paper's network, and ``nyu_lite``, the network for CPUs."""
MAX_CONFIG_BYTES = 1 << 22
MAX_WEIGHTS_BYTES = 1 << 32


def pretrained(name: str) -> Path:
    """Return the folder of one of :data:`PRETRAINED`. Raises CheckpointError if this installation lacks it."""
    folder = shipped(f"pretrained/{name}", f"experiments/{PRETRAINED[name]}/{name}")
    if not is_bundle(folder):
        fix = "Install hudepth again, or pass a run or a file."
        raise CheckpointError(f"checkpoint: the weights of '{name}' are not part of this installation. {fix}")
    return folder


def is_bundle(path: Path) -> bool:
    """Tell whether ``path`` looks like a bundle: a folder with configuration and weights, its weights, or a zip."""
    if path.is_dir():
        return (path / CONFIG).is_file() and (path / WEIGHTS).is_file()
    return path.is_file() and path.suffix.lower() in (".zip", ".safetensors")


def read_bundle(path: Path) -> tuple[dict[str, Any], dict[str, Any], int]:
    """Return a bundle's configuration, its tensors, and the number of bytes they were read from.

    ``path`` is a folder, its ``model.safetensors``, or a zip of the folder; nothing is unpacked to the disk, and
    nothing in it can run code. Raises CheckpointError if it is damaged, too large, not a bundle, or holds paths outside
    its folder.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    is_zip = path.suffix.lower() == ".zip"
    config, weights = _from_zip(path) if is_zip else _from_folder(path if path.is_dir() else path.parent)
    try:
        content = json.loads(config)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"'{path}': its {CONFIG} cannot be read ({error}).") from error
    if not isinstance(content, dict) or content.get("kind") != KIND:
        raise CheckpointError(f"'{path}' is not a bundle of hudepth. Make one with hudepth-export format=bundle.")
    try:
        tensors = load(weights)
    except (SafetensorError, ValueError, KeyError) as error:
        raise CheckpointError(f"'{path}': its {WEIGHTS} is damaged or cut off ({error}).") from error
    return content, {f"net.{name}": tensor for name, tensor in tensors.items()}, len(weights)


def _from_folder(folder: Path) -> tuple[bytes, bytes]:
    read = []
    for name, limit in ((CONFIG, MAX_CONFIG_BYTES), (WEIGHTS, MAX_WEIGHTS_BYTES)):
        file = folder / name
        if not file.is_file():
            raise CheckpointError(f"'{folder}' is not a bundle: it has no {name}. Pass the folder that has it.")
        if file.stat().st_size > limit:
            raise CheckpointError(f"'{file}' is refused: larger than {limit >> 20} MiB.")
        read.append(file.read_bytes())
    return read[0], read[1]


def _from_zip(path: Path) -> tuple[bytes, bytes]:
    try:
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                windows = PureWindowsPath(name)
                if name.startswith("/") or windows.anchor or ".." in {*PurePosixPath(name).parts, *windows.parts}:
                    raise CheckpointError(f"'{path}' is refused: it holds '{name}', a path outside its folder.")
            return _member(path, archive, CONFIG, MAX_CONFIG_BYTES), _member(path, archive, WEIGHTS, MAX_WEIGHTS_BYTES)
    except CheckpointError:
        raise
    except Exception as error:  # zipfile raises many kinds
        raise CheckpointError(f"'{path}' cannot be read as a zip; it is damaged or cut off ({error}).") from error


def _member(path: Path, archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """Read a file of the zip, at its top or in its only folder."""
    found = [entry for entry in archive.infolist() if PurePosixPath(entry.filename).name == name]
    found = [entry for entry in found if len(PurePosixPath(entry.filename).parts) <= 2]
    if len(found) != 1:
        raise CheckpointError(f"'{path}' is not a bundle of hudepth: it has {len(found) or 'no'} {name}.")
    # weights hardly compress: a file that grows tenfold is made to fill memory
    if found[0].file_size > min(limit, 10 * path.stat().st_size + MAX_CONFIG_BYTES):
        raise CheckpointError(f"'{path}' is refused: its {name} unpacks to {found[0].file_size >> 20} MiB.")
    with archive.open(found[0]) as file:
        return file.read(found[0].file_size)
