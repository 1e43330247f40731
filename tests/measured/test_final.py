"""The last fits: how often each of the two models is begun elsewhere."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured import final
from nfc_gym.measured.elsewhere import STARTS


@pytest.mark.parametrize(
    ("effects", "begun"), [((), {"calibrated": STARTS}), (("lag",), {"calibrated": 0, "extended": STARTS})]
)
def test_psi_alone_is_begun_elsewhere_where_there_is_nothing_beside(
    monkeypatch: pytest.MonkeyPatch, effects: tuple[str, ...], begun: dict[str, int]
) -> None:
    seen: dict[str, int] = {}

    def settled(run: Any, name: str, start: Any, whole: Any, others: Any = (), starts: int = STARTS) -> Any:
        seen[name] = starts
        return SimpleNamespace(plant=start.plant, x=start.x, fitted=start, under=None, unsure=np.zeros(len(start.x)))

    plant: Any = SimpleNamespace(effects=effects, space=range(2))
    last: Any = SimpleNamespace(plant=plant, x=np.ones(2 + len(effects)))
    found: Any = SimpleNamespace(
        rest=SimpleNamespace(fitted=last), calibrated=SimpleNamespace(plant=plant, x=np.ones(2))
    )
    monkeypatch.setattr(final, "_settled", settled)
    monkeypatch.setattr(final, "step_error", lambda whole, under, fitted: np.zeros((2, len(fitted.x))))
    monkeypatch.setattr(final, "differs", lambda *_: True)
    monkeypatch.setattr(final, "clusters", lambda _: None)
    final.final_models(SimpleNamespace(), found, SimpleNamespace())  # pyright: ignore[reportArgumentType]
    assert seen == begun
