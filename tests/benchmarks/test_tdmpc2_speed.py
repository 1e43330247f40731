"""TD-MPC2 on a GPU: what it is told at once is what it would be told one by one, and nothing waits on the way."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rail import batch, tiny

from nfc_gym.core.errors import InputError

torch = pytest.importorskip("torch", reason="TD-MPC2 learns with torch")

COMPILE = torch.compile
WAITS = {"_local_scalar_dense", "is_nonzero", "nonzero", "multinomial", "randperm", "masked_select", "equal"}


def learned(speed: Any, device: str = "cpu", updates: int = 4) -> tuple[dict[str, float], dict[str, Any]]:
    """Losses and weights after some updates, dropout and all."""
    from tdmpc2.learner import Learner

    learner = Learner(tiny(dropout=0.3).to(device), 0.9, speed)
    torch.manual_seed(5)
    steps = {k: v.to(device) for k, v in batch().items()}
    for _ in range(updates):
        told = learner.update(steps)
    learner.check()
    assert learner.updates == updates
    return {k: float(v) for k, v in told.items()}, learner.model.state_dict()


def planned(speed: Any, device: str = "cpu", plans: int = 5) -> Any:
    """Actions of plans that go on from one another, with noise and without."""
    from tdmpc2.planner import Planner

    model = tiny(samples=32, elites=4, iterations=3).to(device)
    torch.nn.init.normal_(model.rewards[-1].weight)  # a reward that tells actions apart
    planner = Planner(model, model.settings, 0.9, 1, 3, device, speed)
    torch.manual_seed(6)
    seen = torch.linspace(-1, 1, 6, device=device).reshape(3, 2)
    return torch.stack([planner.plan(seen, explore=explore) for explore in (True, False) for _ in range(plans)])


def traced(functions: list[str]) -> Callable[..., Any]:
    """Traced whole, differentiated and run as they come: what the compiler makes of kernels takes minutes here."""

    def compiled(function: Callable[..., Any], **how: Any) -> Callable[..., Any]:
        assert how["options"] == {"fallback_random": True}
        functions.append(function.__name__)
        return COMPILE(function, dynamic=how["dynamic"], backend="aot_eager", fullgraph=True)

    return compiled


def test_compiled_updates_and_plans_are_those_that_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    from tdmpc2 import speed

    functions: list[str] = []
    monkeypatch.setattr(speed.torch, "compile", traced(functions))
    said: list[str] = []
    fused = speed.Speed(compiled=True, say=said.append)
    (told, weights), (plain, known) = learned(fused), learned(speed.Speed())
    assert told == pytest.approx(plain, rel=1e-5)
    assert all(torch.allclose(v, known[k], rtol=1e-5, atol=1e-7) for k, v in weights.items())
    assert torch.allclose(planned(fused), planned(speed.Speed()), atol=1e-6)
    assert functions == ["losses", "tried", "prior", "round"]
    assert len(said) == 4
    assert not any("without" in text for text in said)


def test_a_compiler_that_fails_is_said_and_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    from tdmpc2 import speed

    def broken(function: Callable[..., Any], **how: Any) -> Callable[..., Any]:
        def fails(*given: Any) -> Any:
            torch.rand(7)  # which what is done instead must not miss
            raise RuntimeError("no C compiler\nmore of it")

        return fails

    monkeypatch.setattr(speed.torch, "compile", broken)
    said: list[str] = []
    fused = speed.Speed(compiled=True, say=said.append)
    (told, weights), (plain, known) = learned(fused), learned(speed.Speed())
    assert told == plain
    assert all(torch.equal(v, known[k]) for k, v in weights.items())
    assert torch.equal(planned(fused), planned(speed.Speed()))
    assert said.count("goes on without: no C compiler") == 4


def test_an_update_and_a_plan_wait_for_nothing() -> None:
    """A GPU can hold them as graphs: nothing asks a tensor for its value, or how many of it there are."""
    from tdmpc2.learner import PARTS, Learner
    from tdmpc2.planner import Planner
    from torch.utils._python_dispatch import TorchDispatchMode

    class Watch(TorchDispatchMode):
        seen: set[str]

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            self.seen.add(func.overloadpacket.__name__)
            return func(*args, **(kwargs or {}))

    learner, steps = Learner(tiny(dropout=0.3), 0.9), {k: batch()[k] for k in PARTS}
    planner = Planner(learner.model, learner.model.settings, 0.9, 1, 3)
    learner._work(steps)  # the first makes the optimiser's moments
    with Watch() as watch:
        watch.seen = set()
        learner._work(steps)
        with torch.no_grad():
            planner._explore({"observation": torch.zeros(3, 2), "fresh": torch.zeros(3, dtype=torch.bool)})
        assert {"mm", "topk", "_fused_adam_"} <= watch.seen
        assert not WAITS & watch.seen
        float(learner.lost)  # that does
    assert "_local_scalar_dense" in watch.seen


def test_nothing_changes_after_a_loss_that_is_not_finite_until_it_is_told() -> None:
    """A GPU goes on with the updates that it was told before anybody looks."""
    from tdmpc2.learner import PARTS, Learner

    from nfc_gym.adaptation.ppo import Diverged

    learner, good, bad = Learner(tiny(), 0.9), batch(), batch()
    bad["reward"][0, 0] = math.nan
    learner.update(good)
    before = {k: v.clone() for k, v in learner.model.state_dict().items()}
    moments = [v.clone() for state in learner.optimiser.state.values() for v in state.values()]
    for steps in (bad, good, good):
        learner._work({k: steps[k] for k in PARTS})
    assert all(torch.equal(v, before[k]) for k, v in learner.model.state_dict().items())
    after = [v for state in learner.optimiser.state.values() for v in state.values()]
    assert all(torch.equal(a, b) for a, b in zip(moments, after, strict=True))
    with pytest.raises(Diverged, match=r"update 1 is not finite \(nan\)"):
        learner.check()


def test_the_scale_is_between_quantiles() -> None:
    from tdmpc2.world_model import quantile

    ordered = torch.randn(257).sort().values
    for share in (0.0, 0.05, 0.5, 0.95, 1.0):
        assert float(quantile(ordered, share)) == pytest.approx(float(ordered.quantile(share)), abs=1e-6)


def test_the_oldest_sequences_make_room() -> None:
    from dataclasses import replace

    from tdmpc2.replay import Replay
    from tdmpc2.settings import NETS

    replay = Replay(replace(NETS["tiny"], batch=500), torch.device("cpu"), most=5)
    for first in range(0, 8, 4):
        replay.add({"reward": torch.arange(first, first + 4.0)[:, None]})
    assert len(replay) == 5
    assert sorted(replay.contents()["reward"][:, 0].tolist()) == [3, 4, 5, 6, 7]
    drawn = replay.sample()["reward"][:, 0]
    assert drawn.shape == (500,)
    assert set(drawn.tolist()) == {3, 4, 5, 6, 7}
    replay.add({"reward": torch.arange(20.0)[:, None]})  # more than there is room for
    assert sorted(replay.contents()["reward"][:, 0].tolist()) == [15, 16, 17, 18, 19]


def test_a_model_of_flat_ground_begins_one_of_rough_ground(tmp_path: Any) -> None:
    from tdmpc2.agent import Agent
    from tdmpc2.pretraining import begin_from
    from worlds.world import World

    from nfc_gym.adaptation.sight import Sight

    def agent(place: str) -> Any:
        env = World(place, "nominal", 0).make(1, context=["psi"])
        sight = Sight.of(env)
        return Agent(tiny(sight.size, env.unwrapped.robot.action_size), 0.99, sight)

    flat, rough = agent("JackalFlat"), agent("JackalRough")
    flat.save(tmp_path / "JackalFlat.safetensors")
    for p in rough.model.parameters():
        torch.nn.init.normal_(p)
    begin_from(rough, tmp_path / "JackalFlat.safetensors")
    seen = np.random.default_rng(0).normal(size=(4, rough.sight.size)).astype(np.float32)
    ours = rough.model.encode(torch.from_numpy(seen))
    theirs = flat.model.encode(torch.from_numpy(seen[:, : flat.sight.size]))
    assert torch.allclose(ours, theirs, atol=1e-6)
    assert all(torch.equal(a, b) for a, b in zip(rough.model.targets.parameters(), flat.model.targets.parameters(),
                                                strict=True))  # fmt: skip
    with pytest.raises(InputError, match="no start for"):
        begin_from(agent("AntFlat"), tmp_path / "JackalFlat.safetensors")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("compiled", [False, True])
def test_a_gpu_replays_what_it_would_be_told(compiled: bool) -> None:
    from tdmpc2.speed import Speed

    replayed, told = Speed(compiled=compiled), Speed(graphs=False)
    (ours, weights), (theirs, known) = learned(replayed, "cuda", 8), learned(told, "cuda", 8)
    assert ours == pytest.approx(theirs, rel=1e-2)
    assert all(torch.allclose(v, known[k], rtol=1e-2, atol=1e-4) for k, v in weights.items())
    assert (planned(replayed, "cuda", 8) - planned(told, "cuda", 8)).abs().median() < 1e-2
