"""docs/mapping.md says what the code does, key by key; docs/library.md is what docs/library.py makes, and runs."""

import hashlib
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from nfc_gym.core import InputError, units
from nfc_gym.measured import entries
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.checks import check
from nfc_gym.measured.dataset import load
from nfc_gym.measured.mapping import Mapping, load_mapping
from nfc_gym.measured.readers import suffixes
from nfc_gym.physics.effects import FAMILIES
from nfc_gym.physics.fields import rows_of
from nfc_gym.physics.parameters import COMPOUND

SUFFIXES = set(suffixes())  # as imported: tests register others
DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "mapping.md").read_text(encoding="utf-8")
LIBRARY = (DOCS / "library.md").read_text(encoding="utf-8")
COMPLETE, *FRAGMENTS = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
(MODEL,) = re.findall(r"^```xml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
# Heading -> what of the mapping it is about.
SECTIONS: dict[str, type[BaseModel]] = {
    "Top level": Mapping,
    "`parameters`": entries.ParameterEntry,
    "`logs`": entries.LogEntry,
    "`split`": entries.SplitRule,
    "`time`": entries.TimeColumn,
    "`controls`": entries.Control,
    "`servo`": entries.Servo,
    "`known`": entries.Known,
    "`channels`": entries.Measured,
    "`exogenous`": entries.Exogenous,
    "`segments`": entries.Segments,
    "`effects`": entries.EffectChoice,
}
SHOWN = (str, bool, int, float)  # defaults that a table can show as they are


def section(title: str) -> str:
    """What stands under a heading, up to the next one."""
    return re.split(r"^#+ ", PAGE.split(f"# {title}\n")[1], maxsplit=1, flags=re.MULTILINE)[0]


def rows(text: str, first: str) -> list[list[str]]:
    """Cells of the table whose first column is headed so; code keeps its bars."""
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {first} |")) + 2
    out = []
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        out.append([cell.strip() for cell in line.strip("|").split(" | ")])
    return out


def code(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


# ---- the examples ---------------------------------------------------------------------------------------------------


def merged(fragment: str) -> dict[str, Any]:
    """The complete example with the keys of a fragment in place of its own."""
    return yaml.safe_load(COMPLETE) | yaml.safe_load(fragment)


@pytest.mark.parametrize("text", [COMPLETE, *(yaml.safe_dump(merged(f)) for f in FRAGMENTS)])
def test_examples_are_mappings(text: str, tmp_path: Path) -> None:
    (tmp_path / "mapping.yaml").write_text(text)
    load_mapping(tmp_path / "mapping.yaml")


def test_every_section_has_an_example() -> None:
    shown = {key for f in FRAGMENTS for key in yaml.safe_load(f)} | set(yaml.safe_load(COMPLETE))
    assert shown == {field.alias or name for name, field in Mapping.model_fields.items()}


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """The complete example's mapping beside its model and five logs of it."""
    (tmp_path / "mapping.yaml").write_text(COMPLETE)
    (tmp_path / "arm.xml").write_text(MODEL)
    (tmp_path / "runs").mkdir()
    for i in range(5):
        record(tmp_path / "runs" / f"run_{i}.csv", i)
    return tmp_path


def record(path: Path, seed: int) -> None:
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(MODEL)
    data, lines = mujoco.MjData(model), ["t,torque,angle"]
    for k in range(400):
        data.ctrl[0] = 0.5 * np.sin((1 + 0.3 * seed) * data.time)
        lines.append(f"{0.01 * k:.3f},{data.ctrl[0]:.5f},{np.degrees(data.qpos[0]) + 0.05 * rng.normal():.4f}")
        mujoco.mj_step(model, data, 5)
    path.write_text("\n".join(lines))


def test_the_complete_example_is_complete(machine: Path) -> None:
    assert check(machine / "mapping.yaml") == []
    dataset = load(machine / "mapping.yaml")
    channel = dataset.logs[0].channels["joint:shoulder:pos"]
    assert channel.unit == "rad"
    assert channel.noise == pytest.approx(np.radians(0.05))
    assert np.abs(channel.values).max() < 3


def changed(machine: Path, column: str, row: int, value: str) -> None:
    path = machine / "runs" / "run_0.csv"
    lines = path.read_text().splitlines()
    at, cells = lines[0].split(",").index(column), lines[row + 1].split(",")
    cells[at] = value
    lines[row + 1] = ",".join(cells)
    path.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("column", "value", "error"),
    [
        ("angle", "", "NaN or infinite"),
        ("torque", "", "NaN or infinite"),
        ("t", "", "is not a number at row 7"),
        ("t", "0.01", "goes back"),
        ("angle", "1e21", "which nothing measures"),
    ],
)
def test_rows_that_are_missing_are_errors(machine: Path, column: str, value: str, error: str) -> None:
    changed(machine, column, 7, value)
    with pytest.raises(InputError, match=error):
        load(machine / "mapping.yaml")


@pytest.mark.parametrize("key", ["mask: good", "rate: 50"])
def test_unless_the_channel_says_so(machine: Path, key: str) -> None:
    for path in (machine / "runs").iterdir():
        head, *lines = path.read_text().splitlines()
        path.write_text("\n".join([f"{head},good", *(f"{line},{int(k != 7)}" for k, line in enumerate(lines))]))
    changed(machine, "angle", 7, "")
    (machine / "mapping.yaml").write_text(COMPLETE.replace("noise: 0.05", f"noise: 0.05, {key}"))
    mask = load(machine / "mapping.yaml").logs[0].channels["joint:shoulder:pos"].mask
    assert mask is not None
    assert np.flatnonzero(~mask).tolist() == [7]


# ---- the tables -----------------------------------------------------------------------------------------------------


def keys(model: type[BaseModel]) -> Iterator[tuple[str, Any]]:
    """What the parser takes, as the tables call it: (key, default)."""
    for name, field in model.model_fields.items():
        yield field.alias or ("column" if name == "columns" else name), field.default


@pytest.mark.parametrize("title", SECTIONS)
def test_tables_have_the_parsers_keys(title: str) -> None:
    table = rows(section(title), "key")
    assert all(len(cells) == 4 for cells in table)
    told = {key: cells[3] for cells in table for key in code(cells[0])}
    taken = dict(keys(SECTIONS[title]))
    assert set(told) == set(taken)
    for key, default in taken.items():
        if default is PydanticUndefined and title != "Top level":
            assert "required" in told[key]
        if title != "Top level" and isinstance(default, SHOWN) and default not in ("", float("inf")):
            shown = str(default).lower() if isinstance(default, bool) else f"{default}".removesuffix(".0")
            assert f"`{shown}`" in told[key], key


def test_every_section_is_in_the_page() -> None:
    tables = re.findall(r"^\| key \|", PAGE, re.MULTILINE)
    assert len(tables) == len(SECTIONS)


def test_units() -> None:
    table = rows(section("Units"), "SI unit")
    assert sorted(unit for cells in table for unit in code(cells[1])) == sorted(units.UNITS)
    for si, given in table:
        assert {units.si_unit(unit) for unit in code(given)} == set(code(si))


def test_channel_names() -> None:
    table = rows(section("`channels`"), "name")
    for cells in table:
        for name in code(cells[0]):
            parsed = parse_channel(name)
            assert parsed.width is None or str(parsed.width) == cells[2], name
            assert set(parsed.units) == set(code(cells[3])), name
    told = {re.sub("<.*>", "x", name) for cells in table for name in code(cells[0])}
    bodies = {f"body:x:{q}" for q in ("pos", "quat", "linvel", "angvel", "linvel@body", "angvel@body")}
    assert told == bodies | {f"joint:x:{q}" for q in ("pos", "vel", "acc")} | {"sensor:x", "force:x"}


def test_fields() -> None:
    table = rows(section("`parameters`"), "field")
    told = [field for cells in table for field in code(cells[0])]
    assert set(COMPOUND) <= set(told)
    prefixes = {p.removesuffix("_") for cells in table for p in code(cells[1]) if p.endswith("_")}
    with pytest.raises(InputError) as error:
        rows_of(mujoco.MjModel.from_xml_string(MODEL), "nothing", ())
    known = re.search(r"fields of (.*), or use", str(error.value))
    assert known is not None
    assert prefixes | {"servo"} == set(known[1].split(", "))  # of `servo_` fields there are two, told by themselves


def test_formats() -> None:
    told = {s for cells in rows(section("`logs`"), "log") for s in code(cells[0]) if s.startswith(".")}
    assert told == SUFFIXES


# ---- the library ----------------------------------------------------------------------------------------------------


def maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location("library_page", DOCS / "library.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_library_is_as_the_code_has_it() -> None:
    assert maker().page() == LIBRARY, "run: python docs/library.py"


def test_every_family_is_listed_once() -> None:
    listed = re.findall(r"^\| `(\w+)` \|", LIBRARY, re.MULTILINE)
    assert listed == [f.family for generic in (False, True) for f in FAMILIES.values() if f.generic == generic]
    assert {f for f in listed if not FAMILIES[f].generic} == set(entries.FAMILIES)


def test_the_librarys_programs_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    own, corrected = re.findall(r"^```python\n(.*?)^```", LIBRARY, re.DOTALL | re.MULTILINE)
    (row,) = (yaml.safe_load(text) for text in re.findall(r"^```yaml\n(.*?)^```", LIBRARY, re.DOTALL | re.MULTILINE))
    names: dict[str, Any] = {}
    exec(own, names)
    assert [e.id for e in names["env"].effects] == ["coulomb:shoulder", "delay:motor"]
    bare = names["Arm"]()
    free, _ = bare.reset(seed=0)
    for _ in range(50):
        free, *_ = bare.step(np.array([0.5], np.float32))
    assert abs(names["observation"][1]) < 0.01 < abs(free[1])  # dry friction brings the link to rest
    (tmp_path / "result").mkdir()
    text = (tmp_path / "arm.xml").read_text()
    (tmp_path / "result" / "model.xml").write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    content = {"version": 1, "model_sha256": digest, "effects": [row], "carried_by_model": ["delay:motor"]}
    (tmp_path / "result" / "effects.yaml").write_text(yaml.safe_dump(content))
    exec(corrected, names)
    assert [e.id for e in names["env"].effects] == ["coulomb:shoulder"]
