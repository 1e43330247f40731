"""`NeuralPosterior`: core's protocol, densities in physical units, checkpoints and what is refused."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from problems import SMALL, box, gaussian, linear_windows, motion_windows, network
from safetensors.torch import save_file

import nfc_gym  # noqa: F401 (registers the loader and the environments)
from nfc_gym.core import Fidelity, InputError, Posterior, load_source
from nfc_gym.inference import checkpoint
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.gains import gains
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window, load
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.state import read
from nfc_gym.wrappers import RandomizePsi


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def shaken(net: torch.nn.Module) -> torch.nn.Module:
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.1 * torch.randn_like(p))
    return net


def cart(**config: object) -> tuple[NeuralPosterior, Window]:
    windows = motion_windows(200)
    net = shaken(network(windows, delta_s=True, families=("none", "force"), **config))
    return NeuralPosterior(net), Window(windows.tensors["states"][0].numpy(), windows.tensors["actions"][0].numpy())


@pytest.mark.parametrize("density", ["score", "mixture", "flow"])
def test_it_is_a_posterior_of_the_core(density: str) -> None:
    posterior, window = cart(density=density, linear=True)
    given = posterior.given(window)
    assert isinstance(given, Posterior)
    drawn = given.sample(50, rng())
    assert drawn.given == ("psi", "delta_s")
    assert drawn.psi.shape == drawn.delta_s.shape == (50, 2)
    assert ((drawn.psi >= posterior.prior.low) & (drawn.psi <= posterior.prior.high)).all()
    np.testing.assert_array_equal(given.sample(50, rng()).psi, drawn.psi)
    assert (given.sample(50, np.random.default_rng(4)).psi != drawn.psi).any()
    assert given.log_prob(drawn).shape == given.log_prob(Fidelity(drawn.psi)).shape == (50,)
    assert sum(given.families().values()) == pytest.approx(1)


@pytest.mark.parametrize("linear", [False, True])
def test_delta_s_turns_with_the_world(linear: bool, tmp_path: Path) -> None:
    """A window says how it lies in the world and nothing of where: draws turn with it, and are as likely."""
    from test_encoders import NAMES, moved

    from nfc_gym.inference.encoders.place import place_of

    g = torch.Generator().manual_seed(1)
    states = torch.randn(60, 11, len(NAMES), generator=g)
    states[..., :4] = torch.nn.functional.normalize(states[..., :4], dim=-1)
    batch = {"states": states, "actions": torch.randn(60, 10, 1, generator=g), "psi": torch.rand(60, 2, generator=g),
             "delta_s": states[:, 1] - states[:, 0]}  # fmt: skip
    sizes = Sizes(10, len(NAMES), 1, place=place_of(NAMES))
    net = Network(NetworkConfig(**{**SMALL, "density": "mixture", "delta_s": True, "linear": linear}), sizes, box(2))
    net.fit_scales(batch)
    shaken(net)
    there = moved(states[:1], 2.0, (3.0, -1.0))
    one, other = (
        NeuralPosterior(net).given(Window(s[0].numpy(), batch["actions"][0].numpy())) for s in (states[:1], there)
    )
    drawn, turned = one.sample(40, rng()), other.sample(40, rng())
    np.testing.assert_allclose(turned.psi, drawn.psi, rtol=1e-4)
    expected = moved(torch.from_numpy(drawn.delta_s), 2.0, (0.0, 0.0)).numpy()
    np.testing.assert_allclose(turned.delta_s, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    assert np.abs(turned.delta_s - drawn.delta_s).max() > 0.1 * np.abs(drawn.delta_s).max()
    np.testing.assert_allclose(other.log_prob(turned), one.log_prob(drawn), rtol=1e-3, atol=1e-2)
    other.save(tmp_path / "p.safetensors")
    np.testing.assert_array_equal(load(tmp_path / "p.safetensors").sample(40, rng()).delta_s, turned.delta_s)
    tensors, metadata = read(tmp_path / "p.safetensors")
    about = json.loads(metadata["about"])
    del about["frame"]  # as files had none while delta_s was in the world's
    save_file(tensors, tmp_path / "old.safetensors", metadata | {"about": json.dumps(about)})
    with pytest.raises(InputError, match=r"its delta_s is in the world's frame.*train it again"):
        load(tmp_path / "old.safetensors")


@pytest.mark.parametrize("density", ["score", "mixture"])
def test_what_windows_tell_is_the_density_over_the_priors(density: str) -> None:
    windows = motion_windows(6)
    net = shaken(network(windows, delta_s=True, density=density))
    found = gains(net, windows.tensors)
    posterior, psi = NeuralPosterior(net), windows.tensors["psi"].double().numpy()
    low, high = np.array(posterior.prior.low), np.array(posterior.prior.high)
    for k in range(6):
        given = posterior.given(Window(*(windows.tensors[n][k].numpy() for n in ("states", "actions"))))
        own = given.log_prob(Fidelity(low + psi[k] * (high - low)))[0] + posterior.prior.log_volume
        assert found[k] == pytest.approx(own / 2, abs=1e-3)


def test_what_was_given_moves_along_to_another_device() -> None:
    posterior, window = cart()
    given = posterior.given(window)
    np.testing.assert_array_equal(given.of("psi").to("cpu").sample(9, rng()).psi, given.of("psi").sample(9, rng()).psi)
    assert given.of("psi").to("cpu").sample(9, rng()).given == ("psi",)


def test_sampling_leaves_torchs_generator_alone() -> None:
    posterior, window = cart()
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    posterior.given(window).sample(5, rng())
    torch.testing.assert_close(torch.rand(3), expected)


def test_threads_draw_what_one_alone_does() -> None:
    posterior, window = cart(density="flow")
    given = posterior.given(window)
    draw = lambda k: given.sample(40, np.random.default_rng(k)).psi  # noqa: E731
    alone = [draw(k) for k in range(12)]
    with ThreadPoolExecutor(6) as pool:
        together = list(pool.map(draw, range(12)))
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a, b)


def test_on_the_linear_base_draws_and_densities_are_the_closed_form() -> None:
    windows = linear_windows(8000)
    posterior = NeuralPosterior(network(windows, linear=True))
    x = windows.tensors["states"][0]
    given, exact = posterior.given(Window(x, np.zeros((0, 0)))), gaussian(x[0])
    prior = posterior.prior
    z = prior.to_z(given.sample(20000, rng()).psi)
    sd = exact.covariance_matrix.diagonal().sqrt().numpy()
    np.testing.assert_allclose((z.mean(0) - exact.mean.numpy()) / sd, 0, atol=0.08)
    np.testing.assert_allclose(np.cov(z.T), exact.covariance_matrix, atol=0.01, rtol=0.05)
    # in physical units: density in z over that of the prior, and 1 over the box's volume
    truth = exact.sample((200,))
    expected = exact.log_prob(truth) + (truth**2 + np.log(2 * np.pi)).sum(1) / 2 - prior.log_volume
    wrong = given.log_prob(Fidelity(prior.from_z(truth.double().numpy()))) - expected.double().numpy()
    assert abs(wrong.mean()) < 0.02


def test_no_memory_is_an_error_that_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    posterior, window = cart()
    given, drawn = posterior.given(window), posterior.given(window).sample(7, rng())

    def full(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    def fuller(*_: object, **__: object) -> torch.Tensor:
        return torch.empty(2**58)

    for lacks in (full, fuller):
        monkeypatch.setattr(given.network, "sample", lacks)
        monkeypatch.setattr(given.network, "log_prob", lacks)
        with pytest.raises(InputError, match="sample: no memory for 40 draws on cpu: draw fewer at a time"):
            given.sample(40, rng())
        with pytest.raises(InputError, match="log_prob: no memory for 7 points on cpu: ask for fewer"):
            given.log_prob(drawn)

    def wrong(*_: object, **__: object) -> None:
        raise RuntimeError("another mistake")

    monkeypatch.setattr(given.network, "sample", wrong)
    with pytest.raises(RuntimeError, match="another mistake"):
        given.sample(40, rng())


def test_an_untrained_posterior_is_the_prior_in_physical_units() -> None:
    windows = linear_windows(100)
    given = NeuralPosterior(network(windows)).given(Window(windows.tensors["states"][0], np.zeros((0, 0))))
    psi = given.sample(500, rng()).psi
    np.testing.assert_allclose(given.log_prob(Fidelity(psi)), -given.prior.log_volume, atol=0.01)
    outside = np.add(given.prior.high, [[0.1, 0, 0]])
    assert given.log_prob(Fidelity(outside)) == -np.inf


def test_the_density_of_psi_integrates_to_one_over_the_box() -> None:
    windows = linear_windows(300, 1)
    prior = PriorBox("toy", ("p",), ("m",), (2.0,), (7.0,))
    given = NeuralPosterior(shaken(network(windows, prior))).given(Window([[0.3]], np.zeros((0, 0))))
    psi = np.linspace(2, 7, 2001)[1:-1, None]
    assert np.exp(given.log_prob(Fidelity(psi))).sum() * 5 / 2000 == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("linear", [False, True])
def test_a_constant_entry_of_delta_s_stays_that_constant(linear: bool) -> None:
    windows = motion_windows(300)
    windows.tensors["delta_s"][:, 0] = 0.25
    seen = Window(windows.tensors["states"][0], windows.tensors["actions"][0])
    given = NeuralPosterior(shaken(network(windows, delta_s=True, linear=linear))).given(seen)
    drawn = given.sample(100, rng())
    np.testing.assert_allclose(drawn.delta_s[:, 0], 0.25, rtol=1e-6)
    assert drawn.delta_s[:, 1].std() > 0
    # such an entry has no part in the density: untrained and without the base, the other's integrates to one
    plain = NeuralPosterior(network(windows, delta_s=True)).given(seen)
    line = np.linspace(-1, 1, 4001) * 40 * windows.tensors["delta_s"][:, 1].std().item()
    psi = np.repeat(drawn.psi[:1], len(line), 0)
    density = np.exp(plain.log_prob(Fidelity(psi, np.stack([np.full(len(line), 0.25), line], 1))))
    volume = np.exp(plain.prior.log_volume)
    assert density.sum() * (line[1] - line[0]) * volume == pytest.approx(1, abs=0.02)


def test_longer_windows_count_from_their_end() -> None:
    posterior, window = cart()
    longer = Window(np.concatenate([np.ones((3, 2)), window.states]), np.concatenate([np.ones((3, 1)), window.actions]))
    a, b = posterior.given(window).sample(5, rng()), posterior.given(longer).sample(5, rng())
    np.testing.assert_array_equal(a.psi, b.psi)


def test_bad_windows_are_refused() -> None:
    posterior, window = cart()
    states, actions = np.array(window.states), np.array(window.actions)
    nan = states.copy()
    nan[4, 1] = np.nan
    for bad, message in (
        (Window(states[:6], actions[:5]), "5 steps; this network was trained on windows of 10"),
        (Window(nan, actions), "states holds nan"),
        (Window(states[:, :1], actions), r"states must have shape \(time, 2\)"),
        (Window(states[:-1], actions), r"n \+ 1 states go with n actions"),
    ):
        with pytest.raises(InputError, match=message):
            posterior.given(bad)
    with pytest.raises(InputError, match="was given no window"):
        posterior.sample(3, rng())
    with pytest.raises(InputError, match="delta_e has no density"):
        posterior.given(window).log_prob(Fidelity(np.ones((1, 2)), None, np.zeros((1, 4, 4))))
    with pytest.raises(InputError, match="x has no psi"):
        posterior.given(window).log_prob(Fidelity(None, np.zeros((1, 2))))


def test_what_no_density_or_draw_can_be_asked_is_refused() -> None:
    posterior, window = cart()
    given = posterior.given(window)
    drawn = given.sample(3, rng())
    assert drawn.psi is not None
    for n in (0, 2.5, True):
        with pytest.raises(InputError, match=f"sample: n is {n}, want a whole number, 1 or more"):
            given.sample(n, rng())  # type: ignore[arg-type]
    for steps in (0, -1):  # without a step it would be the prior that is drawn, or its density
        for ask in (lambda s: given.sample(3, rng(), steps=s), lambda s: given.log_prob(Fidelity(drawn.psi), steps=s)):
            with pytest.raises(InputError, match=f"steps is {steps}, want a whole number, 1 or more"):
                ask(steps)
    for nothing in (None, 5):
        with pytest.raises(InputError, match=f"sample: rng is {nothing}, want a generator of numbers"):
            given.sample(3, nothing)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"log_prob: stochastic= is no setting of the density 'score', which takes st"):
        given.log_prob(Fidelity(drawn.psi), stochastic=True)
    with pytest.raises(InputError, match=r"delta_s must end in 2 values, got shape \(3, 5\)"):
        given.log_prob(Fidelity(drawn.psi, np.zeros((3, 5))))
    states = np.array(window.states, float)
    states[4, 1] = 1e39
    with pytest.raises(InputError, match=r"states holds 1e\+39; every entry must be finite, also in float32"):
        posterior.given(Window(states, window.actions))


@pytest.mark.parametrize("density", ["flow", "mixture"])
def test_settings_of_another_density_are_refused(density: str) -> None:
    given = NeuralPosterior(network(motion_windows(20), density=density)).given(cart()[1])
    drawn = given.sample(3, rng())
    with pytest.raises(InputError, match=f"sample: steps= is no setting of the density '{density}', which takes n"):
        given.sample(3, rng(), steps=20)
    with pytest.raises(InputError, match=f"log_prob: steps= is no setting of the density '{density}', which takes n"):
        given.log_prob(drawn, steps=20)


@pytest.mark.filterwarnings("error::UserWarning")
def test_arrays_of_any_layout_are_the_same_window() -> None:
    posterior, window = cart()
    states, actions = np.array(window.states, float), np.array(window.actions, float)
    fixed = states.copy()
    fixed.flags.writeable = False
    wanted = posterior.given(Window(states, actions)).sample(4, rng())
    for other in (states[::-1].copy()[::-1], np.asfortranarray(states), fixed, states.astype(">f8"), states.tolist()):
        found = posterior.given(Window(other, actions[::-1].copy()[::-1])).sample(4, rng())
        np.testing.assert_array_equal(found.psi, wanted.psi)
    given = posterior.given(window)
    turned = Fidelity(wanted.psi[::-1], wanted.delta_s[::-1])
    np.testing.assert_allclose(given.log_prob(turned), given.log_prob(wanted)[::-1], rtol=1e-5)
    for odd in ([["a", "b"]] * 11, [[1, 2], [3]]):
        with pytest.raises(InputError, match="window: states must be an array of numbers"):
            posterior.given(Window(odd, actions))


@pytest.mark.parametrize("density", ["score", "mixture", "flow"])
def test_no_points_have_no_densities(density: str) -> None:
    windows = motion_windows(64)
    posterior = NeuralPosterior(network(windows, density=density))
    window = Window(windows.tensors["states"][0], windows.tensors["actions"][0])
    assert posterior.given(window).log_prob(Fidelity(np.zeros((0, 2)))).shape == (0,)


def test_a_robots_psi_is_drawn_from_a_file(tmp_path: Path) -> None:
    with gymnasium.make("nfc_gym/JackalFlat-v0", context=["psi"]) as env:
        prior = PriorBox.of(env.unwrapped.psi_space, "jackal")
        windows = motion_windows(50)
        windows.tensors["psi"] = torch.rand(50, len(prior))
        t = windows.tensors
        given = NeuralPosterior(network(windows, prior)).given(Window(t["states"][0], t["actions"][0]))
        given.save(tmp_path / "given.safetensors")
        randomised = RandomizePsi(env, str(tmp_path / "given.safetensors"))
        randomised.reset(seed=0)
        first = randomised.psi
        randomised.reset(seed=1)
        assert (first >= prior.low).all()
        assert (first <= prior.high).all()
        assert (first != randomised.psi).any()


@pytest.mark.parametrize("density", ["score", "mixture", "flow"])
def test_checkpoints_hold_all_that_rebuilds_it(tmp_path: Path, density: str) -> None:
    posterior, window = cart(density=density, encoder="tcn", summaries=True, linear=True)
    posterior.save(tmp_path / "p.safetensors")
    again = load(tmp_path / "p.safetensors", posterior.prior)
    expected = posterior.given(window).sample(20, rng())
    np.testing.assert_array_equal(again.given(window).sample(20, rng()).psi, expected.psi)
    np.testing.assert_array_equal(again.given(window).sample(20, rng()).delta_s, expected.delta_s)
    # with its window inside, it is a source that any wrapper opens by its path
    posterior.given(window).save(tmp_path / "g.safetensors")
    np.testing.assert_array_equal(load_source(tmp_path / "g.safetensors").sample(20, rng()).psi, expected.psi)
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["g.safetensors", "p.safetensors"]


def test_a_checkpoint_of_something_else_is_refused(tmp_path: Path) -> None:
    posterior, _ = cart()
    path = tmp_path / "p.safetensors"
    posterior.save(path)
    with pytest.raises(InputError, match=r"p.safetensors is of the robot 'toy', not of 'arm'"):
        load(path, box(2, "arm"))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="truncated"):
        load(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match="truncated, or no safetensors file"):
        load_source(path)
    save_file({"a": torch.zeros(1)}, path, {"format": "nfc_gym-posterior-99"})
    with pytest.raises(InputError, match=r"'nfc_gym-posterior-99'; this version .* reads 'nfc_gym-posterior-1'"):
        load(path)
    save_file({"a": torch.zeros(1)}, path, {"format": checkpoint.FORMAT, "about": "{}"})
    with pytest.raises(InputError, match="describe no network"):
        load(path)
    with pytest.raises(InputError, match=r"ends in \.safetensors"):
        posterior.save(tmp_path / "p.pt")


@pytest.mark.parametrize("spoil", ["notes", "mean", "odd"])
def test_a_checkpoint_that_lacks_a_part_is_told_as_that(tmp_path: Path, spoil: str) -> None:
    posterior, window = cart()
    path = tmp_path / "p.safetensors"
    posterior.given(window).save(path)
    tensors, metadata = read(path)
    about = json.loads(metadata["about"])
    if spoil == "notes":
        del about["notes"]
    elif spoil == "mean":
        del tensors["given/mean"]
    else:
        tensors["given/odd"] = torch.zeros(1)
    save_file(tensors, path, metadata | {"about": json.dumps(about)})
    with pytest.raises(InputError, match=f"^{path}: its (metadata describe no|weights are not those of the) network"):
        load(path)


@pytest.mark.parametrize(
    ("part", "value"),
    [("prior", None), ("network", ["tcn"]), ("sizes", {"horizon": -3, "states": 2, "actions": 1}), ("notes", 1.5),
     ("sizes", {"horizon": "x", "states": 2, "actions": 1})],
)  # fmt: skip
def test_metadata_that_describe_no_network_are_told_as_that(tmp_path: Path, part: str, value: object) -> None:
    file = tmp_path / "p.safetensors"
    cart()[0].save(file)
    tensors, metadata = read(file)
    about = json.loads(metadata["about"]) | {part: value}
    save_file(tensors, file, {**metadata, "about": json.dumps(about)})
    with pytest.raises(InputError, match=r"p\.safetensors: its metadata describe no network"):
        load(file)


def test_networks_of_earlier_versions_are_opened_but_those_of_the_same_commands(tmp_path: Path) -> None:
    """Those said of every network whether all of its windows had the same commands."""
    posterior, window = cart()
    file = tmp_path / "p.safetensors"
    posterior.save(file)
    tensors, metadata = read(file)
    about = json.loads(metadata["about"])
    assert "aligned" not in about["network"]

    def written(aligned: bool) -> None:
        earlier = about | {"network": about["network"] | {"aligned": aligned}}
        save_file(tensors, file, {**metadata, "about": json.dumps(earlier)})

    written(False)
    expected = posterior.given(window).sample(9, rng()).psi
    np.testing.assert_array_equal(load(file).given(window).sample(9, rng()).psi, expected)
    written(True)
    with pytest.raises(InputError, match=r"p\.safetensors: its metadata describe no network that this version knows"):
        load(file)


def test_a_folder_is_no_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"{tmp_path} is a folder; want a file"):
        load(tmp_path)
