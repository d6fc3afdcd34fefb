"""Random changes to good files, for machines without a coverage-guided fuzzer."""

from __future__ import annotations

import random
import struct

_WORDS = [
    b"-1",
    b"0",
    b"1e999",
    b"nan",
    b"-inf",
    b"1e-320",
    b"4294967296",
    b"9" * 400,
    b"[[",
    b"{",
    b'"',
    b"null",
    b"true",
    b"end_header\n",
    b"element vertex 99999999\n",
    b"property list uchar int a\n",
    b"!!int",
    b"&a [*a]",
    b"format ascii 1.0\n",
    b"format binary_big_endian 1.0\n",
    b"element face 2\n",
    b"uchar",
    b"double",
    b"ushort",
    b"list",
    b"\xff\xfe",
    b"\0",
    b"2001-99-99",
    b"\n",
    b": ",
    b"- ",
    b"[" * 3000,
    b"\\ud800",
]
_NUMBERS = [
    struct.pack(kind, value)
    for kind, values in (
        ("<f", (float("nan"), float("inf"), -1e38, 1e-45, 0.0)),
        ("<i", (-1, 0, 2**31 - 1)),
        (">i", (1, 65536, 2**31 - 1)),
        ("<q", (-1, 2**40, 2**63 - 1)),
    )
    for value in values
]


def mutate(files: list[bytes], seed: int, most_changes: int = 4) -> bytes:
    """Apply a few changes to one of the files, the same ones for the same seed."""
    chance = random.Random(seed)
    data = bytearray(chance.choice(files))
    for _ in range(chance.randint(1, most_changes)):
        at = chance.randint(0, len(data))
        end = min(len(data), at + int(2 ** chance.uniform(0, 8)))
        change = chance.randrange(7)
        if change == 0 and data:
            data[at % len(data)] ^= 1 << chance.randrange(8)
        elif change == 1:
            number = chance.choice(_NUMBERS)
            data[at : at + len(number)] = number
        elif change == 2:
            data[at:at] = chance.choice(_WORDS)
        elif change == 3:
            word = chance.choice(_WORDS)
            data[at:end] = word
        elif change == 4:
            del data[at:end]
        elif change == 5:
            data[at:at] = data[at:end] * chance.choice((1, 1, 2, 50))
        else:
            other = chance.choice(files)
            start = chance.randint(0, len(other))
            data[at:end] = other[start : start + end - at]
    return bytes(data)
