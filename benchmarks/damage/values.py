"""Values that nobody expects, and bytes that nobody wrote."""

from copy import deepcopy
from random import Random
from typing import Any

ODD: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 10**9, 10**30, -(10**30), 0.5, -0.5, 1e-300, 1e300, 1e-12, float("nan"),
    float("inf"), float("-inf"), "", " ", "0", "nan", "true", "null", "x" * 5000, "ü", "日本語", "a\nb", "a\tb",
    "\u202e", "😀",
    "../../etc/passwd", "/dev/null", "/", ".", "..", "~", "*", "**", "[", "(", "a[0]", "q[0]", "q[99]", "q[-1]", "t",
    "q",
    "deg", "m", "rad/s", "kg", "zero", "auto", "fit", "rotate", "time", "group", "xyzw", "body_mass", "opt.timestep",
    "geom_friction[7]", "body_mass[9]", "qpos0", "nq", "__class__", "servo_kv", "ctrl:servo", "joint:hinge:pos",
    "exo:supply", "body:world:pos", "body:base:pos", "sensor:gyro", "machine.xml", "jackal", "nfc_gym/AntFlat-v0",
    [], {}, [None], [[]], [1, 2, 3], ["q", "q"], ["q", "v"], [0.1, 0.1], [0.2, 0.1], [1e-9, 1e9], {"column": "q"},
    {"columns": []}, {"scale": 1e300}, {"a": {"b": {"c": []}}}, ["x"] * 100,
)  # fmt: skip


def odd(rng: Random) -> Any:
    """An odd value, its own: what is damaged next must not reach into `ODD`."""
    return deepcopy(rng.choice(ODD))


def flipped(content: bytes, rng: Random) -> bytes:
    """A few bytes are others."""
    data = bytearray(content)
    for _ in range(rng.randint(1, 8)):
        if data:
            data[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(data)


def cut(content: bytes, rng: Random) -> bytes:
    """The end is missing."""
    return content[: rng.randrange(len(content) + 1)]


def holed(content: bytes, rng: Random) -> bytes:
    """A stretch is zeros, as after a crash of the machine that wrote it."""
    a = rng.randrange(len(content) + 1)
    b = min(len(content), a + rng.choice((1, 16, 256, 4096)))
    return content[:a] + bytes(b - a) + content[b:]


def spliced(content: bytes, rng: Random) -> bytes:
    """A stretch is repeated, moved or left out."""
    a, b, c = sorted(rng.randrange(len(content) + 1) for _ in range(3))
    return rng.choice((content[:a] + content[b:], content[:c] + content[a:], content[:a] + content[b:c] + content[a:]))


def garbage(content: bytes, rng: Random) -> bytes:
    """Nothing of it is left."""
    return rng.choice(
        (b"", b"\0" * 64, b"\xff\xfe" + "t,q\n0,1\n".encode("utf-16-le"), b"PK\x03\x04" + bytes(30),
        b"PAR1" + bytes(20) + b"PAR1",
         b"MATLAB 5.0 MAT-file" + bytes(200), b"\x89HDF\r\n\x1a\n" + bytes(200), b"\x93NUMPY\x01\x00",
         b"\x80\x04K\x01.",
         b"t,q\n", b"\n\n\n", b"t\n0\n1\n", b"\x1f\x8b\x08\x00", b"<html>404</html>", bytes(range(256)) * 4,
         rng.randbytes(500))
    )  # fmt: skip


BYTES = {"flipped": flipped, "cut": cut, "holed": holed, "spliced": spliced, "garbage": garbage}
