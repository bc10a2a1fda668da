"""The model card: what a stranger must know before using a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hudepth import __version__
from hudepth.inference.info import ModelInfo
from hudepth.runs.checkpoint import Checkpoint

SHOWN = ("abs_rel", "rmse", "log10", "delta1", "delta2", "delta3")
UNITS = {"rmse": " [m]"}
NYU = (
    "NYU Depth V2 (Silberman, Hoiem, Kohli, Fergus: Indoor Segmentation and Support Inference from RGBD Images, "
    "ECCV 2012); its authors publish it for research and state no licence for other uses."
)
DATA_LICENCES = {
    "rooms": "Synthetic rooms that hudepth ray-casts itself (MIT, like hudepth): no photograph was used.",
    "nyu_labeled": NYU,
    "nyu_labeled_mat": NYU,
    "nyu_raw": NYU,
    "densedepth": NYU,
}
"""By source: what the training data is and what its owners allow."""
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
    samples: str, half: bool = False,
) -> str:  # fmt: skip
    """Write the card of a model.

    Args:
        checkpoint: says how it was trained.
        info: says what it takes and gives.
        name: of the model.
        results: contents of ``metrics.json`` by protocol; may be empty.
        parity: how far its ONNX file is from it, or its 16-bit weights are.
        samples: what its pictures show.
        half: kernels and matrices are kept as 16-bit floats, and there is no ONNX file.

    Returns:
        Markdown with the header that model hubs read.
    """
    source = str(checkpoint.data.get("source", "unknown"))
    sections = (
        _header(source, onnx=not half), f"# {name}", _about(info), _use(info, parity, half=half),
        _training(checkpoint, source), _results(results), samples, _limits(info, source),
        "## Licence\n\nCode: MIT. Training data: "
        + DATA_LICENCES.get(source, f"'{source}', whose terms whoever publishes this model must state here.")
        + " What that means for the weights is for you to judge.",
        f"## How to cite\n\nhudepth {__version__}, and the paper it implements:\n\n```bibtex\n{CITATION}\n```",
    )  # fmt: skip
    return "\n\n".join(section for section in sections if section) + "\n"


def _header(source: str, *, onnx: bool) -> str:
    tags = "\n".join(f"- {tag}" for tag in ("depth-estimation", "monocular-depth", *["onnx"] * onnx, "hudepth"))
    licence = "mit" if source == "rooms" else "other"
    return f"---\nlibrary_name: hudepth\npipeline_tag: depth-estimation\nlicense: {licence}\ntags:\n{tags}\n---"


def _about(info: ModelInfo) -> str:
    height, width = info.size
    return (
        f"Depth in metres from a single RGB image: {info.name}, {info.parameters:,} parameters, input {height} x "
        f"{width} (height x width), depths up to {info.max_depth_m:g} m. Made with hudepth, which implements "
        "Turkmen & Akgun (2025)."
    )


def _use(info: ModelInfo, parity: str, *, half: bool) -> str:
    height, width = info.size
    if half:
        files = (
            "`model.safetensors` holds kernels and matrices as 16-bit floats and is computed with in 32; against the "
            f"weights of the training it is {parity}. `config.json` says how to build the network around them."
        )
    else:
        files = (
            f"`model.onnx` needs no hudepth: input `image` uint8 [batch, {height}, {width}, 3], RGB, the whole image "
            f"resized to this size (averaged over areas); output `depth_m` float32 [batch, {height}, {width}] in "
            f"metres. It is {parity}.\n"
            "`model.safetensors` holds float32 tensors, `config.json` how to build the network around them."
        )
    return (
        "## Use\n\n```bash\nhudepth-predict checkpoint=<this folder or its zip> input=photos\n```\n\n"
        '```python\nimport hudepth\n\ndepth = hudepth.load("<this folder or its zip>").predict("photo.jpg")\n'
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
    """Name a loss, or those that it mixes."""
    names = [f"{weight:g} {_class(loss['losses'][part])}" for part, weight in loss.get("weights", {}).items() if weight]
    return " + ".join(names) or _class(loss)


def _class(config: Mapping[str, Any]) -> str:
    return str(config.get("_target_", "unknown")).rpartition(".")[2]


def _results(results: Mapping[str, Mapping[str, Any]]) -> str:
    if not results:
        return "## Results\n\nNone are on record. `hudepth-test` makes some; export the run afterwards."
    lines = [
        "## Results", "",
        "On the test subset of that split; in brackets 95 % intervals by bootstrap over scenes. Crop, caps, mask and",
        "averaging of each protocol are in `metrics/`.", "",
        "| protocol | images | " + " | ".join(f"{key}{UNITS.get(key, '')}" for key in SHOWN) + " |",
        "|---|---|" + "---|" * len(SHOWN),
    ]  # fmt: skip
    for protocol, result in results.items():
        values, ranges = result["metrics"]["model"], result.get("intervals", {}).get("model", {})
        cells = [_cell(values.get(key), ranges.get(key)) for key in SHOWN]
        lines.append(f"| {protocol} | {result['images']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(value: float | None, ends: Any) -> str:
    if value is None:
        return "-"
    if not ends or None in ends:
        return f"{value:.3f}"
    return f"{value:.3f} [{ends[0]:.3f}, {ends[1]:.3f}]"


def _limits(info: ModelInfo, source: str) -> str:
    return (
        "## Limits\n\n"
        f"- It knows scenes like those of `{source}`. Elsewhere (outdoors, other cameras, other heights) its metres "
        "are guesses: a single image does not hold the scale.\n"
        f"- Nothing lies beyond {info.max_depth_m:g} m for it.\n"
        "- Images are squeezed to the input size as in training; other fields of view shift all distances.\n"
        "- Mirrors, glass, thin things and edges are where it errs most. Do not steer or brake by it."
    )
