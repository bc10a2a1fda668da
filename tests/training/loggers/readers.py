"""Reads what a run logged back from each service's own files: names, values by step, hyperparameters, pictures."""

from __future__ import annotations

import csv
import io
import json
import struct
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image


@dataclass
class Logged:
    """What one service holds of a run."""

    curves: dict[str, dict[int, float]] = field(default_factory=dict)
    """By name: values by step."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """By dotted key."""
    pictures: dict[str, list[NDArray[np.uint8]]] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    """Name, group and so on."""

    def add(self, name: str, step: int, value: float) -> None:
        self.curves.setdefault(name, {})[step] = value


def read_tensorboard(run: Path) -> Logged:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    events = EventAccumulator(str(run / "tensorboard"), {"scalars": 0, "images": 0}).Reload()
    found = Logged()
    for name in events.Tags()["scalars"]:
        for each in events.Scalars(name):
            found.add(name, each.step, each.value)
    for name in events.Tags()["images"]:
        found.pictures[name] = [rgb(each.encoded_image_string) for each in events.Images(name)]
    data = HParamsPluginData.FromString(events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content)
    for key, value in data.session_start_info.hparams.items():
        found.parameters[key] = getattr(value, str(value.WhichOneof("kind")))
    return found


def read_csv(run: Path) -> Logged:
    found = Logged()
    for folder in sorted((run / "csv").iterdir()):
        with (folder / "metrics.csv").open() as file:
            for row in csv.DictReader(file):
                for name, value in row.items():
                    if value and name != "step":
                        found.add(name, int(row["step"]), float(value))
        if (folder / "hparams.yaml").is_file():
            found.parameters = yaml.safe_load((folder / "hparams.yaml").read_text())
    return found


def read_mlflow(uri: str, run_id: str) -> Logged:
    from mlflow import MlflowClient
    from mlflow.artifacts import download_artifacts

    client = MlflowClient(uri)
    run = client.get_run(run_id)
    found = Logged(parameters=run.data.params, about={**run.data.tags, "status": run.info.status})
    found.about["experiment"] = client.get_experiment(run.info.experiment_id).name
    for name in run.data.metrics:
        for each in client.get_metric_history(run_id, name):
            found.add(name, each.step, each.value)
    for file in client.list_artifacts(run_id, "images"):
        name = Path(file.path).name.partition("+")[0].replace("~", "/")
        if file.path.endswith(".png"):
            path = download_artifacts(run_id=run_id, artifact_path=file.path, tracking_uri=uri)
            found.pictures.setdefault(name, []).append(rgb(Path(path).read_bytes()))
    return found


def read_wandb(run: Path) -> Logged:
    found = Logged(about={"runs": []})
    for folder in sorted((run / "wandb").glob("offline-run-*")):
        (file,) = folder.glob("*.wandb")
        for record in records(file.read_bytes()):
            kind = record.WhichOneof("record_type")
            if kind == "run":
                found.about["runs"].append(record.run.run_id)
                found.about |= {"name": record.run.display_name, "group": record.run.run_group}
                found.about["project"] = record.run.project
            elif kind == "config":
                for each in record.config.update:
                    found.parameters |= flat(json.loads(each.value_json), each.key)
            elif kind == "exit":
                found.about["exit"] = record.exit.exit_code
            elif kind == "history":
                row = {
                    ".".join([x.key] if x.key else x.nested_key): json.loads(x.value_json) for x in record.history.item
                }
                for name, value in row.items():
                    if isinstance(value, float | int) and not name.startswith("_"):
                        found.add(name, row["trainer/global_step"], value)
                    if name.endswith(".filenames"):
                        pictures = found.pictures.setdefault(name.removesuffix(".filenames"), [])
                        pictures += [rgb((folder / "files" / each).read_bytes()) for each in value]
    return found


def records(content: bytes) -> Iterator[Any]:
    """Yield the records of a .wandb file: LevelDB's log format behind a header of seven bytes."""
    from wandb.proto.wandb_internal_pb2 import Record

    assert content.startswith(b":W&B")
    at, part = 7, b""
    while at < len(content):
        if 32768 - at % 32768 < 7:  # the rest of a block that no header fits into
            at += 32768 - at % 32768
            continue
        _, size, kind = struct.unpack_from("<IHB", content, at)
        part += content[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):  # whole, or the last part
            yield Record.FromString(part)
            part = b""


def read_comet(run: Path) -> Logged:
    found = Logged()
    for path in sorted(run.glob("*.zip"), key=lambda path: path.stat().st_mtime):
        with zipfile.ZipFile(path) as file:
            found.about |= json.loads(file.read("experiment.json"))
            for line in file.read("messages.json").decode().splitlines():
                payload = json.loads(line)["payload"]
                if metric := payload.get("metric"):
                    if metric["step"] is not None:
                        found.add(metric["metricName"], metric["step"], float(metric["metricValue"]))
                elif param := payload.get("param"):
                    found.parameters[param["paramName"]] = param["paramValue"]
                elif payload.get("upload_type") == "visualization":
                    name = payload["additional_params"]["figName"]
                    stored = Path(payload["file_path"]).name
                    found.pictures.setdefault(name, []).append(rgb(file.read(stored)))
    return found


def rgb(content: bytes) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def flat(value: Any, key: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        return {key: value}
    return {name: x for each, inner in value.items() for name, x in flat(inner, f"{key}.{each}").items()}
