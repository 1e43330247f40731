"""The scale of observations, the advantage of knowing one's distribution, and losses that come apart."""

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ValueOperator
from torchrl.objectives import A2CLoss, ClipPPOLoss, SACLoss

from nfc_gym.adaptation.agent import Action, OffPolicy, OffPolicyConfig
from nfc_gym.adaptation.network import ActorCritic, Scale, Sizes
from nfc_gym.adaptation.ppo import Diverged, OnPolicy, Power, PPOConfig, clipped


def batch(n: int = 8, steps: int = 16) -> TensorDict:
    """Steps of a made-up task: the reward is the first action."""
    torch.manual_seed(0)
    seen, psi, over = torch.randn(n, steps + 1, 3), torch.randn(n, steps + 1, 2), torch.zeros(n, steps, 1, dtype=bool)
    return TensorDict(
        {
            "observation": seen[:, :-1], "psi": psi[:, :-1],
            "next": TensorDict(
                {
                    "observation": seen[:, 1:], "psi": psi[:, 1:], "reward": torch.zeros(n, steps, 1), "done": over,
                    "terminated": over.clone(),
                }, [n, steps],
            ),
        }, [n, steps], names=["n", "time"],
    )  # fmt: skip


def acted(network: ActorCritic, steps: TensorDict) -> TensorDict:
    """The same steps with the network's actions, and rewards for them."""
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        network.actor(steps)
    steps["next", "reward"] = steps["action"][..., :1].clone()
    return steps


def test_the_scale_joins_batches_as_if_they_were_one() -> None:
    x = 3 + 2 * torch.randn(1000, 4, dtype=torch.float64)
    scale = Scale(4)
    for part in (x[:10], x[10:400].reshape(13, 30, 4), x[400:]):
        scale.see(part)
    torch.testing.assert_close(scale.mean.double(), x.mean(0), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(scale.var.double(), x.var(0, unbiased=False), rtol=1e-4, atol=1e-5)
    assert scale(x.float()).std() == pytest.approx(1, abs=0.02)
    assert scale(torch.full((4,), 1e6)).max() == 5


def test_rewards_over_their_size_do_not_depend_on_their_unit() -> None:
    reward = torch.randn(64)
    torch.testing.assert_close(Power()(1000 * reward), Power()(reward))
    assert Power()(reward).square().mean() == pytest.approx(1, rel=1e-4)


@pytest.mark.parametrize("functional", [False, True])
def test_an_actor_learns_what_is_rewarded(functional: bool) -> None:
    """With our own loss and with another of TorchRL's, which makes its modules functional."""
    network = ActorCritic(Sizes(3, 2, 2, (16,)))
    config = PPOConfig(rate=1e-3, gamma=0.5)
    loss = A2CLoss(network.actor, network.critic) if functional else clipped(network.actor, network.critic, config)
    learner = OnPolicy(loss, config)
    before = network.gaussian(torch.zeros(3))[0].detach()
    for _ in range(30):
        values = learner.learn(acted(network, batch()))
    after = network.gaussian(torch.zeros(3))[0].detach()
    assert after[0] > before[0] + 0.1
    assert after[0] > after[1].abs()
    assert values["rate"] > 0


@pytest.mark.parametrize("functional", [False, True])
@pytest.mark.parametrize(("wanted", "factor"), [(1e-9, 1 / 1.5), (10.0, 1.5)])
def test_the_actors_step_size_changes_once_an_iteration_and_the_critics_stays(
    functional: bool, wanted: float, factor: float
) -> None:
    network = ActorCritic(Sizes(3, 2, 2, (16,)))
    config = PPOConfig(divergence=wanted)
    loss = A2CLoss(network.actor, network.critic) if functional else clipped(network.actor, network.critic, config)
    learner = OnPolicy(loss, config)
    values = learner.learn(acted(network, batch()))
    told = np.isfinite(values["divergence"])
    assert told != functional, "A2C does not say how far it moved the policy"
    assert learner.rate == pytest.approx(config.rate * (factor if told else 1))
    actor, critic = learner.optimiser.param_groups
    assert critic["lr"] == config.critic_rate
    count = {n: sum(p.numel() for p in g["params"]) for n, g in (("actor", actor), ("critic", critic))}
    assert count["critic"] == sum(p.numel() for p in network.value.body.parameters())
    assert count["actor"] == sum(p.numel() for p in network.gaussian.parameters())


def test_a_loss_that_is_not_finite_changes_nothing() -> None:
    network = ActorCritic(Sizes(3, 2, 2, (16,)))
    learner = OnPolicy(clipped(network.actor, network.critic, PPOConfig()), PPOConfig())
    steps = acted(network, batch())
    steps["next", "reward"][0, 0] = float("nan")
    before = {k: v.clone() for k, v in network.state_dict().items()}
    with pytest.raises(Diverged, match="not finite"):
        learner.learn(steps)
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())


class Steep(ClipPPOLoss):
    """Finite, with a gradient that is not: the root of 0."""

    def forward(self, tensordict: Any) -> Any:
        out = super().forward(tensordict)
        first = next(iter(self.actor_network.parameters()))
        return out.set("loss_objective", out["loss_objective"] + (0 * first).sum().abs().sqrt())


def test_a_gradient_that_is_not_finite_changes_nothing() -> None:
    """Else the last update of all would leave weights that are not finite, and nothing would say so."""
    network = ActorCritic(Sizes(3, 2, 2, (16,)))
    learner = OnPolicy(Steep(network.actor, network.critic, functional=False), PPOConfig())
    before = {k: v.clone() for k, v in network.state_dict().items()}
    with pytest.raises(Diverged, match="the gradient is not finite"):
        learner.learn(acted(network, batch()))
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())


def test_a_gradient_that_is_not_finite_changes_nothing_off_policy_either() -> None:
    network = ActorCritic(Sizes(3, 2, 2, (16,)))
    value = ValueOperator(Action(network.scale, 2, (16,)), in_keys=["observation", "action"])

    class SteepSAC(SACLoss):
        def forward(self, tensordict: Any) -> Any:
            out = super().forward(tensordict)
            first = next(p for p in self.actor_network_params.parameters() if p.requires_grad)
            return out.set("loss_actor", out["loss_actor"] + (0 * first).sum().abs().sqrt())

    learner = OffPolicy(SteepSAC(network.actor, value, target_entropy=-2.0), OffPolicyConfig(batch=16, critic_first=0))
    before = {k: v.clone() for k, v in network.gaussian.state_dict().items()}
    with pytest.raises(Diverged, match="the gradient is not finite"):
        learner.learn(acted(network, batch()))
    assert all(torch.equal(v, before[k]) for k, v in network.gaussian.state_dict().items())


def test_a_policy_that_runs_away_is_stopped() -> None:
    network = ActorCritic(Sizes(3, 2, 2, (16,)))
    learner = OnPolicy(clipped(network.actor, network.critic, PPOConfig()), PPOConfig())
    steps = acted(network, batch())
    with torch.no_grad():
        network.gaussian.log_std.fill_(-3)  # another policy than the one that acted
    with pytest.raises(Diverged, match="nats"):
        learner.learn(steps)
