"""The model card: what users must know before they use a model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import yaml

from hudepth import __version__
from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import find_class
from hudepth.base.tables import Table
from hudepth.data.sources.base import Source
from hudepth.inference.model_info import ModelInfo
from hudepth.metrics.catalogue import metric_info, metric_names
from hudepth.runs.checkpoint import Checkpoint

HERE = "<this folder or its zip>"
CITATION = """@article{turkmen2025hybrid,
  title   = {A Hybrid UNet with Attention and a Perceptual Loss Function for Monocular Depth Estimation},
  author  = {Turkmen, Hamidullah and Akgun, Devrim},
  journal = {Mathematics},
  volume  = {13},
  number  = {16},
  pages   = {2567},
  year    = {2025},
  doi     = {10.3390/math13162567}
}"""


def model_card(
    checkpoint: Checkpoint, info: ModelInfo, *, name: str, results: Mapping[str, Mapping[str, Any]], parity: str,
    samples: int = 0, origin: str = "", half: bool = False, trust: Iterable[str] = (), address: str = HERE,
) -> str:  # fmt: skip
    """Return the card of a model, as Markdown with the header that model hubs read.

    Args:
        checkpoint: records how it was trained.
        info: its inputs and outputs.
        name: of the model.
        results: contents of ``metrics.json`` by protocol; may be empty.
        parity: the difference between the checkpoint and the ONNX file or 16-bit weights, in words; empty if there is
            no ONNX file and the weights are the checkpoint's.
        samples: number of sample pictures, which show ``origin``, for example ``test images of nyu_labeled``.
        half: kernels and matrices are stored as 16-bit floats, and there is no ONNX file.
        trust: packages whose data sets may be imported for their terms.
        address: what ``checkpoint=`` takes: ``hf:owner/name`` of a published bundle.
    """
    source, data_set = str(checkpoint.data.get("source", "unknown")), _source_class(checkpoint, trust)
    header = {
        "library_name": "hudepth", "pipeline_tag": "depth-estimation", "license": data_set.licence,
        "tags": ["depth-estimation", "monocular-depth", *["onnx"] * (bool(parity) and not half), "hudepth"],
        "model-index": [{"name": name, "results": _index(results, source)}],
    }  # fmt: skip
    sections = (
        f"---\n{yaml.safe_dump(header, sort_keys=False)}---\n\n# {name}", _about(info),
        _use(info, parity, address, half=half),
        _training(checkpoint, source), _results(results), _samples(samples, origin) if samples else "",
        _limits(info, source),
        "## Licence\n\nCode: MIT. Training data: "
        + (data_set.terms or f"'{source}', whose terms the publisher of this model must state here.")
        + " What this means for the weights is for you to judge.",
        f"## How to cite\n\nhudepth {__version__}, and the paper it implements:\n\n```bibtex\n{CITATION}\n```",
    )  # fmt: skip
    return "\n\n".join(section for section in sections if section) + "\n"


def _source_class(checkpoint: Checkpoint, trust: Iterable[str]) -> type[Source]:
    """Return the class of the training data; the base class, which states no terms, if it cannot be imported."""
    target = checkpoint.config.get("data", {}).get("source", {}).get("_target_", "")
    try:
        found = find_class(str(target), trust=trust)
    except ConfigError:
        return Source
    return found if issubclass(found, Source) else Source


def _about(info: ModelInfo) -> str:
    height, width = info.size
    calibrated = f" It is {info.calibration} (in metres, as the network predicts it)." if info.calibration else ""
    return (
        f"Depth in metres from a single RGB image: {info.name}, {info.parameters:,} parameters, input {height} x "
        f"{width} (height x width), depths up to {info.farthest_m:.4g} m. Made with hudepth, which implements "
        f"Turkmen & Akgun (2025).{calibrated}"
    )


def _index(results: Mapping[str, Mapping[str, Any]], source: str) -> list[dict[str, Any]]:
    """Return the results as the Hub's ``model-index``, one entry for each protocol."""
    return [
        {
            "task": {"type": "depth-estimation"},
            "dataset": {"type": source, "name": f"{source}, protocol {protocol}", "split": "test"},
            "metrics": [
                {"type": name, "name": metric_info(name).label, "value": result["metrics"]["model"][name]}
                for name in metric_names("narrow", among=result["metrics"]["model"])
                if result["metrics"]["model"][name] is not None
            ],
        }
        for protocol, result in results.items()
    ]


def _use(info: ModelInfo, parity: str, address: str, *, half: bool) -> str:
    height, width = info.size
    if half or not parity:
        kind = "kernels and matrices as 16-bit floats; computation uses 32 bits" if half else "float32 tensors"
        compared = f" Compared with the trained weights, it is {parity}." if parity else ""
        files = f"`model.safetensors` holds {kind}.{compared} `config.json` describes the network."
    else:
        files = (
            f"`model.onnx` needs no hudepth: input `image` uint8 [batch, {height}, {width}, 3], RGB, the whole image "
            f"resized to this size (averaged over areas); output `depth_m` float32 [batch, {height}, {width}] in "
            f"metres. It is {parity}.\n"
            "`model.safetensors` holds float32 tensors, `config.json` describes the network."
        )
    return (
        f"## Use\n\n```bash\nhudepth-predict checkpoint={address} input=photos\n```\n\n"
        f'```python\nimport hudepth\n\ndepth = hudepth.load("{address}").predict("photo.jpg")\n'
        "depth.metres  # float32 [height, width], metres along the optical axis\n```\n\n" + files
    )


def _training(checkpoint: Checkpoint, source: str) -> str:
    split = checkpoint.split
    counts = ", ".join(f"{count:,} {name}" for name, count in split.get("counts", {}).items())
    before = [f"{each.get('source')}, {each.get('pairs')} pairs" for each in checkpoint.data.get("before", [])]
    rows = {
        "data": f"{source}, {checkpoint.data.get('pairs')} pairs, depth encoding {checkpoint.data.get('encoding')}",
        "fingerprint of the data": f"`{checkpoint.data.get('fingerprint')}`",
        "split": f"{split.get('kind')}, seed {split.get('seed')}: {counts}",
        "hash of the split": f"`{split.get('sha256')}`",
        "epochs": str(checkpoint.epoch),
        "loss": _loss(checkpoint.config.get("loss") or {}),
        **({"trained before on": "; ".join(before)} if before else {}),
    }
    return "## Training\n\n| | |\n|---|---|\n" + "\n".join(f"| {key} | {value} |" for key, value in rows.items())


def _loss(loss: Mapping[str, Any]) -> str:
    names = [f"{weight:g} {_class(loss['losses'][part])}" for part, weight in loss.get("weights", {}).items() if weight]
    return " + ".join(names) or _class(loss)


def _class(config: Mapping[str, Any]) -> str:
    return str(config.get("_target_", "unknown")).rpartition(".")[2]


def _results(results: Mapping[str, Mapping[str, Any]]) -> str:
    if not results:
        return "## Results\n\nNone are recorded. Run `hudepth-test`, then export the run again."
    names = metric_names("narrow", among={key for result in results.values() for key in result["metrics"]["model"]})
    table = Table(["protocol", "images", *(metric_info(name).label for name in names)], left=2)
    for protocol, result in results.items():
        values, ranges = result["metrics"]["model"], result.get("intervals", {}).get("model", {})
        table.add(protocol, str(result["images"]), *(_cell(name, values.get(name), ranges.get(name)) for name in names))
    return (
        "## Results\n\n"
        "On the test subset of that split; in brackets 95 % intervals by bootstrap over scenes. Crop, caps, mask and\n"
        f"averaging of each protocol are in `metrics/`.\n\n{table.to_markdown().strip()}"
    )


def _cell(name: str, value: float | None, ends: Any) -> str:
    info = metric_info(name)
    if value is None:
        return "-"
    return info.format(value) + (f" [{', '.join(map(info.format, ends))}]" if ends and None not in ends else "")


def _samples(count: int, origin: str) -> str:
    pictures = "\n".join(f"![image and predicted depth](samples/{number}.jpg)" for number in range(count))
    caption = "not selected by hand. Left: the image at the network's size, right: its depth."
    return f"## Samples\n\n{pictures}\n\nFrom the {origin}, {caption}"


def _limits(info: ModelInfo, source: str) -> str:
    return (
        "## Limits\n\n"
        f"- Trained on scenes like those of `{source}`. Elsewhere (outdoors, other cameras, other heights) its metres "
        "are guesses: a single image does not determine scale.\n"
        f"- It predicts nothing beyond {info.farthest_m:.4g} m.\n"
        "- Images are resized to the input size as in training; another field of view shifts all distances, unless\n"
        "  `camera=` of `hudepth-predict` or the file's EXIF states it.\n"
        "- Errors are largest at mirrors, glass, thin objects and edges. Do not steer or brake by it."
    )
