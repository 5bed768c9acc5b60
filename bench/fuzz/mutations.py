"""What can happen to the bytes of a file: cuts, flipped bits, numbers that are none or too large, pieces of something else."""

import re
import struct
import zlib

import numpy as np

Random = np.random.Generator
WORDS = (
    b"nan", b"inf", b"-1", b"-2", b"0", b"1e999", b"-1e308", b"1e-320", b"99999999999999999999", b"18446744073709551615",
    b"4294967295", b"2147483648", b"1000000000", b"x", b"", b"0x10", b"1.5", b"1_0", b"\xff\xfe", b"1" * 5000, b"#", b"\0",
)  # fmt: skip
NUMBERS = (0, 1, -1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1, 2**40, 10**6, 65535, 255)
REALS = (np.nan, np.inf, -np.inf, 1e308, -1e30, 0.0, 1e-310)
WORD = re.compile(rb"[^\s]+")


def mutate(data: bytes, random: Random, other: bytes = b"") -> bytes:
    """Change a file in one to four ways.

    Args:
        data: The file.
        random: Source of randomness.
        other: Another file to take pieces from.
    """
    for _ in range(int(random.choice([1, 1, 1, 2, 4]))):
        data = WAYS[int(random.integers(len(WAYS)))](data, random, other)
    return data


def mend_png(data: bytes) -> bytes:
    """The checksums of a PNG file made right, so that its contents are looked at."""
    position, mended = 8, bytearray(data)
    while position + 12 <= len(mended):
        end = position + 8 + int.from_bytes(mended[position : position + 4], "big")
        if end + 4 > len(mended):
            break
        mended[end : end + 4] = struct.pack(">I", zlib.crc32(mended[position + 4 : end]))
        position = end + 4
    return bytes(mended)


def _place(data: bytes, random: Random) -> int:
    """Anywhere, but oftener near the beginning, where headers are."""
    limit = min(len(data), 200) if random.random() < 0.5 else len(data)
    return int(random.integers(limit + 1))


def _cut(data: bytes, random: Random, other: bytes) -> bytes:
    return data[: int(random.integers(len(data) + 1))]


def _flip(data: bytes, random: Random, other: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(int(random.integers(1, 20))):
        place = _place(data, random)
        if place < len(changed):
            changed[place] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _number(data: bytes, random: Random, other: bytes) -> bytes:
    """A binary number in place of another."""
    size = int(random.choice([1, 2, 4, 8]))
    place = _place(data, random)
    place -= place % size if random.random() < 0.5 else 0
    if random.random() < 0.3:
        raw = struct.pack(random.choice(["<f", "<d", ">f", ">d"]), *_real(random, size))
    else:
        value = NUMBERS[int(random.integers(len(NUMBERS)))] % 2 ** (8 * size)
        raw = value.to_bytes(size, "little" if random.random() < 0.7 else "big")
    return data[:place] + raw + data[place + len(raw) :]


def _real(random: Random, size: int) -> tuple[float]:
    value = float(REALS[int(random.integers(len(REALS)))])
    return (value if abs(value) < 1e38 or not np.isfinite(value) else 1e38,)


def _word(data: bytes, random: Random, other: bytes) -> bytes:
    """A word of a text in place of another."""
    place = _place(data, random)
    found = WORD.search(data, place)
    if found is None:
        return data + b" 1"
    return data[: found.start()] + WORDS[int(random.integers(len(WORDS)))] + data[found.end() :]


def _remove(data: bytes, random: Random, other: bytes) -> bytes:
    place = _place(data, random)
    return data[:place] + data[place + int(random.integers(1, 64)) :]


def _insert(data: bytes, random: Random, other: bytes) -> bytes:
    place = _place(data, random)
    return data[:place] + random.bytes(int(random.integers(1, 64))) + data[place:]


def _repeat(data: bytes, random: Random, other: bytes) -> bytes:
    first, last = sorted((_place(data, random), _place(data, random)))
    return data[:last] + data[first:last] + data[last:]


def _splice(data: bytes, random: Random, other: bytes) -> bytes:
    place, first = _place(data, random), _place(other, random)
    piece = other[first : first + int(random.integers(1, 200))]
    return data[:place] + piece + data[place + (len(piece) if random.random() < 0.5 else 0) :]


def _blank(data: bytes, random: Random, other: bytes) -> bytes:
    first, last = sorted((_place(data, random), _place(data, random)))
    return data[:first] + bytes([int(random.choice([0, 255, 32]))]) * (last - first) + data[last:]


def _lines(data: bytes, random: Random, other: bytes) -> bytes:
    """The lines of another system, or in another order."""
    if random.random() < 0.5:
        return data.replace(b"\n", random.choice([b"\r\n", b"\r", b"\n\n", b" "]))
    lines = data.split(b"\n")
    return b"\n".join(lines[i] for i in random.permutation(len(lines)))


def _noise(data: bytes, random: Random, other: bytes) -> bytes:
    return data[: int(random.integers(9))] + random.bytes(int(random.integers(300)))


WAYS = (_cut, _flip, _flip, _number, _number, _number, _word, _word, _remove, _insert, _repeat, _splice, _blank, _lines, _noise)
