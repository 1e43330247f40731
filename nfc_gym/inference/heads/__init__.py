"""What is learned on the features: densities of (psi, delta_s), residual terrain, the structure of what is missing."""
