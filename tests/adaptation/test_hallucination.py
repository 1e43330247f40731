"""pi and pi_h in one distribution: the agent's own part stays what it was, and both learn."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss, ReinforceLoss, SACLoss

from nfc_gym import InputError
from nfc_gym.adaptation.hallucination import hallucination, widened
from nfc_gym.adaptation.network import ActorCritic, Sizes

SEEN = TensorDict({"observation": torch.linspace(-1, 1, 12).reshape(4, 3)}, [4])


def gaussian() -> ProbabilisticActor:
    return ActorCritic(Sizes(3, 2, 2, (16,))).actor


def squashed(spec: Bounded | None = None) -> ProbabilisticActor:
    """Of a script that knows nothing of this package."""
    net = TensorDictModule(nn.Sequential(nn.Linear(3, 4), NormalParamExtractor()), ["observation"], ["loc", "scale"])
    return ProbabilisticActor(
        net, spec=spec, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    )


@pytest.mark.parametrize("make", [gaussian, squashed])
def test_the_density_is_the_product_of_the_agents_and_pi_hs(make) -> None:
    actor, pi_h = make(), hallucination(3, 5)
    both = widened(actor, pi_h)
    step = both(SEEN.clone())
    assert step["action"].shape == (4, 7)
    own = actor.get_dist(SEEN.clone()).log_prob(step["action"][:, :2])
    mean, spread = pi_h(SEEN["observation"])
    h = torch.distributions.Normal(mean, spread).log_prob(step["action"][:, 2:]).sum(-1)
    torch.testing.assert_close(step["action_log_prob"], own + h)
    torch.testing.assert_close(both.get_dist(SEEN.clone()).log_prob(step["action"]), own + h)


@pytest.mark.parametrize("make", [gaussian, squashed])
def test_without_exploring_the_agent_acts_as_it_did(make) -> None:
    actor, pi_h = make(), hallucination(3, 5)
    action = widened(actor, pi_h)(SEEN.clone())["action"]
    torch.testing.assert_close(action[:, :2], actor(SEEN.clone())["action"])
    torch.testing.assert_close(action[:, 2:], pi_h(SEEN["observation"])[0])


def test_one_loss_trains_the_agents_own_weights_and_pi_h() -> None:
    actor, pi_h = squashed(), hallucination(3, 5)
    critic = TensorDictModule(nn.Linear(3, 1), ["observation"], ["state_value"])
    loss = ReinforceLoss(widened(actor, pi_h), critic)
    with set_exploration_type(ExplorationType.RANDOM):
        step = widened(actor, pi_h)(SEEN.clone()).detach()
    step["advantage"], step["value_target"] = torch.ones(4, 1), torch.ones(4, 1)
    loss(step)["loss_actor"].backward()
    for module in (actor, pi_h):
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in module.parameters())


def test_an_entropy_without_a_closed_form_is_estimated() -> None:
    actor, pi_h = squashed(), hallucination(3, 5)
    torch.manual_seed(0)
    both, own = widened(actor, pi_h).get_dist(SEEN.clone()), actor.get_dist(SEEN.clone())
    drawn = own.rsample(torch.Size([20_000]))
    expected = both.h.entropy() - own.log_prob(drawn).mean(0)
    found = torch.stack([both.entropy() for _ in range(2000)])
    torch.testing.assert_close(found.mean(0), expected, atol=0.05, rtol=0)
    assert found.requires_grad
    # PPO asks for it, with its bonus as it comes.
    step = widened(actor, pi_h)(SEEN.clone()).detach()
    step["advantage"], step["value_target"] = torch.ones(4, 1), torch.ones(4, 1)
    loss = ClipPPOLoss(widened(actor, pi_h), ValueOperator(nn.Linear(3, 1), in_keys=["observation"]))
    assert loss(step)["loss_entropy"].isfinite()


def test_losses_read_the_size_of_the_longer_action_where_they_read_that_of_the_agents() -> None:
    class Q(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = nn.Linear(10, 1)

        def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            return self.net(torch.cat([observation, action], -1))

    both = widened(squashed(Bounded(-1, 1, (2,))), hallucination(3, 5))
    loss = SACLoss(both, ValueOperator(Q(), in_keys=["observation", "action"]))
    assert float(loss.target_entropy) == -7


def test_what_is_no_actor_is_refused() -> None:
    with pytest.raises(InputError, match="ends in a distribution"):
        widened(TensorDictModule(nn.Linear(3, 2), ["observation"], ["action"]), hallucination(3, 5))  # type: ignore[arg-type]
