"""`nfc-gym demo`: the whole loop, blind, on a simulated Jackal that hides one effect; then the envelope is opened."""

import hashlib
import json
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable
from nfc_gym.measured import standin
from nfc_gym.measured.hidden import Array
from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.stages import digest, write_whole

_LOGS, _SECONDS = 6, 2.35  # 8 s to fit: the whole loop then takes two to three minutes on two cores
_OURS = {"logs", "mapping.yaml", "envelope.json", "report"}


def demo(out: Path, *, seed: int = 0, console: Console | None = None, draw: int | None = None) -> dict[str, Any]:
    """Draw a hidden effect, seal it, run the loop on the logs alone, open the envelope and compare.

    Args:
      out: folder for `logs/`, `mapping.yaml`, `envelope.json` and `report/`; new, empty, or left by an unfinished demo.
      seed: of the loop; it does not choose the effect.
      console: where progress and the outcome go; None is silent.
      draw: fixes the drawing of machine, effect and noise, to repeat a demo (`draw` in its envelope); None draws anew.

    Returns:
      The envelope's content with `outcome`: right, wrong or missed, and the loop's report.

    Raises:
      InputError: the folder holds something else, or a finished demo.
    """
    screen = console or Console(quiet=True)
    require_writable(out)
    _clear(out)
    envelope = _seal(out, secrets.randbits(32) if draw is None else draw)
    screen.print(
        "[bold]This machine is simulated.[/bold] It stands in for a real Jackal: separate code, another time step, "
        "parameters off by up to 15 %, noisy sensors."
    )
    screen.print(f"One hidden effect was drawn just now and written to {out / 'envelope.json'} before the loop starts.")
    screen.print(
        "The loop reads mapping.yaml and logs/ only. So that you can check that the envelope stays as it is, "
        "its SHA-256 now:"
    )
    screen.print(f"  {envelope}", highlight=False)
    report = close_loop(out / "mapping.yaml", out / "report", seed=seed, console=console)
    if digest(out / "envelope.json") != envelope:
        raise InputError(
            f"{out / 'envelope.json'} was changed while the loop ran: this demo proves nothing, start over"
        )
    content = json.loads((out / "envelope.json").read_text())
    outcome = judge(report, content["family"], content["where"])
    _show(screen, content, report, outcome, out)
    return {**content, "outcome": outcome, "report": report}


def judge(report: Mapping[str, Any], family: str, where: list[str] | tuple[str, ...]) -> str:
    """What a report is worth, given what was hidden (family `none` for nothing).

    Returns `right`: the one claim, or the one equivalent reported beside it, has the family and the place; `missed`: no
    claim, though something was hidden; `wrong`: anything else, a right claim with a second, false one included.
    """
    claims = report["effects"]
    if not claims:
        return "right" if family == "none" else "missed"
    named = [claims[0]["id"], *claims[0]["equivalents"]]
    hit = any(_same(i, family, where) for i in named)
    return "right" if len(claims) == 1 and hit and len(named) <= 2 else "wrong"


def _same(effect_id: str, family: str, where: list[str] | tuple[str, ...]) -> bool:
    found, _, place = effect_id.removesuffix(":each").partition(":")
    return found == family and set(place.split("+")) == set(where)


def _clear(out: Path) -> None:
    if not out.exists():
        return
    if not out.is_dir():
        raise InputError(f"{out} exists and is not a folder: choose another --out")
    foreign = sorted(p.name for p in out.iterdir() if p.name not in _OURS and not p.name.startswith("."))
    if foreign:
        raise InputError(f"{out} exists and holds {foreign[0]!r}, which is not a demo's: choose another --out")
    if (out / "report" / "report.json").exists():
        raise InputError(f"{out} holds a finished demo: choose another --out, or delete it first")
    for name in _OURS:
        path = out / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _seal(out: Path, draw: int) -> str:
    """Make the machine and its logs; returns the SHA-256 of the envelope, which is written first."""
    rng = np.random.default_rng(draw)
    psi = standin.draw_psi(standin.JACKAL_PSI, rng)
    kind = standin.JACKAL_KINDS[str(rng.choice(list(standin.JACKAL_KINDS)))]
    hidden = kind.make(rng, float(np.exp(rng.uniform(np.log(kind.low), np.log(kind.high)))))
    (out / "logs").mkdir(parents=True, exist_ok=True)
    content = {
        "simulated": True,
        "hidden": hidden.text,
        "family": hidden.family,
        "where": list(hidden.where),
        "parameters": hidden.parameters,
        "psi": psi,
        "draw": draw,
        "salt": secrets.token_hex(16),  # so that nobody can find the effect by hashing guesses
    }
    text = json.dumps(content, indent=1)
    write_whole(out / "envelope.json", text)
    machine = standin.Machine(psi, hidden)
    for i in range(_LOGS):
        write_log(out / "logs" / f"run_{i:02d}.csv", standin.drive_jackal(machine, _SECONDS, int(rng.integers(2**31))))
    write_whole(out / "mapping.yaml", jackal_mapping(psi["base_mass"]))
    return hashlib.sha256(text.encode()).hexdigest()


def write_log(path: Path, columns: Mapping[str, Array]) -> None:
    """Columns (T,) each as a CSV file."""
    np.savetxt(path, np.stack(list(columns.values()), 1), "%.9g", ",", header=",".join(columns), comments="")


def body_channels(noise: Mapping[str, float], body: str = "base") -> dict[str, Any]:
    """Mapping entries of a free base whose columns are those of `standin.body_columns`."""
    return {
        f"body:{body}:pos": {"columns": ["x", "y", "z"], "unit": "m", "noise": noise["pos"]},
        f"body:{body}:quat": {"columns": ["qw", "qx", "qy", "qz"], "order": "wxyz", "noise": noise["quat"]},
        f"body:{body}:linvel": {"columns": ["vx", "vy", "vz"], "unit": "m/s", "noise": noise["linvel"]},
        f"body:{body}:angvel@body": {"columns": ["wx", "wy", "wz"], "unit": "rad/s", "noise": noise["angvel"]},
    }


def jackal_mapping(weighed: float) -> str:
    """Mapping file of the stand-in's logs.

    It declares other and fewer parameters than the Jackal's psi.toml. Four wheels of one make share a friction, a servo
    gain, a bearing drag and a rotor inertia: with a gain for each wheel a lost axle would be a parameter like any
    other, and no finding. The chassis was weighed, which fixes the scale of all forces; restitution shows only in
    jumps, of which there are none.
    """
    noise, wheels = standin.JACKAL_NOISE, list(standin.WHEELS)
    joints = [f"{w}_wheel" for w in wheels]
    mapping = {
        "version": 1,
        "model": "jackal",
        "parameters": [
            {
                "name": "base_mass",
                "field": "body_mass",
                "of": ["base"],
                "unit": "kg",
                "nominal": round(weighed, 3),
                "low": 12.0,
                "high": 35.0,
                "anchored": True,
                "reason": "weighed",
            },
            {
                "name": "wheel_servo",
                "field": "servo_kv",
                "of": wheels,
                "tied": True,
                "unit": "N m s/rad",
                "low": 0.5,
                "high": 10.0,
            },
            {
                "name": "wheel_friction",
                "field": "geom_friction[0]",
                "of": joints,
                "tied": True,
                "unit": "1",
                "low": 0.1,
                "high": 1.5,
            },
            {
                "name": "wheel_damping",
                "field": "dof_damping",
                "of": joints,
                "tied": True,
                "unit": "N m s/rad",
                "low": 0.0,
                "high": 0.1,
            },
            {
                "name": "wheel_armature",
                "field": "dof_armature",
                "of": joints,
                "tied": True,
                "unit": "kg m^2",
                "nominal": 0.05,
                "low": 0.02,
                "high": 0.1,
                "reason": "rotor inertia times the gear ratio squared, data sheet",
            },
        ],
        "logs": [{"path": "logs/*.csv"}],
        "time": {"column": "time", "unit": "s"},
        "controls": {f"ctrl:{w}": {"column": f"{w}_command", "unit": "rad/s"} for w in wheels},
        "channels": body_channels(noise)
        | {f"joint:{w}_wheel:vel": {"column": f"{w}_speed", "unit": "rad/s", "noise": noise["wheel"]} for w in wheels},
        "segments": {"length": 0.4, "history": 0.5, "horizons": [0.05, 0.1, 0.2, 0.4]},
    }
    return yaml.safe_dump(mapping, sort_keys=False, default_flow_style=None, width=120)


def _show(console: Console, content: Mapping[str, Any], report: Mapping[str, Any], outcome: str, out: Path) -> None:
    claims = report["effects"]
    table = Table("", title="The envelope is opened", show_lines=True)
    for title in ("sealed in the envelope", "what the loop says"):
        table.add_column(title, overflow="fold")  # ids of many places have no blank to break at
    table.add_row("effect", content["hidden"], "; ".join(e["sentence"] for e in claims) or "no effect claimed")
    table.add_row(
        "family:place",
        f"{content['family']}:{'+'.join(content['where'])}",
        "\n".join([e["id"], *(f"or {q}" for q in e["equivalents"])]) if (e := claims[0] if claims else None) else "-",
    )
    for name, true in content["parameters"].items():
        found = claims[0]["parameters"].get(name) if claims else None
        table.add_row(
            name,
            f"{true:.4g}",
            f"{found['value']:.4g} ({found['low']:.4g} to {found['high']:.4g}) {found['unit']}" if found else "-",
        )
    for group, row in report["error"]["groups"].items():
        before, after, floor = (row[s][-1] for s in ("calibrated", "extended", "noise_floor"))
        horizon = report["error"]["horizons_s"][-1]
        table.add_row(
            f"{group} error",
            f"after {horizon:g} s, on logs nobody fitted to",
            f"{before:.3g} -> {after:.3g} {row['unit']} (noise floor {floor:.3g})",
        )
    table.add_row("verdict", "", report["verdict"])
    console.print(table)
    words = {
        "right": "[bold green]Right:[/bold green] the loop named the family and the place.",
        "wrong": "[bold red]Wrong:[/bold red] what the loop claims is not what was hidden.",
        "missed": "[bold yellow]Missed:[/bold yellow] the loop claims nothing, though something was hidden.",
    }
    hidden = f"{content['family']}:{'+'.join(content['where'])}"
    among = len(claims) == 1 and hidden in (claims[0]["id"], *claims[0]["equivalents"])
    if outcome == "wrong" and among:
        alike = 1 + len(claims[0]["equivalents"])
        words[outcome] = (
            f"[bold red]Wrong:[/bold red] what was hidden is among {alike} effects that these logs cannot tell apart, "
            "where two at most count as an answer."
        )
    console.print(words[outcome])
    console.print(
        f"The report: {out / 'report' / 'report.html'}. The machine was simulated; on yours: "
        "nfc-gym close-loop MAPPING.yaml --out DIR",
        markup=False,
        emoji=False,
    )
