"""What happens to bytes on disks, on lines and in editors."""

import numpy as np

from fuzz.case import pick


def damaged(content: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Return what was done, and the bytes after it."""
    how = pick(rng, [flip_bits, truncate, cut_out, repeat, overwrite, append])
    return how.__name__.replace("_", " "), how(content, rng)


def flip_bits(content: bytes, rng: np.random.Generator) -> bytes:
    """Flip one to eight bits."""
    data = np.frombuffer(content, np.uint8).copy()
    places = rng.integers(data.size, size=rng.integers(1, 9))
    data[places] ^= (1 << rng.integers(8, size=places.size)).astype(np.uint8)
    return data.tobytes()


def truncate(content: bytes, rng: np.random.Generator) -> bytes:
    """End anywhere."""
    return content[: rng.integers(len(content))]


def cut_out(content: bytes, rng: np.random.Generator) -> bytes:
    """Lose a piece in the middle."""
    start, end = sorted(rng.integers(len(content), size=2))
    return content[:start] + content[end:]


def repeat(content: bytes, rng: np.random.Generator) -> bytes:
    """Write a piece twice."""
    start, end = sorted(rng.integers(len(content), size=2))
    return content[:end] + content[start:]


def overwrite(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace a block by noise, zeros or ones."""
    start = int(rng.integers(len(content)))
    length = min(int(pick(rng, [1, 16, 512, 4096])), len(content) - start)
    block = pick(rng, [rng.bytes(length), b"\0" * length, b"\xff" * length])
    return content[:start] + block + content[start + length :]


def append(content: bytes, rng: np.random.Generator) -> bytes:
    """Add noise, or the whole once more."""
    return content + pick(rng, [rng.bytes(int(rng.integers(1, 5000))), content])
