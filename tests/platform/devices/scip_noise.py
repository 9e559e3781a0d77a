"""Undetected damage: `python -m tests.platform.devices.scip_noise` prints the table."""

import numpy as np

from impslam.platform.devices import scip
from impslam.platform.devices.scip import Splitter
from impslam.platform.devices.scip_encoding import DamagedError, encode, with_checksum

ECHO = "MD0044072501000"
VALUES = np.random.default_rng(1).integers(20, 5600, 682)
CLEAN = (
    f"{ECHO}\n99b\n".encode("ascii")
    + with_checksum(encode(np.array([123456]), 4))
    + scip.in_lines(encode(VALUES, 3))
    + b"\n"
)


def uniform(data, errors, rng):
    """Bytes at random places become any other byte."""
    places = rng.choice(len(data), errors, replace=False)
    data[places] ^= rng.integers(1, 256, errors).astype(np.uint8)
    return data


def bits(data, errors, rng):
    """Single bits at random places flip."""
    places = rng.choice(8 * len(data), errors, replace=False)
    for place in places:
        data[place // 8] ^= 1 << (place % 8)
    return data


def burst(data, errors, rng):
    """Neighbouring bytes become random ones."""
    start = rng.integers(0, len(data) - errors)
    data[start : start + errors] = rng.integers(0, 256, errors)
    return data


def lost(data, errors, rng):
    """Neighbouring bytes are lost."""
    start = rng.integers(0, len(data) - errors)
    return np.delete(data, np.s_[start : start + errors])


def swapped(data, _, rng):
    """Swap two neighbours, which a sum cannot detect."""
    start = rng.integers(0, len(data) - 1)
    data[[start, start + 1]] = data[[start + 1, start]]
    return data


def accepted(raw):
    """Return the scan that the driver would read from these bytes, or None."""
    for piece in Splitter().feed(raw + b"\n\n"):
        try:
            response = scip.parse(piece)
            if response.echo == ECHO and response.status == "99":
                return scip.sweep(response, 3, len(VALUES))
        except DamagedError:
            continue
    return None


def share(damage, errors, trials, rng):
    """Return the share of damaged scans that are accepted although they are wrong."""
    wrong = 0
    for _ in range(trials):
        data = damage(np.frombuffer(CLEAN, np.uint8).copy(), errors, rng)
        taken = accepted(data.tobytes())
        wrong += taken is not None and (
            taken.stamp != 123456 or not np.array_equal(taken.values, VALUES)
        )
    return wrong / trials


if __name__ == "__main__":
    generator = np.random.default_rng(0)
    for kind, numbers in {
        uniform: (1, 2, 3, 5, 10, 20),
        bits: (1, 2, 3, 5, 10, 20),
        burst: (2, 4, 8, 16, 64),
        lost: (1, 2, 66, 200),
        swapped: (2,),
    }.items():
        for number in numbers:
            found = share(kind, number, 50_000, generator)
            print(f"{kind.__name__:8} {number:3}: {found:.2e}")
