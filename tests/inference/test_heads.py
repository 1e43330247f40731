"""Densities: normalised, at the prior where they start, blocks and marginals that agree."""

import math

import pytest
import torch

from nfc_gym.inference.heads.density import Chain, Density
from nfc_gym.inference.heads.flow import Flow
from nfc_gym.inference.heads.mixture import Mixture
from nfc_gym.inference.heads.score import Score
from nfc_gym.inference.heads.structure import Structure
from nfc_gym.inference.linear import LinearBase

PRIOR = torch.distributions.Normal(0, 1)


def densities(sizes: tuple[int, ...], features: int) -> dict[str, Density]:
    return {
        "score": Score(sizes, features, 16, 2),
        "mixture": Chain(sizes, features, lambda d, f: Mixture(d, f, 16, 3)),
        "flow": Chain(sizes, features, lambda d, f: Flow(d, f, 16, 2)),
    }


def shaken(density: Density) -> Density:
    """Weights away from their start, so that nothing is at its prior."""
    with torch.no_grad():
        for p in density.parameters():
            p.add_(0.2 * torch.randn_like(p))
    return density.eval()


def test_an_untrained_score_model_is_exactly_the_prior() -> None:
    model = Score((2, 1), 4, 16, 2)
    x, f = torch.randn(5, 7, 3), torch.randn(5, 4)
    torch.testing.assert_close(model.log_prob(x, f), PRIOR.log_prob(x).sum(-1))
    torch.testing.assert_close(model.log_prob(x[..., :2], f, 1), PRIOR.log_prob(x[..., :2]).sum(-1))


@pytest.mark.parametrize("name", ["score", "mixture", "flow"])
def test_densities_integrate_to_one_jointly_and_for_psi_alone(name: str) -> None:
    model = shaken(densities((1, 1), 3)[name])
    f = torch.randn(1, 3)
    line = torch.linspace(-9, 9, 81)
    grid = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1).reshape(1, -1, 2)
    cell = float(line[1] - line[0])
    with torch.no_grad():
        joint = model.log_prob(grid, f).exp()
        alone = model.log_prob(line[None, :, None], f, 1).exp()
    assert float(joint.sum()) * cell**2 == pytest.approx(1, abs=0.03)
    assert float(alone.sum()) * cell == pytest.approx(1, abs=0.03)
    if name != "score":  # a chain's first factor is its marginal; a score model learns both
        torch.testing.assert_close(joint.view(81, 81).sum(1) * cell, alone[0], atol=0.02, rtol=0.05)


@pytest.mark.parametrize("name", ["score", "mixture", "flow"])
def test_samples_follow_the_density(name: str) -> None:
    """E[-log q] over a model's own samples is its entropy, which the density gives by integration too."""
    model = shaken(densities((1,), 3)[name])
    f = torch.randn(1, 3)
    line = torch.linspace(-9, 9, 721)
    with torch.no_grad():
        logq = model.log_prob(line[None, :, None], f)[0]
        mean = float((logq.exp() * line).sum() * (line[1] - line[0]))
        var = float((logq.exp() * (line - mean) ** 2).sum() * (line[1] - line[0]))
        how = {"steps": 60} if name == "score" else {}  # this random field is no diffusion's, and bends more
        x = model.sample(8000, f, **how)[0, :, 0]
    assert float(x.mean()) == pytest.approx(mean, abs=4 * math.sqrt(var / 8000) + 0.02)
    assert float(x.var()) == pytest.approx(var, rel=0.1)


def test_many_pairs_at_once_are_the_same_as_one_by_one() -> None:
    for name, model in densities((2, 1), 4).items():
        shaken(model)
        how = {"steps": 3} if name == "score" else {}
        x, f = torch.randn(2, 3, 3), torch.randn(2, 4)
        with torch.no_grad():
            together = model.log_prob(x, f, **how)
            alone = torch.stack([torch.stack([model.log_prob(x[i : i + 1, j : j + 1], f[i : i + 1], **how)[0, 0]
                                              for j in range(3)]) for i in range(2)])  # fmt: skip
        torch.testing.assert_close(together, alone, atol=1e-4, rtol=1e-4)


def test_a_flow_that_is_too_sure_is_widened_by_pairs_it_has_not_learned() -> None:
    model, features = shaken(densities((2, 1), 3)["flow"]), torch.randn(1, 3).expand(4000, 3)
    with torch.no_grad():
        for link in model.links:
            link.flow.base.scale.fill_(1.5)  # what the pairs are drawn from is half as wide again
        x = model.sample(4000, features[:1])[0]
        right = float(model.log_prob(x[None], features[:1]).mean())
        for link in model.links:
            link.flow.base.scale.fill_(1.0)
        narrow = float(model.log_prob(x[None], features[:1]).mean())
        model.calibrate(x, features)
        mended = float(model.log_prob(x[None], features[:1]).mean())
    assert [float(link.flow.base.scale.mean()) for link in model.links] == pytest.approx([1.5, 1.5], abs=0.04)
    assert narrow + 0.2 < right == pytest.approx(mended, abs=0.01)


def test_a_mixture_of_one_is_a_gaussian() -> None:
    model = shaken(Mixture(3, 2, 8, 1))
    f, x = torch.randn(4, 2), torch.randn(4, 5, 3)
    with torch.no_grad():
        _, mean, root = model.parts(f)
        # white = L^T (x - mean): the precision is L L^T
        known = torch.distributions.MultivariateNormal(mean, precision_matrix=root @ root.mT)
        torch.testing.assert_close(model.log_prob(x, f), known.log_prob(x), atol=1e-3, rtol=1e-3)
        drawn = model.sample(20000, f[:1])[0]
    torch.testing.assert_close(torch.cov(drawn.T), known.covariance_matrix[0, 0], atol=0.05, rtol=0.1)


def test_the_linear_base_is_the_posterior_of_a_linear_gaussian() -> None:
    n = 20000
    z = torch.randn(n, 2)
    a = torch.tensor([[1.0, 0.5], [0.0, 2.0], [1.0, 1.0]])
    r = z @ a.T + 0.5 * torch.randn(n, 3) + 4
    base = LinearBase(3, 2)
    base.fit(r, z)
    covariance = torch.linalg.inv(torch.eye(2) + a.T @ a / 0.25)
    torch.testing.assert_close(base.factor @ base.factor.T, covariance, atol=2e-3, rtol=0.05)
    # a regression of 20000 pairs knows its means to 1 / sqrt(20000) of the posterior's spread, per input
    wrong = (base(r) - (r - 4) @ a / 0.25 @ covariance) / covariance.diagonal().sqrt()
    assert wrong.square().mean().sqrt() < 0.03
    y = base.whiten(z, base(r))
    torch.testing.assert_close(torch.cov(y.T), torch.eye(2), atol=0.03, rtol=0.03)
    torch.testing.assert_close(base.colour(y, base(r)), z, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(base.whiten(z[:, :1], base(r)), y[:, :1])  # marginals stay marginals


def test_a_linear_base_on_noise_is_the_prior() -> None:
    base = LinearBase(150, 2)
    r, z = torch.randn(300, 150), torch.randn(300, 2)
    base.fit(r, z)
    assert (base.factor @ base.factor.T - torch.cov(z.T)).abs().max() < 0.1  # no gain from 150 columns of noise
    assert base(torch.randn(500, 150)).std() < 0.2


@pytest.mark.parametrize("n", [2, 3, 5, 20, 60, 100, 110])
def test_a_linear_base_of_few_windows_claims_nothing(n: int) -> None:
    """With fewer pairs than inputs a weak ridge goes through every one, and says nothing of the next."""
    torch.manual_seed(n)
    size = 9
    base = LinearBase(100, size)
    base.fit(torch.randn(n, 100), torch.randn(n, size))
    r, x = torch.randn(2000, 100), torch.randn(2000, size)
    y = base.whiten(x, base(r))
    assert y.square().mean().sqrt() < (5.0 if n < 10 else 1.7), "what it never saw lies within what it claims"


def test_the_structure_heads_probabilities() -> None:
    head = Structure(4, 3)
    p = head(torch.randn(6, 4))
    torch.testing.assert_close(p.sum(1), torch.ones(6))
    family = torch.tensor([0, 1, 2, 0, 1, 2])
    features = torch.nn.functional.one_hot(family, 4).float()
    for _ in range(200):
        loss = head.loss(family, features).mean()
        loss.backward()
        with torch.no_grad():
            for q in head.parameters():
                q -= 0.5 * q.grad  # type: ignore[operator]
                q.grad = None
    assert (head(features).argmax(1) == family).all()
