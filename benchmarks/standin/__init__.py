"""Stand-in machines: plain `mj_step` loops that share only the MJCF with the package; the Jackal's ships in it."""
