"""Worlds that hide their truth: psi off, effects that the model lacks, ground, noise; how policies fare there."""
