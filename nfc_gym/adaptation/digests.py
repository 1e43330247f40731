"""What tells networks, detectors and posteriors from others, so that a run is never taken up again with another's."""

from dataclasses import fields
from typing import Any

import numpy as np

from nfc_gym.adaptation.assimilation import Assimilation
from nfc_gym.adaptation.beliefs import Fixed, Sequential
from nfc_gym.adaptation.weights import digest, flat
from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.posterior import Sampler
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.detector_file import KEPT
from nfc_gym.inference.learner import Learner
from nfc_gym.inference.posterior import NeuralPosterior
from nfc_gym.physics.effects.saved import from_row, to_row
from nfc_gym.simulate.replay import Replay

_DRAWS = 16  # by which a posterior is told from others that can only be drawn from
# Of an `Assimilation`: what follows from the rest, what changes nothing, and what is told in another way.
_LEFT_OUT = ("machine", "box", "structure", "nthread", "ground", "remembered")


def of_network(net: Learner) -> list[Any]:
    """Parts of a digest: what a network of psi or of evidence is made of."""
    return [net.config, net.prior.to_dict(), *flat(net.state_dict())]


def of_detector(detector: Any) -> str | None:
    """Of a detector of windows, or None: nobody knows what one of another kind is made of."""
    if not isinstance(detector, WindowDetector):
        return None
    scorer: Any = detector.scorer
    if type(scorer) in KEPT:
        parts = of_network(scorer)
    elif type(scorer) is Replay:
        parts = [scorer.machine.environment, scorer.psi, scorer.jitter, scorer.start, scorer.eps]
        parts += [part for m in scorer.maps for part in (m.heights, m.resolution, m.origin)]
        if scorer.lacks is not None:
            row = to_row(*scorer.lacks)
            try:
                from_row(row)
            except InputError:  # an effect of the caller's own, of which a row does not say everything
                return None
            parts.append(row)
    else:
        return None
    return digest(detector.every, detector.threshold, detector.calibration, *parts)


def of_posterior(posterior: Any) -> str | None:
    """Of what infers, or None where nobody can tell: an `Inference` of the caller's own, draws that do not repeat."""
    if isinstance(posterior, Fixed):
        return of_posterior(posterior.posterior)
    if isinstance(posterior, Sequential):
        return digest(of_posterior(posterior.posterior), posterior.rounds, posterior.training)
    if isinstance(posterior, NeuralPosterior):
        return digest(*of_network(posterior.network), posterior.parts)
    if isinstance(posterior, Assimilation):
        given = {f.name: getattr(posterior, f.name) for f in fields(posterior) if f.name not in _LEFT_OUT}
        ground = posterior.ground
        parts = [] if ground is None else [ground.heights, ground.resolution, ground.origin]
        trajectories = [v for t in posterior.remembered for v in (t.states, t.actions)]
        return digest(given, *parts, *trajectories)
    if isinstance(posterior, Sampler) and not callable(getattr(posterior, "given", None)):
        drawn = [_drawn(posterior) for _ in range(2)]
        return drawn[0] if drawn[0] == drawn[1] else None
    return None


def _drawn(posterior: Sampler) -> str:
    fidelity: Fidelity = posterior.sample(_DRAWS, np.random.default_rng(0))
    return digest(*(part for name in fidelity.given for part in (name, getattr(fidelity, name))))
