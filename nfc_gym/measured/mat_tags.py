"""Whether a MATLAB file (levels 5 to 7) is built as its own tags say, before SciPy's compiled reader follows them.

That reader trusts the tags: one flipped byte of a damaged file can send it to an address that is none, and the process
is gone. Format: MathWorks, "MAT-File Format", the Level 5 chapter.
"""

import struct
import zlib
from math import prod

_MATRIX, _COMPRESSED = 14, 15
_INT32, _UINT32 = 5, 6
_SIZES, _NAMES = (5, 6), (1, 16)  # data types that writers use for dimensions, and for names
_NUMBERS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}  # data types of numbers and characters
_CELL, _STRUCT, _CHAR, _PLAIN = 1, 2, 4, range(6, 16)  # classes of arrays
_COMPLEX = 0x800
_HEADER = 128
_DEEPEST = 40
_LARGEST = 2**32  # bytes of one variable, unpacked


def require_sound(data: bytes) -> None:
    """Raises `ValueError`, saying where, if the file is not built as its tags say; level 4 files pass."""
    if 0 in data[:4]:
        return  # level 4: read by Python code
    if len(data) < _HEADER or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("no MATLAB header")
    order = "<" if data[126:128] == b"IM" else ">"
    at = _HEADER
    while at < len(data):
        kind, content, at = _element(data, at, len(data), order)
        if kind == _COMPRESSED:
            content = _unpacked(content)
            kind, content, _ = _element(content, 0, len(content), order)
        if kind != _MATRIX:
            raise ValueError(f"element of type {kind} before byte {at}, where a variable should be")
        _require_matrix(content, order, 0)


def _unpacked(content: bytes) -> bytes:
    unpack = zlib.decompressobj()
    data = unpack.decompress(content, _LARGEST)
    if not unpack.eof:
        raise ValueError("a variable whose packed bytes have no end")
    return data


def _element(data: bytes, at: int, end: int, order: str) -> tuple[int, bytes, int]:
    """Type and content of the element at a position, and the position of the next; small ones share their tag."""
    if end - at < 8:
        raise ValueError(f"tag cut short at byte {at}")
    kind, size = struct.unpack_from(order + "II", data, at)
    small = kind >> 16
    if small:
        kind, size, start, follow = kind & 0xFFFF, small, at + 4, at + 8
        if size > 4:
            raise ValueError(f"small element of {size} bytes at byte {at}")
    else:
        start = at + 8
        follow = start + size
        if kind != _COMPRESSED:
            follow = min(follow + -size % 8, max(end, follow))
    if kind not in _NUMBERS and kind not in (_MATRIX, _COMPRESSED):
        raise ValueError(f"element of unknown type {kind} at byte {at}")
    if start + size > end:
        raise ValueError(f"element of {size} bytes at byte {at}, beyond the end")
    return kind, data[start : start + size], follow


def _require_matrix(data: bytes, order: str, depth: int) -> None:
    if not data:
        return  # an empty array in a cell or struct
    if depth > _DEEPEST:
        raise ValueError(f"arrays nested more than {_DEEPEST} deep")
    parts, at = [], 0
    while at < len(data):
        kind, content, at = _element(data, at, len(data), order)
        if kind == _COMPRESSED:
            raise ValueError("a packed element inside a variable")
        if kind == _MATRIX:
            _require_matrix(content, order, depth + 1)
        parts.append((kind, content))
    if parts[0][0] != _UINT32 or len(parts[0][1]) != 8:
        raise ValueError("a variable without array flags")
    flags = struct.unpack(order + "I", parts[0][1][:4])[0]
    if (flags & 0xFF) in (_CELL, _STRUCT, _CHAR, *_PLAIN):
        _require_parts(flags, parts, order)


def _require_parts(flags: int, parts: list[tuple[int, bytes]], order: str) -> None:
    """The parts of an array: flags, dimensions, name, then as many as its class has."""
    kinds = [kind for kind, _ in parts]
    named = len(kinds) > 2 and kinds[1] in _SIZES and kinds[2] in _NAMES
    if not named or len(parts[1][1]) < 8 or len(parts[1][1]) % 4:
        raise ValueError("a variable without dimensions or a name")
    shape = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1])
    if min(shape) < 0:
        raise ValueError(f"a variable of shape {shape}")
    rest, kind = kinds[3:], flags & 0xFF
    if kind == _CELL:
        wanted = [_MATRIX] * prod(shape) if prod(shape) == len(rest) else None
    elif kind == _STRUCT:
        width = struct.unpack(order + "i", parts[3][1])[0] if rest[:1] == [_INT32] and len(parts[3][1]) == 4 else 0
        fields = len(parts[4][1]) // width if width > 0 and len(rest) > 1 else 0
        known = fields * prod(shape) == len(rest) - 2
        wanted = [*rest[:2], *[_MATRIX] * (len(rest) - 2)] if known and rest[1] in _NAMES else None
    else:
        wanted = rest if len(rest) == 1 + bool(flags & _COMPLEX) and _MATRIX not in rest else None
    if rest != wanted:
        raise ValueError(f"an array of class {kind} and shape {shape} made of other parts than it should be")
