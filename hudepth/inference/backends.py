"""What computes a prediction: PyTorch, ONNX Runtime or OpenVINO, all behind one call."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import nn

from hudepth.base.errors import CheckpointError, ConfigError, did_you_mean
from hudepth.base.normalise import NormaliseBytes
from hudepth.inference.info import KEY, ModelInfo
from hudepth.inference.pipeline import DepthPipeline
from hudepth.inference.runtimes import PRECISIONS, onnx_session, openvino_model
from hudepth.models.inference import inference_form
from hudepth.runs.checkpoint import Checkpoint

EXPORTED = {".onnx": "onnxruntime", ".xml": "openvino", ".pt2": "torch"}
"""Exported files, and the backend that reads each wherever its package is installed."""
BACKENDS = ("auto", "torch", "onnxruntime", "openvino")
PT2 = "pt2"
"""What ``trust`` must name before a .pt2 file is read: PyTorch unpacks parts of it in a way that can run code."""

_NORMALISE = NormaliseBytes()


@runtime_checkable
class Backend(Protocol):
    """A model, ready to run."""

    info: ModelInfo
    name: str
    """As in :data:`BACKENDS`."""

    def __call__(self, rgb: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] of RGB images at the model's size."""
        ...


class TorchBackend:
    """A network in PyTorch.

    Args:
        net: normalised image to unit depth, in the form it shall run in.
        info: what it is.
        device: where to run it.
    """

    name = "torch"

    def __init__(self, net: nn.Module, info: ModelInfo, *, device: torch.device) -> None:
        self.info, self.device = info, device
        self.pipeline = DepthPipeline(net, max_depth_m=info.max_depth_m).to(device)

    def __call__(self, rgb: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] of RGB images at the model's size."""
        with torch.inference_mode():
            depth: torch.Tensor = self.pipeline(torch.from_numpy(rgb).to(self.device))
            return np.asarray(depth.cpu().numpy())


class ProgramBackend:
    """A ``.pt2`` file that ``torch.export`` wrote.

    Args:
        path: the file; the caller trusts it.

    Raises:
        CheckpointError: if it cannot be read or was not exported by hudepth.
    """

    name = "torch"

    def __init__(self, path: Path) -> None:
        extra = {f"{KEY}.json": ""}
        try:
            program = torch.export.load(path, extra_files=extra)
        except Exception as error:
            raise _unreadable(path, error) from error
        self.info = _described(extra[f"{KEY}.json"], path)
        self._module = program.module()

    def __call__(self, rgb: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] of RGB images at the model's size."""
        images = torch.from_numpy(rgb)
        with torch.inference_mode():
            if self.info.processing:
                return np.asarray(self._module(images).numpy())
            return _to_metres(self._module(_NORMALISE(images)).numpy(), self.info)


class OnnxBackend:
    """An ONNX file in ONNX Runtime, on the CPU.

    Args:
        path: the file.
        threads: to compute with.

    Raises:
        CheckpointError: if it cannot be read or was not exported by hudepth.
    """

    name = "onnxruntime"

    def __init__(self, path: Path, *, threads: int) -> None:
        self._session = _opened(path, partial(onnx_session, threads=threads))
        described = self._session.get_modelmeta().custom_metadata_map.get(KEY, "")
        self.info = _described(described, path)
        self._input = self._session.get_inputs()[0].name

    def __call__(self, rgb: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] of RGB images at the model's size."""
        (result,) = self._session.run(None, {self._input: _graph_input(rgb, self.info)})
        return _graph_output(result, self.info)


class OpenVinoBackend:
    """An OpenVINO IR or ONNX file in OpenVINO, on the CPU.

    Args:
        path: ``.xml`` with its ``.bin`` beside it, or ``.onnx``.
        threads: to compute with.
        precision: of :data:`PRECISIONS`; a quantised model computes in int8 either way.

    Raises:
        CheckpointError: if it cannot be read or was not exported by hudepth.
    """

    name = "openvino"

    def __init__(self, path: Path, *, threads: int, precision: str = "float32") -> None:
        model, self._request = _opened(path, partial(openvino_model, threads=threads, precision=precision))
        described = _openvino_description(model)
        self.info = _described(described, path)

    def __call__(self, rgb: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] of RGB images at the model's size."""
        result = self._request.infer({0: _graph_input(rgb, self.info)}, share_inputs=True)
        return _graph_output(np.array(result[0]), self.info)


def _openvino_description(model: Any) -> str:
    for path in ([KEY], ["framework", KEY]):  # where an IR keeps it, where one that was read from ONNX does
        if model.has_rt_info(path):
            return str(model.get_rt_info(path).astype(str))
    return ""


def _graph_input(rgb: UInt8[np.ndarray, "b h w 3"], info: ModelInfo) -> NDArray[Any]:
    if info.processing:
        return rgb
    return np.asarray(_NORMALISE(torch.from_numpy(rgb)).contiguous().numpy())


def _graph_output(result: NDArray[Any], info: ModelInfo) -> Float[np.ndarray, "b h w"]:
    return np.asarray(result) if info.processing else _to_metres(result, info)


def _to_metres(unit_depth: NDArray[Any], info: ModelInfo) -> Float[np.ndarray, "b h w"]:
    return np.maximum(unit_depth[:, 0] * np.float32(info.max_depth_m), np.float32(0))


def torch_backend(
    checkpoint: Checkpoint, *, device: torch.device, trust: list[str], size: tuple[int, int] | None = None
) -> TorchBackend:
    """Return a checkpoint as it runs fastest without a change of more than rounding.

    Args:
        checkpoint: what to run.
        device: where.
        trust: further modules whose classes its configuration may name.
        size: (height, width) of its input; that of its training by default.

    Raises:
        HudepthError: if the network cannot be built or does not take the size.
    """
    net = checkpoint.build_net(trust=trust)
    info = info_of(checkpoint, parameters=sum(p.numel() for p in net.parameters()), size=size)
    return TorchBackend(inference_form(net.to(device), size=info.size), info, device=device)


def info_of(checkpoint: Checkpoint, *, parameters: int, size: tuple[int, int] | None = None) -> ModelInfo:
    """Return what is known of a checkpoint.

    Raises:
        CheckpointError: if it does not say what it was trained on.
    """
    data = checkpoint.config.get("data")
    try:
        height, width = size or data["size"]  # type: ignore[index]
        sizes = checkpoint.data.get("native_sizes") or []
        aspect = {"aspect": sizes[0][1] / sizes[0][0]} if len(sizes) == 1 else {}
        return ModelInfo(
            name=str(checkpoint.config["model"].get("_target_", "")).rpartition(".")[2],
            size=(int(height), int(width)),
            max_depth_m=float(data["max_depth_m"]),  # type: ignore[index]
            parameters=parameters,
            epoch=checkpoint.epoch,
            trained_on={**checkpoint.data, "split": checkpoint.split},
            **aspect,
        )
    except (TypeError, KeyError, ValueError, IndexError, ZeroDivisionError) as error:
        raise CheckpointError(f"'{checkpoint.path}' does not say what data it was trained on.") from error


def open_exported(path: Path, *, backend: str, threads: int, trust: list[str], precision: str) -> Backend:
    """Return an exported file, ready to run.

    Args:
        path: ``.onnx``, ``.xml`` or ``.pt2``.
        backend: of :data:`BACKENDS`; ``auto`` takes OpenVINO for ONNX where it is installed, since it is faster.
        threads: to compute with.
        trust: must name ``pt2`` for a ``.pt2`` file.
        precision: of :data:`PRECISIONS`, for OpenVINO.

    Raises:
        CheckpointError: if it cannot be read, is not trusted, or was not exported by hudepth.
        ConfigError: if the backend does not read it or is not installed.
    """
    suffix = path.suffix.lower()
    readers = {EXPORTED[suffix], "openvino"} if suffix == ".onnx" else {EXPORTED[suffix]}
    chosen = backend
    if backend == "auto":
        chosen = "openvino" if "openvino" in readers and importlib.util.find_spec("openvino") else EXPORTED[suffix]
    if chosen not in readers:
        raise ConfigError(
            f"backend={backend}: does not read '{path.name}'. Pass backend={' or '.join(sorted(readers))}."
        )
    if precision != "float32" and chosen != "openvino":
        raise ConfigError(
            f"precision={precision}: only OpenVINO computes in it. Pass backend=openvino and a .onnx or .xml."
        )
    if chosen == "torch":
        if PT2 not in trust:
            raise CheckpointError(
                f"'{path}' is a program that could run any code when it is loaded. If you exported it yourself, pass "
                f"trust=[{PT2}]; else ask for an ONNX file or a bundle."
            )
        return ProgramBackend(path)
    if chosen == "openvino":
        return OpenVinoBackend(path, threads=threads, precision=precision)
    return OnnxBackend(path, threads=threads)


def check_backend(backend: str, precision: str) -> None:
    """Check two choices.

    Raises:
        ConfigError: if there is no such backend or precision.
    """
    for key, value, choices in (("backend", backend, BACKENDS), ("precision", precision, tuple(PRECISIONS))):
        if value not in choices:
            raise ConfigError(f"{key}: no '{value}'.{did_you_mean(value, choices)} Pass one of {', '.join(choices)}.")


def _opened(path: Path, read: Callable[[Path], Any]) -> Any:
    try:
        return read(path)
    except ConfigError:  # the package is not there
        raise
    except Exception as error:
        raise _unreadable(path, error) from error


def _described(text: str, path: Path) -> ModelInfo:
    if not text:
        raise CheckpointError(
            f"'{path}' was not exported by hudepth: it does not say its size and units. "
            "Export a checkpoint with hudepth-export."
        )
    return ModelInfo.from_json(text, where=f"'{path}'")


def _unreadable(path: Path, error: Exception) -> CheckpointError:
    reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
    return CheckpointError(f"'{path}' cannot be read as a model; it is damaged or of another kind ({reason}).")
