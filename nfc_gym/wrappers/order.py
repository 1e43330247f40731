"""Which wrappers may stand around which, and why not."""

from typing import Any

from nfc_gym.core.errors import InputError

# Wrappers that write one and the same thing: at most one of a set around an environment.
PSI, TERRAIN = "psi is written by", "the simulated terrain is written by"
_ALONE: dict[str, tuple[str, ...]] = {
    PSI: ("RandomizePsi", "Hallucinate"),
    TERRAIN: ("ResidualTerrain", "Hallucinate"),
    "the action is widened by": ("Hallucinate",),
    "all effects go to one": ("ApplyEffects",),
    "the map of `elevation` is made by": ("PerceiveTerrain",),
}
# (outer, inner) -> why that cannot work, and the signal whose noise it is about (None: whatever the arguments).
_WRONG: dict[tuple[str, str], tuple[str, str | None]] = {
    ("PerceiveTerrain", "PerturbSignals"): ("its map would replace the one that was perturbed", "elevation"),
    ("PerturbSignals", "Hallucinate"): ("it would perturb the hallucinated part of the action", "action"),
    ("MonitorAnomaly", "Hallucinate"): ("its detector would be shown the hallucinated part of the action", None),
}


def kind(wrapper: Any) -> str:
    """Name of a wrapper, the same for a vector twin."""
    return type(wrapper).__name__.removeprefix("Vector")


def beneath(env: Any) -> list[Any]:
    """Every wrapper from `env` down to the environment, outermost first."""
    found = []
    while env is not getattr(env, "unwrapped", env):
        found.append(env)
        env = env.env
    return found


def check_order(wrapper: Any, env: Any) -> None:
    """Refuse, by name, to put `wrapper` around `env` where that cannot work.

    Raises:
      InputError: naming both wrappers, the reason, and the order that works.
    """
    mine = kind(wrapper)
    for inner in beneath(env):
        theirs = kind(inner)
        for what, names in _ALONE.items():
            if mine in names and theirs in names and wrapper.writes(what) and inner.writes(what):
                raise InputError(f"{mine} around {theirs}: {what} {' or '.join(names)}, and that only once")
        reason, signal = _WRONG.get((mine, theirs), ("", None))
        noisy = wrapper if mine == "PerturbSignals" else inner
        if reason and (signal is None or signal in noisy.arguments["noise"]):
            raise InputError(f"{mine} around {theirs}: {reason}; put {theirs} around {mine}")
