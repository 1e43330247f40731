"""Table I of the paper: average log posterior of the simulator's parameters, and how far ours can be set beside it."""

ROBOTS = ("Ant", "Quadruped", "Humanoid", "Quadcopter", "Jackal")
TERRAINS = ("Flat", "Rough")
_ROWS = {
    "mdn-rff": (-4.88, -0.59, -2.09, -2.3, -10.52, -13.27, -2.26, -2.47, 0.64, -1.2),
    "mdn-tcn": (-2.6, -3.1, -1.64, -3.11, -2.52, -3.42, -1.79, -2.56, 0.22, -1.17),
    "sde-nn": (-1, -1.09, -1.14, -1.34, -1.63, -2.93, -1.2, -1.86, 0.26, -1.1),
    "sde-rff": (-2.79, -3.03, -2.17, -2.48, -2.61, -3.33, -3, -3.64, 0.06, -1.29),
    "sde-fks": (-2.63, -3.05, -2, -1.91, -2.41, -3.37, -2.42, -2.73, 0.24, -1.16),
    "sde-tcn": (0.57, 0.46, -0.42, -0.46, -1.03, -2.64, -0.9, -1.5, 1.21, 0.69),
}
CAVEAT = (
    "The paper does not say what its average log posterior is of. Ours beside it is the log density of all d "
    "parameters together, normalised to [-1, 1]: gain - d log 2, the prior being -d log 2. Robots' masses and bounds, "
    "motion, sensor noise and simulator are not the paper's, which gives none of them in full, so its figures are "
    "comparable with each other, ours with ours, and only the order of the methods between the two."
)


def reported(method: str, robot: str, terrain: str) -> float | None:
    """The paper's figure, where it has one."""
    row = _ROWS.get(method)
    return None if row is None else float(row[2 * ROBOTS.index(robot) + TERRAINS.index(terrain)])
