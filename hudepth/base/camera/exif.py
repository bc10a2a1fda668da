"""EXIF, as far as it tells the camera and which way is up. Blocks are untrusted: nothing is read beyond their end.

The format is that of TIFF; tags are those of Exif 2.32 (CIPA DC-008).
"""

from __future__ import annotations

import math
import re
import struct
from typing import NamedTuple

from hudepth.base.camera.intrinsics import Intrinsics

FILM_DIAGONAL_MM = math.hypot(36, 24)
"""Focal lengths for 35 mm film are converted over the diagonal (CIPA DCG-001)."""
ORIENTATION = 0x0112
_MODEL, _EXIF = 0x0110, 0x8769
_FOCAL_MM, _FOCAL_35MM, _ZOOM = 0x920A, 0xA405, 0xA404
_SIZE, _RESOLUTION, _UNIT = (0xA002, 0xA003), (0xA20E, 0xA20F), 0xA210
_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8}  # bytes by type
_CODES = {1: "B", 3: "H", 4: "I", 5: "II", 9: "i", 10: "ii", 11: "f", 12: "d", 16: "Q"}
_SENSORS_MM = (
    (r"Canon EOS[ -](5D|6D|1D X|1Ds|R[3568]|RP?)(?!\d)", 36.0),
    (r"Canon EOS (\d{2,4}D|Kiss|Rebel|REBEL|M\d*|R7|R10|R50|R100)", 22.3),
    (r"NIKON D(3|3S|3X|4|4S|5|6|6[01]0|7[058]0|8[015]0[AE]?)$", 36.0),
    (r"NIKON D(3\d{3}|5\d{3}|7\d{3}|500|90|300S?)$", 23.5),
    (r"ILCE-(7|9|1)(?!\d)", 35.8),
    (r"ILCE-[56]\d{3}|NEX-|X-(T|Pro|E|H|S)\d|X100", 23.5),
    (r"E-M|E-P|OM-\d|DMC-G|DC-G", 17.3),
    (r"iPhone 4$", 4.54),
    (r"(iPhone (4S|5|5c)|Nexus 5)$", 4.57),
    (r"iPhone (5s|6|6 Plus)$", 4.90),
)
"""Longer side of the sensor by model, from the makers' sheets, for files that state neither of the other two."""


class Entry(NamedTuple):
    """A tag of a directory."""

    kind: int
    length: int
    field: bytes
    """The value if it is short enough, else where it lies in the block."""

    @property
    def size(self) -> int:
        """Bytes that the value claims."""
        return _SIZES.get(self.kind, 1) * self.length


def directory(block: bytes | memoryview, start: int | None = None) -> dict[int, Entry]:
    """Return the entries of a directory of a TIFF structure by tag, of the first by default; empty if it is none."""
    order, big = _header(block)
    if not order:
        return {}
    if start is None:
        start = struct.unpack_from(f"{order}Q" if big else f"{order}I", block, 8 if big else 4)[0]
    head, entry = (f"{order}Q", f"{order}HHQ8s") if big else (f"{order}H", f"{order}HHI4s")
    if start + struct.calcsize(head) > len(block):
        return {}
    (count,) = struct.unpack_from(head, block, start)
    at, entries = start + struct.calcsize(head), {}
    for _ in range(min(count, (len(block) - at) // struct.calcsize(entry))):
        tag, *rest = struct.unpack_from(entry, block, at)
        entries[tag] = Entry(*rest)
        at += struct.calcsize(entry)
    return entries


def _header(block: bytes | memoryview) -> tuple[str, bool]:
    """Return the byte order, empty if this is no TIFF structure, and whether it is a BigTIFF."""
    order = {b"II": "<", b"MM": ">"}.get(bytes(block[:2]), "") if len(block) >= 16 else ""
    return order, block[2:4] in (b"+\0", b"\0+")


def _value(block: bytes | memoryview, entry: Entry | None, *, longest: int = 16) -> bytes:
    """Return the bytes of a value, at most ``longest``; empty if they are not in the block."""
    order, _ = _header(block)
    if entry is None or not order:
        return b""
    if entry.size <= len(entry.field):
        return entry.field[: entry.size]
    (at,) = struct.unpack(f"{order}{'Q' if len(entry.field) == 8 else 'I'}", entry.field)
    return bytes(block[at : at + min(entry.size, longest)])


def number(block: bytes | memoryview, entry: Entry | None) -> float:
    """Return the first number of a tag; NaN if there is none, also for a fraction over zero."""
    code, value = _CODES.get(entry.kind, "") if entry else "", _value(block, entry)
    if not code or len(value) < (length := struct.calcsize(f"={code}")):
        return math.nan
    first, *under = struct.unpack(f"{_header(block)[0]}{code}", value[:length])
    if under and not under[0]:
        return math.nan
    return float(first / under[0] if under else first)


def orientation(block: bytes | memoryview) -> int:
    """Return the orientation, 1 to 8; 1 if none is stated."""
    entry = directory(block).get(ORIENTATION)
    value = number(block, entry) if entry and entry.kind == 3 else 1
    return int(value) if value in range(1, 9) else 1


def exif_camera(block: bytes | memoryview, height: int, width: int) -> Intrinsics | str:
    """Return the camera that EXIF states for a picture of this size, or why it states none; empty without a word of it.

    The size is that of the picture turned upright. The focal length is that for 35 mm film, else the one in
    millimetres with the sensor's pixels per millimetre, else with the sensor's size by the camera's model.
    """
    first = directory(block)
    pointer = number(block, first.get(_EXIF))
    tags = directory(block, int(pointer)) if 0 < pointer < len(block) else {}
    if not tags.keys() & {_FOCAL_MM, _FOCAL_35MM}:
        return ""
    stated = tuple(number(block, tags.get(tag)) for tag in _SIZE)
    if all(side > 0 for side in stated) and not _same_shape(stated, (width, height)):
        return f"its EXIF is of {stated[0]:.0f} x {stated[1]:.0f} pixels: it was cropped"
    film_mm, focal_mm = number(block, tags.get(_FOCAL_35MM)), number(block, tags.get(_FOCAL_MM))
    found = []
    if film_mm > 0:
        focal = film_mm * math.hypot(height, width) / FILM_DIAGONAL_MM
        found.append((focal, focal, f"{film_mm:g} mm on 35 mm film"))
    if focal_mm > 0:
        zoom = number(block, tags.get(_ZOOM))
        found += _of_sensor(block, focal_mm * (zoom if 1 < zoom <= 20 else 1), height, width)
    for fx, fy, origin in found:
        if 0 < fx < math.inf and 0 < fy < math.inf:
            camera = Intrinsics.centred(fx, fy, height, width, origin=f"from EXIF, {origin}")
            if camera.fits(height, width):
                return camera
    if focal_mm > 0 and not found:
        return f"its EXIF states {focal_mm:g} mm, but not the sensor's size"
    words = (f"{film_mm:g} mm on 35 mm film" if film_mm >= 0 else "", f"{focal_mm:g} mm" if focal_mm >= 0 else "")
    return f"its EXIF states no possible focal length ({', '.join(filter(None, words)) or 'not a number'})"


def _same_shape(stated: tuple[float, ...], size: tuple[int, int]) -> bool:
    aspect, own = max(stated) / min(stated), max(size) / min(size)
    return abs(aspect - own) * min(size) <= max(1.5, 0.01 * max(size))  # a pixel, or a hundredth, of rounding


def _of_sensor(block: bytes | memoryview, focal_mm: float, height: int, width: int) -> list[tuple[float, float, str]]:
    """Return focal lengths [pixels] of the upright picture, and from what they follow, in order of preference."""
    first = directory(block)
    tags = directory(block, int(number(block, first.get(_EXIF))))
    found, longer = [], max(height, width)
    unit = number(block, tags.get(_UNIT)) if _UNIT in tags else 2
    across, down = (number(block, tags.get(tag)) for tag in _RESOLUTION)
    if across > 0 and unit in _UNITS_MM:
        sides = [number(block, tags.get(tag)) for tag in _SIZE]
        resized = longer / max(sides) if min(sides) > 0 else 1.0  # the resolution is that of the camera's own file
        per_mm = [each / _UNITS_MM[int(unit)] * resized for each in (across, down if down > 0 else across)]
        if orientation(block) > 4:
            per_mm.reverse()
        found.append((focal_mm * per_mm[0], focal_mm * per_mm[1], f"{focal_mm:g} mm, {longer / per_mm[0]:.1f} mm wide"))
    model = _value(block, first.get(_MODEL), longest=64).split(b"\0")[0].decode("ascii", "replace").strip()
    model = re.sub(r"[^ -~]", "?", model)
    sensor_mm = next((side for name, side in _SENSORS_MM if re.match(name, model)), None)
    if sensor_mm:
        focal = focal_mm * longer / sensor_mm
        found.append((focal, focal, f"{focal_mm:g} mm, {sensor_mm:g} mm wide by its model, {model}"))
    return found
