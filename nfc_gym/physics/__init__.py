"""Physics over batches: model fields, parameters, tangent-space states, roll-outs, effects. Needs numpy, mujoco."""
