from __future__ import annotations

import os
import pickle
import pickletools
import resource
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer, seed_everything
from torch import Tensor, nn

from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.files import write_text
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses import BADCL
from hudepth.models import HybridUNet, TinyUNet
from hudepth.runs.checkpoint import KEY, VERSION, find_checkpoint, load_checkpoint, read_plain
from hudepth.training.callbacks import History, LogLosses
from hudepth.training.checkpointing import AtomicCheckpointIO, checkpoint_callbacks
from hudepth.training.module import DepthModule

MODEL = {"_target_": "hudepth.models.TinyUNet", "channels": 4}
PLAIN = (int, float, str, bool, type(None), Tensor)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory with the checkpoints of a real two-epoch run of a Trainer."""
    folder = tmp_path_factory.mktemp("runs") / "name" / "2025-01-01_00-00-00"
    source = RoomsSource(scenes=6, frames_per_scene=2, size=(48, 64))
    data = DepthDataModule(source, size=(32, 48), split="official", cache=folder, native=False, prepare_workers=1)
    config = {"model": MODEL, "data": {"size": [32, 48], "split": "official"}, "seed": 0}
    write_text(folder / "config.yaml", "seed: 0\n")
    seed_everything(0, verbose=False)
    module = DepthModule(
        TinyUNet(channels=4),
        BADCL(),
        max_depth_m=10.0,
        optimizer=partial(torch.optim.AdamW, lr=1e-2),
        scheduler=lambda optimizer, total: torch.optim.lr_scheduler.OneCycleLR(
            optimizer, max_lr=1e-2, total_steps=total + 1
        ),
        record={"config": config, "split": data.split.summary(), "data": {"source": "rooms", "pairs": 12}},
    )
    Trainer(
        accelerator="cpu",
        max_epochs=2,
        logger=False,
        enable_model_summary=False,
        enable_progress_bar=False,
        num_sanity_val_steps=0,
        callbacks=[
            LogLosses(),
            History(folder / "metrics.csv"), *checkpoint_callbacks(folder, monitor="val/abs_rel", mode="min")
        ],
        plugins=[AtomicCheckpointIO()],
    ).fit(module, datamodule=data)  # fmt: skip
    torch.save(module.net.state_dict(), folder / "final.pt")
    return folder


def content_of(run: Path) -> dict[str, Any]:
    return read_plain(run / "checkpoints" / "last.ckpt")


def saved(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


def refused(path: Path | str, **options: Any) -> str:
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(str(path), **options)
    return str(caught.value)


# --- what is in one ---------------------------------------------------------------------------------------------


def strangers(value: object, at: str = "") -> Iterator[str]:
    """Say where a value is not of a plain type."""
    if type(value) in (dict, OrderedDict):
        for key, item in value.items():  # type: ignore[attr-defined]
            yield from strangers(key, f"{at} key")
            yield from strangers(item, f"{at}.{key}")
    elif type(value) in (list, tuple):
        for position, item in enumerate(value):  # type: ignore[arg-type]
            yield from strangers(item, f"{at}.{position}")
    elif type(value) not in PLAIN:
        yield f"{at}: {type(value)}"


@pytest.mark.parametrize("name", ["best.ckpt", "last.ckpt"])
def test_plain_types_only(run: Path, name: str) -> None:
    path = run / "checkpoints" / name
    everything = torch.load(path, weights_only=False)
    assert list(strangers(everything)) == []
    with zipfile.ZipFile(path) as archive:
        code = next(entry for entry in archive.namelist() if entry.endswith("data.pkl"))
        operations = list(pickletools.genops(archive.read(code)))
    assert {argument for opcode, argument, _ in operations if opcode.name == "GLOBAL"} <= {
        "torch._utils _rebuild_tensor_v2",
        "collections OrderedDict",
        "torch FloatStorage",
        "torch LongStorage",
        "torch DoubleStorage",
    }


def test_a_checkpoint_says_what_it_is_of(run: Path) -> None:
    checkpoint = load_checkpoint(str(run / "checkpoints" / "last.ckpt"))
    assert checkpoint.run == run
    assert checkpoint.epoch == 2
    assert checkpoint.config["model"] == MODEL
    assert checkpoint.split["kind"] == "official"
    assert checkpoint.split["counts"] == {"train": 8, "val": 2, "test": 2}
    assert len(checkpoint.split["sha256"]) == 64
    assert checkpoint.data == {"source": "rooms", "pairs": 12}


def test_a_moved_checkpoint_needs_nothing_beside_it(run: Path, tmp_path: Path) -> None:
    moved = tmp_path / "mine.ckpt"
    moved.write_bytes((run / "checkpoints" / "last.ckpt").read_bytes())
    checkpoint = load_checkpoint(str(moved))
    assert checkpoint.run is None
    assert isinstance(checkpoint.build_net(trust=[]), TinyUNet)


# --- building the network ---------------------------------------------------------------------------------------


def test_build_net_returns_what_was_trained_bit_for_bit(run: Path) -> None:
    trained = TinyUNet(channels=4)
    trained.load_state_dict(torch.load(run / "final.pt", weights_only=True))
    net = load_checkpoint(str(run / "checkpoints" / "last.ckpt")).build_net(trust=[])
    assert not net.training
    image = torch.randn(3, 3, 32, 48)
    assert torch.equal(net(image), trained.eval()(image))
    assert all(p.device.type == "cpu" and p.requires_grad for p in net.parameters())


def test_building_does_not_read_the_encoders_first_weights_again(tmp_path: Path) -> None:
    model = {"_target_": "hudepth.models.HybridUNet", "attention": "none", "weights": "/gone/resnet18.pth"}
    net = HybridUNet(attention="none").eval()
    path = written(tmp_path, model, net)
    built = load_checkpoint(str(path)).build_net(trust=[])
    image = torch.randn(1, 3, 32, 32)
    assert torch.equal(built(image), net(image))


def written(folder: Path, model: dict[str, Any], net: nn.Module, **more: Any) -> Path:
    """Write a checkpoint of ``net`` that says it is of ``model``."""
    state = {f"net.{name}": value for name, value in net.state_dict().items()}
    own = {"version": VERSION, "config": {"model": model}, "split": {}, "data": {}}
    return saved(folder / "x.ckpt", {"epoch": 4, "state_dict": state, KEY: own, **more})


def test_half_precision_weights_become_single(tmp_path: Path) -> None:
    net = TinyUNet(channels=4).to(torch.bfloat16)
    built = load_checkpoint(str(written(tmp_path, MODEL, net))).build_net(trust=[])
    assert {p.dtype for p in built.parameters()} == {torch.float32}
    assert built(torch.randn(1, 3, 16, 16)).dtype == torch.float32


class WithHiddenBuffer(nn.Module):
    """What a user's network may have: a buffer that is not saved, and numbers read from tensors while it is built."""

    def __init__(self) -> None:
        super().__init__()
        self.rate = torch.linspace(0, 1, 3)[1].item()
        self.register_buffer("scale", torch.full((1,), 2.0), persistent=False)
        self.conv = nn.Conv2d(3, 1, 1)

    def forward(self, image: Tensor) -> Tensor:
        result: Tensor = self.conv(image) * self.scale * self.rate
        return result


def test_a_users_own_network(tmp_path: Path) -> None:
    net = WithHiddenBuffer()
    checkpoint = load_checkpoint(str(written(tmp_path, {"_target_": f"{__name__}.WithHiddenBuffer"}, net)))
    image = torch.randn(1, 3, 4, 4)
    assert torch.equal(checkpoint.build_net(trust=[__name__])(image), net(image))
    with pytest.raises(ConfigError, match=r"WithHiddenBuffer' is not under a trusted module"):
        checkpoint.build_net(trust=[])


@pytest.mark.parametrize("channels", [2, 8])
def test_checkpoint_of_another_size(tmp_path: Path, channels: int) -> None:
    path = written(tmp_path, MODEL, TinyUNet(channels=channels))
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(str(path)).build_net(trust=[])
    assert str(caught.value) == (
        f"'{path}' is from another model: 7 tensors do not fit hudepth.models.TinyUNet, the first is 'encode.weight'. "
        "Pass a checkpoint whose configuration matches its weights."
    )


def test_checkpoint_of_another_model(tmp_path: Path) -> None:
    path = written(tmp_path, {"_target_": "hudepth.models.HybridUNet", "attention": "none"}, TinyUNet())
    with pytest.raises(
        CheckpointError, match=r"is from another model: \d+ tensors do not fit hudepth.models.HybridUNet"
    ):
        load_checkpoint(str(path)).build_net(trust=[])


def test_a_huge_model_is_refused_without_its_memory(tmp_path: Path) -> None:
    """3 x 16 x 16 x 10^9 weights would be 3 TB."""
    path = written(tmp_path, {**MODEL, "channels": 10**9}, TinyUNet())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError, match="is from another model: 7 tensors do not fit"):
        load_checkpoint(str(path)).build_net(trust=[])
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_tensors_that_claim_more_than_the_file_holds_are_refused(tmp_path: Path) -> None:
    """One stored value, stretched to a tensor of 3 TB, fits a configuration that asks for it."""
    with torch.device("meta"):
        shapes = {name: value.shape for name, value in TinyUNet(channels=10**9).state_dict().items()}
    state = {f"net.{name}": torch.tensor(0.0).expand(shape) for name, shape in shapes.items()}
    path = written(tmp_path, {**MODEL, "channels": 10**9}, TinyUNet(), state_dict=state)
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(str(path)).build_net(trust=[])
    assert str(caught.value) == f"'{path}' is refused: its tensors claim more memory than the file holds."


@pytest.mark.parametrize("target", ["os.system", "builtins.eval", "hudepth.base.files.write_text", "torch.hub.load"])
def test_a_configuration_that_names_code_is_refused(tmp_path: Path, target: str) -> None:
    path = written(tmp_path, {"_target_": target, "command": "touch ran"}, TinyUNet())
    with pytest.raises(ConfigError, match=r"^_target_: "):
        load_checkpoint(str(path)).build_net(trust=[])


def test_a_configuration_that_writes_files_is_refused(tmp_path: Path) -> None:
    victim = tmp_path / "precious"
    victim.write_text("mine")
    writer = {"_target_": "hudepth.data.store.StoreWriter", "path": str(victim), "size": [1, 1], "native": False}
    path = written(tmp_path, writer, TinyUNet())
    with pytest.raises(ConfigError, match=r"StoreWriter' is no depth network"):
        load_checkpoint(str(path)).build_net(trust=[])
    assert victim.read_text() == "mine"


# --- files that are not what they should be ---------------------------------------------------------------------


class Evil:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.marker,)


def test_code_is_refused_and_not_run(run: Path, tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    path = saved(tmp_path / "evil.ckpt", {**content_of(run), "more": Evil(marker)})
    assert refused(path) == (
        f"'{path}' is refused: it holds more than tensors and plain values, so loading it could run code. "
        "Use a checkpoint written by hudepth-train."
    )
    assert not marker.exists()
    torch.load(path, weights_only=False)  # it would have run: the test is a test
    assert marker.exists()


def test_a_bare_pickle_is_not_run(tmp_path: Path) -> None:
    marker, path = tmp_path / "ran", tmp_path / "evil.ckpt"
    path.write_bytes(pickle.dumps(Evil(marker)))
    assert refused(path) == (
        f"'{path}' cannot be read as a checkpoint; it is damaged or cut off (File is not a zip file)."
    )
    assert not marker.exists()


@pytest.mark.parametrize("keep", [0, 1, 100, 0.5, 0.9, -1])
def test_cut_off(run: Path, tmp_path: Path, keep: float) -> None:
    whole = (run / "checkpoints" / "last.ckpt").read_bytes()
    path = tmp_path / "cut.ckpt"
    path.write_bytes(whole[: int(keep * len(whole)) if isinstance(keep, float) else keep])
    message = refused(path)
    assert message.startswith(f"'{path}' cannot be read as a checkpoint; it is damaged or cut off (")
    assert "\n" not in message


@pytest.mark.parametrize("at", [0.01, 0.1, 0.3, 0.5, 0.7, 0.9])
def test_damaged(run: Path, tmp_path: Path, at: float) -> None:
    """Eight zeroed bytes anywhere are noticed, by the checksum of the file they are in."""
    damaged = bytearray((run / "checkpoints" / "last.ckpt").read_bytes())
    start = int(at * len(damaged))
    start = next(i for i in range(start, len(damaged)) if all(damaged[i : i + 8]))
    damaged[start : start + 8] = bytes(8)
    path = tmp_path / "damaged.ckpt"
    path.write_bytes(damaged)
    assert "cannot be read as a checkpoint; it is damaged or cut off (" in refused(path)


def test_a_file_that_unpacks_to_more_than_its_size(tmp_path: Path) -> None:
    plain = saved(tmp_path / "plain.ckpt", {"state_dict": {"net.x": torch.zeros(10**6)}})
    bomb = tmp_path / "bomb.ckpt"
    with zipfile.ZipFile(plain) as source, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry in source.namelist():
            archive.writestr(entry, source.read(entry))
    assert torch.load(bomb, weights_only=True)["state_dict"]["net.x"].shape == (10**6,)  # torch alone would read it
    assert refused(bomb) == (
        f"'{bomb}' is refused: it unpacks to more than its own size. Use a checkpoint written by hudepth-train."
    )


def test_not_a_dict(tmp_path: Path) -> None:
    path = saved(tmp_path / "x.ckpt", [torch.zeros(1)])
    assert refused(path).startswith(f"'{path}' is not a checkpoint")


@pytest.mark.parametrize("content", [{}, {"state_dict": {}}, {KEY: 3, "state_dict": {}}, {KEY: {"version": VERSION}}])
def test_not_ours(tmp_path: Path, content: dict[str, Any]) -> None:
    path = saved(tmp_path / "x.ckpt", content)
    assert refused(path) == f"'{path}' was not written by hudepth-train: it has no '{KEY}' entry."


@pytest.mark.parametrize("version", [0, 1, 3, "2", None])
def test_another_version(run: Path, tmp_path: Path, version: object) -> None:
    content = content_of(run)
    path = saved(tmp_path / "x.ckpt", {**content, KEY: {**content[KEY], "version": version}})
    message = refused(path)
    assert message.startswith(f"'{path}' has format version {version}, this hudepth reads {VERSION}.")
    assert "train" in message
    assert ("pre-release" in message) == (version == 1)


@pytest.mark.parametrize(
    "change",
    [
        {KEY: {"version": VERSION}},
        {KEY: {"version": VERSION, "config": {"model": MODEL}}},
        {KEY: {"version": VERSION, "config": {"model": MODEL}, "split": {}}},
        {KEY: {"version": VERSION, "config": {"model": "x"}, "split": {}, "data": {}}},
        {KEY: {"version": VERSION, "config": {}, "split": {}, "data": {}}},
        {"epoch": "three"},
        {"state_dict": [1]},
        {"state_dict": {"net.x": "not a tensor"}},
        {"state_dict": {3: torch.zeros(1)}},
    ],
)
def test_incomplete(run: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    path = saved(tmp_path / "x.ckpt", {**content_of(run), **change})
    assert refused(path).startswith(f"'{path}' is incomplete: ")


@pytest.mark.parametrize(
    "change",
    [Tensor.to_sparse, lambda tensor: tensor.to("meta"), lambda tensor: tensor.to(torch.complex64),
     lambda tensor: torch.quantize_per_tensor(tensor, 0.1, 0, torch.quint8)],
    ids=["sparse", "meta", "complex", "quantised"],
)  # fmt: skip
def test_tensors_of_another_kind_are_refused(tmp_path: Path, change: Callable[[Tensor], Tensor]) -> None:
    net = TinyUNet(channels=4)
    state = {f"net.{name}": change(value) if value.ndim > 1 else value for name, value in net.state_dict().items()}
    path = written(tmp_path, MODEL, net, state_dict=state)
    assert refused(path).startswith(f"'{path}' is incomplete: ")


# --- finding one ------------------------------------------------------------------------------------------------


def make_run(runs: Path, name: str, *checkpoints: str, at: int = 0) -> Path:
    run = runs / "x" / name
    write_text(run / "config.yaml", "seed: 0\n")
    (run / "checkpoints").mkdir()
    for checkpoint in checkpoints:
        (run / "checkpoints" / checkpoint).touch()
    os.utime(run / "checkpoints", ns=(at, at))
    return run


@pytest.mark.parametrize(("there", "found"), [(("best.ckpt", "last.ckpt"), "best.ckpt"), (("last.ckpt",), "last.ckpt")])
def test_run_directory_means_its_best_else_its_last(tmp_path: Path, there: tuple[str, ...], found: str) -> None:
    run = make_run(tmp_path, "a", *there)
    assert find_checkpoint(str(run), runs="nowhere") == run / "checkpoints" / found


def test_last_is_the_run_written_to_last(tmp_path: Path) -> None:
    make_run(tmp_path, "2025-03", "last.ckpt", at=10**9)
    written_last = make_run(tmp_path, "2025-01", "last.ckpt", "best.ckpt", at=3 * 10**9)
    make_run(tmp_path, "2025-02", "best.ckpt", at=2 * 10**9)
    make_run(tmp_path, "2025-04", at=4 * 10**9)  # has none yet
    assert find_checkpoint("last", runs=tmp_path) == written_last / "checkpoints" / "best.ckpt"


def test_no_run_yet(tmp_path: Path) -> None:
    assert refused("last", runs=tmp_path) == (
        f"checkpoint=last: no run with a checkpoint below '{tmp_path}'. Train one with hudepth-train, "
        "or pass checkpoint=<file or run directory>."
    )


def test_run_without_a_checkpoint(tmp_path: Path) -> None:
    run = make_run(tmp_path, "a")
    assert refused(run).startswith(f"checkpoint: the run '{run}' has no checkpoint")


def test_folder_that_is_no_run(tmp_path: Path) -> None:
    assert refused(tmp_path) == (f"checkpoint: '{tmp_path}' is not a run directory. Pass a file, a run, or last.")


def test_nothing_there(tmp_path: Path) -> None:
    assert refused(tmp_path / "x") == (
        f"checkpoint: no file or run directory '{tmp_path / 'x'}'. Pass a file, a run directory, or last."
    )


def test_a_part_that_only_the_checkpoint_has_can_be_skipped(run: Path) -> None:
    checkpoint = load_checkpoint(str(run))
    more = replace(checkpoint, state={**checkpoint.state, "scale.weight": torch.ones(2)})
    net = TinyUNet(channels=4)
    with pytest.raises(CheckpointError, match=r"1 tensors do not fit .* the first is 'scale\.weight'"):
        more.fill(net)
    more.fill(net, skip=["scale"])
    assert net.state_dict()["decode.weight"].equal(checkpoint.state["decode.weight"])
    with pytest.raises(
        CheckpointError, match=r"^init_skip: TinyUNet has no part 'output'\. It has encode, norm, decode\.$"
    ):
        more.fill(net, skip=["output"])
