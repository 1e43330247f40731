"""The mapping file: mistakes are named with their line; what is right arrives in SI, scalar first, split as asked."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nfc_gym.core import InputError, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.dataset import load
from nfc_gym.measured.entries import SplitRule
from nfc_gym.measured.mapping import load_mapping
from nfc_gym.measured.splits import Source, divide

Build = Any


def complaint(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load(path)
    return str(caught.value)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (("model: machine.xml", "modle: machine.xml"),
         [":3: modle: unknown key; did you mean 'model'?", "model: is missing"]),
        (("column: goal", "colum: goal"), [":10: controls.ctrl:servo.colum: unknown key; did you mean 'column'?"]),
        (("unit: rad/s, noise: 0.01}\n  \"body", "unit: rad/z, noise: 0.01}\n  \"body"),
         [":13: channels.joint:hinge:vel.unit",
         "did you mean 'rad/s'?", "(got 'rad/z')"]),
        (("joint:hinge:pos", "joint:hinge:position"),
         [":12: channels.joint:hinge:position", "valid: joint:<name>:pos|vel|acc"]),
        (("joint:hinge:pos", "ctrl:hinge"), ["it belongs under `controls`"]),
        (("ctrl:servo", "servo"), [":10: controls.servo: names here begin with 'ctrl:'"]),
        (("{columns: [qw, qx, qy, qz], order: wxyz,", "{columns: [qw, qx, qy, qz],"), ["`order` must be said"]),
        (("order: wxyz", "order: zyxw"), ["'wxyz' or 'xyzw'", "(got 'zyxw')"]),
        (("column: q, unit: rad", "column: q, unit: V"), ["unit 'V' cannot be right; want rad or m"]),
        (("column: q, unit: rad,", "column: q,"), ["`unit` is missing"]),
        (("noise: 0.001", "noise: -1"), ["noise", "greater than 0", "(got -1)"]),
        (("low: 0.05, high: 0.2", "low: 0.3, high: 0.2"), [":5: parameters.0: low 0.3 must be below high 0.2"]),
        (("unit: kg, low: 0.05", "unit: deg, low: 0.05"), ["give the values in rad"]),
        (("version: 1", "version: 2"), [":2: version", "1", "(got 2)"]),
        (("{length: 0.4}", "{length: 0.4, horizons: [0.2, 0.1]}"), ["horizons must increase"]),
        (("{length: 0.4}", "{length: 0.4, horizons: [0.2, 0.9]}"),
         ["longest horizon 0.9 s is longer than the segment"]),
        (("{length: 0.4}", "{length: 0.4, mode: backward}"), ["'rollout', 'inverse' or 'forward'", "(got 'backward')"]),
        (("{length: 0.4}", "{length: 0.4}\neffects: {only: [slipp]}"), ["no family 'slipp'; did you mean 'slip'?"]),
        (("time: {column: t}", "time: {column: t, unit: V}"), ["time is in s, ms, us or ns"]),
        (("time: {column: t}", "time: {column: t, columns: [t]}"), ["has both `column` and `columns`"]),
        (("time: {column: t}", "time: {column: t, interval: 0.01}"), [":8: time: has both `column` and `interval`"]),
        (("time: {column: t}", "time: {interval: 0}"), [":8: time.interval", "greater than 0", "(got 0)"]),
        (("time: {column: t}", "time: {interval: -0.01}"), [":8: time.interval", "greater than 0", "(got -0.01)"]),
        (("time: {column: t}", "time: {interval: .nan}"), [":8: time.interval", "finite number"]),
        (("time: {column: t}", "time: {interval: 10, unit: ms}"), ["`interval` is in s; leave out `unit`"]),
        (("time: {column: t}", "time: {}"), [":8: time: time is one column", "or `interval`, the seconds from row"]),
        (("time: {column: t}", "time: {intervall: 1}"), ["unknown key; did you mean 'interval'?"]),
        (("column: v, unit: rad/s,", "column: v, unit: rad/s, shift: .inf,"), ["vel.shift", "finite number"]),
        (("time: {column: t}", "time: {column: t}\nsplit: {fit: 0.9}"), ["must be 1, got 1.3"]),
        (("time: {column: t}", "time: {column: t}\ntime: {column: t}"), [":9: 'time' appears twice, first on line 8"]),
        (("time: {column: t}", "time: {column: t"), ["not valid YAML"]),
        (('{path: "*.npz"}', '{path: "*.npz", group: "run_\\\\d"}'), ["needs one (group)"]),
        (('{path: "*.npz"}', '{path: "*.npz", group: "(walk)"}'), ["'(walk)' does not match the file name 'run_0'"]),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_their_line(build: Build, edit: tuple[str, str], words: list[str]) -> None:
    text = complaint(build(None, edit))
    for word in words:
        assert word in text


def test_all_mistakes_are_reported_from_the_top(build: Build) -> None:
    path = build(None, ("column: goal", "colum: goal"), ("noise: 0.001", "noise: x"), ("high: 0.2", "high: .nan"))
    lines = [int(line.removeprefix(f"{path}:").split(":")[0]) for line in complaint(path).splitlines()]
    assert lines == sorted(lines)
    assert {5, 10, 12} <= set(lines)


@pytest.mark.parametrize("text", ["", "[1, 2]", "just words", "a: !!python/object/apply:os.system ['true']", "\x00"])
def test_what_is_no_mapping(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(InputError, match=r"m\.yaml"):
        load_mapping(tmp_path / "m.yaml")
    with pytest.raises(InputError, match="no such file"):
        load_mapping(tmp_path / "absent.yaml")


def test_aliases_that_multiply_are_refused(tmp_path: Path) -> None:
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    rows += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    (tmp_path / "m.yaml").write_text("\n".join(rows))
    with pytest.raises(InputError, match="more than 100000 entries"):
        load_mapping(tmp_path / "m.yaml")


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("joint:a:b:vel", ("joint", "a:b", "vel", False)),
        ("body:base:linvel@body", ("body", "base", "linvel", True)),
        ("sensor:imu:pos", ("sensor", "imu:pos", "", False)),
        ("force:motor", ("force", "motor", "", False)),
    ],
)
def test_channel_names(name: str, parts: tuple[str, str, str, bool]) -> None:
    parsed = parse_channel(name)
    assert (parsed.kind, parsed.object, parsed.quantity, parsed.own_frame) == parts


def test_untied_parameters_are_one_an_object(build: Build) -> None:
    entry = "{name: mass, field: body_mass, of: [bob], unit: kg"
    untied = load_mapping(build(None, (entry, entry.replace("[bob]", "[bob, base]"))))
    assert [(p.name, p.of) for p in untied.declared] == [("mass:bob", ("bob",)), ("mass:base", ("base",))]
    tied = load_mapping(build(None, (entry, entry.replace("[bob]", "[bob, base], tied: true"))))
    assert [(p.name, p.of) for p in tied.declared] == [("mass", ("bob", "base"))]


def test_values_arrive_in_si_from_time_zero(build: Build) -> None:
    degrees = lambda t: t.update(q=np.degrees(t["q"]), t=1e3 * t["t"] + 5e6)  # noqa: E731
    plain = load(build())
    data = load(build(degrees, ("column: q, unit: rad, noise: 0.001", "column: q, unit: deg, noise: 0.18"),
                      ("time: {column: t}", "time: {column: t, unit: ms}")))  # fmt: skip
    for ours, theirs in zip(plain.logs, data.logs, strict=True):
        np.testing.assert_allclose(theirs.time, ours.time, atol=1e-9)
        channel = theirs.channels["joint:hinge:pos"]
        np.testing.assert_allclose(channel.values, ours.channels["joint:hinge:pos"].values, atol=1e-12)
        assert channel.unit == "rad"
        assert channel.noise == pytest.approx(np.radians(0.18))


def test_quaternions_arrive_scalar_first_and_without_sign_jumps(build: Build) -> None:
    def flip(table: dict[str, np.ndarray]) -> None:
        sign = np.where(np.arange(len(table["t"])) % 7 < 3, -1.0, 1.0)
        for key in ("qw", "qx", "qy", "qz"):
            table[key] = table[key] * sign * 1.001

    plain = load(build()).logs[0].channels["body:base:quat"].values
    reordered = ("[qw, qx, qy, qz], order: wxyz", "[qx, qy, qz, qw], order: xyzw")
    quat = load(build(flip, reordered)).logs[0].channels["body:base:quat"].values
    assert ((quat[1:] * quat[:-1]).sum(1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(np.abs((quat * plain).sum(1)), 1, atol=1e-12)


def test_masked_rows_may_be_empty_and_slow_sensors_too(build: Build) -> None:
    def spoil(table: dict[str, np.ndarray]) -> None:
        table["flying"] = np.arange(len(table["t"])) >= 100
        table["q"] = np.where(table["flying"], table["q"], np.nan)
        table["v"] = np.where(np.arange(len(table["t"])) % 10 == 0, table["v"], np.nan)

    path = build(spoil, ("column: q, unit: rad", "column: q, mask: flying, unit: rad"),
                 ("column: v, unit: rad/s", "column: v, rate: 10, unit: rad/s"))  # fmt: skip
    log = load(path).logs[0]
    q, v = log.channels["joint:hinge:pos"], log.channels["joint:hinge:vel"]
    assert q.mask is not None
    assert np.flatnonzero(~q.mask).tolist() == list(range(100))
    assert v.mask is not None
    assert np.flatnonzero(v.mask).tolist() == list(range(0, 400, 10))
    assert np.isfinite(q.values).all()
    assert (v.values[10:20] == v.values[10]).all()
    assert v.rate == 10


def test_servo_terms_and_known_fields(build: Build) -> None:
    def add(table: dict[str, np.ndarray]) -> None:
        table.update(kp=np.array(800.0), volts=7.0 + table["t"], length=np.array(0.12), mass=np.array(250.0))

    gain, supply = "{columns: [kp], scale: 0.01}", "{columns: [volts]}"
    servo = f"servo: {{joint: hinge, gain: {gain}, limit: 1.0, supply: {supply}, damping: 0.5}}"
    known = """known:
  - {field: "body_pos[2]", of: [bob], columns: [length], scale: -1.0, offset: 0.02, unit: m}
  - {field: body_mass, of: [bob], columns: [mass, volts], scale: 0.001, unit: kg}
channels:"""
    path = build(add, ("unit: rad}", "unit: rad, " + servo + "}"), ("channels:", known))
    data = load(path)
    log = data.logs[0]
    volts = 7.0 + log.time
    terms = log.servo["ctrl:servo"]
    assert set(terms) == {"gain", "supply", "damping"}
    np.testing.assert_allclose(terms["gain"], 8.0)
    np.testing.assert_allclose(terms["supply"], volts)
    np.testing.assert_allclose(terms["damping"], 0.5)
    np.testing.assert_allclose(log.known["body_pos[2]:bob"], -0.1)
    np.testing.assert_allclose(log.known["body_mass:bob"], 0.25 * volts)
    law = data.mapping.controls["ctrl:servo"].servo
    assert law is not None
    assert (law.joint, law.limit) == ("hinge", 1.0)


def test_numbers_are_not_columns(build: Build) -> None:
    assert "'0.5' is a number, not a column" in complaint(build(None, ("column: goal", 'column: "0.5"')))


# ---- splits


def logs(groups: list[str], rows: int = 40, days: str = "") -> tuple[list[Source], list[Log]]:
    names = [f"log{k:02d}" for k in range(len(groups))]
    sources = [Source(n, Path(n), "auto", g) for n, g in zip(names, groups, strict=True)]
    time, days = np.arange(float(rows)), days or " " * len(groups)
    return sources, [
        Log(n, time, {}, {}, group=g, condition=d.strip()) for n, g, d in zip(names, groups, days, strict=True)
    ]


@given(st.integers(3, 40), st.integers(0, 5))
def test_logs_are_dealt_out_by_the_fractions(count: int, seed: int) -> None:
    division = divide(SplitRule(seed=seed), *logs([""] * count))
    sizes = Counter(division.folds[0].splits.values())
    assert division.independent
    assert sum(sizes.values()) == count
    assert sizes["fit"] >= 1
    for split in ("select", "verify"):
        assert sizes[split] >= 1
        assert abs(sizes[split] - 0.2 * count) <= 1
    assert division.folds == divide(SplitRule(seed=seed), *logs([""] * count)).folds


@given(st.lists(st.sampled_from("abcdef"), min_size=8, max_size=30).filter(lambda g: len(set(g)) >= 3))
def test_groups_are_never_torn(groups: list[str]) -> None:
    sources, members = logs(groups)
    splits = divide(SplitRule(by="group"), sources, members).folds[0].splits
    for group in set(groups):
        assert len({splits[log.name] for log in members if log.group == group}) == 1
    assert set(splits.values()) == {"fit", "select", "verify"}


@given(st.lists(st.sampled_from("abcd"), min_size=6, max_size=20).filter(lambda g: len(set(g)) >= 3))
def test_rotation_verifies_every_log_once(groups: list[str]) -> None:
    sources, members = logs(groups)
    division = divide(SplitRule(by="rotate"), sources, members)
    verified = [name for fold in division.folds for name in fold.names("verify")]
    assert sorted(verified) == [log.name for log in members]
    for fold in division.folds:
        rest = len(members) - len(fold.names("verify"))
        assert len(fold.names("select")) == max(round(rest / 5), 1)
        assert len(fold.names("fit")) == rest - len(fold.names("select")) >= 1


@given(st.lists(st.sampled_from("abc"), min_size=3, max_size=30), st.integers(0, 20))
def test_every_day_is_fitted_to(days: list[str], seed: int) -> None:
    """And each split has its share of every day, to one log; how many logs a split has the days do not change."""
    sources, members = logs([""] * len(days), days="".join(days))
    splits = divide(SplitRule(seed=seed), sources, members).folds[0].splits
    plain = divide(SplitRule(seed=seed), *logs([""] * len(days))).folds[0].splits
    assert Counter(splits.values()) == Counter(plain.values())
    count = Counter((log.condition, splits[log.name]) for log in members)
    own, total = Counter(days), Counter(splits.values())
    spare = all(n > 1 for n in own.values()) and sum(n - 1 for n in own.values()) >= total["select"] + total["verify"]
    if spare:
        assert all(count[day, "fit"] for day in own)
    if min(own.values()) >= 5:
        for (day, split), n in count.items():
            assert abs(n - total[split] * own[day] / len(days)) <= 1 + (split == "fit")


def test_a_day_of_three_logs_is_in_every_split() -> None:
    sources, members = logs([""] * 9, days="aaabbbccc")
    splits = divide(SplitRule(fit=1 / 3, select=1 / 3, verify=1 / 3), sources, members).folds[0].splits
    of_day = {day: {splits[log.name] for log in members if log.condition == day} for day in "abc"}
    assert all(own == {"fit", "select", "verify"} for own in of_day.values())


def test_rotation_leaves_each_day_a_log_to_fit() -> None:
    sources, members = logs(list("abcdefg"), days="xxyyzzz")
    for seed in range(10):
        for fold in divide(SplitRule(by="rotate", seed=seed), sources, members).folds:
            fitted = {log.condition for log in members if fold.splits[log.name] == "fit"}
            assert fitted == {"x", "y", "z"}


def test_cut_by_time_keeps_the_order_and_every_row() -> None:
    sources, members = logs([""], rows=100)
    division = divide(SplitRule(by="time", fit=0.45, select=0.15, verify=0.4), sources, members)
    assert [log.name for log in division.logs] == ["log00@fit", "log00@select", "log00@verify"]
    assert [len(log) for log in division.logs] == [45, 15, 40]
    assert all(log.time[0] == 0 for log in division.logs)
    assert not division.independent


def test_without_a_selecting_log_the_last_quarter_selects(build: Build, tmp_path: Path) -> None:
    path = build(None, ('"*.npz"}', '"*.npz", splits: splits.json}'))
    (tmp_path / "splits.json").write_text(json.dumps({"run_0": "fit", "run_1": "fit", "run_2": "verify"}))
    data = load(path)
    assert data.splits == {
        "run_0@fit": "fit", "run_0@select": "select", "run_1@fit": "fit", "run_1@select": "select", "run_2": "verify",
    }  # fmt: skip
    assert [len(log) for log in data.of("select")] == [100, 100]
    assert not data.independent_splits


def test_every_log_has_its_time_as_a_signal(build: Build) -> None:
    """Seconds of the whole file, also in the parts that a split by time makes of it; a column of that name wins."""
    path = build(None, ('"*.npz"}', '"*.npz"}\nsplit: {by: time}'))
    parts = [log for log in load(path).logs if log.name.startswith("run_0")]
    assert len(parts) == 3
    np.testing.assert_allclose(np.concatenate([p.exogenous["exo:time"] for p in parts]), np.arange(400) / 100)
    path = build(None, ("segments:", 'exogenous: {"exo:time": {column: q, unit: s}}\nsegments:'))
    log = load(path).logs[0]
    np.testing.assert_array_equal(log.exogenous["exo:time"], log.channels["joint:hinge:pos"].values)


def test_splits_file_names_groups_and_is_checked(build: Build, tmp_path: Path) -> None:
    path = build(None, ('"*.npz"}', '"*.npz", splits: splits.json}\nsplit: {by: rotate}'), logs=4)
    (tmp_path / "splits.json").write_text(json.dumps({f"run_{k}": "walk" if k < 2 else "turn" for k in range(4)}))
    data = load(path)
    assert [(fold.name, fold.names("verify")) for fold in data.folds] == [
        ("turn", ("run_2", "run_3")),
        ("walk", ("run_0", "run_1")),
    ]
    assert {log.group for log in data.of("fit", data.fold("walk"))} == {"turn"}
    with pytest.raises(InputError, match="no fold 'run'; there are: 'turn', 'walk'"):
        data.fold("run")
    (tmp_path / "splits.json").write_text(json.dumps({"run_0": "fit"}))
    assert "says nothing of 'run_1'" in complaint(path)
    (tmp_path / "splits.json").write_text(json.dumps({f"run_{k}": "fit" for k in range(5)}))
    assert "names 'run_4', which is no log" in complaint(path)
    (tmp_path / "splits.json").write_text("{")
    assert "is not JSON" in complaint(path)


@pytest.mark.parametrize(
    ("rule", "count", "words"),
    [
        (SplitRule(), 2, "2 logs cannot be split 3 ways.*by: time"),
        (SplitRule(by="rotate"), 2, "too few to rotate.*by: time"),
        (SplitRule(by="group"), 4, "needs a `group` pattern"),
        (SplitRule(fit=0.8, select=0.2, verify=0.0), 4, "no log verifies; give some log"),
    ],
)
def test_too_few_logs_say_what_to_do(rule: SplitRule, count: int, words: str) -> None:
    with pytest.raises(InputError, match=words):
        divide(rule, *logs([""] * count))


def test_a_log_too_short_to_cut() -> None:
    with pytest.raises(InputError, match="has 3 rows, too few to cut by time"):
        divide(SplitRule(by="time"), *logs([""], rows=3))
