"""hudepth-data calibrate: fit a model's metres to your camera and rooms, and keep it as a bundle if that helps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch

from hudepth.base.camera import NYU_FOCAL, CameraChoice, CameraOption
from hudepth.base.console import log
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.machine import torch_device, usable_cores
from hudepth.base.options import Range, parse
from hudepth.base.tables import Table
from hudepth.calibrate.depths import focal_of, of_pairs, of_points
from hudepth.calibrate.fitting import Measured, Trial, abs_rel, check_unit, choose, try_kinds
from hudepth.data.build import build_data
from hudepth.export.bundle import write_bundle
from hudepth.export.card import model_card
from hudepth.inference.backends import TorchBackend
from hudepth.inference.calibration import Calibration
from hudepth.inference.model import DepthModel
from hudepth.inference.model_info import CALIBRATION, NYU_SOURCES, ModelInfo
from hudepth.metrics.bootstrap import MIN_SCENES
from hudepth.runs.checkpoint import Checkpoint, load_checkpoint


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of hudepth-data calibrate; conf/data.yaml explains them."""

    checkpoint: str
    data: Mapping[str, Any]
    paths: Mapping[str, Any]
    trust: list[str]
    points: Path | None = None
    camera: CameraOption | None = None
    pairs: Annotated[int, Range(2)] = 200
    output: str | None = None


def calibrate(config: dict[str, Any]) -> None:
    """Fit, cross-validate and store a calibration as conf/data.yaml states; raises HudepthError."""
    options = parse(CalibrateOptions, config)
    if options.camera is not None:
        CameraChoice.of(options.camera)
    if options.points and any(word.lstrip("+~").startswith("data") for word in config["overrides"]):
        raise ConfigError("data, points: both are set. Pass one of them.")
    source = None if options.points else build_data(options.data, trust=options.trust).source
    name = options.points.stem if options.points else source.name if source else ""
    output = Path(options.output or f"calibrated_{name}").expanduser()
    if output.exists():
        raise ConfigError(f"output: '{output}' exists. Remove it, or pass another output=<folder>.")
    checkpoint = _uncalibrated(load_checkpoint(options.checkpoint, runs=options.paths["runs"]))
    device = torch_device("auto")
    torch.set_num_threads(usable_cores())
    backend = TorchBackend.of_checkpoint(checkpoint, device=device, trust=options.trust)
    model = DepthModel(backend, camera="training")
    if options.points:
        images, sizes = of_points(options.points, model)
        what, camera = f"{sum(len(image.truth_m) for image in images)} points of {name}", options.camera
    else:
        assert source is not None
        if source.name == "rooms" and checkpoint.data.get("source") != "rooms":  # the default of data=
            raise ConfigError("data: built-in rooms are no camera's. Pass data=<yours>, or points=<file>.")
        if source.name in {each.get("source") for each in (checkpoint.data, *checkpoint.data.get("before", []))}:
            log.warning("data: the model was trained on %s, so its errors there say little about others.", source.name)
        images, sizes = of_pairs(source, model, most=options.pairs)
        what, camera = f"{len(images)} pairs of {name}", options.camera or source.camera
    if not images:
        raise DataError(f"data: no measured depth within {model.info.max_depth_m:g} m. Check data.encoding.")
    focal = focal_of(camera, sizes) or (NYU_FOCAL if source and source.name in NYU_SOURCES else None)
    check_unit(images)
    trials = try_kinds(images)
    _table(images, trials, what).show()
    kind = choose(trials)
    if kind is None:
        log.info("not stored: no calibration lowers the error on pictures it was not fitted on")
        return
    calibration = replace(trials[kind].calibration, fitted_on=what, focal=focal)
    _store(checkpoint, calibration, output, parameters=model.info.parameters, trust=options.trust)
    log.info("%s; stored: pass checkpoint=%s to hudepth-predict, hudepth-demo or hudepth-export", calibration, output)
    if focal is None:
        log.info("camera: not stated, so the result is for this camera alone; camera=fov=<degrees> makes it known")


def _uncalibrated(checkpoint: Checkpoint) -> Checkpoint:
    """Return a checkpoint without an earlier calibration, which the new one replaces."""
    return replace(checkpoint, data={key: value for key, value in checkpoint.data.items() if key != CALIBRATION})


def _table(images: list[Measured], trials: Mapping[str, Trial], what: str) -> Table:
    before = sum(abs_rel(image) for image in images) / len(images)
    named = any(image.scene for image in images)
    scenes = len({image.scene or image.id for image in images})
    count = f"{scenes} scenes" if named else "no scenes named"
    table = Table(("calibration", "abs_rel", "change", "95 % interval", "helps"), title=f"{what}, {count}")
    table.add("none", f"{before:.3f}", "", "", "")
    for kind, trial in trials.items():
        change = trial.change
        ends = "-" if math.isnan(change.high) else f"[{change.low:+.3f}, {change.high:+.3f}]"
        table.add(kind, f"{trial.abs_rel:.3f}", f"{change.value:+.3f}", ends, "yes" if trial.helps else "no")
    of = "scenes" if named else "pictures"
    few = f" Fewer than {MIN_SCENES} {of} give no interval." if scenes < MIN_SCENES else ""
    alike = "" if named else " Pictures of one room make it look better than it is."
    table.caption = f"Each picture is corrected by a fit on other {of}.{alike}{few}"
    return table


def _store(
    checkpoint: Checkpoint, calibration: Calibration, output: Path, *, parameters: int, trust: list[str]
) -> None:
    kept = replace(checkpoint, data={**checkpoint.data, CALIBRATION: asdict(calibration)})
    info = ModelInfo.of_checkpoint(kept, parameters=parameters)
    half = any(tensor.dtype == torch.float16 for tensor in kept.state.values())
    card = model_card(kept, info, name=output.name, results={}, parity="", half=half, trust=trust)
    try:
        write_bundle(output, kept, info=info, onnx=None, card=card, results={}, samples=[])
    except OSError as error:
        raise ConfigError(f"output: cannot write to '{output}' ({error.strerror or error}).") from error
