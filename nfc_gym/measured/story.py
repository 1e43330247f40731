"""A report in plain words: the verdict in a sentence, how sure it is, and what to know before relying on it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from nfc_gym.measured.wording import DASH, counted, finite, listed, number, percent, plain, quantity
from nfc_gym.physics.effects.words import together

_WORSE = 1.02  # error after over error before from which a group is reported as made worse

_SLIGHT = 0.01  # share of the excess below which an effect is said to matter little


class Verdict(NamedTuple):
    """A verdict's word, colour class, sign (so that colour is not alone) and meaning."""

    word: str
    cls: str
    sign: str
    meaning: str


VERDICTS = {
    v.word: v
    for v in (
        Verdict(
            "nothing missing",
            "good",
            "=",
            "The calibrated model predicts logs that nobody fitted to as well as the noise allows. "
            "No effect need be added.",
        ),
        Verdict(
            "explained",
            "found",
            "✓",
            "Effects that the model lacked are named below; with them "
            "the error on unseen logs comes down to what noise alone leaves.",
        ),
        Verdict(
            "partly explained",
            "part",
            "◐",
            "The effects named below help on unseen logs, but a misfit beyond the "
            "noise remains that they do not explain.",
        ),
        Verdict(
            "unexplained",
            "open",
            "?",
            "The misfit on unseen logs is beyond the noise, and no effect of the "
            "library is shown to be its cause. Nothing is claimed.",
        ),
    )
}


class Change(NamedTuple):
    """Error of one group of quantities at one horizon with each model; None where it is not known."""

    group: str
    unit: str
    horizon: float | None
    nominal: float | None
    calibrated: float | None
    extended: float | None
    floor: float | None


def verdict_of(report: dict[str, Any]) -> Verdict:
    """The verdict; a word that is not known is shown as it is, without a meaning."""
    word = str(report.get("verdict", DASH))
    return VERDICTS.get(word, Verdict(word, "open", "?", ""))


def believed(posterior: dict[str, Any] | None) -> dict[str, Any] | None:
    """What calibration started from, if from a posterior: sentences, and both residual dynamics."""
    parts = ("delta_s", "fitted_delta_s")
    return posterior and {"sentences": _begun(posterior)} | {k: posterior.get(k) or [] for k in parts}


def _begun(posterior: dict[str, Any]) -> list[str]:
    """Where calibration began, what that was worth, and what the posterior speaks of in vain."""
    misfit, seconds = posterior.get("misfit") or {}, posterior.get("seconds")
    chosen = "the posterior" if posterior.get("start") == "posterior" else "nominal values, which fitted better"
    told, given = (number(misfit.get(k)) for k in ("posterior", "nominal"))
    out = [
        f"Calibration began at {chosen} ({posterior.get('file')}): before any fitting the loss is {told} for each "
        f"number compared, {given} at nominal values."
    ]
    saved = finite(posterior.get("seconds_saved"))
    if saved is not None:
        much = f"{quantity(abs(saved), 's')} {'saved' if saved >= 0 else 'lost'}"
        alone = quantity(posterior.get("seconds_from_nominal"), "s")
        out.append(f"It took {quantity(seconds, 's')}; from nominal values {alone}: {much}.")
    elif finite(seconds) is not None:
        out.append(f"It took {quantity(seconds, 's')}.")
    others = posterior.get("not_declared") or []
    if others:
        out.append(f"The posterior also speaks of what is not declared here: {listed([str(n) for n in others], 6)}.")
    return out


def suspected(report: dict[str, Any]) -> dict[str, Any] | None:
    """What a structure head held possible beside what was found: sentences, and a row for each family of either."""
    told = report.get("structure")
    if not told:
        return None
    families, first = told.get("families") or {}, told.get("looked_at_first") or []
    found = [e.get("family") for e in report.get("effects") or []]
    shown = [f for f in families if f in {"none", *first, *found}] + [f for f in found if f not in families]
    rows = [{"family": f, "probability": families.get(f), "first": f in first, "found": f in found} for f in shown]
    sentences = [
        f"{told.get('file')} was asked about {counted(told.get('windows') or 0, 'window')} of the fit logs, in "
        f"{quantity(told.get('seconds'), 's')}. Its families competed first, beside those that lead plain screening; "
        "all others competed where these left something to explain."
    ]
    if told.get("left_out"):
        sentences.append(
            f"The identifiability table leaves out {counted(told['left_out'], 'candidate')} of families that were not "
            f"looked at closely, which saved about {quantity(told.get('seconds_spared'), 's')}."
        )
    return {"sentences": sentences, "rows": rows}


def changes(report: dict[str, Any]) -> list[Change]:
    """Errors of every group at the longest horizon at which the calibrated model has one."""
    error = report.get("error") or {}
    horizons = error.get("horizons_s") or []
    out = []
    for group, row in (error.get("groups") or {}).items():
        known = [i for i, v in enumerate(row.get("calibrated") or []) if finite(v) is not None]
        at = known[-1] if known else 0
        pick = [value_at(row.get(s), at) for s in ("nominal", "calibrated", "extended", "noise_floor")]
        out.append(Change(str(group), row.get("unit") or "", value_at(horizons, at), *pick))
    return out


def value_at(values: Any, i: int) -> float | None:
    """The i-th value, or None where there is none or it is not finite."""
    return finite(values[i]) if values and i < len(values) else None


def worst(found: list[Change]) -> Change | None:
    """The group that the calibrated model misses by the most, measured by its noise floor: not the prettiest one."""
    usable = [c for c in found if c.calibrated is not None]
    excess = lambda c: c.calibrated / c.floor if c.floor else c.calibrated  # noqa: E731
    return max(usable, key=excess, default=None)


def what(effect: dict[str, Any]) -> str:
    """`dry friction at hinge`: an effect's sentence up to its values, many places counted rather than listed."""
    where = effect.get("where")
    places = [str(w) for w in where] if isinstance(where, list) else [str(where or DASH)]
    head, values, _ = str(effect.get("sentence") or "").partition(": ")
    if not values:
        return f"{str(effect.get('family', '')).replace('_', ' ')} at {listed(places, 4)}"
    if len(places) > 3:
        head = head.replace(together(places), listed(places, 4))
    return head[:1].lower() + head[1:] if head[1:2].islower() else head


def added(report: dict[str, Any]) -> list[dict[str, Any]]:
    """What the extended model has beyond psi: effects that are claimed, and what is proposed without a cause."""
    return [*(report.get("effects") or []), *(report.get("proposals") or [])]


def headline(report: dict[str, Any]) -> str:
    """What is missing, in one sentence."""
    effects = report.get("effects") or []
    word = report.get("verdict")
    left = (report.get("unexplained") or {}).get("coordinate")
    at = f", most plainly at {left}" if left else ""
    proposals = report.get("proposals") or []
    if near := [what(e) for e in proposals if e.get("nearest")]:
        share = percent((report.get("unexplained") or {}).get("nearest_share") or 0.0)
        at += f". Nearest comes {listed(near, 3)}, which takes away {share} of that and is not believed to be the cause"
    if laws := [what(e) for e in proposals if not e.get("nearest")]:
        at += f". It looks like {listed([h[:1].lower() + h[1:] for h in laws], 3)}"
    if word == "nothing missing":
        return "Nothing is missing: once calibrated, the model predicts unseen motion as well as the sensors can tell."
    if word == "unexplained":
        return f"Something is missing, but no known effect is shown to be it: the model misses unseen motion{at}."
    lacks = f"Missing from the model: {listed([what(e) for e in effects], 4)}"
    if word == "partly explained":
        return f"{lacks}; and something more that no known effect is shown to be{at}."
    return f"{lacks}. With {'it' if len(effects) == 1 else 'them'} added, what remains is {_noise(report)}."


def _noise(report: dict[str, Any]) -> str:
    """What is left, where nothing more is missing: a tenth above what noise leaves is not worth a word of its own."""
    chi2 = report.get("chi2") or {}
    after, bound = (finite(chi2.get(key)) for key in ("extended", "null_95"))
    above = after is not None and bound is not None and after > bound
    return "hardly more than noise" if above else "no more than noise"


def ahead(horizon: float | None) -> str:
    """`0.4 s ahead`; horizon 0 is no look ahead."""
    return f" {plain(horizon)}\N{NO-BREAK SPACE}s ahead" if horizon else " at each instant"


def unseen(report: dict[str, Any]) -> str:
    """On what the errors were counted."""
    names = set((report.get("logs") or {}).get("verify") or [])
    if not report.get("independent_splits", True):
        return f"unseen stretches of {counted(len(names), 'log')}"
    return counted(len(names), "unseen log")


def error_sentence(report: dict[str, Any]) -> str:
    """Error before and after in the group that was missed by the most."""
    c = worst(changes(report))
    if c is None:
        return ""
    steps = [(c.nominal, "with the model as given"), (c.calibrated, "once calibrated")]
    if new := added(report):
        near = any(e.get("nearest") for e in new)
        name = "missing effect" if report.get("effects") else "nearest effect" if near else "proposed law"
        steps.append((c.extended, f"with the {name}{'s' * (len(new) > 1)} added"))
    path = ", ".join(f"{quantity(v, c.unit)} {words}" for v, words in steps if v is not None)
    floor = f" The noise alone accounts for {quantity(c.floor, c.unit)}." if c.floor is not None else ""
    return f"Typical error of the {c.group}{ahead(c.horizon)}, on {unseen(report)}: {path}.{floor}"


def certainty(report: dict[str, Any]) -> str:
    """How sure: chi-squared against a perfect model's, and the interval of what the effects take away."""
    chi2 = report.get("chi2") or {}
    after = finite(chi2.get("extended" if added(report) else "calibrated"))
    bound, null = finite(chi2.get("null_95")), finite(chi2.get("null"))
    if after is None or bound is None:
        return ""
    if after <= bound:
        rest = f"is within what a perfect model would show (up to {number(bound)})"
    elif after <= 1.1 * bound:
        rest = f"is next to what a perfect model would show (up to {number(bound)})"
    else:
        rest = f"is {number(after / null if null else after, 2)} times a perfect model's ({number(null)})"
    text = f"Chi-squared {number(after)} {rest}"
    low, high = (finite(r) for r in chi2.get("extended_over_calibrated_95") or (None, None))
    if added(report) and low is not None and high is not None:
        part = f"{number(100 * low, 2)} to {number(100 * high, 2)} %"
        text += f"; that is {part} of what calibration alone leaves (95 % interval)"
    return f"{text}."


def notices(report: dict[str, Any]) -> list[str]:
    """What a reader should know before relying on the verdict."""
    parameters = report.get("parameters") or []
    out = []
    if not report.get("independent_splits", True):
        out.append(
            "The logs that test the model are stretches of the logs that it was fitted to: they are not "
            "independent, and the errors may be too rosy. Record more logs to be sure."
        )
    out += _on_effects(report)
    findings = report.get("findings") or []
    out += [str(f.get("text")) for f in findings]
    moved = [p.get("name") for p in parameters if p.get("left_prior")]
    if moved and not any(f.get("kind") == "left_prior" for f in findings):
        out.append(
            f"{listed(moved)} {'lies' if len(moved) == 1 else 'lie'} at the bound of the allowed range. Either "
            "the range is too narrow, or the parameter stands in for something else."
        )
    blind = [p.get("name") for p in parameters if p.get("identifiable") is False]
    if blind:
        out.append(f"These motions do not show {listed(blind)}: the estimate is hardly more than what was declared.")
    if parameters and report.get("verdict") in ("unexplained", "partly explained"):
        out.append(
            "The parameters' intervals hold only if nothing is missing, and something is: the parameters take up "
            "what they can of it, and the true values may lie far outside."
        )
    guessed = [n.get("channel") for n in report.get("noise") or [] if n.get("estimated")]
    if guessed:
        out.append(
            f"The noise of {listed(guessed)} was not declared; it was estimated from the logs, "
            "and the verdict leans on it."
        )
    return out


def rivals_of(effect: dict[str, Any], effects: Sequence[dict[str, Any]]) -> list[str]:
    """Ids of what fits as well as an effect, less those that are claimed beside it."""
    claimed = {e.get("id") for e in effects}
    return [i for i in effect.get("equivalents") or [] if i not in claimed]


def _undecided(rivals: Sequence[str], effect: dict[str, Any], report: dict[str, Any]) -> str:
    """That the contest left an effect's rivals standing; and where they lie far enough apart to be told, that too."""
    text = f"explains these logs no better than {listed(list(rivals), 4)}"
    for row in report.get("identifiability") or []:
        sigma, rival = finite(row.get("sigma")), row.get("worst_mimic")
        if row.get("id") == effect.get("id") and rival in rivals and row.get("distinguishable") and sigma:
            text += f", though {rival} should lie {number(sigma, 2)} sigma away"
    return text


def _on_effects(report: dict[str, Any]) -> list[str]:
    effects = report.get("effects") or []
    if not effects:
        spare = [e for e in report.get("proposals") or [] if e.get("nearest")]
        if spare and report.get("verdict") == "nothing missing":
            fitted = " ".join(str(e.get("sentence")) for e in spare)
            return [f"Fitted as well, and in effects.yaml as a proposal, but it may make no difference: {fitted}"]
        return []
    out = []
    for e in effects:
        if rivals := rivals_of(e, effects):
            out.append(f"{e.get('id')} {_undecided(rivals, e, report)}.")
        share = finite(e.get("share_of_excess"))
        if share is not None and share < _SLIGHT:
            part = f"takes away {percent(share)} of the excess error on the verification logs"
            out.append(f"{e.get('id')} {part}: it matters little.")
    high = finite(((report.get("chi2") or {}).get("extended_over_calibrated_95") or [None, None])[1])
    if high is not None and high >= 1:
        out.append("On the verification logs the gain is not significant: its 95 % interval includes none at all.")
    for c in changes(report):
        if c.calibrated and c.extended and c.extended > _WORSE * c.calibrated:
            before, after = quantity(c.calibrated, c.unit), quantity(c.extended, c.unit)
            out.append(f"The {c.group} gets worse on unseen logs: {before} before, {after} after.")
    return out
