"""A report as close-loop makes it, its pictures, and a reader of the page that is made of them."""

from html.parser import HTMLParser
from typing import Any

import numpy as np

EVIL = "<script>alert('x')</script>\"&"
LOADING = {"src", "href", "xlink:href", "action", "data", "srcset", "poster"}
VOID = {"meta", "br"}


def effect(name: str = "coulomb:hinge", **more: Any) -> dict[str, Any]:
    family, where = name.split(":", 1)
    level = {"value": 0.04213, "low": 0.0402, "high": 0.0441, "unit": "N m"}
    base = {"id": name, "family": family, "where": where, "sentence": f"Dry friction at {where}: level 0.0421 N m."}
    return base | {"share_of_excess": 0.93, "equivalents": [], "parameters": {"level": level}} | more


def candidate(name: str, fit: float, select: float, low: float, generic: bool = False) -> dict[str, Any]:
    row = {"id": name, "gain_fit": fit, "gain_select": select, "gain_select_low": low}
    return row | {"generic": generic, "sentence": f"{name} in words."}


def parameter(
    name: str, unit: str, nominal: float, estimate: float, low: float, high: float, left_prior: bool = False
) -> dict[str, Any]:
    row = {"name": name, "unit": unit, "nominal": nominal, "estimate": estimate, "low": low, "high": high}
    return row | {"identifiable": True, "left_prior": left_prior}


def errors(unit: str, *stages: list[float]) -> dict[str, Any]:
    return {"unit": unit} | dict(zip(("nominal", "calibrated", "extended", "noise_floor"), stages, strict=True))


def example(effects: int = 1) -> dict[str, Any]:
    """A report as `loop` makes it."""
    names = ["coulomb:hinge", *(f"gain:motor_{i}" for i in range(effects))][:effects]
    ranking = [
        candidate("coulomb:hinge", 812.0, 240.0, 201.0),
        candidate("stribeck:hinge", 815.0, 239.0, 199.0),
        candidate("generic_velocity:hinge", 700.0, 200.0, 170.0, True),
        candidate("damping_poly:hinge", 300.0, 20.0, -4.0),
    ]
    first = {"accepted": ["coulomb:hinge"], "share": 0.8, "ranking": ranking, "equivalents": ["stribeck:hinge"]}
    last = {"accepted": [], "share": 0.0, "ranking": ranking[3:], "equivalents": [], "reason": "no more than chance"}
    angle = ([0.02, 0.05, 0.1, 0.21], [0.01, 0.02, 0.04, 0.081], [0.003, 0.0032, 0.0036, 0.0041])
    speed = ([0.2, 0.3, 0.4, 0.5], [0.15, 0.2, 0.25, 0.3], [0.1, 0.11, 0.12, 0.13])
    levels = {"nominal": 91.0, "calibrated": 14.2, "extended": 1.02, "null": 1.0, "null_95": 1.06}
    mimic = {"id": "payload:bob", "smallest_detectable": 0.0123, "unit": "kg"}
    return {
        "schema": 1,
        "model": "servo.xml",
        "fold": "",
        "logs": {"fit": ["run_1", "run_2"], "select": ["run_3"], "verify": ["run_4", "run_5"]},
        "independent_splits": True,
        "parameters": [
            parameter("bob_mass", "kg", 0.1, 0.10417, 0.1031, 0.1052),
            parameter("kp", "N m/rad", 10.0, 20.0, 19.9, 20.0, left_prior=True),
        ],
        "effects": [effect(n) for n in names],
        "verdict": "explained" if effects else "nothing missing",
        "unexplained": None,
        "error": {
            "horizons_s": [0.05, 0.1, 0.2, 0.4],
            "groups": {
                "joint angle": errors("rad", *angle, [0.003, 0.0031, 0.0033, 0.0037]),
                "joint speed": errors("rad/s", *speed, [0.1, 0.1, 0.1, 0.11]),
            },
        },
        "chi2": levels | {"extended_over_calibrated_95": (0.05, 0.09)},
        "identifiability": [
            mimic | {"worst_mimic": "inertia:bob", "distinguishable": False},
            {"id": "lag:motor", "smallest_detectable": None, "unit": "s", "worst_mimic": None, "distinguishable": True},
        ],
        "rounds": [first, last],
        "noise": [
            {"channel": "joint:hinge:pos", "noise": 0.002, "unit": "rad", "estimated": False},
            {"channel": "joint:hinge:vel", "noise": 0.1, "unit": "rad/s", "estimated": True},
        ],
        "seed": 7,
        "versions": {"nfc_gym": "0.1.0", "mujoco": "4.0.0"},
    }


def pictures() -> dict[str, Any]:
    """Pictures' data as `details` makes it."""
    t = np.linspace(0, 0.4, 81)
    wave = np.sin(9 * t)
    trace = {
        "title": "joint:hinge:pos, log run_4",
        "unit": "rad",
        "time": t.tolist(),
        "sample_time": t[::4].tolist(),
        "measured": (wave[::4] + 0.01).tolist(),
        "calibrated": (1.3 * wave).tolist(),
        "extended": wave.tolist(),
    }

    def misfit(scale: float) -> dict[str, Any]:
        seconds = [0.4 * i for i in range(20)]
        values = [scale * (1 + (i % 7)) for i in range(40)]
        return {
            "place": {"joint:hinge joint angle": 9 * scale, "joint:hinge joint speed": 4 * scale},
            "log": {"run_4": 8 * scale, "run_5": 5 * scale},
            "time": {"log": ["run_4"] * 20 + ["run_5"] * 20, "seconds": seconds * 2, "value": values},
        }

    line = {"title": "over the speed of hinge", "unit": "rad/s", "x": [-1.0, 0.0, 1.0]}
    grid = {"x": [0.0, 1.0, 2.0], "y": [-1.0, 0.0, 1.0]}
    values = {"calibrated": [9.0, None, 4.0], "extended": [1.0, None, 1.0]}
    cells = {s: [[v[0], None], [None, v[2]]] for s, v in values.items()}
    maps = {"degrees": {"hinge": 0.6, "slide": 0.02}, "lines": [line | values], "grid": grid | cells}
    return {"traces": [trace], "misfit": {"calibrated": misfit(2.0), "extended": misfit(0.2)}, "maps": maps}


def summary() -> dict[str, Any]:
    folds = {
        name: {k: r[k] for k in ("verdict", "chi2", "error")} | {"effects": [e["id"] for e in r["effects"]]}
        for name, r in (("a b/c", example()), ("javascript:alert(1)", example(0)), (EVIL, example()))
    }
    head = {k: example()[k] for k in ("schema", "model", "seed", "versions")}
    return head | {"folds": folds, "effects_found_in": {"coulomb:hinge": "2 of 3 folds"}, "seconds": 3.0}


class Reader(HTMLParser):
    """Tags that are open, what is loaded, ids, and the visible words; fails on a tag closed out of turn."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.ids: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        given = dict(attrs)
        self.ids += [given["id"]] if given.get("id") else []
        self.loads += [v or "" for k, v in attrs if k in LOADING]
        assert not any(k.startswith("on") for k in given), (tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def read(page: str) -> Reader:
    reader = Reader(page)
    assert reader.open == []
    return reader
