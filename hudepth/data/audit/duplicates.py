"""Test images that are in training too: perceptual hashes, and the exact and near duplicates found with them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hudepth.data.splits import Split

NEAR_BITS = 6
"""Images whose hashes differ in at most this many of 64 bits count as near duplicates.

Chosen on the 1,449 images of NYU's labelled set. Of its 1.05 million pairs of images from different scenes none is this
close; the first differs in 8 bits. An image cropped again 2 % of its width to the side and saved as JPEG again differs
from the original in 6 bits (median), 4 % to the side in 10: the camera must have nearly stood still.
"""

_THUMBNAIL, _KEPT = 32, 8  # sides of the thumbnail, and of the block of its lowest frequencies
_ROUNDING = 0.01  # keeps rounding errors out of the hash of an image of one colour
_BITS = np.array([number.bit_count() for number in range(1 << 16)], np.uint8)


@dataclass(frozen=True)
class Duplicates:
    """Test images that are (nearly) equal to training images: their shares, ``near`` including ``exact``, and each."""

    exact: float
    near: float
    nearest: NDArray[np.int64]
    """[n] position in the store of the training image most like each test image, in the order of the split."""
    bits: NDArray[np.int64]
    """[n] bits in which the hashes of the two differ, 0 to 64."""
    equal: NDArray[np.bool_]


def hash_images(images: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Hash RGB images [n, h, w, 3] to 64 bits [n] by the signs of their lowest frequencies (pHash; Zauner, 2010).

    A grey 32 x 32 thumbnail, averaged over areas, goes through a two-dimensional DCT. Each of its 8 x 8 lowest
    frequencies gives one bit: whether it is above their median, which leaves out the constant term. Hashes ignore
    brightness and contrast; small changes flip a few bits.
    """
    hashes = np.empty(len(images), np.uint64)
    for row, image in enumerate(images):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        thumbnail = cv2.resize(grey, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA)
        low = cv2.dct(thumbnail)[:_KEPT, :_KEPT].ravel()
        hashes[row] = np.packbits(low - np.median(low[1:]) > _ROUNDING).view(">u8")[0]
    return hashes


def digest_pixels(images: NDArray[np.uint8]) -> list[bytes]:
    """Return 16 bytes per image [n, h, w, 3] that are equal for equal pixels, and in practice for no others."""
    return [hashlib.blake2b(image.tobytes(), digest_size=16).digest() for image in images]


def find_nearest_hashes(
    queries: NDArray[np.uint64], hashes: NDArray[np.uint64], *, block: int = 1 << 22
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find for each query [n] the hash [m] that differs in fewest bits, by comparing all pairs, ``block`` at a time.

    Returns positions [n] in ``hashes`` (the first of equals), and differing bits [n], 0 to 64.
    """
    position, bits = np.empty((2, len(queries)), np.int64)
    step = max(1, block // len(hashes))
    for start in range(0, len(queries), step):
        differing = count_bits(queries[start : start + step, None] ^ hashes)
        position[start : start + step] = differing.argmin(axis=1)
        bits[start : start + step] = differing.min(axis=1)
    return position, bits


def find_duplicates(
    split: Split, hashes: NDArray[np.uint64], digests: Sequence[bytes], *, near_bits: int = NEAR_BITS
) -> Duplicates:
    """Look for each test image among all training images, by the hashes [n] and digests of a store's images.

    Hashes of near duplicates differ in at most ``near_bits``.
    """
    train = np.asarray(split.train, np.int64)
    position, bits = find_nearest_hashes(hashes[split.test], hashes[train])
    first = {digests[index]: index for index in reversed(split.train)}
    twin = np.array([first.get(digests[index], -1) for index in split.test], np.int64)
    equal = twin >= 0
    return Duplicates(
        exact=float(equal.mean()),
        near=float((bits <= near_bits).mean()),
        nearest=np.where(equal, twin, train[position]),  # other images may have the same hash
        bits=bits,
        equal=equal,
    )


def count_bits(values: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Count the bits that are 1 in each value, of any shape."""
    if hasattr(np, "bitwise_count"):  # numpy 2
        return np.asarray(np.bitwise_count(values), np.uint8)
    counts: NDArray[np.uint8] = _BITS[np.ascontiguousarray(values)[..., None].view(np.uint16)].sum(-1, dtype=np.uint8)
    return counts
