"""What benchmarks share of their command lines, and what they say of arguments that cannot be."""

import argparse
import importlib
import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from nfc_gym.core.errors import InputError


@pytest.mark.parametrize("text", ["0", "-3", "1.5", "many", "nan"])
def test_a_count_names_the_value_and_what_would_be_valid(text: str) -> None:
    from argparse import ArgumentTypeError

    from options import count

    with pytest.raises(ArgumentTypeError, match=rf"'{text}': want a whole number of at least 1"):
        count(1)(text)
    assert count(1)("1") == 1


@pytest.mark.parametrize("text", ["-0.1", "1.5", "nan", "half"])
def test_a_share_is_from_0_to_1(text: str) -> None:
    from argparse import ArgumentTypeError

    from options import number

    with pytest.raises(ArgumentTypeError, match=rf"'{text}': want a number from 0 to 1"):
        number(0, 1)(text)
    assert number(0, 1)("0.25") == 0.25
    assert number(0)("inf") == math.inf


def test_where_rows_go_is_asked_before_the_run(tmp_path: Path) -> None:
    from argparse import ArgumentTypeError

    from options import json_file, write_json

    file = json_file(str(tmp_path / "new" / "rows.json"))
    write_json(file, [{"value": math.nan, "seeds": (0,)}])
    assert json.loads(file.read_text()) == [{"value": None, "seeds": [0]}]
    with pytest.raises(ArgumentTypeError, match="is a folder: want a file"):
        json_file(str(tmp_path))
    with pytest.raises(ArgumentTypeError, match="its folder cannot be made"):
        json_file(str(file / "rows.json"))


def test_rows_of_another_run_are_read_or_refused(tmp_path: Path) -> None:
    from options import read_json, write_json

    file = tmp_path / "rows.json"
    with pytest.raises(InputError, match=r"rows.json: No such file or directory; want the file that a run's --json"):
        read_json(file, "worlds")
    for content in ("{", "[]", '{"rows": []}'):
        file.write_text(content)
        with pytest.raises(InputError, match="is not what a run's --json wrote: want JSON with worlds"):
            read_json(file, "worlds")
    write_json(file, {"worlds": [1]})
    assert read_json(file, "worlds") == {"worlds": [1]}


def test_figures_say_how_they_were_made(tmp_path: Path) -> None:
    import os
    import platform
    from datetime import UTC, datetime

    from options import made, write_json

    before = datetime.now(UTC).date()
    settings = {"out": tmp_path / "out", "sets": [tmp_path / "a", "b"], "stop": math.inf, "jobs": 2, "seed": None}
    file = tmp_path / "rows.json"
    write_json(file, made(argparse.Namespace(**settings)))
    told = json.loads(file.read_text())
    assert before <= datetime.fromisoformat(told["date"]).date() <= datetime.now(UTC).date()
    assert told["machine"]["processor"]
    assert told["machine"]["cores"] == os.cpu_count()
    assert told["versions"]["python"] == platform.python_version()
    assert set(told["versions"]) == {"python", "numpy", "mujoco", "nfc_gym"}
    assert told["settings"] == {"out": "out", "sets": ["a", "b"], "stop": None, "jobs": 2, "seed": None}
    assert str(tmp_path) not in file.read_text()


def test_a_queue_with_a_failure_ends_in_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    import posterior_queue

    def refused(*_: object) -> None:
        raise InputError("the disk is full")

    monkeypatch.setattr(posterior_queue, "stored", refused)
    monkeypatch.setattr(posterior_queue, "run", lambda *_: pytest.fail("there are no windows for it"))
    words = ["--windows", "JackalFlat=64", "--out", str(tmp_path), "--gpus", "cpu"]
    monkeypatch.setattr(sys, "argv", ["posterior_queue.py", *words])
    assert posterior_queue.main() == 1
    said = capsys.readouterr().out
    assert "JackalFlat: FAILED: the disk is full" in said
    assert said.splitlines()[-1].endswith("FAILED: JackalFlat; no table yet")


def test_a_queue_without_a_folder_prints_its_table_and_writes_its_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    import posterior_queue
    from posteriors.keep import Kept

    def filled(args: Any) -> int:
        (args.out / "table.md").write_text("the table")
        Kept(args.out, {}).keep("JackalFlat_ceiling", {"joint": [0.8, 0.1]})
        return 0

    monkeypatch.setattr(posterior_queue, "fill", filled)
    monkeypatch.setattr(sys, "argv", ["posterior_queue.py", "--quick", "--json", str(tmp_path / "results.json")])
    assert posterior_queue.main() == 0
    assert "the table" in capsys.readouterr().out
    assert json.loads((tmp_path / "results.json").read_text()) == {"JackalFlat_ceiling": {"joint": [0.8, 0.1]}}


def test_a_table_writes_its_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import posterior_table

    def ceiling(run: Any, robot: str, terrain: str) -> None:
        run.kept.once(f"{robot}{terrain}_ceiling", lambda: {"joint": [0.8, 0.1]})

    monkeypatch.setattr(posterior_table, "robot_on", ceiling)
    file = tmp_path / "results.json"
    words = ["--robots", "Jackal", "--terrain", "Flat", "--out", str(tmp_path), "--json", str(file)]
    monkeypatch.setattr(sys, "argv", ["posterior_table.py", *words])
    assert posterior_table.main() is None
    assert json.loads(file.read_text()) == {"JackalFlat_ceiling": {"joint": [0.8, 0.1]}}


@pytest.mark.parametrize("name", ["anomaly", "inference", "posterior_queue", "posterior_table", "structure"])
def test_every_option_has_a_help_text(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    script, told = importlib.import_module(name), {}

    def asked(parser: argparse.ArgumentParser, *_: object) -> None:
        told.update({action.option_strings[0]: action.help for action in parser._actions})
        parser.format_help()  # a default that its text does not take ends here
        raise KeyboardInterrupt

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", asked)
    with pytest.raises(KeyboardInterrupt):
        script.main()
    assert len(told) > 10
    assert [option for option, text in told.items() if not text] == []


@pytest.mark.parametrize("windows", ["JackalFlat", "JackalFlat=-3", "JackalFlat=many", "Moon=3"])
def test_a_queue_of_no_windows_is_refused(windows: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import posterior_queue

    monkeypatch.setattr(sys, "argv", ["q", "--windows", windows, "--out", str(tmp_path / "out")])
    with pytest.raises(InputError, match=windows.partition("=")[0]):
        posterior_queue.main()
    assert not (tmp_path / "out").exists()


def test_a_policy_that_is_none_is_named_with_what_there_is() -> None:
    from worlds.players import player
    from worlds.world import World

    with pytest.raises(InputError, match="policy 'nonsense' is neither falco nor random, nor a file or an id"):
        player("nonsense", World("JackalFlat", "axle", 0), 0)


def test_bad_input_ends_in_a_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from options import ended

    def refusing() -> None:
        raise InputError("place 'Moon': want a robot and its ground")

    def stopped() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["benchmarks/some.py"])
    assert ended(refusing) == 2
    assert capsys.readouterr().err == "some: place 'Moon': want a robot and its ground\n"
    assert ended(stopped) == 130
    assert ended(lambda: None) == 0
    assert ended(lambda: 1) == 1


def test_a_folder_keeps_its_seed_where_another_is_refused(tmp_path: Path) -> None:
    """An overwritten seed would make the folder refuse the very command that it was begun with."""
    from posteriors.keep import begun

    assert begun(tmp_path / "out", 7) == 7
    with pytest.raises(InputError, match="was begun with seed 7, not 8: leave --seed out"):
        begun(tmp_path / "out", 8)
    assert begun(tmp_path / "out", None) == 7
    assert begun(tmp_path / "else", None) == begun(tmp_path / "else", None)


@pytest.mark.parametrize(
    ("name", "words", "said"),
    [
        ("hidden_worlds", ["--places", "JackalFlat", "Moon"], "place 'Moon': want a robot and its ground"),
        ("hidden_worlds", ["--scenarios", "axle", "fog"], "fog"),
    ],
)
def test_a_wrong_name_ends_a_run_before_its_first_world(
    name: str, words: list[str], said: str, tmp_path: Path
) -> None:  # fmt: skip
    with pytest.raises(InputError, match=said):
        importlib.import_module(name).parse([*words, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_worlds_that_a_run_without_find_kept_are_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    import hidden_worlds
    from posteriors.keep import Kept
    from worlds.counting import Drop
    from worlds.figures import Interval
    from worlds.judge import Episodes

    seeds = []

    def measure(policy: str, world: object, episodes: int, seed: int, **_: object) -> Drop:
        seeds.append(seed)
        some = Interval(1.0, 0.0, 2.0)
        return Drop(world, some, some, some, 0.5, Episodes([1.0], [1.0], [0.0], [1.0], [0.0], [0.0], [1]))

    monkeypatch.setattr(hidden_worlds, "measure", measure)
    kept = Kept(tmp_path, {})
    plain = hidden_worlds.parse(["--seed", "3"])
    finding = hidden_worlds.parse(["--seed", "3", "--find", "1"])
    again = []
    for args in (plain, finding, finding):
        again += [row.get("again") for row in hidden_worlds.worlds(args, kept, "AntFlat", "psi+effect")]
    assert again == [None, 0.5, 0.5]
    assert seeds == [3, 3, 1_000_003]


def test_a_structure_run_is_of_one_seed_and_one_course(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import structure
    import timing

    monkeypatch.setattr(structure, "taught", lambda *_: tmp_path / "head")
    monkeypatch.setattr(structure, "judged", lambda *_: {})
    monkeypatch.setattr(structure, "told_rows", lambda *_: [structure.row("r", "area", 1, "1", 0.5, 0.95)])
    words = ["--trials", "0", "--windows", "512", "--out", str(tmp_path / "out")]
    assert structure.main([*words, "--seed", "5", "--json", str(tmp_path / "rows.json")]) == 0
    told = json.loads((tmp_path / "rows.json").read_text())
    (row,) = told["rows"]
    assert (told["seed"], told["settings"]["windows"]) == (5, 512)
    assert row["name"] == "r: area"
    table = timing.Table()
    table.add("r: area", 1.0, "1", baseline=0.5, at_least=0.95, seeds=(5,))
    assert {k: type(v) for k, v in row.items()} == {
        k: type(v) for k, v in json.loads(json.dumps(asdict(table.rows[0]))).items()
    }  # the rows of every script are alike
    assert row["goal"] == table.rows[0].goal
    assert row["seeds"] == [5]
    with pytest.raises(InputError, match="was begun with seed 5, not 6"):
        structure.main([*words, "--seed", "6"])
    words[3] = "1024"
    with pytest.raises(InputError, match="holds results of windows 512, not 1024"):
        structure.main(words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--only", "nonesuch"], "no kind of damage holds that; they begin with .*mapping"),
        (["--case", "4"], "give that run's --seed"),
    ],
)
def test_malformed_refuses_what_would_damage_nothing(
    words: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    import re

    import malformed

    monkeypatch.setattr(sys, "argv", ["malformed.py", *words])
    with pytest.raises(SystemExit):
        malformed.main()
    assert re.search(said, capsys.readouterr().err.replace("\n", " "))
