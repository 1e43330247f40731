"""Physics over batches: model fields and parameters, tangent-space states, roll-outs, effects. Needs numpy and mujoco alone."""
