"""Files as they come from elsewhere: good ones with something wrong in them, the same for the same seed."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator

MUTANTS = int(os.environ.get("MUTANTS", "10000"))
"""Of each format, in the long runs."""
EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FFFFFFFFFFFFFFF, 2**64 - 1)
WORDS = (
    b"nan", b"-inf", b"1e400", b"-1e308", b"0", b"-1", b"99999999999999999999", b"1e-320", b"true", b"null", b"''",
    b'""', b"[]", b"{}", b"[" * 300, b"{" * 300, b'{"a":' * 300, b"&a [*a]", b"*a", b"<<: *a", b"!!python/object:x {}",
    b"\xff", b"\xed\xa0\x80", b"\0", b"\x1b[2J", b"a.b.c.d", b"= =", b'"""', b"0x", b"1979-05-27", b"\xe2\x80\xae",
)  # fmt: skip


def mutants(good: bytes, count: int, seed: int, *, text: bool = False) -> Iterator[bytes]:
    """text: also such as only people's formats have."""
    chance = random.Random(seed)
    for _ in range(count):
        data = bytearray(good)
        for _ in range(chance.choice((1, 1, 1, 2, 4))):
            (_spoil_text if text and chance.random() < 0.7 else _spoil)(data, chance)
        yield bytes(data)


def _spoil(data: bytearray, chance: random.Random) -> None:
    at = chance.randrange(len(data) + 1)
    length = min(chance.choice((1, 2, 4, 8, 64, 1000)), max(len(data) - at, 0))
    match chance.randrange(6):
        case 0 if at < len(data):
            data[at] ^= 1 << chance.randrange(8)
        case 1:
            data[at : at + length] = chance.randbytes(length)
        case 2:
            del data[at : at + length]
        case 3:
            data[at:at] = data[at : at + length]
        case 4:
            size = chance.choice((1, 2, 4, 8))
            extreme = chance.choice(EXTREMES) & ((1 << 8 * size) - 1)
            data[at : at + size] = extreme.to_bytes(size, chance.choice(("little", "big")))
        case _:
            del data[at:]


def _spoil_text(data: bytearray, chance: random.Random) -> None:
    """A word in place of another, a line twice, gone or elsewhere."""
    lines = data.split(b"\n")
    at = chance.randrange(len(lines))
    line = lines[at]
    match chance.randrange(5):
        case 0 | 1:
            head, mark, _ = line.partition(chance.choice((b"=", b":", b",", b"[")))
            lines[at] = head + mark + b" " + chance.choice(WORDS)
        case 2:
            words = line.split(b" ")
            words[chance.randrange(len(words))] = chance.choice(WORDS)
            lines[at] = b" ".join(words)
        case 3:
            lines.insert(chance.randrange(len(lines)), line)
        case _:
            del lines[at]
    data[:] = b"\n".join(lines)
