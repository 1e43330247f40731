"""`SplitPiH`: the widened action of `Hallucinate` as TorchRL has actions of several parts, a key for each.

A Transform sees tensors and no physics: the world that pi_h asks for is the wrapper's to make. Psi too is drawn by a
wrapper (`RandomizePsi`). It is written through the options of a reset, which TorchRL hands to the environment past all
Transforms, and where a vector environment resets within a step, no Transform is asked.
"""

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite
from torchrl.envs import Transform

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole

ACTION = "action"


class SplitPiH(Transform):
    """Two action keys, the robot's own entries and pi_h, in place of one action that `Hallucinate` has widened.

    Args:
      own: entries of the robot's own action, `own` of `Hallucinate` and `VectorHallucinate`.
      key: of pi_h; the robot's own entries keep `action`.

    The environment beneath takes an action (..., own + m); of what stands around it a policy gives `action` (..., own)
    and `key` (..., m), and both are kept in its data. In a deployed policy the one that gives `key` is left out.

    Raises:
      InputError: the action is no wider than `own`, or no box.
    """

    def __init__(self, own: int, key: str = "pi_h") -> None:
        self.own, self.key = require_whole("SplitPiH: own", own, 1), key
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=[ACTION], out_keys_inv=[ACTION, key])

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        own, pi_h = (tensordict.get(k, None) for k in (ACTION, self.key))
        if own is not None and pi_h is not None:
            tensordict = tensordict.exclude(self.key).set(ACTION, torch.cat([own, pi_h], -1))
        return tensordict

    def transform_action_spec(self, action_spec: Any) -> Composite:
        """The two boxes (..., own) and (..., m)."""
        wide = action_spec[ACTION]
        if not isinstance(wide, Bounded) or wide.shape[-1] <= self.own:
            raise InputError(f"SplitPiH: own is {self.own}, and the environment's action is {wide}; want a box with "
                             "pi_h behind the robot's own entries, as Hallucinate makes it")  # fmt: skip
        found, box = action_spec.clone(), cast(Any, wide.space)
        for key, part in ((ACTION, slice(None, self.own)), (self.key, slice(self.own, None))):
            low, high = (bound[..., part] for bound in (box.low, box.high))
            found[key] = Bounded(low, high, low.shape, dtype=wide.dtype, device=wide.device)
        return found
