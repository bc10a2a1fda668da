from __future__ import annotations

import hashlib
import math
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hudepth.base.camera.intrinsics import Intrinsics
from hudepth.base.errors import ConfigError, DataError
from hudepth.data.rooms.look import STUDIO
from hudepth.data.rooms.raycast import BOX, CYLINDER, F64, ROOM_FACES, Solids, View, pinhole_view, trace
from hudepth.data.rooms.scene import build_room
from hudepth.data.rooms.shading import _expose
from hudepth.data.sources import rooms
from hudepth.data.sources.rooms import RoomsSource, kinect_holes

SMALL = (48, 64)


def digest(source: RoomsSource, index: int) -> str:
    pair = source.read(source.records()[index])
    return hashlib.sha256(pair.image.tobytes() + pair.depth.tobytes()).hexdigest()


def run_python(code: str) -> str:
    """Run code in a fresh process, whose sets and dicts are hashed differently, and return what it prints."""
    environment = {**os.environ, "PYTHONHASHSEED": "17"}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=True).stdout


# Records


def test_records_are_named_by_scene_and_frame() -> None:
    records = RoomsSource(scenes=5, frames_per_scene=3).records()
    assert len(records) == 15
    assert len({record.id for record in records}) == 15
    assert (records[11].id, records[11].scene, records[11].frame) == ("room_0003/02", "room_0003", 2)
    assert {record.category for record in records} == {"bedroom", "kitchen", "office", "living_room"}


@pytest.mark.parametrize(("scenes", "tests"), [(2, 1), (3, 1), (5, 1), (10, 2), (48, 10)])
def test_the_last_fifth_of_the_scenes_is_the_test_split(scenes: int, tests: int) -> None:
    records = RoomsSource(scenes=scenes, frames_per_scene=4).records()
    train = {record.scene for record in records if record.split == "train"}
    test = {record.scene for record in records if record.split == "test"}
    assert (len(train), len(test)) == (scenes - tests, tests)
    assert not train & test
    assert max(train) < min(test)


def test_a_single_scene_has_no_split() -> None:
    assert {record.split for record in RoomsSource(scenes=1).records()} == {""}


def test_each_room_has_a_camera_of_its_own() -> None:
    source = RoomsSource(scenes=200, frames_per_scene=2, fov_deg=(45, 75))
    zooms = np.array([source._zoom(scene) for scene in range(200)])
    degrees = 2 * np.degrees(np.arctan(320 / (zooms * 518.857901)))
    assert 45 <= degrees.min() < 46
    assert 74 < degrees.max() <= 75
    assert degrees.mean() == pytest.approx(60, abs=2)  # three standard errors


@pytest.mark.parametrize("fov_deg", [[75, 45], [10, 45], [45, 170], [45]])
def test_an_impossible_field_of_view_is_refused(fov_deg: Any) -> None:
    with pytest.raises(ConfigError, match=r"data\.source\.fov_deg"):
        RoomsSource(fov_deg=fov_deg)


def test_a_lens_darkens_corners_and_turns_none_white() -> None:
    view = pinhole_view(np.zeros(3), np.eye(3), height=48, width=64, zoom=0.3)  # 119 degrees
    for seed in range(20):
        image = _expose(np.ones((3, 48, 64), np.float32), view, np.random.default_rng(seed), STUDIO)
        corners, centre = image[[0, 0, -1, -1], [0, -1, 0, -1]].astype(int), image[24, 32].astype(int)
        assert (corners <= centre + 25).all()  # noise


# Determinism


def test_a_frame_is_the_same_in_any_order_instance_and_after_pickling() -> None:
    source = RoomsSource(scenes=2, frames_per_scene=2, size=SMALL, holes=True)
    forwards = [digest(source, i) for i in range(4)]
    build_room.cache_clear()
    copy = pickle.loads(pickle.dumps(source))
    assert [digest(copy, i) for i in reversed(range(4))] == forwards[::-1]
    assert len(set(forwards)) == 4


def test_a_frame_does_not_depend_on_how_many_there_are() -> None:
    few, many = RoomsSource(scenes=2, frames_per_scene=1, size=SMALL), RoomsSource(scenes=9, size=SMALL)
    np.testing.assert_array_equal(few.read(few.records()[1]).image, many.read(many.records()[5]).image)


def test_a_frame_is_the_same_in_another_process() -> None:
    code = (
        "import hashlib; from hudepth.data.sources.rooms import RoomsSource; s = RoomsSource(size=(48, 64));"
        "p = s.read(s.records()[7]); print(hashlib.sha256(p.image.tobytes() + p.depth.tobytes()).hexdigest())"
    )
    assert run_python(code).strip() == digest(RoomsSource(size=SMALL), 7)


def test_another_seed_gives_other_rooms() -> None:
    assert digest(RoomsSource(size=SMALL), 0) != digest(RoomsSource(size=SMALL, seed=1), 0)


def test_the_fingerprint_covers_all_that_changes_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    base = RoomsSource(size=SMALL)
    others = [
        RoomsSource(size=(48, 65)),
        RoomsSource(size=SMALL, seed=1),
        RoomsSource(size=SMALL, holes=True),
        RoomsSource(size=SMALL, scenes=47),
        RoomsSource(size=SMALL, frames_per_scene=6),
        RoomsSource(size=SMALL, fov_deg=[45, 75]),
        RoomsSource(size=SMALL, fov_deg=[45, 70]),
    ]
    prints = [source.fingerprint() for source in (base, *others)]
    assert len(set(prints)) == len(prints)
    assert RoomsSource(size=list(SMALL)).fingerprint() == prints[0]
    monkeypatch.setattr(rooms, "RENDERER_VERSION", rooms.RENDERER_VERSION + 1)
    assert base.fingerprint() != prints[0]


# Exact depth


def scalar_depth(view: View, room: F64, solids: Solids, row: int, column: int) -> float:
    """First hit by plane equations and roots, one ray and one solid at a time, in plain Python."""
    x, y = float(view.xs[column]), float(view.ys[row])
    ray = [x * view.axes[0][k] + y * view.axes[1][k] + view.axes[2][k] for k in range(3)]
    hits = [((room[k] if ray[k] > 0 else 0.0) - view.origin[k]) / ray[k] for k in range(3)]
    for kind, centre, half, yaw in zip(*solids, strict=True):
        cos, sin = math.cos(yaw), math.sin(yaw)
        p = [view.origin[k] - centre[k] for k in range(3)]
        o = [p[0] * cos - p[2] * sin, p[1], p[0] * sin + p[2] * cos]
        d = [ray[0] * cos - ray[2] * sin, ray[1], ray[0] * sin + ray[2] * cos]
        round_axes = {BOX: [], CYLINDER: [0, 2]}.get(int(kind), [0, 1, 2])
        for k in {BOX: [0, 1, 2], CYLINDER: [1]}.get(int(kind), []):
            for side in (-half[k], half[k]):
                t = (side - o[k]) / d[k]
                at = [(o[j] + t * d[j]) / half[j] for j in range(3)]
                flat = math.hypot(at[0], at[2]) if kind == CYLINDER else max(abs(at[j]) for j in range(3) if j != k)
                if t > 0 and flat <= 1:
                    hits.append(t)
        if round_axes:
            a = sum((d[k] / half[k]) ** 2 for k in round_axes)
            b = 2 * sum(o[k] * d[k] / half[k] ** 2 for k in round_axes)
            c = sum((o[k] / half[k]) ** 2 for k in round_axes) - 1
            if b * b >= 4 * a * c:
                t = (-b - math.sqrt(b * b - 4 * a * c)) / (2 * a)
                if t > 0 and (kind != CYLINDER or abs(o[1] + t * d[1]) <= half[1]):
                    hits.append(t)
    return float(min(hits))


@pytest.mark.parametrize("index", [1, 38])
def test_depth_agrees_with_one_ray_at_a_time(index: int) -> None:
    source = RoomsSource(size=(120, 160))
    record = source.records()[index]
    room = build_room(0, index // 5)
    view = pinhole_view(*room.path.pose(record.frame), height=120, width=160)
    depth = source.read(record).depth
    _, surface = trace(view, room.scene.room_size, room.scene.solids)
    kinds = np.concatenate([np.full(ROOM_FACES, BOX), room.scene.solids.kind])[surface]
    rng = np.random.default_rng(index)
    pixels = [
        tuple(rng.choice(np.argwhere(mask))) for mask in (kinds != BOX, surface >= 6, surface < 6) for _ in range(25)
    ]
    truth = [scalar_depth(view, room.scene.room_size, room.scene.solids, r, c) for r, c in pixels]
    traced = [float(depth[r, c]) for r, c in pixels]
    close = np.isclose(traced, truth, rtol=1e-5)
    assert (~close).sum() <= 1  # a ray that grazes a silhouette may fall on either side of it


@pytest.mark.parametrize("fov_deg", [None, 45.0, 75.0])
def test_the_floor_back_projects_to_a_plane(fov_deg: float | None) -> None:
    source = RoomsSource(size=(96, 128), fov_deg=None if fov_deg is None else (fov_deg, fov_deg))
    nyu = Intrinsics.of_nyu(96, 128)
    focal = nyu.fx if fov_deg is None else 64 / math.tan(math.radians(fov_deg / 2))
    camera = replace(nyu, fx=focal, fy=nyu.fy * focal / nyu.fx)
    seen = 0
    for index in (0, 6):
        record = source.records()[index]
        room = build_room(0, index // 5)
        origin, axes = room.path.pose(record.frame)
        view = pinhole_view(origin, axes, height=96, width=128, zoom=focal / nyu.fx)
        _, surface = trace(view, room.scene.room_size, room.scene.solids)
        z = source.read(record).depth.astype(np.float64) * focal / nyu.fx
        v, u = np.mgrid[:96, :128]
        points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1) @ axes + origin
        floor = surface == 2
        seen += floor.sum()
        np.testing.assert_allclose(points[floor][:, 1], 0, atol=1e-4)
        assert (points > -1e-4).all()
        assert (points < room.scene.room_size + 1e-4).all()
    assert seen > 100


# What the rooms are like


@pytest.fixture(scope="module")
def furnished() -> tuple[list[Any], list[Any]]:
    """Eight rooms, and two frames of each."""
    source = RoomsSource(scenes=8, frames_per_scene=2, size=SMALL)
    records, built, pairs = source.records(), [], []
    for scene in range(8):  # the cache of rooms is small: read the frames of each before the next is built
        built.append(build_room(0, scene))
        pairs += [source.read(record) for record in records[2 * scene : 2 * scene + 2]]
    return built, pairs


@pytest.fixture(scope="module")
def gallery(furnished: tuple[list[Any], list[Any]]) -> list[Any]:
    return furnished[1]


def test_pairs_have_the_promised_types(gallery: list[Any]) -> None:
    for pair in gallery:
        assert pair.image.shape == (*SMALL, 3)
        assert pair.image.dtype == np.uint8
        assert pair.depth.shape == SMALL
        assert pair.depth.dtype == np.float32


def test_depths_are_those_of_rooms(gallery: list[Any]) -> None:
    depths = np.stack([pair.depth for pair in gallery])
    medians = np.median(depths, axis=(1, 2))
    assert np.isfinite(depths).all()
    assert depths.min() > 0.3
    assert depths.max() < 10
    assert 2.0 < np.median(medians) < 3.5
    assert ((medians > 1.2) & (medians < 6)).all()
    assert (depths < 0.9).mean(axis=(1, 2)).max() < 0.4  # nothing covers the view


def test_images_are_neither_black_nor_burnt_out(gallery: list[Any]) -> None:
    means = np.array([pair.image.mean() for pair in gallery])
    assert ((means > 50) & (means < 190)).all()
    assert np.median([pair.image.std() for pair in gallery]) > 25


def test_the_camera_keeps_clear_of_furniture_and_walls(furnished: tuple[list[Any], list[Any]]) -> None:
    for room in furnished[0]:
        solids = room.scene.solids
        for frame in range(0, 60, 4):
            origin, _ = room.path.pose(frame)
            assert 1.0 <= origin[1] <= 1.8
            assert (origin > 0.1).all()
            assert (origin < room.scene.room_size - 0.1).all()
            x, y, z = (origin - solids.centre).T
            cos, sin = np.cos(solids.yaw), np.sin(solids.yaw)
            local = np.abs(np.stack([x * cos - z * sin, y, x * sin + z * cos], 1)) - solids.half
            assert local.max(1).min() > 0.05


def test_every_room_is_furnished(furnished: tuple[list[Any], list[Any]]) -> None:
    for room in furnished[0]:
        large = (room.scene.solids.half.prod(1) * 8 > 0.02).sum()
        assert large >= 5
        assert room.scene.room_size[[0, 2]].min() >= 3
        assert room.scene.room_size.max() <= 9


def test_neighbours_in_a_scene_are_alike_but_not_the_same(gallery: list[Any]) -> None:
    depths = np.stack([pair.depth for pair in gallery])
    within = np.abs(depths[0::2] - depths[1::2]).mean(axis=(1, 2))
    across = np.abs(depths[0::2] - np.roll(depths[0::2], 1, axis=0)).mean(axis=(1, 2))
    assert (within > 0.01).all()
    assert np.mean(within) < 0.5 * np.mean(across)


# Holes


def test_holes_only_take_depth_away() -> None:
    whole = RoomsSource(scenes=2, frames_per_scene=1, size=(120, 160))
    holed = RoomsSource(scenes=2, frames_per_scene=1, size=(120, 160), holes=True)
    for record in whole.records():
        full, part = whole.read(record), holed.read(record)
        missing = part.depth == 0
        assert full.depth.min() > 0
        assert 0.05 < missing.mean() < 0.45
        assert missing[0].all()
        assert missing[:, -1].all()
        np.testing.assert_array_equal(part.depth[~missing], full.depth[~missing])
        np.testing.assert_array_equal(part.image, full.image)


def test_the_projectors_shadow_lies_left_of_a_near_plate_and_is_as_wide_as_its_parallax() -> None:
    depth = np.full((100, 320), 4.0, np.float32)
    depth[20:80, 150:200] = 1.0
    image = np.full((100, 320, 3), 128, np.uint8)
    holes = kinect_holes(depth, image, fx=260.0, rng=np.random.default_rng(0))
    width = round(260 * 0.075 * (1 / 1.0 - 1 / 4.0))
    assert holes[30:70, 152 - width : 150].all()
    assert holes[30:70, 150 - width - 12 : 150 - width - 3].mean() < 0.2
    assert holes[30:70, 203:215].mean() < 0.2


def test_nothing_is_measured_beyond_the_kinects_range() -> None:
    depth = np.full((60, 80), 3.0, np.float32)
    depth[:, 40:] = 8.5
    holes = kinect_holes(depth, np.full((60, 80, 3), 128, np.uint8), fx=65.0, rng=np.random.default_rng(0))
    assert holes[:, 40:].all()
    assert holes[5:-5, 5:35].mean() < 0.3


# Errors


@pytest.mark.parametrize("option", ["scenes", "frames_per_scene", "seed"])
@pytest.mark.parametrize("value", [-1, True])
def test_counts_must_be_whole_and_not_negative(option: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"data\.source\.{option}.*whole number"):
        RoomsSource(**{option: value})


def test_there_is_at_least_one_scene() -> None:
    with pytest.raises(ConfigError, match=r"data\.source\.scenes"):
        RoomsSource(scenes=0)


@pytest.mark.parametrize("size", [[240], [240, 320, 3], (8, 320), (240, 4096), [True, 320]])
def test_a_bad_size_says_what_to_do(size: Any) -> None:
    with pytest.raises(ConfigError, match=r"data\.source\.size.*16"):
        RoomsSource(size=size)


@pytest.mark.slow
def test_options_of_the_wrong_type_say_what_to_do() -> None:
    # In another process: here the run-time type checker of the tests would raise first.
    code = """
from hudepth.data.sources.rooms import RoomsSource
from hudepth.base.errors import ConfigError
for options in ({"scenes": 2.0}, {"seed": None}, {"holes": "no"}, {"size": "ab"}, {"size": (24.0, 32)}):
    try:
        RoomsSource(**options)
    except ConfigError as error:
        print(error)
"""
    keys = ["scenes", "seed", "holes", "size", "size"]
    assert [line.split(":")[0] for line in run_python(code).splitlines()] == [f"data.source.{key}" for key in keys]


@pytest.mark.parametrize(
    "change",
    [
        {"scene": "room_0009", "id": "room_0009/00"},
        {"frame": 7, "id": "room_0000/07"},
        {"scene": "attic"},
        {"frame": -1},
    ],
)
def test_a_record_of_another_source_is_refused(change: dict[str, Any]) -> None:
    source = RoomsSource(scenes=2, frames_per_scene=2)
    record = replace(source.records()[0], **change)
    with pytest.raises(DataError, match=rf"rooms: no frame '{record.id}' in 2 scenes"):
        source.read(record)


def test_wide_rooms_are_other_rooms() -> None:
    usual, wide = RoomsSource(size=SMALL), RoomsSource(size=SMALL, variety="wide")
    assert usual.fingerprint() != wide.fingerprint()
    assert digest(usual, 0) != digest(wide, 0)


@pytest.mark.slow
def test_homes_are_fuller_than_wide_rooms_and_taken_by_a_worse_camera() -> None:
    scenes = range(24)
    wide, homes = ([build_room(0, scene, variety).scene for scene in scenes] for variety in ("wide", "homes"))
    counts = [np.mean([len(scene.surface_material) for scene in rooms]) for rooms in (wide, homes)]
    assert counts[1] > counts[0] + 15
    pictures = [
        np.stack([source.read(record).image for record in source.records()])
        for source in (
            RoomsSource(size=SMALL, scenes=24, frames_per_scene=1, variety=name) for name in ("wide", "homes")
        )
    ]
    brightness, balance = (
        [np.std([statistic(image) for image in images]) for images in pictures]
        for statistic in (np.mean, lambda image: image[..., 0].mean() / image[..., 2].mean())
    )
    assert brightness[1] > 1.3 * brightness[0]
    assert balance[1] > 1.3 * balance[0]


def test_wide_rooms_spread_depths_below_ten_metres_and_look_down_and_up_as_nyu_does() -> None:
    def read(variety: str) -> tuple[Any, Any]:
        source = RoomsSource(scenes=30, frames_per_scene=1, size=(24, 32), variety=variety)
        depths = np.stack([source.read(record).depth for record in source.records()])
        return depths, [build_room(0, scene, variety).path for scene in range(30)]

    (usual, level), (wide, tilted) = read("usual"), read("wide")
    spread = [np.quantile(depth, 0.95) / np.quantile(depth, 0.05) for depth in (usual, wide)]
    assert spread[1] > 1.15 * spread[0]
    assert 0.1 < wide.min() < wide.max() < 10
    heights = [path.centre[1] for path in tilted]
    assert min(heights) < 1.0 < 1.7 < max(heights)
    assert max(path.pitch for path in level) < 0 < max(path.pitch for path in tilted)


def test_an_unknown_variety_is_named() -> None:
    with pytest.raises(ConfigError, match=r"data\.source\.variety.*'wild'.*Did you mean 'wide'"):
        RoomsSource(variety="wild")
