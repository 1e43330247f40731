"""TD-MPC2: its mathematics and its plans, on cases whose answer is known."""

import math
from typing import Any

import pytest
from rail import tiny

torch = pytest.importorskip("torch", reason="TD-MPC2 learns with torch")


def test_numbers_come_back_from_symlog_and_from_two_bins() -> None:
    from tdmpc2.networks import TwoHot, symexp, symlog

    x = torch.tensor([-2e4, -3.0, -0.01, 0.0, 0.5, 1.0, 1e3, 2e4])
    assert symexp(symlog(x)) == pytest.approx(x, rel=1e-5)
    assert float(symlog(torch.tensor(math.e - 1))) == pytest.approx(1)
    coder = TwoHot(101, 10.0)
    weights = coder.encode(x)
    assert weights.sum(-1) == pytest.approx(torch.ones(8), rel=1e-5)
    assert int((weights > 0).sum(-1).max()) <= 2
    assert coder.decode((weights + 1e-30).log()) == pytest.approx(x, rel=1e-3, abs=1e-4)
    beyond = coder.encode(torch.tensor([1e9, -1e9]))  # cut at the outermost bins
    assert beyond[0, -1] == beyond[1, 0] == 1


def test_cross_entropy_is_least_where_the_prediction_is_the_number() -> None:
    from tdmpc2.networks import TwoHot

    coder, x = TwoHot(101, 10.0), torch.tensor([0.7, -12.0])
    right = (coder.encode(x) + 1e-12).log()
    entropy = -(coder.encode(x) * (coder.encode(x) + 1e-12).log()).sum(-1)
    assert coder.loss(right, x) == pytest.approx(entropy, abs=1e-4)
    assert coder.loss(torch.zeros(2, 101), x) == pytest.approx(torch.full((2,), math.log(101)), rel=1e-5)


def test_latent_states_are_points_of_simplices() -> None:
    from tdmpc2.networks import SimNorm

    x = torch.randn(5, 3, 32)
    out = SimNorm(8)(x)
    assert out.shape == x.shape
    assert out.unflatten(-1, (4, 8)).sum(-1) == pytest.approx(torch.ones(5, 3, 4), rel=1e-5)
    assert out[..., :8] == pytest.approx(x[..., :8].softmax(-1))
    model = tiny()
    z = model.next(model.encode(torch.randn(6, 2)), torch.zeros(6, 1)).detach()
    assert z.unflatten(-1, (-1, 8)).sum(-1) == pytest.approx(torch.ones(6, 2), rel=1e-5)


def test_critics_together_are_what_each_is_alone() -> None:
    from tdmpc2.networks import Critics

    torch.manual_seed(0)
    critics = Critics(3, 4, (8, 8), 5, 0.0)
    for p in critics.parameters():
        torch.nn.init.normal_(p)
    x = torch.randn(2, 6, 4)
    whole = critics(x).detach()
    assert whole.shape == (3, 2, 6, 5)
    assert critics(x, torch.tensor([2, 0])).detach() == pytest.approx(whole[[2, 0]], rel=1e-4, abs=1e-5)
    a, b, c = critics.layers
    y = x @ a.weight[1] + a.bias[1]
    y = torch.nn.functional.mish(torch.nn.functional.layer_norm(y, (8,)) * a.gain[1] + a.shift[1])
    y = y @ b.weight[1] + b.bias[1]
    y = torch.nn.functional.mish(torch.nn.functional.layer_norm(y, (8,)) * b.gain[1] + b.shift[1])
    assert (y @ c.weight[1] + c.bias[1]).detach() == pytest.approx(whole[1], rel=1e-4, abs=1e-4)
    x.requires_grad_()
    critics(x, frozen=True).sum().backward()
    assert x.grad is not None
    assert all(p.grad is None for p in critics.parameters())


def test_the_prior_s_entropy_is_that_of_a_squashed_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    from torch.distributions import Normal, TanhTransform, TransformedDistribution

    model = tiny(action=2)
    raw = torch.tensor([[0.3, -1.0, -0.2, 0.4]])
    monkeypatch.setattr(model.prior, "forward", lambda state: raw)
    torch.manual_seed(1)
    action, entropy = model.propose(torch.zeros(1, 16))
    std = (-10 + 6 * (raw[:, 2:].tanh() + 1)).exp()
    known = TransformedDistribution(Normal(raw[:, :2], std), [TanhTransform()]).log_prob(action).sum(-1)
    assert entropy == pytest.approx(-known, rel=1e-4)


def test_the_discount_is_as_published() -> None:
    from tdmpc2.settings import discount

    assert discount(500) == pytest.approx(0.99)
    assert discount(1000) == pytest.approx(0.995)
    assert discount(25) == 0.95


# ---- planning ------------------------------------------------------------------------------------------------------


class Plain:
    """A model that is known: the state moves by a tenth of the action, and a quadratic reward has its best action."""

    def __init__(self, best: Any, cliff: float = math.inf) -> None:
        self.best, self.cliff = best, cliff

    def encode(self, observation: Any) -> Any:
        return observation

    def act(self, state: Any) -> Any:
        return torch.zeros(*state.shape[:-1], 2)

    def imagine(self, state: Any, action: Any) -> Any:
        from tdmpc2.world_model import Imagined

        after = state + 0.1 * action.sum(-1, keepdim=True)
        best = self.best[:, None].expand_as(action)
        return Imagined(after, -(action - best).square().sum(-1), after[..., 0] > self.cliff)

    def value(self, state: Any) -> Any:
        return torch.zeros(state.shape[:-1])


def planner(model: Any, rows: int, **change: Any) -> Any:
    from dataclasses import replace

    from tdmpc2.planner import Planner
    from tdmpc2.settings import Settings

    return Planner(model, replace(Settings(), **change), 0.99, 2, rows)


def test_plans_of_many_robots_find_each_its_own_optimum() -> None:
    torch.manual_seed(0)
    best = torch.tensor([[0.5, -0.3], [-0.8, 0.1], [0.0, 0.9]])
    plans = planner(Plain(best), 3, iterations=12, temperature=8.0)
    action = plans.plan(torch.zeros(3, 1))
    assert (action - best).abs().max() < 0.1
    assert (plans.mean - best[:, None]).abs().max() < 0.1  # at every step of the horizon


def test_what_is_left_of_a_plan_is_begun_from_and_forgotten_with_the_episode() -> None:
    plans = planner(
        Plain(torch.zeros(2, 2)), 2, iterations=1, samples=2, priors=1, elites=1, max_std=1e-6, min_std=1e-6
    )
    plans.mean = torch.tensor([[[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]] * 2)
    plans.model.act = lambda state: torch.full((*state.shape[:-1], 2), 5.0)  # so that no prior is ever an elite
    plans.plan(torch.zeros(2, 1), fresh=torch.tensor([False, True]))
    assert plans.mean[0] == pytest.approx(torch.tensor([[0.2, 0.2], [0.3, 0.3], [0.0, 0.0]]), abs=1e-4)
    assert plans.mean[1].abs().max() < 1e-4


def test_nothing_is_earned_after_an_episode_s_end() -> None:
    model = Plain(torch.zeros(1, 2), cliff=0.15)
    plans = planner(model, 1)
    flat = torch.zeros(1, 1, 3, 2)
    over = flat.clone()
    over[0, 0, 0] = 1.0  # over the cliff at once: the first step's reward counts, the later ones do not
    over[0, 0, 1] = -1.0
    assert float(plans.worth(torch.zeros(1, 1), over)) == pytest.approx(-2.0)
    assert float(planner(Plain(torch.zeros(1, 2)), 1).worth(torch.zeros(1, 1), over)) == pytest.approx(-2 - 0.99 * 2)
    assert float(plans.worth(torch.zeros(1, 1), flat)) == 0
