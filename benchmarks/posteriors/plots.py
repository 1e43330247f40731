"""The paper's pictures: joint posteriors of two parameters, sampled residual terrains, perceived and true ground."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from posteriors.fitted import Ours
from posteriors.methods import METHODS
from posteriors.residuals import maps_of
from posteriors.sets import Held

from nfc_gym.inference import checkpoint
from nfc_gym.inference.network import Network

_DRAWS, _MAPS = 2000, 24


def draw(out: Path, training: Path, robot: str, terrain: str, judges: Held, device: torch.device) -> list[Path]:
    """Every picture that the trained posteriors of one environment allow; gives the files."""
    place, folder = f"{robot}{terrain}", out / "plots"
    folder.mkdir(exist_ok=True)
    batch = judges.noisy()
    files = []
    for inputs in ("window", "summaries", "linear", "map"):
        networks = {}
        for key, method in METHODS.items():
            found = sorted(training.glob(f"{place}_{key}_{inputs}_*/posterior.safetensors"))
            if found:
                networks[method.name] = checkpoint.load(found[0])[0].to(device)
        if networks:
            files.append(joint(folder / f"{place}_{inputs}_joint.png", networks, batch))
    heads = training / f"{place}_residuals" / "posterior.safetensors"
    if heads.is_file():
        network = checkpoint.load(heads)[0].to(device)
        files += ground(folder, place, network, batch)
    return files


def joint(file: Path, networks: dict[str, Network], batch: dict[str, torch.Tensor]) -> Path:
    """One window without an effect: the two parameters of which the last method says most, one panel a method."""
    row = int(torch.nonzero(batch["family"] == 0)[0])
    one = {k: t[row : row + 1] for k, t in batch.items()}
    drawn = {n: Ours(net).draws(one, _DRAWS, 0).cpu().numpy()[0] for n, net in networks.items()}
    network = list(networks.values())[-1]
    prior = network.prior
    names = [n for n, f in zip(prior.names, prior.free, strict=True) if f]
    a, b = (int(i) for i in np.argsort(list(drawn.values())[-1].std(0))[:2])
    low, high = (np.array(v)[list(prior.free)] for v in (prior.low, prior.high))
    truth = low + (high - low) * one["psi"].cpu().numpy()[0][list(prior.free)]
    figure, axes = plt.subplots(1, len(drawn), figsize=(2.6 * len(drawn), 3), sharex=True, sharey=True, squeeze=False)
    for axis, (name, u) in zip(axes[0], drawn.items(), strict=True):
        psi = low + (high - low) * u
        axis.hist2d(psi[:, a], psi[:, b], bins=40, range=[(low[a], high[a]), (low[b], high[b])], cmap="viridis")
        axis.plot(truth[a], truth[b], "x", color="red", markersize=9, markeredgewidth=2, label="truth")
        axis.set_title(name, fontsize=9)
        axis.set_xlabel(f"{names[a]} [{prior.units[prior.names.index(names[a])]}]", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[0, 0].set_ylabel(f"{names[b]} [{prior.units[prior.names.index(names[b])]}]", fontsize=8)
    axes[0, 0].legend(fontsize=7, loc="upper right")
    return _saved(figure, file)


def ground(folder: Path, place: str, network: Network, batch: dict[str, torch.Tensor]) -> list[Path]:
    """Perceived, true and reconstructed ground of one window; and draws of delta_e beside their spread."""
    one = {k: t[:1] for k, t in batch.items()}
    maps = maps_of(network, one, _MAPS, 0)
    seen, missing = (one[k].double().cpu().numpy()[0] for k in ("map", "delta_e"))
    panels = {"perceived": seen, "true": seen + missing, "reconstructed": seen + maps.mean(0)}
    low, high = min(p.min() for p in panels.values()), max(p.max() for p in panels.values())
    figure, axes = plt.subplots(1, 3, figsize=(9.5, 3), layout="constrained")
    for axis, (name, value) in zip(axes, panels.items(), strict=True):
        shown = axis.imshow(value, vmin=low, vmax=high, origin="lower", extent=(-6.4, 6.4, -6.4, 6.4))
        axis.set_title(name)
        axis.set_xlabel("to the left [m]")
        axis.invert_xaxis()
    axes[0].set_ylabel("forward [m]")
    figure.colorbar(shown, ax=axes, label="height less the base's [m]")
    files = [_saved(figure, folder / f"{place}_ground.png")]
    growing = {"truth": missing} | {f"draw {i + 1}": maps[i] for i in np.argsort(maps.var((1, 2)))[:: _MAPS // 4][:4]}
    most = max(np.abs(v).max() for v in growing.values())
    figure, axes = plt.subplots(1, 6, figsize=(15, 2.9), layout="constrained")
    for axis, (name, value) in zip(axes, growing.items(), strict=False):
        shown = axis.imshow(value, vmin=-most, vmax=most, cmap="RdBu_r", origin="lower")
        axis.set_title(f"{name}, sd {value.std():.3f} m", fontsize=9)
        axis.set_axis_off()
    figure.colorbar(shown, ax=axes[:5], label="delta_e [m]")
    spread = axes[5].imshow(maps.std(0), origin="lower")
    axes[5].set_title(f"spread of {_MAPS} draws", fontsize=9)
    axes[5].set_axis_off()
    figure.colorbar(spread, ax=axes[5], label="[m]")
    return [*files, _saved(figure, folder / f"{place}_delta_e.png")]


def _saved(figure: plt.Figure, file: Path) -> Path:
    figure.savefig(file, dpi=130, bbox_inches="tight")
    plt.close(figure)
    return file
