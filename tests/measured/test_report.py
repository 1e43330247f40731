"""The page: everything is on it, nothing is loaded, nothing is injected, and odd values are shown as a dash."""

import copy
import math
import re
from importlib import resources
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from reports import EVIL, effect, errors, example, pictures, read, summary

from nfc_gym.measured import story, wording
from nfc_gym.measured.report import render, render_summary
from nfc_gym.measured.verdict import effect_rows
from nfc_gym.physics.effects import FAMILIES
from nfc_gym.physics.effects.command import SupplySag
from nfc_gym.physics.effects.places import sized

SECTIONS = ("effects", "errors", "traces", "misfit", "candidates", "parameters", "identifiability", "noise", "glossary")


def spoil(value: Any, bad: Any) -> Any:
    """Every number replaced."""
    if isinstance(value, dict):
        return {k: spoil(v, bad) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [spoil(v, bad) for v in value]
    return bad if isinstance(value, float) else value


def poison(value: Any) -> Any:
    """Every string and every key of names gets a script."""
    if isinstance(value, dict):
        return {k: poison(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [poison(v) for v in value]
    return value + EVIL if isinstance(value, str) else value


def test_every_section_is_there_once_and_tags_are_balanced() -> None:
    page = read(render(example(), pictures()))
    assert [i for i in page.ids if i in SECTIONS] == list(SECTIONS)
    assert "reproduction" in page.ids
    assert len(page.ids) == len(set(page.ids))


def test_the_verdict_comes_first_with_errors_units_and_logs() -> None:
    text = read(render(example(), pictures())).text
    lead = text[: text.index("Before you rely on it")]
    assert "Missing from the model: dry friction at hinge." in lead
    # the group with the largest error over its floor, at the longest horizon
    assert "joint angle 0.4 s ahead, on 2 unseen logs: 0.210 rad with the model as given, 0.0810 rad once" in lead
    assert "0.00410 rad with the missing effect added" in lead
    assert "0.00370 rad" in lead
    assert "that is 5.0 to 9.0 % of what calibration alone leaves" in lead


@pytest.mark.parametrize("word", list(story.VERDICTS))
def test_each_verdict_has_its_own_words_sign_and_colour(word: str) -> None:
    report = example(0 if word in ("nothing missing", "unexplained") else 1) | {"verdict": word}
    if "expl" in word and word != "explained":
        left = {"coordinate": "joint:arm:pos", "where": "joint:arm", "description": "a bump"}
        report["unexplained"] = left | {"nearest": "gain:motor", "nearest_share": 0.12}
    page = render(report, pictures())
    own = story.VERDICTS[word]
    others = [v for v in story.VERDICTS.values() if v is not own]
    assert own.meaning in page
    assert f'<header class="{own.cls}">' in page
    assert not any(v.meaning in page or v.cls == own.cls or v.sign == own.sign for v in others)
    assert ("joint:arm:pos" in page) == (report["unexplained"] is not None)
    assert ("12\N{NO-BREAK SPACE}%" in page) == (report["unexplained"] is not None)


def test_a_proposed_law_is_shown_apart_from_what_is_claimed() -> None:
    report = example(0) | {"verdict": "unexplained"}
    size = {"cosine": {"value": 0.3, "low": 0.28, "high": 0.32, "unit": "N m"}}
    law = {
        "id": "law_harmonic:hinge",
        "sentence": "A torque on hinge that repeats 6 times a turn: 0.31 N m.",
        "share_of_excess": 0.9,
        "parameters": size,
    }
    near = "looks like f(q_hinge); the nearest named effect, gain:motor, explains 12%"
    report["unexplained"] = {"coordinate": "joint:hinge:pos", "description": near, "nearest": "gain:motor"}
    text = read(render(report | {"proposals": [law]}, pictures())).text
    assert "It looks like a torque on hinge that repeats 6 times a turn." in text
    assert "with the proposed law added" in text
    assert "No effect is claimed." in text
    assert "law_harmonic:hinge" in text
    assert text.count("gain:motor") == 1  # said once, in the description
    without = read(render(report, pictures())).text
    assert "proposed law" not in without


def test_what_comes_nearest_is_no_claim() -> None:
    report = example(1) | {"verdict": "unexplained"}
    report["unexplained"] = {"coordinate": "joint:hinge:pos", "description": "", "nearest_share": 0.06}
    near = report["effects"][0] | {"nearest": True}
    text = read(render(report | {"effects": [], "proposals": [near]}, pictures())).text.replace("\xa0", " ")
    assert "which takes away 6 % of that and is not believed to be the cause." in text
    assert "with the nearest effect added" in text
    assert "No effect is claimed." in text
    assert "too little of what is missing to be believed the cause" in text
    assert "a proposed law" not in text
    text = read(render(report | {"effects": [], "proposals": [near | {"may_be_none": True}]}, pictures())).text
    assert "by its intervals it may have no size at all" in text
    assert "too little of what is missing to be believed the cause" not in text


def test_what_may_make_no_difference_is_told_as_that() -> None:
    sentence = "Actuator force scaled at m1: gain 1.05."
    spare = {"id": "gain:m1", "family": "gain", "where": "m1", "sentence": sentence, "nearest": True, "alike": []}
    report = {"verdict": "nothing missing", "effects": [], "proposals": [spare], "findings": []}
    assert any(n.endswith(f"it may make no difference: {sentence}") for n in story.notices(report))
    assert not any(sentence in n for n in story.notices(report | {"proposals": []}))


def test_maps_of_the_misfit() -> None:
    page = render(example(), pictures())
    text = read(page).text
    assert "over the speed of hinge" in text
    assert wording.percent(0.6) in page
    assert page.count("3.00 × noise") == 1  # the cell of a mean square of 9; bare cells are not drawn
    assert "By degree of freedom" not in read(render(example(), {**pictures(), "maps": {}})).text


def test_nothing_is_loaded_from_anywhere() -> None:
    for page in (render(example(), pictures()), render_summary(summary())):
        assert not re.search(r"https?:|//[a-z]|@import|url\(", page)
        assert all(re.fullmatch(r"\./[^:]+", link) for link in read(page).loads)
        assert "default-src 'none'" in page


def test_names_from_logs_and_models_cannot_become_markup() -> None:
    report, shown = poison(example(2)), poison(pictures())
    report["verdict"] = "partly explained"
    report["error"]["groups"] = {k + EVIL: v for k, v in report["error"]["groups"].items()}
    report["effects"][0]["parameters"] = {EVIL: report["effects"][0]["parameters"]["level"]}
    report["versions"] = {EVIL: EVIL}
    for m in shown["misfit"].values():
        m["place"] = {EVIL + k: v for k, v in m["place"].items()}
        m["log"] = {EVIL + k: v for k, v in m["log"].items()}
    clean = read(render(example(2) | {"verdict": "partly explained"}, pictures()))
    page = render(report, shown)
    assert read(page).tags.count("script") == 1 == clean.tags.count("script")
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert") > 40


@pytest.mark.parametrize("bad", [None, math.nan, math.inf, -math.inf], ids=["none", "nan", "inf", "-inf"])
def test_numbers_that_are_missing_become_a_dash(bad: float | None) -> None:
    page = read(render(spoil(example(), bad), spoil(pictures(), bad)))
    assert wording.DASH in page.text
    assert not re.search(r"\b(nan|inf|None|undefined)\b", page.text)
    svg = re.findall(r'(?: d|cx|cy|x|y|width)="([^"]*)"', render(spoil(example(), bad), spoil(pictures(), bad)))
    assert not any("nan" in v or "inf" in v for v in svg)


def test_one_missing_value_spoils_only_its_own_cell() -> None:
    report = example()
    report["error"]["groups"]["joint angle"]["extended"][2] = None
    report["parameters"][0]["low"] = math.nan
    text = read(render(report, pictures())).text
    assert "0.00410 rad" in text
    assert "20.000" in text


def test_a_number_that_only_sets_a_unit_has_no_interval() -> None:
    """The voltage at which a sagging supply changes nothing is given; free, it would be a gain by another name."""
    volts = 23.3
    narrow = {"low": 0.999 * volts, "high": 1.001 * volts, "probes": (volts,)}
    sag = FAMILIES["supply_sag"](("winch",), sized(SupplySag.PARAMS, reference=narrow))
    x = np.array([0.99, 1.001 * volts])
    plant = SimpleNamespace(space=[], effects=[sag], split=lambda x: (x[:0], [x]))
    (row,) = effect_rows(SimpleNamespace(plant=plant, x=x), [], x + np.outer([-1, 1], [0.01, 2.0]), {})  # type: ignore[arg-type]
    numbers = row["parameters"]
    assert numbers["reference"]["given"]
    assert "given" not in numbers["exponent"]
    page = read(render(example() | {"effects": [row]}, pictures()))
    assert "given" in page.text
    assert "23.277 to 23.323" not in page.text


def test_an_empty_report_still_makes_a_page() -> None:
    page = read(render({"verdict": "unexplained"}, {}))
    assert set(SECTIONS) <= set(page.ids)
    assert "No effect is claimed" in page.text


def test_the_same_report_gives_the_same_page() -> None:
    report, shown = example(3), pictures()
    before = copy.deepcopy((report, shown))
    assert render(report, shown) == render(copy.deepcopy(report), copy.deepcopy(shown))
    assert (report, shown) == before
    assert render(report | {"seconds": 1.0}, shown) == render(report | {"seconds": 2.0}, shown)


def test_without_effects_no_third_model_is_drawn() -> None:
    page = render(example(0), pictures())
    body = page[page.index("<body>") :]
    assert "line extended" not in body
    assert "line extended" in render(example(1), pictures())


def test_a_single_instant_is_drawn_as_bars() -> None:
    report = example()
    report["error"] = {"horizons_s": [0.0], "groups": {"force": errors("N", [9.0], [4.5], [1.5], [1.2])}}
    page = render(report, pictures())
    figure = page[page.index('aria-label="force: error before and after"') :]
    widths = re.findall(r'<rect class="(?:nominal|calibrated|extended)"[^>]*width="([\d.]+)"', figure)[:3]
    np.testing.assert_allclose(np.array(widths, float) / float(widths[0]), [1, 0.5, 1 / 6], atol=1e-3)
    assert "force at each instant" in read(page).text


def test_large_reports_fold_away_and_stay_small() -> None:
    report, shown = example(15), pictures()
    row = report["parameters"][0]
    report["parameters"] = [row | {"name": f"p{i}", "left_prior": i < 3} for i in range(300)]
    report["error"]["groups"] = {f"group {i}": report["error"]["groups"]["joint angle"] for i in range(40)}
    report["identifiability"] = [report["identifiability"][0] | {"id": f"gain:m{i}"} for i in range(200)]
    shown["traces"] *= 6
    page = render(report, shown)
    text = read(page).text
    assert "300 parameters; 3 at a bound, 0 not identifiable" in text
    assert all(name in text for name in ("p299", "group 39", "gain:m199"))
    assert text.count("of the excess error") == 15
    assert len(page) < 1_000_000
    assert page.count("<details") >= 4


def test_candidates_say_why_they_were_left() -> None:
    text = read(render(example(), pictures())).text
    rows = text[text.index("Round 1") : text.index("Round 2")]
    verdicts = ["accepted", "cannot be told", "less than the accepted one", "lower bound not above zero"]
    at = [rows.index(w, rows.index("outcome")) for w in verdicts]
    assert at == sorted(at)
    assert "No more than chance." in text


def test_what_gains_more_by_more_parameters_is_not_said_to_gain_less() -> None:
    report = example()
    rows = report["rounds"][0]["ranking"]
    rows.insert(0, rows[0] | {"id": "load_friction:hinge", "gain_fit": 820.0, "gain_select": 241.0})
    page = read(render(report, pictures())).text
    part = page[page.index("Round 1") : page.index("Round 2")]
    assert "201 gains no more than a plainer one would by chance: the accepted one is preferred" in part
    assert "gains less than the accepted one" in part, "of those that do gain less"
    report["rounds"][0]["possible"] = ["load_friction:hinge"]
    page = read(render(report, pictures())).text
    part = page[page.index("Round 1") : page.index("Round 2")]
    assert "201 does as well with more numbers, as too many do: the accepted one is the simplest" in part


def test_values_of_each_place_keep_the_place_as_the_model_names_it() -> None:
    report = example()
    level = report["effects"][0]["parameters"]["level"]
    report["effects"][0]["parameters"] = {"forward_viscous@rear_left": level}
    assert "forward viscous at rear_left 0.0421 N m 0.0402 to 0.0441" in read(render(report, pictures())).text


def test_two_plainer_laws_may_stand_for_the_best_candidate() -> None:
    report = example()
    report["rounds"][0] |= {"accepted": ["coulomb:hinge", "lag:motor"], "equivalents": ["stribeck:hinge"]}
    text = read(render(report, pictures())).text
    rows = text[text.index("Round 1") : text.index("Round 2")]
    assert "accepted coulomb:hinge , lag:motor" in rows
    assert "plainer than the best-ranked" in rows
    assert "201 gains less than the accepted one" in rows  # coulomb alone was not what was taken


def test_warnings_name_what_they_are_about() -> None:
    report = example() | {"independent_splits": False}
    report["effects"][0]["equivalents"] = ["stribeck:hinge", "lag:motor"]
    report["effects"].append(effect("lag:motor", share_of_excess=0.0002))
    report["parameters"][0]["identifiable"] = False
    report["error"]["groups"]["joint speed"]["extended"][-1] = 0.6
    said = " ".join(story.notices(report))
    for words in (
        "not independent",
        "stribeck:hinge",
        "kp lies at the bound",
        "do not show bob_mass",
        "matters little",
    ):
        assert words in said
    assert "no better than stribeck:hinge." in said  # the lag is claimed beside it, hence no rival
    for words in ("joint:hinge:vel was not declared", "joint speed gets worse"):
        assert words in said
    assert "true values may lie far outside" not in said  # nothing is missing any more
    assert story.notices(example(0) | {"parameters": [], "noise": []}) == []


@pytest.mark.parametrize("verdict", ["unexplained", "partly explained"])
def test_what_is_missing_makes_the_parameters_intervals_conditional(verdict: str) -> None:
    assert "true values may lie far outside" in " ".join(story.notices(example() | {"verdict": verdict}))


def test_of_what_is_anchored_it_says_so_and_why() -> None:
    report = example()
    report["parameters"][0] |= {"anchored": True, "reason": "weighed <twice>"}
    assert "<td>anchored: weighed &lt;twice&gt;</td>" in render(report, pictures())
    report["parameters"][0]["reason"] = ""
    assert "<td>anchored</td>" in render(report, pictures())


def test_misfit_is_in_noise_widths_with_the_worst_first() -> None:
    text = read(render(example(), pictures())).text
    part = text[text.index("Where and when") :]
    # mean squares 18 and 8 before, 1.8 and 0.8 after
    assert part.index("joint:hinge joint angle 4.24 1.34") < part.index("joint:hinge joint speed 2.83 0.894")


def test_summary_lists_folds_with_links_that_stay_beneath_it() -> None:
    page = render_summary(summary())
    reader = read(page)
    assert reader.loads[:2] == ["./a%20b/c/report.html", "./javascript%3Aalert%281%29/report.html"]
    assert "Explained in 2 of 3 folds; nothing missing in 1 of 3 folds." in reader.text
    assert "joint angle 0.0810 → 0.00410 rad (0.00370)" in reader.text
    assert reader.tags.count("script") == 1
    assert read(render_summary({"folds": {}})).tags


def test_the_templates_are_part_of_the_package() -> None:
    folder = resources.files("nfc_gym.measured").joinpath("templates")
    names = {f.name for f in folder.iterdir()}
    assert {"base.html.j2", "report.html.j2", "summary.html.j2", "page.css", "page.js"} <= names
