"""The folder that a user would have: model, mapping file and logs; and the truth, which is kept elsewhere."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from .drawing import Drawn, columns
from .effect import Array
from .machine import MODELS, Machine


def write(drawn: Drawn, folder: Path, truth: Path) -> None:
    """Write `machine.xml` (or `.urdf`), `mapping.yaml` and `runs/` into the folder, and the truth into its own file."""
    machine = drawn.case.machine
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "runs").mkdir(parents=True)
    source = MODELS / machine.model
    shutil.copy(source, folder / f"machine{source.suffix}")
    (folder / "mapping.yaml").write_text(mapping(machine))
    for log in range(len(drawn.runs)):
        _write_log(folder / "runs" / f"run{log:02d}.{machine.format.suffix}", machine, columns(drawn, log))
    truth.parent.mkdir(parents=True, exist_ok=True)
    truth.write_text(json.dumps(told(drawn), indent=1))


def told(drawn: Drawn) -> dict[str, Any]:
    """The truth, as JSON has it."""
    machine, user = drawn.case.machine, drawn.case.machine.user_model()
    forms = [
        [{"family": f.family, "where": list(f.where), "parameters": dict(f.parameters)} for f in e.forms]
        for e in drawn.effects
    ]
    return {
        "name": drawn.case.name,
        "group": drawn.case.group,
        "seed": drawn.seed,
        "effects": [
            {"forms": rows, "places": list(e.places), "text": e.text}
            for rows, e in zip(forms, drawn.effects, strict=True)
        ],
        "psi": {p.name: value for p, value in zip(machine.parameters, drawn.psi, strict=True)},
        "nominal": {p.name: p.nominal(user) for p in machine.parameters},
        "shown": drawn.shown,
        "seconds": machine.seconds * machine.logs,
    }


def mapping(machine: Machine) -> str:
    """The mapping file."""
    user, form = machine.user_model(), machine.format
    lines = ["version: 1", f"model: machine{Path(machine.model).suffix}", "parameters:"]
    lines += [p.entry(user) for p in machine.parameters]
    lines += ["logs:", f'  - {{path: "runs/*.{form.suffix}"}}', f"time: {{column: t, unit: {form.clock}}}"]
    if machine.controls:
        lines += ["controls:"]
        lines += [f'  "ctrl:{c.actuator}": {{column: {c.column}, unit: {c.unit}}}' for c in machine.controls]
    lines += ["channels:", *(c.entry() for c in machine.channels)]
    if machine.signals:
        lines += ["exogenous:"]
        lines += [f'  "exo:{s.name}": {{column: {s.column}, unit: {s.unit}}}' for s in machine.signals]
    return "\n".join(lines) + "\n"


def _write_log(path: Path, machine: Machine, content: dict[str, Array]) -> None:
    if machine.format.suffix == "npz":
        np.savez_compressed(path, **content)  # type: ignore[arg-type]
        return
    rows = np.column_stack(list(content.values()))
    with path.open("w", encoding="utf-8") as file:
        print(machine.format.separator.join(content), file=file)
        for row in rows:
            cells = ("" if np.isnan(value) else _cell(name, value) for name, value in zip(content, row, strict=True))
            print(machine.format.separator.join(cells), file=file)


def _cell(name: str, value: float) -> str:
    """Seven digits; stamps, which may count since 1970, to a microsecond of seconds."""
    return f"{value:.6f}" if name == "t" else f"{value:.7g}"
