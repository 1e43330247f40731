"""The methods of the table, and what they are given to see."""

from dataclasses import dataclass

from nfc_gym.inference.config import NetworkConfig


@dataclass(frozen=True)
class Method:
    """One row: how a posterior is learned.

    Attributes:
      name: as the table has it.
      encoder: of the motion.
      density: of our `NetworkConfig`, or the trainer of sbi (`peer`).
      peer: whether it is sbi's.
    """

    name: str
    encoder: str
    density: str
    peer: bool = False


METHODS = {
    "mdn-rff": Method("MDN + QMC-RFF", "qmc-rff", "mixture"),
    "mdn-tcn": Method("MDN + TCN", "tcn", "mixture"),
    "sde-nn": Method("SDE + NN", "nn", "score"),
    "sde-rff": Method("SDE + QMC-RFF", "qmc-rff", "score"),
    "sde-fks": Method("SDE + QMC-FKS", "qmc-fks", "score"),
    "sde-tcn": Method("SDE + TCN (ours)", "tcn", "score"),
    "flow-tcn": Method("spline flow + TCN", "tcn", "flow"),
    "sbi-npe": Method("sbi NPE, spline flow, TCN", "tcn", "npe", peer=True),
    "sbi-npse": Method("sbi NPSE, TCN", "tcn", "npse", peer=True),
}
OURS = "sde-tcn"
BASELINES = ("mdn-rff", "mdn-tcn", "sde-nn", "sde-rff", "sde-fks")  # the paper's five
FLOW = ("flow-tcn",)  # a density that the paper has not, on our encoder and with our training
SBI = ("sbi-npe", "sbi-npse")  # of the kept library, on our encoder

# What every method of a row is given: what is added to the window of states and actions.
INPUTS: dict[str, dict[str, bool]] = {
    "window": {},
    "summaries": {"summaries": True},
    "linear": {"summaries": True, "linear": True},  # and a start from what a ridge regression on these tells
    "map": {"elevation": True},
}


def network_config(
    method: Method, inputs: str, small: bool = False, draws: int = 8, hidden: int = 256
) -> NetworkConfig:  # fmt: skip
    """Of one method; `small` is for trying things out, `draws` are a score model's, `hidden` is its layers' width."""
    size = {"width": 64, "features": 64, "hidden": 64, "depth": 2} if small else {"hidden": hidden}
    density = "score" if method.peer else method.density
    return NetworkConfig(encoder=method.encoder, density=density, draws=draws, **INPUTS[inputs], **size)


def cell_name(place: str, method: str, inputs: str, seed: int) -> str:
    """Of the result of one method in one environment, such as JackalFlat."""
    return f"{place}_{method}_{inputs}_{seed}"


def possible(method: Method, inputs: str) -> str:
    """Why a method cannot have an input; empty if it can."""
    if inputs == "map" and method.encoder.startswith("qmc"):
        return "kernel methods see no map"
    if inputs == "linear" and method.peer:
        return "sbi has no linear start"
    return ""
