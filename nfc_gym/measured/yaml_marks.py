"""YAML read with the safe loader, keeping the line of every key, so that a message can say where."""

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from nfc_gym.core import InputError

Place = tuple[str | int, ...]
_LARGEST = 5_000_000  # bytes
_MOST_NODES = 100_000  # aliases of aliases can make a small file explode; no mapping comes near this


def suggest(name: str, choices: list[str] | tuple[str, ...], most: int = 12) -> str:
    """`did you mean 'x'? valid: a, b, c` for a name that is none of the choices."""
    close = get_close_matches(name, choices, 1, 0.6)
    listed = ", ".join(choices[:most]) + (f" and {len(choices) - most} more" if len(choices) > most else "")
    return (f"did you mean {close[0]!r}? " if close else "") + f"valid: {listed or 'none'}"


def read_yaml(path: Path) -> tuple[Any, dict[Place, int]]:
    """A YAML file's data, and for the place (keys and indices from the root) of every entry its line, counted from 1.

    Raises:
      InputError: the file is missing, not text, not YAML, or holds a key twice; with the line where there is one.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder: name the mapping file in it")
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: not an ordinary file; a mapping is one, beside its model and logs")
        if path.stat().st_size > _LARGEST:
            raise InputError(f"{path}: larger than {_LARGEST / 1e6:g} MB; a mapping is a small YAML file")
        text = path.read_text(encoding="utf-8-sig")
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such file") from None
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror or e})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; a mapping is YAML in UTF-8") from None
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        lines: dict[Place, int] = {(): 1}
        return (None if node is None else _build(path, loader, node, (), lines)), lines
    except yaml.MarkedYAMLError as e:
        line = f":{e.problem_mark.line + 1}" if e.problem_mark else ""
        raise InputError(f"{path}{line}: not valid YAML: {e.problem or e.context}") from None
    except InputError:
        raise
    except (yaml.YAMLError, RecursionError, ValueError) as e:
        raise InputError(f"{path}: not valid YAML: {e}") from None


def _build(path: Path, loader: yaml.SafeLoader, node: yaml.Node, place: Place, lines: dict[Place, int]) -> Any:
    if len(lines) > _MOST_NODES:
        raise InputError(f"{path}: more than {_MOST_NODES} entries; a mapping is a small file")
    if isinstance(node, yaml.SequenceNode):
        for i, item in enumerate(node.value):
            lines[(*place, i)] = item.start_mark.line + 1
        return [_build(path, loader, item, (*place, i), lines) for i, item in enumerate(node.value)]
    if not isinstance(node, yaml.MappingNode):
        return _scalar(path, loader, node)
    result: dict[str, Any] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        key = _scalar(path, loader, key_node)
        if not isinstance(key, str):
            raise InputError(f"{path}:{line}: key {key!r} is not text: put it in quotes")
        if key in result:
            raise InputError(f"{path}:{line}: {key!r} appears twice, first on line {lines[(*place, key)]}: remove one")
        lines[(*place, key)] = line
        result[key] = _build(path, loader, value_node, (*place, key), lines)
    return result


def _scalar(path: Path, loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    try:
        data = loader.construct_object(node, deep=True)
        if isinstance(data, str):
            data.encode()  # half a surrogate pair could be written to no report
        return data
    except (yaml.YAMLError, RecursionError):
        raise
    except Exception as e:  # dates, numbers and binaries that are none, each in its own way
        text, kind = str(node.value)[:40], node.tag.rpartition(":")[2]
        raise InputError(f"{path}:{node.start_mark.line + 1}: {text!r} is no {kind} ({e})") from None


def line_of(lines: dict[Place, int], place: Place) -> int:
    """Line of the nearest entry at or above a place."""
    while place not in lines:
        place = place[:-1]
    return lines[place]
