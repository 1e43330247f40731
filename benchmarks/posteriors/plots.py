"""The paper's pictures: joint posteriors of two parameters, sampled residual terrains, perceived and true ground."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.inference import checkpoint
from nfc_gym.inference.network import Network
from nfc_gym.inference.space import PriorBox
from posteriors.fitted import Fitted
from posteriors.methods import INPUTS, METHODS, OURS
from posteriors.residuals import maps_of
from posteriors.sets import Held, Sets

Array = NDArray[np.float64]
_DRAWS, _MAPS = 2000, 24
DRAWS = "draws.npz"


def draw(
    out: Path, training: Path, place: str, prior: PriorBox, sets: Sets, struck: Sets, device: torch.device
) -> list[Path]:  # fmt: skip
    """Every picture that the trained posteriors of one environment allow; gives the files.

    Args:
      out, training: where pictures go, and where draws and networks lie.
      place: robot and ground.
      prior: psi's box.
      sets, struck: windows of the table, and those of the residual heads.
      device: of the networks.
    """
    folder = out / "plots"
    folder.mkdir(exist_ok=True)
    files: list[Path] = []
    for inputs in INPUTS:
        found = {k: sorted(training.glob(f"{place}_{k}_{inputs}_*/{DRAWS}")) for k in METHODS}
        drawn = {METHODS[k].name: np.load(files_[0])["u"] for k, files_ in found.items() if files_}
        if drawn:
            files.append(joint(folder / f"{place}_{inputs}_joint.png", drawn, prior, sets.judges.noisy()))
    heads = training / f"{place}_residuals" / "posterior.safetensors"
    if heads.is_file():
        network = checkpoint.load(heads)[0].to(device)
        files += ground(folder, place, network, struck.judges.noisy())
    return files


def keep_draws(fitted: Fitted, judges: Held, folder: Path) -> None:
    """Keep what a method draws for the window that is pictured: the first one without an effect."""
    folder.mkdir(parents=True, exist_ok=True)
    batch = judges.noisy()
    row = _pictured(batch)
    one = {k: t[row : row + 1] for k, t in batch.items()}
    np.savez(folder / DRAWS, u=fitted.draws(one, _DRAWS, 0).cpu().numpy()[0])


def _pictured(batch: dict[str, torch.Tensor]) -> int:
    return int(torch.nonzero(batch["family"] == 0)[0])


def joint(file: Path, drawn: dict[str, Array], prior: PriorBox, batch: dict[str, torch.Tensor]) -> Path:
    """The two parameters of which ours (else the last method there) says most, one panel a method."""
    free = np.array(prior.free)
    names, units = (np.array(v)[free] for v in (prior.names, prior.units))
    best = drawn.get(METHODS[OURS].name, list(drawn.values())[-1])
    a, b = (int(i) for i in np.argsort(best.std(0))[:2])
    low, high = (np.array(v)[free] for v in (prior.low, prior.high))
    truth = low + (high - low) * batch["psi"][_pictured(batch)].cpu().numpy()[free]
    figure, axes = plt.subplots(1, len(drawn), figsize=(2.6 * len(drawn), 3), sharex=True, sharey=True, squeeze=False)
    for axis, (name, u) in zip(axes[0], drawn.items(), strict=True):
        psi = low + (high - low) * u
        axis.hist2d(psi[:, a], psi[:, b], bins=25, range=[(low[a], high[a]), (low[b], high[b])], cmap="viridis")
        axis.plot(truth[a], truth[b], "x", color="red", markersize=9, markeredgewidth=2, label="truth")
        axis.set_title(name, fontsize=9)
        axis.set_xlabel(f"{names[a]} [{units[a]}]", fontsize=8)
        axis.tick_params(labelsize=7)
    axes[0, 0].set_ylabel(f"{names[b]} [{units[b]}]", fontsize=8)
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
    for axis in axes:
        axis.invert_xaxis()  # what lies to the left is shown there, as of the ground
    figure.colorbar(spread, ax=axes[5], label="[m]")
    return [*files, _saved(figure, folder / f"{place}_delta_e.png")]


def _saved(figure: plt.Figure, file: Path) -> Path:
    figure.savefig(file, dpi=130, bbox_inches="tight")
    plt.close(figure)
    return file
